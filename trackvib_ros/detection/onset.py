"""When energy rises (:class:`Onset`), and where it is above the noise (:class:`Trigger`).

The onset is a sequential test, bin by bin of about 1 ms. With noise the energy E over floor F of a
bin has ν degrees of freedom, with a train g times as much; the likelihood ratio of the bin is
``g^(-ν/2) exp(ν/2 (1 - 1/g) E/F)``. The statistic of Shiryaev and Roberts sums the likelihood
ratios over all times at which the train may have come, ``R_n = (1 + R_(n-1)) Λ_n``, and is averaged
over what is not known: the band, and g. ``R_n - n`` is a martingale under noise for any such
average, so the mean number of bins between false alarms is at least the threshold (Pollak, Ann.
Statist. 13, 1985, 206, and 15, 1987, 749), and no test of that false alarm rate tells the change
much sooner.

Activity is the short-term average over 1 to 16 frames against a threshold from the chi-square law
of the energy (Urkowitz, Proc. IEEE 55, 1967, 523). The floor is frozen while an event lasts.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from .features import BLOW_S, FRAME_S

Array = NDArray[np.float64]

WINDOWS = (1, 2, 4, 8, 16)
"""Lengths of the short-term averages (frames)."""

_BLOW = round(BLOW_S / FRAME_S)  # frames

WARM_UP = 50
"""Frames from which a floor is learned."""

_FALSE_ALARM = 1e-9  # per test, Gaussian noise: 0.007 an hour and channel before the margin
_FALSE_LAST = 1e-4  # inside an event: noise lengthens one in 100 quiet times, of 100 tests each
_WARM_UP_S = 0.5
_UNLUCKY, _FEW = 1e-3, 10.0
_MARGIN = 1.2  # the floor itself is an estimate
_LEAST_RATIO = 1.6
_FLOOR_FRAMES = 800.0  # time constant of the floor
_FALL_FRAMES = 50.0  # faster downwards: a floor learned inside a train is wrong
_QUIET_FRAMES = 8  # 80 ms: the least that a record leaves before its train
_QUIET_RANGE = 4.0  # over the quietest, still the same noise: 6 dB
_UNREST_FRAMES = 3200.0  # time constant of the variance of the longest window
_UNREST_PRIOR = 160.0  # frames that its first estimate counts as
_LAST = np.array(WINDOWS) - 1
_COUNT = np.array(WINDOWS, dtype=np.float64)[:, None, None]


GAINS = (2.5, 5.0, 10.0, 40.0)
"""Energy over noise that the onset test looks for. The least one makes 1.5 times the floor, for
however long, no onset: noise changes by as much."""

_FALSE_ARRIVAL_S = 7 * 86400.0  # mean time between false arrivals of a detector, Gaussian noise
_MOST = 1e30  # of the statistic, and per bin e^30: they stay finite


class Onset:
    """Sequential test of the channels of one group for energy that begins to rise.

    Args:
        channels: of the group.
        bands: number of bands.
        bin_s: length of a bin (s).
        sharing: channels of the detector, which share the false alarms.
    """

    def __init__(self, channels: int, bands: int, bin_s: float, sharing: int) -> None:
        self.threshold = sharing * _FALSE_ARRIVAL_S / bin_s
        self._shape = (channels, bands * len(GAINS))
        self._gain = np.array(GAINS)
        self._sum = np.zeros(self._shape)

    def restart(self, channels: NDArray[np.bool_] | None = None) -> None:
        """Nothing has been seen, by some channels or (without them) by any."""
        self._sum[slice(None) if channels is None else channels] = 0.0

    def look(self, ratio: Array, valid: NDArray[np.bool_], freedom: Array) -> Array:
        """The statistic after every bin for every alternative; :meth:`take` adopts the last.

        Args:
            ratio: energy over floor, shape (bins, channels, bands).
            valid: bins that count, shape (bins, channels).
            freedom: degrees of freedom of a bin, shape (channels, bands).

        Returns:
            Shape (bins, channels, bands * gains).
        """
        g = self._gain
        half = 0.5 * freedom[:, :, None]
        log = (half * (1 - 1 / g)) * ratio[..., None] - half * np.log(g)
        log = np.where(valid[..., None, None], np.minimum(log, 30.0), 0.0)
        product = np.exp(np.cumsum(log.reshape(len(ratio), *self._shape), axis=0))
        # R_n = Λ_1 ... Λ_n (R_0 + Σ_k 1 / (Λ_1 ... Λ_(k-1)))
        begun = np.empty_like(product)
        begun[0] = 1.0 + self._sum
        begun[1:] = 1.0 / product[:-1]
        return np.asarray(product * np.cumsum(begun, axis=0))

    def take(self, statistic: Array) -> None:
        """Go on from the last bin of :meth:`look`."""
        np.minimum(statistic[-1], _MOST, out=self._sum)


def thresholds(
    bands: tuple[tuple[float, float], ...], frame_s: float, false_alarm: float = _FALSE_ALARM
) -> Array:
    """Energy over floor of active frames, shape (windows, bands)."""
    table = np.empty((len(WINDOWS), len(bands)))
    for w, frames in enumerate(WINDOWS):
        for b, (low, high) in enumerate(bands):
            freedom = max(1.0, 2 * (high - low) * frames * frame_s)
            table[w, b] = stats.chi2.isf(false_alarm, freedom) / freedom
    return np.maximum(_MARGIN * table, _LEAST_RATIO) * margins(bands)


def margins(bands: tuple[tuple[float, float], ...]) -> Array:
    """Factor by which energy must rise more than by chance, because the floor is known no better.

    Where it was learned in half a second from few degrees of freedom, it may be too low by as much
    as the chi-square law allows once in a thousand times.
    """
    freedom = np.array([max(2 * (high - low) * _WARM_UP_S, 1.0) for low, high in bands])
    return np.where(freedom < _FEW, freedom / stats.chi2.ppf(_UNLUCKY, freedom), 1.0)


def quietest(energy: Array, bands: tuple[tuple[float, float], ...], frame_s: float) -> Array:
    """Noise floor by the quietest stretch of a record, whatever came first in it, shape (bands,).

    The least of many averages of a constant noise lies below its mean, by the same chi-square law
    as the thresholds; that much is made up for.

    Args:
        energy: measured frames, shape (frames, bands).
        bands: their limits (Hz).
        frame_s: length of a frame (s).

    Returns:
        NaN where there are too few frames.
    """
    if len(energy) < _QUIET_FRAMES:
        return np.full(energy.shape[1], np.nan)
    total = np.cumsum(np.concatenate([np.zeros((1, energy.shape[1])), energy]), axis=0)
    mean = (total[_QUIET_FRAMES:] - total[:-_QUIET_FRAMES]) / _QUIET_FRAMES
    least = mean.min(axis=0)
    for b, (low, high) in enumerate(bands):
        alike = max(1.0, np.sum(mean[:, b] < _QUIET_RANGE * least[b]) / _QUIET_FRAMES)
        freedom = max(1.0, 2 * (high - low) * _QUIET_FRAMES * frame_s)
        # median of the least of so many independent averages
        least[b] /= stats.chi2.isf(0.5 ** (1 / alike), freedom) / freedom
    return np.asarray(least)


class Trigger:
    """Noise floor and activity of the channels of one group, frame by frame.

    Args:
        channels: of the group.
        bands: frequency limits (Hz).
        frame_s: length of a frame (s).
        freedom: degrees of freedom of the energy of white noise in a frame, per band.

    Attributes:
        floor: energy of the noise, (channels, bands).
        first_floor: the floor as it was first learned.
        recent: mean energy over the longest window.
        level: energy of the longest window over the floor, the largest of the bands.
        steady: the most that any four frames on end of it all have (an opening, in the terms of
            morphology): the blows of wheel flats do not raise it, however strong they are.
        active: energy over threshold in a window and band; the threshold is lower while the floor
            is frozen, for an event that has begun lasts on less than makes one begin.
    """

    def __init__(
        self,
        channels: int,
        bands: tuple[tuple[float, float], ...],
        frame_s: float,
        freedom: Array,
    ) -> None:
        self.thresholds = thresholds(bands, frame_s)
        self._lasting = thresholds(bands, frame_s, _FALSE_LAST)
        shape = (channels, len(bands))
        self.floor = np.full(shape, np.nan)
        self.active = np.zeros(channels, dtype=bool)
        self.seen = np.zeros(channels, dtype=np.int64)
        self.level = np.ones(channels)
        self.steady = np.ones(channels)
        self._history = np.zeros((WINDOWS[-1], *shape))
        self.recent = np.full(shape, np.nan)
        self._warm = np.full((WARM_UP, *shape), np.nan)
        self._median = stats.chi2.median(freedom) / freedom
        self._unrest_white = 2 / (WINDOWS[-1] * freedom)
        self._unrest = np.tile(self._unrest_white, (channels, 1))
        self.first_floor = np.full(shape, np.nan)

    @property
    def whiteness(self) -> Array:
        """Degrees of freedom of the noise over those of white noise, (channels, bands).

        From the variance of the longest window's mean, as far as it is more than by chance (twice
        the standard deviation of a variance): narrow-band noise and gusts have fewer.
        """
        windows = np.minimum(_UNREST_PRIOR + self.seen, _UNREST_FRAMES) / WINDOWS[-1]
        chance = 1 + 2 * np.sqrt(2 / windows[:, None])
        return np.asarray(np.minimum(chance * self._unrest_white / self._unrest, 1.0))

    def step(self, energy: Array, valid: NDArray[np.bool_], frozen: bool) -> NDArray[np.bool_]:
        """Take one frame of energies (channels, bands); say which channels are active.

        Invalid frames leave floor and history untouched; a band that was not measured (NaN) keeps
        its level. ``frozen`` holds the floor.
        """
        energy = np.where(np.isnan(energy), self._history[0], energy)
        usable = valid & np.all(energy > 0, axis=1)
        if usable.all():
            self._history[1:] = self._history[:-1]
            self._history[0] = energy
        else:
            self._history[1:, usable] = self._history[:-1, usable]
            self._history[0, usable] = energy[usable]
        ready = self.seen >= WARM_UP
        learning = usable & ~ready
        if learning.any():
            for c in np.flatnonzero(learning):
                self._warm[self.seen[c], c] = energy[c]
                if self.seen[c] == WARM_UP - 1:
                    self.floor[c] = np.median(self._warm[:, c], axis=0) / self._median
                    self.first_floor[c] = self.floor[c]
                    self._unrest[c] = self._first_unrest(self._warm[:, c])
                    ready[c] = True
            self.seen[learning] += 1
        if not ready.any():
            return self.active
        total = np.cumsum(self._history, axis=0)[_LAST]
        mean = total / (_COUNT * self.floor)
        with np.errstate(invalid="ignore"):
            least = self._lasting if frozen else self.thresholds
            above = (mean > least[:, None]).any(axis=(0, 2))
        longest = mean[-1]
        self.level = np.nan_to_num(longest).max(axis=1, initial=0.0)
        runs = range(WINDOWS[-1] - _BLOW + 1)
        through = np.stack([self._history[i : i + _BLOW].min(axis=0) for i in runs])
        self.steady = np.nan_to_num(through.max(axis=0) / self.floor).max(axis=1, initial=0.0)
        self.recent = longest * self.floor
        self.active = usable & ready & above
        learn = usable & ready & ~self.active
        if not frozen and learn.any():
            self._learn(learn, energy, longest)
        return self.active

    def start_from(self, floor: Array) -> None:
        """Begin with known floors, (channels, bands); NaN where one has to be learned."""
        known = np.isfinite(floor).all(axis=1) & (floor > 0).all(axis=1)
        self.floor[known] = self.first_floor[known] = floor[known]
        self.seen[known] = WARM_UP
        self._history[:, known] = floor[known]

    def _learn(self, channels: NDArray[np.bool_], energy: Array, longest: Array) -> None:
        """Track floor and unrest."""
        self.seen[channels] += 1
        count = self.seen[channels, None]
        quiet = longest[channels]
        weight = np.where(quiet < 0.3, 1 / _FALL_FRAMES, 1 / _FLOOR_FRAMES)
        excess = energy[channels] / self.floor[channels]
        self.floor[channels] *= 1 + weight * (np.minimum(excess, 4.0) - 1)
        # what rises may be a train that comes: only what falls tells how restless the noise is
        square = 2 * np.minimum(quiet - 1, 0.0) ** 2
        weight = 1.0 / np.minimum(_UNREST_PRIOR + count, _UNREST_FRAMES)
        self._unrest[channels] += weight * (square - self._unrest[channels])

    def _first_unrest(self, energy: Array) -> Array:
        """Variance of the longest window's mean by that of frames and its neighbours' correlation.

        As of a first-order process, whose mean varies by (1 + ρ) / (1 - ρ) more.
        """
        away = energy / energy.mean(axis=0) - 1
        variance = np.mean(away**2, axis=0)
        rho = np.clip(np.mean(away[1:] * away[:-1], axis=0) / variance, 0.0, 0.9)
        seen = variance / WINDOWS[-1] * (1 + rho) / (1 - rho)
        return np.asarray(np.maximum(seen, self._unrest_white))

    def relearn(self, channel: int) -> None:
        """Forget the floor of a channel."""
        self.seen[channel] = 0
        self.first_floor[channel] = np.nan
        self._unrest[channel] = self._unrest_white
        self.active[channel] = False
