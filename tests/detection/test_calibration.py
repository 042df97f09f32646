"""What passages teach of the distance between two rail channels."""

from dataclasses import replace

import numpy as np
import pytest

from solver import InputError
from trackvib_ros.detection import Calibration, Channel, DetectorConfig, TrainDetector
from trackvib_ros.detection.blind import Blind, at_site
from trackvib_ros.detection.bowl import SHAPE_SIGMA
from trackvib_ros.detection.calibration import POSITION_SIGMA, Measured
from trackvib_ros.detection.kinematics import Motion

from .synthetic import CATALOGUE, RAILS, Passage, blocks, record

NAMES = ("a", "b")
CHANNELS = (Channel("a", 0.0), Channel("b", 20.0))


def measured(value, sigma=0.03):
    covariance = np.zeros((2, 2))
    covariance[1, 1] = sigma**2
    return Measured(NAMES, np.array([0.0, value]), covariance)


def test_first_passage_is_a_weighted_mean():
    found = Calibration.untaught(CHANNELS, 0.1).learned(measured(0.12, 0.05))
    # weights of N(0, 2 x 0.1²), a little more for a passage's drift, and 0.12 +- 0.05
    prior = 2 * 0.1**2 * (1 + 2 / 300)
    offset, covariance = found.relative(NAMES)
    assert offset[1] == pytest.approx(0.12 * prior / (prior + 0.05**2), rel=1e-12)
    assert covariance[1, 1] == pytest.approx(1 / (1 / prior + 1 / 0.05**2), rel=1e-12)
    assert found.relative(("b", "a"))[0][1] == pytest.approx(-offset[1])


def test_stated_sigma_holds_while_learning():
    rng = np.random.default_rng(0)
    ratios = []
    for _ in range(200):
        true = 2**0.5 * 0.05 * rng.standard_normal()
        state = Calibration.untaught(CHANNELS, 0.05)
        for _ in range(5):
            state = state.learned(measured(true + 0.03 * rng.standard_normal()))
        offset, covariance = state.relative(NAMES)
        ratios.append((offset[1] - true) / covariance[1, 1] ** 0.5)
    # 200 draws: 1 +- 3 / sqrt(400)
    assert 0.85 < np.sqrt(np.mean(np.square(ratios))) < 1.15


def test_a_contradiction_teaches_nothing():
    state = Calibration.untaught(CHANNELS, 0.02)
    found = state.learned(measured(0.5))
    assert found.doubt is not None
    assert replace(found, doubt=None).to_json() == state.to_json()


def test_contradictions_that_agree_are_a_sensor_that_was_moved():
    rng = np.random.default_rng(1)
    needed, ratios = [], []
    for _ in range(100):
        true = 0.3 + abs(rng.standard_normal())
        state = Calibration.untaught(CHANNELS, 0.02)
        for _ in range(3):
            state = state.learned(measured(0.03 * rng.standard_normal()))
        count = 0
        while state.passages == 3:
            state, count = state.learned(measured(true + 0.03 * rng.standard_normal())), count + 1
        needed.append(count)
        offset, covariance = state.relative(NAMES)
        ratios.append((offset[1] - true) / covariance[1, 1] ** 0.5)
    # the first one says where; each that agrees within 0.04 m or so is 20 to 40 times (ln 3 to 3.7)
    # as likely as an accident within 1.4 m, and ln 1000 + ln 19 = 9.9 are asked for
    assert min(needed) >= 3 and np.median(needed) == 4 and max(needed) <= 7
    # 100 draws: 1 +- 3 / sqrt(200)
    assert 0.75 < np.sqrt(np.mean(np.square(ratios))) < 1.25


def test_accidents_are_no_moved_sensor():
    rng = np.random.default_rng(2)
    for _ in range(30):
        state = Calibration.untaught(CHANNELS, 0.02)
        # one in ten passages is of another train than was thought
        for k in range(1, 101):
            wrong = 2**0.5 * rng.standard_normal() if k % 10 == 0 else 0.0
            state = state.learned(measured(wrong + 0.03 * rng.standard_normal()))
        assert abs(state.relative(NAMES)[0][1]) < 0.05
    for _ in range(20):
        state = Calibration.untaught(CHANNELS, 0.02)
        for _ in range(20):  # nothing but accidents
            state = state.learned(measured(2**0.5 * rng.standard_normal()))
        # those within four sigmas of what was stated, 4 sqrt(2 x 0.02² + 0.03²), do count
        assert abs(state.relative(NAMES)[0][1]) < 0.17


def test_old_passages_fade():
    state = Calibration.untaught(CHANNELS, 0.05)
    for _ in range(50):
        state = state.learned(measured(0.08))
    assert state.relative(NAMES)[0][1] == pytest.approx(0.08, abs=0.005)
    for _ in range(300):
        state = state.learned(measured(-0.02))
    assert state.relative(NAMES)[0][1] == pytest.approx(-0.02, abs=0.005)
    assert state.relative(NAMES)[1][1, 1] > 0  # never certain


def test_text_and_back():
    state = Calibration.untaught(CHANNELS, 0.05).learned(measured(0.04))
    again = Calibration.from_json(state.to_json())
    assert again.to_json() == state.to_json()
    doubted = state.learned(measured(2.0))
    assert doubted.doubt is not None and not np.allclose(doubted.doubt.offset, state.offset)
    again, once = (
        c.learned(measured(2.0)) for c in (Calibration.from_json(doubted.to_json()), doubted)
    )
    assert again.to_json() == once.to_json() != doubted.to_json()
    with pytest.raises(InputError, match="offset_m"):
        Calibration.from_json(state.to_json().replace('"offset_m"', '"offset"'))


def test_every_position_is_as_well_known_as_its_channel_says():
    sure = Channel("a", 0.0, position_sigma=0.001)
    vague = Channel("b", 20.0)
    state = Calibration.untaught((sure, vague), 0.3)
    assert state.relative(NAMES)[1][1, 1] == pytest.approx(0.001**2 + 0.3**2, rel=1e-12)
    # of two equal doubts the one that is larger learns: a metre between them is b's
    for _ in range(5):
        state = state.learned(measured(0.5))
    assert abs(state.offset[0]) < 1e-4 < 0.4 < state.offset[1]


def metro(speed, seed):
    return record([Passage(CATALOGUE["metro"].axles, speed)], RAILS, 30, seed, kind="pulse")


def test_a_wrong_position_is_learned_and_then_allowed_for():
    # stands at 20.0 m, is said to stand at 20.1 m
    said = (RAILS[0], Channel(RAILS[1].name, 20.1))
    detector = TrainDetector(said, config=DetectorConfig(position_sigma=0.1))
    start_ns = 0
    for seed, speed in enumerate((30.0, 45.0, 60.0)):
        for block in blocks(metro(speed, seed), 0.5, start_ns):
            detector.process(block)
        start_ns += 20_000_000_000
    detector.finish()
    offset, covariance = detector.calibration.relative([c.name for c in said])
    assert detector.calibration.passages == 3
    assert abs(offset[1] + 0.1) < 2.5 * covariance[1, 1] ** 0.5 < 2.5 * 0.03

    later = TrainDetector(said, calibration=detector.calibration)
    crh3 = record([Passage(CATALOGUE["CRH3"].axles, 50.0)], RAILS, 30, 9, kind="pulse")
    events = [e for block in blocks(crh3, 0.5) for e in later.process(block)] + later.finish()
    (passage,) = [e for e in events if e.kind == "passage"]
    # half of the 0.18 m by which CRH2 would differ was in the position
    assert passage.values["type"] == "CRH3"
    assert passage.values["baseline_passages"] == 3
    assert passage.values["baseline_correction"].value == offset[1]
    later.reset()
    assert later.calibration is detector.calibration
    detector.reset()
    assert detector.calibration.passages == 0


def test_a_calibration_of_other_channels_is_refused():
    with pytest.raises(InputError, match="calibration is of channels a, b"):
        TrainDetector(RAILS, calibration=Calibration.untaught(CHANNELS, 0.02))


def test_an_unlisted_train_is_as_fast_as_the_distance_is_long():
    # 40 ± 0.1 m/s by 20 m between the channels, the distance said to be right to 0.5 m at either end
    motion = Motion(0.0, 0.0, 40.0, 0.2, np.diag([1e-4, 0.1**2, 1e-4]))
    seen = np.linspace(0.0, 1.0, 9)
    blind = Blind(NAMES, 0.0, motion, (40.0, 0.1), seen, 0 * seen, 0.9, 1, 0.9, True, "delay",
                  baseline=20.0)  # fmt: skip
    told = at_site(blind, Calibration.untaught(CHANNELS, 0.5))
    relative = (2 * 0.5**2) ** 0.5 / 20.0
    assert told.speed == pytest.approx((40.0, np.hypot(0.1, 40.0 * relative)), rel=1e-12)
    assert told.motion.speed_sigma(0.0) == pytest.approx(told.speed[1], rel=1e-12)
    told = at_site(blind, Calibration.untaught(CHANNELS))
    tape = 2**0.5 * POSITION_SIGMA / 20.0
    assert told.speed == pytest.approx((40.0, np.hypot(0.1, 40.0 * tape)), rel=1e-12)
    # a metre more, as five passages have taught, makes everything longer and faster
    state = Calibration.untaught(CHANNELS, 0.5)
    for _ in range(5):
        state = state.learned(measured(1.0))
    offset, covariance = state.relative(NAMES)
    told = at_site(blind, state)
    factor = 1 + offset[1] / 20.0
    assert told.speed[0] == pytest.approx(40.0 * factor, rel=1e-12)
    assert told.spacings == pytest.approx(factor * blind.spacings, rel=1e-12)
    assert covariance[1, 1] ** 0.5 / 20.0 < relative / 10


def test_bowl_is_learned_as_a_weighted_mean():
    start = Calibration.untaught(CHANNELS)
    before, spread = start.wavenumber("a")
    found = start.learned_bowl("a", 2.0, 0.03)
    noise = 0.03**2 + SHAPE_SIGMA**2
    value, sigma = found.wavenumber("a")
    weight = spread**2 / (spread**2 + noise)
    assert np.log(value / before) == pytest.approx(weight * np.log(2.0 / before), rel=1e-12)
    assert sigma == pytest.approx((1 / spread**2 + 1 / noise) ** -0.5, rel=1e-12)
    assert found.wavenumber("b") == (before, spread)
    assert found.learned_bowl("a", 4.0, 0.03) is found


def test_file_and_back(tmp_path):
    path = tmp_path / "site.json"
    state = Calibration.untaught(CHANNELS).learned(measured(0.02)).learned_bowl("b", 1.6, 0.02)
    state.save(path)
    state.save(path)
    assert Calibration.load(path).to_json() == state.to_json()
    assert [p.name for p in tmp_path.iterdir()] == ["site.json"]


@pytest.mark.parametrize("text", ["", "notes", "{}", '{"schema": "other"}', "\xff"])
def test_what_is_no_calibration_is_not_overwritten(tmp_path, text):
    path = tmp_path / "notes.txt"
    path.write_text(text, "latin-1")
    with pytest.raises(InputError, match=r"notes\.txt"):
        Calibration.untaught(CHANNELS).save(path)
    assert path.read_text("latin-1") == text


def test_a_directory_that_does_not_exist_is_named(tmp_path):
    with pytest.raises(InputError, match="nowhere"):
        Calibration.untaught(CHANNELS).save(tmp_path / "nowhere" / "site.json")


def test_known_trains_teach_the_bowl_and_so_the_speed_of_an_unlisted_one():
    detector = TrainDetector(RAILS[:1])
    start_ns = 0
    for seed, speed in enumerate((40.0, 60.0)):
        part = record([Passage(CATALOGUE["ICE1"].axles, speed)], RAILS[:1], 30, seed, kind="pulse")
        known = detector.calibration.wavenumber(RAILS[0].name)
        # the events of a train do not wait for what it teaches
        for block in blocks(part, 0.5, start_ns):
            if any(event.kind == "passage" for event in detector.process(block)):
                break
            assert detector.calibration.wavenumber(RAILS[0].name) == known
        assert detector.calibration.wavenumber(RAILS[0].name) == known
        detector.finish()
        assert detector.calibration.wavenumber(RAILS[0].name) != known
        start_ns += 60 * 10**9
    # the pulses of the stand-in are those of a beam with k/4EI = 1 m^-4: k0 = sqrt 2
    value, sigma = detector.calibration.wavenumber(RAILS[0].name)
    assert value == pytest.approx(2**0.5, rel=0.06)
    assert sigma < 0.04
