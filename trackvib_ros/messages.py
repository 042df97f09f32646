"""The only place that knows message types, QoS, frames and signs on the wire.

Frames are right-handed with z up (REP-103). ``line``: x along the running direction from the left
end of the modelled line, z = 0 at the rail head. A waveform's frame is its sensor group, an
acceleration's its channel, a wheel force's its wheelset. Stamps are simulation time.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import AccelStamped, TwistWithCovarianceStamped, WrenchStamped
from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Bool, Header, String
from visualization_msgs.msg import Marker, MarkerArray

from solver import InputError, Scenario
from trackvib_ros import topics
from trackvib_ros.channels import channel_values, read_channel
from trackvib_ros.detection import Channel, Estimate, TrainEvent
from trackvib_ros.pointcloud import decode, encode
from trackvib_ros.station import TrainState, WheelsetState
from trackvib_ros.truth import PassageTruth
from trackvib_ros.waveform import Waveform

MAX_BLOCK_BYTES = 16 << 20
"""A waveform message larger than this is refused before it is decoded (bytes)."""

STREAM = QoSProfile(
    history=HistoryPolicy.KEEP_ALL,
    depth=0,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
)
"""Nothing is lost: a full history blocks the publisher."""
LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
EVENTS = QoSProfile(
    depth=200, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
CLOCK_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
STATUS = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
BEST_EFFORT_STREAM = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic: name relative to the node's namespace (absolute where ROS says so), type, QoS."""

    name: str
    type: type
    qos: QoSProfile


CLOCK = Topic(topics.CLOCK, Clock, CLOCK_QOS)
DIAGNOSTICS = Topic(topics.DIAGNOSTICS, DiagnosticArray, STATUS)
SCENARIO = Topic(topics.SCENARIO, String, LATCHED)
CHANNELS = Topic(topics.CHANNELS, DiagnosticArray, LATCHED)
MARKERS = Topic(topics.MARKERS, MarkerArray, STATUS)
TRUE_ACCELERATION = Topic(topics.TRUE_ACCELERATION, PointCloud2, STREAM)
TRUE_WHEEL_FORCE = Topic(topics.TRUE_WHEEL_FORCE, PointCloud2, STREAM)
TRUE_WHEELSETS = Topic(topics.TRUE_WHEELSETS, PointCloud2, STREAM)
TRUE_TRAIN = Topic(topics.TRUE_TRAIN, Odometry, STREAM)
TRUE_PASSAGES = Topic(topics.TRUE_PASSAGES, DiagnosticArray, EVENTS)
TRAIN_EVENTS = Topic(topics.TRAIN_EVENTS, DiagnosticArray, EVENTS)
TRAIN_OCCUPIED = Topic(topics.TRAIN_OCCUPIED, Bool, LATCHED)
TRAIN_SPEED = Topic(topics.TRAIN_SPEED, TwistWithCovarianceStamped, EVENTS)


def waveform_topic(group: str) -> Topic:
    """Full-rate blocks of a sensor group."""
    return Topic(topics.waveform(group), PointCloud2, STREAM)


def acceleration_topic(channel: str) -> Topic:
    """The peak of every block of a channel, for people and plots."""
    return Topic(topics.acceleration(channel), AccelStamped, STREAM)


def wheel_force_topic(number: int) -> Topic:
    """The force on the ``number``-th wheelset (from 1) of the train on the line."""
    return Topic(topics.wheel_force(number), WrenchStamped, STREAM)


def to_stamp(nanoseconds: int) -> Time:
    """Integer nanoseconds as a message."""
    return Time(sec=nanoseconds // 1_000_000_000, nanosec=nanoseconds % 1_000_000_000)


def from_stamp(stamp: Time) -> int:
    """A message's time in integer nanoseconds."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def _header(nanoseconds: int, frame: str) -> Header:
    return Header(stamp=to_stamp(nanoseconds), frame_id=frame)


def _table(
    stamp_ns: int, frame: str, fields: list[PointField], point_step: int, data: bytes
) -> PointCloud2:
    rows = len(data) // point_step
    return PointCloud2(
        header=_header(stamp_ns, frame),
        height=1,
        width=rows,
        fields=fields,
        is_bigendian=False,
        point_step=point_step,
        row_step=point_step * rows,
        data=array("B", data),
        is_dense=False,
    )


def waveform_message(waveform: Waveform) -> PointCloud2:
    """A block as a table: field ``t`` (s after the stamp), then one field per channel."""
    columns, point_step, data = encode(waveform)
    fields = [
        PointField(name=c.name, offset=c.offset, datatype=c.datatype, count=c.count)
        for c in columns
    ]
    return _table(waveform.stamp_ns, waveform.frame_id, fields, point_step, data)


def read_waveform(message: PointCloud2) -> Waveform:
    """The block of a message; the sender may be any driver that follows the layout.

    Raises:
        InputError: says what is wrong with the message.
    """
    size = len(message.data)
    if size > MAX_BLOCK_BYTES:
        raise InputError(
            f"waveform block of {size} bytes: more than {MAX_BLOCK_BYTES} bytes; "
            "publish shorter blocks"
        )
    if message.is_bigendian:
        raise InputError("waveform block is big-endian: publish it little-endian")
    rows = int(message.width) * int(message.height)
    if size != rows * int(message.point_step):
        raise InputError(
            f"waveform block has {size} bytes, but width x height x point_step = "
            f"{message.width} x {message.height} x {message.point_step}"
        )
    return decode(
        from_stamp(message.header.stamp),
        message.fields,
        int(message.point_step),
        memoryview(message.data),
        message.header.frame_id,
    )


def acceleration_messages(waveform: Waveform) -> list[tuple[str, AccelStamped]]:
    """For each channel of a block the sample of largest magnitude, with its own stamp."""
    messages = []
    for column, channel in enumerate(waveform.channels):
        samples = waveform.data[:, column]
        if np.isnan(samples).all():
            continue
        row = int(np.nanargmax(np.abs(samples)))
        message = AccelStamped(header=_header(int(waveform.time_ns[row]), channel))
        message.accel.linear.z = float(samples[row])
        messages.append((channel, message))
    return messages


def wheel_force_message(stamp_ns: int, wheelset: WheelsetState) -> WrenchStamped:
    """Force of both rails on a wheelset, up, at one instant."""
    frame = f"train_{wheelset.train}_wheelset_{wheelset.number}"
    message = WrenchStamped(header=_header(stamp_ns, frame))
    message.wrench.force.z = wheelset.force
    return message


def wheelsets_message(stamp_ns: int, wheelsets: Sequence[WheelsetState]) -> PointCloud2:
    """The wheelsets on the line as points: x, y, z (m), force (N, up), train, wheelset (from 1)."""
    names = ("x", "y", "z", "force", "train", "wheelset")
    rows = [(w.position, 0.0, 0.0, w.force, w.train, w.number) for w in wheelsets]
    data = np.array(rows, dtype="<f4").tobytes()
    fields = [
        PointField(name=name, offset=4 * column, datatype=PointField.FLOAT32, count=1)
        for column, name in enumerate(names)
    ]
    return _table(stamp_ns, "line", fields, 4 * len(names), data)


def train_message(stamp_ns: int, train: TrainState) -> Odometry:
    """Position of the first wheelset and velocity of a train, along x of the line."""
    message = Odometry(header=_header(stamp_ns, "line"), child_frame_id=f"train_{train.number}")
    message.pose.pose.position.x = train.position
    message.pose.pose.orientation.w = 1.0
    message.twist.twist.linear.x = train.velocity
    return message


def _pairs(values: Mapping[str, str]) -> list[KeyValue]:
    return [KeyValue(key=key, value=value) for key, value in values.items()]


def _status(
    name: str, message: str, values: Mapping[str, str], level: bytes = DiagnosticStatus.OK
) -> DiagnosticStatus:
    return DiagnosticStatus(level=level, name=name, message=message, values=_pairs(values))


def _statuses(message: DiagnosticArray) -> list[dict[str, str]]:
    return [{pair.key: pair.value for pair in status.values} for status in message.status]


def event_message(event: TrainEvent) -> DiagnosticArray:
    """An event as key/value pairs; its stamp is the time the event is about."""
    speed = event.values.get("speed")
    text = f"{event.kind}, {speed}" if isinstance(speed, Estimate) else event.kind
    return DiagnosticArray(
        header=_header(event.stamp_ns, "line"),
        status=[_status(f"train: {event.kind}", text, event.to_dict())],
    )


def read_events(message: DiagnosticArray) -> list[TrainEvent]:
    """The events of a message; raises :class:`InputError` if it has others."""
    return [TrainEvent.from_dict(values) for values in _statuses(message)]


def event_messages(event: TrainEvent) -> list[tuple[Topic, object]]:
    """All that an event says, by topic."""
    messages = [
        (TRAIN_EVENTS, event_message(event)),
        (TRAIN_OCCUPIED, occupied_message(event)),
        (TRAIN_SPEED, speed_message(event)),
    ]
    return [(topic, message) for topic, message in messages if message is not None]


def speed_message(event: TrainEvent) -> TwistWithCovarianceStamped | None:
    """The velocity along x of the line that an event states, with its variance, if it does.

    A train of unknown direction gets the positive sign; the event says so.
    """
    speed = event.values.get("speed")
    if not isinstance(speed, Estimate):
        return None
    sign = -1.0 if event.values.get("direction") == "backward" else 1.0
    message = TwistWithCovarianceStamped(header=_header(event.stamp_ns, "line"))
    message.twist.twist.linear.x = sign * speed.value
    message.twist.covariance[0] = speed.sigma**2
    return message


def occupied_message(event: TrainEvent) -> Bool | None:
    """Whether a train is over the sensors, if the event changes that."""
    return {"arrival": Bool(data=True), "departure": Bool(data=False)}.get(event.kind)


def passage_message(passage: PassageTruth) -> DiagnosticArray:
    """The truth of a passage, stamped when the first wheelset enters the line."""
    text = f"{passage.train_type}, {passage.axle_count} wheelsets, {passage.direction}"
    return DiagnosticArray(
        header=_header(max(0, passage.enter_ns), "line"),
        status=[_status(f"truth: train {passage.train}", text, passage.to_dict())],
    )


def read_passages(message: DiagnosticArray) -> list[PassageTruth]:
    """The passages of a message; raises :class:`InputError` if it has others."""
    return [PassageTruth.from_dict(values) for values in _statuses(message)]


def channels_message(scenario: Scenario, groups: Mapping[str, Sequence[str]]) -> DiagnosticArray:
    """Where every sensor sits and what it is: one status per channel; ``groups`` by name."""
    group_of = {channel: group for group, names in groups.items() for channel in names}
    by_name = {channel.name: channel for channel in scenario.channel}
    statuses = []
    for sensor in scenario.sensor:
        channel = by_name[sensor.channel]
        values = {
            **channel_values(scenario, sensor.channel),
            "topic": waveform_topic(group_of[sensor.channel]).name,
            "axis": "z up",
            "unit": "m/s^2",
            "rate": f"{sensor.rate} Hz",
            "bandwidth": f"{sensor.bandwidth!r} Hz",
            "range": f"{sensor.range!r} m/s^2",
            "noise_density": f"{sensor.noise_density!r} m/s^2/sqrt(Hz)",
            "bits": str(sensor.bits),
            "coupling": sensor.coupling,
        }
        statuses.append(_status(sensor.channel, f"accelerometer on the {channel.layer}", values))
    return DiagnosticArray(header=_header(0, "line"), status=statuses)


def read_channels(message: DiagnosticArray) -> dict[str, list[Channel]]:
    """The sensors by the topic that carries them.

    Raises:
        InputError: a sensor lacks its layer, position or topic.
    """
    by_topic: dict[str, list[Channel]] = {}
    for status, values in zip(message.status, _statuses(message), strict=True):
        if "topic" not in values:
            raise InputError(f"channel description of {status.name!r}: no topic")
        by_topic.setdefault(values["topic"], []).append(read_channel(status.name, values))
    return by_topic


def channels_by_topic(
    names: Sequence[str],
    positions: Sequence[float] | None,
    layers: Sequence[str] | None,
    topic_names: Sequence[str] | None,
    position_sigma: float | None = None,
) -> dict[str, list[Channel]]:
    """The accelerometers stated by four lists of the same length, by topic.

    ``position_sigma`` is the standard uncertainty of the positions (m).

    Raises:
        InputError: the lists differ in length, or an entry is wrong.
    """
    lists = {
        "channel_names": names,
        "channel_positions": positions or (),
        "channel_layers": layers or (),
        "channel_topics": topic_names or (),
    }
    if len({len(entries) for entries in lists.values()}) > 1:
        lengths = ", ".join(f"{name}: {len(entries)}" for name, entries in lists.items())
        raise InputError(f"channel lists must have one entry per accelerometer; {lengths}")
    by_topic: dict[str, list[Channel]] = {}
    for name, x, layer, topic in zip(*lists.values(), strict=True):
        by_topic.setdefault(topic, []).append(Channel(name, x, layer, position_sigma))
    return by_topic


def scenario_message(scenario: Scenario) -> String:
    """The complete scenario as TOML."""
    return String(data=scenario.to_toml())


def clock_message(nanoseconds: int) -> Clock:
    """Simulated time."""
    return Clock(clock=to_stamp(nanoseconds))


def diagnostics_message(
    stamp_ns: int, node: str, components: Iterable[tuple[str, str | None, Mapping[str, object]]]
) -> DiagnosticArray:
    """State of a node: (component, warning or None, values) each."""
    return DiagnosticArray(
        header=_header(stamp_ns, ""),
        status=[
            _status(
                f"{node}: {component}",
                warning or "ok",
                {key: str(value) for key, value in values.items()},
                DiagnosticStatus.WARN if warning else DiagnosticStatus.OK,
            )
            for component, warning, values in components
        ],
    )


def _marker(identity: int, kind: int, scale: tuple[float, float, float], stamp_ns: int) -> Marker:
    marker = Marker(header=_header(stamp_ns, "line"), id=identity, type=kind, action=Marker.ADD)
    marker.scale.x, marker.scale.y, marker.scale.z = scale
    marker.pose.orientation.w = 1.0
    marker.color.a = 1.0
    marker.color.r = marker.color.g = marker.color.b = 0.6
    return marker


def marker_message(
    stamp_ns: int,
    scenario: Scenario,
    trains: Sequence[TrainState],
    wheelsets: Sequence[WheelsetState],
) -> MarkerArray:
    """Bridge, sensors, cars and wheelsets for a 3D view with the fixed frame ``line``."""
    markers = [Marker(action=Marker.DELETEALL, header=_header(stamp_ns, "line"))]

    def add(
        kind: int, scale: tuple[float, float, float], x: float, z: float, colour: str, name: str
    ) -> None:
        marker = _marker(len(markers), kind, scale, stamp_ns)
        marker.ns = name
        marker.pose.position.x, marker.pose.position.z = x, z
        marker.color.r, marker.color.g, marker.color.b = (
            int(colour[i : i + 2], 16) / 255 for i in (0, 2, 4)
        )
        markers.append(marker)

    length = scenario.line.length
    add(Marker.CUBE, (length, 3.0, 0.5), length / 2, -0.25, "9a9a94", "track")
    for left, right in scenario.line.span_bounds:
        add(Marker.CUBE, (right - left, 5.0, 2.5), (left + right) / 2, -1.75, "6f7f8f", "bridge")
    for channel in scenario.channel:
        x = scenario.channel_x(channel)
        add(Marker.SPHERE, (0.4, 0.4, 0.4), x, 0.1, "d9482b", channel.name)
    for train in trains:
        sign = 1.0 if train.train.direction == "forward" else -1.0
        for first, last in _cars(train):
            centre = train.position - sign * (first + last) / 2
            add(Marker.CUBE, (last - first - 0.4, 2.9, 3.0), centre, 2.5, "f2f2ef", "car")
    for wheelset in wheelsets:
        add(Marker.SPHERE, (0.9, 1.6, 0.9), wheelset.position, 0.45, "33373b", "wheelset")
    return MarkerArray(markers=markers)


def _cars(train: TrainState) -> list[tuple[float, float]]:
    """Front and rear of every vehicle, measured backwards from the first wheelset (m)."""
    vehicles = train.train.vehicles
    first = vehicles[0]
    overhang = first.length / 2
    if first.kind == "car":
        front = first.front_overhang
        overhang = (first.length - first.bogie_centres) / 2 if front is None else front
        overhang -= first.wheelbase / 2
    ends = np.cumsum([-overhang, *(vehicle.length for vehicle in vehicles)]).tolist()
    return list(pairwise(ends))
