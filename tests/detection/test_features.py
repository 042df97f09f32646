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
