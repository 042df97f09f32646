"""The delay between two rail channels while a train passes, as far as it has passed.

At every delay the part that both channels have seen is compared: the waveform below 100 Hz, which
wheels carry along (:mod:`.travel`), and the log-energies of the bands. Of n independent pairs with
the sample correlation r the likelihood ratio of a true correlation ρ to none is

    (1 - ρ²)^((n - 1)/2) / (1 - ρ r)^(n - 3/2)

(Jeffreys, Theory of Probability, 1961, sec. 5.9), here averaged over 0 < ρ < 1 and over the bands:
a signal that shows nothing weighs next to nothing, and a peak by chance no more than it is worth.
n is that of what the channels do not share at the delay, which is white only if the delay is right.
The prior of the speed is uniform in its logarithm. Constant speed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from .pattern import Trace
from .record import Record
from .travel import (
    BROAD,
    CELL,
    ENERGY_PLACE_SIGMA,
    PLACE_SIGMA,
    Series,
    band_pass,
    deflection,
    independent,
    limited,
    residual,
)

Array = NDArray[np.float64]

_FINE = 0.4  # m, of waveforms: shorter waves are noise
_ENERGY_FINE, _ENERGY_BROAD = 0.4, 6.0  # m, between which bogies and wheelsets lie
_RATIO = 1.25  # of successive speeds, whose filters serve the delays between
_FINER = 2  # delays per cell
_STEP = CELL / _FINER
_RHO = (np.arange(20) + 0.5) / 20
_MOST = 0.99  # correlation, above which no more is claimed
_LEAST_OVERLAP = 6.0  # m that both channels must have seen: the wheelsets of a bogie and quiet
_CANDIDATES = 5  # delays that are weighed by what is left of the signals
_NEAR = 1.0  # m about a delay: beyond, another wheelset is taken for this one
_EVIDENCE = 1e4  # likelihood ratio to chance at which a delay is told


@dataclass(frozen=True)
class Delay:
    """Speed (m/s) by the delay of the second channel, by its posterior.

    Attributes:
        speed: with ``sigma`` (m/s).
        direction: +1 towards growing x, -1.
        probability: of this delay among all, and that there is one.
        band: whose energies agree best.
    """

    speed: float
    sigma: float
    direction: int
    probability: float
    band: int


def log_ratio(r: Array, n: Array) -> Array:
    """ln of the mean likelihood ratio of all correlations from 0 to 1 to none."""
    n = np.maximum(np.asarray(n)[..., None], 2.0)
    log = 0.5 * (n - 1) * np.log(1 - _RHO**2)
    log = log - (n - 1.5) * np.log(1 - _RHO * np.asarray(r)[..., None])
    return _log_mean(log)


def _log_mean(log: Array) -> Array:
    """ln of the mean of likelihoods along the last axis."""
    top = log.max(axis=-1)
    return np.asarray(top + np.log(np.mean(np.exp(log - top[..., None]), axis=-1)))


class _Signals:
    """The same quantity of two channels in cells of distance at one trial speed.

    Args:
        pair: series of both, shape (cells,).
        lags: of the second behind the first, in parts of a cell.
        place: standard deviation of where a wheel shows itself (m), beyond what noise makes.
    """

    def __init__(self, pair: Sequence[Array], lags: NDArray[np.int64], place: float) -> None:
        self.pair = a, b = tuple(limited(x - x.mean()) for x in pair)
        self.place = place
        n = a.size
        size = int(fft.next_fast_len(2 * n, real=True))
        cross = np.conj(fft.rfft(a, size)) * fft.rfft(b, size)
        product = _FINER * fft.irfft(cross, _FINER * size)[lags % (_FINER * size)]
        whole = np.clip(np.round(lags / _FINER).astype(np.int64), -n, n)
        begin, end = np.maximum(-whole, 0), np.minimum(n - whole, n)  # cells of the first
        end = np.maximum(end, begin)
        one, other = (np.concatenate([[0.0], np.cumsum(x * x)]) for x in (a, b))
        power = (one[end] - one[begin]) * (other[end + whole] - other[begin + whole])
        self.r = np.clip(product / np.sqrt(np.maximum(power, 1e-300)), -_MOST, _MOST)
        self.overlap = (end - begin).astype(np.float64)
        # N / sum of the products of the autocorrelations (Bartlett), by Parseval's theorem
        products = (
            2 * float(np.abs(cross) @ np.abs(cross)) / size / max(one[-1] * other[-1], 1e-300)
        )
        share = 1 / max(products, 1.0)
        self.gain = -0.5 * share * self.overlap * np.log(1 - np.maximum(self.r, 0.0) ** 2)

    def log(self, lag: int, near: slice) -> Array:
        """ln of the likelihood ratio of the delays ``near`` a lag to nothing in common."""
        a, b = self.pair
        whole = round(lag / _FINER)
        begin, end = max(-whole, 0), min(a.size - whole, a.size)
        left = residual(a[begin:end], b[begin + whole : end + whole])
        share = independent(left) / left.size
        log = log_ratio(self.r[near], share * self.overlap[near])
        return _blurred(log, self.place) if self.place else log


def _blurred(log: Array, sigma: float) -> Array:
    """ln of the mean likelihood over a Gaussian of this width (m)."""
    reach = int(np.ceil(3 * sigma / _STEP))
    weight = np.exp(-0.5 * (np.arange(-reach, reach + 1) * _STEP / sigma) ** 2)
    top = log.max()
    padded = np.pad(np.exp(log - top), reach, mode="edge")
    return np.asarray(top + np.log(np.convolve(padded, weight / weight.sum(), mode="valid")))


@dataclass(frozen=True)
class _Peak:
    """The delays near one that is likely.

    Attributes:
        speed: of every delay, its sign the direction (m/s).
        log: of the likelihood ratio to nothing in common.
        prior: ln of the prior probability, but for a constant.
        band: whose energies agree best.
    """

    speed: Array
    log: Array
    prior: Array
    band: int

    @property
    def weight(self) -> float:
        """ln of the whole."""
        return float(np.logaddexp.reduce(self.log + self.prior))


class _Trial:
    """All delays at speeds of a ``span`` (m/s) under the filters of their mean."""

    def __init__(
        self,
        waves: Sequence[Series],
        traces: Sequence[Sequence[Trace]],
        within: tuple[float, float],
        baseline: float,
        span: tuple[float, float],
    ) -> None:
        self.centre = float(np.sqrt(span[0] * span[1]))
        self.baseline, self.span = baseline, span
        count = int((within[1] - within[0]) * self.centre / CELL)
        self.enough = count * CELL > baseline * self.centre / span[1] + _LEAST_OVERLAP
        if not self.enough:
            return
        steps = np.arange(count + 1, dtype=np.float64) - count
        edges = within[1] + steps * (CELL / self.centre)
        self.reach = round(_NEAR / _STEP)
        most = int(baseline * self.centre / span[0] / _STEP) + self.reach + 1
        self.lags = np.arange(-most, most + 1)
        levels = [
            [band_pass(t.levels(edges), _ENERGY_FINE, _ENERGY_BROAD) for t in pair]
            for pair in zip(*traces, strict=True)
        ]
        self.wave = _Signals(
            [band_pass(w.cells(edges), _FINE, BROAD) for w in waves], self.lags, 0.0
        )
        self.energies = [_Signals(pair, self.lags, ENERGY_PLACE_SIGMA) for pair in levels]
        self.gain = self.wave.gain + np.max([e.gain for e in self.energies], axis=0)

    def best(self, low: float, high: float) -> int:
        """Index of the best delay between two (m); the gain is in :attr:`gain`."""
        way = self.lags * _STEP
        return int(np.argmax(np.where((way >= low) & (way <= high), self.gain, -1.0)))

    def bests(self) -> list[int]:
        """The best delay of either direction."""
        low, high = (self.baseline * self.centre / v for v in reversed(self.span))
        return [self.best(low, high), self.best(-high, -low)]

    def peak(self, k: int) -> _Peak:
        """A delay, by its index, and its neighbours."""
        lag, near = int(self.lags[k]), slice(max(k - self.reach, 0), k + self.reach + 1)
        rows = np.stack([e.log(lag, near) for e in self.energies])
        log = self.wave.log(lag, near) + _log_mean(rows.T)
        way = np.maximum(np.abs(self.lags[near]) * _STEP, CELL)
        speed = np.sign(lag) * self.baseline * self.centre / way
        return _Peak(speed, log, np.log(_STEP / way), int(np.argmax(rows.max(axis=1))))


def find_delay(
    first: Record, second: Record, within: tuple[float, float], limits: tuple[float, float]
) -> Delay | None:
    """The speed that the delays between two channels tell; ``None`` if it is not clear.

    Args:
        first: channel at the lower x.
        second: the other.
        within: start of the event and now (s).
        limits: speeds (m/s).
    """
    baseline = second.channel.x - first.channel.x
    # a record that begins inside a train begins in both channels at once
    known = [record.window.time[record.window.valid] for record in (first, second)]
    if not all(time.size for time in known):
        return None
    begun = max(float(time[0]) for time in known)
    within = max(within[0], begun), within[1]
    waves = [deflection(record.window, within) for record in (first, second)]
    traces = [record.traces(within) for record in (first, second)]
    range_ = float(np.log(limits[1] / limits[0]))
    ends = [float(v) for v in np.geomspace(*limits, max(2, int(range_ / np.log(_RATIO)) + 2))]
    tried = [_Trial(waves, traces, within, baseline, span) for span in pairwise(ends)]
    trials = [trial for trial in tried if trial.enough]
    if not trials:
        return None
    found = [(float(t.gain[k]), t, k) for t in trials for k in t.bests()]
    found.sort(key=lambda item: -item[0])
    peaks = [trial.peak(k) for _, trial, k in found[:_CANDIDATES]]
    weights = np.array([peak.weight for peak in peaks])
    best = peaks[int(np.argmax(weights))]
    evidence = float(np.logaddexp.reduce(weights)) - float(np.log(2 * range_))
    # what reaches both channels faster than a train
    at_once = 0.5 * baseline / limits[1]
    still = [(t, t.best(-at_once * t.centre, at_once * t.centre)) for t in trials]
    trial, k = max(still, key=lambda item: float(item[0].gain[item[1]]))
    nothing = float(np.logaddexp(0.0, trial.peak(k).log.max()))
    if evidence < nothing + np.log(_EVIDENCE):
        return None
    rough = float(best.speed[np.argmax(best.log)])
    speeds = np.concatenate([peak.speed for peak in peaks])
    log = np.concatenate([peak.log + peak.prior for peak in peaks])
    density = np.exp(log - log.max())
    near = np.abs(speeds / rough - 1) < _NEAR / baseline
    sure = float(density[near].sum() / density.sum()) / (1 + np.exp(min(nothing - evidence, 50.0)))
    weight = np.exp(best.log + best.prior - best.weight)
    speed = float(weight @ np.abs(best.speed))
    variance = float(weight @ (np.abs(best.speed) - speed) ** 2)
    variance += float(density[~near] @ (speeds[~near] - rough) ** 2 / density.sum())
    sigma = float(np.hypot(variance**0.5, PLACE_SIGMA * speed / baseline))
    return Delay(speed, sigma, 1 if rough > 0 else -1, sure, best.band)
