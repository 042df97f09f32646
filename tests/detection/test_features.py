"""Where features say that something was."""

import numpy as np
import pytest

from trackvib_ros.detection.features import GroupStream
from trackvib_ros.waveform import Waveform


@pytest.mark.parametrize("rate", [500, 1000, 2000, 5000, 10_000, 16_000])
def test_a_slow_pulse_is_where_it_was(rate):
    place = 2.0003
    time = np.arange(4 * rate) / rate
    samples = np.exp(-0.5 * ((time - place) / 0.02) ** 2)[:, None]
    stream = GroupStream(("a",), round(1e9 / rate), 10.0)
    stream.push(Waveform(0, round(1e9 / rate), ("a",), samples.astype(np.float32)))
    stream.flush()
    window = stream.window(0, 0, 4_000_000_000)
    # a filter moves the centre of a pulse by its delay at frequency zero, whatever its other
    # delays; the means of bins and the sums of samples keep it
    centre = float(np.sum(window.time * window.low) / np.sum(window.low))
    assert centre - window.low_shift == pytest.approx(place, abs=2e-6)


def test_a_bridged_hole_is_not_measured_where_it_makes_a_slow_wave():
    """A vibration at 400 Hz, far above the low-passed waveform, but for holes of 1 to 20 ms."""
    rate, rng = 2000, np.random.default_rng(0)
    samples = np.sin(2 * np.pi * 400.0 * np.arange(8 * rate) / rate + 0.3)[:, None]
    streams = [GroupStream(("a",), 500_000, 10.0) for _ in range(2)]
    holed = samples.copy()
    for start in np.arange(rate // 2, 8 * rate, 300):
        holed[start : start + rng.integers(2, 40)] = np.nan
    for stream, given in zip(streams, (samples, holed), strict=True):
        stream.push(Waveform(0, 500_000, ("a",), given.astype(np.float32)))
        stream.flush()
    whole, window = (stream.window(0, 0, 8_000_000_000) for stream in streams)
    error = np.abs(window.low - whole.low)
    assert np.max(error[window.valid]) > 0.2
    # what the waveform remembers of a hole has faded to 1e-4, twice over for the bins' width
    assert np.max(error[window.measured]) < 1e-3
    assert 0.5 * np.sum(window.valid) < np.sum(window.measured) < 0.99 * np.sum(window.valid)
    assert whole.measured.all() == whole.valid.all()


def _features(samples: np.ndarray, block: int = 0) -> GroupStream:
    stream = GroupStream(("a",), 500_000, 30.0)
    size = block or len(samples)
    for first in range(0, len(samples), size):
        part = samples[first : first + size, None]
        stream.push(Waveform(first * 500_000, 500_000, ("a",), part.astype(np.float32)))
        if block:
            stream.advance((first + len(part)) * 500_000)
    stream.flush()
    return stream


def _holed(samples: np.ndarray, seed: int) -> np.ndarray:
    """A tenth of the samples missing, 5 times a second (Poisson) for 20 ms (exponential)."""
    rng, holed = np.random.default_rng(seed), samples.copy()
    start = 600
    while start < len(samples):
        holed[start : start + max(1, round(rng.exponential(40)))] = np.nan
        start += round(rng.exponential(400)) + 1
    return holed


def test_short_holes_of_a_straight_line_are_bridged_exactly():
    line = np.linspace(-1.0, 1.0, 8000)
    line[:1000], line[-1000:] = line[1000], line[-1001]
    holed = line.copy()
    for start in range(1500, 6500, 237):
        holed[start : start + 30] = np.nan
    whole, bridged = (_features(x).window(0, 0, 2**62).low for x in (line, holed))
    assert np.max(np.abs(whole - bridged)) < 1e-6  # samples are of 32 bit


def test_noise_beside_holes_is_as_loud_as_noise():
    """Frames of noise with a tenth of the samples missing have the energies of those without.

    The quietest hundredth of 6000 frames, where holes would leave silence, and the loudest two in
    a thousand, where a line from sample to sample would make a slow wave: these are known to 5 %.
    """
    noise = np.random.default_rng(3).normal(size=120_000)
    levels = []
    for samples in (noise, _holed(noise, 4)):
        stream = GroupStream(("a",), 500_000, 61.0)
        stream.push(Waveform(0, 500_000, ("a",), samples[:, None].astype(np.float32)))
        stream.flush()
        frames = range(100, stream.bins - stream.frame_bins, stream.frame_bins)
        kept = [f for i in frames if (f := stream.frame(i)).valid.all()]
        assert len(kept) > 0.6 * len(frames)
        energy = [f.energy[0] for f in kept]
        levels.append(np.nanpercentile(energy, [1.0, 50.0, 99.8], axis=0))
    np.testing.assert_allclose(levels[1], levels[0], rtol=0.12)


@pytest.mark.parametrize("block", [1, 7, 400])
def test_bridged_holes_do_not_depend_on_blocks(block):
    samples = _holed(np.random.default_rng(5).normal(size=2500), 6)
    whole, parts = (_features(samples, b).window(0, 0, 2**62) for b in (0, block))
    np.testing.assert_array_equal(parts.energy, whole.energy)
    np.testing.assert_array_equal(parts.low, whole.low)
    np.testing.assert_array_equal(parts.valid, whole.valid)
