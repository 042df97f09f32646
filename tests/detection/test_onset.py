"""When a train is told to arrive: false alarms as designed, delay as theory allows, any blocks."""

import numpy as np
import pytest
from scipy import signal

from tests.detection.synthetic import CATALOGUE, RAILS, Passage, record
from trackvib_ros.detection import Channel, TrainDetector, onset
from trackvib_ros.detection.features import GroupStream
from trackvib_ros.detection.onset import GAINS, Onset, Trigger
from trackvib_ros.waveform import Waveform

RUNS = 400


def first_crossings(gain, threshold, freedom, rng, most):
    """Bins until a test of one band crosses, and its statistic then, for many runs at once."""
    test = Onset(RUNS, 1, 0.001, 1)
    when, value = np.full(RUNS, most), np.full(RUNS, np.nan)
    for first in range(0, most, 10):
        ratio = gain * rng.chisquare(freedom, (10, RUNS, 1)) / freedom
        looked = test.look(ratio, np.ones((10, RUNS), bool), np.full((RUNS, 1), freedom))
        test.take(looked)
        statistic = looked.mean(axis=2)
        over = statistic > threshold
        new = over.any(axis=0) & (when == most)
        at = np.argmax(over, axis=0)
        when[new] = first + 1 + at[new]
        value[new] = statistic[at[new], new]
        if (when < most).all():
            break
    return when, value


def test_false_alarms_are_as_rare_as_designed():
    rng = np.random.default_rng(1)
    threshold = 200.0
    when, value = first_crossings(1.0, threshold, 1.2, rng, 40_000)
    assert np.isfinite(value).all()
    # R_n - n is a martingale: the mean of what it stops at is the mean time, at least the threshold
    error = np.std(when) / np.sqrt(RUNS)
    assert when.mean() > threshold - 3 * error
    capped = np.minimum(value, 40 * threshold)  # the jump over the threshold has a heavy tail
    assert when.mean() > 0.7 * capped.mean()


@pytest.mark.parametrize("gain", [4.0, 10.0, 30.0])
def test_delay_is_that_of_theory(gain):
    rng = np.random.default_rng(2)
    threshold, freedom = 1e9, 1.2
    when, _ = first_crossings(gain, threshold, freedom, rng, 2000)
    information = 0.5 * freedom * (gain - 1 - np.log(gain))
    # Lorden: no test of this false alarm rate needs less than ln(threshold) / information; not
    # knowing the gain costs a likelihood ratio of the number of gains, discreteness a bin
    assert when.mean() > 0.8 * np.log(threshold) / information
    assert when.mean() < 1.15 * np.log(threshold * len(GAINS)) / information + 1.5


def stream_of(samples, rate, keep_s=200.0):
    names = tuple(f"c{i}" for i in range(samples.shape[1]))
    stream = GroupStream(names, round(1e9 / rate), keep_s)
    stream.push(Waveform(0, round(1e9 / rate), names, samples.astype(np.float32)))
    stream.flush()
    return stream


def frames(stream, row):
    return stream.measured(row, 2**62)[20:]


@pytest.mark.parametrize("rate", [500, 2000, 10_000])
def test_degrees_of_freedom_of_white_noise(rate):
    rng = np.random.default_rng(3)
    stream = stream_of(rng.standard_normal((60 * rate, 2)), rate)
    for row in range(2):
        energy = frames(stream, row)
        energy = energy[: len(energy) // 16 * 16].reshape(-1, 16, energy.shape[1]).mean(axis=1)
        measured = 2 / np.var(energy / energy.mean(axis=0), axis=0)
        windows = len(energy)
        expected = 16 * stream.frame_bins * stream.freedom
        # the variance of a variance is 2 / n
        assert measured == pytest.approx(expected, rel=4 * np.sqrt(2 / windows))


def test_narrow_noise_is_recognised():
    rate, width = 2000, 20.0
    rng = np.random.default_rng(4)
    pole = np.exp(-np.pi * width / rate) * np.exp(2j * np.pi * 300 / rate)
    x = signal.lfilter([1.0], np.poly([pole, pole.conj()]).real, rng.standard_normal(40 * rate))
    stream = stream_of(x[:, None], rate)
    trigger = Trigger(1, stream.bands, stream.frame_s, stream.frame_bins * stream.freedom)
    for energy in frames(stream, 0):
        trigger.step(energy[None], np.ones(1, bool), frozen=False)
    # a resonance has the equivalent width pi/2 (power squared: pi) times that between half powers
    true = 2 * np.pi * width * stream.step / stream.freedom
    inside = [low < 300 < high for low, high in stream.bands]
    seen = trigger.whiteness[0][inside]
    # by the lower side of a skewed law, and short of what may be chance
    assert np.all(seen > 0.7 * true[inside])
    assert np.all(seen < 2.2 * true[inside])


def arrivals(samples, rate, detector=None, length=1000):
    names = tuple(c.name for c in RAILS[: samples.shape[1]])
    detector = detector or TrainDetector(RAILS[: samples.shape[1]])
    out = []
    for first in range(0, len(samples), length):
        dt = round(1e9 / rate)
        block = Waveform(first * dt, dt, names, samples[first : first + length].astype(np.float32))
        out += [(block.end_ns, e) for e in detector.process(block) if e.kind == "arrival"]
    return out


def test_false_arrivals_of_the_detector_are_fewer_than_designed(monkeypatch):
    # a mean time of five seconds instead of a week, floors learned from half a second
    monkeypatch.setattr(onset, "_FALSE_ARRIVAL_S", 5.0)
    rate, seconds, found = 1000, 6, 0
    for seed in range(12):
        rng = np.random.default_rng([5, seed])
        found += len(arrivals(rng.standard_normal((seconds * rate, 2)), rate))
    expected = 12 * (seconds - 0.5) / 5.0
    assert found < expected + 2 * np.sqrt(expected)


@pytest.mark.parametrize("snr", [0, 10, 20])
def test_arrival_is_told_in_the_block_that_shows_it(snr):
    rate, length = 2000, 40
    late = []
    for seed in range(4):
        truth = Passage(CATALOGUE["CRH3"].axles, 80.0, start=2.8 + 0.0061 * seed)
        signals = record([truth], RAILS, snr, seed=seed, duration=4.0, rates={"rail": rate})
        x = np.stack([signals[c.name][1] for c in RAILS], 1)
        (told_ns, event), *_ = arrivals(x[: round(3.0 * rate)], rate, length=length)
        stream = GroupStream(("a",), 500_000, 1.0)
        # the block, the filters' delay, a bin, but neither a frame nor the time that a hole takes
        wait = length / rate + stream.shift.max() + stream.step
        assert 0 < (told_ns - event.stamp_ns) * 1e-9 <= wait + 1e-9
        late.append(told_ns * 1e-9 - min(truth.axle_times(c.x)[0] for c in RAILS))
    # a block of 20 ms; the second wheelset follows after 31 ms
    assert max(late) < 0.06 and np.median(late) < 0.04


@pytest.mark.parametrize("hole", [False, True])
def test_groups_of_other_rates_and_holes_in_any_blocks(hole):
    sensors = (RAILS[0], RAILS[1], Channel("slab", 10.0, "slab"))
    truth = Passage(CATALOGUE["metro"].axles, 50.0, start=1.7)
    rates = {"rail": 2000, "slab": 1000}
    signals = record([truth], sensors, 10, seed=7, duration=5.0, rates=rates)
    rails = np.stack([signals["rail_a"][1], signals["rail_b"][1]], 1)
    slab = signals["slab"][1][:, None]
    if hole:
        rails[3390:3420, 0] = np.nan  # 15 ms, bridged, where the train arrives
        slab[1690:1760] = np.nan

    def events(length_s):
        blocks = []
        for names, data, rate in ((("rail_a", "rail_b"), rails, 2000), (("slab",), slab, 1000)):
            size, dt = round(length_s * rate), round(1e9 / rate)
            blocks += [
                Waveform(first * dt, dt, names, data[first : first + size].astype(np.float32))
                for first in range(0, len(data), size)
            ]
        detector, out = TrainDetector(sensors), []
        for block in sorted(blocks, key=lambda b: b.end_ns):
            out += detector.process(block)
        return out + detector.finish()

    reference = events(1.0)
    assert next(e.kind for e in reference) == "arrival"
    for length_s in (0.007, 0.02):
        assert events(length_s) == reference
