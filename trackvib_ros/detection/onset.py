"""Causal energy trigger per channel: short-term energy against a noise floor that is learned.

The short-term average over 1 to 16 frames is compared with the floor in every band. The
thresholds follow from the chi-square law of the energy of band-limited Gaussian noise: 2 B T
degrees of freedom in a band of width B over time T (Urkowitz, Proc. IEEE 55, 1967, 523). The floor
is frozen while an event lasts.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Array = NDArray[np.float64]

WINDOWS = (1, 2, 4, 8, 16)
"""Lengths of the short-term averages (frames)."""

_UPPER = 3 * WINDOWS[-1] // 4 - 1  # rank of the upper quartile of the longest window
_FALSE_ALARM = 1e-9  # per test, Gaussian noise: 0.007 an hour and channel before the margin
_MARGIN = 1.2  # the floor itself is an estimate
_LEAST_RATIO = 1.6
_WARM_UP = 50  # frames
_FLOOR_FRAMES = 800.0  # time constant of the floor
_FALL_FRAMES = 50.0  # faster downwards: a floor learned inside a train is wrong
_QUIET_FRAMES = 8  # 80 ms: the least that a record leaves before its train
_QUIET_RANGE = 4.0  # over the quietest, still the same noise: 6 dB


def thresholds(bands: tuple[tuple[float, float], ...], frame_s: float) -> Array:
    """Energy over floor at which to trigger, shape (windows, bands)."""
    table = np.empty((len(WINDOWS), len(bands)))
    for w, frames in enumerate(WINDOWS):
        for b, (low, high) in enumerate(bands):
            freedom = max(1.0, 2 * (high - low) * frames * frame_s)
            table[w, b] = stats.chi2.isf(_FALSE_ALARM, freedom) / freedom
    return np.maximum(_MARGIN * table, _LEAST_RATIO)


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

    Attributes:
        floor: energy of the noise, (channels, bands).
        ratio: energy over threshold, the largest of windows and bands, per channel.
        band: the band of ``ratio``.
        first_floor: the floor as it was first learned.
        recent: mean energy over the longest window.
        level: energy of the longest window over the floor, the largest of the bands.
        steady: the same of its upper quartile of frames, which the blows of a wheel flat, a frame
            or two each, do not raise.
        active: ``ratio`` > 1.
        fall_db: by how much the floor has fallen since it was first learned.
    """

    def __init__(
        self, channels: int, bands: tuple[tuple[float, float], ...], frame_s: float
    ) -> None:
        self.thresholds = thresholds(bands, frame_s)
        shape = (channels, len(bands))
        self.floor = np.full(shape, np.nan)
        self.ratio = np.zeros(channels)
        self.active = np.zeros(channels, dtype=bool)
        self.seen = np.zeros(channels, dtype=np.int64)
        self.fall_db = np.zeros(channels)
        self.level = np.ones(channels)
        self.steady = np.ones(channels)
        self.band = np.zeros(channels, dtype=np.int64)
        self._history = np.zeros((WINDOWS[-1], *shape))
        self._filled = np.zeros(channels, dtype=np.int64)
        self.recent = np.full(shape, np.nan)
        self._warm = np.full((_WARM_UP, *shape), np.nan)
        self.first_floor = np.full(shape, np.nan)

    def ready(self) -> NDArray[np.bool_]:
        """Which channels have learned a floor."""
        return self.seen >= _WARM_UP

    def step(self, energy: Array, valid: NDArray[np.bool_], frozen: bool) -> NDArray[np.bool_]:
        """Take one frame of energies (channels, bands); say which channels are active.

        Invalid frames leave floor and history untouched. ``frozen`` holds the floor.
        """
        usable = valid & np.all(energy > 0, axis=1)
        if usable.all():
            self._history[1:] = self._history[:-1]
            self._history[0] = energy
        else:
            self._history[1:, usable] = self._history[:-1, usable]
            self._history[0, usable] = energy[usable]
        self._filled[usable] += 1
        learning = usable & (self.seen < _WARM_UP)
        if learning.any():
            for c in np.flatnonzero(learning):
                self._warm[self.seen[c], c] = energy[c]
                self.seen[c] += 1
                if self.seen[c] == _WARM_UP:
                    self.floor[c] = np.median(self._warm[:, c], axis=0)
                    self.first_floor[c] = self.floor[c]
        ready = self.seen >= _WARM_UP
        if not ready.any():
            return self.active
        with np.errstate(invalid="ignore"):
            excess = np.zeros(len(ready))
            for w, frames in enumerate(WINDOWS):
                mean = self._history[:frames].mean(axis=0) / self.floor
                relative = np.nan_to_num(mean / self.thresholds[w])
                band = np.argmax(relative, axis=1)
                peak = relative[np.arange(len(band)), band]
                self.band = np.where(peak > excess, band, self.band)
                np.maximum(excess, peak, out=excess)
            self.level = np.nanmax(mean, axis=1, initial=0.0)
            upper = np.partition(self._history, _UPPER, axis=0)[_UPPER] / self.floor
            self.steady = np.nanmax(upper, axis=1, initial=0.0)
            self.recent = mean * self.floor
        self.ratio = np.where(usable & ready, excess, 0.0)
        self.active = self.ratio > 1.0
        learn = usable & ready & ~self.active
        if not frozen and learn.any():
            excess_energy = energy[learn] / self.floor[learn]
            quiet = self._history[:, learn].mean(axis=0) / self.floor[learn]
            weight = np.where(quiet < 0.3, 1 / _FALL_FRAMES, 1 / _FLOOR_FRAMES)
            self.floor[learn] *= 1 + weight * (np.minimum(excess_energy, 4.0) - 1)
            self.fall_db[learn] = np.max(
                10 * np.log10(self.first_floor[learn] / self.floor[learn]), axis=1
            )
        return self.active

    def start_from(self, floor: Array) -> None:
        """Begin with known floors, (channels, bands); NaN where one has to be learned."""
        known = np.isfinite(floor).all(axis=1) & (floor > 0).all(axis=1)
        self.floor[known] = self.first_floor[known] = floor[known]
        self.seen[known] = _WARM_UP

    def relearn(self, channel: int) -> None:
        """Forget the floor of a channel."""
        self.seen[channel] = 0
        self.first_floor[channel] = np.nan
        self.active[channel] = False
