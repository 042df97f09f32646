"""Energies over any interval of time."""

import numpy as np
import pytest

from trackvib_ros.detection import Catalogue
from trackvib_ros.detection.passage_scan import Scanned, _alone
from trackvib_ros.detection.pattern import Integral, Match, Trace, lasting
from trackvib_ros.detection.place import Wave
from trackvib_ros.detection.strength import strong, strong_interval


@pytest.mark.parametrize("gap", [0.0, 7.0])
def test_integral_of_bins(gap):
    rng = np.random.default_rng(1)
    # stamps in whole ns, a step that is none; with and without a gap between bins
    edges = np.round(1e9 * np.arange(2001) / 1023.7) * 1e-9 + np.where(
        np.arange(2001) > 900, gap, 0
    )
    value = rng.chisquare(2, 2000)
    exact = np.concatenate([[0.0], np.cumsum(value * np.diff(edges))])
    at = rng.uniform(edges[0] - 1, edges[-1] + 1, (3, 500))
    # linear between edges; equal bins are taken as such, 1 ns of 1 ms away from their edges
    np.testing.assert_allclose(
        Integral(edges, value)(at), np.interp(at, edges, exact), rtol=1e-6, atol=2e-8
    )


def test_levels_of_successive_intervals():
    rng = np.random.default_rng(2)
    time = 0.001 * np.arange(3000)
    trace = Trace("a", 0.0, time, rng.chisquare(2, 3000), np.ones(3000, bool), 0.1, 0.001)
    edges = np.linspace(-0.2, 3.3, 80)
    np.testing.assert_allclose(
        trace.levels(edges), trace.level(edges[:-1], edges[1:]), rtol=1e-9, atol=1e-12
    )


def test_one_loud_bin_beside_a_hole_is_not_strong():
    """Noise with holes of 60 ms that end in one bin of ten times its level: one bin in 40 ms of ten
    degrees of freedom each tells nothing. A train of ten times the level is strong for as long as
    it lasts, holes or not."""
    rng, step, holes = np.random.default_rng(4), 0.001, np.arange(300, 9000, 200)
    time = step * np.arange(10_000)
    valid = np.ones(time.size, dtype=bool)
    for start in holes:
        valid[start : start + 60] = False
    energy = rng.chisquare(1, time.size)
    energy[holes - 1] = energy[holes + 60] = 10.0
    train = (time > 4.0) & (time < 6.0)
    quiet = Trace("a", 0.0, time, energy, valid, 1.0, step)
    loud = Trace("a", 0.0, time, energy * np.where(train, 10.0, 1.0), valid, 1.0, step)
    assert not strong(quiet, 500.0, (0.0, 10.0)).any()
    found = strong_interval(loud, 500.0, (0.0, 10.0))
    assert found == pytest.approx((4.0, 6.0), abs=0.09)
    at = rng.uniform(0.0, 9.9, 50)
    inside = (time[:, None] >= at + step) & (time[:, None] < at + 0.1 - step)
    mean = np.sum(energy[:, None] * (inside & valid[:, None]), axis=0)
    mean /= np.maximum(np.sum(inside & valid[:, None], axis=0), 1)
    np.testing.assert_allclose(quiet.shown(at, at + 0.1), mean, rtol=0.5)


def test_blows_do_not_last():
    """Blows of up to 20 ms, 10 ms apart from what is quiet, vanish; a wheelset's 0.9 dB/m stays."""
    step, rng = 0.001, np.random.default_rng(3)
    time = step * np.arange(4000)
    hum = 1.0 + 100 * 10 ** (-0.09 * 50.0 * np.abs(time - 2.0))
    blows = np.zeros(time.size)
    for start in range(100, 3900, 60):
        blows[start : start + rng.integers(1, 21)] = 1e4 * rng.random()
    rest = lasting(hum + blows, step)
    # what a slope of 0.9 dB/m at 50 m/s makes of the window of 40 ms and the mean over 10 ms
    slack = 10 ** (0.09 * 50.0 * 0.05)
    assert np.all(rest < slack * hum) and np.all(rest > hum / slack)
    np.testing.assert_array_equal(lasting(np.full(500, 3.0), step), 3.0)


def test_a_wrong_clock_is_asked_of_one_type():
    """Two channels that look most like a type each, and less like the same one."""
    types = Catalogue.default()
    zero = np.zeros(1)
    trace = Trace("a", 0.0, zero, zero, zero == 0, 1.0, 1.0)
    wave = Wave(zero, zero, zero == 0)

    def scanned(**scores):
        matches = [
            Match(score, types[name], False, 0.0, 0.0, 60.0, 0.0) for name, score in scores.items()
        ]
        return Scanned(trace, trace, wave, (5.0, 150.0), (0.0, 1.0), (0.8, 1.2), matches)

    channels = [scanned(CRH3=0.9, metro=0.6), scanned(CRH5=0.9, metro=0.5)]
    assert _alone(channels) == pytest.approx(0.5 * (np.log(0.64) + np.log(0.75)))
    assert _alone([scanned(CRH3=0.9), scanned(CRH5=0.9)]) == 0.0
