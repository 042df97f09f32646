"""Where the wheelsets of a train are: kinematics of its start, speed and direction."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .scenario import Train

Array = NDArray[np.float64]


class TrainMotion:
    """Motion of one train along the line, known in advance.

    The speed is piecewise linear in the time since ``start_time`` (constant before the first and
    after the last corner of ``speed_profile``), so positions are piecewise quadratic and exact.

    Args:
        train: its ``start`` (m) is the position of the first wheelset at ``start_time`` (s).

    Attributes:
        train: the train.
        sign: +1 forward (towards increasing x), -1 backward.
        offsets: (A,) m, distance of every wheelset behind the first.
    """

    def __init__(self, train: Train) -> None:
        self.train = train
        self.sign = 1.0 if train.direction == "forward" else -1.0
        self.offsets: Array = np.array(train.axle_positions)
        points = [(point.time, point.speed) for point in train.speed_profile]
        points = points or [(0.0, train.speed)]
        self._knots: Array = np.array([train.start_time + time for time, _ in points])
        self._speeds: Array = np.array([speed for _, speed in points])
        lengths = np.diff(self._knots)
        self._rates: Array = np.append(np.diff(self._speeds) / lengths, 0.0)
        means = (self._speeds[:-1] + self._speeds[1:]) / 2
        self._travelled: Array = np.concatenate([[0.0], np.cumsum(means * lengths)])

    def travelled(self, time: ArrayLike) -> Array:
        """Distance run since ``start_time`` (m), negative before it; shape of ``time`` (s)."""
        t = np.asarray(time, dtype=np.float64)
        if len(self._knots) == 1:
            return np.asarray(self._speeds[0] * (t - self._knots[0]))
        piece = np.clip(np.searchsorted(self._knots, t, side="right") - 1, 0, None)
        elapsed = t - self._knots[piece]
        rate = np.where(elapsed < 0, 0.0, self._rates[piece])
        return self._travelled[piece] + (self._speeds[piece] + 0.5 * rate * elapsed) * elapsed

    def position(self, time: ArrayLike) -> Array:
        """Positions of the wheelsets (m), shape ``time.shape + (A,)``, first wheelset first."""
        first = self.train.start + self.sign * self.travelled(time)
        return first[..., np.newaxis] - self.sign * self.offsets

    def speed(self, time: ArrayLike) -> Array:
        """Speed (m/s, positive in either direction), shape of ``time`` (s)."""
        return np.interp(np.asarray(time, dtype=np.float64), self._knots, self._speeds)

    def _time_after(self, distance: ArrayLike) -> Array:
        s = np.asarray(distance, dtype=np.float64)
        piece = np.clip(np.searchsorted(self._travelled, s, side="right") - 1, 0, None)
        remaining = s - self._travelled[piece]
        start = self._speeds[piece]
        rate = np.where(remaining < 0, 0.0, self._rates[piece])
        end = np.sqrt(np.maximum(start**2 + 2 * rate * remaining, 0.0))
        return self._knots[piece] + 2 * remaining / (start + end)

    def time_at(self, x: float) -> float:
        """Time (s) at which the first wheelset is at ``x`` (m)."""
        return float(self._time_after(self.sign * (x - self.train.start)))

    def axle_times(self, x: float) -> Array:
        """Times (s) at which the wheelsets are at ``x`` (m), shape (A,), first wheelset first."""
        return self._time_after(self.sign * (x - self.train.start) + self.offsets)
