"""Runs that forget trains which have left: the same results, constant columns."""

from typing import Any

import numpy as np
import pytest

from solver import InputError, Scenario, Simulation, build_scenario

MODELS: dict[str, dict[str, Any]] = {
    "modal": {"frequency_limit": 700.0, "step": 4e-4},
    "newmark": {
        "frequency_limit": 700.0,
        "step": 4e-4,
        "integrator": "newmark",
        "sines": [12, 4, 4, 4],
    },
    "hybrid": {"frequency_limit": 2840.0, "step": 1.75e-4, "model": "hybrid"},
}
WHEEL = {"preset": "wheel_element", "speed": 60.0, "start": 5.0}


def scenario(model: str, *trains: dict[str, Any]) -> Scenario:
    # stated sines go with an Euler-Bernoulli rail only
    theory = "euler_bernoulli" if model == "newmark" else "timoshenko"
    return build_scenario(
        {
            "track": {"rail": {"theory": theory}},
            "line": {"approach_left": 5.2, "spans": [5.2], "approach_right": 5.2},
            "train": trains,
            "irregularity": {"spectrum": "sato", "wavelength_min": 0.1},
            "channel": [{"name": "rail", "layer": "rail", "x": 7.0}],
            "solution": {"end_time": 0.96, **MODELS[model]},
        }
    )


@pytest.mark.parametrize("model", MODELS)
def test_what_a_later_train_does_is_the_same_to_the_bit(model: str) -> None:
    """The second leaves before the first, so that columns in the middle go; the third comes late."""
    case = scenario(
        model,
        WHEEL,
        {**WHEEL, "start": 17.0, "speed": 120.0, "direction": "backward"},
        {**WHEEL, "start": -26.0, "speed": 120.0, "start_time": 0.55},
    )
    whole, lasting = Simulation(case), Simulation(case, columns="present")
    shown, known, met = [], [], False
    for kept, block in zip(whole.blocks(97), lasting.blocks(97), strict=True):
        columns = block.wheelset_train
        shown.append(tuple(columns))
        known.append(tuple(lasting.motions))
        np.testing.assert_array_equal(block.acceleration, kept.acceleration)
        np.testing.assert_array_equal(block.wheelset_force, kept.wheelset_force[:, columns])
        np.testing.assert_array_equal(block.wheelset_position, kept.wheelset_position[:, columns])
        others = np.setdiff1d(kept.wheelset_train, columns)
        assert np.isnan(kept.wheelset_force[:, others]).all()
        met |= np.isfinite(kept.wheelset_force[:, 2]).any()
    assert met
    assert list(dict.fromkeys(shown)) == [(0, 1), (0, 1, 2), (0, 2), (2,), ()]
    assert list(dict.fromkeys(known)) == [(0, 1, 2), (0, 2), (2,), ()]
    assert lasting.end_index == whole.end_index


@pytest.mark.parametrize("model", MODELS)
def test_trains_without_end_keep_a_constant_number_of_columns(model: str) -> None:
    run = Simulation(scenario(model), columns="present")
    train = scenario("modal", {**WHEEL, "start": -30.0, "speed": 120.0}).train[0]
    samples = round(0.1 / (run.step_ns * 1e-9))
    for number in range(4):
        assert run.add_train(train, start_time=0.4 * number) == number
        met = False
        for _ in range(4):
            block = run.advance(samples)
            assert len(block.wheelset_train) <= 2
            assert len(run.motions) <= 2
            own = block.wheelset_force[:, block.wheelset_train == number]
            met |= np.isfinite(own).any()
        assert met


def test_a_train_that_the_hybrid_refuses_leaves_no_trace() -> None:
    run = Simulation(scenario("hybrid", WHEEL), columns="present")
    run.advance(10)
    flat = {**WHEEL, "start": -10.0, "flat": [{"wheelset": 1, "length": 0.03}]}
    with pytest.raises(InputError, match="flat"):
        run.add_train(scenario("modal", flat).train[0], start_time=0.1)
    assert list(run.motions) == [0]
    assert run.advance(10).wheelset_force.shape == (10, 1)
