"""Record ROS topics into a bag: every topic, bytes as received, without an executor."""

from __future__ import annotations

import importlib
import struct
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from solver import InputError
from trackvib_ros.bag import BagWriter, Qos, Topic, message_definition
from trackvib_ros.bag.metadata import INFINITE_NS

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

INFRASTRUCTURE = ("/parameter_events", "/rosout")
"""Topics that every node has."""
CLOCK = "/clock"
SCENARIO = "scenario"
"""Last part of the topic whose text (TOML) is copied to the custom data of the bag."""

_BEST_EFFORT_DEPTH = 2000
_DISCOVERY_PERIOD_S = 0.1
_POLL_PERIOD_S = 0.005
_CLOSE_S = 5.0
_HELD_BYTES = 16 << 20


class _PolledGroup(CallbackGroup):  # type: ignore[misc]
    """Keeps an executor that spins the node away from the recorder's subscriptions."""

    def can_execute(self, entity: object) -> bool:
        return False

    def beginning_execution(self, entity: object) -> bool:
        return False

    def ending_execution(self, entity: object) -> None:
        pass


@dataclass(slots=True)
class _Source:
    topic: str
    subscription: Any
    publishers: int
    recorded: bool
    last_sequences: list[int] = field(default_factory=list)


@dataclass(frozen=True, slots=True, order=True)
class _Arrival:
    received_ns: int
    topic: str
    source_ns: int
    data: bytes


class Recorder:
    """Subscribes to topics of a ROS graph and feeds a :class:`~trackvib_ros.bag.BagWriter`.

    Call :meth:`poll` at least every few milliseconds, or :meth:`start` a thread that does. The node
    may be spun by an executor meanwhile; its callbacks do not delay recording from the thread.

    Reliable topics are subscribed with unlimited history: when the queue is full, messages stay in
    the middleware, which holds publishers of unlimited history back. What is lost nevertheless
    shows as a gap in the publisher's sequence numbers and is counted in :attr:`drops`.

    Attributes:
        skipped: topics that cannot be recorded, with the reason.
    """

    def __init__(
        self,
        node: Node,
        directory: Path,
        *,
        topics: Sequence[str] | None = None,
        exclude: Collection[str] = (),
        custom_data: Mapping[str, str] | None = None,
        split_bytes: int | None = None,
        split_ns: int | None = None,
        queue_bytes: int = 64 << 20,
        flush_interval_s: float = 0.5,
        use_sim_time: bool = False,
    ) -> None:
        """Create the bag and subscribe to what is there.

        Args:
            node: the subscriptions become this node's.
            directory: the bag, must not exist.
            topics: names to record, relative ones in the node's namespace; all if None.
            exclude: names not to record.
            custom_data: stored in the bag (scenario, seed ...).
            split_bytes: start a new file after so many bytes.
            split_ns: start a new file after so many ns of log time.
            queue_bytes: bound of the queue in front of the disk (bytes).
            flush_interval_s: longest time a message waits before it goes to the disk (s).
            use_sim_time: log messages with the time of ``/clock``; what comes before the first
                clock message (latched topics) is logged with that one.

        Raises:
            InputError: the directory exists or an argument is out of range.
            OSError: the directory cannot be created.
        """
        self.skipped: dict[str, str] = {}
        self._node = node
        self._wanted = None if topics is None else {node.resolve_topic_name(t) for t in topics}
        self._excluded = {node.resolve_topic_name(t) for t in exclude}
        self._use_sim_time = use_sim_time
        self._clock = node.resolve_topic_name(CLOCK)  # a site may have a clock of its own
        self._sim_ns: int | None = None
        self._held: deque[_Arrival] = deque()
        self._held_bytes = 0
        self._scenario = b""
        self._lost: Counter[str] = Counter()
        self._sources: dict[str, _Source] = {}
        self._group = _PolledGroup()
        self._next_discovery = 0.0
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._closed = False
        self._error: str | None = None
        self._writer = BagWriter(
            directory,
            custom_data=custom_data,
            split_bytes=split_bytes,
            split_ns=split_ns,
            queue_bytes=queue_bytes,
            flush_interval_s=flush_interval_s,
        )
        self.poll()

    @property
    def directory(self) -> Path:
        """The bag."""
        return self._writer.directory

    @property
    def failure(self) -> str | None:
        """Why recording stopped by itself (disk full ...), None while all is well."""
        return self._error or self._writer.failure

    @property
    def counts(self) -> dict[str, int]:
        """Messages recorded, by topic."""
        return {topic: count for topic, count in list(self._writer.counts.items()) if count}

    @property
    def drops(self) -> dict[str, int]:
        """Messages lost in the middleware or in front of the disk, by topic."""
        total = Counter(dict(self._writer.drops)) + self._lost
        return dict(total)

    def state(self) -> tuple[str | None, dict[str, object]]:
        """Warning, if any, and figures for diagnostics."""
        drops = {topic: n for topic, n in self.drops.items() if n and topic != CLOCK}
        lost = ", ".join(f"{n} of {topic}" for topic, n in drops.items())
        return self.failure or (f"messages lost: {lost}" if drops else None), {
            "bag": self.directory,
            "lost": sum(drops.values()),
            "failure": self.failure or "",
            **{f"recorded {topic}": n for topic, n in self.counts.items()},
        }

    @property
    def topics(self) -> tuple[str, ...]:
        """Topics subscribed for recording."""
        return tuple(source.topic for source in self._sources.values() if source.recorded)

    def poll(self) -> int:
        """Queue all messages that have arrived and return how many; look for new topics.

        Never waits for the disk or for a message.
        """
        with self._lock:
            if self._closed:
                return 0
            if self.failure is not None:
                self._unsubscribe()
                return 0
            now = time.monotonic()
            if now >= self._next_discovery:
                self._next_discovery = now + _DISCOVERY_PERIOD_S
                self._discover()
            return self._take()

    def start(self) -> None:
        """Poll from a thread of its own until :meth:`stop` or :meth:`close`."""
        if self._thread is None:
            self._stop.clear()
            self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """End the thread; messages that have arrived are queued."""
        if self._thread is not None:
            self._stop.set()
            self._thread.join()
            self._thread = None

    def close(self) -> None:
        """Take what has arrived and finish the bag. Call before the node is destroyed.

        May be called again. Look at :attr:`failure` and :attr:`drops` afterwards.
        """
        self.stop()
        with self._lock:
            if self._closed:
                return
            deadline = time.monotonic() + _CLOSE_S
            while self.failure is None and self._node.context.ok() and time.monotonic() < deadline:
                if not self._take() and not self._writer.full:
                    break
                time.sleep(_POLL_PERIOD_S)
            for arrival in self._held:
                self._writer.write(arrival.topic, 0, arrival.source_ns, arrival.data)
            self._held.clear()
            self._unsubscribe()
            self._closed = True
        self._writer.close()

    def _run(self) -> None:
        while not self._stop.wait(_POLL_PERIOD_S):
            if not self._node.context.ok():
                return
            try:
                self.poll()
            except Exception as failure:
                # A thread that dies unseen would be a silent loss.
                self._error = f"recording to {self.directory} stopped: {failure!r}"
                self._node.get_logger().error(self._error)
                return

    def _discover(self) -> None:
        for name, types in self._node.get_topic_names_and_types():
            source = self._sources.get(name)
            if source is not None:
                source.publishers = self._node.count_publishers(name)
                continue
            recorded = self._is_wanted(name)
            if not recorded and not (self._use_sim_time and name == self._clock):
                continue
            if self._node.count_publishers(name) == 0:
                continue
            try:
                self._subscribe(name, types, recorded)
            except InputError as failure:
                self.skipped[name] = str(failure)
                self._node.get_logger().warning(f"not recorded: {failure}")

    def _is_wanted(self, name: str) -> bool:
        if name in self._excluded or name in self.skipped:
            return False
        if self._wanted is not None:
            return name in self._wanted
        return not any(part.startswith("_") for part in name.split("/"))

    def _subscribe(self, name: str, types: Sequence[str], recorded: bool) -> None:
        if len(types) != 1:
            raise InputError(f"topic {name} has types {', '.join(types)}: one topic has one type")
        publishers = self._node.get_publishers_info_by_topic(name)
        if not publishers:
            return
        if recorded:
            profiles = dict.fromkeys(_stored_qos(p.qos_profile) for p in publishers)
            self._writer.add_topic(
                Topic(
                    name,
                    types[0],
                    message_definition(types[0]),
                    str(publishers[0].topic_type_hash),
                    tuple(profiles),
                )
            )
        subscription = self._node.create_subscription(
            message_class(types[0]),
            name,
            _never_called,
            _matching_qos(p.qos_profile for p in publishers),
            callback_group=self._group,
            raw=True,
        )
        self._sources[name] = _Source(name, subscription, len(publishers), recorded)

    def _take(self) -> int:
        arrivals: list[_Arrival] = []
        room = self._writer.room
        for source in self._sources.values():
            subscription = source.subscription
            handle, message_type = subscription.handle, subscription.msg_type
            with handle:
                while room > 0:
                    taken = handle.take_message(message_type, True)
                    if taken is None:
                        break
                    data, info = taken
                    self._check_sequence(source, info["publication_sequence_number"])
                    arrivals.append(
                        _Arrival(
                            info["received_timestamp"], source.topic, info["source_timestamp"], data
                        )
                    )
                    room -= len(data)
        arrivals.sort(key=lambda arrival: arrival.received_ns)
        for arrival in arrivals:
            self._put(arrival)
        return len(arrivals)

    def _check_sequence(self, source: _Source, sequence: int | None) -> None:
        """Count what is missing before this number of its publisher.

        The middleware does not say whose number it is: it continues the publisher whose last one
        fits, else starts another one as long as fewer are known than there are.
        """
        if sequence is None:
            return
        lasts = source.last_sequences
        before = max((last for last in lasts if last < sequence), default=None)
        if before is None or (before < sequence - 1 and len(lasts) < source.publishers):
            lasts.append(sequence)
            return
        self._lost[source.topic] += sequence - before - 1
        lasts[lasts.index(before)] = sequence

    def _put(self, arrival: _Arrival) -> None:
        if self._use_sim_time:
            if arrival.topic == self._clock:
                self._sim_ns = _clock_ns(arrival.data)
                while self._held:
                    self._store(self._held.popleft(), self._sim_ns)
                self._held_bytes = 0
            elif self._sim_ns is None:
                self._hold(arrival)
                return
        now = arrival.received_ns if self._sim_ns is None else self._sim_ns
        if self._sources[arrival.topic].recorded:
            self._store(arrival, now)

    def _store(self, arrival: _Arrival, log_time_ns: int) -> None:
        if arrival.topic.rpartition("/")[2] == SCENARIO and arrival.data != self._scenario:
            self._scenario = arrival.data
            self._writer.add_custom_data(_scenario_data(arrival.data))
        self._writer.write(arrival.topic, log_time_ns, arrival.source_ns, arrival.data)

    def _hold(self, arrival: _Arrival) -> None:
        if self._held_bytes + len(arrival.data) > _HELD_BYTES:
            self._lost[arrival.topic] += 1
            return
        self._held.append(arrival)
        self._held_bytes += len(arrival.data)

    def _unsubscribe(self) -> None:
        for source in self._sources.values():
            self._node.destroy_subscription(source.subscription)
        self._sources.clear()


def _never_called(_data: bytes, _info: object) -> None:
    """Two arguments make rclpy hand out the message info."""


def message_class(type_name: str) -> Any:
    """Return the installed class of ``package/msg/Type``; raises :class:`InputError` if none."""
    package, _, name = type_name.partition("/msg/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError):
        raise InputError(
            f"message type {type_name} is not installed: install the Python package {package}"
        ) from None


def _matching_qos(offered: Iterable[QoSProfile]) -> QoSProfile:
    """Ask for no more than every publisher offers, as rosbag2 does."""
    profiles = list(offered)
    reliable = all(p.reliability == ReliabilityPolicy.RELIABLE for p in profiles)
    latched = all(p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in profiles)
    return QoSProfile(
        history=HistoryPolicy.KEEP_ALL if reliable else HistoryPolicy.KEEP_LAST,
        depth=_BEST_EFFORT_DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def _stored_qos(profile: QoSProfile) -> Qos:
    return Qos(
        reliability=profile.reliability.name.lower(),
        durability=profile.durability.name.lower(),
        deadline_ns=min(profile.deadline.nanoseconds, INFINITE_NS),
        lifespan_ns=min(profile.lifespan.nanoseconds, INFINITE_NS),
        liveliness=profile.liveliness.name.lower(),
        lease_ns=min(profile.liveliness_lease_duration.nanoseconds, INFINITE_NS),
    )


def _clock_ns(cdr: bytes) -> int:
    """Return the time (ns) of a serialized ``rosgraph_msgs/Clock``, which is never negative.

    Byte 1 of CDR tells the byte order.
    """
    seconds, nanoseconds = struct.unpack_from("<iI" if cdr[1] & 1 else ">iI", cdr, 4)
    return max(0, int(seconds) * 10**9 + int(nanoseconds))


def _scenario_data(cdr: bytes) -> dict[str, str]:
    """Return the custom data of a serialized ``std_msgs/String`` that holds a scenario."""
    (size,) = struct.unpack_from("<I" if cdr[1] & 1 else ">I", cdr, 4)
    text = cdr[8 : 7 + size].decode("utf-8", "replace")
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return {"scenario": text}
    seeds = ", ".join(f"{path} = {value}" for path, value in _seeds(content, ""))
    return {"scenario": text, "seed": seeds}


def _seeds(value: object, path: str) -> Iterator[tuple[str, object]]:
    if isinstance(value, dict):
        for key, inner in value.items():
            if key == "seed":
                yield f"{path}seed", inner
            else:
                yield from _seeds(inner, f"{path}{key}.")
    elif isinstance(value, list):
        for number, inner in enumerate(value):
            yield from _seeds(inner, f"{path[:-1]}[{number}].")
