"""Trains of equal cars, for those that no catalogue lists: without a size, only proportions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from .catalogue import TrainType

CAR = 20.0, 0.2
"""Length of a car over couplers (m), standard deviation of its logarithm: 95 % of the cars are 13.5
to 30 m long (short articulated bodies and metros; the longest of EN 1991-2 and of the UIC have 27
and 26.4 m)."""

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

CHOICES = ALTERNATIVES * 3 * len(_NUMBERS)
"""Trains of equal cars among which the best is sought."""


@dataclass(frozen=True)
class EqualCars:
    """A train of equal cars.

    Attributes:
        cars: their number.
        centres: distance of the bogies of a car over its length; 1 if neighbours share them.
        base: wheelbase over the length of a car.
    """

    cars: int
    centres: float
    base: float

    @property
    def shared(self) -> bool:
        """Whether neighbouring cars share a bogie."""
        return self.centres >= _SHARED

    @property
    def train(self) -> TrainType:
        """The train with cars of :data:`CAR`."""
        middle = np.arange(self.cars + 1 if self.shared else self.cars) * 1.0
        bogies = (0.0,) if self.shared else (-0.5 * self.centres, 0.5 * self.centres)
        places = [m + b + s * self.base for m in middle for b in bogies for s in (-0.5, 0.5)]
        axles = CAR[0] * (np.array(places) - places[0])
        name = f"{self.cars} equal cars, {self.centres:.2f}, {self.base:.3f}"
        length = self.cars * CAR[0]
        return TrainType(name, tuple(float(a) for a in axles), self.cars, length=length)

    def numbers(self) -> list[EqualCars]:
        """The same cars, up to three more or fewer."""
        near = range(max(2, self.cars - 3), self.cars + 4)
        return [EqualCars(n, self.centres, self.base) for n in near]

    def proportions(self) -> list[EqualCars]:
        """As many cars of other proportions."""
        shared = (_SHARED,), (0.12, 0.14, 0.16, 0.18)
        own = tuple(np.arange(0.61, 0.80, 0.03)), (0.08, 0.095, 0.11, 0.125, 0.14)
        centres, bases = shared if self.shared else own
        return [EqualCars(self.cars, float(c), b) for c in centres for b in bases]

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
