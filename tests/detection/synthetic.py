"""Synthetic passages with exact ground truth, made without the solver.

Rail: every wheelset carries a pulse along the track. ``burst``: noise (30-600 Hz) with a Gaussian
envelope of 0.6 m plus a skirt falling 0.9 dB/m, each wheelset with its own noise and 2 dB of level;
``pulse``: the acceleration v² w''(x) of a beam on an elastic foundation (beta = 1.0 1/m), the
quasi-static part of a clean solver signal, with 5 % of the burst. Slab: the foundation pulse with a
deck length of 3 m. Bridge: first two modes of a simply supported 32 m span under moving loads.
SNR: rms of the clean signal between first and last wheelset over the rms of the white noise, both
over the whole band of the channel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from trackvib_ros.detection import Catalogue, Channel
from trackvib_ros.waveform import Waveform

Array = NDArray[np.float64]
CATALOGUE = Catalogue.default()

RAILS = (Channel("rail_a", 0.0, "rail"), Channel("rail_b", 20.0, "rail"))
DEMO = (*RAILS, Channel("slab_mid", 10.0, "slab"), Channel("bridge_mid", 10.0, "bridge"))
DEMO_RATES = {"rail": 10_000, "slab": 5_000, "bridge": 2_000}


@dataclass(frozen=True)
class Passage:
    """One train: kinematics of its first wheelset past x = 0, dir * x = v t + a t²/2."""

    axles: Array
    speed: float
    start: float = 3.0
    acceleration: float = 0.0
    direction: int = 1
    level: float = 1.0
    truth: dict[str, float] = field(default_factory=dict)

    def distance(self, time: Array) -> Array:
        t = time - self.start
        if self.acceleration < 0:  # stays at its stop
            t = np.minimum(t, -self.speed / self.acceleration)
        return self.speed * t + 0.5 * self.acceleration * t**2

    def velocity(self, time: Array) -> Array:
        return self.speed + self.acceleration * (time - self.start)

    def axle_times(self, x: float) -> Array:
        s = self.direction * x + self.axles
        a = self.acceleration
        if a == 0:
            return self.start + s / self.speed
        root = np.sqrt(np.maximum(self.speed**2 + 2 * a * s, 0))
        return self.start + 2 * s / (self.speed + root)

    def mid_speed(self, x: float = 0.0) -> float:
        s = self.direction * x + 0.5 * self.axles[-1]
        return float(np.sqrt(self.speed**2 + 2 * self.acceleration * s))


def _band_noise(rng: np.random.Generator, n: int, rate: float, low: float, high: float) -> Array:
    sos = signal.butter(2, [low, min(high, 0.45 * rate)], "bandpass", fs=rate, output="sos")
    noise = signal.sosfilt(sos, rng.standard_normal(n + 400))[400:]
    return noise / noise.std()


def clean(
    passage: Passage, channel: Channel, time: Array, rate: float, rng: np.random.Generator, kind: str
) -> Array:
    """Noise-free acceleration of one channel, scaled to about 1 in the passage."""
    out = np.zeros(time.size)
    s = passage.distance(time) - passage.direction * channel.x
    if channel.layer == "bridge":
        return passage.level * _bridge(passage, channel, time, rate)
    reach = 40.0
    for offset in passage.axles:
        first, last = np.searchsorted(s, [offset - reach, offset + reach])
        if last - first < 4:
            continue
        xi = s[first:last] - offset
        v = passage.velocity(time[first:last])
        if channel.layer == "rail":
            envelope = np.exp(-0.5 * (xi / 0.6) ** 2) + 0.12 * 10 ** (-0.9 * np.abs(xi) / 20)
            gain = 10 ** (0.1 * rng.standard_normal())
            burst = gain * envelope * _band_noise(rng, xi.size, rate, 30, 600)
            if kind == "burst":
                out[first:last] += burst
                continue
            beta = 1.0
            out[first:last] += 0.05 * burst
        else:
            beta = 0.33
        q = beta * np.abs(xi)
        out[first:last] += (v / 80) ** 2 * np.exp(-q) * (np.cos(q) - np.sin(q))
    return passage.level * out


def _bridge(passage: Passage, channel: Channel, time: Array, rate: float) -> Array:
    length, left = 32.0, channel.x - 16.0
    out = np.zeros(time.size)
    for mode, frequency in ((1, 4.4), (2, 17.0)):
        force = np.zeros(time.size)
        position = passage.direction * passage.distance(time)
        for offset in passage.axles:
            x = position - passage.direction * offset - left
            force += np.where((x > 0) & (x < length), np.sin(mode * np.pi * x / length), 0.0)
        w = 2 * np.pi * frequency
        system = signal.cont2discrete(([1.0, 0, 0], [1.0, 2 * 0.02 * w, w * w]), 1 / rate, "bilinear")
        response = signal.lfilter(system[0].ravel(), system[1], force)
        out += np.sin(mode * np.pi * (channel.x - left) / length) * response
    return out / 4


def record(
    passages: Sequence[Passage],
    channels: Sequence[Channel] = RAILS,
    snr_db: float = 40.0,
    seed: int = 0,
    duration: float | None = None,
    kind: str = "burst",
    rates: dict[str, int] | None = None,
) -> dict[str, tuple[int, Array]]:
    """Rate (Hz) and samples of every channel by name."""
    rates = rates or DEMO_RATES
    rng = np.random.default_rng(seed)
    if duration is None:
        duration = max((p.axle_times(c.x).max() for p in passages for c in channels), default=5) + 4
    out = {}
    for channel in channels:
        rate = rates[channel.layer]
        time = np.arange(int(duration * rate)) / rate
        total = np.zeros(time.size)
        reference = 0.0
        for passage in passages:
            part = clean(passage, channel, time, rate, rng, kind)
            times = passage.axle_times(channel.x)
            inside = (time >= times[0]) & (time <= times[-1])
            if inside.any():
                reference = max(reference, float(np.sqrt(np.mean(part[inside] ** 2))))
            total += part
        noise = (reference or 1.0) * 10 ** (-snr_db / 20)
        out[channel.name] = (rate, total + noise * rng.standard_normal(time.size))
    return out


def blocks(
    signals: dict[str, tuple[int, Array]], length_s: float = 0.05, stamp_ns: int = 0
) -> list[Waveform]:
    """The signals as blocks in time order, channels of one rate grouped."""
    groups: dict[int, list[str]] = {}
    for name, (rate, _) in signals.items():
        groups.setdefault(rate, []).append(name)
    out = []
    for rate, names in groups.items():
        data = np.stack([signals[name][1] for name in names], axis=1).astype(np.float32)
        dt = round(1e9 / rate)
        size = max(1, round(length_s * rate))
        for first in range(0, len(data), size):
            out.append(Waveform(stamp_ns + first * dt, dt, tuple(names), data[first : first + size]))
    return sorted(out, key=lambda block: block.end_ns)
