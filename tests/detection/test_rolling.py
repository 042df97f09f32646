"""Lengths of vehicles as a prior of speed: left out in turn, each is told with an honest sigma."""

import numpy as np
import pytest

from trackvib_ros.detection import rolling
from trackvib_ros.detection.single import Bogies, _posterior, bogies

DEFLECTION = 0.136  # relative sigma of the speed by the deflection of an untaught site
LIMITS = (1.0, 150.0)
SPEED = 40.0
WAGONS = np.array([base < 1.9 for base, _, _ in rolling.VEHICLES])


def told(lengths, locomotive=0.0, draws=4):
    """Relative errors and sigmas of the speed of trains of a vehicle (m), by their times."""
    rng = np.random.default_rng(0)
    for _ in range(draws):
        base, longer, shorter = (lengths + 0.042 * rng.standard_normal(3)) / SPEED
        stand = Bogies(base, 1.0, centres=(longer, shorter), locomotive=locomotive / SPEED)
        bowl = SPEED * np.exp(DEFLECTION * rng.standard_normal())
        speed, sigma, _ = _posterior(bowl, stand, (bowl, DEFLECTION), LIMITS)
        yield speed / SPEED - 1, sigma / speed


@pytest.fixture(scope="module")
def left_out():
    every = rolling._ln
    out = []
    for k, own in enumerate(every):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(rolling, "_ln", np.delete(every, k, axis=0))
            out.append(list(told(np.exp(own))))
    return np.array(out)  # (vehicles, draws, 2)


def test_a_vehicle_that_is_not_in_the_table_is_told_honestly(left_out):
    error, sigma = left_out[..., 0], left_out[..., 1]
    # 38 vehicles: the rms of as many ratios has a standard deviation of 0.12
    assert 0.75 < np.sqrt(np.mean((error / sigma) ** 2)) < 1.25
    assert np.mean(np.abs(error) < 1.96 * sigma) > 0.9
    # by the deflection alone half the errors are beyond 0.67 of its sigma
    assert np.median(np.abs(error)) < 0.5 * 0.67 * DEFLECTION


def test_a_locomotive_tells_wagons_from_coaches(left_out):
    error = left_out[WAGONS, :, 0]
    every = rolling._ln
    with_one = []
    for k in np.flatnonzero(WAGONS):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(rolling, "_ln", np.delete(every, k, axis=0))
            with_one.append([e for e, _ in told(np.exp(every[k]), 2.85)])
    assert np.sqrt(np.mean(np.square(with_one))) < 0.6 * np.sqrt(np.mean(error**2))


def test_lengths_of_a_train_are_found_with_bogies_missed():
    wagon = np.array([0.0, 1.8, 9.0, 10.8])
    axles = np.concatenate(
        [[0.0, 3.0, 9.9, 12.9], (18.0 + wagon + 14.04 * np.arange(10)[:, None]).ravel()]
    )
    axles = np.delete(axles, [10, 11, 21])
    stand = bogies(axles / SPEED)
    assert stand.base == pytest.approx(1.8 / SPEED)
    assert stand.centres == pytest.approx((9.0 / SPEED, 5.04 / SPEED))
    assert stand.locomotive == pytest.approx(3.0 / SPEED)
    articulated = bogies((np.array([0.0, 2.7]) + 16.0 * np.arange(6)[:, None]).ravel() / SPEED)
    assert articulated.centres == pytest.approx((16.0 / SPEED, 16.0 / SPEED))
    assert articulated.locomotive == 0.0
