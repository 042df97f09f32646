"""The delay between two rail channels by what both have seen of a train."""

from dataclasses import replace

import numpy as np
import pytest

from tests.detection.synthetic import CATALOGUE, RAILS, Passage, flat_blows, record
from trackvib_ros.detection.delay import find_delay, log_ratio
from trackvib_ros.detection.features import GroupStream
from trackvib_ros.detection.record import Record
from trackvib_ros.waveform import Waveform

RATE = 2000
LIMITS = (10.0, 115.0)
APART = (20.0, 0.0)


def records(samples, floor):
    """Both channels as records of the detector, noise of variance ``floor`` per sample."""
    step = round(1e9 / RATE)
    stream = GroupStream(tuple(c.name for c in RAILS), step, 20.0)
    stream.push(Waveform(0, step, stream.channels, samples.astype(np.float32)))
    stream.advance(10**12)
    out = []
    for row, channel in enumerate(RAILS):
        window = stream.window(row, 0, 10**12)
        width = np.array([high - low for low, high in window.bands])
        out.append(Record(channel, window, floor * width / (RATE / 2)))
    return out


def train(seed, kind, snr, seen, name=None, apart=APART, limit=np.inf):
    """A train of which ``seen`` metres have passed both channels, ``apart`` as is thought.

    Samples beyond ``limit`` of the largest are clipped.
    """
    rng = np.random.default_rng(seed)
    name = name or ("CRH3", "articulated", "metro", "locomotive_hauled")[seed % 4]
    direction = 1 if seed % 2 else -1
    truth = Passage(CATALOGUE[name].axles, rng.uniform(60, 360) / 3.6, direction=direction)
    signals = record([truth], RAILS, snr, seed=seed, rates={"rail": RATE}, kind=kind)
    samples = np.stack([signals[c.name][1] for c in RAILS], axis=1)
    samples = np.clip(samples, *(sign * limit * np.abs(samples).max() for sign in (-1, 1)))
    first = [truth.axle_times(c.x)[0] for c in RAILS]
    now = max(first) + seen / truth.speed
    quiet = samples[: round((min(first) - 0.5) * RATE)]
    both = records(samples[: round(now * RATE)], float(quiet.var()))
    return truth, find_delay(*both, (min(first) - 0.3, now), LIMITS, apart)


def test_the_ratio_is_one_on_average_without_a_correlation():
    # the density of r under no correlation, (1 - r²)^((n - 4) / 2), of n pairs less their means
    r = np.linspace(-1, 1, 20001)[1:-1]
    for n in (8, 20, 60):
        density = (1 - r**2) ** ((n - 4) / 2)
        density /= density.sum()
        mean = float(density @ np.exp(log_ratio(r, np.full(r.shape, float(n)))))
        # Jeffreys' form leaves out a factor 1 + O(1 / n); 20 steps of the correlation
        assert mean == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize(("kind", "seen"), [("pulse", 8.0), ("pulse", 45.0), ("burst", 45.0)])
def test_the_delay_tells_speed_and_direction_within_its_sigma(kind, seen):
    told = [train(seed, kind, 10, seen) for seed in range(12)]
    found = [(truth, delay) for truth, delay in told if delay is not None]
    assert len(found) >= 5  # others are told at a later trial
    assert all(delay.direction == truth.direction for truth, delay in found)
    z = [(delay.speed - truth.speed) / delay.sigma for truth, delay in found]
    rms = np.sqrt(np.mean(np.square(z)))
    # of five or more the rms lies between 0.33 and 1.74 at 98 % (chi squared)
    assert rms < 1.74
    # bursts have nothing in common but their places, which are drawn exactly as well
    assert rms > 0.33 or kind == "burst"
    relative = np.median([delay.sigma / delay.speed for _, delay in found])
    assert relative < (0.004 if kind == "pulse" else 0.015)  # 2 cm; 25 cm of 20 m


def test_the_sigma_in_noise_is_that_of_the_error():
    told = [train(seed, "pulse", 0, 45.0) for seed in range(24)]
    z = [(delay.speed - truth.speed) / delay.sigma for truth, delay in told if delay is not None]
    assert len(z) > 20
    # chi squared of 21 to 24 at 99 %: 0.62 to 1.41
    assert 0.62 < np.sqrt(np.mean(np.square(z))) < 1.41


def test_cars_as_long_as_the_channels_are_apart_are_not_taken_for_each_other():
    # a metro's 19.5 m on 20 m: the next car reaches both channels as if at once
    for seed in range(6):
        truth, delay = train(seed, "pulse", 10, 45.0, "metro")
        assert delay is not None and delay.direction == truth.direction
        assert delay.speed == pytest.approx(truth.speed, rel=0.01)


def test_what_is_known_of_the_distance_is_in_the_speed_and_its_sigma():
    (_, exact), (_, other) = (train(1, "pulse", 20, 45.0, apart=x) for x in (APART, (20.2, 0.1)))
    # the delay is the same: speed goes with the distance, but for the trials that it moves
    assert other.speed == pytest.approx(1.01 * exact.speed, rel=2e-4)
    relative = np.hypot(exact.sigma / exact.speed, 0.1 / 20.2)
    assert other.sigma / other.speed == pytest.approx(relative, rel=0.05)


@pytest.mark.parametrize("kind", ["noise", "blow", "hum"])
def test_what_is_no_train_has_no_delay(kind):
    for seed in range(8):
        rng = np.random.default_rng([7, seed])
        samples = rng.standard_normal((3 * RATE, 2))
        time = np.arange(3 * RATE) / RATE
        if kind == "blow":  # reaches both at once
            for at in rng.uniform(1.2, 2.8, 4):
                ring = np.exp(-np.maximum(time - at, 0) / 0.03) * (time > at)
                samples += 30 * (ring * np.sin(600 * (time - at)))[:, None]
        if kind == "hum":
            samples += 5 * np.sin(2 * np.pi * rng.uniform(5, 200) * time)[:, None]
        assert find_delay(*records(samples, 1.0), (1.0, 3.0), LIMITS, APART) is None


def test_a_clipped_waveform_places_no_better_than_energies():
    # two of either, 25 cm each, on 20 m
    least = 0.25 / 2**0.5 / 20
    for seed in range(2):
        for limit in (np.inf, 0.2):
            _, delay = train(seed, "pulse", 20, 45.0, limit=limit)
            assert delay is not None
            assert (delay.sigma > 0.9 * least * delay.speed) is bool(np.isfinite(limit))


@pytest.mark.parametrize("turns", [6.9, 7.5])
def test_blows_of_flats_tell_no_delay(turns):
    """Both channels hear a blow at once, and the next one turn later: whole turns alone agree."""
    rails = [RAILS[0], replace(RAILS[1], x=RAILS[0].x + 2.9 * turns)]
    for seed in range(2):
        truth = Passage(CATALOGUE["metro"].axles, (20.0, 35.0)[seed])
        duration = 3.5 + 60 / truth.speed
        time = np.arange(round(duration * RATE)) / RATE
        samples = np.random.default_rng(seed).standard_normal((time.size, 2))
        for row, channel in enumerate(rails):
            samples[:, row] += flat_blows(truth, channel, time, RATE, (1, 6), 30.0)
        now = float(truth.axle_times(rails[1].x)[0] + 30 / truth.speed)
        both = [
            replace(r, channel=channel)
            for r, channel in zip(records(samples[time < now], 1.0), rails, strict=True)
        ]
        assert find_delay(*both, (2.5, now), LIMITS, (2.9 * turns, 0.0)) is None
