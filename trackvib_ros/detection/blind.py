"""Without a catalogue: speed from two channels, wheelsets as peaks, spacings as a result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from .kinematics import HIGH_BAND_POSITION_SIGMA, Motion, robust_scale
from .pattern import Trace

Array = NDArray[np.float64]

TYPICAL_WHEELBASE = 2.6
"""Middle of the wheelbases of catalogue bogies (2.2 to 3.0 m)."""

WHEELBASE_SPREAD = 0.10
"""Relative standard deviation of a wheelbase about the typical one."""

_GRID_S = 0.002
_PEAK_WIDTH = 0.7  # m
_LEAST_DISTANCE = 1.5  # m between wheelsets
_PROMINENCE = 0.7  # ln of energy, 3 dB


@dataclass(frozen=True)
class Blind:
    """A train described without its type.

    Attributes:
        motion: motion past the reference point.
        speed: at mid-train (m/s), with standard deviation.
        times: wheelsets at the reference channel (s).
        regular: 0 to 1, how well the peaks pair into bogies; a count with less than 0.8 is not
            to be trusted.
        direction: +1, -1, or 0 unknown.
        correlation: of the envelopes of two channels; 0 with one channel.
        method: how the speed was obtained.
        sensors: channels used, the reference first.
        x: position of the reference (m).
    """

    sensors: tuple[str, ...]
    x: float
    motion: Motion
    speed: tuple[float, float]
    times: Array
    regular: float
    direction: int
    correlation: float
    method: str

    @property
    def spacings(self) -> Array:
        """Distances between successive wheelsets (m)."""
        return np.asarray(np.diff(self.motion.distance_at(self.times)))


def peaks(trace: Trace, speed: float, interval: tuple[float, float]) -> Array:
    """Times (s) of the energy peaks that could be wheelsets at about this speed."""
    step = min(trace.step, 0.1 / speed)
    time = np.arange(interval[0] - 2.0 / speed, interval[1] + 2.0 / speed, step)
    half = _PEAK_WIDTH / 2 / speed
    level = trace.level(time - half, time + half)
    top = float(np.percentile(level, 95))
    found, _ = signal.find_peaks(
        level,
        prominence=_PROMINENCE,
        height=max(0.35 * top, 1.0),
        distance=max(1, int(_LEAST_DISTANCE / speed / step)),
    )
    return np.asarray(time[found])


def regularity(times: Array, speed: float) -> float:
    """Share of the peaks that pair into bogies of one wheelbase (2 to 3.3 m)."""
    if times.size < 4:
        return 0.0
    gaps = np.diff(times) * speed
    short = gaps[(gaps > 1.8) & (gaps < 3.6)]
    if short.size < 2:
        return 0.0
    base = float(np.median(short))
    near = np.abs(gaps - base) < 0.15 * base
    paired = np.zeros(times.size, dtype=bool)
    paired[:-1] |= near
    paired[1:] |= near
    return float(paired.mean())


def envelope_delay(
    a: Trace, b: Trace, within: tuple[float, float], limits: tuple[float, float]
) -> tuple[float, float] | None:
    """Delay of channel b behind a (s) by correlation of log-energies, and the correlation.

    Only delays of a train between the speed limits (m/s) are looked at. ``None`` if the channels
    are too near each other.
    """
    baseline = abs(b.x - a.x)
    shortest, longest = baseline / limits[1], baseline / limits[0]
    if shortest < 4 * _GRID_S:
        return None
    time = np.arange(within[0] - longest, within[1] + longest, _GRID_S)
    if time.size < 20:
        return None
    levels = []
    for trace in (a, b):
        level = trace.level(time - 0.004, time + 0.004)
        width = max(3, int(0.4 / _GRID_S))
        background = np.convolve(level, np.ones(width) / width, mode="same")
        levels.append(level - background)
    norm = np.sqrt(np.sum(levels[0] ** 2) * np.sum(levels[1] ** 2))
    if norm <= 0:
        return None
    correlation = signal.correlate(levels[1], levels[0], mode="full", method="fft") / norm
    lag = (np.arange(correlation.size) - (time.size - 1)) * _GRID_S
    allowed = (np.abs(lag) >= shortest) & (np.abs(lag) <= longest)
    correlation = np.where(allowed, correlation, -1.0)
    k = int(np.argmax(correlation))
    if not 0 < k < correlation.size - 1:
        return None
    left, here, right = correlation[k - 1 : k + 2]
    bend = left - 2 * here + right
    fraction = 0.5 * (left - right) / bend if bend < 0 else 0.0
    return float(lag[k] + np.clip(fraction, -1, 1) * _GRID_S), float(here)


def describe(
    traces: Sequence[Trace],
    interval: tuple[float, float],
    limits: tuple[float, float],
    guess: float | None = None,
) -> Blind | None:
    """What one or two rail channels tell of a train that no catalogue type explains.

    Args:
        traces: rail channels; the first is the reference, the farthest other one the second.
        interval: first and last strong energy (s).
        limits: speeds (m/s).
        guess: speed of the nearest catalogue type (m/s), for one channel.
    """
    reference = traces[0]
    others = sorted(traces[1:], key=lambda t: -abs(t.x - reference.x))
    if others and abs(others[0].x - reference.x) > 2.0:
        found = envelope_delay(reference, others[0], interval, limits)
        if found is not None and found[1] > 0.4:
            blind = _two_channels(reference, others[0], interval, *found)
            if blind is not None:
                return blind
    return _one_channel(reference, interval, limits, guess)


def _two_channels(
    a: Trace, b: Trace, interval: tuple[float, float], delay: float, correlation: float
) -> Blind | None:
    baseline = b.x - a.x
    rough = abs(baseline / delay)
    direction = 1 if delay * baseline > 0 else -1
    first = peaks(a, rough, interval)
    second = peaks(b, rough, (interval[0] + min(delay, 0), interval[1] + max(delay, 0)))
    if first.size < 2 or second.size < 2:
        return None
    nearest = second[np.argmin(np.abs(second[None, :] - first[:, None] - delay), axis=1)]
    lag = nearest - first
    paired = np.abs(lag - delay) < max(0.9 / rough, 0.1 * abs(delay))
    if paired.sum() < 3:
        return None
    middle = 0.5 * (first[paired] + nearest[paired])
    distance = abs(baseline)
    # local speeds: v(t) = v + a t, from the delay of every wheelset
    local = distance / np.abs(lag[paired])
    epoch = float(np.mean(middle))
    spread = max(robust_scale(local - np.median(local), 1), 1e-3 * rough)
    t = middle - epoch
    weight = np.where(np.abs(local - np.median(local)) < 4 * spread, 1.0, 0.0) / spread**2
    normal = np.array(
        [
            [weight.sum(), (weight * t).sum()],
            [(weight * t).sum(), (weight * t * t).sum() + 1 / 0.6**2],
        ]
    )
    v, acceleration = np.linalg.solve(
        normal, [float((weight * local).sum()), float((weight * t * local).sum())]
    )
    cov = np.linalg.inv(normal)
    covariance = np.zeros((3, 3))
    covariance[0, 0] = (0.3 / np.sqrt(paired.sum())) ** 2
    covariance[1:, 1:] = cov
    if v <= 0:
        return None
    start = float(first[0])
    offset = v * (start - epoch) + 0.5 * acceleration * (start - epoch) ** 2
    motion = Motion(epoch, -offset, float(v), float(acceleration), covariance)
    mid = 0.5 * (first[0] + first[-1])
    speed = float(motion.speed_at(mid))
    return Blind(
        sensors=(a.name, b.name),
        x=a.x,
        motion=motion,
        speed=(
            speed,
            float(
                np.hypot(
                    motion.speed_sigma(float(mid)),
                    speed * 2**0.5 * HIGH_BAND_POSITION_SIGMA / distance,
                )
            ),
        ),
        times=first,
        regular=regularity(first, speed),
        direction=direction,
        correlation=correlation,
        method="delay between two rail channels",
    )


def _one_channel(
    trace: Trace, interval: tuple[float, float], limits: tuple[float, float], guess: float | None
) -> Blind | None:
    """Speed from the wheelbase, whose typical value is known to ten percent."""
    best: tuple[float, float, Array] | None = None
    trials = (
        np.geomspace(limits[0], limits[1], 24) if guess is None else guess * np.array([0.9, 1, 1.1])
    )
    for trial in trials:
        times = peaks(trace, float(trial), interval)
        score = regularity(times, float(trial))
        if times.size >= 4 and (best is None or score > best[0]):
            best = (score, float(trial), times)
    if best is None:
        return None
    score, trial, times = best
    gaps = np.diff(times)
    short = gaps[(gaps * trial > 1.8) & (gaps * trial < 3.6)]
    if short.size < 2:
        return None
    speed = TYPICAL_WHEELBASE / float(np.median(short))
    sigma = WHEELBASE_SPREAD * speed
    method = "typical wheelbase"
    if guess is not None and abs(guess / speed - 1) < 2 * WHEELBASE_SPREAD:
        speed, sigma, method = guess, 0.06 * guess, "nearest catalogue type"
    epoch = float(times[0])
    covariance = np.diag([0.3**2, sigma**2, 0.6**2])
    motion = Motion(epoch, 0.0, speed, 0.0, covariance)
    return Blind((trace.name,), trace.x, motion, (speed, sigma), times, score, 0, 0.0, method)
