"""ROS tests are skipped without the [ros] extra, but never where CI=true: there that is a failure."""

from __future__ import annotations

import importlib.util
import os

import pytest

HAS_ROS = importlib.util.find_spec("rclpy") is not None


def pytest_sessionstart(session: pytest.Session) -> None:
    if not HAS_ROS and os.environ.get("CI") == "true":
        pytest.exit("rclpy is missing: install with pip install '.[ros,dev]'", returncode=1)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if HAS_ROS:
        return
    skip = pytest.mark.skip(reason="needs rclpy: pip install '.[ros]'")
    for item in items:
        if item.get_closest_marker("ros"):
            item.add_marker(skip)
