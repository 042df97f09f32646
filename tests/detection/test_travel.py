"""Speed, wheelsets and confirmation of trains that no catalogue lists."""

import numpy as np
import pytest

from tests.detection.synthetic import RAILS, Passage, record
from trackvib_ros.detection import CONFIRMED, Catalogue, detect
from trackvib_ros.detection.blind import Blind, _is_train, _wary
from trackvib_ros.detection.kinematics import Motion
from trackvib_ros.detection.pattern import Trace
from trackvib_ros.detection.travel import BROAD, CELL, FINE, Pair, Series, band_pass, search
from trackvib_ros.detection.wheelsets import find

RATE = 2000


def train(rng: np.random.Generator) -> np.ndarray:
    """Places of the wheelsets of a train on bogies of random geometry (m)."""
    wheelbase, centres = rng.uniform(1.8, 3.2), rng.uniform(9, 19)
    length = centres + rng.uniform(5, 8)
    cars = int(rng.integers(3, 11))
    car = np.array([0, wheelbase, centres, centres + wheelbase])
    return (car + length * np.arange(cars)[:, None]).ravel()


@pytest.fixture(scope="module")
def told() -> list[dict]:
    """What is told of sixteen unlisted trains of random geometry, speed and acceleration."""
    only = Catalogue((Catalogue.default()["articulated"],), "one type of another shape")
    out = []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        axles = train(rng)
        speed = rng.uniform(15, 95)
        most = min(0.8, 0.2 * speed**2 / axles[-1])
        truth = Passage(
            axles,
            speed,
            acceleration=rng.uniform(-most, most),
            direction=int(rng.choice([-1, 1])),
        )
        kind, snr = ("burst", "pulse")[seed % 2], (30, 15)[seed // 2 % 2]
        signals = record([truth], RAILS, snr, seed=seed, kind=kind, rates={"rail": RATE})
        x = np.stack([signals[c.name][1] for c in RAILS], axis=1)
        found = [e for e in detect(RATE, x, RAILS, only) if e.kind == "passage"]
        out.append({"truth": truth, "found": found, "pulses": kind == "pulse"})
    return out


def test_every_unlisted_train_is_confirmed_as_unknown(told):
    for case in told:
        (passage,) = case["found"]
        assert passage.values["grade"] == CONFIRMED
        assert passage.values["type"] == "unknown"
        forward = case["truth"].direction > 0
        assert passage.values["direction"] == ("forward" if forward else "backward")


def test_speed_of_unlisted_trains_holds_its_sigma(told):
    errors = np.array(
        [c["found"][0].values["speed"].value / c["truth"].mid_speed() - 1 for c in told]
    )
    sigma = np.array([c["found"][0].values["speed"].sigma / c["truth"].mid_speed() for c in told])
    # chi-square of 16: 99.9 % lies below 39, so the rms of error over sigma below 1.57
    assert np.sqrt(np.mean((errors / sigma) ** 2)) < 1.57
    # bursts are noise of its own at either channel: their energies alone give 0.25 m over 20 m
    assert np.all(np.abs(errors) < 0.03)
    # pulses are the same at both: the sigma of the tape, 0.02 m over 20 m, and of the noise
    assert np.median(np.abs(errors[1::2])) < 0.002


def test_a_confident_count_is_right(told):
    sure = [c for c in told if c["found"][0].values["axle_count_confidence"] >= 0.8]
    right = [c["found"][0].values["axle_count"] == c["truth"].axles.size for c in sure]
    # at least half are told with confidence; of ten, nine and more are right
    assert len(sure) >= 8
    assert np.mean(right) >= 0.9


def test_spacings_of_unlisted_trains_hold_their_sigma(told):
    ratios = []
    for case in told:
        values = case["found"][0].values
        if values["axle_count"] == case["truth"].axles.size:
            error = np.array(values["axle_spacings"]) - np.diff(case["truth"].axles)
            ratios.append(np.sqrt(np.mean(error**2)) / values["axle_spacing_sigma"])
            # a pulse learnt freely from equal bogies takes up 0.13 m of their wheelbase
            assert not case["pulses"] or np.sqrt(np.mean(error**2)) < 0.05
    # rms over a train of a dozen spacings and more: not above 1.5 sigma but for one train in many
    assert np.median(ratios) < 1.2 and np.mean(np.array(ratios) < 2) > 0.9


def comb(places: np.ndarray, cells: int) -> tuple[np.ndarray, np.ndarray]:
    s = CELL * np.arange(cells)
    lag = CELL * np.arange(-60, 61)

    def pulse(x: np.ndarray) -> np.ndarray:
        q = 1.1 * np.abs(x)
        return np.exp(-q) * (np.cos(q) - np.sin(q))

    y = sum(pulse(s - place) for place in places)
    return band_pass(np.asarray(y), FINE, BROAD), band_pass(pulse(lag), FINE, BROAD)


@pytest.mark.parametrize("seed", range(6))
def test_wheelsets_of_a_comb_in_noise(seed):
    rng = np.random.default_rng(seed)
    places = 20 + train(rng)
    y, pulse = comb(places, int((places[-1] + 20) / CELL))
    filtered = band_pass(rng.standard_normal((2, y.size))[0], FINE, BROAD)
    noise = band_pass(rng.standard_normal(y.size), FINE, BROAD)
    # a pulse stands 8 standard deviations out of the noise of its matched filter
    scale = float(pulse @ pulse) / np.std(np.convolve(filtered, pulse[::-1], "valid")) / 8
    found = find(y + scale * filtered, scale * noise, pulse)
    assert found is not None
    assert found.place.size == places.size
    error = found.place - places
    # about 10 to 40 wheelsets: 99.9 % limits of a chi-square of 10 over 10 degrees
    assert np.sqrt(np.mean((error / found.sigma) ** 2)) < 1.72
    assert found.certainty > 0.8


def test_noise_alone_has_no_wheelsets_worth_telling():
    rng = np.random.default_rng(3)
    y, noise = (band_pass(x, FINE, BROAD) for x in rng.standard_normal((2, 2000)))
    _, pulse = comb(np.array([50.0]), 1000)
    found = find(y, noise, pulse)
    # what is found at 3.5 sigma explains next to nothing
    assert found is None or found.explained < 0.2


def shots(rng: np.random.Generator, times: np.ndarray, n: int) -> np.ndarray:
    x = rng.standard_normal(n)
    for at in times:
        k = int(at * RATE)
        x[k : k + int(rng.integers(1, 12))] += 200 * rng.choice([-1, 1])
    return x


@pytest.mark.parametrize("seed", range(8))
def test_chance_coincidences_are_no_train(seed):
    """Two disturbances a delay apart, at either channel one or two, have a speed but no bogies."""
    rng = np.random.default_rng(seed)
    times = 4 + np.cumsum(rng.uniform(0.1, 0.6, 1 + seed % 2))
    delay = 20.0 / rng.uniform(15, 100)
    n = 12 * RATE
    x = np.stack([shots(rng, times, n), shots(rng, times + delay, n)], axis=1)
    events = detect(RATE, x, RAILS)
    assert [e for e in events if e.kind == "arrival"]
    assert not [e for e in events if e.kind == "passage" and e.values["grade"] == CONFIRMED]


def test_what_reaches_both_channels_at_once_is_no_train():
    rng = np.random.default_rng(0)
    hits = 4 + 0.5 * np.arange(12) * (1 + 0.02 * rng.standard_normal(12))
    n = 16 * RATE
    one = shots(rng, hits, n)
    x = np.stack([one, one], axis=1) + rng.standard_normal((n, 2))
    events = detect(RATE, x, RAILS)
    assert [e for e in events if e.kind == "arrival"]
    assert not [e for e in events if e.kind == "passage" and e.values["grade"] == CONFIRMED]


@pytest.mark.parametrize("equal", [True, False])
def test_a_delay_by_a_wagon_more_is_as_likely_inside_a_train_of_equal_wagons(equal):
    """The middle of a train on record, of which only energies show anything."""
    rng = np.random.default_rng(4)
    speed, apart, step = 25.0, 30.0, 0.01
    pitch = 20.0 + (0.0 if equal else rng.uniform(-4, 4, 60))
    wagons = np.cumsum(np.broadcast_to(pitch, 60)) - 600
    wheelsets = np.concatenate([wagons + x for x in (0.0, 1.8, 13.2, 15.0)])
    time = step * np.arange(1600)
    traces = []
    for x in (0.0, apart):
        off = speed * time[:, None] - x - wheelsets
        level = np.exp(-0.5 * (off / 0.5) ** 2).sum(axis=1) + 0.01
        energy = level * rng.chisquare(6, time.size) / 6
        known = np.ones(time.size, dtype=bool)
        traces.append([Trace(f"at {x}", x, time, energy, known, 0.01, step)])
    still = Series(time, np.zeros(time.size), known)
    found = search(Pair((still, still), (traces[0], traces[1]), apart, (0.0, 16.0)), (10.0, 115.0))
    assert found is not None and found.clear
    off = found.motion.speed - speed
    if equal:
        assert abs(off) > 0.3 * speed and abs(off) < 2 * found.doubt
        assert found.sure < 0.95
    else:
        assert abs(off) < 0.02 * speed and found.doubt < 0.001 * speed


def test_the_blows_of_a_flat_wheel_are_no_bogies():
    """A wheel of 0.92 m strikes the rail every 2.89 m; its record may have gaps."""
    turn = np.pi * 0.92
    blows = turn * np.concatenate([np.arange(11), 18 + np.arange(1), 22 + np.arange(10)])
    bogie = np.array([0.0, 2.5])
    bogies = np.concatenate(
        [bogie, *(bogie + 22.0 * k + x for k in range(4) for x in (17.0, 22.0))]
    )
    for places, train in ((blows, False), (bogies, True)):
        near = np.diff(places) < 3.6
        assert _is_train(places, np.append(near, False) | np.append(False, near)) is train


def test_what_goes_on_longer_beyond_wheelsets_than_they_last_is_no_train():
    """Ten seconds of a vehicle on a road, of which four look like wheelsets in bogies."""
    places = np.array([0.0, 2.5, 17.5, 20.0, 25.0, 27.5, 42.5, 45.0])
    motion = Motion(0.0, 0.0, 11.0, 0.0, np.eye(3))
    blind = Blind(
        sensors=("a", "b"),
        x=0.0,
        motion=motion,
        speed=(11.0, 0.1),
        times=motion.time_at(places),
        time_sigma=np.full(places.size, 0.002),
        regular=0.9,
        direction=1,
        correlation=0.6,
        travels=True,
        method="",
        axle_method="",
    )
    first, last = blind.times[[0, -1]]
    for beyond, train in ((0.0, True), (2.0, True), (6.0, False)):
        assert _wary(blind, (first, last + beyond)).travels is train
        assert _wary(blind, (first - beyond, last)).travels is train
