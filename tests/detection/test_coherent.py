"""Wheelsets from their deflection under blows of wheel flats, against places that are known."""

import numpy as np
import pytest
from scipy import signal

from trackvib_ros.detection import Catalogue
from trackvib_ros.detection.coherent import wheelsets
from trackvib_ros.detection.kinematics import Motion
from trackvib_ros.detection.place import Wave

AXLES = Catalogue.default()["CRH3"].axles
APART = (0.0, 20.0)
TIME = np.arange(0.0, 14.0, 0.001)


def passage(speed, acceleration, noise, seed, blow=0.0, places=APART):
    """Deflection of two rails (1 at its peak), flats on two wheelsets, white noise."""
    rng = np.random.default_rng(seed)
    motion = Motion(4.0, 0.3, speed, acceleration, np.eye(3))
    waves = []
    for apart in places:
        x = np.abs(motion.distance_at(TIME)[:, None] - AXLES - apart)
        value = np.sum(np.exp(-x) * (np.cos(x) - np.sin(x)), axis=1)
        for flat in AXLES[[3, 17]]:
            # a blow every turn of 2.7 m, 0.15 /m weaker with distance, ringing at 300 Hz for 5 ms
            for turn in range(-30, 30):
                struck = flat + apart + 0.9 + 2.7 * turn
                t = TIME - motion.time_at(struck)
                ring = np.where(t > 0, np.exp(-np.maximum(t, 0) / 0.005), 0.0)
                value += blow * np.exp(-0.15 * abs(2.7 * turn)) * ring * np.sin(600 * np.pi * t)
        value += noise * rng.standard_normal(TIME.size)
        sos = signal.bessel(2, 100.0, "low", norm="mag", fs=1000.0, output="sos")
        waves.append(Wave(TIME, signal.sosfiltfilt(sos, value), np.ones(TIME.size, dtype=bool)))
    return waves, motion


PLACES = [AXLES + apart for apart in APART]


@pytest.mark.parametrize("speed", [25.0, 60.0, 95.0])
def test_the_motion_is_found_from_a_start_that_is_metres_off(speed):
    # blows of twenty times the deflection
    waves, motion = passage(speed, 0.4, 0.2, 0, blow=20.0)
    start = Motion(4.0, 0.3 + 0.8, 1.006 * speed, 0.3, np.eye(3))
    assert np.max(np.abs(start.distance_at(motion.time_at(AXLES)) - AXLES)) > 0.8
    found = wheelsets(waves, PLACES, start)
    late = [found.motion.distance_at(motion.time_at(own)) - own for own in PLACES]
    # one step each: 0.15 m at the ends and 0.1 m of the whole
    assert np.max(np.abs(late)) < 0.25


def test_rails_may_be_half_a_kilometre_apart():
    """A bend of metres within the train is one of 70 m on the way, more than the waveform has."""
    apart = (0.0, 600.0)
    waves, motion = passage(95.0, 0.0, 0.2, 2, places=apart)
    places = [AXLES + x for x in apart]
    found = wheelsets(waves, places, motion)
    late = [found.motion.distance_at(motion.time_at(own)) - own for own in places]
    assert np.max(np.abs(late)) < 0.25


def test_braking_is_found_from_a_start_at_constant_speed():
    """A bend of 2.9 m: a pattern scanned at constant speed is 1.4 m off at the ends."""
    speed, braking = 33.0, -0.66
    waves, motion = passage(speed, braking, 0.2, 1)
    middle = float(motion.time_at(0.5 * AXLES[-1]))
    half = 0.5 * AXLES[-1]
    bend = -0.5 * braking * (half / speed) ** 2
    at = motion.moved(middle)
    start = Motion(middle, at.distance - 0.5 * bend, at.speed, 0.0, np.eye(3))
    found = wheelsets(waves, PLACES, start)
    late = [found.motion.distance_at(motion.time_at(own)) - own for own in PLACES]
    assert bend > 2.5
    # one step each: 0.15 m at the ends, 0.15 m of the bend, half of it there, 0.1 m of the whole
    assert np.max(np.abs(late)) < 0.325


def test_deviations_of_wheelsets_are_measured_and_their_sigma_holds():
    ratios = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        waves, motion = passage(rng.uniform(30, 90), 0.0, rng.uniform(0.2, 1.0), seed)
        ahead = 0.03 * rng.standard_normal(AXLES.size)
        found = wheelsets(waves, [own - ahead for own in PLACES], motion)
        left = found.motion.distance_at(motion.time_at(np.stack(PLACES))) - np.stack(PLACES)
        wrong = found.shift - ahead + left
        # the whole is for the likelihood of the place to find, with the lead of the coupling
        wrong -= wrong.mean(axis=1, keepdims=True)
        ratios.append(wrong / found.sigma[:, None])
    # 768 draws, and pulses 2.5 m apart are not quite independent
    assert 0.85 < np.sqrt(np.mean(np.square(ratios))) < 1.15


def test_noise_and_blows_without_deflection_are_not_taken_for_wheelsets():
    for seed in range(5):
        waves, motion = passage(40.0, 0.0, 1.0, seed)
        rng = np.random.default_rng(seed)
        empty = [Wave(w.time, rng.standard_normal(TIME.size), w.valid) for w in waves]
        assert wheelsets(empty, PLACES, motion) is None
