"""Explanations of wheelset times whose truth is drawn from the model itself."""

import numpy as np
import pytest

from trackvib_ros.detection import Catalogue
from trackvib_ros.detection.axles import AxleFit, refit
from trackvib_ros.detection.evidence import LISTED, Candidate, explain, half_interval
from trackvib_ros.detection.kinematics import regress

CATALOGUE = Catalogue.default()
SPEED, BASELINE, NOISE = 60.0, 20.0, 0.02


def candidate(
    nominal, true, offsets=(0.0, 0.0), channels=2, seed=0, noise=NOISE, place=0.1, site=0.0
):
    """A type of ``nominal`` places fitted to the times of a train of ``true`` ones."""
    rng = np.random.default_rng(seed)
    shifts = BASELINE * np.arange(channels)
    time = (true[None, :] + shifts[:, None]) / SPEED + np.array(offsets)[:channels, None]
    time = time + noise / SPEED * rng.standard_normal(time.shape)
    seen = np.ones(time.shape, dtype=bool)
    channel = np.nonzero(seen)[0]
    # the second channel is aligned where its pattern was seen, as in a passage
    scale = nominal[-1] / true[-1]
    seen_shift = scale * SPEED * (time[:, 0] - time[0, 0])
    seen_place = (nominal[None, :] + seen_shift[:, None])[seen]
    fit = regress(time[seen], seen_place, channel, float(time.mean()))
    zeros = np.zeros(time.shape)
    residual = zeros.copy()
    residual[seen] = fit.residual
    placed = place**2 * np.eye(channels)
    axle_fit = AxleFit(fit.motion, fit.scale, time, residual, zeros, seen, fit.offset, placed)
    free = site**2 * (np.eye(channels) + 1.0)
    free[0] = free[:, 0] = 0.0
    return Candidate(nominal, shifts, axle_fit, 0.9, free)


def test_acceleration_holds_though_the_ends_of_a_train_lack_neighbours():
    axles = CATALOGUE["CRH3"].axles
    lack = np.exp(-np.minimum(axles, axles[-1] - axles) / 12.0)
    ratios = []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        shown = axles + 0.01 * lack * rng.standard_normal(axles.size)
        found = explain([candidate(axles, shown, channels=1, seed=seed, noise=0.003)])
        motion = next(e.motion for e in found if e.kind == "type")
        ratios.append(motion.acceleration / motion.acceleration_sigma)
    # 100 draws: the rms of unit normals lies within 1 +- 3 / sqrt(200)
    assert 0.79 < np.sqrt(np.mean(np.square(ratios))) < 1.21


def test_a_listed_train_is_its_type():
    axles = CATALOGUE["CRH3"].axles
    best = explain([candidate(axles, axles)])[0]
    assert best.kind == "type" and best.probability > 0.95
    middle = 0.5 * axles[-1] / SPEED
    # 64 wheelsets of 2 cm over 193 m: the regression's sigma, 4 of them
    error = abs(float(best.motion.speed_at(middle)) - SPEED)
    assert error < 4 * best.motion.speed_sigma(middle) < 1e-3 * SPEED


@pytest.mark.parametrize("size", [0.92, 0.94, 1.06])
def test_an_unlisted_size_is_told_by_the_delay_of_two_channels(size):
    axles = CATALOGUE["CRH3"].axles
    best = explain([candidate(axles, size * axles)])[0]
    assert best.kind in ("scaled", "varied")
    sigma = best.motion.speed_sigma(best.motion.epoch)
    # places known to 0.1 m each over 20 m: 0.71 %
    assert sigma / SPEED == pytest.approx(2**0.5 * 0.1 / BASELINE, rel=0.15)
    assert abs(best.motion.speed - SPEED) < 3 * sigma


def test_other_gaps_are_told_on_one_channel():
    own, nearest = CATALOGUE["metro"].axles, CATALOGUE["metro_A6"].axles
    best = explain([candidate(nearest, own, channels=1)])[0]
    assert best.kind == "varied"
    # the types differ by 17 % in size, which one channel cannot see: its sigma must say so
    assert abs(best.motion.speed - SPEED) < 3 * best.motion.speed_sigma(best.motion.epoch)


def test_a_train_of_free_size_does_not_shrink_with_noise():
    axles = CATALOGUE["CRH3"].axles
    shifts = []
    for seed in range(20):
        parts = explain([candidate(axles, axles, channels=1, seed=seed)])
        (scaled,) = [e for e in parts if e.kind == "scaled"]
        shifts.append(scaled.motion.speed / SPEED - 1)
    # 4 % is the prior of the size; were the nominal places the regressor, the speed would come out
    # 32 wheelsets x 0.04² = 5 % low
    assert abs(np.mean(shifts)) < 0.2 * 0.04


def test_bogies_that_lean_are_no_unlisted_train():
    """A bogie is seen nearer to, or further from, the bogie it shares a coupling with."""
    axles = CATALOGUE["CRH3x2"].axles
    lean = np.where((np.arange(axles.size) // 2) % 2 == 0, -0.015, 0.015)
    listed = [
        sum(e.probability for e in explain([trial]) if e.kind == "type")
        for trial in (
            candidate(axles, axles + lean, channels=1, noise=0.005, seed=seed) for seed in range(6)
        )
    ]
    # 15 mm are common on bridges; as a gap that differs they make a relative four times as likely
    assert np.mean(listed) > 0.7


def test_a_wrong_clock_is_no_unlisted_train():
    axles = CATALOGUE["CRH3"].axles
    best = explain([candidate(axles, axles, offsets=(0.0, 0.1))])[0]
    assert (best.kind, best.channel) == ("clock", 1)
    assert best.motion.speed == pytest.approx(SPEED, rel=1e-3)


@pytest.mark.parametrize("off", [0.5, 1.0, -2.0, 4.0])
def test_a_misstated_distance_keeps_the_type_in_the_mixture(off):
    axles = CATALOGUE["CRH3"].axles
    found = explain([candidate(axles, axles, offsets=(0.0, off / SPEED), place=0.02)])
    parts = [(e.probability, e.motion.speed, e.motion.covariance[1, 1] ** 0.5) for e in found]
    mean = sum(p * v for p, v, _ in parts)
    assert abs(SPEED - mean) < half_interval(parts, mean)
    listed = next(e for e in found if e.kind in LISTED)
    # of these the pattern tells the speed: 2 cm of 64 wheelsets over 193 m
    assert listed.motion.speed == pytest.approx(SPEED, rel=1e-3)
    # no relative of the type is a fifth larger
    assert found[0].kind in LISTED or abs(off) < 4


def test_what_a_delay_cannot_decide_stays_open():
    """A relative of the type, or the type before a sensor that is elsewhere: both are possible."""
    axles = CATALOGUE["CRH3"].axles
    found = explain([candidate(axles, 0.98 * axles, place=0.02)])
    listed = sum(e.probability for e in found if e.kind in LISTED)
    assert 0.02 < listed < 0.98


def test_interval_of_a_mixture():
    assert half_interval([(1.0, 5.0, 2.0)], 5.0) == pytest.approx(1.959964 * 2.0, rel=1e-6)
    # a part of 4 % far away is outside, one of 20 % inside
    near, far = (0.96, 0.0, 1e-6), (0.04, 1.0, 1e-6)
    assert half_interval([near, far], 0.0) < 1e-4
    assert half_interval([(0.8, 0.0, 1e-6), (0.2, 1.0, 1e-6)], 0.0) == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize(("place", "channels"), [(0.02, 2), (0.02, 1), (0.1, 2)])
def test_types_of_one_shape_are_told_by_the_distance_between_channels(place, channels):
    own = CATALOGUE["CRH3"].axles
    twin = 1.009 * own  # CRH2 but for 3 cm in its bogie centres
    odds = []
    for seed in range(10):
        common = {"channels": channels, "seed": seed, "place": place}
        found = explain([candidate(twin, own, **common), candidate(own, own, **common)])
        types = {e.candidate: e.probability for e in found if e.kind == "type"}
        odds.append(np.log(types[1] / types[0]))
    # the distance would be 0.009 x 20 m off, and is known to 2**0.5 x place
    expected = 0.5 * (0.009 * BASELINE) ** 2 / (2 * place**2) if channels == 2 else 0.0
    assert np.mean(odds) == pytest.approx(expected, rel=0.15, abs=0.4)


def test_an_uncertain_distance_between_channels_widens_the_speed_of_an_unlisted_train():
    axles = CATALOGUE["CRH3"].axles
    best = explain([candidate(axles, 0.94 * axles, place=0.02, site=0.05)])[0]
    sigma = best.motion.speed_sigma(best.motion.epoch)
    assert sigma / SPEED == pytest.approx(2**0.5 * np.hypot(0.02, 0.05) / BASELINE, rel=0.15)


@pytest.mark.parametrize("place", [0.03, 0.2])
def test_wheelsets_of_a_channel_whose_deflection_places_it_do_not_scatter(place):
    """A channel seems 0.9 m from where its pattern was first seen; a few pulses are mistaken."""
    axles = CATALOGUE["metro"].axles
    fit = candidate(axles, axles, offsets=(0.0, 0.9 / SPEED), place=place).fit
    fit.time[:, ::6] += 1.0 / SPEED
    scale = refit(fit, [axles, axles + BASELINE]).scale
    # told by the deflection it is where it is; by energies alone, 0.1 m, it is six sigma off
    assert scale < 0.04 if place < 0.1 else scale > 0.2
