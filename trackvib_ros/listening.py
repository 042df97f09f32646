"""The subscriptions of a detector: blocks of all waveform topics into one intake."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import PointCloud2

from trackvib_ros.detection import Channel, TrainEvent
from trackvib_ros.intake import Intake

DRAIN_S = 0.7
"""Time for blocks that have arrived but were not looked at when listening ends (s)."""


class Listening:
    """Subscribed to the waveform topics from construction to :meth:`close`.

    Args:
        node: the subscriptions become this node's.
        channels: the accelerometers by topic.
        qos: of the subscriptions.
        tell: called with the events that a block completes.
        calibration: file that keeps what passages teach of the site, or none.
    """

    def __init__(
        self,
        node: Node,
        channels: dict[str, list[Channel]],
        qos: QoSProfile,
        tell: Callable[[Sequence[TrainEvent]], None],
        calibration: Path | None = None,
    ) -> None:
        self.channels = channels
        self._node = node
        self._tell = tell
        self._intake = Intake(channels, calibration)
        self._inputs = [(topic, self._subscribe(topic, qos)) for topic in channels]

    def _subscribe(self, topic: str, qos: QoSProfile) -> Any:
        def take(message: PointCloud2) -> None:
            self._tell(self._intake.take(topic, message))

        return self._node.create_subscription(PointCloud2, topic, take, qos)

    def state(self) -> tuple[str | None, dict[str, object]]:
        """Warning, if any, and figures for diagnostics."""
        silent = [topic for topic in self.channels if not self._node.count_publishers(topic)]
        return self._intake.state(silent)

    def close(self) -> None:
        """Take what has arrived, unsubscribe, and tell what is left to tell."""
        deadline = time.monotonic() + DRAIN_S
        for topic, subscription in self._inputs:
            self._drain(topic, subscription, deadline)
            self._node.destroy_subscription(subscription)
        self._inputs.clear()
        self._tell(self._intake.finish())
        if self._intake.not_kept:
            self._node.get_logger().error(self._intake.not_kept)

    def _drain(self, topic: str, subscription: Any, deadline: float) -> None:
        with subscription.handle:
            while taken := subscription.handle.take_message(subscription.msg_type, False):
                self._tell(self._intake.take(topic, taken[0]))
                if time.monotonic() > deadline:
                    self._node.get_logger().warning(f"ended before all of {topic} was looked at")
                    return
