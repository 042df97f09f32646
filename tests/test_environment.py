"""The ROS environment: domains, mixed installations, pace. No node is made."""

from __future__ import annotations

import importlib.util
import socket
import sys
from pathlib import Path

import pytest

from solver import InputError
from trackvib_ros import environment


@pytest.mark.parametrize(("text", "domain"), [("", None), (" 7 ", 7), ("0", 0), ("101", 101)])
def test_domain_is_read(text: str, domain: int | None) -> None:
    assert environment.domain_of({"ROS_DOMAIN_ID": text}) == domain
    assert environment.domain_of({}) is None


@pytest.mark.parametrize("text", ["102", "-1", "1.5", "two", "٣"])
def test_wrong_domain_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="whole number from 0 to 101"):
        environment.domain_of({"ROS_DOMAIN_ID": text})


def test_free_domain_avoids_those_in_use(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(environment, "DOMAINS", range(88, 90))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("", 7400 + 250 * 88 + 10))  # what a participant of domain 88 binds
        assert {environment.free_domain() for _ in range(8)} == {89}
        monkeypatch.setattr(environment, "DOMAINS", range(88, 89))
        with pytest.raises(InputError, match="set ROS_DOMAIN_ID"):
            environment.free_domain()


def test_missing_ros_is_told_with_the_cure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"trackvib\[ros\]"):
        environment.require_ros({})


@pytest.mark.ros
def test_a_sourced_installation_beside_the_wheels_is_refused(tmp_path: Path) -> None:
    (tmp_path / "share" / "rclpy").mkdir(parents=True)
    wheels = {"_ROS_WHEELS_BOOTSTRAP_COMPLETE": "1", "AMENT_PREFIX_PATH": str(tmp_path)}
    with pytest.raises(InputError, match="sourced"):
        environment.require_ros(wheels)
    environment.require_ros({**wheels, "AMENT_PREFIX_PATH": f"{sys.prefix}:/nowhere"})
    with pytest.raises(InputError, match="RMW_IMPLEMENTATION = rmw_other"):
        environment.require_ros({"RMW_IMPLEMENTATION": "rmw_other"})


def test_the_users_settings_win() -> None:
    mine = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET", "FASTRTPS_DEFAULT_PROFILES_FILE": "/mine"}
    settings = {**mine, "HOME": "/home/me"}
    environment.complete(settings)
    assert settings == {**mine, "HOME": "/home/me"}
    settings = {}
    environment.complete(settings)
    assert Path(settings["FASTRTPS_DEFAULT_PROFILES_FILE"]).read_text().count("<profiles") == 1
    assert settings["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"
    assert settings["ROS_LOG_DIR"]  # rclpy needs one without a home


@pytest.mark.ros
def test_pace_follows_the_wall_and_gives_up_what_is_lost() -> None:
    from trackvib_ros.clock import Pace

    wall = [100.0]
    pace = Pace(2.0, now=lambda: wall[0])
    assert pace.delay(10_000_000_000) == 0.0  # the first step is due at once
    assert pace.delay(11_000_000_000) == pytest.approx(0.5)  # a second, twice as fast
    wall[0] = 100.4
    assert pace.delay(11_000_000_000) == pytest.approx(0.1)
    wall[0] = 100.9
    assert pace.delay(11_000_000_000) == 0.0  # late by 0.4 s: caught up
    assert pace.late_s == 0.0
    assert pace.behind_s == pytest.approx(0.4)
    wall[0] = 105.0
    assert pace.delay(11_200_000_000) == 0.0  # late by 4.4 s: given up
    assert pace.late_s == pytest.approx(4.4)
    assert pace.delay(11_400_000_000) == pytest.approx(0.1)
    pace.hold()
    wall[0] = 200.0
    assert pace.delay(11_600_000_000) == 0.0
    assert pace.delay(11_800_000_000) == pytest.approx(0.1)  # a pause is not caught up
    pace.factor = 0.0
    assert pace.delay(10**15) == 0.0
