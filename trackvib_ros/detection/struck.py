"""A train whose wheelsets are lost in the noise while flats of some of them strike the rail.

Blows are heard tens of metres away, once a turn of the wheel: how often tells the speed to the
uncertainty of a wheel's radius, and where they leave off the rest can be searched. A train of a
given type and motion adds to the energy e (over the floor) a little at every wheelset; with the
level B about every bin, which blows raise, the matched sum over all wheelsets of all channels

    Z = sum s (e - B) / B² / (var sum s² / B²)^(1/2),   s the wheelsets, smoothed, less their mean,

is normal with variance 1 without a train, and Z² / 2 the gain in ln of the likelihood with one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage, stats
from scipy.special import logsumexp

from .axles import AxleFit
from .catalogue import TrainType
from .evidence import Explanation
from .kinematics import MAX_ACCELERATION, PRIOR_ACCELERATION, Motion
from .passage import Hypothesis, Passage
from .pattern import Integral, accelerations, independent
from .record import Record

Array = NDArray[np.float64]

_RADIUS = (0.38, 0.50)  # m, worn and new wheels of trains
_REPEATED = 0.3  # correlation of what is heard one turn apart: blows, not what falls at random
_BLOW_S = 0.004  # averaging of energies among which blows are looked for
_LOUD = 3.0  # energy over floor from which a blow is heard in that time
_TREND_S = 0.5  # many turns
_LEVEL_S = 0.005  # averaging of the level B, and its reach to either side
_QUIET = 3.0  # energy over floor to which a level of so few bins may rise by chance
_SPREAD_S = 0.05  # a wheelset is heard for 30 ms (100 m/s) to 200 ms
_LEAST_QUIET = 0.5  # of the event: where wheelsets rise over the noise as well they need no sums
_CAP = 8.0  # energy of one bin over the floor that counts: noise has more once in 200 times
_WIDTH = 1.2  # m, standard deviation of what a wheelset is heard as
_BACKGROUND = 12.0  # m, of what fades in and out with the blows
_CELL, _FINE_CELL = 0.5, 0.25  # m
_LEAST_LEVEL = 0.1  # share of unstruck bins that makes a level
_LEAST_SEEN = 0.3  # of the information that the best place has
_SPEED_STEP = 0.004  # 0.4 m at the ends of a train of 200 m
_COARSE_BEND, _FINE_BEND = 2.0, 0.5  # m
_MOST_BENDS = 4  # to either side: two of the coarse ones
_FINE_STEP, _FINE = 0.001, 12  # relative; steps to either side, three of the coarse ones
# variance of a motion over that by Z: what blows leave is no white noise, and wheelsets are not
# heard alike; mean square of error / sigma on 16 computed passages: speed 4.2, ends 2.1 and 1.1
_DISPERSION = 2.5
_RIVAL = 8.0  # ln of odds beyond which another type need not be looked at closely
_CHANCE = 1e-3  # of a train that is none, all trials counted
_LEAST_HEARD = 0.5  # of the time that the train takes
_LEAST_APART = 0.5  # m, of channels that tell a direction
_PLACE = 0.15  # m, of a channel by energies


class _Found(NamedTuple):
    """A type in all channels: its motion past the first, ln of the likelihood, largest Z."""

    train: TrainType
    reverse: bool
    direction: int
    motion: Motion
    log: float
    sigmas: float


class _Heard(NamedTuple):
    """One channel: integrals of weighted energy and of the weight over time, variance of a bin."""

    x: float
    energy: Integral
    weight: Integral
    variance: float
    step: float


def find(
    records: Sequence[Record],
    within: tuple[float, float],
    trains: Sequence[TrainType],
    limits: tuple[float, float],
) -> Passage | None:
    """The train that channels show under the blows of wheel flats.

    Args:
        records: rail channels, two or more.
        within: the event (s); its train may begin before and end after it.
        trains: candidate types.
        limits: lowest and highest speed (m/s).

    Returns:
        ``None`` unless blows repeat with the turn of a wheel and the best type is beyond chance.
    """
    records = sorted(records, key=lambda r: r.channel.x)
    band = len(records[0].window.bands) - 1
    if any(r.window.bands != records[0].window.bands for r in records):
        return None
    if records[-1].channel.x - records[0].channel.x < _LEAST_APART:
        return None
    turn = _turn(records, within, band, limits)
    if turn is None:
        return None
    low, high = (2 * np.pi * radius / turn for radius in _RADIUS)
    low, high = max(low, limits[0]), min(high, limits[1])
    channels = [h for record in records if (h := _heard(record, within, band)) is not None]
    if len(channels) < len(records) or low >= high:
        return None
    span = (
        max(float(r.window.time[0]) for r in records),
        min(float(r.window.time[-1]) for r in records),
    )
    found = _search(channels, span, within[1] - within[0], trains, (low, high))
    if not found:
        return None
    passage = _passage(found, records, within, band)
    time = passage.hypotheses[0].fit.time
    start, stop = float(time.min()), float(time.max())
    heard_s = min(within[1], stop) - max(within[0], start)
    # flats are anywhere in a train, and all of it is on record at a channel
    whole = span[0] < start and float(time[:, -1].min()) < span[1]
    return passage if whole and heard_s > _LEAST_HEARD * (stop - start) else None


def _search(
    channels: Sequence[_Heard],
    span: tuple[float, float],
    duration: float,
    trains: Sequence[TrainType],
    speeds: tuple[float, float],
) -> list[_Found]:
    """The types in all channels, most likely first; none if the best is within chance."""
    kinds = [(t, reverse) for t in trains for reverse in ((False, True)[: 1 + (not t.symmetric)])]
    longest = max(t.span for t in trains)
    trials = 0.0
    best: dict[tuple[TrainType, bool, int], tuple[float, float, float]] = {}
    for acceleration in accelerations(duration, _COARSE_BEND):
        for speed in np.exp(np.arange(np.log(speeds[0]), np.log(speeds[1]), _SPEED_STEP)):
            sums = _Sums(channels, span, float(speed), float(acceleration), longest, _CELL)
            # of smoothed normal values one in a width of (2 pi)^(1/2) is independent
            trials += 2 * len(kinds) * sums.n * _CELL / (_WIDTH * np.sqrt(2 * np.pi))
            for kind in kinds:
                for direction in (1, -1):
                    z = float(np.max(sums.z(kind[0].oriented(kind[1]), direction)))
                    key = *kind, direction
                    if key not in best or z > best[key][0]:
                        best[key] = z, float(speed), float(acceleration)
    top = max(z for z, *_ in best.values())
    if trials * stats.norm.sf(top) > _CHANCE:
        return []
    found = [
        _refined(channels, span, *key, *state)
        for key, (z, *state) in best.items()
        if z > 0 and 0.5 * (top**2 - z**2) < _RIVAL
    ]
    return sorted(found, key=lambda f: -f.log)


def _refined(
    channels: Sequence[_Heard],
    span: tuple[float, float],
    train: TrainType,
    reverse: bool,
    direction: int,
    speed: float,
    acceleration: float,
) -> _Found:
    """Mean and covariance of the motion of a type, by the likelihood of motions near a coarse one.

    It is a quasi-likelihood of a measured dispersion (R. Wedderburn, Biometrika 61, 1974, 439). The
    prior of the acceleration is normal about 0, that of place and speed even.
    """
    places = train.oriented(reverse)
    speeds = speed * (1 + _FINE_STEP * np.arange(-_FINE, _FINE + 1))
    bend = 32 * _FINE_BEND / (train.span / speed) ** 2
    reach = min(int(MAX_ACCELERATION / bend), _MOST_BENDS)
    states, logs, top = [], [], 0.0
    for a in acceleration + bend * np.arange(-reach, reach + 1):
        for v in speeds:
            sums = _Sums(channels, span, float(v), float(a), train.span, _FINE_CELL)
            z = np.maximum(sums.z(places, direction), 0.0)
            use = np.flatnonzero(z**2 > np.max(z) ** 2 - 2 * _RIVAL)
            x = (use + 0.5 - sums.n / 2) * _FINE_CELL
            length = sums.n * _FINE_CELL
            # the middle of the train, not its head, is near the epoch
            x -= length * np.round((x + train.span / 2) / length)
            states.append(np.stack([-x, np.full(x.size, v), np.full(x.size, a)], axis=1))
            logs.append(0.5 * z[use] ** 2 - 0.5 * (a / PRIOR_ACCELERATION) ** 2)
            top = max(top, float(z.max()))
    state, log = np.concatenate(states), np.concatenate(logs)
    total = float(logsumexp(log))
    weight = np.exp(log - total)
    mean = weight @ state
    away = state - mean
    covariance = _DISPERSION * (weight[:, None] * away).T @ away
    if not reach:
        covariance[2, 2] = PRIOR_ACCELERATION**2
    # the delay between channels whose places are in doubt has a share in the speed
    apart = np.array([h.x for h in channels])
    share = np.var(apart) / (np.var(apart) + np.var(places))
    covariance[0, 0] += _PLACE**2
    covariance[1, 1] += (2**0.5 * _PLACE / np.ptp(apart) * share * mean[1]) ** 2
    distance, speed, acceleration = (float(m) for m in mean)
    motion = Motion(0.5 * (span[0] + span[1]), distance, speed, acceleration, covariance)
    # every type has as many speeds and places, and accelerations within the prior
    return _Found(train, reverse, direction, motion, total - float(np.log(2 * reach + 1)), top)


def _passage(
    found: Sequence[_Found], records: Sequence[Record], within: tuple[float, float], band: int
) -> Passage:
    """The passage of the most likely direction, with the types that are likely in it."""
    direction = found[0].direction
    kept = [f for f in found if f.direction == direction]
    weight = np.exp(np.array([f.log for f in kept]) - kept[0].log)
    traces = tuple(record.traces(within)[band] for record in records)
    ways = [direction * (record.channel.x - records[0].channel.x) for record in records]
    hypotheses, explanations = [], []
    for k, (f, p) in enumerate(zip(kept, weight / weight.sum(), strict=True)):
        places = f.train.oriented(f.reverse)
        time = np.stack([f.motion.time_at(places + way) for way in ways])
        fit = AxleFit(
            motion=f.motion,
            scale=_PLACE,
            time=time,
            residual=np.zeros(time.shape),
            contrast=np.zeros(time.shape),
            observed=np.zeros(time.shape, dtype=bool),
            offset=np.zeros(len(records)),
            place=_PLACE**2 * np.eye(len(records)),
            in_phase=0.5 * f.sigmas**2,
        )
        levels = independent(f.train.span) * len(records)
        score = float(np.sqrt(-np.expm1(-(f.sigmas**2) / levels)))
        hypotheses.append(
            Hypothesis(f.train, f.reverse, direction, score, fit, probability=float(p))
        )
        explanations.append(Explanation(k, "type", float(p), f.motion))
    first = hypotheses[0]
    start, end = (float(t) for t in first.fit.time[0, [0, -1]])
    return Passage(
        interval=(start, end),
        traces=traces,
        band=records[0].window.bands[band],
        hypotheses=tuple(hypotheses),
        direction=direction,
        explanations=tuple(explanations),
        struck=True,
    )


def _turn(
    records: Sequence[Record],
    within: tuple[float, float],
    band: int,
    limits: tuple[float, float],
) -> float | None:
    """Time between two blows of a wheel (s), if blows are heard that repeat."""
    total: Array | None = None
    step = records[0].window.step
    for record in records:
        window = record.window
        if window.step != step:
            return None
        inside = (window.time > within[0]) & (window.time < within[1]) & window.valid
        if inside.sum() * step < 2 * _TREND_S:
            return None
        first = int(np.argmax(inside))
        inside = inside[first:]
        energy = ndimage.uniform_filter1d(
            window.energy[first:, band], max(1, round(_BLOW_S / step))
        )
        level = np.log(np.maximum(energy / record.floor[band] / _LOUD, 1.0)) * inside
        width = round(_TREND_S / step)
        share = ndimage.uniform_filter1d(inside.astype(np.float64), width)
        level = (level - ndimage.uniform_filter1d(level, width) / np.maximum(share, 0.1)) * inside
        longest = round(4 * np.pi * _RADIUS[1] / limits[0] / step)
        size = fft.next_fast_len(level.size + longest, real=True)
        own = fft.irfft(np.abs(fft.rfft(level, size)) ** 2, size)[:longest]
        if not own[0] > 0:
            return None
        total = own / own[0] if total is None else total + own / own[0]
    assert total is not None
    first, last = (
        round(2 * np.pi * r / v / step) for r, v in zip(_RADIUS, limits[::-1], strict=True)
    )
    lag = first + int(np.argmax(total[first : last + 1]))
    again = float(np.max(total[2 * lag - 2 : 2 * lag + 3]))
    if total[lag] < _REPEATED * len(records) or again < 0.5 * _REPEATED * len(records):
        return None
    # at the edge of what is looked for it is a slow change, no peak
    return lag * step if total[lag] >= max(total[lag - 1], total[lag + 1]) else None


def _heard(record: Record, within: tuple[float, float], band: int) -> _Heard | None:
    window = record.window
    energy = window.energy[:, band] / record.floor[band]
    few = max(1, round(_LEVEL_S / window.step))
    level = ndimage.maximum_filter1d(ndimage.uniform_filter1d(energy, few), 2 * few + 1)
    weight = np.where(window.valid, np.maximum(level / _QUIET, 1.0) ** -2, 0.0)
    time = window.time - window.shift[band]
    inside = (time > within[0]) & (time < within[1])
    if not inside.any() or np.mean(weight[inside] == 1.0) < _LEAST_QUIET:
        return None
    energy = np.minimum(energy, _CAP)
    # what blows leave in sums over the length of a wheelset is noise as well, and what begins or
    # ends beside them
    few = round(_SPREAD_S / window.step)
    mean = ndimage.uniform_filter1d(weight * energy, 6 * few)
    mean /= np.maximum(ndimage.uniform_filter1d(weight, 6 * few), 1e-9)
    rows = energy.size // few
    away = (weight * (energy - mean))[: rows * few].reshape(rows, few).sum(axis=1)
    weights = weight[: rows * few].reshape(rows, few).sum(axis=1)
    loud = np.add.reduceat(inside[: rows * few], np.arange(0, rows * few, few)) > 0
    parts = [np.sum(away[p] ** 2) / max(np.sum(weights[p]), 1e-9) for p in (loud, ~loud)]
    variance = float(np.max(parts))
    edges = np.append(time - window.step / 2, time[-1] + window.step / 2)
    return _Heard(
        record.channel.x,
        Integral(edges, weight * energy),
        Integral(edges, weight),
        variance,
        window.step,
    )


class _Sums:
    """Z of any type at every place, for one motion."""

    def __init__(
        self,
        channels: Sequence[_Heard],
        span: tuple[float, float],
        speed: float,
        acceleration: float,
        longest: float,
        size_m: float,
    ) -> None:
        epoch = 0.5 * (span[0] + span[1])
        extent = speed * (span[1] - span[0]) + longest + 8 * _BACKGROUND
        self._cell = size_m
        self.n = n = int(fft.next_fast_len(int(extent / size_m), real=True))
        edges = (np.arange(n + 1) - n / 2) * size_m
        root = np.sqrt(np.maximum(speed**2 + 2 * acceleration * edges, 0.01 * speed**2))
        times = epoch + 2 * edges / (speed + root)
        k = 2 * np.pi * np.arange(n // 2 + 1) / (n * size_m)
        far = np.exp(-0.5 * (k * _BACKGROUND) ** 2)
        self._shape = np.exp(-0.5 * (k * _WIDTH) ** 2) - far
        self._score = {1: np.zeros(k.size, complex), -1: np.zeros(k.size, complex)}
        self._information = {1: np.zeros(k.size, complex), -1: np.zeros(k.size, complex)}
        for channel in channels:
            energy = np.diff(channel.energy(times)) / channel.step
            weight = np.diff(channel.weight(times)) / channel.step
            size = fft.irfft(fft.rfft(weight) * far, n)
            mean = fft.irfft(fft.rfft(energy) * far, n) / np.maximum(size, 1e-9)
            enough = size > _LEAST_LEVEL * np.diff(times) / channel.step
            score = fft.rfft(np.where(enough, energy - weight * mean, 0.0)) / channel.variance
            information = fft.rfft(np.where(enough, weight, 0.0)) / channel.variance
            for direction in (1, -1):
                turned = np.exp(1j * k * direction * (channel.x - channels[0].x))
                self._score[direction] += score * turned
                self._information[direction] += information * turned

    def z(self, places: Array, direction: int) -> Array:
        """Shape (n,): the first wheelset in each cell."""
        n = self.n
        comb = np.zeros(n)
        cell = places / self._cell
        first = np.floor(cell).astype(np.int64)
        np.add.at(comb, first, 1 - (cell - first))
        np.add.at(comb, first + 1, cell - first)
        shape = fft.irfft(fft.rfft(comb) * self._shape, n)
        score = fft.irfft(self._score[direction] * np.conj(fft.rfft(shape)), n)
        square = fft.irfft(self._information[direction] * np.conj(fft.rfft(shape**2)), n)
        return np.asarray(score / np.sqrt(np.maximum(square, _LEAST_SEEN * square.max())))
