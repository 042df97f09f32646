"""Mains hum is taken out, a train is not."""

import numpy as np
import pytest

from tests.detection.field_like import catalogue, stand_in
from tests.detection.stand_ins import SEEDS
from trackvib_ros.detection import Catalogue, detect
from trackvib_ros.detection.hum import without_hum

SEED = SEEDS["figures"] + 41


@pytest.mark.parametrize("rate", [200.0, 1000.0, 51_200 / 3])
@pytest.mark.parametrize("lines", [((50.03, 1.0), (150.09, 0.3)), ((16.69, 1.0),), ((60.0, 1.0),)])
def test_lines_are_taken_out_of_noise_with_a_burst(rate, lines):
    random, time = np.random.default_rng(2), np.arange(0, 8, 1 / rate)
    noise = 0.1 * random.standard_normal(time.size)
    burst = (np.abs(time - 4) < 1) * random.standard_normal(time.size)
    seen = [(f, a) for f, a in lines if f < 0.5 * rate - 10]
    hum = sum(a * np.sin(2 * np.pi * f * time + 0.7 * f) for f, a in seen)
    left = without_hum(noise + burst + hum, rate) - (noise + burst)
    # twice 4 s of noise without burst tell two numbers of every line, to 2 % of its amplitude and
    # less; that it lies between bins of the whole leaves a tenth at the ends
    middle = np.abs(time - 4) < 3.5
    assert np.sqrt(np.mean(left[middle] ** 2)) < 0.05
    assert np.sqrt(np.mean(left**2)) < 0.1


def test_nothing_is_taken_from_records_without_a_line():
    random, rate = np.random.default_rng(3), 500.0
    time = np.arange(0, 10, 1 / rate)
    for _ in range(50):
        x = random.standard_normal(time.size) * (0.1 + (np.abs(time - 5) < 2))
        assert without_hum(x, rate) is x
    # pulses of wheelsets 50 times in a second, while they pass
    passing = (np.abs(time - 5) < 2) * np.sin(2 * np.pi * 51.5 * time) + 0.1 * x
    left = without_hum(passing, rate)
    assert np.std(left - passing) < 0.05 * np.std(passing)


def test_hum_as_strong_as_the_train_changes_nothing():
    s = stand_in(SEED, "none", "roomy", 1000.0, 2, snr_db=25, train="class_425")
    known = Catalogue(tuple(t for t in catalogue() if t.name in ("class_425", "class_642")))
    peak = float(np.abs(s.samples).max())
    hum = peak * (np.sin(2 * np.pi * 49.98 * s.time) + 0.3 * np.sin(2 * np.pi * 149.94 * s.time))
    events = detect(s.rate, s.samples + hum[:, None], s.channels, known)
    (passage,) = [event for event in events if event.kind == "passage"]
    assert passage.values["type"] == s.train and passage.values["axle_count"] == s.axles.size
    speed = passage.values["speed"]
    assert abs(speed.value - s.mid_speed(0.0)) < 3 * speed.sigma < 0.01 * speed.value
