"""The detector on a replay says what it says on the bag itself, message by message."""

from __future__ import annotations

import signal
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

from tests.ros.test_record_replay import Command, command, domain, ended, node, until
from trackvib_ros import messages as m
from trackvib_ros.bag import BagReader
from trackvib_ros.detection import TrainDetector, TrainEvent

__all__ = ["command", "domain", "node"]

pytestmark = pytest.mark.ros

BAG = Path(__file__).parents[2] / "bags" / "demo"
DETECTED = ("/train/events", "/train/occupied", "/train/speed", "/diagnostics")


def events_of_the_bag() -> list[TrainEvent]:
    """The detector fed from the bag without ROS."""
    reader = BagReader(BAG)
    (description,) = reader.messages(("/channels",))
    channels = m.read_channels(reader.decode(description))
    detector = TrainDetector([channel for group in channels.values() for channel in group])
    blocks = [
        (message.log_time_ns, wave)
        for topic in channels
        for message, wave in zip(
            reader.messages((f"/{topic}",)), reader.waveforms(f"/{topic}"), strict=True
        )
    ]
    events: list[TrainEvent] = []
    for _, block in sorted(blocks, key=lambda entry: entry[0]):
        events += detector.process(block)
    return events + detector.finish()


@pytest.mark.parametrize("rate", ["max", pytest.param("4", marks=pytest.mark.slow)])
def test_replay_gives_the_same_events(node: Node, command: Command, rate: str) -> None:
    wanted = events_of_the_bag()
    assert {event.kind for event in wanted} >= {"arrival", "departure", "passage"}
    received: list[Any] = []
    blocks: dict[str, int] = {}

    def on_diagnostics(message: DiagnosticArray) -> None:
        for status in message.status:
            for pair in status.values:
                if pair.key.startswith("blocks "):
                    blocks[pair.key.removeprefix("blocks ")] = int(pair.value)

    node.create_subscription(DiagnosticArray, "/train/events", received.append, m.EVENTS)
    node.create_subscription(DiagnosticArray, "/diagnostics", on_diagnostics, m.STATUS)
    detector = command("detect")
    waves = [name for name in BagReader(BAG).topics if name.endswith("/waveform")]
    options = [part for name in DETECTED for part in ("--exclude-topics", name)]
    options += [part for name in waves for part in ("--wait-for", name)]
    player = command("replay", str(BAG), "--rate", rate, *options)

    def spin() -> None:
        rclpy.spin_once(node, timeout_sec=0.01)

    until(lambda: player.poll() is not None, "end of the replay", spin)
    status, output = ended(player)
    assert status == 0, output

    topics = BagReader(BAG).topics
    wanted_blocks = {name.lstrip("/"): topics[name].count for name in waves}
    until(
        lambda: {name.lstrip("/"): n for name, n in blocks.items()} == wanted_blocks,
        "every block in the detector",
        spin,
    )
    detector.send_signal(signal.SIGINT)
    until(lambda: detector.poll() is not None, "end of the detector", spin)
    status, output = ended(detector)
    assert status == 0, output
    spin()
    found = [event for message in received for event in m.read_events(message)]
    assert sorted(map(repr, found)) == sorted(map(repr, wanted))
