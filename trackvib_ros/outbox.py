"""Publishing without loss: a full middleware holds the run back instead of dropping messages."""

from __future__ import annotations

import time
from collections import Counter, deque
from typing import Any

from rclpy.duration import Duration
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.publisher import Publisher

from trackvib_ros.messages import STREAM, Topic

RCLError = rclpy_implementation.RCLError


class Outbox:
    """Publishers of a node by topic, and the messages that the middleware has not taken yet.

    A publisher of unlimited history refuses a message while its readers are behind; the message
    waits here, and whoever produces more shall not go on before :meth:`flush` says so.

    Attributes:
        published: messages handed to the middleware, by topic.
        refusals: times the middleware was full.
    """

    def __init__(self, node: Node) -> None:
        self.published: Counter[str] = Counter()
        self.refusals = 0
        self._node = node
        self._publishers: dict[str, tuple[Topic, Publisher]] = {}
        self._pending: deque[tuple[Topic, Any]] = deque()

    def open(self, topic: Topic) -> None:
        """Create the publisher of a topic, if there is none yet."""
        if topic.name not in self._publishers:
            publisher = self._node.create_publisher(topic.type, topic.name, topic.qos)
            self._publishers[topic.name] = (topic, publisher)

    def put(self, topic: Topic, message: Any) -> None:
        """Queue a message for publication."""
        self.open(topic)
        self._pending.append((topic, message))

    def flush(self) -> bool:
        """Publish what is queued; False while the middleware is full."""
        while self._pending:
            topic, message = self._pending[0]
            try:
                self._publishers[topic.name][1].publish(message)
            except RCLError:
                self.refusals += 1
                return False
            self.published[topic.name] += 1
            self._pending.popleft()
        return True

    @property
    def pending(self) -> int:
        """Messages that wait for the middleware."""
        return len(self._pending)

    def subscriptions(self) -> dict[str, int]:
        """Subscriptions matched, for every stream topic."""
        return {
            name: publisher.get_subscription_count()
            for name, (topic, publisher) in self._publishers.items()
            if topic.qos is STREAM
        }

    def acknowledged(self, timeout_s: float) -> bool:
        """Wait until every reliable reader has taken everything; False after ``timeout_s``."""
        deadline = time.monotonic() + timeout_s
        for _, publisher in self._publishers.values():
            left = max(0.0, deadline - time.monotonic())
            if not publisher.wait_for_all_acked(Duration(nanoseconds=int(left * 1e9))):
                return False
        return True

    def close(self) -> None:
        """Destroy the publishers; what is queued is given up."""
        for _, publisher in self._publishers.values():
            self._node.destroy_publisher(publisher)
        self._publishers.clear()
        self._pending.clear()
