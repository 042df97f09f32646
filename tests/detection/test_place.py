"""Places of wheelsets from their deflection, against pulses whose place is known."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import signal

from trackvib_ros.detection import Catalogue
from trackvib_ros.detection.blind import _bent
from trackvib_ros.detection.kinematics import Motion
from trackvib_ros.detection.place import Wave, agreement, classes, likelihood, locate, spectrum

AXLES = Catalogue.default()["CRH3"].axles
RATE = 1000.0


def wave(
    speed,
    error,
    noise,
    seed,
    beta=1.0,
    coupling=0.0,
    sign=1.0,
    acceleration=0.0,
    axles=AXLES,
):
    """Pulses of a beam on an elastic foundation, ``error`` m behind the expected places."""
    rng = np.random.default_rng(seed)
    motion = Motion(4.0, 0.0, speed, acceleration, np.eye(3))
    time = np.arange(0.0, 8.0 + 1.3 * AXLES[-1] / speed, 1 / RATE)
    x = beta * np.abs(motion.distance_at(time)[:, None] - axles - error)
    value = sign * np.sum(np.exp(-x) * (np.cos(x) - np.sin(x)), axis=1)
    if coupling:
        taps = signal.butter(1, coupling, "highpass", fs=RATE)
        value = signal.lfilter(*taps, value)
    value = value + noise * rng.standard_normal(time.size)
    return Wave(time, value, np.ones(time.size, dtype=bool)), motion


def placed(tables, scales):
    """Shifts of the channels and their standard deviations (m)."""
    shift, covariance = locate(tables, scales)
    return shift, np.sqrt(np.diag(covariance))


@pytest.mark.parametrize("speed", [12.0, 30.0, 90.0])
@pytest.mark.parametrize("acceleration", [0.0, 0.3])
def test_a_clean_pulse_is_placed_within_a_centimetre(speed, acceleration):
    for beta in (0.8, 1.3):  # soft and stiff pads: k0 = 2**0.5 beta
        given, motion = wave(speed, 0.37, 0.0, 0, beta, sign=-1.0, acceleration=acceleration)
        shift, sigma = placed([likelihood(given, motion, AXLES)], np.array([0.5]))
        # the unknown coupling may lead by half of what its mean edge of 1.5 Hz would do
        assert abs(shift[0] - 0.37) < 0.01 + 0.02 * 12.0 / speed
        assert sigma[0] < 0.03


@pytest.mark.parametrize("error", [-1.9, 1.9])
def test_a_channel_is_placed_though_its_energies_are_most_of_a_wheelbase_off(error):
    for seed in range(4):
        given, motion = wave(45.0, error, 1.0, seed)
        shift, sigma = placed([likelihood(given, motion, AXLES)], np.array([0.07]))
        # the deflection of the next wave, 1.2 m off, was told for it where the search ended
        assert abs(shift[0] - error) < 3 * sigma[0] < 0.15


def test_the_lead_of_an_ac_coupling_is_taken_out():
    given, motion = wave(16.0, 0.0, 0.02, 0, coupling=2.0)
    shift, sigma = placed([likelihood(given, motion, AXLES)], np.array([0.5]))
    # at 3 m of wavelength 2 Hz lead by atan(2 / 5.3) x 3 m / 2 pi = 0.17 m
    assert abs(shift[0]) < 2 * sigma[0] < 0.08


def test_stated_sigma_holds_in_noise():
    ratios = []
    for seed in range(60):
        rng = np.random.default_rng(1000 + seed)
        error, speed = rng.uniform(-0.4, 0.4), rng.uniform(15.0, 90.0)
        given, motion = wave(speed, error, rng.uniform(0.5, 4.0), seed, coupling=1.0)
        shift, sigma = placed([likelihood(given, motion, AXLES)], np.array([0.5]))
        ratios.append((shift[0] - error) / sigma[0])
    # 60 draws: the rms of unit normals lies within 1 +- 3 / sqrt(120)
    assert 0.73 < np.sqrt(np.mean(np.square(ratios))) < 1.27


def test_what_the_coupling_leaves_in_doubt_is_no_part_of_a_distance():
    """Two channels before the same coupling, of unknown edge, on their way to one distance."""
    ratios, single = [], []
    for seed in range(40):
        rng = np.random.default_rng(5000 + seed)
        errors, speed = rng.uniform(-0.2, 0.2, 2), rng.uniform(10.0, 40.0)
        noise, coupling = rng.uniform(0.05, 1.0), rng.uniform(0.5, 2.5)
        given = [wave(speed, e, noise, 2 * seed + k, 1.0, coupling) for k, e in enumerate(errors)]
        tables = [likelihood(one, motion, AXLES) for one, motion in given]
        shift, covariance = locate(tables, np.full(2, 0.5))
        apart = covariance[0, 0] + covariance[1, 1] - 2 * covariance[0, 1]
        ratios.append((np.diff(shift)[0] - np.diff(errors)[0]) / np.sqrt(apart))
        single.append(np.sqrt(apart / (covariance[0, 0] + covariance[1, 1])))
    # 40 draws: the rms of unit normals lies within 1 +- 3 / sqrt(80)
    assert 0.66 < np.sqrt(np.mean(np.square(ratios))) < 1.34
    # more than half of the variance of either place is common to both
    assert np.median(single) ** 2 < 0.5


def test_noise_alone_tells_nothing():
    rng = np.random.default_rng(0)
    time = np.arange(0.0, 12.0, 1 / RATE)
    empty = Wave(time, rng.standard_normal(time.size), np.ones(time.size, dtype=bool))
    motion = Motion(4.0, 0.0, 30.0, 0.0, np.eye(3))
    _, sigma = placed([likelihood(empty, motion, AXLES)], np.array([0.5]))
    assert sigma[0] > 0.3


def test_a_channel_without_samples_keeps_its_prior():
    given, motion = wave(30.0, 0.3, 0.1, 0)
    silent = Wave(given.time, given.value, np.zeros(given.time.size, dtype=bool))
    tables = [likelihood(given, motion, AXLES), likelihood(silent, motion, AXLES)]
    shift, sigma = placed(tables, np.array([0.5, 0.07]))
    assert shift == pytest.approx([0.3, 0.0], abs=0.02)
    assert sigma[0] < 0.05 and 0.1 < sigma[1] < 0.25


def test_the_motion_is_corrected_with_the_stated_covariance():
    ratios = []
    half = 0.5 * AXLES[-1]
    for seed in range(30):
        rng = np.random.default_rng(2000 + seed)
        speed, noise = rng.uniform(15.0, 90.0), 10.0 ** rng.uniform(-1.0, 0.7)
        given, motion = wave(speed, rng.uniform(-0.3, 0.3), noise, seed, coupling=1.0)
        # both ends within 0.03 m, the middle within 0.015 m: most of what the noisiest tell
        known = np.array([0.3, 0.03, 0.03]) / np.array([1.0, half / speed, (half / speed) ** 2])
        true = 0.03 * rng.standard_normal(2)
        middle = motion.moved(float(motion.time_at(half)))
        motion = replace(middle, covariance=np.diag(known**2))
        along = AXLES / half - 1
        expected = AXLES - true[0] * along - 0.5 * true[1] * along**2
        found = agreement([given], motion, [expected])
        ratios.append(np.linalg.solve(np.linalg.cholesky(found.covariance), found.change - true))
        assert np.max(np.diag(found.covariance)) < 0.031**2
    # 60 numbers: the rms of unit normals lies within 1 +- 3 / sqrt(120)
    assert 0.73 < np.sqrt(np.mean(np.square(ratios))) < 1.27


def by_class(speed, seed, axles, noise):
    """The same rough rail under every wheelset, whose neighbours shift it, waves by waves, by 5 mm."""
    rng = np.random.default_rng(seed)
    size = 2**14
    k = 2 * np.pi * np.fft.rfftfreq(size, speed / RATE)
    about = np.fft.rfft(rng.standard_normal(size) * np.exp(-np.arange(size) * speed / RATE))
    waves = 3 * about / np.std(about[(k > 1) & (k < 30)]) * (k > 1) * (k < 30)
    alike, comb = classes(axles), np.zeros(k.size, dtype=complex)
    for first in range(0, 30, 5):
        part = (k >= first) & (k < first + 5)
        at = 4 * speed + axles + 0.005 * rng.standard_normal(alike.max() + 1)[alike]
        comb[part] = np.exp(-1j * np.outer(k[part], at)).sum(axis=1)
    value = np.fft.irfft(waves * comb, size)
    value = value / np.std(value) + noise * rng.standard_normal(size)
    motion = Motion(4.0, 0.0, speed, 0.0, np.diag([1.0, 0.01, 1e-4]))
    return Wave(np.arange(size) / RATE, value, np.ones(size, dtype=bool)), motion


def test_trains_that_differ_by_centimetres_are_told_apart_as_surely_as_is_said():
    """Their bogies lie 6 mm nearer each other, as much as their neighbours shift them by."""
    twin = Catalogue.default()["CRH2"].axles
    kinds = (AXLES, AXLES + 0.2 * (twin * AXLES[-1] / twin[-1] - AXLES))
    right, probability = [], []
    for seed in range(40):
        true = seed % 2
        # at the least noise the classes hide more, at the most hardly anything is told
        noise = 10.0 ** np.random.default_rng(3000 + seed).uniform(-2.0, 1.0)
        given, motion = by_class(60.0, seed, kinds[true], noise)
        odds = np.diff([agreement([given], motion, [places]).log for places in kinds])[0]
        probability.append(1 / (1 + np.exp(-odds * (1 if true else -1))))
        right.append(probability[-1] > 0.5)
    said = np.maximum(probability, 1 - np.array(probability))
    # the number of right answers scatters by the root of the sum of p (1 - p)
    spread = np.sqrt(np.sum(said * (1 - said)))
    assert abs(np.sum(right) - np.sum(said)) < 3 * spread
    assert np.sum(right) > 30 and np.mean(said) > 0.75


@pytest.mark.parametrize("places", [-AXLES, 0 * AXLES, np.nan * AXLES])
def test_places_of_no_train_agree_with_nothing(places):
    given, motion = wave(30.0, 0.0, 0.1, 0)
    assert agreement([given], motion, [places]).log == 0.0


def heard(speed, seed, axles=AXLES):
    """Every wheelset on the same rough rail: the same waveform again and again, 0.2 to 1 m long."""
    rng = np.random.default_rng(seed)
    motion = Motion(4.0, 0.0, speed, 0.0, np.eye(3))
    time = np.arange(0.0, 8.0 + 1.3 * AXLES[-1] / speed, 1 / RATE)
    near = np.arange(-3.0, 3.0, 0.02)
    rough = signal.sosfilt(
        signal.butter(2, [6.0, 30.0], "bandpass", fs=2 * np.pi / 0.02, output="sos"),
        rng.standard_normal(near.size),
    )
    rough *= np.exp(-np.abs(near)) / np.std(rough)
    x = motion.distance_at(time)[:, None] - axles
    bent = np.exp(-np.abs(x)) * (np.cos(x) - np.sin(np.abs(x)))
    value = np.sum(3 * np.interp(x, near, rough, 0.0, 0.0) + 3 * bent, axis=1)
    return time, value + 0.3 * rng.standard_normal(time.size), motion


TWIN = Catalogue.default()["CRH2"].axles * AXLES[-1] / Catalogue.default()["CRH2"].axles[-1]


@pytest.mark.parametrize("low", [1.0, 0.4])
def test_clipped_samples_still_tell_trains_that_differ_by_centimetres(low):
    """Zero crossings stay where they are (Van Vleck & Middleton, Proc. IEEE 54, 1966)."""
    for seed in range(8):
        kinds = (AXLES, TWIN) if seed % 2 else (TWIN, AXLES)
        time, value, motion = heard(30.0 + 7.0 * seed, seed, kinds[0])
        top = 0.2 * np.max(np.abs(value))
        cut = Wave(time, np.clip(value, -low * top, top), np.ones(time.size, dtype=bool), True)
        right, wrong = (agreement([cut], motion, [places]).log for places in kinds)
        assert right > max(wrong, 0.0) + 10.0


def test_wheelsets_in_a_hole_do_not_count_against_a_train():
    """Half of the train is missing."""
    for seed in range(6):
        time, value, motion = heard(50.0, 50 + seed)
        measured = np.ones(time.size, dtype=bool)
        for start in np.random.default_rng(seed).uniform(4.0, 8.0, 20):
            measured &= (time < start) | (time > start + 0.14)
        holed = Wave(time, np.where(measured, value, 5.0), measured)
        right, wrong = (agreement([holed], motion, [places]).log for places in (AXLES, TWIN))
        assert right > max(wrong, 0.0) + 10.0


def test_holes_are_filled_with_what_other_wheelsets_show():
    """A sixth of the waveform is missing, in holes of 2 m, against straight lines in these."""
    for seed in range(3):
        given, motion = wave(30.0, 0.2, 0.0, 0)
        measured = np.ones(given.time.size, dtype=bool)
        for start in np.random.default_rng(seed).uniform(3.0, 12.0, 26):
            measured &= (given.time < start) | (given.time > start + 0.06)
        bridged = np.interp(given.time, given.time[measured], given.value[measured])
        (_, seen, _), (_, line, _), (_, true, _) = (
            spectrum(w, motion, AXLES)
            for w in (
                Wave(given.time, np.where(measured, given.value, 9.0), measured),
                Wave(given.time, bridged, given.valid),
                given,
            )
        )
        error, before = (float(np.sum(np.abs(x - true) ** 2)) for x in (seen, line))
        # waves beyond 2 pi m are not asked for and not filled: a third of the error is theirs
        assert error < 0.5 * before


def test_the_acceleration_of_an_unlisted_train_is_how_its_way_between_channels_grows():
    ratios, sigmas = [], []
    for seed in range(20):
        rng = np.random.default_rng(6000 + seed)
        speed, noise = rng.uniform(30.0, 60.0), 10.0 ** rng.uniform(-1.0, 0.5)
        true = Motion(4.0, 0.0, speed, 0.3 * rng.standard_normal(), np.eye(3))
        time = np.arange(0.0, 6.0 + AXLES[-1] / speed, 1 / RATE)
        # wheelsets, by both channels, are placed to 2 cm only
        places = AXLES + 0.02 * rng.standard_normal(AXLES.size)
        pair = []
        for x in (0.0, 20.0):
            at = np.abs(true.distance_at(time)[:, None] - AXLES - x)
            value = np.sum(np.exp(-at) * (np.cos(at) - np.sin(at)), axis=1)
            value = value + noise * rng.standard_normal(time.size)
            given = Wave(time, value, np.ones(time.size, dtype=bool))
            pair.append(
                SimpleNamespace(channel=SimpleNamespace(x=x), wave=lambda given=given: given)
            )
        # the delay as a whole tells the acceleration to 0.05 m/s², and the speed of the middle
        middle = true.moved(float(true.time_at(0.5 * AXLES[-1] + 10.0)))
        thought = replace(middle, acceleration=true.acceleration + 0.05 * rng.standard_normal())
        known = thought.distance_at(true.time_at(places))
        found = _bent(*pair, thought, 1, known)
        ratios.append((found.acceleration - true.acceleration) / found.acceleration_sigma)
        sigmas.append(found.acceleration_sigma)
    # 20 draws: the rms of unit normals lies within 1 +- 3 / sqrt(40)
    assert 0.52 < np.sqrt(np.mean(np.square(ratios))) < 1.48
    assert np.median(sigmas) < 0.1
