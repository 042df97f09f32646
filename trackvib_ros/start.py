"""How processes begin: the command ``trackvib``, and ``python -m trackvib_ros.start
sensor|detector [--ros-args ...]``, the process of a node.

Before the imports, which take a second, signals are caught, for until a node exists there is
nothing to clean up, and numpy is kept to one thread. Matrices are small here: more threads wait for
each other, and on two cores for the other node, at ten times the work of one.
"""

import os
import signal
import sys
from types import FrameType


def _one_thread() -> None:
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(name, "1")


def _leave(_number: int, _frame: FrameType | None) -> None:
    os._exit(0)


def main() -> None:
    """Run the node named by the first argument."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _leave)
    if len(sys.argv) < 2 or sys.argv[1] not in ("sensor", "detector"):
        sys.exit("name the node to start: sensor or detector")
    _one_thread()
    from trackvib_ros.process import main as run_node

    if sys.argv[1] == "sensor":
        from trackvib_ros.sensor_node import SensorNode

        run_node(SensorNode)
    else:
        from trackvib_ros.detector_node import DetectorNode

        run_node(DetectorNode)


def command() -> None:
    """Run the command line."""
    _one_thread()
    from trackvib_ros.cli import main as run_command

    run_command()


if __name__ == "__main__":
    main()
