"""One train after another, and two at once."""

import numpy as np
import pytest

from tests.detection.synthetic import CATALOGUE, RAILS, Passage, record
from trackvib_ros.detection import TrainDetector, detect
from trackvib_ros.detection.closing import Closing
from trackvib_ros.waveform import Waveform

RATE = 2000
SPEED = 100 / 3.6


def pair(gap):
    """Two slow trains, the second as many seconds behind the first, and their samples."""
    places = CATALOGUE["metro"].axles
    first = Passage(places, SPEED)
    second = Passage(places, SPEED, start=first.axle_times(0.0)[-1] + gap)
    signals = record([first, second], RAILS, 20, seed=4, rates={"rail": RATE}, kind="pulse")
    samples = np.stack([signals[c.name][1] for c in RAILS], axis=1)
    return first, second, samples.astype(np.float32)


def told(samples, block):
    detector = TrainDetector(RAILS)
    step, names = round(1e9 / RATE), tuple(c.name for c in RAILS)
    events = []
    for i in range(0, len(samples), block):
        wave = Waveform(i * step, step, names, samples[i : i + block])
        events += [(wave.end_ns, event) for event in detector.process(wave)]
    return events + [(len(samples) * step, event) for event in detector.finish()]


def test_the_first_train_does_not_wait_for_the_second(monkeypatch):
    """At 100 km/h a gap of 1.2 s leaves 0.5 s in which both rails, 20 m apart, are quiet."""
    searches = []
    search = Closing.search
    monkeypatch.setattr(Closing, "search", lambda *a, **k: searches.append(1) or search(*a, **k))
    first, second, samples = pair(1.2)
    events = told(samples, 40)
    (at, one), (_, other) = [item for item in events if item[1].kind == "passage"]
    for passage, truth in ((one, first), (other, second)):
        times = truth.axle_times(0.0)
        assert passage.values["type"] == "metro" and passage.quality == ()
        assert abs(passage.values["speed"].value / SPEED - 1) < 0.004
        assert abs(passage.stamp_ns * 1e-9 - times[0]) < 0.005
        assert abs(passage.values["departure_ns"] * 1e-9 - times[-1]) < 0.008
    # the longest pause of any train of the catalogue; levels are of windows of 0.16 s
    clear = 1.15 * TrainDetector(RAILS).catalogue.longest_gap / SPEED
    assert at * 1e-9 < first.axle_times(20.0)[-1] + clear + 0.2
    assert at * 1e-9 < second.axle_times(0.0)[-1]
    arrivals = [event.stamp_ns * 1e-9 for _, event in events if event.kind == "arrival"]
    assert len(arrivals) == 2 and arrivals[1] > first.axle_times(0.0)[-1]
    assert abs(arrivals[1] - second.start) < 0.3
    # the channels begin to hear the second train at different times
    updates = [event.values["speed"] for _, event in events if event.kind == "update"]
    assert len(updates) == 4
    assert all(abs(told.value - SPEED) < 4 * told.sigma < 0.03 * SPEED for told in updates)
    # what was found when the train was told is not sought again when its event ends
    assert len(searches) == 2


def test_succession_does_not_depend_on_the_blocks():
    samples = pair(1.2)[2]
    events = [[event for _, event in told(samples, block)] for block in (90, 4000)]
    assert events[0] == events[1]


@pytest.mark.parametrize(("kind", "level"), [("pulse", 0.2), ("burst", 0.2)])
def test_a_train_on_the_neighbouring_track(kind, level):
    """One that comes the other way, 14 dB weaker, does no harm."""
    own = Passage(CATALOGUE["CRH3"].axles, 60.0)
    other = Passage(
        CATALOGUE["articulated"].axles, 50.0, start=own.start + 0.7, direction=-1, level=level
    )
    signals = record([own, other], RAILS, 20, seed=3, rates={"rail": RATE}, kind=kind)
    samples = np.stack([signals[c.name][1] for c in RAILS], axis=1)
    (passage,) = [event for event in detect(RATE, samples, RAILS) if event.kind == "passage"]
    speed = passage.values["speed"]
    assert abs(speed.value / own.speed - 1) < 0.004
    assert abs(speed.value - own.speed) < 2.5 * speed.sigma
    assert passage.values["type"] == "CRH3" and passage.values["direction"] == "forward"
    assert passage.values["axle_count"] == own.axles.size
    assert abs(passage.stamp_ns * 1e-9 - own.axle_times(0.0)[0]) < 0.005
