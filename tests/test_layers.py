"""The layers hold: numbers, sensor, detection and bags know nothing of ROS."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ROS_PACKAGES = {
    "action_msgs", "builtin_interfaces", "diagnostic_msgs", "geometry_msgs", "lifecycle_msgs",
    "nav_msgs", "rcl_interfaces", "rclpy", "rosgraph_msgs", "rosidl_runtime_py", "sensor_msgs",
    "std_msgs", "std_srvs", "visualization_msgs",
}  # fmt: skip
WITHOUT_ROS = (
    "solver",
    "trackvib_ros",
    "trackvib_ros.waveform",
    "trackvib_ros.pointcloud",
    "trackvib_ros.sensor",
    "trackvib_ros.truth",
    "trackvib_ros.station",
    "trackvib_ros.topics",
    "trackvib_ros.detection",
    "trackvib_ros.bag",
    "trackvib_ros.report",
    "trackvib_ros.environment",
    "trackvib_ros.cli",
    "trackvib_ros.cli.bag_commands",
    "trackvib_ros.cli.detection_commands",
    "trackvib_ros.cli.ros_commands",
    "trackvib_ros.cli.solver_commands",
)
BLOCK = f"""
import importlib.abc, sys
class Block(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {sorted(ROS_PACKAGES)!r}:
            raise ModuleNotFoundError(name + " is blocked")
sys.meta_path.insert(0, Block())
import importlib
for name in {WITHOUT_ROS!r}:
    importlib.import_module(name)
try:
    import rclpy
except ModuleNotFoundError:
    print("blocked")
"""


def imports(path: Path) -> set[str]:
    """Absolute modules that a file imports anywhere, also inside functions."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            found.add(node.module)
    return found


def test_everything_below_messages_imports_with_rclpy_absent() -> None:
    result = subprocess.run(
        [sys.executable, "-c", BLOCK], capture_output=True, text=True, cwd=ROOT, check=False
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout == "blocked\n"


@pytest.mark.parametrize("path", sorted((ROOT / "solver").rglob("*.py")), ids=lambda p: p.name)
def test_solver_imports_neither_ros_nor_what_is_above_it(path: Path) -> None:
    tops = {name.split(".")[0] for name in imports(path)}
    assert not tops & (ROS_PACKAGES | {"trackvib_ros", "solver"})  # inside, imports are relative


@pytest.mark.parametrize(
    "path", sorted((ROOT / "trackvib_ros").rglob("*.py")), ids=lambda p: p.stem
)
def test_only_the_facade_of_the_solver_is_used_outside(path: Path) -> None:
    assert not {name for name in imports(path) if name.startswith("solver.")}


def test_nodes_are_imported_by_nothing_but_what_starts_them() -> None:
    users = {
        path.name
        for path in (ROOT / "trackvib_ros").rglob("*.py")
        if imports(path) & {"trackvib_ros.sensor_node", "trackvib_ros.detector_node"}
    }
    assert users == {"start.py", "ros_commands.py"}


@pytest.mark.parametrize("name", ["sensor_node", "detector_node"])
def test_nodes_hold_no_arithmetic(name: str) -> None:
    tree = ast.parse((ROOT / "trackvib_ros" / f"{name}.py").read_text(encoding="utf-8"))
    operations = (ast.Mult, ast.Div, ast.Sub, ast.Pow, ast.MatMult, ast.Mod, ast.FloorDiv)
    found = [
        node.lineno
        for node in ast.walk(tree)
        if isinstance(node, ast.BinOp) and isinstance(node.op, operations)
    ]
    assert found == []
    assert "numpy" not in imports(ROOT / "trackvib_ros" / f"{name}.py")
