"""The virtual accelerometer against the numbers of its datasheet."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from solver import GRAVITY, InputError, Scenario, Sensor, build_scenario
from trackvib_ros.sensor import SensorArray, VirtualSensor, anti_alias_taps

STEP_NS = 25_000
SOLVER_RATE = 40_000.0
IDEAL = {
    "channel": "rail",
    "rate": 2000,
    "bandwidth": 600.0,
    "range": 1000.0,
    "noise_density": 0.0,
    "bits": 24,
    "coupling": "DC",
}


def spec(**changes: object) -> Sensor:
    return Sensor.model_validate({**IDEAL, **changes})


def measured(sensor: Sensor, motion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Samples of a motion, m/s² up, gravity of a DC sensor removed."""
    samples = VirtualSensor(sensor, STEP_NS).push(motion).astype(np.float64)
    return samples - (GRAVITY if sensor.coupling == "DC" else 0.0)


def sine(frequency: float, seconds: float = 2.0) -> NDArray[np.float64]:
    return np.sin(2 * np.pi * frequency * np.arange(int(seconds * SOLVER_RATE)) / SOLVER_RATE)


@pytest.mark.parametrize(
    ("bandwidth", "rate"), [(5000.0, 20_000), (2000.0, 5000), (400.0, 1000), (600.0, 2000)]
)
def test_filter_has_its_edge_at_the_bandwidth_and_nothing_above_half_the_rate(
    bandwidth: float, rate: int
) -> None:
    taps = anti_alias_taps(bandwidth, rate, SOLVER_RATE)
    lags = (np.arange(taps.size) - taps.size // 2) / SOLVER_RATE

    def gain(frequency: NDArray[np.float64] | float) -> NDArray[np.float64]:
        return np.cos(2 * np.pi * np.multiply.outer(frequency, lags)) @ taps

    np.testing.assert_array_equal(taps, taps[::-1])  # linear phase
    assert gain(0.0) == pytest.approx(1.0, abs=1e-12)
    assert gain(bandwidth) == pytest.approx(np.sqrt(0.5), abs=1e-6)
    # the Kaiser formula meets its attenuation within about 1 dB
    stop = gain(np.linspace(rate / 2, SOLVER_RATE / 2, 4000))
    assert np.abs(stop).max() < 10 ** (-99 / 20)
    assert (taps.size - 1) % (2 * round(SOLVER_RATE / rate)) == 0


@pytest.mark.parametrize("frequency", [5.0, 100.0, 400.0])
def test_a_tone_in_the_band_keeps_amplitude_sign_and_time(frequency: float) -> None:
    sensor = spec()
    samples = measured(sensor, 100.0 * sine(frequency))
    time = np.arange(samples.size) / sensor.rate
    taps = anti_alias_taps(sensor.bandwidth, sensor.rate, SOLVER_RATE)
    lags = (np.arange(taps.size) - taps.size // 2) / SOLVER_RATE
    gain = float(np.cos(2 * np.pi * frequency * lags) @ taps)
    # motion is positive down, the axis up: hence the minus; zero delay: hence no phase
    expected = -100.0 * gain * np.sin(2 * np.pi * frequency * time)
    settled = slice(taps.size // 20 + 1, None)  # before: the tone had not begun
    # resolution of 24 bits over 2000 m/s² and of float32 at 100 m/s²
    np.testing.assert_allclose(samples[settled], expected[settled], atol=2e-4)


def test_a_tone_above_half_the_rate_does_not_alias() -> None:
    # 1900 Hz would appear at 100 Hz
    samples = measured(spec(), 100.0 * sine(1900.0))
    assert np.abs(samples[200:]).max() < 100.0 * 10 ** (-99 / 20) + 2e-4


def test_noise_has_the_density_asked_for_and_is_white() -> None:
    density = 2e-3
    sensor = spec(noise_density=density, coupling="AC", high_pass=0.001, bits=32)
    noise = measured(sensor, np.zeros(int(110 * SOLVER_RATE)))
    n = noise.size
    # one-sided density: variance = density² rate/2, +- 4 sigma of an estimate from n samples
    assert np.var(noise) == pytest.approx(density**2 * sensor.rate / 2, rel=4 * np.sqrt(2 / n))
    power = np.abs(np.fft.rfft(noise)[1:]) ** 2 * 2 / (n * sensor.rate)
    for band in np.array_split(power, 8):
        assert band.mean() == pytest.approx(density**2, rel=4 / np.sqrt(band.size))


def test_range_clips_on_both_sides_and_counts() -> None:
    sensor = VirtualSensor(spec(range=50.0, bits=12, coupling="AC", high_pass=0.01), STEP_NS)
    samples = sensor.push(200.0 * sine(10.0))
    resolution = 100.0 / 2**12
    assert samples.max() == np.float32(50.0 - resolution)  # two's complement: one code less
    assert samples.min() == np.float32(-50.0)
    # |200 sin| > 50 for 1 - 2 asin(1/4)/pi of the time; the ends of the record count +-1 each
    share = 1 - 2 * np.arcsin(0.25) / np.pi
    assert sensor.clipped / samples.size == pytest.approx(share, rel=0.01)


def test_converter_rounds_to_its_steps() -> None:
    sensor = spec(range=64.0, bits=10, coupling="AC", high_pass=0.001)
    resolution = 2 * 64.0 / 2**10
    motion = 20.0 * sine(7.3) + 20.0 * sine(113.7)
    coarse = measured(sensor, motion)
    fine = measured(spec(range=64.0, bits=24, coupling="AC", high_pass=0.001), motion)
    np.testing.assert_array_equal(coarse / resolution, np.round(coarse / resolution))
    error = coarse - fine
    assert np.abs(error).max() <= resolution / 2 * (1 + 1e-3)
    # uniform error: rms = step/sqrt(12), whose estimate from n samples is good to 0.45/sqrt(n)
    assert np.sqrt(np.mean(error**2)) == pytest.approx(
        resolution / np.sqrt(12), rel=4 * 0.45 / np.sqrt(error.size)
    )


def test_dc_coupling_shows_gravity_and_ac_coupling_a_decaying_constant() -> None:
    rest = VirtualSensor(spec(), STEP_NS).push(np.zeros(40_000))
    np.testing.assert_allclose(rest, GRAVITY, atol=1e-4)
    edge = 2.0
    samples = measured(spec(coupling="AC", high_pass=edge), np.full(80_000, -10.0))
    time = np.arange(samples.size) / 2000
    # first-order high-pass; the filter's own rise spreads the start over a few samples
    late = time > 0.05
    shift = np.log(samples[late][0] / 10.0) + 2 * np.pi * edge * time[late][0]
    assert abs(shift) < 0.01
    expected = 10.0 * np.exp(-2 * np.pi * edge * time[late] + shift)
    # bilinear transform: relative error of the rate (pi edge/rate)²/3 = 3e-6
    np.testing.assert_allclose(samples[late], expected, atol=4e-4)


def test_ac_coupling_has_its_edge_at_the_high_pass() -> None:
    edge = 20.0
    samples = measured(spec(coupling="AC", high_pass=edge), 100.0 * sine(edge, 4.0))
    tail = samples[-4000:]  # two seconds, 40 periods
    amplitude = np.sqrt(2 * np.mean(tail**2))
    assert amplitude == pytest.approx(100.0 * np.sqrt(0.5), rel=1e-4)


def test_bias_is_an_offset() -> None:
    sensor = spec(bias=0.25, coupling="AC", high_pass=0.5)
    np.testing.assert_allclose(measured(sensor, np.zeros(40_000)), 0.25, atol=1e-4)


def test_jitter_of_the_instants_makes_the_error_of_a_tone() -> None:
    frequency, jitter = 300.0, 5e-6
    steady = measured(spec(), 100.0 * sine(frequency, 6.0))
    shaken = measured(spec(timing_jitter=jitter), 100.0 * sine(frequency, 6.0))
    error = (shaken - steady)[200:]
    amplitude = np.sqrt(2 * np.mean(steady[200:] ** 2))
    expected = 2 * np.pi * frequency * amplitude / np.sqrt(2) * jitter
    # estimate of an rms from n products of two independent variables: about 1.1/sqrt(n)
    assert np.sqrt(np.mean(error**2)) == pytest.approx(expected, rel=4 * 1.1 / np.sqrt(error.size))


def test_jitter_is_exact_to_second_order() -> None:
    """Every sample is the tone at its own, displaced instant."""
    frequency, jitter = 500.0, 2e-5
    sensor = spec(timing_jitter=jitter)
    virtual = VirtualSensor(sensor, STEP_NS)
    twin = VirtualSensor(sensor, STEP_NS)
    samples = virtual.push(100.0 * sine(frequency)).astype(np.float64) - GRAVITY
    shift = jitter * twin._jitter.standard_normal(samples.size)
    taps = virtual._filters[0]
    lags = (np.arange(taps.size) - taps.size // 2) / SOLVER_RATE
    gain = float(np.cos(2 * np.pi * frequency * lags) @ taps)
    time = np.arange(samples.size) / sensor.rate + shift
    expected = -100.0 * gain * np.sin(2 * np.pi * frequency * time)
    # third-order remainder (2 pi f shift)³/6 of the largest shift, 4 sigma
    remainder = 100.0 * gain * (2 * np.pi * frequency * 4.5 * jitter) ** 3 / 6
    settled = slice(200, None)
    np.testing.assert_allclose(samples[settled], expected[settled], atol=remainder + 5e-4)


def test_dropouts_come_as_often_and_last_as_long_as_asked() -> None:
    rate, duration, seconds = 2.0, 0.02, 400
    sensor = VirtualSensor(spec(dropout_rate=rate, dropout_duration=duration), STEP_NS)
    lost = np.concatenate(
        [np.isnan(sensor.push(np.zeros(int(SOLVER_RATE)))) for _ in range(seconds)]
    )
    # alternating renewal process: time in drop-outs = duration / (duration + 1/rate)
    share = duration / (duration + 1 / rate)
    starts = np.count_nonzero(np.diff(lost.astype(int)) == 1)
    expected = seconds / (duration + 1 / rate)
    # drop-outs shorter than a sampling interval may fall between two samples
    seen = expected * np.exp(-0.5 / (2000 * duration))
    assert starts == pytest.approx(seen, abs=4 * np.sqrt(expected))
    assert lost.mean() == pytest.approx(share, rel=4 * np.sqrt(2 / expected))
    assert sensor.dropped == np.count_nonzero(lost)


EVERYTHING = spec(
    noise_density=1e-3,
    timing_jitter=1e-5,
    dropout_rate=30.0,
    dropout_duration=0.005,
    coupling="AC",
    range=60.0,
    bits=16,
    bias=0.1,
)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(0, 3000), min_size=1, max_size=12))
def test_the_cutting_into_blocks_changes_no_bit(lengths: list[int]) -> None:
    motion = 80.0 * np.random.default_rng(5).standard_normal(8000)
    whole = VirtualSensor(EVERYTHING, STEP_NS).push(motion)
    sensor = VirtualSensor(EVERYTHING, STEP_NS)
    cuts = np.unique(np.clip(np.cumsum([0, *lengths]), 0, motion.size)).tolist()
    parts = [sensor.push(motion[a:b]) for a, b in pairwise([*cuts, motion.size])]
    np.testing.assert_array_equal(np.concatenate(parts), whole)
    assert np.isnan(whole).any()


def test_seed_and_channel_decide_the_noise() -> None:
    def noise(**changes: object) -> NDArray[np.float64]:
        return measured(spec(noise_density=1e-2, bits=32, **changes), np.zeros(400_000))

    first = noise(seed=1)
    np.testing.assert_array_equal(first, noise(seed=1))
    for other in (noise(seed=2), noise(seed=1, channel="slab")):
        # correlation of n independent pairs is 1/sqrt(n)
        assert abs(np.corrcoef(first, other)[0, 1]) < 4 / np.sqrt(first.size)


def test_impossible_sensors_are_refused() -> None:
    with pytest.raises(InputError, match="so close to half the rate"):
        VirtualSensor(spec(bandwidth=999.0), STEP_NS)
    with pytest.raises(InputError, match=r"timing_jitter = 0.001 s"):
        VirtualSensor(spec(timing_jitter=1e-3), STEP_NS)


def scenario(sensors: list[dict[str, object]], **channel: object) -> Scenario:
    channels = [
        {"name": "a", "layer": "rail", "x": 2.0, **channel},
        {"name": "b", "layer": "rail", "x": 4.0},
        {"name": "c", "layer": "slab", "x": 4.0},
    ]
    line = {"approach_left": 5.0, "approach_right": 5.0, "spans": []}
    base = {key: value for key, value in IDEAL.items() if key != "channel"}
    return build_scenario(
        {"line": line, "channel": channels, "sensor": [{**base, **sensor} for sensor in sensors]}
    )


def test_array_groups_by_layer_and_rate_and_gives_gapless_blocks() -> None:
    array = SensorArray(
        scenario([{"channel": "b"}, {"channel": "c", "rate": 1000, "bandwidth": 300.0}]),
        ["a", "b", "c"],
    )
    assert [(group.name, group.channels) for group in array.groups] == [
        ("rail", ("b",)),
        ("slab", ("c",)),
    ]
    motion = np.zeros((20_000, 3))
    motion[:, 1], motion[:, 2] = -1.0, -2.0
    blocks = [block for part in np.array_split(motion, 7) for block in array.push(part)]
    for name, level, samples, dt_ns in (("rail", 1.0, 40, 500_000), ("slab", 2.0, 20, 1_000_000)):
        own = [block for block in blocks if block.frame_id == name]
        assert [block.stamp_ns for block in own] == [20_000_000 * k for k in range(len(own))]
        assert {block.data.shape for block in own} == {(samples, 1)}
        assert {block.dt_ns for block in own} == {dt_ns}
        np.testing.assert_allclose(own[-1].data, GRAVITY + level, atol=1e-3)  # column by name
    mixed = SensorArray(
        scenario([{"channel": "a"}, {"channel": "b", "rate": 4000}]), ["a", "b", "c"]
    )
    assert [group.name for group in mixed.groups] == ["rail_2000hz", "rail_4000hz"]


def test_array_refuses_what_is_no_accelerometer() -> None:
    with pytest.raises(InputError, match='quantity is "strain"'):
        SensorArray(scenario([{"channel": "a"}], quantity="strain"), ["a", "b", "c"])
    with pytest.raises(InputError, match="already has one"):
        SensorArray(scenario([{"channel": "a"}, {"channel": "a"}]), ["a", "b", "c"])
