"""Trains of equal cars, for those that no catalogue lists: without a size, only proportions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from .catalogue import TrainType

CAR = 19.0, 0.26
"""Length of a car over couplers (m), standard deviation of its logarithm: of all that is known,
that it is 12 m (four-axle hopper wagons) to 30 m (the longest of EN 1991-2 and of the UIC have 27
and 26.4 m), each as likely."""

NUMBERS_APART = 3
"""Numbers of cars that a channel tells apart about a given one, each as likely."""

ALTERNATIVES = NUMBERS_APART * 8
"""With four distances of bogies and two wheelbases that it tells apart."""

_NUMBERS = (2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 14, 16, 18, 20, 23, 26, 30)
_CENTRES = (0.62, 0.72)  # over the length of a car, of those that a first look tells apart
_SHARED = 1.0  # bogies shared by two cars
_USUAL = 0.70, 0.04  # the same of cars in service: the shipped types have 0.65 to 0.76
_USUAL_BASE = 0.105, 0.012  # wheelbase over length of a car: they have 0.09 to 0.11
_BASE = 0.11
_POWER = 0.55, 0.145  # the same of locomotives and power cars: shipped 0.51 to 0.63, 0.135 to 0.156
_POWER_SIZES = (0.65, 0.8, 1.0, 1.2, 1.45)  # their length over that of a car
_OVERHANG = 0.2  # of a power car and of the first car behind it, over the length of a car
_BOGIE = 3.6  # m, longest wheelbase

CHOICES = ALTERNATIVES * 3 * len(_NUMBERS)
"""Trains of equal cars alone among which the best is sought."""

WITH_POWER = 1 + 3 * len(_POWER_SIZES)
"""The same, over that, with a locomotive or power car at either end or at both."""


@dataclass(frozen=True)
class EqualCars:
    """A train of equal cars.

    Attributes:
        cars: their number.
        centres: distance of the bogies of a car over its length; 1 if neighbours share them.
        base: wheelbase over the length of a car.
        front, rear: length of a locomotive or power car at an end over that of a car; 0 without.
    """

    cars: int
    centres: float
    base: float
    front: float = 0.0
    rear: float = 0.0

    @property
    def shared(self) -> bool:
        """Whether neighbouring cars share a bogie."""
        return self.centres >= _SHARED

    @property
    def run(self) -> tuple[float, float]:
        """Where the equal cars begin and end behind the front of the train, in lengths of a car."""
        gap = _OVERHANG if self.shared else 0.0
        first = self.front + gap if self.front else 0.0
        return first, first + self.cars

    @property
    def train(self) -> TrainType:
        """The train with cars of :data:`CAR`."""
        first, last = self.run
        bogies = [(first + 0.5 + i + s * 0.5 * self.centres, self.base) for i, s in self._bogies]
        behind = last + (_OVERHANG if self.shared else 0.0)
        for length, start in ((self.front, 0.0), (self.rear, behind)):
            if length:
                middle, apart = start + 0.5 * length, 0.5 * _POWER[0] * length
                bogies += [(middle + s * apart, _POWER[1] * length) for s in (-1, 1)]
        places = np.array([b + s * base for b, base in sorted(bogies) for s in (-0.5, 0.5)])
        axles = CAR[0] * (places - places[0])
        ends = "".join(
            f", {n} {x:.2f}" for n, x in (("front", self.front), ("rear", self.rear)) if x
        )
        name = f"{self.cars} equal cars, {self.centres:.2f}, {self.base:.3f}{ends}"
        vehicles = self.cars + (self.front > 0) + (self.rear > 0)
        return TrainType(
            name, tuple(float(a) for a in axles), vehicles, length=CAR[0] * (behind + self.rear)
        )

    @property
    def _bogies(self) -> list[tuple[int, int]]:
        """Car and end of every bogie of the equal cars."""
        if self.shared:
            return [(0, -1), *((i, 1) for i in range(self.cars))]
        return [(i, s) for i in range(self.cars) for s in (-1, 1)]

    @property
    def ends(self) -> tuple[float, float]:
        """Where the equal cars begin and end behind the middle of the wheelsets (m)."""
        train, (first, last) = self.train, self.run
        bogie = 0.5 * (1 - self.centres) - 0.5 * self.base  # first wheelset behind the front
        if self.front:
            bogie = 0.5 * self.front * (1 - _POWER[0] - _POWER[1])
        middle = bogie * CAR[0] + 0.5 * train.span
        return first * CAR[0] - middle, last * CAR[0] - middle

    def numbers(self) -> list[EqualCars]:
        """The same cars, up to three more or fewer."""
        near = range(max(2, self.cars - 3), self.cars + 4)
        return [replace(self, cars=n) for n in near]

    def kinds(self, number: int) -> list[EqualCars]:
        """As many cars with bogies of their own, and with shared ones."""
        return [replace(self, cars=number, centres=c, base=_BASE) for c in (_USUAL[0], _SHARED)]

    def powered(self) -> list[EqualCars]:
        """The same cars with and without locomotives or power cars."""
        found = [replace(self, front=0.0, rear=0.0)]
        for size in _POWER_SIZES:
            found += [
                replace(self, front=front, rear=rear)
                for front, rear in ((size, 0.0), (0.0, size), (size, size))
            ]
        return found

    def proportions(self) -> list[EqualCars]:
        """As many cars of other proportions."""
        shared = (_SHARED,), (0.12, 0.14, 0.16, 0.18)
        own = tuple(np.arange(0.61, 0.80, 0.03)), (0.08, 0.095, 0.11, 0.125, 0.14)
        centres, bases = shared if self.shared else own
        return [replace(self, centres=float(c), base=b) for c in centres for b in bases]

    @property
    def choices(self) -> int:
        """Kinds of trains among which this one was chosen: with power cars there are more."""
        return WITH_POWER if self.front or self.rear else 1

    @property
    def prior(self) -> float:
        """How usual these proportions are (not normalised): builders do not choose them freely."""
        if self.shared:
            return 1.0
        off = (self.centres - _USUAL[0]) / _USUAL[1], (self.base - _USUAL_BASE[0]) / _USUAL_BASE[1]
        return float(np.exp(-0.5 * (off[0] ** 2 + off[1] ** 2)))


def starts() -> Iterator[EqualCars]:
    """Numbers and kinds of cars to begin with."""
    for cars in _NUMBERS:
        for centres in (*_CENTRES, _SHARED):
            yield EqualCars(cars, centres, _BASE)


def like(train: TrainType) -> tuple[EqualCars, float] | None:
    """The equal cars most like a type's, and the length of its cars (m)."""
    axles = train.axles
    new = np.flatnonzero(np.diff(axles) > _BOGIE) + 1
    groups = np.split(axles, new)
    if len(groups) < 3 or any(group.size < 2 for group in groups):
        return None
    bogies = np.array([0.5 * (group[0] + group[-1]) for group in groups])
    base = float(np.median([group[-1] - group[0] for group in groups]))
    apart, two = np.diff(bogies), bogies[2:] - bogies[:-2]
    length = float(np.median(two))
    centres = float(np.median(np.maximum(apart[1:], apart[:-1])))
    shared = centres > 0.9 * 0.5 * length and centres < 1.1 * 0.5 * length
    if shared:
        return EqualCars(max(2, round(train.span / centres)), _SHARED, base / centres), centres
    return EqualCars(max(2, round(train.length / length)), centres / length, base / length), length
