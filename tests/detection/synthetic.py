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
    passage: Passage,
    channel: Channel,
    time: Array,
    rate: float,
    rng: np.random.Generator,
    kind: str,
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
        system = signal.cont2discrete(
            ([1.0, 0, 0], [1.0, 2 * 0.02 * w, w * w]), 1 / rate, "bilinear"
        )
        response = signal.lfilter(system[0].ravel(), system[1], force)
        out += np.sin(mode * np.pi * (channel.x - left) / length) * response
    return out / 4


def flat_blows(
    passage: Passage,
    channel: Channel,
    time: Array,
    rate: float,
    wheelsets: Sequence[int],
    amplitude: float,
) -> Array:
    """Hits of flat wheels: every 2.9 m of way, heard 1 dB weaker a metre, 2 ms at 300 Hz."""
    out = np.zeros(time.size)
    s = passage.distance(time)
    for number in wheelsets:
        place = s - passage.axles[number]  # of the wheelset along the track
        for k in range(-14, 15):
            at = 2.9 * (k + 0.37 * number % 1)
            i = int(np.searchsorted(place, at))
            if not 0 < i < time.size:
                continue
            near = 10 ** (-abs(at - passage.direction * channel.x) / 20)
            t = np.arange(int(0.02 * rate)) / rate
            blow = amplitude * near * np.exp(-t / 2e-3) * np.sin(2 * np.pi * 300 * t)
            part = out[i : i + t.size]
            part += blow[: part.size]
    return out


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
            out.append(
                Waveform(stamp_ns + first * dt, dt, tuple(names), data[first : first + size])
            )
    return sorted(out, key=lambda block: block.end_ns)


NUISANCES = ("hammer", "road", "footsteps", "trolley", "rain", "spikes", "hum", "neighbour")


def nuisance(kind: str, duration: float, rate: float, rng: np.random.Generator) -> Array:
    """A disturbance of about unit level that is no train on this track."""
    time = np.arange(int(duration * rate)) / rate
    out = np.zeros(time.size)

    def hit(at: float, amplitude: float, frequency: float, decay: float) -> None:
        first = int(at * rate)
        t = time[first : first + int(8 * decay * rate)] - at
        ring = np.exp(-t / decay) * np.sin(2 * np.pi * frequency * t + rng.uniform(0, 6))
        out[first : first + t.size] += amplitude * ring

    if kind == "hammer":
        at = rng.uniform(1, 3)
        interval = rng.uniform(0.3, 1.5)
        for _ in range(rng.integers(3, 25)):
            if at > duration - 1:
                break
            hit(at, rng.uniform(1, 4), rng.uniform(100, 700), rng.uniform(0.005, 0.03))
            at += interval * rng.normal(1, 0.08)
    elif kind == "road":
        for _ in range(rng.integers(1, 4)):
            centre, width = rng.uniform(2, duration - 2), rng.uniform(0.4, 1.5)
            envelope = np.exp(-0.5 * ((time - centre) / width) ** 2)
            out += envelope * _band_noise(rng, time.size, rate, 8, rng.uniform(25, 120))
    elif kind == "footsteps":
        at, pace = 1.0, rng.uniform(0.45, 0.7)
        while at < duration - 1:
            hit(at, rng.uniform(0.5, 1.5), rng.uniform(20, 90), 0.03)
            at += pace * rng.normal(1, 0.03)
    elif kind == "trolley":
        speed = rng.uniform(1.0, 4.0)
        centre = duration / 2
        envelope = 1 / (1 + ((time - centre) * speed / 4) ** 2)
        out += envelope * _band_noise(rng, time.size, rate, 40, 500)
        for joint in np.arange(-30, 30, 3.0):
            for axle in (0.0, 1.8):
                at = centre + (joint + axle) / speed
                if 0.5 < at < duration - 1:
                    level = 3 / (1 + (joint / 4) ** 2)
                    hit(at, level, 300, 0.01)
    elif kind == "rain":
        for at in np.cumsum(rng.exponential(0.12, int(duration / 0.12))):
            if at < duration - 1:
                hit(at, rng.lognormal(-1, 0.8), rng.uniform(200, 900), 0.004)
    elif kind == "spikes":
        for at in rng.uniform(0.5, duration - 0.5, rng.integers(3, 30)):
            first = int(at * rate)
            out[first : first + rng.integers(1, 20)] += rng.choice([-1, 1]) * rng.uniform(2, 20)
    elif kind == "hum":
        on, off = sorted(rng.uniform(1, duration - 1, 2))
        out += np.where((time > on) & (time < off), np.sin(2 * np.pi * 50 * time), 0.0)
    elif kind == "neighbour":
        # a train on the next track: its wheelsets smeared over 8 m of ground, low frequencies
        train = CATALOGUE["CRH3"].axles
        speed = rng.uniform(30, 100)
        envelope = np.zeros(time.size)
        for axle in train:
            s = (time - 2) * speed - axle
            envelope += np.exp(-0.5 * (s / 8.0) ** 2)
        out += envelope / envelope.max() * _band_noise(rng, time.size, rate, 8, 80)
    else:
        raise ValueError(kind)
    return out
