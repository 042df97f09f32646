"""Publish a bag again: stored bytes and QoS, in the rhythm of the log times or at full speed."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from rclpy.duration import Duration
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)
from rosgraph_msgs.msg import Clock

from solver import InputError
from trackvib_ros.bag import BagMessage, BagReader, Qos, TopicInfo, type_hash
from trackvib_ros.bag.metadata import INFINITE_NS
from trackvib_ros.recorder import CLOCK, INFRASTRUCTURE, message_class

RCLError = rclpy_implementation.RCLError

SETTLE_S = 1.0
"""Subscriptions count as complete when none was added for this long (s)."""
DISCOVERY_S = 4.0
"""Without any subscription, playing begins after this time (s)."""
MAX_LATCHED = 1000
BEST_EFFORT_DEPTH = 100
DIAGNOSTICS = "/diagnostics"
_SLICE_S = 0.02
_ACK_TIMEOUT_S = 10.0


@dataclass(frozen=True, slots=True)
class ReplayOptions:
    """How to replay.

    Attributes:
        rate: times faster than recorded; 0 = as fast as subscribers take it.
        loop: start again at the end.
        clock_hz: publish ``/clock`` from the log times so many times per second instead of the
            recorded one; 0 = the recorded one.
        start_offset_s: skip so much of the bag (s); the last latched message of each topic before
            it is published nevertheless.
        duration_s: stop after so much of the bag (s); None = all.
        topics: only these; None = all.
        exclude: not these.
        remap: other names, by stored name.
        paused: wait for :meth:`Player.resume` before the first message.
        wait_for: topics (as published) that need a subscription before anything but latched
            messages is published.
    """

    rate: float = 1.0
    loop: bool = False
    clock_hz: float = 0.0
    start_offset_s: float = 0.0
    duration_s: float | None = None
    topics: Collection[str] | None = None
    exclude: Collection[str] = ()
    remap: Mapping[str, str] = field(default_factory=dict)
    paused: bool = False
    wait_for: Sequence[str] = ()

    def __post_init__(self) -> None:
        """Refuse what cannot be meant."""
        for name, value, unit in (
            ("--rate", self.rate, "times real time"),
            ("--clock-hz", self.clock_hz, "Hz"),
            ("--start-offset", self.start_offset_s, "s"),
            ("--duration", self.duration_s or 0.0, "s"),
        ):
            if not 0 <= value < float("inf"):
                raise InputError(f"{name} = {value} {unit}: must be a finite number, 0 or greater")


class Player:
    """Publishes the messages of one bag.

    Attributes:
        published: messages published, by topic.
        skipped: topics of the bag that cannot be published, with the reason.
        position_ns: log time reached (ns).
        late_s: largest delay behind the planned time (s).
    """

    def __init__(self, node: Node, reader: BagReader, options: ReplayOptions) -> None:
        """Create the publishers.

        Raises:
            InputError: a topic is not in the bag, or none can be published.
        """
        self.published: dict[str, int] = {}
        self.skipped: dict[str, str] = {}
        self.late_s = 0.0
        self.paused = options.paused
        self._node = node
        self._reader = reader
        self._options = options
        self._start_ns = reader.start_ns + round(options.start_offset_s * 1e9)
        self._end_ns = (
            None if options.duration_s is None else self._start_ns + round(options.duration_s * 1e9)
        )
        self.position_ns = self._start_ns
        self._publishers: dict[str, Any] = {}
        self._latched: set[str] = set()
        self._streams: set[str] = set()
        for name, info in self._chosen().items():
            self._open(name, info)
        if not self._publishers:
            reasons = "; ".join(self.skipped.values()) or "it has no messages"
            raise InputError(f"{reader.path}: nothing to publish: {reasons}")
        self._clock = node.create_publisher(Clock, CLOCK, 1) if options.clock_hz else None
        self._next_clock = 0.0
        self._clock_ns = -1
        self._state_ns = self._first_of_streams()

    def pause(self) -> None:
        """Hold the replay; ``/clock`` stands still but goes on being published."""
        self.paused = True

    def resume(self) -> None:
        """Go on."""
        self.paused = False

    def play(self, running: Callable[[], bool]) -> bool:
        """Publish everything; False if ``running()`` became false before the end.

        Raises:
            InputError: a stored message is not CDR.
        """
        waited = False
        while True:
            self._publish_state(running)
            waited = waited or self._wait_for_subscriptions(running)
            if not waited or not self._play_once(running):
                return False
            if not self._options.loop:
                return self._finish(running)

    def _play_once(self, running: Callable[[], bool]) -> bool:
        rate = self._options.rate
        begin = time.monotonic()
        topics = tuple(self._publishers)
        for message in self._reader.messages(topics, start_ns=self._start_ns, end_ns=self._end_ns):
            if message.topic in self._latched and message.log_time_ns <= self._state_ns:
                continue
            begin += self._hold(running)
            if rate > 0:
                ahead_s = (message.log_time_ns - self._start_ns) * 1e-9 / rate
                begin = self._wait(begin, ahead_s, running)
                self.late_s = max(self.late_s, time.monotonic() - begin - ahead_s)
            if not running():
                return False
            self.position_ns = message.log_time_ns
            self._tick()
            if not self._publish(message, running):
                return False
        return True

    def _wait(self, begin: float, ahead_s: float, running: Callable[[], bool]) -> float:
        """Sleep until ``begin + ahead_s``; returns ``begin``, moved by pauses meanwhile."""
        while running() and (left := begin + ahead_s - time.monotonic()) > 0:
            passed = (time.monotonic() - begin) * self._options.rate
            self.position_ns = self._start_ns + round(passed * 1e9)
            self._tick()
            time.sleep(min(left, _SLICE_S))
            begin += self._hold(running)
        return begin

    def _hold(self, running: Callable[[], bool]) -> float:
        """Stay while paused; returns how long (s)."""
        if not self.paused:
            return 0.0
        began = time.monotonic()
        while self.paused and running():
            self._tick()
            time.sleep(_SLICE_S)
        return time.monotonic() - began

    def _tick(self) -> None:
        """Publish ``/clock`` if it is due by the wall clock or, when that is faster, by the log."""
        if self._clock is None:
            return
        wall, period = time.monotonic(), 1.0 / self._options.clock_hz
        moved = abs(self.position_ns - self._clock_ns) * 1e-9
        if wall >= self._next_clock or (self._options.rate == 0 and moved >= period):
            self._next_clock = wall + period
            self._clock_ns = self.position_ns
            message = Clock()
            message.clock.sec = self.position_ns // 10**9
            message.clock.nanosec = self.position_ns % 10**9
            self._clock.publish(message)

    def _publish(self, message: BagMessage, running: Callable[[], bool]) -> bool:
        if len(message.data) < 4 or message.data[0] != 0 or message.data[1] > 1:
            raise InputError(
                f"{self._reader.path}: message of {message.topic} at log time "
                f"{message.log_time_ns} ns is not CDR (first bytes {message.data[:4].hex()})"
            )
        publisher = self._publishers[message.topic]
        while True:
            try:
                publisher.publish(bytes(message.data))
            except RCLError:
                # The history is full: subscribers of unlimited history hold the replay back.
                if not running():
                    return False
                continue
            self.published[message.topic] = self.published.get(message.topic, 0) + 1
            return True

    def _publish_state(self, running: Callable[[], bool]) -> None:
        """Publish latched messages from before the first message of a stream.

        They are state, not events of their time: subscribers (the detector) need them to know what
        to subscribe to. With a start offset this is what a late subscriber would have got.
        """
        if self._latched:
            for message in self._reader.messages(tuple(self._latched), end_ns=self._state_ns + 1):
                self._publish(message, running)

    def _first_of_streams(self) -> int:
        """Log time (ns) of the first message that is lost to who subscribes too late."""
        streams = [name for name in self._publishers if name in self._streams]
        for message in self._reader.messages(streams, start_ns=self._start_ns):
            return message.log_time_ns
        return self._start_ns

    def _wait_for_subscriptions(self, running: Callable[[], bool]) -> bool:
        """Wait for those asked for, or until the number of subscriptions is steady."""
        wanted = []
        for name in self._options.wait_for:
            absolute = self._node.resolve_topic_name(name)
            matching = [p for p in self._publishers.values() if p.topic_name == absolute]
            if not matching:
                raise InputError(
                    f"--wait-for {name}: the replay does not publish this topic; it publishes "
                    f"{', '.join(p.topic_name for p in self._publishers.values())}"
                )
            wanted += matching
        began = steady_since = time.monotonic()
        last = 0
        while running():
            count = sum(p.get_subscription_count() for p in self._publishers.values())
            if count != last:
                steady_since, last = time.monotonic(), count
            ready = all(publisher.get_subscription_count() > 0 for publisher in wanted)
            if ready and time.monotonic() >= max(
                steady_since + SETTLE_S, began + (0.0 if count else DISCOVERY_S)
            ):
                return True
            self._tick()
            time.sleep(_SLICE_S)
        return False

    def _finish(self, running: Callable[[], bool]) -> bool:
        """Stay until reliable subscribers have taken everything."""
        deadline = time.monotonic() + _ACK_TIMEOUT_S
        for publisher in self._publishers.values():
            while running() and time.monotonic() < deadline:
                if publisher.wait_for_all_acked(Duration(nanoseconds=100_000_000)):
                    break
        return running()

    def _chosen(self) -> dict[str, TopicInfo]:
        options = self._options
        known = self._reader.topics
        unknown = sorted({*(options.topics or ()), *options.exclude, *options.remap} - set(known))
        if unknown:
            raise InputError(
                f"topic {', '.join(unknown)} is not in {self._reader.path}; "
                f"it has {', '.join(known)}"
            )
        return {
            name: info
            for name, info in known.items()
            if info.count
            and (options.topics is None or name in options.topics)
            and name not in options.exclude
            and not (options.clock_hz and options.remap.get(name, name) == CLOCK)
        }

    def _open(self, name: str, info: TopicInfo) -> None:
        topic = info.topic
        try:
            message_type = message_class(topic.type)
            installed = type_hash(topic.type)
            if topic.type_hash and topic.type_hash != installed:
                raise InputError(
                    f"{name} was recorded with another definition of {topic.type} "
                    f"({topic.type_hash}) than the installed one ({installed})"
                )
        except InputError as failure:
            self.skipped[name] = str(failure)
            return
        qos = topic.qos[0] if len(set(topic.qos)) == 1 else Qos()
        latched = qos.durability == "transient_local"
        self._publishers[name] = self._node.create_publisher(
            message_type, self._options.remap.get(name, name), _profile(qos, info.count)
        )
        if latched:
            self._latched.add(name)
        elif qos.reliability == "reliable" and name not in (*INFRASTRUCTURE, DIAGNOSTICS):
            self._streams.add(name)


def _profile(qos: Qos, count: int) -> QoSProfile:
    """Stored QoS; DDS does not tell a publisher's history, so the one that loses nothing."""
    reliable = qos.reliability != "best_effort"
    latched = qos.durability == "transient_local"
    return QoSProfile(
        history=HistoryPolicy.KEEP_ALL if reliable and not latched else HistoryPolicy.KEEP_LAST,
        depth=min(count, MAX_LATCHED) if latched else max(qos.depth, BEST_EFFORT_DEPTH),
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
        deadline=_duration(qos.deadline_ns),
        lifespan=_duration(qos.lifespan_ns),
        liveliness=LivelinessPolicy.AUTOMATIC,
        liveliness_lease_duration=_duration(qos.lease_ns),
    )


def _duration(nanoseconds: int) -> Duration:
    return Duration(nanoseconds=0 if nanoseconds >= INFINITE_NS else nanoseconds)
