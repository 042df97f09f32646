"""Where in a record a known axle pattern lies: the scan over type, speed and acceleration.

The log-energy of a rail channel, resampled from time to distance for a trial speed and
acceleration, is compared with the comb of a train's wheelsets by the normalised correlation of both
after the same band-pass in space. All offsets come from one Fourier transform.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from .catalogue import TrainType
from .features import BLOW_S, FRAME_S
from .kinematics import MAX_ACCELERATION

Array = NDArray[np.float64]

DYNAMIC_RANGE = 300.0
"""Energy range below the strong axles that counts (25 dB)."""

SLOWEST, FASTEST = 0.80, 1.25
"""Speeds tried, as fractions of a train's span over the duration of its strong energy."""

_ABOVE = 4.0  # energy of a blow over what lasts that counts; scores are flat from 3 to 8
_COARSE = 1.8  # m, smoothing of the first pass
_COARSE_BEND = 2.0  # m
_SPEED_STEP = 0.016
_CELL = 0.5  # m
_EVEN = 1e-3  # of a bin, equal
_BACKGROUND = 8.0  # m, what is smoother than this is no axle pattern


class Integral:
    """A quantity that is constant in every bin, integrated up to any time.

    Args:
        edges: of the bins (s), shape (bins + 1,).
        value: in the bins, shape (bins,).
    """

    def __init__(self, edges: Array, value: Array) -> None:
        self._edges = edges
        self._rise = np.append(value * np.diff(edges), 0.0)
        self._sum = np.concatenate([[0.0], np.cumsum(self._rise[:-1])])
        # stamps are whole ns: bins are equal but for that, unless a long gap lies between them
        step = float(edges[-1] - edges[0]) / value.size if value.size else 0.0
        even = edges[0] + step * np.arange(edges.size)
        self._rate = 1 / step if step > 0 and np.max(np.abs(edges - even)) < _EVEN * step else None

    def __call__(self, time: Array) -> Array:
        """Integral from the first edge to times (s); constant outside the bins."""
        if self._rate is None:
            return np.asarray(np.interp(time, self._edges, self._sum))
        place = (np.asarray(time) - self._edges[0]) * self._rate
        place = np.minimum(np.maximum(place, 0.0), self._edges.size - 1.0)
        bins = place.astype(np.intp)
        place -= bins
        place *= self._rise.take(bins)
        place += self._sum.take(bins)
        return np.asarray(place)


def lasting(energy: Array, step: float) -> Array:
    """Energy that does not end within :data:`BLOW_S`: its morphological opening, shape (bins,).

    Args:
        energy: per bin.
        step: bin length (s).
    """
    mean = ndimage.uniform_filter1d(energy, max(round(FRAME_S / step), 1))
    return np.asarray(ndimage.grey_opening(mean, (max(round(BLOW_S / step), 1),)))


class Trace:
    """Band energy of one rail channel in an event, averaged over any interval of time.

    Args:
        name: channel.
        x: position (m).
        time: centres of the bins (s), group delay removed.
        energy: mean square per bin, shape (bins,).
        valid: bins that hold measured samples.
        floor: noise floor of the energy.
        step: bin length (s).
        within: interval of interest (s); outside it the trace is quiet.
        limited: whether no bin counts more than what lasts about it, and the noise, by 6 dB: wheel
            flats hit the rail where they please, far above the wheelsets, for a few ms.
    """

    def __init__(
        self,
        name: str,
        x: float,
        time: Array,
        energy: Array,
        valid: NDArray[np.bool_],
        floor: float,
        step: float,
        within: tuple[float, float] = (-np.inf, np.inf),
        limited: bool = False,
    ) -> None:
        self.name, self.x, self.time, self.step = name, x, time, step
        self.valid, self.limited = valid, limited
        known = np.flatnonzero(valid)
        filled: Array = np.full(energy.shape, floor)
        if known.size:
            filled = np.asarray(np.interp(np.arange(energy.size), known, energy[known]))
        outside = (time < within[0]) | (time > within[1])
        if outside.any():
            filled = np.where(outside, floor, filled)
            known = np.flatnonzero(valid & ~outside)
        if limited:
            filled = np.minimum(filled, _ABOVE * np.maximum(lasting(filled, step), floor))
        self.energy = filled
        strong = float(np.percentile(filled[known], 97)) if known.size else floor
        self.noise = floor
        self.base = max(floor, strong / DYNAMIC_RANGE, 1e-300)
        # a stream with a gap of several seconds has unequal bins: integrate over real time
        edges = np.concatenate([time - step / 2, time[-1:] + step / 2])
        self._ends = float(edges[0]), float(edges[-1])
        self._energy = Integral(edges, filled)
        self._known = Integral(edges, valid.astype(np.float64))
        self._shown = self._energy if valid.all() else Integral(edges, filled * valid)

    def mean(self, start: Array, stop: Array) -> Array:
        """Mean energy between two times (s); :attr:`noise` outside the record."""
        return self._over(self._energy(stop) - self._energy(start), start, stop)

    def shown(self, start: Array, stop: Array) -> Array:
        """Mean energy of what was measured between two times (s); else :attr:`noise`."""
        time = self._known(stop) - self._known(start)
        total = self._shown(stop) - self._shown(start)
        return np.where(time > _EVEN * self.step, total / np.maximum(time, 1e-12), self.noise)

    def _over(self, total: Array, start: Array, stop: Array) -> Array:
        length = np.clip(stop, *self._ends) - np.clip(start, *self._ends)
        return np.where(length > 0, total / np.maximum(length, 1e-12), self.noise)

    def _level(self, mean: Array) -> Array:
        return np.log(np.maximum(mean / self.base, 1.0))

    def level(self, start: Array, stop: Array) -> Array:
        """ln of the mean energy over :attr:`base`, not below 0."""
        return self._level(self.mean(start, stop))

    def levels(self, edges: Array) -> Array:
        """The level between successive times (s) along the last axis."""
        total = np.diff(self._energy(edges))
        return self._level(self._over(total, edges[..., :-1], edges[..., 1:]))

    def coverage(self, start: Array, stop: Array) -> Array:
        """Fraction of an interval that was measured."""
        total = self._known(stop) - self._known(start)
        return np.asarray(total / np.maximum(stop - start, 1e-12))


@dataclass(frozen=True)
class Match:
    """A pattern in a trace: the first wheelset passes at ``start`` (s); v and a there at ``epoch``.

    ``score`` is the normalised correlation, 1 for a perfect comb.
    """

    score: float
    train: TrainType
    reverse: bool
    start: float
    epoch: float
    speed: float
    acceleration: float

    def times(self) -> Array:
        """Passing time of every wheelset (s)."""
        places = self.train.oriented(self.reverse) + self._distance(self.start)
        root = np.sqrt(np.maximum(self.speed**2 + 2 * self.acceleration * places, 1e-6))
        return self.epoch + 2 * places / (self.speed + root)

    def _distance(self, time: float) -> float:
        t = time - self.epoch
        return self.speed * t + 0.5 * self.acceleration * t * t


def _weights(n: int, sigma: float) -> Array:
    k = 2 * np.pi * np.arange(n // 2 + 1) / (n * _CELL)
    fine = np.exp(-0.5 * (k * sigma) ** 2)
    return np.asarray(fine - np.exp(-0.5 * (k * _BACKGROUND) ** 2), dtype=np.float32)


def _comb(places: Array, n: int) -> NDArray[np.float32]:
    comb = np.zeros(n, dtype=np.float32)
    cell = places / _CELL
    first = np.floor(cell).astype(int)
    np.add.at(comb, first, 1 - (cell - first))
    np.add.at(comb, first + 1, cell - first)
    return comb


def _resample(trace: Trace, epoch: float, speed: Array, acceleration: float, n: int) -> Array:
    """Levels on the distance grid, shape (speeds, n); the grid is centred on the epoch."""
    edges = (np.arange(n + 1) - n / 2) * _CELL
    v = speed[:, None]
    square = v * v + 2 * acceleration * edges
    reachable = square > 0.01 * v * v
    root = np.sqrt(np.where(reachable, square, 0.01 * v * v))
    times = epoch + 2 * edges / (v + root)
    level = trace.levels(times)
    both = reachable[:, 1:] & reachable[:, :-1]
    return np.asarray(np.where(both, level, 0.0), dtype=np.float32)


Placed: TypeAlias = tuple[Trace, float]
"""A rail channel and its shift (m): a wheelset d behind the first passes it at shift + d."""


def _scan_once(
    traces: Sequence[Placed],
    epoch: float,
    duration: float,
    trains: Sequence[tuple[TrainType, bool]],
    ranges: Sequence[tuple[float, float]],
    speeds: Array,
    acceleration: float,
    sigma: float,
    combs: dict[tuple[int, int], NDArray[np.complex64]],
) -> list[Match]:
    """Best match of every train for one acceleration; its score is the mean of the channels.

    The spectra of the trains, by number and size, are kept in ``combs``.
    """
    apart = max(abs(shift) for _, shift in traces)
    best: list[Match] = []
    found: dict[int, Match] = {}
    chunk = 24
    for first in range(0, speeds.size, chunk):
        part = speeds[first : first + chunk]
        wanted = [j for j, (low, high) in enumerate(ranges) if low <= part[-1] and high >= part[0]]
        if not wanted:
            continue
        longest = max(trains[j][0].span for j in wanted)
        extent = max(part[-1] * duration + 2 * _BACKGROUND, longest + 4 * _BACKGROUND)
        extent += 2 * apart
        n = int(fft.next_fast_len(int(extent / _CELL) + 1, real=True))
        weights = _weights(n, sigma)
        signal = _together(traces, epoch, part, acceleration, n, weights)
        for j in wanted:
            train, reverse = trains[j]
            rows = np.flatnonzero((part >= ranges[j][0]) & (part <= ranges[j][1]))
            if rows.size == 0:
                continue
            if (j, n) not in combs:
                comb = np.conj(fft.rfft(_comb(train.oriented(reverse), n)) * weights)
                combs[j, n] = comb / max(np.sqrt(np.sum(np.abs(comb) ** 2) * 2 / n), 1e-30)
            matched = signal[rows[0] : rows[-1] + 1] * combs[j, n]
            scores = fft.irfft(matched, n, axis=1)
            row, offset = np.unravel_index(int(np.argmax(scores)), scores.shape)
            score = float(scores[row, offset])
            if j in found and found[j].score >= score:
                continue
            place = (offset + 0.5 - n / 2) * _CELL
            # the middle of the train, not its head, is near the epoch
            place -= n * _CELL * round((place + train.span / 2) / (n * _CELL))
            v = float(part[rows[row]])
            square = max(v * v + 2 * acceleration * place, 0.01 * v * v)
            start = epoch + 2 * place / (v + np.sqrt(square))
            found[j] = Match(score, train, reverse, float(start), epoch, v, acceleration)
    best.extend(found.values())
    return best


def _together(
    traces: Sequence[Placed],
    epoch: float,
    speeds: Array,
    acceleration: float,
    n: int,
    weights: Array,
) -> NDArray[np.complex64]:
    """Spectra of the levels, each of norm 1, shifted to the first channel and averaged."""
    total = np.zeros((speeds.size, n // 2 + 1), dtype=np.complex64)
    k = 2 * np.pi * np.arange(n // 2 + 1) / (n * _CELL)
    for trace, shift in traces:
        signal = fft.rfft(_resample(trace, epoch, speeds, acceleration, n), axis=1) * weights
        norm = np.sqrt(np.sum(np.abs(signal) ** 2, axis=1, keepdims=True) * 2 / n)
        signal /= np.maximum(norm, 1e-30)
        if shift:
            signal *= np.exp(1j * k * shift).astype(np.complex64)
        total += signal
    return total / len(traces)


def _grid(low: float, high: float, step: float) -> Array:
    count = max(1, int(np.ceil(np.log(high / low) / step)) + 1)
    return np.geomspace(low, high, count)


def accelerations(duration: float, step_m: float) -> Array:
    """Accelerations whose bend over the duration differs by ``step_m`` (m) at the ends."""
    step = 32 * step_m / duration**2
    count = int(MAX_ACCELERATION / step)
    return np.asarray(step * np.arange(-count, count + 1), dtype=np.float64)


def scan(
    traces: Sequence[Placed],
    interval: tuple[float, float],
    trains: Sequence[TrainType],
    limits: tuple[float, float],
    stretch: tuple[float, float] = (SLOWEST, FASTEST),
) -> list[Match]:
    """Coarse best matches of the types, at most one per type and orientation, best first.

    Args:
        traces: the rail channels.
        interval: first and last strong energy (s); gives the speeds to try.
        trains: candidate types.
        limits: lowest and highest speed (m/s).
        stretch: speeds tried, as fractions of span / duration of the interval.
    """
    start, stop = interval
    duration = max(stop - start, 0.2)
    epoch = 0.5 * (start + stop)
    oriented = [
        (train, reverse)
        for train in trains
        for reverse in ((False,) if train.symmetric else (False, True))
    ]
    ranges = []
    for train, _ in oriented:
        v = train.span / duration
        ranges.append((max(limits[0], v * stretch[0]), min(limits[1], v * stretch[1])))
    usable = [j for j, (low, high) in enumerate(ranges) if high > low]
    if not usable:
        return []
    oriented = [oriented[j] for j in usable]
    ranges = [ranges[j] for j in usable]
    low = min(r[0] for r in ranges)
    high = max(r[1] for r in ranges)
    best: dict[tuple[str, bool], Match] = {}
    combs: dict[tuple[int, int], NDArray[np.complex64]] = {}
    for acceleration in accelerations(duration, _COARSE_BEND):
        for match in _scan_once(
            traces,
            epoch,
            duration,
            oriented,
            ranges,
            _grid(low, high, _SPEED_STEP),
            float(acceleration),
            _COARSE,
            combs,
        ):
            key = (match.train.name, match.reverse)
            if key not in best or match.score > best[key].score:
                best[key] = match
    return sorted(best.values(), key=lambda m: -m.score)


def refine(
    traces: Sequence[Placed],
    matches: Sequence[Match],
    interval: tuple[float, float],
    keep: int = 8,
) -> list[Match]:
    """The best coarse matches with finer speeds, accelerations and smoothing, best first."""
    if not matches:
        return []
    duration = max(interval[1] - interval[0], 0.2)
    bends = accelerations(duration, _COARSE_BEND)
    bend = float(bends[1] - bends[0]) if bends.size > 1 else 0.0
    near = [m for m in matches if m.score > matches[0].score - 0.25][:keep]
    return sorted((_refine(traces, m, duration, bend) for m in near), key=lambda m: -m.score)


def independent(span: float) -> float:
    """Number of independent levels in a train of this length (m) after the coarse smoothing.

    White levels through a filter of power P(k) are worth (L/pi) (int P dk)² / int P² dk, with
    P = exp(-k² sigma²): L / (sigma sqrt(2 pi)).
    """
    return span / (_COARSE * float(np.sqrt(2 * np.pi)))


def stretched(
    traces: Sequence[Placed],
    match: Match,
    interval: tuple[float, float],
    factors: Array,
) -> Array:
    """Score of a match whose shifts are each multiplied by a factor, shape (factors,)."""
    duration = max(interval[1] - interval[0], 0.2)
    out = np.empty(factors.size)
    combs: dict[tuple[int, int], NDArray[np.complex64]] = {}
    for i, factor in enumerate(factors):
        (found,) = _scan_once(
            [(trace, factor * shift) for trace, shift in traces],
            match.epoch,
            duration,
            [(match.train, match.reverse)],
            [(0.0, np.inf)],
            np.array([match.speed]),
            match.acceleration,
            _COARSE,
            combs,
        )
        out[i] = found.score
    return out


def _refine(traces: Sequence[Placed], match: Match, duration: float, bend: float) -> Match:
    best, top = match, -1.0
    for sigma, spread, points in ((1.1, 1.0, 4), (0.7, 0.35, 3)):
        centre, top = best, -1.0
        offsets = np.linspace(-spread, spread, 2 * points + 1)
        bends = [0.0] if bend == 0 else list(spread * bend * np.linspace(-1, 1, 5))
        speeds = centre.speed * (1 + _SPEED_STEP * offsets)
        limit = [(0.5 * centre.speed, 2 * centre.speed)]
        combs: dict[tuple[int, int], NDArray[np.complex64]] = {}
        for offset in bends:
            for found in _scan_once(
                traces,
                centre.epoch,
                duration,
                [(match.train, match.reverse)],
                limit,
                speeds,
                centre.acceleration + float(offset),
                sigma,
                combs,
            ):
                if found.score > top:
                    best, top = found, found.score
    return best
