"""The same scenario and seeds give the same values and stamps in another process and a bag."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy")

from solver import load_scenario
from tests.ros.test_record_replay import Command, command, domain, until
from trackvib_ros import messages as m
from trackvib_ros.bag import BagReader
from trackvib_ros.station import Station
from trackvib_ros.waveform import Waveform

__all__ = ["command", "domain"]

pytestmark = pytest.mark.ros

SCENARIO = """
name = "short"
track_preset = "crts2"

[line]
approach_left = 10.0
spans = [16.0]
approach_right = 10.0

[irregularity]
spectrum = "sato"
seed = 3

[[train]]
preset = "metro"
speed = "160 km/h"
start = 8.0

[[channel]]
name = "rail_a"
layer = "rail"
span = 1
x = 6.0

[[sensor]]
channel = "rail_a"
preset = "rail_500g"
timing_jitter = 1e-6
dropout_rate = 30.0
seed = 3

[solution]
end_time = 0.4
frequency_limit = 500.0
"""


def recorded(bag: Path) -> dict[str, list[Any]]:
    """Stamps and decoded samples of everything that the solver and the sensors produce."""
    reader = BagReader(bag)
    assert reader.verify() == []
    found: dict[str, list[Any]] = {}
    for name in reader.topics:
        if name.endswith("/waveform") or name == "/ground_truth/acceleration":
            found[name] = [_block(wave) for wave in reader.waveforms(name)]
        elif name == "/ground_truth/passages":
            messages = [reader.decode(message) for message in reader.messages((name,))]
            found[name] = [p for message in messages for p in m.read_passages(message)]
    return found


def computed(scenario: Path) -> dict[str, list[Any]]:
    """The same from a station in this process."""
    station = Station(load_scenario(scenario))
    found: dict[str, list[Any]] = {}
    while not station.finished:
        step = station.advance()
        for wave in step.waveforms:
            found.setdefault(f"/{m.waveform_topic(wave.frame_id).name}", []).append(_block(wave))
        found.setdefault("/ground_truth/acceleration", []).append(_block(step.acceleration))
        found.setdefault("/ground_truth/passages", []).extend(step.entered)
    return found


def _block(wave: Waveform) -> tuple[int, int, bytes]:
    return wave.stamp_ns, wave.dt_ns, wave.data.tobytes()


def test_same_seed_same_values(domain: int, command: Command, tmp_path: Path) -> None:
    """Over DDS and through a bag, with jitter and drop-outs: to the bit what this process computes."""
    scenario = tmp_path / "short.toml"
    scenario.write_text(SCENARIO)
    process = command("demo", "-s", str(scenario), "-o", str(tmp_path / "run"), "--no-figure")
    until(lambda: process.poll() is not None, "end of the demo", deadline_s=120.0)
    found, wanted = recorded(tmp_path / "run" / "bag"), computed(scenario)
    waves = np.concatenate([np.frombuffer(x, np.float32) for _, _, x in wanted["/rail/waveform"]])
    assert np.isnan(waves).any() and np.nanmax(waves) > 1.0
    assert set(found) == set(wanted) and len(wanted["/ground_truth/passages"]) == 1
    assert [name for name in found if found[name] != wanted[name]] == []
