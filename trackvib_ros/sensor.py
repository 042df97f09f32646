"""Virtual accelerometers in datasheet terms: solver acceleration in, sampled waveforms out.

The chain of one sensor, in this order: axis (up) - anti-alias filter and decimation (with timing
jitter) - AC or DC coupling - bias and white noise - range and converter - drop-outs. Every stage
carries its state from block to block, so cutting the input differently gives the same bits.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable, Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.signal import butter, firwin, kaiser_beta, kaiserord

from solver import GRAVITY, InputError, Scenario, Sensor
from trackvib_ros.waveform import Waveform

BLOCKS_PER_SECOND = 50
"""Waveform blocks per second of simulated time."""

STOPBAND_DB = 100.0
"""Attenuation of the anti-alias filter from half the sampling rate on (dB)."""

MAX_TAPS = 40_001
UP = -1.0
"""The solver's motion is positive down, a sensor's axis points up."""


def anti_alias_taps(bandwidth: float, rate: float, solver_rate: float) -> NDArray[np.float64]:
    """Taps of the linear-phase low-pass before decimation (Kaiser window), shape (2 H + 1,).

    The gain is 1 at 0 Hz, 1/sqrt(2) at ``bandwidth`` (Hz) and below -100 dB from ``rate/2`` (Hz)
    on; H is a multiple of the decimation factor, so that the delay is a whole number of samples.

    Raises:
        InputError: the band between bandwidth and rate/2 is too narrow for a practical filter.
    """
    transition = min(rate / 2 - bandwidth, bandwidth / 2)
    count, _ = kaiserord(STOPBAND_DB, transition / (solver_rate / 2))
    decimation = round(solver_rate / rate)
    half = -(-count // (2 * decimation)) * decimation
    if 2 * half + 1 > MAX_TAPS:
        raise InputError(
            f"sensor bandwidth = {bandwidth:g} Hz is so close to half the rate {rate:g} Hz that "
            f"the anti-alias filter needs {2 * half + 1} taps: lower the bandwidth or raise the "
            "rate"
        )
    window = ("kaiser", kaiser_beta(STOPBAND_DB))
    lags = np.arange(-half, half + 1) / solver_rate

    def taps(cutoff: float) -> NDArray[np.float64]:
        return np.asarray(firwin(2 * half + 1, cutoff, window=window, fs=solver_rate))

    def excess(cutoff: float) -> float:
        gain = float(taps(cutoff) @ np.cos(2 * np.pi * bandwidth * lags))
        return gain - math.sqrt(0.5)

    return taps(float(brentq(excess, bandwidth * 0.5, bandwidth + transition / 2, xtol=1e-9)))


def _derivative(taps: NDArray[np.float64], rate: float, order: int) -> NDArray[np.float64]:
    """Taps that give the time derivative of what ``taps`` give (spectral differentiation)."""
    omega = 2 * np.pi * np.fft.rfftfreq(taps.size, 1 / rate)
    return np.fft.irfft((1j * omega) ** order * np.fft.rfft(taps), taps.size)


class _Dropouts:
    """Poisson drop-outs of exponentially distributed length."""

    def __init__(self, spec: Sensor, random: np.random.Generator) -> None:
        self._rate, self._duration, self._random = spec.dropout_rate, spec.dropout_duration, random
        self._start = self._end = 0.0
        if self._rate > 0:
            self._next()

    def _next(self) -> None:
        self._start = self._end + self._random.exponential(1 / self._rate)
        self._end = self._start + self._random.exponential(self._duration)

    def mask(self, time: NDArray[np.float64]) -> NDArray[np.bool_]:
        """True where the sample is lost; ``time`` (s) must continue the last call's."""
        lost = np.zeros(time.size, dtype=bool)
        while self._rate > 0 and time.size and self._start <= time[-1]:
            lost |= (time >= self._start) & (time < self._end)
            if self._end > time[-1]:
                break
            self._next()
        return lost


class VirtualSensor:
    """One accelerometer of a datasheet, fed with solver acceleration block by block.

    Sample ``k`` is the acceleration at ``k / rate``: the delay of the linear-phase filter is
    compensated, so samples come out ``latency`` seconds after the motion they describe.

    Args:
        spec: the datasheet.
        step_ns: solver step (ns).

    Attributes:
        samples: samples given out so far.
        clipped: samples so far at the end of the range.
        dropped: samples so far lost to drop-outs.

    Raises:
        InputError: no practical anti-alias filter, or more jitter than the model holds for.
    """

    def __init__(self, spec: Sensor, step_ns: int) -> None:
        self.spec = spec
        self.samples = self.clipped = self.dropped = 0
        solver_rate = 1e9 / step_ns
        self._decimation = round(solver_rate / spec.rate)
        taps = anti_alias_taps(spec.bandwidth, spec.rate, solver_rate)
        if 2 * np.pi * spec.bandwidth * spec.timing_jitter > 0.3:
            raise InputError(
                f'sensor on "{spec.channel}": timing_jitter = {spec.timing_jitter:g} s is more '
                f"than 0.3/(2 pi bandwidth) = {0.3 / (2 * np.pi * spec.bandwidth):.3g} s, the "
                "limit of the jitter model"
            )
        orders = (0, 1, 2) if spec.timing_jitter > 0 else (0,)
        every = [_derivative(taps, solver_rate, n) if n else taps for n in orders]
        # first tap last: a scalar product with samples in order is then the convolution
        self._filters = np.ascontiguousarray(np.array(every)[:, ::-1])
        half = taps.size // 2
        self.latency = half / solver_rate
        self._pending = np.zeros(half)
        self._high_pass = np.array([1.0, 0.0, 0.0])
        if spec.coupling == "AC":
            (b0, b1), (_, a1) = butter(1, spec.high_pass, "highpass", fs=spec.rate)
            self._high_pass[:] = b0, b1, a1
        self._memory = np.zeros(1)
        self._offset = spec.bias + (0.0 if spec.coupling == "AC" else GRAVITY)
        self._deviation = spec.noise_density * math.sqrt(spec.rate / 2)
        self._half_codes = 2.0 ** (spec.bits - 1)
        streams = [
            np.random.default_rng([spec.seed, zlib.crc32(spec.channel.encode()), purpose])
            for purpose in range(3)
        ]
        self._noise, self._jitter = streams[0], streams[1]
        self._dropouts = _Dropouts(spec, streams[2])

    def push(self, acceleration: NDArray[np.float64]) -> NDArray[np.float32]:
        """Take solver acceleration (m/s², positive down), give the samples now complete (m/s², up).

        Drop-outs are NaN.
        """
        length, step = self._filters.shape[1], self._decimation
        self._pending = np.concatenate((self._pending, acceleration))
        count = max(0, (self._pending.size - length) // step + 1)
        output = np.empty(count, np.float32)
        if count == 0:
            return output
        shift = np.zeros(0)
        if len(self._filters) > 1:
            shift = self.spec.timing_jitter * self._jitter.standard_normal(count)
        self.clipped += _sample(
            self._pending,
            self._filters,
            step,
            shift,
            self._high_pass,
            self._memory,
            self._offset,
            self._deviation,
            self._noise.standard_normal(count),
            self.spec.range / self._half_codes,
            self._half_codes,
            output,
        )
        self._pending = self._pending[count * step :]
        if self.spec.dropout_rate > 0:
            lost = self._dropouts.mask((self.samples + np.arange(count)) / self.spec.rate)
            output[lost] = np.nan
            self.dropped += int(np.count_nonzero(lost))
        self.samples += count
        return output


@njit(cache=True, fastmath={"contract", "reassoc"})
def _tap(pending, begin, filters, order):  # type: ignore[no-untyped-def]
    total = 0.0
    for k in range(filters.shape[1]):
        total += filters[order, k] * pending[begin + k]
    return total


@njit(cache=True)
def _sample(  # type: ignore[no-untyped-def]
    pending,
    filters,
    step,
    shift,
    high_pass,
    memory,
    offset,
    deviation,
    noise,
    resolution,
    half_codes,
    output,
):
    """Fill ``output``; the taps of a sample are summed in one order, however blocks are cut.

    Returns the number of samples at the end of the range.
    """
    b0, b1, a1 = high_pass[0], high_pass[1], high_pass[2]
    kept, clipped = memory[0], 0
    for n in range(output.size):
        value = _tap(pending, n * step, filters, 0)
        if filters.shape[0] > 1:
            slope = _tap(pending, n * step, filters, 1)
            curvature = _tap(pending, n * step, filters, 2)
            value += shift[n] * slope + 0.5 * shift[n] ** 2 * curvature
        value *= UP
        passed = b0 * value + kept
        kept = b1 * value - a1 * passed
        code = np.rint((passed + offset + deviation * noise[n]) / resolution)
        if code <= -half_codes or code >= half_codes - 1:
            clipped += 1
        output[n] = min(max(code, -half_codes), half_codes - 1) * resolution
    memory[0] = kept
    return clipped


class SensorGroup:
    """Sensors of one layer and rate, whose samples travel together in blocks of fixed length.

    Attributes:
        name: name of the group, also its frame.
        sensors: one per channel of the waveform.
        rate: sampling rate (Hz).
        block_samples: samples per block, 1/50 s.
    """

    def __init__(self, name: str, columns: Sequence[int], sensors: Sequence[VirtualSensor]) -> None:
        self.name, self.sensors = name, tuple(sensors)
        self.channels = tuple(sensor.spec.channel for sensor in sensors)
        self.rate = sensors[0].spec.rate
        self.block_samples = max(2, round(self.rate / BLOCKS_PER_SECOND))
        self._columns = tuple(columns)
        self._ready = [np.empty(0, np.float32) for _ in sensors]
        self._next = 0

    def push(self, acceleration: NDArray[np.float64]) -> Iterable[Waveform]:
        """Take the solver's (samples, channels) in m/s², positive down; give complete blocks."""
        for row, (sensor, column) in enumerate(zip(self.sensors, self._columns, strict=True)):
            self._ready[row] = np.concatenate(
                (self._ready[row], sensor.push(acceleration[:, column]))
            )
        dt_ns = 1_000_000_000 // self.rate
        while min(samples.size for samples in self._ready) >= self.block_samples:
            data = np.stack([samples[: self.block_samples] for samples in self._ready], axis=1)
            self._ready = [samples[self.block_samples :] for samples in self._ready]
            stamp = self._next * dt_ns
            self._next += self.block_samples
            yield Waveform(stamp, dt_ns, self.channels, data, self.name)


class SensorArray:
    """All sensors of a scenario, grouped by layer (and by rate where a layer has several).

    Args:
        scenario: states channels and sensors.
        channels: names of the columns of the acceleration that will be pushed.

    Raises:
        InputError: a sensor sits on a channel that is no motion, two sensors share a channel, or a
            rate is not a whole number of nanoseconds.
    """

    def __init__(self, scenario: Scenario, channels: Sequence[str]) -> None:
        by_name = {channel.name: channel for channel in scenario.channel}
        layers: dict[str, dict[int, list[Sensor]]] = {}
        seen: set[str] = set()
        for spec in scenario.sensor:
            channel = by_name[spec.channel]
            if channel.quantity != "motion":
                raise InputError(
                    f'sensor on "{spec.channel}": the channel\'s quantity is "{channel.quantity}"; '
                    'an accelerometer needs "motion"'
                )
            if spec.channel in seen:
                raise InputError(
                    f'sensor on "{spec.channel}": the channel already has one; add another channel '
                    "at the same place"
                )
            if 1_000_000_000 % spec.rate:
                raise InputError(
                    f'sensor on "{spec.channel}": rate = {spec.rate} Hz: its interval is not a '
                    "whole number of nanoseconds; choose a divisor of 1000000000"
                )
            seen.add(spec.channel)
            layers.setdefault(channel.layer, {}).setdefault(spec.rate, []).append(spec)
        step_ns = scenario.solution.step_ns
        self.groups = tuple(
            SensorGroup(
                layer if len(rates) == 1 else f"{layer}_{rate}hz",
                [list(channels).index(spec.channel) for spec in specs],
                [VirtualSensor(spec, step_ns) for spec in specs],
            )
            for layer, rates in layers.items()
            for rate, specs in rates.items()
        )

    def push(self, acceleration: NDArray[np.float64]) -> list[Waveform]:
        """Take the solver's (samples, channels) in m/s², positive down; give complete blocks."""
        return [block for group in self.groups for block in group.push(acceleration)]

    @property
    def clipped(self) -> int:
        """Samples so far at the end of their range, all sensors."""
        return sum(sensor.clipped for group in self.groups for sensor in group.sensors)

    @property
    def dropped(self) -> int:
        """Samples so far lost to drop-outs, all sensors."""
        return sum(sensor.dropped for group in self.groups for sensor in group.sensors)
