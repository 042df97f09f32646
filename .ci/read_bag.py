"""Read a bag with rosbags and with mcap; both must find the same messages, decoded alike."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

from mcap.reader import make_reader
from rosbags.highlevel import AnyReader


def main() -> None:
    """Compare counts, stamps and payload bytes of both readers; exit non-zero on a difference."""
    (bag,) = [path.parent for path in Path(sys.argv[1]).rglob("metadata.yaml")]
    by_mcap: list[tuple[str, int, bytes]] = []
    for file in sorted(bag.glob("*.mcap")):
        with file.open("rb") as stream:
            for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
                by_mcap.append((channel.topic, message.log_time, message.data))
    by_rosbags: list[tuple[str, int, bytes]] = []
    decoded = 0
    with AnyReader([bag]) as reader:
        for connection, stamp, data in reader.messages():
            reader.deserialize(data, connection.msgtype)
            decoded += 1
            by_rosbags.append((connection.topic, stamp, bytes(data)))
    if sorted(by_mcap) != sorted(by_rosbags) or not by_mcap:
        sys.exit(f"readers disagree: mcap {len(by_mcap)}, rosbags {len(by_rosbags)} messages")
    for topic, count in sorted(Counter(topic for topic, _, _ in by_mcap).items()):
        print(f"{count:6d} {topic}")
    print(f"{decoded} messages, the same from both readers, all decoded")


main()
