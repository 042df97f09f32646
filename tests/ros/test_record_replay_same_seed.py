"""The same scenario and seeds give the same decoded values and stamps, recorded over DDS twice."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy")

from tests.ros.test_record_replay import Command, command, domain, until
from trackvib_ros.bag import BagReader

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


def values(bag: Path) -> dict[str, list[Any]]:
    """Stamps and decoded samples of everything that the solver and the sensors produce."""
    reader = BagReader(bag)
    assert reader.verify() == []
    found: dict[str, list[Any]] = {}
    for name in reader.topics:
        if name.endswith("/waveform") or name == "/ground_truth/acceleration":
            found[name] = [(w.stamp_ns, w.dt_ns, w.data.tobytes()) for w in reader.waveforms(name)]
        elif name.endswith(("/acceleration", "ground_truth/train", "ground_truth/passages")):
            found[name] = [repr(reader.decode(m)) for m in reader.messages((name,))]
    return found


def test_same_seed_same_values(domain: int, command: Command, tmp_path: Path) -> None:
    runs = []
    for number in range(2):
        (tmp_path / f"{number}.toml").write_text(SCENARIO)
        output = str(tmp_path / str(number))
        process = command(
            "demo", "-s", str(tmp_path / f"{number}.toml"), "-o", output, "--no-figure"
        )
        until(lambda p=process: p.poll() is not None, "end of the demo", deadline_s=120.0)
        runs.append(values(tmp_path / str(number) / "bag"))
    first, same = runs
    waves = [np.frombuffer(data, np.float32) for _, _, data in first["/rail/waveform"]]
    assert np.isnan(np.concatenate(waves)).any() and np.nanmax(np.concatenate(waves)) > 1.0
    assert set(first) == set(same) and len(first) >= 4
    assert [name for name in first if first[name] != same[name]] == []
