"""Scores on hand-made events whose result is known, and one bag from the solver to the table."""

import json
import subprocess
import sys

import numpy as np
import pytest

from solver import InputError
from trackvib_ros.dataset import EXAMPLE, Case, Spec, make_dataset, scenario_of, tomllib
from trackvib_ros.detection import Estimate, TrainEvent
from trackvib_ros.evaluate import (
    BagScore,
    Evaluation,
    evaluate,
    find_bags,
    load_factory,
    match_events,
    pair,
)
from trackvib_ros.truth import PassageTruth

S = 10**9
PLACES = np.array([0.0, 2.5, 17.375, 19.875])
SPEED = 50.0


def truth(start_s=10.0):
    times = tuple(int((start_s + p / SPEED) * S) for p in PLACES)
    return PassageTruth(
        train=1,
        train_type="custom",
        direction="forward",
        length_m=25.0,
        enter_ns=times[0] - S,
        leave_ns=times[-1] + S,
        axle_times_ns={"rail_a": times},
        speed_m_s={"rail_a": SPEED},
    )


def told(kind, stamp_s, at_s=20.0, **values):
    event = TrainEvent(kind, round(stamp_s * S), 0.01, 1.0, "m", ("rail_a",), values)
    return round(at_s * S), event


def test_errors_are_found_minus_true():
    events = [
        told("arrival", 9.9),
        told("arrival", 40.0),
        *(told("axle", 10.0 + p / SPEED + 0.001) for p in PLACES[:3]),
        told(
            "passage",
            10.002,
            at_s=12.5,
            speed=Estimate(50.5, 0.25, "m/s"),
            departure_ns=round((10 + 19.875 / 50 - 0.003) * S),
            type="CRH3",
            direction="backward",
        ),
        told("passage", 60.0, speed=Estimate(30.0, 1.0, "m/s")),
    ]
    score = BagScore("bag", 3600.0, 1.0)
    match_events(score, events, [truth()])
    (p,) = score.passages
    assert p.detected and p.found_type == "CRH3" and p.direction_right is False
    assert p.arrival_s == pytest.approx(0.002, abs=1e-6)
    assert p.departure_s == pytest.approx(-0.003, abs=1e-6)
    assert p.onset_s == pytest.approx(-0.1, abs=1e-6)
    assert p.speed_error == pytest.approx(0.01) and p.speed_sigma == pytest.approx(0.005)
    assert (p.axles_true, p.axles_found, p.axles_right) == (4, 3, 3)
    assert p.latency_s == pytest.approx(12.5 - 10 - 19.875 / 50, abs=1e-6)
    assert score.extra == 1 and score.alarms == 1
    result = Evaluation("d", [score])
    summary = result.summary()
    assert summary["false_alarms_per_hour"] == pytest.approx(1.0)
    assert summary["axle_recall"] == 0.75 and summary["axle_precision"] == 1.0
    assert summary["speed_sigma_calibration"] == pytest.approx(2.0)
    assert result.confusion() == {"custom": {"CRH3": 1}}
    assert json.loads(result.to_json())["summary"]["detected"] == 1.0


def test_missed_passage():
    score = BagScore("bag", 60.0, 1.0)
    match_events(score, [told("passage", 30.0)], [truth()])
    assert not score.passages[0].detected and score.extra == 1
    assert Evaluation("d", [score]).confusion() == {"custom": {"missed": 1}}


def test_pairs_are_one_to_one():
    true = np.array([1.0, 2.0, 3.0])
    assert pair(np.array([0.99, 1.01, 2.0]), true, 0.05) == 2
    assert pair(np.array([]), true, 0.05) == 0


@pytest.mark.parametrize(
    ("name", "named"),
    [("json", "module:factory"), ("no_such_module:X", "cannot be loaded"), ("json:nope", "nope")],
)
def test_wrong_detector_is_named(name, named):
    with pytest.raises(InputError, match=named):
        load_factory(name)


def test_bags_are_looked_for(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        find_bags([tmp_path / "none"])
    with pytest.raises(InputError, match="holds no bag"):
        find_bags([tmp_path])


@pytest.mark.parametrize(
    ("table", "named"),
    [
        ({"train": ["CRH3"]}, "unknown field 'train'"),
        ({"trains": ["TGV"]}, "'TGV'; choose from"),
        ({"trains": []}, "filled list"),
        ({"speeds": [1]}, "speeds has 1"),
        ({"snr_db": ["loud"]}, "snr_db has 'loud'"),
        ({"faults": ["fire"]}, "clipping"),
        ({"repeats": 0}, "at least 1"),
        ({"seed": -1}, "seed = -1"),
    ],
)
def test_wrong_specification_is_named(table, named):
    with pytest.raises(InputError, match=named):
        Spec.from_table(table, "s.toml")


def test_cases_follow_from_the_seed():
    spec = Spec.from_table(tomllib.loads(EXAMPLE), "example")
    cases = spec.expand()
    assert len(cases) == 50 and len({c.seed for c in cases}) == 50
    assert cases == spec.expand()
    other = Spec.from_table({**tomllib.loads(EXAMPLE), "seed": 2}, "example").expand()
    assert {c.seed for c in other}.isdisjoint(c.seed for c in cases)


def test_case_becomes_a_scenario():
    case = Case(1, "demo", "metro", 90.0, 0.5, "backward", 2.0, None, "flat", 77)
    scenario = scenario_of(case)
    assert scenario.irregularity.seed == 77
    assert [t.direction for t in scenario.train] == ["backward", "backward"]
    assert scenario.train[0].flat[0].wheelset == 5
    assert scenario.train[1].start > scenario.train[0].start > scenario.line.length


def bytes_of(bag):
    return {path.name: path.read_bytes() for path in bag.iterdir()}


@pytest.mark.slow
def test_dataset_is_resumed_scored_and_made_again(tmp_path):
    spec = Spec(trains=("metro",), speeds=(300.0,), snr_db=(20.0,), seed=3)
    first = make_dataset(spec, tmp_path / "set", workers=1)
    (name,) = first
    assert first == {name: "made"}
    assert make_dataset(spec, tmp_path / "set", workers=1) == {name: "there"}
    with pytest.raises(InputError, match="another dataset"):
        make_dataset(Spec(seed=4), tmp_path / "set")

    bag = tmp_path / "set" / name
    result = evaluate([tmp_path / "set"])
    (score,) = result.passages
    assert score.detected and score.found_type == "metro" and score.axles_right == 24
    # target for two rail sensors: 0.4 %
    assert abs(score.speed_error) < 4e-3

    naive = evaluate([bag], "tests.detection.naive:PeakCounter")
    assert not naive.bags[0].problem

    again = tmp_path / "again" / name
    main = "from trackvib_ros.cli import main; main()"
    command = [sys.executable, "-c", main, "dataset", "--again", bag, "-o", again]
    subprocess.run(command, check=True)
    assert bytes_of(again) == bytes_of(bag)
