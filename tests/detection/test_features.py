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
    assert np.max(error[window.valid]) > 0.3
    # what the waveform remembers of a hole has faded to 1e-4, twice over for the bins' width
    assert np.max(error[window.measured]) < 1e-3
    assert 0.5 * np.sum(window.valid) < np.sum(window.measured) < 0.99 * np.sum(window.valid)
    assert whole.measured.all() == whole.valid.all()
