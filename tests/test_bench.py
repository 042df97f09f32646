from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from trackvib_ros.bench import Case, Result, _errors, _Signals, growth, load_cases, scenario_of


def test_what_a_case_refers_to_comes_before_it() -> None:
    seen: set[str] = set()
    for case in load_cases():
        assert case.name not in seen
        assert {case.reference, case.truth} <= seen | {""}
        seen.add(case.name)


def test_every_case_is_a_scenario_that_can_be_run() -> None:
    for case in load_cases():
        scenario = scenario_of(case)
        if case.cars:
            assert len(scenario.train[0].vehicles) == case.cars
        if case.spans:
            assert len(scenario.line.spans) == case.spans
        if case.start is not None:
            assert {train.start for train in scenario.train} == {case.start}
        times = [train.start_time for train in scenario.train]
        assert times == [times[0] + case.headway * number for number in range(case.trains)]
        for name, value in case.solution.items():
            assert getattr(scenario.solution, name) == value


@pytest.mark.parametrize("power", [0.5, 1.0, 2.0])
def test_growth_recovers_the_exponent_per_simulated_second(power: float) -> None:
    empty = Result("", "", 0, 1e-5, 1.0, 1.0, 1.0, 1.0, 0.0, 0)
    sizes = [1.0, 2.0, 4.0, 8.0]
    results = [replace(empty, simulated=size, cpu=3 * size * size**power) for size in sizes]
    assert growth(results, sizes) == pytest.approx(power, abs=1e-12)


def test_errors_are_relative_to_the_truths_deviation_and_match_by_time() -> None:
    # the truth has twice the rate; a 3 % larger sine is 3 % of its peak away
    time = np.arange(40_000) * 1e-5
    wave = np.sin(2 * np.pi * 100 * time)[:, None]
    truth = _Signals(1e-5, 5.0 + wave, wave)
    own = _Signals(2e-5, 5.0 + wave[::2], 1.03 * wave[::2])
    force, acceleration = _errors(own, truth)
    assert force < 1e-3  # what is left of the filters' start-up
    assert acceleration == pytest.approx(0.03, abs=1e-3)
    off_line = _Signals(2e-5, np.full((20_000, 1), math.nan), wave[::2])
    assert math.isnan(_errors(off_line, truth)[0])


def test_a_case_with_an_unknown_entry_is_refused() -> None:
    with pytest.raises(TypeError, match="speeed"):
        Case(name="x", group="y", scenario="demo", speeed=3)  # type: ignore[call-arg]
