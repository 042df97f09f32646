"""`trackvib simulate` and `trackvib scenario`: layout of the result, refusals, nothing half-written."""

import json
import subprocess
import sys

import numpy as np
import pytest

from solver import Simulation, load_scenario, load_scenario_text, preset_names

SCENARIO = """
[line]
approach_left = 5.2
spans = [5.2]
approach_right = 5.2

[[train]]
preset = "wheel_element"
speed = 60.0
start = -1.0

[irregularity]
spectrum = "sato"

[[channel]]
name = "rail"
layer = "rail"
x = 7.0

[solution]
frequency_limit = 700.0
end_time = 0.05
"""


def trackvib(*arguments, cwd=None):
    return subprocess.run(
        [sys.executable, "-c", "from trackvib_ros.cli import main; main()", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=300,
        cwd=cwd,
    )


@pytest.fixture
def scenario(tmp_path):
    path = tmp_path / "run.toml"
    path.write_text(SCENARIO)
    return path


def test_simulate_writes_the_run(scenario, tmp_path):
    output = tmp_path / "out.npz"
    done = trackvib("simulate", scenario, "-o", output)
    assert done.returncode == 0, done.stderr
    assert "quality: equilibrium residual" in done.stderr
    assert done.stdout == ""
    loaded = load_scenario(scenario)
    simulation = Simulation(loaded, outputs=("displacement", "velocity", "acceleration"))
    block = simulation.advance(2001)
    with np.load(output, allow_pickle=False) as run:
        assert list(run["channels"]) == ["rail"]
        assert run["wheelset_position"] == pytest.approx([-1.0])
        assert run["step_ns"] == 25_000
        assert load_scenario_text(str(run["scenario"])) == loaded
        for name in ("time", "wheelset_force", "displacement", "velocity", "acceleration"):
            assert run[name].dtype == np.float64
            np.testing.assert_allclose(run[name], getattr(block, name), rtol=1e-9, atol=1e-12)
    # nothing but the scenario and the result is left
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out.npz", "run.toml"]


def test_existing_output_is_kept_unless_forced(scenario, tmp_path):
    output = tmp_path / "out.npz"
    output.write_text("mine")
    refused = trackvib("simulate", scenario, "-o", output)
    assert refused.returncode == 2
    assert "exists already, not overwriting" in refused.stderr
    assert output.read_text() == "mine"
    forced = trackvib("simulate", scenario, "-o", output, "--force")
    assert forced.returncode == 0, forced.stderr
    assert np.load(output)["time"].shape == (2001,)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nothing", "-o", "a.npz"], "neither a .toml file nor a preset"),
        (["missing.toml", "-o", "a.npz"], "cannot be read"),
        (["run.toml", "-o", "a.csv"], "must end in .npz"),
        (["run.toml", "-o", "nowhere/a.npz"], "there is no folder"),
        (["wrong.toml", "-o", "a.npz"], "unknown entry"),
    ],
)
def test_user_mistakes_end_with_one_sentence(scenario, tmp_path, arguments, message):
    (tmp_path / "wrong.toml").write_text(SCENARIO.replace("preset", "prefix"))
    failed = trackvib("simulate", *arguments, cwd=tmp_path)
    assert failed.returncode == 2
    assert message in failed.stderr
    assert "Traceback" not in failed.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run.toml", "wrong.toml"]


def test_a_failed_run_leaves_nothing_behind(scenario, tmp_path):
    scenario.write_text(SCENARIO.replace('spectrum = "sato"', 'profile = "r.txt"'))
    failed = trackvib("simulate", scenario, "-o", tmp_path / "out.npz")
    assert failed.returncode == 2
    assert "r.txt" in failed.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["run.toml"]


def test_check_shows_what_changes(scenario, tmp_path):
    done = trackvib("simulate", scenario, "-o", tmp_path / "out.npz", "--check")
    assert done.returncode == 0, done.stderr
    assert "step 25 -> 12.5 us" in done.stderr
    assert "wheelset force" in done.stderr


def test_scenario_commands():
    listed = trackvib("scenario", "list").stdout
    for kind, names in preset_names().items():
        assert f"{kind}: {', '.join(names)}" in listed
    assert "[crts2]" not in trackvib("scenario", "show", "crts2").stdout
    assert "mass_per_length = 60.64" in trackvib("scenario", "show", "crts2").stdout
    schema = json.loads(trackvib("scenario", "--schema").stdout)
    assert schema["title"] == "Scenario"
    unknown = trackvib("scenario", "show", "crts9")
    assert unknown.returncode == 2
    assert "no such preset" in unknown.stderr
