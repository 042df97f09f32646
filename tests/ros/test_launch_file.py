"""``passage.launch.py`` against the package: what it names exists; what it starts comes up.

There is no package of ``launch`` for Python alone, so the file is read, not run; what launch_ros
would start is started here with the same executables, remappings and parameters, and brought to
state active by the same transitions.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

pytest.importorskip("rclpy")
from lifecycle_msgs.msg import Transition, TransitionEvent
from lifecycle_msgs.srv import ChangeState

from tests.ros.harness import QUICK, Graph, Processes, graph_of_test, own_domain, processes_of_test
from tests.ros.test_nodes import figures
from trackvib_ros import messages as m
from trackvib_ros.settings import DETECTOR_SETTINGS, SENSOR_SETTINGS

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

pytestmark = pytest.mark.ros
processes = pytest.fixture(processes_of_test)
ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "trackvib_ros"
TREE = ast.parse((PACKAGE / "launch" / "passage.launch.py").read_text(encoding="utf-8"))
SETTINGS = {"sensor": SENSOR_SETTINGS, "detector": DETECTOR_SETTINGS}
KINDS = {"str": str, "float": float, "int": int, "bool": bool}


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> Iterator[Graph]:
    own_domain(monkeypatch, offset=5)
    yield from graph_of_test()


def calls(name: str) -> list[ast.Call]:
    found = [node for node in ast.walk(TREE) if isinstance(node, ast.Call)]
    return [node for node in found if getattr(node.func, "id", None) == name]


def keywords(call: ast.Call) -> dict[str, Any]:
    return {entry.arg: entry.value for entry in call.keywords if entry.arg}


def text(node: ast.expr) -> str:
    """A string, or an f-string with its fields in braces."""
    if isinstance(node, ast.JoinedStr):
        parts = [
            p.value if isinstance(p, ast.Constant) else f"{{{ast.unparse(p.value)}}}"
            for p in node.values
        ]  # type: ignore[attr-defined]
        return "".join(parts)
    return str(ast.literal_eval(node))


def managed() -> dict[str, dict[str, str]]:
    """Nodes of the launch file, with the type of every parameter that is passed on."""
    nodes = {}
    for call in calls("_managed"):
        name, parameters = call.args
        (passed,) = (e for e in parameters.elts if isinstance(e, ast.Dict))  # type: ignore[attr-defined]
        nodes[text(name)] = {
            text(key): text_of_type(value)  # type: ignore[arg-type]
            for key, value in zip(passed.keys, passed.values, strict=True)
        }
    return nodes


def text_of_type(call: ast.Call) -> str:
    argument, kind = call.args
    assert text(argument) in {text(declared.args[0]) for declared in calls("DeclareLaunchArgument")}
    return ast.unparse(kind)


def test_executables_configuration_and_package_are_installed() -> None:
    (node,) = calls("LifecycleNode")
    package, executable = (text(keywords(node)[name]) for name in ("package", "executable"))
    files = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["data-files"]
    installed = {folder: {Path(file).name for file in names} for folder, names in files.items()}
    assert package in installed["share/ament_index/resource_index/packages"]
    assert set(managed()) == set(SETTINGS)
    for name in managed():
        assert executable.format(name=name) in installed[f"lib/{package}"]
    shares = [
        [part.value for part in (node.left.right, node.right)]
        for node in ast.walk(TREE)
        if isinstance(node, ast.BinOp)
        and isinstance(node.left, ast.BinOp)
        and ast.unparse(node.left.left) == "share"
    ]
    assert len(shares) == 2
    for folder, file in shares:
        assert file in installed[f"share/{package}/{folder}"]
    assert "package.xml" in installed[f"share/{package}"]
    declared = (ROOT / "package.xml").read_text()
    for statement in ast.walk(TREE):
        if isinstance(statement, ast.ImportFrom):
            origin = str(statement.module).partition(".")[0]
            known = (
                origin in sys.stdlib_module_names
                or f"<exec_depend>{origin}</exec_depend>" in declared
            )
            assert known or origin == "ament_index_python", f"{origin}: not in package.xml"


def test_arguments_are_described_and_fit_the_parameters_of_the_nodes() -> None:
    arguments = {text(call.args[0]): keywords(call) for call in calls("DeclareLaunchArgument")}
    assert all(text(entry["description"]) for entry in arguments.values())
    used = {
        text(call.args[0])
        for call in calls("LaunchConfiguration")
        if not isinstance(call.args[0], ast.Name)
    }
    assert used | {p for node in managed().values() for p in node} == set(arguments)
    for node, parameters in managed().items():
        settings = {setting.name: setting for setting in SETTINGS[node]}
        for name, kind in parameters.items():
            default = KINDS[kind](text(arguments[name]["default_value"]))
            assert type(settings[name].default) is KINDS[kind]
            assert default == settings[name].default
    config = yaml.safe_load((PACKAGE / "config" / "passage.yaml").read_text(encoding="utf-8"))
    assert {key.rpartition("/")[2] for key in config} == set(SETTINGS)
    for key, entry in config.items():
        known = {setting.name for setting in SETTINGS[key.rpartition("/")[2]]} | {"use_sim_time"}
        assert set(entry["ros__parameters"]) <= known


def test_what_it_starts_comes_up_by_its_transitions(graph: Graph, processes: Processes) -> None:
    """In a namespace, by the arguments that launch_ros builds: __node, __ns, files, remappings."""
    (node,) = calls("LifecycleNode")
    remappings = ast.literal_eval(keywords(node)["remappings"])
    settings = {"sensor": {"scenario": str(QUICK), "real_time_factor": "0.0"}, "detector": {}}
    diagnostics = graph.listen(m.DIAGNOSTICS)
    heard: dict[str, list[TransitionEvent]] = {name: [] for name in managed()}
    for name, passed in settings.items():
        arguments = ["--ros-args", "-r", f"__node:={name}", "-r", "__ns:=/north"]
        arguments += ["--params-file", str(PACKAGE / "config" / "passage.yaml")]
        for key, value in passed.items():
            assert key in managed()[name]
            arguments += ["-p", f"{key}:={value}"]
        for old, new in remappings:
            arguments += ["-r", f"{old}:={new}"]
        processes.executable(PACKAGE / "resource" / f"{name}_node", *arguments)
        graph.tester.create_subscription(
            TransitionEvent, f"/north/{name}/transition_event", heard[name].append, 10
        )

    def change(name: str, transition: int) -> bool:
        request = ChangeState.Request(transition=Transition(id=transition))
        return bool(graph.call(ChangeState, f"/north/{name}/change_state", request).success)

    (handler,) = calls("OnStateTransition")
    start, goal = (text(keywords(handler)[key]) for key in ("start_state", "goal_state"))
    for name in heard:
        assert change(name, Transition.TRANSITION_CONFIGURE)
        graph.until(
            lambda name=name: any(
                (e.start_state.label, e.goal_state.label) == (start, goal) for e in heard[name]
            ),
            f"{start} to {goal}",
        )
        assert change(name, Transition.TRANSITION_ACTIVATE)
    graph.until(
        lambda: int(figures(diagnostics, "detector: input").get("blocks rail/waveform", "0")) > 0,
        "waveforms at the detector",
    )
    assert graph.tester.count_publishers("/north/clock") == 1
    assert graph.tester.count_subscribers("/north/clock") == 1
    assert graph.tester.count_publishers("/clock") == 0
