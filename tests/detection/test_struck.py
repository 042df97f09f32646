"""Trains whose wheelsets lie in the noise while their flats strike the rail."""

import numpy as np
import pytest

from tests.detection.synthetic import CATALOGUE, RAILS, Passage, blocks, flat_blows, record
from tests.detection.test_delay import LIMITS, records
from trackvib_ros.detection import CONFIRMED, TrainDetector
from trackvib_ros.detection import struck as hidden

FLAT = (2, 9, 15, 20)
AMPLITUDE = 50.0  # over the rms of the wheelsets; the noise has 2.5
SNR = -8.0


def told(signals):
    """Confirmed trains."""
    detector = TrainDetector(RAILS)
    events = [e for block in blocks(signals, 0.5) for e in detector.process(block)]
    events += detector.finish()
    return [e for e in events if e.kind == "passage" and e.values["grade"] == CONFIRMED]


def struck(truth, seed):
    """Noise, wheelsets, blows."""
    signals = record([truth], RAILS, SNR, seed=seed, rates={"rail": 2000})
    for channel in RAILS:
        rate, x = signals[channel.name]
        time = np.arange(x.size) / rate
        blows = flat_blows(truth, channel, time, rate, FLAT, AMPLITUDE)
        signals[channel.name] = rate, x + blows
    return signals


@pytest.mark.parametrize(("name", "kmh", "seed"), [("metro", 110, 1), ("articulated", 140, 3)])
def test_the_sum_over_all_wheelsets_shows_the_train(name, kmh, seed):
    """Every wheelset is 8 dB below the noise of its channel: none can be seen by itself."""
    truth = Passage(CATALOGUE[name].axles, kmh / 3.6, start=3.5 + 40 / kmh, direction=-1)
    (passage,) = told(struck(truth, seed))
    values = passage.values
    assert values["type"] == name and values["direction"] == "backward"
    assert values["axle_count"] == truth.axles.size
    speed = values["speed"]
    assert abs(speed.value - truth.mid_speed()) < 3 * speed.sigma < 0.03 * truth.speed
    first, last = truth.axle_times(values["reference_x"].value)[[0, -1]]
    assert abs(passage.stamp_ns * 1e-9 - first) < 3 * values["arrival_sigma"]
    assert abs(values["departure_ns"] * 1e-9 - last) < 3 * values["departure_sigma"]


def test_a_train_is_on_record_if_one_channel_has_all_of_it():
    truth = Passage(CATALOGUE["metro"].axles, 110 / 3.6, start=3.5, direction=-1)
    signals = struck(truth, 1)
    samples = np.stack([signals[c.name][1] for c in RAILS], axis=1)
    ends = sorted(float(truth.axle_times(c.x)[-1]) for c in RAILS)
    for end, seen in ((0.5 * sum(ends), True), (ends[0] - 0.5, False)):
        both = records(samples[: round(end * 2000)], float(samples[:4000].var()))
        found = hidden.find(both, (3.0, end), CATALOGUE.types, LIMITS)
        assert (found is not None) is seen


def test_blows_that_repeat_are_no_train():
    """A machine beside the track strikes as often as a wheel turns: nothing is confirmed."""
    rate = 2000
    time = np.arange(12 * rate) / rate
    since = np.where((time > 3) & (time < 8), time % 0.09, 1.0)
    blow = AMPLITUDE * np.exp(-since / 2e-3) * np.sin(2 * np.pi * 300 * since)
    noise = 2.5 * np.random.default_rng(5).normal(size=(len(RAILS), time.size))
    signals = {c.name: (rate, x + blow) for c, x in zip(RAILS, noise, strict=True)}
    assert not told(signals)
