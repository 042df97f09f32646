"""Trains on channels that do not show their wheelsets: one common response per wheelset."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from trackvib_ros.detection import CONFIRMED, Catalogue, Channel, Estimate, TrainEvent, detect
from trackvib_ros.detection.catalogue import TrainType
from trackvib_ros.detection.events import Layer
from trackvib_ros.detection.response import CONFIRM_EVIDENCE, ResponsePassage
from trackvib_ros.detection.response_loads import loaded
from trackvib_ros.detection.response_model import (
    Model,
    Observation,
    Spectrum,
    comb,
    late_by,
    ringing,
)
from trackvib_ros.detection.response_search import CORRELATED, ResponseFit, Search
from trackvib_ros.detection.unlisted import CAR, EqualCars, like
from trackvib_ros.nuisances import RATE, nuisance

Array = NDArray[np.float64]

SHIPPED = Catalogue.default()
RAILCAR = TrainType("railcar", (0.0, 1.9, 15.625, 18.275, 32.0, 33.9), 2)
BEFORE_S = 12.0  # s, noise to learn, then the first wheelset


def wheelset_times(name: str, speed: float, acceleration: float = 0.0) -> Array:
    """Closed form: time (s) at which every wheelset is above the sensor; speed at mid-train."""
    d = SHIPPED[name].axles - 0.5 * SHIPPED[name].span
    late = 2 * d / (speed + np.sqrt(speed**2 + 2 * acceleration * d))
    return np.asarray(BEFORE_S + late - late[0])


def recorded(
    times: Array,
    rate: float,
    answer: tuple[str, float],
    noise: float,
    seed: int,
    loads: Array | None = None,
) -> Array:
    """Sum of one response per wheelset, of unit peak each, with white noise.

    ``("modes", v)``: two damped modes of a bridge, hit by every wheelset (acceleration).
    ``("strain", v)``: triangular influence line of a simple span of 20 m, gauge at mid-span.
    """
    kind, speed = answer
    t = np.arange(round((times[-1] + 12.0) * rate)) / rate
    x = np.zeros(t.size)
    for passing, load in zip(times, np.ones(times.size) if loads is None else loads, strict=True):
        since = t - passing
        if kind == "strain":
            x += load * np.maximum(1 - np.abs(since) * speed / 10.0, 0.0)
            continue
        ring = np.maximum(since, 0.0)
        for frequency, damping in ((6.0, 0.04), (23.0, 0.05)):
            w = 2 * np.pi * frequency
            x += load * np.where(since > 0, np.exp(-damping * w * ring) * np.sin(w * ring), 0.0)
    return x + noise * np.random.default_rng(seed).standard_normal(t.size)


def passage(events: list[TrainEvent]) -> TrainEvent | None:
    found = [event for event in events if event.kind == "passage"]
    assert len(found) <= 1
    return found[0] if found else None


def known(name: str) -> Catalogue:
    return Catalogue((SHIPPED[name],), "one type")


def estimate(event: TrainEvent, name: str) -> Estimate:
    value = event.values[name]
    assert isinstance(value, Estimate)
    return value


def speed_of(event: TrainEvent) -> Estimate:
    return estimate(event, "speed")


def test_the_comb_is_the_transform_of_the_wheelset_times() -> None:
    name, v, a = "articulated", 62.0, 0.4
    f = np.linspace(0.5, 30.0, 40)
    places = SHIPPED[name].axles - 0.5 * SHIPPED[name].span
    times = wheelset_times(name, v, a)
    times = times - (BEFORE_S + (times - BEFORE_S)[0]) + _first(places, v, a)
    expected = np.exp(-2j * np.pi * np.outer(f, times)).sum(axis=1)
    found = comb(places, f, np.array([v]), np.array([a]))[0]
    # 40 wheelsets, phases of up to 2 pi 30 Hz 2 s: rounding only
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_a_comb_of_no_frequencies_is_empty() -> None:
    none = comb(SHIPPED["metro"].axles, np.zeros(0), np.array([20.0]), np.array([0.0]))
    assert none.shape == (1, 0)


def _first(places: Array, v: float, a: float) -> float:
    return float(2 * places[0] / (v + np.sqrt(v**2 + 2 * a * places[0])))


@pytest.mark.parametrize("deviation", [(), (0.3, 0.1, 0.05, 0.2)])
def test_evidence_is_that_of_the_gaussian_model(deviation: tuple[float, ...]) -> None:
    """Second method: the marginal likelihood by the dense covariance of all coefficients."""
    random = np.random.default_rng(3)
    values = random.standard_normal(400) * np.hanning(400)
    seen = Observation("x", 0.0, 0.01 * np.arange(400) - 2.0, values, np.zeros(0), 3.0, 50.0)
    misfit = 0.2, 0.1, 0.4, 0.02
    model = Model(Spectrum(seen, 1.0, 12.0), 0.2, 0.4, misfit, 0.1, deviation)
    s = model.spectrum
    # octaves down from 12 Hz; the last one is all that is slower
    octave = np.digitize(s.f, [1.5, 3.0, 6.0])
    part = np.array(misfit)[3 - octave]
    size = np.sqrt(np.array(deviation or [0.0] * 4)[3 - octave])
    places = np.array([-9.0, -6.5, 6.5, 9.0])
    v, a = np.array([20.0]), np.array([0.0])
    combs = model.comb(places, v, a)
    found = model.evidence(combs, 4, np.array([0.1]))[0, 0]
    t = model.knots
    shape = np.sqrt(s.excess / (4 * t.size))
    # the four wheelsets of a car: what each answers is the common response and its contrasts
    patterns = [[1, 1, 1, 1], [1, -1, 1, -1], [1, 1, -1, -1], [1, -1, -1, 1]]
    parts = []
    for share, pattern in zip([np.ones(s.f.size), size, size, size], patterns, strict=True):
        each = comb(places, s.f, v, a, np.array([pattern], dtype=float))[0, 0]
        knots = np.exp(-2j * np.pi * np.outer(s.f, t + 0.1))
        parts.append((share * each * shape)[:, None] * knots)
    design = np.concatenate(parts, axis=1)
    # real and imaginary parts are independent; a share of the padded coefficients counts
    real = np.concatenate([design.real, design.imag])
    rest = np.concatenate([s.noise + part * s.excess] * 2) / (2 * s.share)
    y = np.concatenate([s.y.real, s.y.imag])
    covariance = np.diag(rest) + real @ real.T
    quadratic = y @ np.linalg.solve(covariance, y)
    log = np.linalg.slogdet(covariance)[1] - np.sum(np.log(rest))
    own = s.noise + s.excess
    null = 2 * s.share * np.sum(np.abs(s.y) ** 2 / own)
    levels = 2 * s.share * np.sum(np.log(own / (s.noise + part * s.excess)))
    assert found == pytest.approx(0.5 * (null - quadratic - log + levels), rel=1e-9)


@pytest.mark.parametrize(
    ("name", "speed", "acceleration", "layer"),
    [("CRH3", 70.0, 0.0, "bridge"), ("articulated", 38.0, -0.3, "slab")],
)
def test_a_channel_alone_gives_the_speed_of_a_known_type(
    name: str, speed: float, acceleration: float, layer: Layer
) -> None:
    times = wheelset_times(name, speed, acceleration)
    x = recorded(times, 500.0, ("modes", speed), 0.01, 1)
    events = detect(500.0, x, [Channel("one", 5.0, layer)], known(name))
    event = passage(events)
    assert event is not None
    # none is told where none is seen
    assert not [event for event in events if event.kind == "axle"]
    assert event.values["grade"] == CONFIRMED
    found = speed_of(event)
    # the waveform's model is exact, that of the energy is not where answers overlap; 2e-4 is 4 cm
    # of 200 m
    assert found.value == pytest.approx(speed, rel=2e-4)
    bend = estimate(event, "acceleration")
    assert abs(bend.value - acceleration) < 4 * bend.sigma < 0.3
    assert event.values["reference"] == "one"
    assert event.values["direction"] == "unknown"
    assert "axles_not_visible" in event.quality
    spectral = estimate(event, "speed_spectrum")
    assert abs(spectral.value - speed) < 4 * spectral.sigma
    left = [event for event in events if event.kind == "departure"][-1]
    late = left.stamp_ns * 1e-9 - times[-1]
    # the mode at 6 Hz rings for 0.33 s, by which energies alone are late
    assert abs(late) < 3 * left.sigma_s < 0.3


def test_a_mode_that_rings_on_is_ended_by_its_filter() -> None:
    """Closed form: free vibration is zero behind the filter, and a blow as short as it was."""
    rate, f, damping = 400.0, 6.0, 0.02
    t = np.arange(round(8 * rate)) / rate
    pole = 2j * np.pi * f * np.sqrt(1 - damping**2) - 2 * np.pi * f * damping
    x = np.zeros(t.size)
    for blow in (0.5, 0.9, 1.7):
        x += np.where(t > blow, np.imag(np.exp(pole * (t - blow).clip(0))), 0.0)
    taps = np.array(ringing(t, x, 1.8))
    root = np.exp(pole / rate)
    # blocks of several samples shift no pole: rounding of a least-squares fit only
    np.testing.assert_allclose(taps, [1.0, -2 * root.real, abs(root) ** 2], atol=1e-6)
    # energy decays as exp(-2 zeta omega t)
    energy_late = 1 / (4 * np.pi * f * damping)
    assert late_by(tuple(taps), 1 / rate, 5.0) == pytest.approx(energy_late, rel=1e-3)
    assert late_by(tuple(taps), 1 / rate, 20.0) == 0.0
    left = np.convolve(x, taps)[: x.size]
    assert np.sum(np.abs(left) > 1e-4 * np.abs(left).max()) <= 3 * 2


@pytest.mark.parametrize(("name", "speed"), [("CRH3", 50.0), ("locomotive_hauled", 30.0)])
def test_strain_gauge_with_drift_in_counts(name: str, speed: float) -> None:
    """Influence line of 20 m, noise 0.5 % of the peak, drift by a tenth of it in a minute."""
    times = wheelset_times(name, speed)
    x = recorded(times, 200.0, ("strain", speed), 0.0, 0)
    random = np.random.default_rng(4)
    peak = x.max()
    x += 0.005 * peak * random.standard_normal(x.size) + 0.1 * peak * np.arange(x.size) / 12000
    counts = np.round(30000 + 2000 * x)
    event = passage(detect(200.0, counts, [Channel("gauge", 0.0, "bridge")], known(name)))
    assert event is not None
    found = speed_of(event)
    # the noise alone would allow 1e-4; the gauge drifts and its filter smooths the kinks
    assert found.value == pytest.approx(speed, rel=2e-3)
    assert abs(found.value - speed) < 4 * found.sigma


def test_a_slow_train_on_a_strain_gauge_is_one_event() -> None:
    """At 11 m/s a span of 20 m answers below 1 Hz, and the bogies of a car are seconds apart."""
    times = wheelset_times("metro", 11.0)
    x = recorded(times, 200.0, ("strain", 11.0), 0.05, 9)
    events = detect(200.0, x, [Channel("gauge", 0.0, "bridge")], known("metro"))
    told = [e for e in events if e.kind in ("arrival", "departure")]
    assert [e.kind for e in told] == ["arrival", "departure"]
    assert abs(told[0].stamp_ns * 1e-9 - times[0]) < 20.0 / 11.0


def test_two_bridge_channels_share_a_motion_but_no_direction() -> None:
    times = wheelset_times("CRH3", 60.0)
    a = recorded(times, 500.0, ("modes", 60.0), 0.05, 5)
    b = recorded(times + 20.0 / 60.0, 500.0, ("strain", 60.0), 0.05, 6)
    size = min(a.size, b.size)
    data = np.stack([a[:size], b[:size]], axis=1)
    sensors = [Channel("mid", 0.0, "bridge"), Channel("quarter", 20.0, "bridge")]
    event = passage(detect(500.0, data, sensors, known("CRH3")))
    assert event is not None
    assert event.sensors == ("mid", "quarter")
    assert event.values["direction"] == "unknown"
    assert speed_of(event).value == pytest.approx(60.0, rel=1e-3)


def seen(x: Array, rate: float, times: Array, epoch: float) -> Observation:
    """A waveform about a passage, its times after an epoch."""
    t = np.arange(x.size) / rate
    near = (t > times[0] - 1.5) & (t < times[-1] + 1.5)
    late = np.asarray(t[near] - epoch, dtype=np.float64)
    quiet, lasts = x[t < times[0] - 2.0], float(times[-1] - times[0])
    return Observation("waveform", epoch, late, x[near], quiet, lasts, 80.0)


def best(search: Search, train: TrainType) -> ResponseFit:
    """The motion of a type with one response for all wheelsets."""
    return search.shared(search.refined(search.coarse(train, False)))[0]


def test_stated_sigma_holds_the_error() -> None:
    """White noise near the level of the signal, six seeds: rms of error / sigma."""
    ratios = []
    for seed in range(6):
        times = wheelset_times("metro", 33.0)
        x = recorded(times, 200.0, ("modes", 33.0), 0.2, seed)
        search = Search([seen(x, 200.0, times, 14.0)], (5.0, 120.0))
        found = loaded(search, best(search, SHIPPED["metro"]))
        assert found.covariance is not None
        ratios.append((found.speed - 33.0) / np.sqrt(CORRELATED * found.covariance[0, 0]))
    rms = float(np.sqrt(np.mean(np.square(ratios))))
    # sigma allows for misfit that is not white (CORRELATED = 3), which is absent here: 0.58
    # expected, and chi-square of six holds 0.26 to 0.90 in 95 %
    assert 0.25 < rms < 1.0


def test_loads_of_wheelsets_do_not_shift_the_speed() -> None:
    """Wheelsets that differ by 20 %, four seeds: taken as equal, the speed errs by what they do."""
    times, metro = wheelset_times("metro", 33.0), SHIPPED["metro"]
    errors, ratios = [], []
    for seed in range(4):
        random = np.random.default_rng(seed)
        loads = 1 + 0.2 * random.standard_normal(times.size)
        x = recorded(times, 200.0, ("modes", 33.0), 0.01, seed, loads)
        search = Search([seen(x, 200.0, times, 14.0)], (5.0, 120.0))
        equal = best(search, metro)
        found = loaded(search, equal)
        assert found.covariance is not None
        errors.append((equal.speed - 33.0, found.speed - 33.0))
        ratios.append(errors[-1][1] / np.sqrt(found.covariance[0, 0]))
        known_loads = np.corrcoef(found.loads, loads)[0, 1]
        assert known_loads > 0.9
    before, after = np.sqrt(np.mean(np.square(errors), axis=0))
    assert after < 0.5 * before
    # chi-square of four: below in 99 %, were the misfit white
    assert np.sqrt(np.mean(np.square(ratios))) < 1.82


def test_a_train_partly_empty_is_a_train() -> None:
    """Wagons weigh 22 t or 5.5 t: the parts of a train need not answer alike."""
    times, train = wheelset_times("CRH3", 33.0), SHIPPED["CRH3"]
    loads = np.where(np.arange(times.size) < 2 * times.size // 3, 1.0, 0.25)
    x = recorded(times, 200.0, ("modes", 33.0), 0.01, 5, loads)
    search = Search([seen(x, 200.0, times, 14.0)], (5.0, 120.0))
    found = best(search, train)
    assert not found.alike
    assert _told(search, found).confirmed


def _told(search: Search, fit: ResponseFit) -> ResponsePassage:
    gauge = (Channel("gauge", 0.0, "bridge"),)
    return ResponsePassage((fit,), (1.0,), gauge, (0.0, 0.1), 0, search.duration, None)


def test_channels_share_the_speed_of_the_train_whenever_they_are_strong() -> None:
    """Where an observation has its epoch is of no account, though the train brakes."""
    times = wheelset_times("metro", 33.0, -0.5)
    x = recorded(times, 200.0, ("modes", 33.0), 0.05, 3)
    metro = SHIPPED["metro"]
    values = []
    for late in (0.0, 0.7):
        search = Search([seen(x, 200.0, times, 14.0), seen(x, 200.0, times, 14.0 + late)], (5, 99))
        middle = BEFORE_S - 14.0 - _first(metro.axles - 0.5 * metro.span, 33.0, -0.5)
        models = search.models(33.0, 4.0, 20.0, 0.5)
        placed = tuple(replace(model, centre=middle - k * late) for k, model in enumerate(models))
        fit = ResponseFit(metro, False, 33.0, -0.5, 0.0, placed)
        values.append(float(search.total(fit, np.array([33.0]), np.array([-0.5]))[0]))
    # the series fade at their ends, which are the same
    assert values[0] == pytest.approx(values[1], rel=1e-9)


def test_a_short_train_is_sought_on_waves_short_enough() -> None:
    """Two articulated cars, 36 m over the wheelsets, on a gauge near the track: on waves of 8 m
    there is nothing to compare."""
    times = BEFORE_S + RAILCAR.axles / 25.0
    t = np.arange(round((times[-1] + 4) * 200)) / 200
    x = np.sum(np.exp(-(((t[:, None] - times) * 25.0 / 1.5) ** 2)), axis=1)
    x += 0.05 * np.random.default_rng(1).standard_normal(t.size)
    search = Search([seen(x, 200.0, times, 12.7)], (5.0, 120.0))
    found = search.refined(search.coarse(RAILCAR, False))[0]
    # 0.2 m of 36 m, before anything finer is asked
    assert found.speed == pytest.approx(25.0, rel=5e-3)
    assert found.evidence > CONFIRM_EVIDENCE
    # a road vehicle and spikes have as much: three bogies are three blows
    assert not _told(search, found).confirmed


@pytest.mark.parametrize(
    ("cars", "length", "speed", "types"),
    [
        (EqualCars(4, 0.74, 0.11), 23.0, 30.0, ("metro", "metro_A6")),
        # proportions of metro_A6 but for 2 %, and as many cars
        (EqualCars(6, 0.709, 0.0945), 27.5, 16.0, ("metro_A6", "CRH3")),
        # wagons as many as the coaches of ICE1, behind a locomotive
        (EqualCars(12, 0.64, 0.128, front=1.37), 14.04, 40.0, ("ICE1", "CRH3")),
    ],
    ids=["four cars", "six long cars", "locomotive and wagons"],
)
def test_an_unlisted_train_is_told_as_unknown(
    cars: EqualCars, length: float, speed: float, types: tuple[str, ...]
) -> None:
    """Some type of the catalogue repeats nearly alike at another speed."""
    axles = length / CAR[0] * cars.train.axles
    x = recorded(BEFORE_S + axles / speed, 400.0, ("modes", speed), 0.02, 7)
    some = Catalogue(tuple(SHIPPED[name] for name in types), "two types")
    events = detect(400.0, x, [Channel("b", 0.0, "bridge")], some)
    event = passage(events)
    assert event is not None
    assert event.values["type"] == "unknown"
    assert "axle_count" not in event.values
    left = next(event for event in events if event.kind == "departure")
    # one of three beyond 2.5 sigma would be an accident in 80
    assert abs(left.stamp_ns * 1e-9 - BEFORE_S - axles[-1] / speed) < 2.5 * left.sigma_s
    # the vehicles at its ends may be others, by half a car: 0.29 cars
    assert left.sigma_s > 0.25 * length / speed
    assert "unknown_type" in event.quality
    found = speed_of(event)
    # its size is not known, but for a quarter; what repeats is
    assert found.sigma > 0.24 * found.value
    assert abs(found.value - speed) < 2 * found.sigma
    rate = estimate(event, "car_rate")
    assert rate.value == pytest.approx(speed / length, rel=5e-3)


@pytest.mark.parametrize("front", [0.0, 1.3])
@pytest.mark.parametrize("centres", [0.7, 1.0])
def test_the_cars_of_a_train_of_equal_cars_lie_where_it_says(centres: float, front: float) -> None:
    """Wheelsets of the first and of the last equal car against their drawing."""
    cars = EqualCars(5, centres, 0.1, front=front)
    first, last = cars.ends
    assert last - first == pytest.approx(5 * CAR[0])
    axles = cars.train.axles - 0.5 * cars.train.span
    run = axles[4:] if front else axles
    edge = 0.5 * (1 - centres) * CAR[0]
    assert run[0] == pytest.approx(first + edge - 0.05 * CAR[0])
    assert run[-1] == pytest.approx(last - edge + 0.05 * CAR[0])


def test_the_equal_cars_of_a_type_are_those_of_its_drawing() -> None:
    found = like(SHIPPED["metro_A6"])
    assert found is not None
    cars, length = found
    assert cars.cars == 6
    assert length == pytest.approx(22.8)
    assert (cars.centres, cars.base) == pytest.approx((15.7 / 22.8, 2.5 / 22.8))
    found = like(SHIPPED["ICE1"])
    assert found is not None
    assert found[1] == pytest.approx(26.4)
    assert found[0].centres == pytest.approx(19.0 / 26.4)


def test_two_types_of_one_shape_are_equally_likely() -> None:
    """The second is the first enlarged by 1 %: nothing on a bridge can tell them apart."""
    metro = SHIPPED["metro"]
    other = replace(metro, name="other", axle_positions=tuple(1.01 * metro.axles))
    times = wheelset_times("metro", 40.0)
    x = recorded(times, 400.0, ("modes", 40.0), 0.1, 8)
    event = passage(detect(400.0, x, [Channel("b", 0.0, "bridge")], Catalogue((metro, other))))
    assert event is not None
    chances = dict(event.values["types"])  # type: ignore[arg-type]
    # all but the range of speeds is the same, and that favours none
    assert 0.2 < chances["metro"] < 0.8
    found = speed_of(event)
    assert abs(found.value - 40.0) < 2 * found.sigma


@pytest.mark.parametrize("kind", ["hammer", "rain", "spikes", "hum"])
def test_disturbances_are_no_trains(kind: str) -> None:
    sensor = Channel("slab", 0.0, "slab")
    events = detect(float(RATE), nuisance(kind, 900, (sensor,)), sensor, known("CRH3"))
    assert passage(events) is None
