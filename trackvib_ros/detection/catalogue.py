"""The catalogue of train types: axle positions built from cars, in a file users edit."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from solver import InputError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

_CAR_FIELDS = {
    "count",
    "length",
    "bogie_centres",
    "wheelbase",
    "front_overhang",
    "shared_rear_bogie",
    "axles",
}
_TRAIN_FIELDS = {"name", "family", "source", "units", "cars", "articulated"}


@dataclass(frozen=True)
class TrainType:
    """One type of train.

    Attributes:
        name: unique name.
        axle_positions: distance of every wheelset behind the first one (m).
        cars: number of cars, power cars and locomotives included.
        units: trainsets coupled together (1 single, 2 double).
        family: name of the group of types that one sensor tells apart with difficulty.
        length: length over couplers (m).
        source: where the dimensions come from.
    """

    name: str
    axle_positions: tuple[float, ...]
    cars: int
    units: int = 1
    family: str = ""
    length: float = 0.0
    source: str = ""

    def __post_init__(self) -> None:
        """Check the axle positions."""
        axles = np.asarray(self.axle_positions, dtype=float)
        if axles.size < 2 or not np.all(np.isfinite(axles)) or np.any(np.diff(axles) < 0.5):
            raise InputError(
                f"train {self.name!r}: axle positions must be two or more, finite, increasing from "
                "front to rear and at least 0.5 m apart; correct its cars"
            )

    @cached_property
    def axles(self) -> NDArray[np.float64]:
        """:attr:`axle_positions` as an array (m)."""
        return np.asarray(self.axle_positions, dtype=np.float64)

    @property
    def span(self) -> float:
        """First to last wheelset (m)."""
        return self.axle_positions[-1]

    def oriented(self, reverse: bool) -> NDArray[np.float64]:
        """Axle positions behind the leading wheelset with either end in front (m)."""
        return self.span - self.axles[::-1] if reverse else self.axles

    @cached_property
    def symmetric(self) -> bool:
        """Whether both ends look the same to a sensor (within 5 cm)."""
        return bool(np.max(np.abs(self.oriented(True) - self.axles)) < 0.05)


@dataclass(frozen=True)
class Catalogue:
    """Train types that the detector knows.

    ``Catalogue.default()`` is the file shipped with the package, ``Catalogue.load(path)`` the
    user's own, ``Catalogue.from_axles({"my train": [0.0, 2.5, ...]})`` is made from arrays.
    """

    types: tuple[TrainType, ...]
    version: str = "unversioned"
    _names: tuple[str, ...] = field(init=False, repr=False, compare=False, default=())

    def __post_init__(self) -> None:
        """Check the names."""
        names = tuple(train.name for train in self.types)
        if not names:
            raise InputError("the catalogue has no train; give at least one [[train]]")
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise InputError(f"train names must differ; used more than once: {', '.join(twice)}")
        object.__setattr__(self, "_names", names)

    @property
    def longest_gap(self) -> float:
        """Longest distance between successive wheelsets of a train of any type (m)."""
        return max(float(np.max(np.diff(train.axles))) for train in self.types)

    def __iter__(self) -> Iterator[TrainType]:
        """Iterate over the types."""
        return iter(self.types)

    def __len__(self) -> int:
        """Return the number of types."""
        return len(self.types)

    def __getitem__(self, name: str) -> TrainType:
        """Return the type of that name."""
        try:
            return self.types[self._names.index(name)]
        except ValueError:
            raise InputError(
                f"train {name!r} is not in the catalogue; it has {', '.join(self._names)}"
            ) from None

    @property
    def longest(self) -> float:
        """Largest distance between first and last wheelset (m)."""
        return max(train.span for train in self.types)

    @classmethod
    def default(cls) -> Catalogue:
        """The catalogue shipped with the package."""
        text = resources.files(__package__).joinpath("catalogue.toml").read_text("utf-8")
        return cls.parse(text, "catalogue.toml")

    @classmethod
    def load(cls, path: str | Path) -> Catalogue:
        """Read a catalogue file.

        Raises:
            InputError: the file cannot be read or an entry is wrong; names file, train, field.
        """
        path = Path(path)
        try:
            return cls.parse(path.read_text("utf-8"), str(path))
        except (OSError, UnicodeDecodeError) as failure:
            raise InputError(f"catalogue {path}: cannot be read: {failure}") from None

    @classmethod
    def parse(cls, text: str, name: str) -> Catalogue:
        """Read catalogue text; ``name`` is used in messages."""
        try:
            table = tomllib.loads(text)
        except tomllib.TOMLDecodeError as failure:
            raise InputError(f"catalogue {name}: not valid TOML: {failure}") from None
        trains = table.get("train")
        if not isinstance(trains, list):
            raise InputError(f"catalogue {name}: has no [[train]] tables; give at least one")
        return cls(
            types=tuple(_train(entry, name, index) for index, entry in enumerate(trains, 1)),
            version=str(table.get("version", "unversioned")),
        )

    @classmethod
    def from_axles(
        cls, trains: Mapping[str, Sequence[float]], version: str = "caller"
    ) -> Catalogue:
        """Catalogue of bare axle positions (m) by name; the first wheelset need not be at 0.

        Raises:
            InputError: no mapping of names, or positions that are not two or more numbers.
        """
        if not isinstance(trains, Mapping):
            raise InputError(
                f"trains = {trains!r} must be a mapping of names to axle positions (m), "
                'like {"my train": [0.0, 2.5, 17.4, 19.9]}'
            )
        types = []
        for name, positions in trains.items():
            try:
                axles = np.sort(np.asarray(positions, dtype=float).ravel())
            except (TypeError, ValueError):
                axles = np.empty(0)
            if axles.size < 2:
                raise InputError(
                    f"train {name!r}: axle positions = {positions!r} must be two or more numbers, m"
                )
            types.append(
                TrainType(
                    name=name,
                    axle_positions=tuple(float(a) for a in axles - axles[0]),
                    cars=0,
                    family=name,
                    length=float(axles[-1] - axles[0]),
                )
            )
        return cls(tuple(types), version)


def _number(entry: Mapping[str, Any], key: str, where: str, low: float, high: float) -> float:
    value = entry.get(key)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        raise InputError(f"{where}: {key} = {value!r} must be a number from {low} to {high} m")
    return float(value)


def _train(entry: Mapping[str, Any], file: str, index: int) -> TrainType:
    name = entry.get("name")
    where = f"catalogue {file}, train {name if name else index!r}"
    if not isinstance(name, str) or not name:
        raise InputError(f"{where}: name = {name!r} must be a text")
    unknown = sorted(set(entry) - _TRAIN_FIELDS)
    if unknown:
        raise InputError(
            f"{where}: unknown field {unknown[0]!r}; known are {', '.join(sorted(_TRAIN_FIELDS))}"
        )
    units = entry.get("units", 1)
    if not isinstance(units, int) or units < 1:
        raise InputError(f"{where}: units = {units!r} must be a whole number of trainsets >= 1")
    cars = entry.get("cars")
    if not isinstance(cars, list) or not cars:
        raise InputError(f"{where}: cars must be a list of one or more car tables")
    axles: list[float] = []
    front, shared, count = 0.0, False, 0
    for number, car in enumerate(cars, 1):
        here = f"{where}, car entry {number}"
        unknown = sorted(set(car) - _CAR_FIELDS)
        if unknown:
            raise InputError(
                f"{here}: unknown field {unknown[0]!r}; known are {', '.join(sorted(_CAR_FIELDS))}"
            )
        repeat = car.get("count", 1)
        if not isinstance(repeat, int) or not 1 <= repeat <= 200:
            raise InputError(f"{here}: count = {repeat!r} must be a whole number from 1 to 200")
        length = _number(car, "length", here, 1.0, 100.0)
        for _ in range(repeat):
            if "axles" in car:
                axles += [front + float(position) for position in car["axles"]]
                shared = False
            else:
                centres = _number(car, "bogie_centres", here, 0.0, length)
                half = _number(car, "wheelbase", here, 0.5, 10.0) / 2
                overhang = (
                    _number(car, "front_overhang", here, 0.0, length)
                    if "front_overhang" in car
                    else (length - centres) / 2
                )
                bogies = (front + overhang, front + overhang + centres)
                for centre in bogies[1:] if shared else bogies:
                    axles += [centre - half, centre + half]
                shared = bool(car.get("shared_rear_bogie", False))
            front += length
            count += 1
    if not axles:
        raise InputError(f"{where}: its cars have no axles")
    return TrainType(
        name=name,
        axle_positions=tuple(axle - axles[0] for axle in axles),
        cars=count,
        units=units,
        family=str(entry.get("family", name)),
        length=front,
        source=str(entry.get("source", "")),
    )
