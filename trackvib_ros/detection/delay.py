"""The delay between two rail channels while a train passes, as far as it has passed.

At every delay the part that both channels have seen is compared: the waveform below 100 Hz, which
wheels carry along (:mod:`.travel`), and the log-energies of the bands. Of n independent pairs with
the sample correlation r the likelihood ratio of a true correlation ρ to none is

    (1 - ρ²)^((n - 1)/2) / (1 - ρ r)^(n - 3/2)

(Jeffreys, Theory of Probability, 1961, sec. 5.9), here averaged over 0 < ρ < 1 and over the bands:
a signal that shows nothing weighs next to nothing, and a peak by chance no more than it is worth.
n is that of what the channels do not share at the delay, which is white only if the delay is right.

A train repeats itself after every car, so that a wrong delay may look as good as the right one
under the filters of its own speed, which pass other data. All likely delays, and what reaches both
channels at once, are therefore compared under the filters of each of them, and by which channel
became strong first. The prior of the speed is uniform in its logarithm. Constant speed.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage
from scipy.interpolate import CubicSpline

from .pattern import Trace
from .place import DEFLECTION_SIGMA
from .record import Record
from .strength import strong_interval, struck
from .travel import (
    BROAD,
    CELL,
    ENERGY_PLACE_SIGMA,
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
_ATANH = (np.arange(24) + 0.5) * 0.2
_RHO = np.tanh(_ATANH)
_RHO_PRIOR = np.log((1 - _RHO**2) * _ATANH.size * 0.2)  # uniform in the correlation
_MOST = 0.9999  # correlation, above which no more is claimed
_LEAST_OVERLAP = 6.0  # m that both channels must have seen: the wheelsets of a bogie and quiet
_CANDIDATES = 5  # delays that are weighed by what is left of the signals
_LOOKS = 40  # delays either side of one, at most, at which it is compared with others
_PARTS = 8  # of the step between delays, for the posterior
_CORRELATED = 6.0  # m, of what channels do not share: three of the longest waves; flat from 3 to 12
_NEAR = 1.0  # m about a delay: beyond, another wheelset is taken for this one
_EVIDENCE = 1e4  # likelihood ratio to chance at which a delay is told
_TRAVELS = 19.0  # the same to what comes at once: 95 %
FIRST_SIGMA = 2.5
"""Where a channel becomes strong (m): at the first wheelset or the next one."""
_LATE = 0.1  # probability that one does so at some later time
KNOWN_START = 0.1
"""Time after the start of a record (s), before which what is strong may have been so."""


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
    return _log_mean(log + _RHO_PRIOR)


def _log_mean(log: Array) -> Array:
    """ln of the mean of likelihoods along the last axis."""
    top = log.max(axis=-1)
    return np.asarray(top + np.log(np.mean(np.exp(log - top[..., None]), axis=-1)))


def _blurred(log: Array, reach: int) -> Array:
    """ln of the mean likelihood over a Gaussian, three standard deviations of it ``reach``."""
    weight = np.exp(-0.5 * (np.arange(-reach, reach + 1) * 3 / reach) ** 2)
    return np.asarray(ndimage.convolve1d(log, weight / weight.sum(), axis=-1, mode="nearest"))


@dataclass(frozen=True)
class _Near:
    """Delays about one, as a trial sees them.

    Attributes:
        lags: in parts of a cell, shape (lags,).
        prior: ln of the prior probability of every delay, but for a constant, shape (lags,).
        blur: three standard deviations of where a wheel shows itself in energies, steps of lags.
    """

    lags: NDArray[np.int64]
    prior: Array
    blur: int


class _Trial:
    """Waveforms and energies of two channels under the filters of a speed: the mean of a ``span``.

    Signals are the waveform, then the log-energies of the bands, in cells of distance at that
    speed.

    Args:
        waves: of both channels.
        traces: one per band, of both channels.
        within: from and to (s).
        baseline: distance of the channels (m).
        span: of speeds whose delays the filters serve (m/s).
        clipped: whether the waveforms are bent, and place a wheel no better than energies do.
    """

    def __init__(
        self,
        waves: Sequence[Series],
        traces: Collection[Sequence[Trace]],
        within: tuple[float, float],
        baseline: float,
        span: tuple[float, float],
        clipped: bool,
    ) -> None:
        self.centre = float(np.sqrt(span[0] * span[1]))
        self.baseline, self.span, self.clipped = baseline, span, clipped
        count = int((within[1] - within[0]) * self.centre / CELL)
        self.enough = count * CELL > baseline * self.centre / span[1] + _LEAST_OVERLAP
        if not self.enough:
            return
        steps = np.arange(count + 1, dtype=np.float64) - count
        edges = within[1] + steps * (CELL / self.centre)
        wave = np.stack([w.cells(edges) for w in waves])[:, None]
        energy = np.stack([[t.levels(edges) for t in own] for own in zip(*traces, strict=True)])
        both = np.concatenate(
            [band_pass(wave, _FINE, BROAD), band_pass(energy, _ENERGY_FINE, _ENERGY_BROAD)], axis=1
        )
        # (channels, signals, cells)
        self._pair = limited(both - both.mean(axis=-1, keepdims=True))
        size = int(fft.next_fast_len(2 * count, real=True))
        spectra = fft.rfft(self._pair, size)
        cross = np.conj(spectra[0]) * spectra[1]
        self._product = _FINER * fft.irfft(cross, _FINER * size)
        self._power = np.zeros((*self._pair.shape[:2], count + 2))
        np.cumsum(self._pair**2, axis=-1, out=self._power[..., 1:-1])
        self._power[..., -1] = self._power[..., -2]
        # N / sum of the products of the autocorrelations (Bartlett), by Parseval's theorem
        whole = np.maximum(np.prod(self._power[..., -1], axis=0), 1e-300)
        self._share = 1 / np.maximum(2 * np.sum(np.abs(cross) ** 2, axis=-1) / size / whole, 1.0)
        most = int(baseline * self.centre / span[0] / _STEP) + 1
        self._lags = np.arange(-most, most + 1)
        gain = self._gain_of(*self.compare(self._lags))
        self._gain = gain[0] + gain[1:].max(axis=0)

    def compare(self, lags: NDArray[np.int64]) -> tuple[Array, Array]:
        """Correlations, shape (signals, lags), and overlap (cells), at lags of the second."""
        n = self._pair.shape[-1]
        cells = np.clip(lags / _FINER, -n, n)
        begin, end = np.maximum(-cells, 0), np.minimum(n - cells, n)  # of the first
        first = self._energy(0, end) - self._energy(0, begin)
        second = self._energy(1, end + cells) - self._energy(1, begin + cells)
        product = self._product[:, lags % self._product.shape[-1]] * (np.abs(cells) < n)
        r = product / np.sqrt(np.maximum(first * second, 1e-300))
        return np.clip(r, -_MOST, _MOST), end - begin

    def _energy(self, channel: int, to: Array) -> Array:
        """Sum of the squares up to a place between cells, shape (signals, places)."""
        whole = to.astype(np.intp)
        power = self._power[channel]
        return np.asarray(power[:, whole] + (to - whole) * (power[:, whole + 1] - power[:, whole]))

    def _gain_of(self, r: Array, overlap: Array) -> Array:
        """ln of the likelihood ratio of a correlation to none, by the signals themselves."""
        square = np.maximum(r, 0.0) ** 2
        return np.asarray(-0.5 * self._share[:, None] * overlap * np.log(1 - square))

    def best(self, low: float, high: float) -> tuple[float, float]:
        """The largest gain of the delays between two (s), and its delay (s)."""
        delay = self._lags * (_STEP / self.centre)
        k = int(np.argmax(np.where((delay >= low) & (delay <= high), self._gain, -1.0)))
        return float(self._gain[k]), float(delay[k])

    def bests(self) -> list[tuple[float, float]]:
        """The same of either direction."""
        low, high = (self.baseline / v for v in reversed(self.span))
        return [self.best(low, high), self.best(-high, -low)]

    def near(self, delay: float, speed: float) -> _Near:
        """The delays about one (s) that a train of a speed (m/s) makes."""
        scale = self.centre / _STEP  # parts of a cell in a second
        reach = max(round(_NEAR / speed * scale), 1)
        step = 1 + reach // _LOOKS
        lags = round(delay * scale) + step * np.arange(-(reach // step), reach // step + 1)
        blur = max(round(3 * ENERGY_PLACE_SIGMA / speed * scale / step), 1)
        return _Near(lags, np.log(step / np.maximum(np.abs(lags), 1)), blur)

    def _cut(self, lag: int) -> Array:
        """What both channels have seen at a lag, shape (channels, signals, cells)."""
        n, whole = self._pair.shape[-1], round(lag / _FINER)
        begin, end = max(-whole, 0), min(n - whole, n)
        return np.stack(
            [self._pair[0, :, begin:end], self._pair[1, :, begin + whole : end + whole]]
        )

    def logs(self, delays: Sequence[_Near]) -> tuple[list[Array], Array]:
        """ln of the likelihood ratio of every delay to nothing in common.

        What the channels do not share is noise; how many samples of it are independent, the best
        of the delays tells, for all explain the same samples.

        Returns:
            One array for each of ``delays``; independent samples a cell, shape (signals,).
        """
        lags = np.concatenate([near.lags for near in delays])
        cuts = np.cumsum([near.lags.size for near in delays])[:-1]
        r, overlap = self.compare(lags)
        share = np.empty(len(r))
        for row, k in enumerate(np.argmax(self._gain_of(r, overlap), axis=1)):
            left = residual(*self._cut(int(lags[k]))[:, row])
            share[row] = independent(left) / left.size
        rows = log_ratio(r, share[:, None] * overlap)
        out = []
        for part, near in zip(np.split(rows, cuts, axis=1), delays, strict=True):
            out.append(self._total(part, near.blur))
        return out, share

    def band(self, delay: float) -> int:
        """The number of the band whose energies agree best at a delay (s)."""
        r, _ = self.compare(np.array([round(delay * self.centre / _STEP)]))
        return int(np.argmax(r[1:, 0]))

    def posterior(self, delay: float, speed: float, share: Array) -> tuple[Array, Array]:
        """Speeds (m/s) about the right delay (s), and their probabilities.

        Args:
            delay: the right one (s).
            speed: that it tells (m/s).
            share: independent samples a cell, shape (signals,).
        """
        near = self.near(delay, speed)
        lags = np.linspace(near.lags[0], near.lags[-1], 1 + _PARTS * (near.lags.size - 1))
        r, overlap = self.compare(near.lags)
        # where energies peak is in doubt by where a wheel shows itself in them, not by noise
        pairs = np.concatenate([[self._pairs(int(near.lags[np.argmax(r[0])]))], share[1:]])
        overlap = np.interp(lags, near.lags, overlap)
        r = np.clip(CubicSpline(near.lags, r, axis=1)(lags), -_MOST, _MOST)
        log = log_ratio(r, pairs[:, None] * overlap)
        # or a signal has nothing in common, and tells nothing
        common = _log_mean(log_ratio(r, share[:, None] * overlap)) - _log_mean(log)
        log = np.logaddexp(0.0, log + common[:, None])
        way = np.maximum(np.abs(lags), 1.0)
        total = self._total(log, _PARTS * near.blur) - np.log(way)
        weight = np.exp(total - total.max())
        return self.baseline * self.centre / _STEP / way, weight / weight.sum()

    def _total(self, log: Array, blur: int) -> Array:
        """ln of the likelihood of the waveform and of the energies, a wheel being seen near where
        it stands, shape (signals, lags)."""
        wave = _over_bands(log[:1], blur) if self.clipped else log[0]
        return np.asarray(wave + _over_bands(log[1:], blur))

    def _pairs(self, lag: int) -> float:
        """Independent pairs a cell that make a peak of the waveform as wide as it is uncertain.

        The place is where a = m - d / 2 and b = m + d / 2 have sum(m' d) = 0; its variance is that
        of the sum over sum(a' b')². What the channels do not share, d, is noise of any colour over
        all that was seen: the variance of the sum is the sum of the products of the autocovariances
        of m' and d (Bartlett's formula; Box & Jenkins, Time Series Analysis, sec. 11.1.3), those
        beyond a few waves left out by degrees (Newey & West, Econometrica 55, 1987, 703).

        Args:
            lag: of the peak.
        """
        a, b = self._cut(lag)[:, 0]
        a, b = (x / max(float(np.sqrt(x @ x)), 1e-150) for x in (a, b))
        count = a.size
        if count < 2:
            return 0.0
        bend = float(np.gradient(a) @ np.gradient(b))
        r = min(float(a @ b), _MOST)
        if bend <= 0 or r <= 0:
            return 0.0
        size = int(fft.next_fast_len(2 * count, real=True))
        slope, left = (
            fft.irfft(np.abs(fft.rfft(x, size)) ** 2, size)[:count]
            for x in (np.gradient(0.5 * (a + b)), b - a)
        )
        weight = np.maximum(1 - np.arange(count) * (CELL / _CORRELATED), 0.0)
        weight[1:] *= 2
        variance = float(weight @ (slope * left)) / count / bend**2
        return float((1 - r * r) / (r * bend * max(variance, 1e-300)) / count)


def _over_bands(log: Array, blur: int) -> Array:
    """ln of the mean likelihood of signals, a wheel being seen near where it stands."""
    top = float(log.max())
    mean = _blurred(np.exp(log - top).mean(axis=0), blur)
    return np.asarray(top + np.log(np.maximum(mean, 1e-300)))


@dataclass(frozen=True)
class _Likely:
    """A delay (s) that is likely, the speed it tells (m/s), and the trial that found it."""

    delay: float
    speed: float
    trial: _Trial

    def differs(self, other: _Likely) -> bool:
        """Whether they take different wheelsets for one."""
        return abs(self.delay - other.delay) > _NEAR / min(self.speed, other.speed)


def find_delay(
    first: Record,
    second: Record,
    within: tuple[float, float],
    limits: tuple[float, float],
    apart: tuple[float, float],
) -> Delay | None:
    """The speed that the delays between two channels tell; ``None`` if it is not clear.

    Args:
        first: channel at the lower x.
        second: the other.
        within: start of the event and now (s).
        limits: speeds (m/s).
        apart: distance of the channels, its standard uncertainty (m).
    """
    baseline = apart[0]
    # before its own beginning a channel had another train; none is cut off where the other has none
    known = [record.window.time[record.window.valid] for record in (first, second)]
    if not all(time.size for time in known):
        return None
    begun = min(float(time[0]) for time in known)
    within = max(within[0], begun), within[1]
    waves = [deflection(record.window, within) for record in (first, second)]
    lasting = _lasting((first, second), within)
    if not lasting:
        return None
    range_ = float(np.log(limits[1] / limits[0]))
    ends = [float(v) for v in np.geomspace(*limits, max(2, int(range_ / np.log(_RATIO)) + 2))]
    cut = any(record.wave(within).clipped for record in (first, second))
    signals = waves, lasting.values(), within, baseline
    tried = [_Trial(*signals, span, cut) for span in pairwise(ends)]
    trials = [trial for trial in tried if trial.enough]
    if not trials:
        return None
    moving = _likeliest(trials, baseline)
    likely = [*moving, _at_once(trials, 0.5 * baseline / limits[1], limits[1])]
    views: dict[float, tuple[list[float], Array]] = {}
    for trial in {item.trial.centre: item.trial for item in likely}.values():
        near = [trial.near(item.delay, item.speed) for item in likely]
        logs, share = trial.logs(near)
        sums = [float(_log_sum(x + n.prior)) for x, n in zip(logs[:-1], near, strict=False)]
        views[trial.centre] = [*sums, float(logs[-1].max())], share
    told = np.array([weight for weight, _ in views.values()])
    # the filters pass data in common: together they tell what they tell on average
    weights = told.mean(axis=0) + _order(likely, (first, second), lasting, within)
    k = int(np.argmax(weights[:-1]))
    # the mean of likelihood ratios to chance is one, however they depend on each other
    chance = float(np.log(2 * range_))
    evidence = float(_log_mean(told[:, k])) - chance
    travels = float(weights[k] - weights[-1]) - chance
    if evidence < np.log(_EVIDENCE) or travels < np.log(_TRAVELS):
        return None
    among = np.exp(weights[:-1] - _log_sum(weights[:-1]))
    sure = float(among[k]) / (1 + np.exp(-travels))
    best, direction = moving[k], 1 if moving[k].delay > 0 else -1
    _, share = views[best.trial.centre]
    speeds, weight = best.trial.posterior(best.delay, best.speed, share)
    speed = float(weight @ speeds)
    errors = np.array([direction * np.sign(item.delay) * item.speed - speed for item in moving])
    errors[k] = float(np.sqrt(weight @ (speeds - speed) ** 2))
    place = float(np.hypot(apart[1], 2**0.5 * DEFLECTION_SIGMA)) / baseline
    sigma = float(np.hypot(np.sqrt(among @ errors**2), place * speed))
    return Delay(speed, sigma, direction, sure, list(lasting)[best.trial.band(best.delay)])


def _lasting(records: Sequence[Record], within: tuple[float, float]) -> dict[int, list[Trace]]:
    """Energies of both channels by band, without bands that blows carry at both: a flat wheel
    strikes once a turn, and both channels hear that at once."""
    pairs = zip(*(record.traces(within) for record in records), strict=True)
    cuts = zip(*(record.traces(within, limited=True) for record in records), strict=True)
    return {
        band: list(pair)
        for band, (pair, cut) in enumerate(zip(pairs, cuts, strict=True))
        if not all(struck(t, limited, within) for t, limited in zip(pair, cut, strict=True))
    }


def _log_sum(log: Array) -> Array:
    return np.asarray(np.logaddexp.reduce(log))


def _likeliest(trials: Sequence[_Trial], baseline: float) -> list[_Likely]:
    """The best delays that a train can make and that differ."""
    found = [(gain, delay, trial) for trial in trials for gain, delay in trial.bests()]
    out: list[_Likely] = []
    for _, delay, trial in sorted(found, key=lambda item: -item[0]):
        one = _Likely(delay, baseline / max(abs(delay), 1e-9), trial)
        if all(one.differs(other) for other in out):
            out.append(one)
    return out[:_CANDIDATES]


def _at_once(trials: Sequence[_Trial], most: float, speed: float) -> _Likely:
    """What reaches both channels faster than a train: the best delay not above one (s)."""
    found = [(*trial.best(-most, most), trial) for trial in trials]
    _, delay, trial = max(found, key=lambda item: item[0])
    return _Likely(delay, speed, trial)


def _order(
    likely: Sequence[_Likely],
    records: Sequence[Record],
    traces: Mapping[int, Sequence[Trace]],
    within: tuple[float, float],
) -> Array:
    """ln of the likelihood of the delays by when the channels become strong, shape (delays,)."""
    delays = np.array([item.delay for item in likely])
    sigma = FIRST_SIGMA / np.array([item.speed for item in likely])
    late = _LATE / (2 * (within[1] - within[0]))
    told = []
    for band, pair in traces.items():
        starts = []
        for record, trace in zip(records, pair, strict=True):
            low, high = record.window.bands[band]
            found = strong_interval(trace, high - low, within)
            own = max(within[0], float(trace.time[trace.valid][0]))
            if found is not None and found[0] > own + KNOWN_START:
                starts.append(found[0])
        if len(starts) == 2:
            z = (starts[1] - starts[0] - delays) / sigma
            density = np.exp(-0.5 * z**2) / (np.sqrt(2 * np.pi) * sigma)
            told.append(np.log((1 - _LATE) * density + late))
    return np.asarray(np.mean(told, axis=0)) if told else np.zeros(len(likely))
