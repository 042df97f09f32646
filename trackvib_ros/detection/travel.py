"""Speed and acceleration of whatever passes two rail channels, without a catalogue.

A rail bends under every wheel by the same few metres of curve, wherever it is laid alike: below
100 Hz the acceleration of two places is one waveform, v² w''(s), shifted by their distance. Its
delay is known to centimetres of travel where that of the energies, which the roughness at each
place makes, is known to decimetres. Both are compared on an axis of distance s = v t + a t²/2, and
what they agree on is weighed by the likelihood of correlated Gaussian variables,

    ln L = -n/2 ln(1 - r²),

n independent samples with the correlation r.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import fft, optimize
from scipy.special import ndtr

from .features import Window
from .kinematics import MAX_ACCELERATION, PRIOR_ACCELERATION, Motion
from .pattern import Integral, Trace

Array = NDArray[np.float64]

PLACE_SIGMA = 0.013
"""Standard deviation (m) of the distance between two rail sensors as their deflections show it: rms
on computed passages without noise to speak of. That of the distance itself is the site's."""

ENERGY_PLACE_SIGMA = 0.25
"""The same by energies alone: rms 0.2 to 0.3 m on computed passages."""

CELL = 0.1  # m
FINE, BROAD = 0.3, 2.0  # m, between which the bending lies (its wavelength is 2 to 4 m)
_COARSE_FINE = 0.6  # m
_ENERGY_FINE, _ENERGY_BROAD = 0.4, 6.0  # m, between which bogies and wheelsets lie
_RATIO = 1.25  # of successive speeds, whose filters serve the lags between
_LONGEST = 2000.0  # m of train; a longer vibration is something slower, or none
_LEAST_GAIN = 25.0  # e^25 outweighs the 10^6 motions tried, and one error in 10^4 passages
_LEAST_CORRELATION = 0.5  # of the energies, which all trains show
_CANDIDATES = 5  # speeds that are compared with all filters
_SAME = 1.0  # m about a delay: beyond, another wheelset is taken for this one
_CELLS, _WIDE = 6, 4.0  # either side of a mean, that hold a density; its standard deviations there
_CLIP = 5.0  # rms, above which a sample of the waveform counts no more


@dataclass(frozen=True)
class Travel:
    """What two channels tell of the motion past them.

    Attributes:
        motion: distance run past the first channel (m), 0 at the epoch; its covariance.
        direction: +1 towards growing x, -1.
        gain: ln of the likelihood ratio of this motion to none in common, by what is independent
            in the differences of the channels.
        lead: the same gain before the best of what reaches both channels at once, samples taken for
            independent.
        correlation: of the waveforms below 100 Hz, of the energies.
        band: whose energies agree best.
        doubt: standard uncertainty of the speed (m/s) by other delays, which equal cars make nearly
            as likely.
        sure: probability that the likeliest of these is worse.
    """

    motion: Motion
    direction: int
    gain: float
    lead: float
    correlation: tuple[float, float]
    band: int
    doubt: float = 0.0
    sure: float = 1.0

    @property
    def clear(self) -> bool:
        """Whether something passes one channel after the other."""
        return (
            self.gain > _LEAST_GAIN
            and self.lead > _LEAST_GAIN
            and self.correlation[1] > _LEAST_CORRELATION
        )


class Series:
    """A quantity of one channel over time that can be averaged over any cells of distance."""

    def __init__(self, time: Array, value: Array, valid: NDArray[np.bool_]) -> None:
        known = np.flatnonzero(valid)
        if known.size:
            value = np.interp(np.arange(value.size), known, value[known])
        middle = 0.5 * (time[1:] + time[:-1])
        ends = 1.5 * time[[0, -1]] - 0.5 * time[[1, -2]]
        self._integral = Integral(np.concatenate([ends[:1], middle, ends[1:]]), value)

    def cells(self, edges: Array) -> Array:
        """Means between successive times (s); 0 outside the record."""
        total = np.diff(self._integral(edges))
        return np.asarray(total / np.maximum(np.diff(edges), 1e-12))


def deflection(window: Window, within: tuple[float, float]) -> Series:
    """The waveform below 100 Hz, its mean removed, zero outside an interval (s)."""
    time = window.time - window.low_shift
    inside = (time >= within[0]) & (time <= within[1])
    good = inside & window.measured
    middle = float(np.median(window.low[good])) if good.any() else 0.0
    return Series(time, np.where(inside, window.low - middle, 0.0), window.measured | ~inside)


@dataclass(frozen=True)
class Pair:
    """Two rail channels: waveforms and traces per band, the first at the lower x."""

    waves: tuple[Series, Series]
    traces: tuple[Sequence[Trace], Sequence[Trace]]
    baseline: float
    within: tuple[float, float]

    def axis(self, motion: Motion, direction: int) -> Array:
        """Edges of the cells of one axis of distance (m), run past the first channel."""
        low, high = (float(motion.distance_at(t)) for t in self.within)
        n = max(int((high - low + self.baseline) / CELL), 8)
        start = low - (self.baseline if direction > 0 else 0.0)
        return np.asarray(start + CELL * np.arange(n + 1), dtype=np.float64)

    def edges(self, motion: Motion, direction: int) -> tuple[Array, Array]:
        """Times (s) at which the edges pass the two channels."""
        s = self.axis(motion, direction)
        return motion.time_at(s), motion.time_at(s + direction * self.baseline)


def band_pass(x: Array, fine: float, broad: float) -> Array:
    """Difference of two Gaussian averages of these widths (m), last axis; spacing :data:`CELL`."""
    count = x.shape[-1]
    size = int(fft.next_fast_len(count + int(4 * broad / CELL), real=True))
    k = 2 * np.pi * np.arange(size // 2 + 1) / (size * CELL)
    weight = np.exp(-0.5 * (k * fine) ** 2) - np.exp(-0.5 * (k * broad) ** 2)
    padding = [(0, 0)] * (x.ndim - 1) + [(0, size - count)]
    padded = np.pad(x, padding, mode="edge" if count else "constant")
    out = fft.irfft(fft.rfft(padded) * weight, size)[..., :count]
    return out.astype(np.float64)


def limited(x: Array) -> Array:
    """Series cut at :data:`_CLIP` of their rms over the last axis."""
    limit = _CLIP * np.sqrt(np.mean(x * x, axis=-1, keepdims=True))
    return np.clip(x, -limit, limit)


def _samples(length: float, fine: float) -> float:
    """Independent samples in a length (m) after a Gaussian low-pass of width ``fine`` (m)."""
    return max(length / (2 * float(np.sqrt(np.pi)) * fine), 4.0)


def _gain(r: Array | float, n: float) -> Array:
    return np.asarray(-0.5 * n * np.log(1 - np.minimum(np.maximum(r, 0.0), 0.999) ** 2))


def _features(
    pair: Pair, edges: tuple[Array, Array], fine: float
) -> list[tuple[Array, Array, float]]:
    """The two channels' waveform, then their log-energies per band, each with its width (m)."""
    waves = [
        limited(band_pass(w.cells(e), fine, BROAD)) for w, e in zip(pair.waves, edges, strict=True)
    ]
    out = [(waves[0], waves[1], fine)]
    width = max(fine, _ENERGY_FINE)
    for first, second in zip(*pair.traces, strict=True):
        levels = [
            band_pass(trace.levels(e), width, _ENERGY_BROAD)
            for trace, e in zip((first, second), edges, strict=True)
        ]
        out.append((levels[0], levels[1], width))
    return out


@dataclass(frozen=True)
class _Lags:
    """Gain of all delays (s of warped time), and the band whose energies agree best at each.

    Attributes:
        gain: by the independent samples of the signals, so that speeds can be compared.
        even: samples taken for independent, so that delays of one speed can be.
    """

    lag: Array
    gain: Array
    even: Array
    band: Array


def _axis(speed: float, length: float) -> Array:
    n = int(length / CELL)
    return np.asarray((np.arange(n + 1) - n / 2) * CELL / speed)


def _time(pair: Pair, u: Array, bend: float) -> Array:
    """Time (s) at a warped time u = t + bend t²/2 from the middle of the record, in which a train
    with the acceleration bend · v keeps its delay."""
    root = np.sqrt(np.maximum(1 + 2 * bend * u, 0.01))
    return np.asarray(0.5 * (pair.within[0] + pair.within[1]) + 2 * u / (1 + root))


@dataclass(frozen=True)
class _Candidate:
    """A delay (s of warped time) that suits the filters of a speed (m/s)."""

    speed: float
    delay: float
    bend: float
    gain: float
    lead: float
    band: int

    def differs(self, other: _Candidate) -> bool:
        """Whether they take different wheelsets for one."""
        return abs(self.delay - other.delay) > _SAME / min(self.speed, other.speed)


def _together(
    pair: Pair, one: _Candidate, among: Sequence[_Candidate], duration: float
) -> tuple[float, float]:
    """Gain of a delay under the filters of all candidates, and its sampling variance: only so do
    they see the same data. The filters pass data in common: together they tell their average.

    The log-likelihood ratio of one sample of Gaussian variables with the correlation r has the
    variance r².
    """
    gain, variance = 0.0, 0.0
    for other in among:
        length = duration * other.speed
        u = _axis(other.speed, length)
        edges = _time(pair, u, one.bend), _time(pair, u + one.delay, one.bend)
        rs, counts = np.array(
            [
                (max(_correlation(a, b), 0.0), _samples(length, fine))
                for a, b, fine in _features(pair, edges, _COARSE_FINE)
            ]
        ).T
        gains, variances = _gain(rs, counts), counts * rs**2
        k = 1 + int(np.argmax(gains[1:]))
        gain += float(gains[0] + gains[k])
        variance += float(variances[0] + variances[k])
    return gain / len(among), variance / len(among)


def _lags(pair: Pair, speed: float, bend: float, length: float) -> _Lags:
    """All delays at about one speed (m/s)."""
    u = _axis(speed, length)
    edges = _time(pair, u, bend)
    n = u.size - 1
    size = int(fft.next_fast_len(2 * n, real=True))
    gains, evens = [], []
    for a, b, fine in _features(pair, (edges, edges), _COARSE_FINE):
        one, other = fft.rfft(a, size), fft.rfft(b, size)
        auto = fft.irfft(np.abs(one) ** 2, size), fft.irfft(np.abs(other) ** 2, size)
        power = max(float(auto[0][0]) * float(auto[1][0]), 1e-300)
        r = fft.irfft(np.conj(one) * other, size) / np.sqrt(power)
        own = max(float(auto[0] @ auto[1]) / power, 1.0)
        gains.append(_gain(r, max(n / own, 4.0)))
        evens.append(_gain(r, _samples(length, fine)))
    cells = np.arange(size)
    lag = np.where(cells > size // 2, cells - size, cells) * (CELL / speed)
    band = np.argmax(np.stack(evens[1:]), axis=0)
    gain, even = (
        x[0] + np.take_along_axis(np.stack(x[1:]), band[None], axis=0)[0] for x in (gains, evens)
    )
    return _Lags(lag, np.asarray(gain), np.asarray(even), np.asarray(band, dtype=np.float64))


def _still(lags: _Lags, shortest: float) -> float:
    near = np.abs(lags.lag) < 0.5 * shortest
    return float(lags.even[near].max()) if near.any() else 0.0


def _bends(duration: float, baseline: float, speed: float) -> Array:
    """Relative accelerations (1/s) whose delays at the ends differ by 0.6 m of travel."""
    most = min(MAX_ACCELERATION / speed, 1.6 / duration)
    step = 4 * _COARSE_FINE / (baseline * duration)
    count = int(most / step)
    return np.asarray(step * np.arange(-count, count + 1), dtype=np.float64)


def search(pair: Pair, limits: tuple[float, float]) -> Travel | None:
    """The motion that the two channels agree on best; ``None`` if they are too near each other."""
    shortest, longest = pair.baseline / limits[1], pair.baseline / limits[0]
    duration = pair.within[1] - pair.within[0]
    if pair.baseline < 2.0 or duration < 0.1:
        return None
    found: list[_Candidate] = []
    cells = max(2, int(np.ceil(np.log(limits[1] / limits[0]) / np.log(_RATIO))))
    centres = [float(v) for v in np.geomspace(limits[0], limits[1], cells)]
    ratio = (centres[1] / centres[0]) ** 0.5
    for speed in centres:
        length = duration * speed
        if length > _LONGEST and speed > centres[0]:
            break
        low = max(shortest, pair.baseline / speed / ratio)
        high = min(longest, pair.baseline / speed * ratio)
        best: _Candidate | None = None
        for bend in _bends(duration, pair.baseline, speed):
            lags = _lags(pair, speed, float(bend), length)
            mine = (np.abs(lags.lag) >= low) & (np.abs(lags.lag) <= high)
            if not mine.any():
                continue
            k = int(np.argmax(np.where(mine, lags.gain, -1.0)))
            if best is None or lags.gain[k] > best.gain:
                best = _Candidate(
                    speed,
                    float(lags.lag[k]),
                    float(bend),
                    float(lags.gain[k]),
                    float(lags.even[k]) - _still(lags, shortest),
                    int(lags.band[k]),
                )
        if best is not None:
            found.append(best)
    if not found:
        return None
    found = sorted(found, key=lambda c: -c.gain)[:_CANDIDATES]
    gains, variances = np.array([_together(pair, c, found, duration) for c in found]).T
    k = int(np.argmax(gains))
    told = _refined(pair, found[k])
    # samples were taken for independent: what the best delay leaves tells how many are
    share = told.gain / max(float(gains[k]), 1e-9)
    doubt, sure = 0.0, 1.0
    for one, gain, variance in zip(found, gains, variances, strict=True):
        if one.differs(found[k]):
            # by the sampling variance of what the gains differ by (Vuong, Econometrica 57, 1989)
            spread = np.sqrt(max(variances[k] + variance, 1e-9) / share)
            off = pair.baseline / abs(one.delay) - told.motion.speed
            better = float(ndtr((gain - gains[k]) / spread))
            doubt, sure = doubt + better * off**2, min(sure, 1 - better)
    return replace(told, doubt=doubt**0.5, sure=sure)


def _features_under(pair: Pair, motion: Motion, direction: int) -> list[tuple[Array, Array, float]]:
    return _features(pair, pair.edges(motion, direction), FINE)


def independent(x: Array, uneven: bool = True) -> float:
    """Independent samples in a series, by its autocorrelation: N / sum r(k)²

    (Bartlett's formula for the variance of a correlation; Box & Jenkins, Time Series Analysis,
    sec. 11.1.3), less if few of them carry its energy, when ``uneven``: 3 / kurtosis.
    """
    size = int(fft.next_fast_len(2 * x.size, real=True))
    r = fft.irfft(np.abs(fft.rfft(x, size)) ** 2, size)
    r = r / max(float(r[0]), 1e-300)
    square = x * x
    kurtosis = x.size * float(square @ square) / max(float(square.sum()) ** 2, 1e-300)
    share = 3.0 / max(kurtosis, 3.0) if uneven else 1.0
    return max(share * x.size / max(float(r @ r), 1.0), 4.0)


def _correlation(a: Array, b: Array) -> float:
    return float(a @ b) / float(np.sqrt(max(float(a @ a) * float(b @ b), 1e-300)))


def residual(a: Array, b: Array) -> Array:
    """What two series of any scale do not share."""
    x, y = (v / max(float(np.sqrt(v @ v)), 1e-150) for v in (a, b))
    return np.asarray(x - y)


@dataclass(frozen=True)
class _Weights:
    """Independent samples of what is left of waveforms and energies."""

    wave: float
    energy: float


def _agreement(
    pair: Pair, motion: Motion, direction: int, weights: _Weights
) -> tuple[float, float, float]:
    """Gain of a motion, and the correlations of waveforms and energies under it."""
    wave, energy = _features_under(pair, motion, direction)
    r = _correlation(wave[0], wave[1])
    # the energies of a channel may stand some decimetres from the wheelsets that cause them
    a, b, _ = energy
    norm = np.sqrt(max(float(a @ a) * float(b @ b), 1e-300))
    most = round(3 * ENERGY_PLACE_SIGMA / CELL)
    shifts = np.arange(-most, most + 1)
    inner = a[most : a.size - most]
    rs = np.array([inner @ b[most + k : b.size - most + k] for k in shifts]) / norm
    gains = _gain(rs, weights.energy) - 0.5 * (shifts * CELL / ENERGY_PLACE_SIGMA) ** 2
    return float(_gain(r, weights.wave)) + _parabola(gains), r, float(rs.max())


def _parabola(y: Array) -> float:
    k = int(np.argmax(y))
    if not 0 < k < y.size - 1:
        return float(y[k])
    left, here, right = y[k - 1 : k + 2]
    bend = left - 2 * here + right
    return float(here - 0.125 * (left - right) ** 2 / bend) if bend < 0 else float(here)


def _moments(cost: Callable[[float], float]) -> tuple[float, float]:
    """Mean and standard deviation of a density exp(-cost) near 0, a few units wide or less."""
    mean, step = 0.0, 1.0
    spread = step
    for _ in range(2):
        x = mean + step * np.arange(-_CELLS, _CELLS + 1)
        costs = np.array([cost(float(v)) for v in x])
        weight = np.exp(costs.min() - costs)
        weight /= weight.sum()
        mean = float(weight @ x)
        spread = float(np.sqrt(weight @ (x - mean) ** 2 + step**2 / 12))  # of the grid, too
        step = max(spread, step / 3) * _WIDE / _CELLS
    return mean, spread


def _refined(pair: Pair, one: _Candidate) -> Travel:
    direction = 1 if one.delay > 0 else -1
    rough, band = pair.baseline / abs(one.delay), one.band
    epoch = 0.5 * (pair.within[0] + pair.within[1])
    duration = pair.within[1] - pair.within[0]
    # one unit of either parameter moves the delay by 0.1 m of travel, of the second at the ends
    unit_v = 0.1 * rough / pair.baseline
    unit_a = 0.2 * rough / (pair.baseline * duration)
    start_a = one.bend * rough

    def motion_at(p: Array) -> Motion:
        speed = max(rough + unit_v * float(p[0]), 0.3 * rough)
        return Motion(epoch, 0.0, speed, start_a + unit_a * float(p[1]), np.zeros((3, 3)))

    pair = replace(pair, traces=(pair.traces[0][band : band + 1], pair.traces[1][band : band + 1]))
    length = duration * rough
    weights = _Weights(_samples(length, FINE), _samples(length, _ENERGY_FINE))

    def cost(p: Array) -> float:
        motion = motion_at(p)
        prior = 0.5 * (motion.acceleration / PRIOR_ACCELERATION) ** 2
        return prior - _agreement(pair, motion, direction, weights)[0]

    grid = [np.array([x, y]) for x in (-6.0, -3, 0, 3, 6) for y in (-6.0, -3, 0, 3, 6)]
    start = min(grid, key=cost)
    left = [residual(a, b) for a, b, _ in _features_under(pair, motion_at(start), direction)]
    weights = _Weights(independent(left[0]), independent(left[1]))
    even = _Weights(independent(left[0], uneven=False), independent(left[1], uneven=False))
    simplex = start + np.array([[0.0, 0.0], [1.5, 0.0], [0.0, 1.5]])
    found = optimize.minimize(
        cost,
        start,
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "xatol": 0.1, "fatol": 0.1, "maxfev": 60},
    )
    top = np.asarray(found.x)
    # the likelihood has many small tops, whose curvature tells nothing: integrated. About the
    # middle of the record both parameters are nearly independent.
    x, spread = _moments(lambda z: cost(top + np.array([z, 0.0])))
    y, across = _moments(lambda z: cost(top + np.array([0.0, z])))
    motion = motion_at(top + np.array([x, y]))
    covariance = np.zeros((3, 3))
    covariance[1, 1] = (unit_v * spread) ** 2 + (PLACE_SIGMA * motion.speed / pair.baseline) ** 2
    covariance[2, 2] = min((unit_a * across) ** 2, PRIOR_ACCELERATION**2)
    wave, energy = (_correlation(a, b) for a, b, _ in _features_under(pair, motion, direction))
    return Travel(
        Motion(epoch, 0.0, motion.speed, motion.acceleration, covariance),
        direction,
        _agreement(pair, motion, direction, even)[0],
        one.lead,
        (wave, energy),
        band,
    )
