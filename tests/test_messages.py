"""On the wire and back: layout, stamps, frames, signs, QoS."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rclpy")
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.qos import DurabilityPolicy, HistoryPolicy, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.validate_full_topic_name import validate_full_topic_name
from sensor_msgs.msg import PointCloud2

from solver import InputError, TrainMotion, load_scenario, train_preset
from trackvib_ros import messages as m
from trackvib_ros.channels import EXACT
from trackvib_ros.detection import Channel, Estimate, TrainEvent
from trackvib_ros.station import TrainState, WheelsetState
from trackvib_ros.truth import PassageTruth
from trackvib_ros.waveform import Waveform

pytestmark = pytest.mark.ros


def wire(message: object) -> object:
    """Through CDR, as every subscriber gets it."""
    return deserialize_message(serialize_message(message), type(message))


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**31 * 10**9 - 1))
def test_stamps_are_whole_nanoseconds_both_ways(nanoseconds: int) -> None:
    stamp = m.to_stamp(nanoseconds)
    assert m.from_stamp(stamp) == nanoseconds and 0 <= stamp.nanosec < 10**9


def test_a_block_is_a_table_that_numpy_and_others_read() -> None:
    data = np.array([[1.5, -2.0], [np.nan, 3.0], [4.0, 5.0]], np.float32)
    block = Waveform(12_345_678_901, 50_000, ("rail_a", "rail_b"), data, "rail")
    message = wire(m.waveform_message(block))
    assert isinstance(message, PointCloud2)
    assert [field.name for field in message.fields] == ["t", "rail_a", "rail_b"]
    assert (message.width, message.height, message.point_step) == (3, 1, 12)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (12, 345_678_901)
    # what README tells users to write
    table = np.frombuffer(message.data, dtype=[(f.name, "<f4") for f in message.fields])
    np.testing.assert_array_equal(table["rail_b"], data[:, 1])
    np.testing.assert_allclose(table["t"], [0, 5e-5, 1e-4], rtol=1e-6)
    back = m.read_waveform(message)
    assert (back.stamp_ns, back.dt_ns, back.channels, back.frame_id) == (
        block.stamp_ns,
        block.dt_ns,
        block.channels,
        "rail",
    )
    np.testing.assert_array_equal(back.data, data)


def test_wrong_tables_are_refused() -> None:
    good = m.waveform_message(Waveform(0, 1000, ("a",), np.zeros((2, 1), np.float32)))
    good.width = 3
    with pytest.raises(InputError, match="width x height x point_step"):
        m.read_waveform(good)
    good.width, good.is_bigendian = 2, True
    with pytest.raises(InputError, match="big-endian"):
        m.read_waveform(good)


def test_low_rate_acceleration_is_the_peak_at_its_own_time() -> None:
    data = np.array([[1.0, np.nan], [-7.0, np.nan], [3.0, np.nan]], np.float32)
    block = Waveform(1_000_000_000, 500_000, ("a", "silent"), data, "rail")
    ((channel, message),) = m.acceleration_messages(block)
    assert channel == message.header.frame_id == "a"
    assert message.accel.linear.z == -7.0
    assert m.from_stamp(message.header.stamp) == 1_000_500_000


def test_wheel_force_points_up_and_names_its_wheelset() -> None:
    message = m.wheel_force_message(5, WheelsetState(2, 7, 31.0, 1.4e5))
    assert message.wrench.force.z == 1.4e5  # the rails push a wheelset up
    assert message.header.frame_id == "train_2_wheelset_7"
    points = m.wheelsets_message(5, [WheelsetState(2, 7, 31.0, 1.4e5)])
    table = np.frombuffer(points.data, dtype=[(f.name, "<f4") for f in points.fields])
    assert table["x"][0] == 31.0 and table["force"][0] == np.float32(1.4e5)
    assert table["train"][0] == 2 and table["wheelset"][0] == 7


def test_events_survive_the_wire() -> None:
    event = TrainEvent(
        "passage", 1_812_000_000, 1e-4, 0.9, "axle pattern", ("rail_a", "rail_b"),
        {"speed": Estimate(83.3, 0.1, "m/s"), "direction": "backward", "axle_count": 32},
        ("clipped",),
    )  # fmt: skip
    message = wire(m.event_message(event))
    assert m.from_stamp(message.header.stamp) == event.stamp_ns  # type: ignore[attr-defined]
    assert m.read_events(message) == [event]  # type: ignore[arg-type]
    speed = m.speed_message(event)
    assert speed is not None
    assert speed.twist.twist.linear.x == -83.3  # backward is towards decreasing x
    assert speed.twist.covariance[0] == pytest.approx(0.01)


@pytest.mark.parametrize(("kind", "occupied"), [("arrival", True), ("departure", False)])
def test_occupation_follows_arrival_and_departure(kind: str, occupied: bool) -> None:
    event = TrainEvent(kind, 1, 0.1, 0.5, "energy", ("a",))  # type: ignore[arg-type]
    message = m.occupied_message(event)
    assert message is not None and message.data is occupied
    assert m.speed_message(event) is None


def test_channel_description_says_where_every_sensor_is() -> None:
    scenario = load_scenario("demo")
    groups = {"rail": ("rail_a", "rail_b"), "slab": ("slab_mid",), "bridge": ("bridge_mid",)}
    message = wire(m.channels_message(scenario, groups))
    assert m.read_channels(message) == {  # type: ignore[arg-type]
        "rail/waveform": [
            Channel("rail_a", 26.0, "rail", EXACT),
            Channel("rail_b", 46.0, "rail", EXACT),
        ],
        "slab/waveform": [Channel("slab_mid", 36.0, "slab", EXACT)],
        "bridge/waveform": [Channel("bridge_mid", 36.0, "bridge", EXACT)],
    }
    message.status[0].values.pop(0)  # type: ignore[attr-defined]
    with pytest.raises(InputError, match="rail_a"):
        m.read_channels(message)  # type: ignore[arg-type]


def test_scenario_and_truth_survive_the_wire() -> None:
    scenario = load_scenario("demo")
    from solver import load_scenario_text

    assert load_scenario_text(wire(m.scenario_message(scenario)).data) == scenario  # type: ignore[attr-defined]
    passage = PassageTruth.of(TrainMotion(scenario.train[0]), 1, scenario)
    message = wire(m.passage_message(passage))
    assert m.read_passages(message) == [passage]  # type: ignore[arg-type]
    # 300 km/h from x = -125 m to rail_a at 26 m: 151 m
    assert passage.axle_times_ns["rail_a"][0] == round(151 / (300 / 3.6) * 1e9)
    assert passage.enter_ns == 1_500_000_000
    assert passage.axle_count == 32


def test_train_faces_its_direction_in_the_markers() -> None:
    scenario = load_scenario("demo")
    forward = train_preset("CRH3", 80.0, 0.0)
    backward = forward.model_copy(update={"direction": "backward"})
    for train, sign in ((forward, 1.0), (backward, -1.0)):
        state = TrainState(1, 40.0, sign * 80.0, train)
        markers = m.marker_message(7, scenario, [state], []).markers
        cars = [marker.pose.position.x for marker in markers if marker.ns == "car"]
        assert len(cars) == 8
        assert all(sign * (b - a) == pytest.approx(-24.775) for a, b in zip(cars, cars[1:]))  # noqa: B905, RUF007
        # the first wheelset is (24.775 - 17.375 - 2.5)/2 = 2.45 m behind the nose
        assert sign * (cars[0] - 40.0) == pytest.approx(2.45 - 24.775 / 2)
        assert m.train_message(7, state).twist.twist.linear.x == sign * 80.0


TOPICS = [
    *(value for value in vars(m).values() if isinstance(value, m.Topic)),
    m.waveform_topic("rail"),
    m.acceleration_topic("rail_a"),
    m.wheel_force_topic(12),
]


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.name)
def test_topic_names_are_legal_and_qos_keeps_the_promise(topic: m.Topic) -> None:
    assert validate_full_topic_name("/" + topic.name.lstrip("/"))
    package = topic.type.__module__.split(".")[0]
    assert package in {
        "diagnostic_msgs", "geometry_msgs", "nav_msgs", "rosgraph_msgs", "sensor_msgs", "std_msgs",
        "visualization_msgs",
    }  # fmt: skip
    if topic.name.endswith("waveform") or topic.name.startswith("ground_truth/a"):
        assert topic.qos.history == HistoryPolicy.KEEP_ALL
        assert topic.qos.reliability == ReliabilityPolicy.RELIABLE
    if topic.name in ("scenario", "channels", "train/occupied"):
        assert topic.qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
        assert topic.qos.depth == 1
    if topic.name == "/clock":
        assert topic.qos.reliability == ReliabilityPolicy.BEST_EFFORT
        assert topic.qos.depth == 1
