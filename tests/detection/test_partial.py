"""What is told of a train before it has passed, and of one in which the record begins."""

from pathlib import Path

import numpy as np
import pytest

from solver import load_scenario_text
from tests.detection.synthetic import CATALOGUE, RAILS, Passage, record
from trackvib_ros.bag import BagReader
from trackvib_ros.detection import CONFIRMED, VIBRATION, Channel, detect, detector
from trackvib_ros.detection.closing import Closing

BAGS = Path(__file__).parents[2] / "bags"
RATE = 2000


def samples(truth, channels, snr=20, kind="burst", seed=3):
    signals = record([truth], channels, snr, seed=seed, rates={"rail": RATE}, kind=kind)
    return np.stack([signals[c.name][1] for c in channels], axis=1)


def of(events, kind):
    return [event for event in events if event.kind == kind]


@pytest.mark.parametrize("kind", ["burst", "pulse"])
@pytest.mark.parametrize(
    ("name", "kmh", "snr"),
    [("CRH3", 300, 20), ("articulated", 160, 10), ("metro", 70, 20), ("locomotive_hauled", 100, 0)],
)
def test_one_rail_tells_a_speed_while_the_train_passes(name, kmh, snr, kind):
    truth = Passage(CATALOGUE[name].axles, kmh / 3.6)
    events = detect(RATE, samples(truth, RAILS[:1], snr, kind), RAILS[:1])
    updates = of(events, "update")
    assert updates
    times = truth.axle_times(0.0)
    for update in updates:
        assert times[3] < update.stamp_ns * 1e-9 < times[-1]
        speed = update.values["speed"]
        # the stated uncertainty is no excuse for no information
        assert 0.02 * speed.value <= speed.sigma < 0.15 * speed.value
        assert abs(speed.value - truth.speed) < 2.5 * speed.sigma
        assert update.values["direction"] == "unknown" and update.quality == ("provisional",)
        types = dict(update.values["types"])
        assert list(types.values()) == sorted(types.values(), reverse=True)
        assert 0.97 < sum(types.values()) < 1.001  # those below one in a thousand are left out
        assert types[name] > 0.01
    assert update.values["passed"].value > 12 * 2.5  # twelve wheelsets, 2.5 m apart or more


def demo_rails():
    """Rate, stamps and samples of the rail channels of a recorded passage, its channels."""
    reader = BagReader(BAGS / "demo")
    scenario = load_scenario_text(reader.custom_data["scenario"])
    (topic,) = [
        name
        for name in reader.topics
        if name.endswith("/waveform") and "rail_a" in next(iter(reader.waveforms(name))).channels
    ]
    waves = list(reader.waveforms(topic))
    channels = [
        Channel(name, scenario.channel_x({c.name: c for c in scenario.channel}[name]), "rail")
        for name in waves[0].channels
    ]
    data = np.concatenate([wave.data for wave in waves])
    return 1e9 / waves[0].dt_ns, data, channels, scenario.train[0]


def check_truncated(events, speed, reference_end):
    (passage,), (departure,) = of(events, "passage"), of(events, "departure")
    assert passage.quality == departure.quality == ("truncated_start",)
    assert passage.values["grade"] == CONFIRMED
    told = passage.values["speed"]
    assert 0 < told.sigma < 0.15 * told.value
    assert abs(told.value - speed) < 2.5 * told.sigma
    end = reference_end(passage.values["reference"])
    assert abs(departure.stamp_ns * 1e-9 - end) < 2.5 * departure.sigma_s
    # what began before the record is not claimed
    assert not {"arrival_ns", "passing_time", "axle_count", "train_length"} & set(passage.values)
    assert not of(events, "axle") and passage.values["type"] == "unknown"
    assert "arrival unknown" in passage.method
    return passage


@pytest.mark.parametrize("rails", [1, 2])
@pytest.mark.parametrize("share", [0.2, 0.5])
def test_a_recording_cut_inside_its_train(share, rails):
    rate, data, channels, train = demo_rails()
    whole = detect(rate, data, channels)
    (passage,) = of(whole, "passage")
    assert passage.quality == ()
    arrival, departure = passage.stamp_ns * 1e-9, passage.values["departure_ns"] * 1e-9
    cut = round((arrival + share * (departure - arrival)) * rate)
    x = {channel.name: channel.x for channel in channels}

    def end(name):
        ahead = (x[name] - x[passage.values["reference"]]) / train.speed
        return departure + ahead - cut / rate

    told = check_truncated(detect(rate, data[cut:, :rails], channels[:rails]), train.speed, end)
    on_record = told.values["on_record"]
    length = train.speed * (end(told.values["reference"]))
    # to the start of the record, half a metre of pulse and the speed's own error
    assert abs(on_record.value - length) < 2.5 * on_record.sigma + 1.0
    if rails == 1:
        assert told.values["direction"] == "unknown"


@pytest.mark.parametrize("rails", [1, 2])
def test_a_synthetic_record_that_begins_inside_a_train(rails):
    truth = Passage(CATALOGUE["articulated"].axles, 50.0)
    times = truth.axle_times(0.0)
    cut = round(RATE * (0.6 * times[0] + 0.4 * times[-1]))
    events = detect(RATE, samples(truth, RAILS[:rails])[cut:], RAILS[:rails])
    check_truncated(
        events,
        truth.speed,
        lambda name: truth.axle_times({"rail_a": 0.0, "rail_b": 20.0}[name])[-1] - cut / RATE,
    )


@pytest.mark.parametrize(("inside", "speed"), [(False, 50.0), (False, 30.0), (True, 50.0)])
def test_a_record_gone_through_once_more_begins_in_a_train_only_without_quiet(
    monkeypatch, inside, speed
):
    ended = []
    monkeypatch.setattr(Closing, "conclude", lambda _, event: ended.append(event) or [])
    monkeypatch.setattr(detector, "_BEGUN", 0.0)  # as if a train had been near at the start
    truth = Passage(CATALOGUE["CRH3"].axles, speed)
    times = truth.axle_times(0.0)
    cut = round(RATE * (0.6 * times[0] + 0.4 * times[-1])) if inside else 0
    detect(RATE, samples(truth, RAILS)[cut:], RAILS)
    assert [event.begun is not None for event in ended] == [inside]


def test_too_little_of_a_train_is_no_passage():
    truth = Passage(CATALOGUE["CRH3"].axles, 60.0)
    times = truth.axle_times(0.0)
    events = detect(RATE, samples(truth, RAILS[:1])[round(RATE * times[-6]) :], RAILS[:1])
    assert not of(events, "passage")
    for departure in of(events, "departure"):
        assert departure.values["grade"] == VIBRATION
        assert departure.quality == ("truncated_start", "low_score")


@pytest.mark.parametrize(("name", "share"), [("articulated", 0.6), ("CRH3x2", 0.8)])
def test_a_record_that_ends_inside_a_train(name, share):
    truth = Passage(CATALOGUE[name].axles, 50.0)
    times = truth.axle_times(0.0)
    cut = round(RATE * ((1 - share) * times[0] + share * times[-1]))
    events = detect(RATE, samples(truth, RAILS)[:cut], RAILS)
    (passage,), (departure,) = of(events, "passage"), of(events, "departure")
    assert passage.quality == departure.quality == ("truncated_end",)
    told = passage.values["speed"]
    assert 0 < told.sigma < 0.15 * told.value
    assert abs(told.value - truth.speed) < 2.5 * told.sigma
    first = truth.axle_times({"rail_a": 0.0, "rail_b": 20.0}[passage.values["reference"]])[0]
    assert abs(passage.stamp_ns * 1e-9 - first) < 2.5 * passage.sigma_s
    assert passage.values["arrival_ns"] == passage.stamp_ns
    # what came after the record is not claimed: the train left later, by no more than the longest
    assert departure.stamp_ns * 1e-9 == pytest.approx(cut / RATE, abs=0.02)
    assert times[-1] < departure.stamp_ns * 1e-9 + departure.sigma_s
    assert not {"departure_ns", "passing_time", "axle_count", "train_length"} & set(passage.values)
    assert not of(events, "axle") and passage.values["type"] == "unknown"
    assert "departure unknown" in departure.method


@pytest.mark.parametrize("rails", [1, 2])
def test_the_middle_of_a_train_is_no_shorter_train(rails):
    truth = Passage(CATALOGUE["CRH3x2"].axles, 25.0)
    times = truth.axle_times(0.0)
    inside = slice(round(RATE * (times[0] + 2.0)), round(RATE * (times[0] + 7.0)))
    for event in of(detect(RATE, samples(truth, RAILS[:rails])[inside], RAILS[:rails]), "passage"):
        told = event.values["speed"]
        assert abs(told.value - truth.speed) < 3 * told.sigma
        assert {"truncated_start", "truncated_end"} & set(event.quality)
