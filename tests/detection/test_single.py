"""One rail and a train that no catalogue lists: its wheelsets, and a speed with an honest sigma."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import fft

from tests.detection.synthetic import RAILS, Passage, record
from trackvib_ros.detection import CONFIRMED, Catalogue, detect
from trackvib_ros.detection.blind import Blind
from trackvib_ros.detection.bowl import _LOADS, _STRENGTHS, _odds, corner, low_pass
from trackvib_ros.detection.kinematics import PRIOR_ACCELERATION, Motion
from trackvib_ros.detection.passage import _SCATTER, UNLIKE
from trackvib_ros.detection.place import Wave
from trackvib_ros.detection.single import Shown, _likeliest, _Trial, accelerated, bogies
from trackvib_ros.detection.wheelsets import Wheelsets

STEP = 0.001
CAR = np.array([0.0, 2.5, 17.5, 20.0])
PLACES = (CAR + 25.0 * np.arange(6)[:, None]).ravel()


def bowls(wavenumber: float, speed: float, noise: float, rng: np.random.Generator) -> Wave:
    """A waveform made of the pulses of the module's equation, first wheelset at 1 s, and noise."""
    time = STEP * np.arange(round((PLACES[-1] / speed + 2) / STEP))
    f = fft.rfftfreq(time.size, STEP)
    x = 2 * np.pi * f / (wavenumber * speed)
    loads = rng.uniform(0.8, 1.2, PLACES.size)
    late = np.exp(-2j * np.pi * np.outer(f, 1.0 + PLACES / speed)) @ loads
    value = fft.irfft(np.sqrt(low_pass(f, STEP)) * x**2 / (1 + x**4) * late, time.size)
    value /= np.abs(value).max()
    value += noise * rng.standard_normal(time.size)
    return Wave(time, value, np.ones(time.size, dtype=bool))


@pytest.mark.parametrize(("wavenumber", "speed"), [(1.5, 30.0), (1.8, 60.0), (2.1, 90.0)])
def test_corner_of_its_own_equation(wavenumber, speed):
    wave = bowls(wavenumber, speed, 0.0, np.random.default_rng(0))
    found = corner(wave, 1.0 + PLACES / speed, 1.1 * wavenumber * speed)
    # the search ends at 4e-3 of ln, the prior about 1 Hz of coupling pulls a little more
    assert found.value == pytest.approx(wavenumber * speed, rel=0.01)
    assert found.explained > 0.995


def test_sigma_of_the_corner_holds():
    rng = np.random.default_rng(1)
    ratios = []
    for _ in range(16):
        speed, wavenumber = rng.uniform(30, 80), rng.uniform(1.5, 2.1)
        wave = bowls(wavenumber, speed, 0.15, rng)
        found = corner(wave, 1.0 + PLACES / speed, 1.8 * speed, refits=0)
        ratios.append(np.log(found.value / (wavenumber * speed)) / found.sigma)
    # chi-square of 16: 99.9 % lies below 39
    assert np.sqrt(np.mean(np.square(ratios))) < 1.57


@pytest.mark.parametrize(("speed", "base", "length"), [(35.0, 2.7, 26.0), (80.0, 2.3, 22.0)])
def test_an_unlisted_train_on_one_rail(speed, base, length):
    car = np.array([0.0, base, 0.7 * length, 0.7 * length + base])
    axles = (car + length * np.arange(5)[:, None]).ravel()
    only = Catalogue((Catalogue.default()["articulated"],), "one type of another shape")
    truth = Passage(axles, speed)
    rate, x = record([truth], RAILS[:1], 10, kind="pulse", rates={"rail": 2000})["rail_a"]
    (passage,) = (e for e in detect(rate, x, RAILS[0], only) if e.kind == "passage")
    values = passage.values
    assert values["grade"] == CONFIRMED and values["type"] == "unknown"
    assert values["direction"] == "unknown"
    assert values["axle_count"] == axles.size
    # the sigma is that of what is known of wheelbases and of foundations beforehand
    assert 0.03 < values["speed"].sigma / speed < 0.2
    assert abs(values["speed"].value - speed) < 2.5 * values["speed"].sigma
    low, high = values["speed_interval"]
    assert low < values["speed"].value < high
    times = 1e-9 * np.array([passage.stamp_ns, values["departure_ns"]])
    assert np.allclose(times, truth.axle_times(0.0)[[0, -1]], atol=0.15 / speed)


def test_wheelsets_elsewhere_contradict_a_type():
    speed = 50.0
    wave = bowls(1.8, speed, 0.3, np.random.default_rng(2))
    motion = Motion(1.0, 0.0, speed, 0.0, np.zeros((3, 3)))
    blind = Blind(
        sensors=("rail_a",),
        x=0.0,
        motion=motion,
        speed=(speed, 4.0),
        times=motion.time_at(PLACES),
        time_sigma=np.full(PLACES.size, 1e-3),
        regular=0.95,
        direction=0,
        correlation=0.0,
        travels=True,
        method="",
    )
    assert not blind.contradicts(PLACES + 0.3, motion, wave)
    moved = PLACES.copy()
    moved[:2] += 5.0  # another first bogie
    assert blind.contradicts(moved, motion, wave)
    assert blind.contradicts(PLACES[2:], motion, wave)
    assert blind.contradicts(PLACES[:-2], motion, wave)
    # what clipping has cut off, a hole hides, or no deflection shows, contradicts nothing
    assert not blind.contradicts(moved, motion, replace(wave, clipped=True))
    here = np.abs(motion.distance_at(wave.time)[:, None] - [[0.0, 2.5, 5.0, 7.5]]).min(axis=1) < 2
    assert not blind.contradicts(moved, motion, replace(wave, valid=~here))
    noise = np.random.default_rng(3).standard_normal(wave.time.size)
    assert not blind.contradicts(moved, motion, replace(wave, value=noise))
    # nor do bogies that it missed itself, where a type explains the deflection with them
    for k in (0, 8, PLACES.size - 2):
        fewer = replace(blind, times=np.delete(blind.times, [k, k + 1]))
        assert not fewer.contradicts(PLACES, motion, wave)
    # cars whose bogies stand in another ratio are another type's, though no wheelset is 0.6 m off
    coaches = replace(blind, cars=bogies(blind.times).ratio)
    assert coaches.cars == pytest.approx(17.5 / 7.5)
    assert not coaches.contradicts(PLACES, motion, wave)
    longer = PLACES + np.tile([0.0, 0.0, 0.5, 0.5], 6)
    assert coaches.contradicts(longer, motion, wave)
    assert not blind.contradicts(longer, motion, wave)
    # not one of the type's was seen: they are there, or not
    one = replace(blind, times=blind.times[:1])
    assert not one.contradicts(PLACES[2:6], motion, wave)
    assert one.contradicts(np.array([33.0, 35.5, 58.0, 60.5]), motion, wave)


@pytest.mark.parametrize("speed", [5.0, 110.0])
def test_bogies_are_seen_whatever_the_speed(speed):
    stand = bogies(PLACES / speed)
    assert stand.clear and stand.share == 1.0
    assert stand.base == pytest.approx(2.5 / speed)
    assert stand.speeds()[0] == pytest.approx(speed)
    assert stand.cars and stand.regular == 1.0
    # one chance pulse moves no wheelbase: that which repeats most is taken
    chance = bogies(np.sort(np.append(PLACES, PLACES[4] - 2.2)) / speed)
    assert chance.base == pytest.approx(2.5 / speed, rel=0.01)
    threes = bogies((np.array([0.0, 1.4, 2.8]) + 16.0 * np.arange(5)[:, None]).ravel() / speed)
    assert (stand.each, threes.each) == (2.0, 3.0)
    # blows of a hammer that ring on
    rung = bogies((np.array([0.0, 0.02]) + 0.7 * np.arange(12)[:, None]).ravel())
    assert not rung.clear and not rung.cars
    even = bogies(np.arange(24) / speed)  # what is evenly spaced has none
    assert not even.clear


def test_evidence_of_loads_is_that_of_their_gaussian_process():
    rng = np.random.default_rng(4)
    x = rng.standard_normal((40, 5))
    y = x @ rng.normal(1.0, 0.3, 5) + 0.8 * rng.standard_normal(40)
    covariance = x @ (np.ones((5, 5)) + _LOADS**2 * np.eye(5)) @ x.T
    logs = []
    for g in _STRENGTHS:
        c = np.eye(40) + g * covariance
        misfit = y @ np.linalg.solve(c, y) / (y @ y)
        logs.append(-20 * np.log(misfit) - 0.5 * np.linalg.slogdet(c)[1])
    assert _odds(x, y, 40.0) == pytest.approx(max(logs), rel=1e-9)


def test_short_waves_at_every_wheelset_are_no_faster_train():
    """Roughness that shakes every wheelset alike has pulses of its own, three for each."""
    speed, wavelength = 35.0, 0.5
    wave = bowls(1.8, speed, 0.05, np.random.default_rng(5))
    passed = 1.0 + PLACES / speed
    away = speed * (wave.time[:, None] - passed)
    shaken = np.cos(2 * np.pi * away / wavelength) * np.exp(-0.5 * (away / 0.4) ** 2)
    wave = replace(wave, value=wave.value + shaken.sum(axis=1))
    thrice = np.sort((passed[:, None] + wavelength / speed * np.arange(-1, 2)).ravel())

    def trial(speed, times):
        n = times.size
        found = Wheelsets(times, np.ones(n), np.full(n, 0.02), 8.0, 1.0, 0.9, np.ones(3))
        return _Trial(speed, found, times, True, bogies(times))

    slow, fast = trial(speed, passed), trial(3 * speed, thrice)
    assert slow.bogies.clear and fast.bogies.clear
    span = float(passed[0]) - 0.2, float(passed[-1]) + 0.2
    shown = Shown(None, span, span, (10.0, 120.0), None, 0)
    shown.__dict__["wave"] = wave
    # in its own waves the faster train explains more than the slower one in those that it has
    assert fast.worth(shown, fast.likely) > slow.worth(shown, slow.likely)
    assert _likeliest(shown, [fast, slow])[0] is slow


@pytest.mark.parametrize("wheelsets", [10, 24])
def test_cars_of_one_kind_tell_the_acceleration(wheelsets):
    """Jacobs bogies 16 m apart, or coaches; times scatter by 3 cm."""
    articulated = (np.array([0.0, 2.7]) + 16.0 * np.arange(5)[:, None]).ravel()
    places = {10: articulated, 24: PLACES}[wheelsets]
    rng = np.random.default_rng(6)
    ratios, sigmas = [], []
    for _ in range(100):
        speed = rng.uniform(25, 80)
        motion = Motion(0.0, 0.0, speed, 0.6 * rng.standard_normal(), np.zeros((3, 3)))
        times = motion.time_at(places + 0.03 * rng.standard_normal(wheelsets))
        middle = motion.speed_at(0.5 * (times[0] + times[-1]))
        rate, sigma = accelerated(times, 0.03 / middle, bogies(times), middle)
        ratios.append((rate - motion.acceleration) / sigma)
        sigmas.append(sigma)
    # the rms of 100 ratios has a standard deviation of 0.07
    assert 0.8 < np.sqrt(np.mean(np.square(ratios))) < 1.2
    assert np.median(sigmas) < (0.03 if wheelsets > 10 else 0.3)
    # what has no cars tells nothing
    assert accelerated(times[:6], 1e-3, bogies(times[:6]), middle) == (0.0, PRIOR_ACCELERATION)


def test_scatter_that_is_as_likely_of_an_unlisted_train():
    at = np.log(UNLIKE)
    listed, other = (p / s * np.exp(-0.5 * ((at - m) / s) ** 2) for m, s, p in _SCATTER)
    assert listed == pytest.approx(other, rel=0.03)
