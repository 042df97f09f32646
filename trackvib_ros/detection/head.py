"""The first wheelsets of a train, or by mirroring its last, against the catalogue.

The log-energy of a rail channel is put on a distance grid for every trial speed and compared with
the part of every type's comb that can have passed by now; Pearson's r over that part. A linear
model with unknown gain, offset and noise has the profile likelihood (1 - r²)^(-n/2) for n
independent values (Seber & Lee, Linear Regression Analysis, 2003, sec. 4.1); the weights of types
and speeds are these, with one n for all because all explain the same samples, and with a misfit
added to 1 - r² because pulses differ. Constant speed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .catalogue import TrainType
from .pattern import Trace
from .strength import STRONG

Array = NDArray[np.float64]

LEAST_SCORE = 0.75
"""Least correlation of a head that is told."""

MOST_UNCERTAIN = 0.15
"""Largest relative uncertainty of a speed that is told."""

_CELL = 0.5  # m
_WIDTH = 0.8  # m, of a wheelset in the smoothed energy
_BEFORE, _AFTER = 6.0, 8.0  # m of quiet about a train that belongs to its pattern
_WHEELSETS = 95  # per cent of the bins of a passing train are weaker than its strong wheelsets
_OFFSETS = np.arange(-4.0, 4.01, 0.5)  # m, first strong energy is only near the first wheelset
_SPEED_STEP = 0.012
_INDEPENDENT = 2.5  # m between independent values of the smoothed energy
_MISFIT = 0.05  # share of the variance that no comb of equal pulses explains
_LEAST_SIGMA = 0.02  # relative: sizes of relatives that no catalogue lists


@dataclass(frozen=True)
class Head:
    """Speed by the part of a train that has passed one channel.

    Attributes:
        speed: of the most probable type (m/s).
        sigma: standard deviation about it over all types and speeds (m/s).
        score: largest correlation.
        passed: wheelsets that have passed, of the most probable type.
        distance: length of train that has passed (m).
        start: time of the first wheelset (s).
        types: (name, probability), most probable first.
        families: the same for families.
    """

    speed: float
    sigma: float
    score: float
    passed: int
    distance: float
    start: float
    types: tuple[tuple[str, float], ...]
    families: tuple[tuple[str, float], ...]

    @property
    def clear(self) -> bool:
        """Whether it says enough to be told."""
        return self.score >= LEAST_SCORE and self.sigma < MOST_UNCERTAIN * self.speed


class HeadMatcher:
    """Combs of all types, either end first, ready for comparison.

    Args:
        trains: catalogue types.
        limits: lowest and highest speed (m/s).
        mirrored: trains are read from their last wheelset, in reversed time.
    """

    def __init__(
        self, trains: Sequence[TrainType], limits: tuple[float, float], mirrored: bool = False
    ) -> None:
        self.entries = [
            (train, train.oriented(reverse != mirrored))
            for train in trains
            for reverse in ((False,) if train.symmetric else (False, True))
        ]
        self.speeds = np.geomspace(
            *limits, 1 + int(np.ceil(np.log(limits[1] / limits[0]) / _SPEED_STEP))
        )
        longest = max(train.span for train, _ in self.entries)
        self.place = np.arange(-_BEFORE, longest + _AFTER, _CELL) + _CELL / 2
        rows = []
        for _, places in self.entries:
            for offset in _OFFSETS:
                from_wheel = (self.place[:, None] - places - offset) / _WIDTH
                rows.append(np.exp(-0.5 * from_wheel**2).sum(axis=1))
        self.combs = np.stack(rows)
        self._sum = np.cumsum(self.combs, axis=1)
        self._square = np.cumsum(self.combs**2, axis=1)
        kernel = np.arange(-4, 5) * _CELL / (0.6 * _WIDTH)
        self._kernel = np.exp(-0.5 * kernel**2) / np.exp(-0.5 * kernel**2).sum()

    def match(self, trace: Trace, start: float, now: float) -> Head | None:
        """Compare what passed between the first strong energy and now (s).

        Returns:
            The result, or ``None`` if less than 0.1 s or no pattern has passed.
        """
        if now - start < 0.1:
            return None
        score = np.zeros((self.speeds.size, len(self.combs)))
        # weaker energy is what the rail carries between bogies and ahead of the train
        passing = trace.energy[(trace.time >= start) & (trace.time <= now)]
        strong = float(np.percentile(passing, _WHEELSETS)) if passing.size else 0.0
        least = float(np.log(max(STRONG * strong / trace.base, 1.0)))
        for i, speed in enumerate(self.speeds):
            count = int((speed * (now - start) + _BEFORE) / _CELL)
            count = min(count, self.place.size)
            if count < 16:
                continue
            edges = start + (np.arange(count + 1) * _CELL - _BEFORE) / speed
            level = np.maximum(trace.levels(edges), least)
            level = np.convolve(np.pad(level, 4, mode="edge"), self._kernel, mode="valid")
            level = level - level.mean()
            own = float(level @ level)
            comb = self._square[:, count - 1] - self._sum[:, count - 1] ** 2 / count
            score[i] = self.combs[:, :count] @ level / np.sqrt(np.maximum(own * comb, 1e-12))
        top = float(score.max())
        if top <= 0:
            return None
        row = int(np.argmax(score)) // len(self.combs)
        independent = float(self.speeds[row]) * (now - start) / _INDEPENDENT
        square = np.clip(score, 0.0, 0.999) ** 2
        log = -0.5 * independent * np.log(1 - square + _MISFIT)
        weight = np.exp(log - log.max())
        weight /= weight.sum()
        best = np.unravel_index(int(np.argmax(weight)), weight.shape)
        places = self.entries[best[1] // _OFFSETS.size][1]
        # the peak of this type between the trial speeds
        mine = weight[:, best[1]]
        near = slice(max(best[0] - 3, 0), best[0] + 4)
        speed = float(mine[near] @ self.speeds[near] / mine[near].sum())
        offset = float(_OFFSETS[best[1] % _OFFSETS.size])
        distance = speed * (now - start) - offset
        by_speed = weight.sum(axis=1)
        variance = float(by_speed @ (self.speeds - speed) ** 2)
        by_entry = weight.reshape(self.speeds.size, len(self.entries), -1).sum(axis=(0, 2))
        types: dict[str, float] = {}
        families: dict[str, float] = {}
        for (entry, _), p in zip(self.entries, by_entry, strict=True):
            types[entry.name] = types.get(entry.name, 0.0) + float(p)
            families[entry.family] = families.get(entry.family, 0.0) + float(p)
        return Head(
            speed=speed,
            sigma=float(np.hypot(variance**0.5, _LEAST_SIGMA * speed)),
            score=top,
            passed=int(np.sum(places <= distance)),
            distance=distance,
            start=start + offset / speed,
            types=_ranked(types),
            families=_ranked(families),
        )


def _ranked(table: dict[str, float]) -> tuple[tuple[str, float], ...]:
    return tuple(
        (name, round(p, 4)) for name, p in sorted(table.items(), key=lambda i: -i[1]) if p > 1e-3
    )
