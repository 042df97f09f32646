"""``trackvib demo`` as its users run it."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy")
from solver import Simulation, load_scenario
from tests.ros.harness import (
    DEADLINE_S,
    QUICK,
    Processes,
    descendants,
    ended,
    own_domain,
    processes_of_test,
)
from trackvib_ros.bag import BagReader
from trackvib_ros.cli import main
from trackvib_ros.report import PassageReport
from trackvib_ros.sensor import SensorArray

pytestmark = pytest.mark.ros
processes = pytest.fixture(processes_of_test)


@pytest.fixture(autouse=True)
def domain(monkeypatch: pytest.MonkeyPatch) -> int:
    return own_domain(monkeypatch)


@pytest.fixture
def mark(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Iterator[int]:
    """Every process of the test can be found by this number in its environment."""
    number = os.getpid() * 1000 + abs(hash(request.node.name)) % 1000
    monkeypatch.setenv("TRACKVIB_TEST_MARK", str(number))
    yield number
    monkeypatch.delenv("TRACKVIB_TEST_MARK")


def until(condition: Callable[[], object], what: str) -> None:
    end = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < end, f"{what} did not happen within {DEADLINE_S} s"
        time.sleep(0.02)


def test_demo_detects_records_and_shows(processes: Processes, tmp_path: Path, mark: int) -> None:
    out = tmp_path / "run"
    status, text = ended(processes.command("demo", "-s", str(QUICK), "-o", str(out)))
    assert status == 0, text
    assert "detected vs truth" in text
    assert (out / "passage.png").read_bytes().startswith(b"\x89PNG")
    report = PassageReport(out / "bag")
    (found,) = report.matches
    assert found.event is not None and not report.extra
    assert found.event.values["direction"] == "forward"
    until(lambda: descendants(mark) == [], "end of all processes")
    # what went over the wire is, bit for bit, what solver and sensors compute here
    scenario = load_scenario(QUICK)
    simulation = Simulation(scenario)
    array = SensorArray(scenario, simulation.channels)
    expected = array.push(simulation.advance(simulation.end_index).acceleration)
    reader = BagReader(out / "bag")
    for group in array.groups:
        blocks = list(reader.waveforms(f"/{group.name}/waveform"))
        stamps = [block.stamp_ns for block in blocks]
        assert stamps == [k * blocks[0].data.shape[0] * blocks[0].dt_ns for k in range(len(blocks))]
        computed = [block for block in expected if block.frame_id == group.name]
        assert len(blocks) >= len(computed) > 250
        for block, own in zip(blocks, computed, strict=False):
            np.testing.assert_array_equal(block.data, own.data)
    counts = {name: info.count for name, info in reader.topics.items()}
    assert counts["/rail_a/acceleration"] == counts["/rail/waveform"]
    assert counts["/scenario"] == counts["/channels"] == counts["/ground_truth/passages"] == 1


@pytest.mark.parametrize(
    "moment", ["start", pytest.param("recording", marks=pytest.mark.slow), "passage"]
)
def test_interrupted_demo_leaves_a_readable_bag_and_no_process(
    processes: Processes, tmp_path: Path, mark: int, moment: str
) -> None:
    out = tmp_path / "run"
    arguments = ("demo", "-s", str(QUICK), "-o", str(out), "--real-time-factor", "1", "--no-figure")
    demo = processes.command(*arguments)
    if moment == "start":
        until((out / "log").exists, "start")
    else:
        active = out / "bag" / "bag_0.mcap.active"
        least = 1 if moment == "recording" else 100_000
        until(lambda: active.exists() and active.stat().st_size >= least, "recording")
    os.kill(demo.pid, signal.SIGINT)
    status, text = ended(demo)
    assert status == 130, text
    assert "interrupted" in text
    until(lambda: descendants(mark) == [], "end of all processes")
    if moment != "start":
        reader = BagReader(out / "bag")
        assert reader.recovery is None and not reader.damage
        assert reader.verify() == []
        assert (out / "bag" / "metadata.yaml").exists()
    if moment == "passage":
        blocks = list(reader.waveforms("/rail/waveform"))
        assert blocks[0].stamp_ns == 0
        assert all(b.stamp_ns == a.end_ns for a, b in pairwise(blocks))


@pytest.mark.slow
def test_demo_refuses_a_domain_that_has_a_clock(processes: Processes, tmp_path: Path) -> None:
    processes.command("sensor", "-s", str(QUICK))
    out = tmp_path / "run"
    arguments = ("demo", "-s", str(QUICK), "-o", str(out), "--real-time-factor", "0.2")
    status, text = ended(processes.command(*arguments))
    assert status == 2, text
    assert "another publisher of /clock" in text and "unset ROS_DOMAIN_ID" in text


def test_killed_demo_takes_its_nodes_along(processes: Processes, tmp_path: Path, mark: int) -> None:
    out = tmp_path / "run"
    demo = processes.command(
        "demo", "-s", str(QUICK), "-o", str(out), "--real-time-factor", "1", "--no-figure"
    )
    until(lambda: (out / "bag" / "bag_0.mcap.active").exists(), "recording")
    until(lambda: len(descendants(mark)) == 3, "three processes")
    os.kill(demo.pid, signal.SIGKILL)
    until(lambda: descendants(mark) == [], "end of all processes")
    assert BagReader(out / "bag").verify() == []


@pytest.mark.slow
def test_demo_with_nothing_to_detect_does_not_claim_success(
    processes: Processes, tmp_path: Path
) -> None:
    # no train: the run has an end, but there is no passage to detect
    text = QUICK.read_text(encoding="utf-8")
    head, _, rest = text.partition("[[train]]")
    scenario = tmp_path / "empty.toml"
    scenario.write_text(head + rest[rest.index("[irregularity]") :] + "end_time = 1.0\n")
    status, output = ended(
        processes.command("demo", "-s", str(scenario), "-o", str(tmp_path / "run"), "--no-figure")
    )
    assert status == 1, output
    assert "not every train was detected, or there was none" in output


@pytest.mark.parametrize(
    ("arguments", "environment", "words"),
    [
        (("-o", "{exists}"), {}, ("exists", "another directory")),
        (("-s", "nonsense"), {}, ("nonsense", "presets: ")),
        ((), {"ROS_DOMAIN_ID": "300"}, ("ROS_DOMAIN_ID = '300'", "0 to 101")),
        ((), {"ROS_DOMAIN_ID": "one"}, ("ROS_DOMAIN_ID = 'one'", "0 to 101")),
        ((), {"RMW_IMPLEMENTATION": "rmw_other"}, ("rmw_other", "unset")),
        (("-o", "{file}/run"), {}, ("{file}",)),
    ],
)
def test_demo_refuses_with_one_sentence(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    environment: dict[str, str],
    words: tuple[str, ...],
) -> None:
    monkeypatch.chdir(tmp_path)
    for name, setting in environment.items():
        monkeypatch.setenv(name, setting)
    places = {"exists": str(tmp_path / "taken"), "file": str(tmp_path / "file")}
    (tmp_path / "taken").mkdir()
    (tmp_path / "file").write_text("kept")
    filled = [argument.format(**places) for argument in arguments]
    monkeypatch.setattr("sys.argv", ["trackvib", "demo", *filled])
    with pytest.raises(SystemExit) as ending:
        main()
    assert ending.value.code == 2
    text = capsys.readouterr().err
    assert len(text.strip().splitlines()) == 1, text
    for word in words:
        assert word.format(**places) in text
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "taken"]
