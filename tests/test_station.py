"""The station: run, sensors and truth in step; trains sent at run time; seeds."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from solver import GRAVITY, InputError, load_scenario
from trackvib_ros.station import Station, StationStep, reseeded

QUICK = load_scenario(Path(__file__).parent / "ros" / "quick.toml")


def run(station: Station, steps: int) -> list[StationStep]:
    return [station.advance() for _ in range(steps)]


@pytest.fixture(scope="module")
def passage() -> list[StationStep]:
    station = Station(QUICK)
    steps = []
    while not station.finished:
        steps.append(station.advance())
    return steps


def test_steps_follow_each_other_without_gap(passage: list[StationStep]) -> None:
    assert passage[0].start_ns == 0
    for step, follower in pairwise(passage):
        assert step.time_ns == follower.start_ns == step.acceleration.end_ns
    assert passage[0].time_ns == 20_000_000
    blocks = [block for step in passage for block in step.waveforms if block.frame_id == "rail"]
    assert [block.stamp_ns for block in blocks] == [20_000_000 * k for k in range(len(blocks))]


def test_truth_of_wheelsets_and_train_agrees_with_the_motion(passage: list[StationStep]) -> None:
    speed, start = 200 / 3.6, -60.0
    train = QUICK.train[0]
    (truth,) = [entered for step in passage for entered in step.entered]
    assert truth.enter_ns == round(-start / speed * 1e9)
    assert truth.axle_count == 24 and truth.train_type == "metro"
    assert truth.speed_m_s["rail_a"] == pytest.approx(speed, rel=1e-12)
    seen = set()
    for step in passage:
        front = start + speed * step.start_ns * 1e-9
        for wheelset in step.wheelsets:
            seen.add(wheelset.number)
            place = front - train.axle_positions[wheelset.number - 1]
            assert wheelset.position == pytest.approx(place, abs=1e-9)
            assert 0 <= wheelset.position <= QUICK.line.length
        for state in step.trains:
            assert state.position == pytest.approx(front, abs=1e-9)
            assert state.velocity == pytest.approx(speed)
    assert seen == set(range(1, 25))


def test_wheel_forces_are_upward_and_carry_the_train(passage: list[StationStep]) -> None:
    forces: dict[str, list[np.ndarray]] = {}
    for step in passage:
        if step.wheel_force is not None:
            assert step.wheel_force.stamp_ns == step.start_ns
            for column, name in enumerate(step.wheel_force.channels):
                forces.setdefault(name, []).append(step.wheel_force.data[:, column])
    assert set(forces) == {f"train_1_wheelset_{n}" for n in range(1, 25)}
    means = [np.nanmean(np.concatenate(parts)) for parts in forces.values()]
    static = QUICK.train[0].mass * GRAVITY / 24
    # each mean still has the slow motion of the suspension over 0.6 s in it, all together less
    assert np.mean(means) == pytest.approx(static, rel=0.02)
    assert min(means) > 0.9 * static


def test_true_acceleration_points_up_like_the_sensors(passage: list[StationStep]) -> None:
    """The bridge sensor is the filtered truth: same sign, same size where the filter is flat."""
    column = passage[0].acceleration.channels.index("bridge_mid")
    truth = np.concatenate([step.acceleration.data[:, column] for step in passage])[::10]
    blocks = [block for step in passage for block in step.waveforms if block.frame_id == "bridge"]
    sensed = np.concatenate([block.data[:, 0] for block in blocks])

    def low(signal: np.ndarray) -> np.ndarray:
        spectrum = np.fft.rfft(signal[: sensed.size])
        frequency = np.fft.rfftfreq(sensed.size, 1e-3)
        spectrum[(frequency < 2) | (frequency > 30)] = 0
        return np.fft.irfft(spectrum, sensed.size)

    a, b = low(truth.astype(float)), low(sensed.astype(float))
    assert a @ b / (a @ a) == pytest.approx(1.0, abs=0.02)


def test_seeds_give_another_run_and_the_same_run_again() -> None:
    assert reseeded(QUICK, QUICK.irregularity.seed) == QUICK
    other = reseeded(QUICK, 7)
    assert other.irregularity.seed == 7
    assert other.line == QUICK.line
    first, again, changed = (
        np.concatenate([s.acceleration.data for s in run(Station(scenario), 80)])
        for scenario in (QUICK, QUICK, other)
    )
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, changed)


def test_a_train_is_sent_at_run_time() -> None:
    station = Station(QUICK)
    run(station, 5)
    assert station.trigger("CRH3", 50.0) == 2
    sent_ns = station.time_ns
    entered = [truth for step in run(station, 60) for truth in step.entered]
    (second,) = [truth for truth in entered if truth.train == 2]
    assert second.train_type == "CRH3" and second.axle_count == 32
    # half a second and a metre of run-in at 50 m/s
    assert second.enter_ns - sent_ns == pytest.approx(0.52e9, abs=1)
    assert second.speed_m_s["rail_a"] == pytest.approx(50.0)
    with pytest.raises(InputError, match="no such preset"):
        station.trigger("steam", None)


def test_random_headways_never_end_and_keep_their_distance() -> None:
    def entries(steps: int) -> list[int]:
        station = Station(reseeded(QUICK, 3), headway=0.5, least_headway=5.0)
        given = []
        for _ in range(steps):
            given.append(station.advance())
            assert len(station.simulation.motions) <= 2  # those that have left are forgotten
        assert not station.finished
        return [truth.enter_ns for step in given for truth in step.entered]

    first = entries(650)  # 13 s
    assert len(first) == 3
    assert first[2] - first[1] >= 5e9  # the first train is the scenario's own
    assert entries(350) == first[:2]
