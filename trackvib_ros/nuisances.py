"""Disturbances of rail sensors that are no train on their track, to count false confirmations.

Made from simple models, not by the solver. Levels are relative to white noise of rms 1 in every
channel. Disturbances that pass along the track reach the channels one after the other, because a
detector with two sensors must not take that for a train.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from trackvib_ros.detection import VIBRATION, Catalogue, Channel
from trackvib_ros.evaluate import load_factory
from trackvib_ros.waveform import Waveform

Array = NDArray[np.float64]

RATE = 2000
"""Samples per second."""

STRETCH_S = 60.0
"""Length of one recording (s): one disturbance, quiet before and after it."""

CHANNELS = (Channel("rail_a", 0.0, "rail"), Channel("rail_b", 20.0, "rail"))
"""Two rail sensors 20 m apart."""


@dataclass
class _Scene:
    """Signals under construction: (samples, channels)."""

    x: Array
    random: np.random.Generator
    data: Array

    @property
    def time(self) -> Array:
        return np.arange(len(self.data)) / RATE

    @property
    def duration(self) -> float:
        return len(self.data) / RATE

    def hit(self, at: float, gains: Array, frequency: float, decay: float) -> None:
        """A decaying oscillation that begins at a time (s) with an amplitude per channel."""
        first = max(0, int(at * RATE))
        t = self.time[first : first + int(8 * decay * RATE)] - at
        phase = self.random.uniform(0, 6)
        ring = np.exp(-t / decay) * np.sin(2 * np.pi * frequency * t + phase)
        self.data[first : first + t.size] += ring[:, None] * gains

    def band(self, low: float, high: float) -> Array:
        """Independent noise of rms 1 in every channel, shape of the data."""
        sos = signal.butter(2, [low, high], "bandpass", fs=RATE, output="sos")
        noise = signal.sosfilt(sos, self.random.standard_normal(self.data.shape), axis=0)
        return np.asarray(noise / noise.std(axis=0))

    def near(self, place: float, reach: float) -> Array:
        """Gain per channel of something at a place on the track (m)."""
        return np.asarray(np.exp(-np.abs(self.x - place) / reach))


def _hammer(s: _Scene) -> None:
    at, interval, place = 20.0, s.random.uniform(0.3, 1.5), s.random.uniform(-15, 35)
    frequency, decay = s.random.uniform(100, 700), s.random.uniform(0.005, 0.03)
    for _ in range(int(s.random.integers(3, 30))):
        if at > s.duration - 10:
            break
        s.hit(at, s.random.uniform(1, 4) * s.near(place, 12.0), frequency, decay)
        at += interval * s.random.normal(1, 0.08)


def _road(s: _Scene) -> None:
    """Vehicles on a road beside the track."""
    for _ in range(int(s.random.integers(1, 4))):
        centre = s.random.uniform(15, s.duration - 15)
        speed, distance = s.random.uniform(8, 30), s.random.uniform(8, 40)
        high = s.random.uniform(25, 120)
        along = (s.time[:, None] - centre) * speed - s.x
        s.data += s.band(8, high) / (1 + (along / distance) ** 2)


def _footsteps(s: _Scene) -> None:
    at, pace = 12.0, s.random.uniform(0.45, 0.7)
    place, way = s.random.uniform(-20, 0), s.random.choice([-1.0, 1.0])
    while at < s.duration - 10:
        gains = s.random.uniform(0.5, 1.5) / (1 + ((s.x - place) / 3) ** 2)
        s.hit(at, gains, s.random.uniform(20, 90), 0.03)
        at += pace * s.random.normal(1, 0.03)
        place += 0.75 * way


def _trolley(s: _Scene) -> None:
    """A two-axle trolley pushed along the rail, rolling noise and joints 3 m apart."""
    speed, centre = s.random.uniform(1.0, 4.0), s.duration / 2
    along = (s.time[:, None] - centre) * speed - s.x
    s.data += s.band(40, 500) / (1 + (along / 4) ** 2)
    for joint in np.arange(-30, 50, 3.0):
        for axle in (0.0, 1.8):
            at = centre + (joint + axle) / speed
            if 5 < at < s.duration - 5:
                s.hit(at, 3 / (1 + ((s.x - joint) / 4) ** 2), 300, 0.01)


def _rain(s: _Scene) -> None:
    at = 10.0
    while at < s.duration - 10:
        for channel in range(s.x.size):
            gains = np.zeros(s.x.size)
            gains[channel] = s.random.lognormal(-1, 0.8)
            s.hit(at + s.random.uniform(0, 0.1), gains, s.random.uniform(200, 900), 0.004)
        at += s.random.exponential(0.12)


def _spikes(s: _Scene) -> None:
    """Electric disturbance, in one channel or in all at once."""
    for at in s.random.uniform(5, s.duration - 5, int(s.random.integers(3, 40))):
        first = int(at * RATE)
        gains = s.random.choice([-1.0, 1.0]) * s.random.uniform(2, 20) * np.ones(s.x.size)
        if s.random.random() < 0.5:
            gains[s.random.integers(s.x.size)] = 0.0
        s.data[first : first + int(s.random.integers(1, 20))] += gains


def _hum(s: _Scene) -> None:
    on, off = sorted(s.random.uniform(8, s.duration - 8, 2))
    inside = (s.time > on) & (s.time < off)
    s.data += np.where(inside, np.sin(2 * np.pi * 50 * s.time), 0.0)[:, None]


def _neighbour(s: _Scene) -> None:
    """A train on the next track: its wheelsets smeared over 8 m of ground, low frequencies."""
    train = Catalogue.default().types[int(s.random.integers(len(Catalogue.default())))]
    speed, way = s.random.uniform(15, 100), s.random.choice([-1.0, 1.0])
    along = (s.time[:, None] - 20.0) * speed - way * s.x
    envelope = np.zeros_like(s.data)
    for axle in train.axles:
        envelope += np.exp(-0.5 * ((along - axle) / 8.0) ** 2)
    s.data += envelope / envelope.max() * s.band(8, 80)


def _noise(_: _Scene) -> None:
    """Nothing but the noise that every recording has."""


def _faults(s: _Scene) -> None:
    """A bad sensor or cable: steps, drop-outs, a loose contact, drift."""
    channel = int(s.random.integers(s.x.size))
    data = s.data[:, channel]
    for _ in range(int(s.random.integers(1, 6))):
        first, last = sorted(s.random.integers(10 * RATE, len(data) - 5 * RATE, 2))
        fault = s.random.integers(4)
        if fault == 0:  # the mean jumps
            data[first:] += s.random.uniform(-30, 30)
        elif fault == 1:  # blocks are lost
            data[first : first + int(s.random.uniform(0.02, 3.0) * RATE)] = np.nan
        elif fault == 2:  # contact comes and goes
            at = first + np.cumsum(s.random.exponential(0.05 * RATE, 60).astype(int) + 1)
            data[at[at < last]] += s.random.normal(0, 10, int(np.sum(at < last)))
        else:  # the zero wanders
            data[first:last] += np.cumsum(s.random.standard_normal(last - first)) / 30


KINDS: dict[str, Callable[[_Scene], None]] = {
    "hammer": _hammer,
    "road": _road,
    "footsteps": _footsteps,
    "trolley": _trolley,
    "rain": _rain,
    "spikes": _spikes,
    "hum": _hum,
    "neighbour": _neighbour,
    "noise": _noise,
    "faults": _faults,
}
"""Disturbances by name."""


def nuisance(kind: str, seed: int, channels: Sequence[Channel] = CHANNELS) -> Array:
    """One recording of :data:`STRETCH_S`, shape (samples, channels), noise of rms 1 included.

    Samples that a fault has dropped are NaN.

    The disturbance has 1.6 to 100 times the rms of the noise.
    """
    random = np.random.default_rng([seed, list(KINDS).index(kind)])
    x = np.array([channel.x for channel in channels])
    scene = _Scene(x, random, np.zeros((round(STRETCH_S * RATE), x.size)))
    KINDS[kind](scene)
    level = 10 ** random.uniform(0.2, 2)
    return np.asarray(level * scene.data + random.standard_normal(scene.data.shape))


@dataclass(frozen=True)
class Calm:
    """What a detector said of disturbances.

    Attributes:
        hours: length of all recordings (h).
        events: vibration events (arrivals) by kind.
        trains: kind and seed of every recording in which a train was confirmed.
    """

    hours: float
    events: dict[str, int]
    trains: tuple[tuple[str, int], ...]


def _watch(job: tuple[str, int], detector: str | None) -> tuple[int, int]:
    kind, seed = job
    data = nuisance(kind, seed).astype(np.float32)
    subject = load_factory(detector)(list(CHANNELS))
    names = tuple(channel.name for channel in CHANNELS)
    told = []
    size = RATE  # the result is the same for any size of blocks
    for first in range(0, len(data), size):
        stamp = first * (1_000_000_000 // RATE)
        block = Waveform(stamp, 1_000_000_000 // RATE, names, data[first : first + size])
        told += subject.process(block)
    told += subject.finish()
    confirmed = [e for e in told if e.kind == "passage" and e.values.get("grade") != VIBRATION]
    return sum(e.kind == "arrival" for e in told), len(confirmed)


def watch(
    hours: float,
    seed: int = 1,
    detector: str | None = None,
    workers: int = 1,
    progress: Callable[[int, int, str], None] | None = None,
) -> Calm:
    """Let a detector listen to all kinds of disturbances in turn, ``hours`` together."""
    count = max(1, round(hours * 3600 / STRETCH_S))
    kinds = list(KINDS)
    jobs = [(kinds[i % len(kinds)], seed * 1_000_000 + i) for i in range(count)]
    events = dict.fromkeys(kinds, 0)
    trains: list[tuple[str, int]] = []
    with ProcessPoolExecutor(workers) as pool:
        results = pool.map(partial(_watch, detector=detector), jobs, chunksize=4)
        for number, (job, (alarms, confirmed)) in enumerate(zip(jobs, results, strict=True), 1):
            events[job[0]] += alarms
            trains += [job] * confirmed
            if progress:
                progress(number, count, job[0])
    return Calm(count * STRETCH_S / 3600, events, tuple(trains))
