"""``python -m trackvib_ros.start sensor|detector [--ros-args ...]``: the process of a node.

Signals are caught before the imports, which take a second: until a node exists there is nothing to
clean up.
"""

import os
import signal
import sys
from types import FrameType


def _leave(_number: int, _frame: FrameType | None) -> None:
    os._exit(0)


def main() -> None:
    """Run the node named by the first argument."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _leave)
    if len(sys.argv) < 2 or sys.argv[1] not in ("sensor", "detector"):
        sys.exit("name the node to start: sensor or detector")
    from trackvib_ros.process import main as run_node

    if sys.argv[1] == "sensor":
        from trackvib_ros.sensor_node import SensorNode

        run_node(SensorNode)
    else:
        from trackvib_ros.detector_node import DetectorNode

        run_node(DetectorNode)


if __name__ == "__main__":
    main()
