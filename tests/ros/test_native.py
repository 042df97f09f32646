"""The interfaces that ``ros2 node|topic|service|param|lifecycle`` call, called the same way."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

pytest.importorskip("rclpy")
from lifecycle_msgs.msg import TransitionEvent
from lifecycle_msgs.srv import ChangeState, GetAvailableStates, GetAvailableTransitions, GetState
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterType, ParameterValue
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetParametersAtomically,
)
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from type_description_interfaces.srv import GetTypeDescription

from tests.ros.harness import QUICK, Graph, NeverStop, graph_of_test, own_domain
from trackvib_ros.detector_node import DetectorNode
from trackvib_ros.sensor_node import SensorNode
from trackvib_ros.settings import DETECTOR_SETTINGS, SENSOR_SETTINGS

pytestmark = pytest.mark.ros

RCLCPP_LIFECYCLE_SERVICES = {
    "change_state": "lifecycle_msgs/srv/ChangeState",
    "get_available_states": "lifecycle_msgs/srv/GetAvailableStates",
    "get_available_transitions": "lifecycle_msgs/srv/GetAvailableTransitions",
    "get_state": "lifecycle_msgs/srv/GetState",
    "get_transition_graph": "lifecycle_msgs/srv/GetAvailableTransitions",
    "describe_parameters": "rcl_interfaces/srv/DescribeParameters",
    "get_parameter_types": "rcl_interfaces/srv/GetParameterTypes",
    "get_parameters": "rcl_interfaces/srv/GetParameters",
    "list_parameters": "rcl_interfaces/srv/ListParameters",
    "set_parameters": "rcl_interfaces/srv/SetParameters",
    "set_parameters_atomically": "rcl_interfaces/srv/SetParametersAtomically",
    "get_type_description": "type_description_interfaces/srv/GetTypeDescription",
}
"""Services of an rclcpp_lifecycle::LifecycleNode of ROS 2 Jazzy."""

COMMANDS = ("pause", "reset", "resume", "step", "trigger_passage")


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> Iterator[Graph]:
    own_domain(monkeypatch, offset=4)
    for graph in graph_of_test():
        overrides = [Parameter("scenario", value=str(QUICK))]
        graph.add(SensorNode(NeverStop(), namespace="/north", parameter_overrides=overrides))
        graph.add(DetectorNode(NeverStop(), namespace="/north"))
        yield graph


def transitions(graph: Graph, node: str, service: str = "get_available_transitions") -> Any:
    request = GetAvailableTransitions.Request()
    name = f"/north/{node}/{service}"
    return graph.call(GetAvailableTransitions, name, request).available_transitions


def change(graph: Graph, node: str, label: str) -> bool:
    """As ``ros2 lifecycle set``: the label is looked up among the available transitions."""
    ids = {entry.transition.label: entry.transition for entry in transitions(graph, node)}
    request = ChangeState.Request(transition=ids[label])
    return bool(graph.call(ChangeState, f"/north/{node}/change_state", request).success)


def state(graph: Graph, node: str) -> str:
    answer = graph.call(GetState, f"/north/{node}/get_state", GetState.Request())
    return str(answer.current_state.label)


def test_node_info_and_service_list(graph: Graph) -> None:
    tester = graph.tester
    for node in ("sensor", "detector"):
        assert ("/north", node) in [(s, n) for n, s in tester.get_node_names_and_namespaces()]
        services = dict(tester.get_service_names_and_types_by_node(node, "/north"))
        wanted = {
            f"/north/{node}/{name}": [kind] for name, kind in RCLCPP_LIFECYCLE_SERVICES.items()
        }
        if node == "sensor":
            wanted |= {f"/north/{node}/{name}": ["std_srvs/srv/Trigger"] for name in COMMANDS}
        assert services == wanted
        topics = dict(tester.get_publisher_names_and_types_by_node(node, "/north"))
        assert topics[f"/north/{node}/transition_event"] == ["lifecycle_msgs/msg/TransitionEvent"]
        assert topics["/diagnostics"] == ["diagnostic_msgs/msg/DiagnosticArray"]
        assert {"/parameter_events", "/rosout"} <= set(topics)


def test_param_list_describe_get_and_set(graph: Graph) -> None:
    for node, settings in (("sensor", SENSOR_SETTINGS), ("detector", DETECTOR_SETTINGS)):
        prefix = f"/north/{node}"
        listed = graph.call(ListParameters, f"{prefix}/list_parameters", ListParameters.Request())
        names = list(listed.result.names)
        assert {setting.name for setting in settings} <= set(names)
        request = DescribeParameters.Request(names=names)
        told = graph.call(DescribeParameters, f"{prefix}/describe_parameters", request).descriptors
        assert [descriptor.name for descriptor in told] == names
        types = graph.call(
            GetParameterTypes,
            f"{prefix}/get_parameter_types",
            GetParameterTypes.Request(names=names),
        ).types
        values = graph.call(
            GetParameters, f"{prefix}/get_parameters", GetParameters.Request(names=names)
        ).values
        by_name = dict(zip(names, zip(told, types, values, strict=True), strict=True))
        for setting in settings:
            descriptor, kind, value = by_name[setting.name]
            assert descriptor.description
            assert kind == value.type
            if kind == ParameterType.PARAMETER_DOUBLE:
                (limits,) = descriptor.floating_point_range
                assert (limits.from_value, limits.to_value) == (setting.low, setting.high)
            elif kind == ParameterType.PARAMETER_INTEGER:
                (limits,) = descriptor.integer_range
                assert (limits.from_value, limits.to_value) == (setting.low, setting.high)
            else:
                assert not descriptor.floating_point_range and not descriptor.integer_range
        with_unit = [d for d, kind, _ in by_name.values() if kind == ParameterType.PARAMETER_DOUBLE]
        assert all("[" in descriptor.description for descriptor in with_unit)
    double, integer = ParameterType.PARAMETER_DOUBLE, ParameterType.PARAMETER_INTEGER

    def atomically(factor: float, seed: int) -> Any:
        parameters = [
            ParameterMessage(
                name="real_time_factor", value=ParameterValue(type=double, double_value=factor)
            ),
            ParameterMessage(name="seed", value=ParameterValue(type=integer, integer_value=seed)),
        ]
        request = SetParametersAtomically.Request(parameters=parameters)
        return graph.call(
            SetParametersAtomically, "/north/sensor/set_parameters_atomically", request
        ).result

    def now() -> tuple[float, int]:
        request = GetParameters.Request(names=["real_time_factor", "seed"])
        factor, seed = graph.call(GetParameters, "/north/sensor/get_parameters", request).values
        return factor.double_value, seed.integer_value

    before = now()
    refused = atomically(2.0, -2)
    assert not refused.successful and "seed" in refused.reason
    assert now() == before
    assert atomically(2.0, 7).successful
    assert now() == (2.0, 7)


def test_lifecycle_get_list_set_and_events(graph: Graph) -> None:
    for node in ("detector", "sensor"):
        heard: list[TransitionEvent] = []
        graph.tester.create_subscription(
            TransitionEvent, f"/north/{node}/transition_event", heard.append, 10
        )
        graph.until(
            lambda node=node: graph.tester.count_publishers(f"/north/{node}/transition_event"),
            "transition events",
        )
        states = graph.call(
            GetAvailableStates,
            f"/north/{node}/get_available_states",
            GetAvailableStates.Request(),
        ).available_states
        primary = {"unconfigured", "inactive", "active", "finalized"}
        assert primary <= {entry.label for entry in states}
        assert len(transitions(graph, node, "get_transition_graph")) == 25
        expected = []
        for label, passing, goal, available in (
            ("configure", "configuring", "inactive", {"cleanup", "activate", "shutdown"}),
            ("activate", "activating", "active", {"deactivate", "shutdown"}),
            ("deactivate", "deactivating", "inactive", {"cleanup", "activate", "shutdown"}),
            ("cleanup", "cleaningup", "unconfigured", {"configure", "shutdown"}),
            ("shutdown", "shuttingdown", "finalized", set()),
        ):
            start = state(graph, node)
            assert change(graph, node, label)
            assert state(graph, node) == goal
            assert {e.transition.label for e in transitions(graph, node)} == available
            expected += [(start, passing), (passing, goal)]
        graph.until(lambda n=len(expected), h=heard: len(h) >= n, "all transition events")
        assert [(e.start_state.label, e.goal_state.label) for e in heard] == expected


def test_a_transition_that_is_not_there_is_refused(graph: Graph) -> None:
    for node in ("sensor", "detector"):
        for number in (3, 4, 99):  # activate, deactivate, no such
            request = ChangeState.Request()
            request.transition.id = number
            assert not graph.call(ChangeState, f"/north/{node}/change_state", request).success
            assert state(graph, node) == "unconfigured"


def test_topic_info_and_type_description(graph: Graph) -> None:
    assert change(graph, "sensor", "configure")
    tester = graph.tester

    def only(topic: str) -> Any:
        graph.until(lambda: tester.count_publishers(topic), topic)
        (info,) = tester.get_publishers_info_by_topic(topic)
        return info

    waves = only("/north/rail/waveform")
    assert (waves.node_name, waves.node_namespace) == ("sensor", "/north")
    assert waves.topic_type == "sensor_msgs/msg/PointCloud2"
    assert waves.qos_profile.reliability == ReliabilityPolicy.RELIABLE
    assert waves.qos_profile.durability == DurabilityPolicy.VOLATILE
    latched = only("/north/scenario").qos_profile
    assert latched.reliability == ReliabilityPolicy.RELIABLE
    assert latched.durability == DurabilityPolicy.TRANSIENT_LOCAL
    assert only("/clock").qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT

    request = GetTypeDescription.Request(
        type_name=waves.topic_type, type_hash=str(waves.topic_type_hash)
    )
    answer = graph.call(GetTypeDescription, "/north/sensor/get_type_description", request)
    assert answer.successful, answer.failure_reason
    fields = [field.name for field in answer.type_description.type_description.fields]
    assert fields[:3] == ["header", "height", "width"] and "data" in fields
