"""Places of wheelsets from their deflection, against pulses whose place is known."""

import numpy as np
import pytest
from scipy import signal

from trackvib_ros.detection import Catalogue
from trackvib_ros.detection.kinematics import Motion
from trackvib_ros.detection.place import Wave, likelihood, locate

AXLES = Catalogue.default()["CRH3"].axles
RATE = 1000.0


def wave(speed, error, noise, seed, beta=1.0, coupling=0.0, sign=1.0, acceleration=0.0):
    """Pulses of a beam on an elastic foundation, ``error`` m behind the expected places."""
    rng = np.random.default_rng(seed)
    motion = Motion(4.0, 0.0, speed, acceleration, np.eye(3))
    time = np.arange(0.0, 8.0 + 1.3 * AXLES[-1] / speed, 1 / RATE)
    x = beta * np.abs(motion.distance_at(time)[:, None] - AXLES - error)
    value = sign * np.sum(np.exp(-x) * (np.cos(x) - np.sin(x)), axis=1)
    if coupling:
        taps = signal.butter(1, coupling, "highpass", fs=RATE)
        value = signal.lfilter(*taps, value)
    value = value + noise * rng.standard_normal(time.size)
    return Wave(time, value, np.ones(time.size, dtype=bool)), motion


@pytest.mark.parametrize("speed", [12.0, 30.0, 90.0])
@pytest.mark.parametrize("acceleration", [0.0, 0.3])
def test_a_clean_pulse_is_placed_within_a_centimetre(speed, acceleration):
    for beta in (0.8, 1.3):  # soft and stiff pads: k0 = 2**0.5 beta
        given, motion = wave(speed, 0.37, 0.0, 0, beta, sign=-1.0, acceleration=acceleration)
        shift, sigma = locate([likelihood(given, motion, AXLES)], np.array([0.5]))
        # the unknown coupling may lead by half of what its mean edge of 1.5 Hz would do
        assert abs(shift[0] - 0.37) < 0.01 + 0.02 * 12.0 / speed
        assert sigma[0] < 0.03


def test_the_lead_of_an_ac_coupling_is_taken_out():
    given, motion = wave(16.0, 0.0, 0.02, 0, coupling=2.0)
    shift, sigma = locate([likelihood(given, motion, AXLES)], np.array([0.5]))
    # at 3 m of wavelength 2 Hz lead by atan(2 / 5.3) x 3 m / 2 pi = 0.17 m
    assert abs(shift[0]) < 2 * sigma[0] < 0.08


def test_stated_sigma_holds_in_noise():
    ratios = []
    for seed in range(60):
        rng = np.random.default_rng(1000 + seed)
        error, speed = rng.uniform(-0.4, 0.4), rng.uniform(15.0, 90.0)
        given, motion = wave(speed, error, rng.uniform(0.5, 4.0), seed, coupling=1.0)
        shift, sigma = locate([likelihood(given, motion, AXLES)], np.array([0.5]))
        ratios.append((shift[0] - error) / sigma[0])
    # 60 draws: the rms of unit normals lies within 1 +- 3 / sqrt(120)
    assert 0.73 < np.sqrt(np.mean(np.square(ratios))) < 1.27


def test_noise_alone_tells_nothing():
    rng = np.random.default_rng(0)
    time = np.arange(0.0, 12.0, 1 / RATE)
    empty = Wave(time, rng.standard_normal(time.size), np.ones(time.size, dtype=bool))
    motion = Motion(4.0, 0.0, 30.0, 0.0, np.eye(3))
    _, sigma = locate([likelihood(empty, motion, AXLES)], np.array([0.5]))
    assert sigma[0] > 0.3


def test_a_channel_without_samples_keeps_its_prior():
    given, motion = wave(30.0, 0.3, 0.1, 0)
    silent = Wave(given.time, given.value, np.zeros(given.time.size, dtype=bool))
    tables = [likelihood(given, motion, AXLES), likelihood(silent, motion, AXLES)]
    shift, sigma = locate(tables, np.array([0.5, 0.07]))
    assert shift == pytest.approx([0.3, 0.0], abs=0.02)
    assert sigma[0] < 0.05 and 0.1 < sigma[1] < 0.25
