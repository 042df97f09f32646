"""Clipped records are told from what only looks like it."""

import numpy as np
import pytest

from trackvib_ros.detection.features import GroupStream
from trackvib_ros.detection.health import clipped
from trackvib_ros.waveform import Waveform

RATE = 2000
TIME = np.arange(4 * RATE) / RATE


def window(samples):
    stream = GroupStream(("rail",), round(1e9 / RATE), 10.0)
    stream.push(Waveform(0, round(1e9 / RATE), ("rail",), samples[:, None].astype(np.float32)))
    stream.advance(10**10)
    return stream.window(0, 0, 10**10)


def noise(seed=0):
    return np.random.default_rng(seed).standard_normal(TIME.size)


@pytest.mark.parametrize("level", [0.5, 1.5, 2.5])  # of the rms: 60 %, 13 %, 1 % of the samples
def test_noise_cut_at_its_range_is_clipped(level):
    bursts = noise() * np.where(TIME % 0.5 < 0.2, 1.0, 0.1)  # neighbours seldom equal
    found = window(np.clip(bursts, -level, level))
    assert clipped(found, np.ones(found.time.size, dtype=bool))


@pytest.mark.parametrize(
    "samples",
    [
        *(noise(seed) for seed in range(5)),
        np.sin(2 * np.pi * 50 * TIME),
        np.sin(2 * np.pi * 13 * TIME) + 0.02 * noise(),
        np.full(TIME.size, 3.0),
    ],
)
def test_noise_hum_and_a_dead_sensor_are_not(samples):
    found = window(samples)
    assert not clipped(found, np.ones(found.time.size, dtype=bool))
