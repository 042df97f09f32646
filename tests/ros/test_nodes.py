"""Lifecycle, parameters, services and hostile input of the nodes, over real DDS in one process."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy")
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterType, ParameterValue
from rcl_interfaces.srv import DescribeParameters, SetParameters
from rclpy.callback_groups import CallbackGroup
from rclpy.parameter import Parameter
from sensor_msgs.msg import PointCloud2

from tests.ros.harness import QUICK, Graph, NeverStop, graph_of_test, own_domain
from trackvib_ros import messages as m
from trackvib_ros.detector_node import DetectorNode
from trackvib_ros.sensor_node import SensorNode
from trackvib_ros.settings import SENSOR_SETTINGS
from trackvib_ros.waveform import Waveform

pytestmark = pytest.mark.ros


class Untouched(CallbackGroup):  # type: ignore[misc]
    """Subscriptions that the executor leaves alone."""

    def can_execute(self, entity: object) -> bool:
        return False

    def beginning_execution(self, entity: object) -> bool:
        return False

    def ending_execution(self, entity: object) -> None:
        pass


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> Iterator[Graph]:
    own_domain(monkeypatch, offset=1)
    yield from graph_of_test()


def sensor_of(graph: Graph, **settings: object) -> SensorNode:
    overrides = [
        Parameter(name, value=setting)
        for name, setting in {"scenario": str(QUICK), "real_time_factor": 0.0, **settings}.items()
    ]
    return graph.add(SensorNode(NeverStop(), parameter_overrides=overrides))


def detector_of(graph: Graph, **settings: object) -> DetectorNode:
    overrides = [Parameter(name, value=setting) for name, setting in settings.items()]
    return graph.add(DetectorNode(NeverStop(), parameter_overrides=overrides))


def change(graph: Graph, node: str, transition: int) -> bool:
    request = ChangeState.Request(transition=Transition(id=transition))
    return bool(graph.call(ChangeState, f"{node}/change_state", request).success)


def state(graph: Graph, node: str) -> str:
    return str(graph.call(GetState, f"{node}/get_state", GetState.Request()).current_state.label)


def set_parameter(graph: Graph, node: str, name: str, **value: Any) -> Any:
    parameter = ParameterMessage(name=name, value=ParameterValue(**value))
    request = SetParameters.Request(parameters=[parameter])
    return graph.call(SetParameters, f"{node}/set_parameters", request).results[0]


def figures(heard: list[Any], component: str) -> dict[str, str]:
    for message in reversed(heard):
        for status in message.status:
            if status.name == component:
                return {pair.key: pair.value for pair in status.values}
    return {}


def warning(heard: list[Any], component: str) -> str:
    for message in reversed(heard):
        for status in message.status:
            if status.name == component:
                return status.message if status.level != b"\x00" else ""
    return ""


def test_sensor_lifecycle_services_and_clock(graph: Graph) -> None:
    sensor_of(graph)
    clock = graph.listen(m.CLOCK)
    rail = graph.listen(m.waveform_topic("rail"))
    scenario = graph.listen(m.SCENARIO)

    assert state(graph, "sensor") == "unconfigured"
    assert not graph.trigger("sensor/pause").success
    assert change(graph, "sensor", Transition.TRANSITION_CONFIGURE)
    graph.until(lambda: scenario, "latched scenario")
    assert 'name = "quick"' in scenario[0].data
    assert rail == [] and clock == []  # configured, not running

    assert change(graph, "sensor", Transition.TRANSITION_ACTIVATE)
    graph.until(lambda: len(rail) >= 10, "waveforms")
    assert graph.trigger("sensor/pause").success
    graph.once()
    paused = m.from_stamp(clock[-1].clock)
    count = len(clock)
    graph.until(lambda: len(clock) > count + 1, "clock repeated while paused")
    assert m.from_stamp(clock[-1].clock) == paused
    times = [m.from_stamp(message.clock) for message in clock]
    assert times[0] > 0 and times == sorted(times)

    answer = set_parameter(
        graph, "sensor", "step_duration", type=ParameterType.PARAMETER_DOUBLE, double_value=0.1
    )
    assert answer.successful
    assert graph.trigger("sensor/step").success
    graph.until(lambda: m.from_stamp(clock[-1].clock) >= paused + 100_000_000, "the step")
    count = len(clock)
    graph.until(lambda: len(clock) > count + 1, "clock repeated after the step")
    assert m.from_stamp(clock[-1].clock) == paused + 100_000_000

    assert change(graph, "sensor", Transition.TRANSITION_DEACTIVATE)
    assert graph.trigger("sensor/resume").success is False
    assert change(graph, "sensor", Transition.TRANSITION_ACTIVATE)
    assert graph.trigger("sensor/resume").success
    count = len(rail)
    graph.until(lambda: len(rail) > count + 10, "more waveforms")
    stamps = [m.from_stamp(message.header.stamp) for message in rail]
    assert stamps == [20_000_000 * k for k in range(len(stamps))]  # nothing lost by all this

    assert change(graph, "sensor", Transition.TRANSITION_DEACTIVATE)
    assert change(graph, "sensor", Transition.TRANSITION_CLEANUP)
    assert state(graph, "sensor") == "unconfigured"
    assert change(graph, "sensor", Transition.TRANSITION_CONFIGURE)
    assert change(graph, "sensor", Transition.TRANSITION_CLEANUP)


def test_reset_restarts_with_another_seed_and_trigger_sends_a_train(graph: Graph) -> None:
    node = sensor_of(graph)
    rail = graph.listen(m.waveform_topic("rail"))
    clock = graph.listen(m.CLOCK)
    passages = graph.listen(m.TRUE_PASSAGES)
    scenario = graph.listen(m.SCENARIO)
    node.trigger_configure()
    node.trigger_activate()
    graph.until(lambda: len(rail) >= 100, "the passage")
    first = [m.read_waveform(message).data for message in rail[:100]]

    answer = graph.trigger("sensor/reset")
    assert answer.success and "seed 2" in answer.message
    graph.until(lambda: len(scenario) == 2, "new scenario")
    assert "seed = 2" in scenario[1].data
    back = len(rail)
    graph.until(lambda: len(rail) >= back + 150, "second run")
    starts = [i for i, message in enumerate(rail) if m.from_stamp(message.header.stamp) == 0]
    assert len(starts) == 2
    second = [m.read_waveform(message).data for message in rail[starts[1] : starts[1] + 100]]
    assert not np.array_equal(np.concatenate(first), np.concatenate(second))
    times = [m.from_stamp(message.clock) for message in clock]
    assert sum(b < a for a, b in pairwise(times)) == 1  # one jump back

    set_parameter(graph, "sensor", "seed", type=ParameterType.PARAMETER_INTEGER, integer_value=1)
    assert graph.trigger("sensor/reset").success
    graph.until(
        lambda: sum(m.from_stamp(x.header.stamp) == 0 for x in rail) == 3 and len(rail) > 400,
        "third run",
    )
    start = [i for i, message in enumerate(rail) if m.from_stamp(message.header.stamp) == 0][2]
    graph.until(lambda: len(rail) >= start + 100, "third passage")
    third = [m.read_waveform(message).data for message in rail[start : start + 100]]
    np.testing.assert_array_equal(np.concatenate(first), np.concatenate(third))  # same seed

    sent_ns = node.run.time_ns
    answer = graph.trigger("sensor/trigger_passage")
    assert answer.success and "train 2" in answer.message

    def of_second() -> list[Any]:
        return [p for message in passages for p in m.read_passages(message) if p.train == 2]

    graph.until(of_second, "truth of the train that was sent")
    assert of_second()[0].enter_ns > sent_ns
    assert of_second()[0].axle_count == 24


def test_parameters_tell_unit_and_range_and_refuse_with_a_reason(graph: Graph) -> None:
    node = sensor_of(graph)
    names = [setting.name for setting in SENSOR_SETTINGS]
    request = DescribeParameters.Request(names=names)
    described = graph.call(DescribeParameters, "sensor/describe_parameters", request).descriptors
    assert all(descriptor.description for descriptor in described)
    by_name = dict(zip(names, described, strict=True))
    assert by_name["autostart"].read_only
    assert by_name["real_time_factor"].floating_point_range[0].to_value == 1000.0
    assert "[s]" in by_name["step_duration"].description

    double = ParameterType.PARAMETER_DOUBLE
    refused = set_parameter(graph, "sensor", "real_time_factor", type=double, double_value=-1.0)
    assert not refused.successful and refused.reason
    text = ParameterType.PARAMETER_STRING
    refused = set_parameter(graph, "sensor", "real_time_factor", type=text, string_value="fast")
    assert not refused.successful and refused.reason
    boolean = ParameterType.PARAMETER_BOOL
    refused = set_parameter(graph, "sensor", "autostart", type=boolean, bool_value=True)
    assert not refused.successful and refused.reason

    accepted = set_parameter(graph, "sensor", "scenario", type=text, string_value="no such thing")
    assert accepted.successful
    assert not change(graph, "sensor", Transition.TRANSITION_CONFIGURE)
    assert "no such thing" in str(node.failure) and "presets" in str(node.failure)
    assert state(graph, "sensor") == "unconfigured"
    set_parameter(graph, "sensor", "scenario", type=text, string_value=str(QUICK))
    assert change(graph, "sensor", Transition.TRANSITION_CONFIGURE)
    refused = set_parameter(graph, "sensor", "scenario", type=text, string_value="demo")
    assert not refused.successful
    assert "unconfigured" in refused.reason and "inactive" in refused.reason


def test_detector_survives_counts_and_reports_hostile_messages(graph: Graph) -> None:
    node = detector_of(
        graph,
        channel_names=["north"],
        channel_positions=[3.0],
        channel_layers=["rail"],
        channel_topics=["gauge/waveform"],
    )
    node.trigger_configure()
    node.trigger_activate()
    topic = m.waveform_topic("gauge")
    publisher = graph.tester.create_publisher(topic.type, topic.name, topic.qos)
    heard = graph.listen(m.DIAGNOSTICS)
    graph.until(lambda: publisher.get_subscription_count() == 1, "subscription")

    def block(k: int, data: Any = None, names: tuple[str, ...] = ("north",)) -> PointCloud2:
        quiet = np.full((40, len(names)), 0.01, np.float32) if data is None else data
        return m.waveform_message(Waveform(k * 20_000_000, 500_000, names, quiet, "gauge"))

    hostile: list[PointCloud2] = [block(100)]
    wrong_size = block(101)
    wrong_size.data = array("B", bytes(7))
    no_rows = block(101)
    no_rows.width, no_rows.row_step, no_rows.data = 0, 0, array("B")
    no_step = block(101)
    no_step.point_step = 0
    big = block(101)
    big.data = array("B", bytes(m.MAX_BLOCK_BYTES + 8))
    endian = block(101)
    endian.is_bigendian = True
    frame = block(101)
    frame.header.frame_id = "elsewhere"
    no_fields = block(101)
    no_fields.fields = []
    offset = block(101)
    offset.fields[1].offset = 2**32 - 1
    time = block(101)
    table = np.frombuffer(bytes(time.data), "<f4").copy().reshape(-1, 2)
    table[:, 0] = np.nan
    time.data = array("B", table.tobytes())
    other = block(101, names=("stranger",))
    back = block(50)
    far = block(101)
    far.header.stamp.sec = -(2**31)
    future = block(101)
    future.header.stamp.sec = 2**31 - 1
    bad = [wrong_size, no_rows, no_step, big, endian, frame, no_fields, offset, time, other]
    bad += [back, far, future]
    hostile += bad
    poisoned = np.full((40, 1), 0.01, np.float32)
    poisoned[:5, 0] = [np.nan, np.inf, -np.inf, 3e38, -1e30]
    hostile += [block(101, poisoned), block(102)]
    for message in hostile:
        publisher.publish(message)
    graph.until(
        lambda: figures(heard, "detector: input").get("blocks gauge/waveform") == "3", "3 blocks"
    )
    told = figures(heard, "detector: input")
    assert told["refused"] == str(len(bad))
    assert "blocks refused" in warning(heard, "detector: input")
    publisher.publish(block(110))
    graph.until(
        lambda: figures(heard, "detector: input").get("gaps gauge/waveform") == "1", "the gap"
    )
    assert "0.140 s missing" in warning(heard, "detector: input")  # 7 blocks of 20 ms
    for k in range(4):  # the source has started anew
        publisher.publish(block(k))
    graph.until(lambda: figures(heard, "detector: input").get("restarts") == "1", "the restart")
    assert figures(heard, "detector: input")["blocks gauge/waveform"] == "8"
    assert state(graph, "detector") == "active"


def test_a_reader_that_takes_nothing_holds_the_run_back_and_loses_nothing(graph: Graph) -> None:
    node = sensor_of(graph, ground_truth=False, await_detectors=1, headway_mean=60.0)
    topic = m.waveform_topic("rail")
    taken: list[int] = []
    slow = graph.tester.create_subscription(
        topic.type, topic.name, taken.append, topic.qos, callback_group=Untouched()
    )
    graph.listen(m.waveform_topic("bridge"))
    node.trigger_configure()
    node.trigger_activate()
    graph.until(lambda: node.run.state == "blocked", "a full middleware")
    (_, _, told) = node.run.components()[-1]
    assert told["published rail/waveform"] == 400  # 200 on either side: config/dds_profile.xml

    def take() -> int:
        with slow.handle:
            while found := slow.handle.take_message(slow.msg_type, False):
                taken.append(m.from_stamp(found[0].header.stamp))
        return len(taken)

    graph.until(lambda: take() >= 500, "further blocks")
    assert taken == [20_000_000 * k for k in range(len(taken))]


def test_detector_refuses_lists_that_do_not_fit(graph: Graph) -> None:
    node = detector_of(graph, channel_names=["a", "b"], channel_positions=[1.0])
    assert not change(graph, "detector", Transition.TRANSITION_CONFIGURE)
    assert "channel_positions: 1" in str(node.failure)


def test_detector_refuses_a_calibration_file_that_is_none(graph: Graph, tmp_path: Path) -> None:
    file = tmp_path / "site.json"
    file.write_text("my notes")
    node = detector_of(
        graph,
        channel_names=["a"],
        channel_positions=[1.0],
        channel_layers=["rail"],
        channel_topics=["a/waveform"],
        calibration_file=str(file),
    )
    assert change(graph, "detector", Transition.TRANSITION_CONFIGURE)
    assert not change(graph, "detector", Transition.TRANSITION_ACTIVATE)
    assert "site.json is not used or overwritten" in str(node.failure)
    assert file.read_text() == "my notes"
