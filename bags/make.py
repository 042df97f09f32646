"""Make the sample bags anew: ``python bags/make.py [NAME ...]``, from the repository root.

Runs ``trackvib demo`` on the scenario beside this file, then copies the recording without what a
detector does not need (full-rate truth, markers, wheel forces), so that the set stays small. A
bag that exists is not overwritten: remove it first.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path

from trackvib_ros.bag import BagReader, BagWriter

HERE = Path(__file__).parent
SCENARIOS = {
    "demo": "demo",
    "metro": str(HERE / "metro.toml"),
    "double": str(HERE / "double.toml"),
    "succession": str(HERE / "succession.toml"),
    "noise": str(HERE / "noise.toml"),
}
LEFT_OUT = ("/ground_truth/acceleration", "/ground_truth/wheel_force", "/markers")
LEFT_OUT_BELOW = ("/wheel_force/", "/parameter_events", "/rosout")


def kept(topic: str) -> bool:
    """Whether a sample bag has this topic."""
    return topic not in LEFT_OUT and not topic.startswith(LEFT_OUT_BELOW)


def copy(source: BagReader, target: Path) -> None:
    """Copy the messages of the kept topics: same bytes, times, QoS and custom data."""
    writer = BagWriter(target, custom_data=source.custom_data)
    topics = [name for name in source.topics if kept(name)]
    for name in topics:
        writer.add_topic(source.topics[name].topic)
    for message in source.messages(topics):
        while writer.full:
            time.sleep(0.01)
        writer.write(message.topic, message.log_time_ns, message.publish_time_ns, message.data)
    writer.close()
    if writer.failure or writer.drops:
        sys.exit(f"{target}: {writer.failure or dict(writer.drops)}")


def main() -> None:
    """Make the named bags, or all."""
    for name in sys.argv[1:] or list(SCENARIOS):
        target = HERE / name
        if target.exists():
            sys.exit(f"{target} exists: remove it first")
        with tempfile.TemporaryDirectory() as scratch:
            output = Path(scratch) / name
            command = ["trackvib", "demo", "-s", SCENARIOS[name], "-o", str(output), "--no-figure"]
            print(" ".join(command), flush=True)
            status = subprocess.run(command).returncode
            if status not in (0, 1):
                sys.exit(f"{name}: trackvib demo ended with status {status}")
            copy(BagReader(output / "bag"), target)
            size = sum(path.stat().st_size for path in target.iterdir())
            print(f"{target}: {size / 1e6:.2f} MB\n", flush=True)


if __name__ == "__main__":
    main()
