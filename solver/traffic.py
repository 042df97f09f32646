"""Which units run where and when: from trains to wheelsets on and near the line."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .contact import wheelset_law
from .errors import InputError
from .irregularity import Profile, build_profile, wheel_defect
from .motion import TrainMotion
from .scenario import Scenario, Train
from .vehicle import Unit, build_units

Array = NDArray[np.float64]

RUN_IN = 25.0
"""Distance (m) before the line at which a unit starts, in static equilibrium on a rigid rail.

The mode of a wheelset on its contact spring (167 Hz, 2 % damping for a CRH3) decays by 50 dB.
"""

NEVER = 2**62

END_ZONE = 4.0
"""Length (m) of the zone at either end in which the running surface of a crossing wheelset is
laid so that its loaded level stays even; faded out over its inner half."""


@dataclass(eq=False)
class Running:
    """A unit of a train with the samples in which it is stepped.

    Attributes:
        unit, train: the unit and the index of its train.
        kind: number that is equal for units with equal matrices.
        axles: its wheelsets among those of its train.
        law: (2, A) contact law of its wheelsets.
        start, end: first sample, and first sample after it has left the line.
        columns: its wheelsets among those that have a column, see :meth:`Traffic.arrange`.
    """

    unit: Unit
    train: int
    kind: int
    axles: slice
    law: Array
    start: int
    end: int
    columns: slice


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _add_ends(
    position: Array,
    crossed: NDArray[np.bool_],
    load: Array,
    step: float,
    rise: Array,
    length: float,
    values: Array,
) -> None:
    last = rise.shape[1] - 1
    for n in range(position.shape[0]):
        for i in range(position.shape[1]):
            for side in range(2):
                inside = position[n, i] if side == 0 else length - position[n, i]
                if crossed[i, side] and inside < last * step:
                    place = max(inside, 0.0) / step
                    cell = min(int(place), last - 1)
                    share = place - cell
                    height = (1.0 - share) * rise[side, cell] + share * rise[side, cell + 1]
                    values[n, i] += load[i] * height


class Traffic:
    """All trains of a run.

    Args:
        scenario: line, trains, contact and irregularity.

    Raises:
        InputError: a wheelset would cross a free end of the line.

    Attributes:
        motions: kinematics of every train by its index, which counts trains as they are added.
        running: their units.
        arranged: indices of the trains whose wheelsets have columns, in order of the columns.
        wheelset_train, wheelset_number: (W,) index of the train, and number in it from 1, of every
            column.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.length = scenario.line.length
        self.step = scenario.solution.step_ns * 1e-9
        self.motions: dict[int, TrainMotion] = {}
        self.running: list[Running] = []
        self.arranged: tuple[int, ...] = ()
        self.wheelset_train: NDArray[np.intp] = np.zeros(0, dtype=np.intp)
        self.wheelset_number: NDArray[np.intp] = np.zeros(0, dtype=np.intp)
        self._added = 0
        self._last_exit = 0
        self._kinds: list[Unit] = []
        self._profile: Profile | None = None
        self._reach = 0.0
        self._zone: Array = np.zeros(0)
        self._rise: Array = np.zeros((2, 0))
        self._crossed: dict[tuple[int, int], tuple[bool, bool]] = {}
        for train in scenario.train:
            self.add(train)
        self.arrange(tuple(self.motions))

    def add(self, train: Train, now: int = 0) -> int:
        """Add a train whose units may start at sample ``now`` or later; returns its index."""
        motion = TrainMotion(train)
        index, first = self._added, 0
        entry, way_out = (0.0, self.length) if motion.sign > 0 else (self.length, 0.0)
        starts = motion.axle_times(entry - motion.sign * RUN_IN)
        ends = motion.axle_times(way_out)
        self._check_free_ends(train, motion, now)
        for unit in build_units(train):
            axles = len(unit.wheelsets)
            last = first + axles - 1
            law = [wheelset_law(self.scenario.contact, radius) for radius in unit.wheel_radius]
            self.running.append(
                Running(
                    unit=unit,
                    train=index,
                    kind=self._kind(unit),
                    axles=slice(first, last + 1),
                    law=np.array(law).T,
                    start=max(now, math.ceil(starts[first] / self.step)),
                    end=math.floor(ends[last] / self.step) + 1,
                    columns=slice(0, 0),
                )
            )
            self._last_exit = max(self._last_exit, self.running[-1].end)
            reach = RUN_IN + float(motion.offsets[last] - motion.offsets[first]) + 1.0
            if reach > self._reach:
                self._reach, self._profile = reach, None
            first = last + 1
        self.motions[index] = motion
        self._added += 1
        return index

    def arrange(self, trains: Sequence[int]) -> NDArray[np.intp]:
        """Give columns to the wheelsets of just these trains, in this order.

        Returns:
            (W,) column that every new column was before, -1 if there was none.
        """
        before = {index: column for column, index in enumerate(self._columns_of(self.arranged))}
        places = self._columns_of(trains)
        self.arranged = tuple(trains)
        self.wheelset_train = np.array([train for train, _ in places], dtype=np.intp)
        self.wheelset_number = np.array([axle + 1 for _, axle in places], dtype=np.intp)
        first = {train: places.index((train, 0)) for train in self.arranged}
        for unit in self.running:
            start = first.get(unit.train)
            unit.columns = (
                slice(0, 0)
                if start is None
                else slice(start + unit.axles.start, start + unit.axles.stop)
            )
        return np.array([before.get(place, -1) for place in places], dtype=np.intp)

    def _columns_of(self, trains: Sequence[int]) -> list[tuple[int, int]]:
        return [
            (index, axle) for index in trains for axle in range(len(self.motions[index].offsets))
        ]

    def present(self, first: int, last: int) -> tuple[int, ...]:
        """Indices of the trains with a unit that is stepped between two samples."""
        near = {unit.train for unit in self.running if unit.start <= last and unit.end > first}
        return tuple(sorted(near))

    def rearranged(self, values: Array, source: NDArray[np.intp]) -> Array:
        """(n, W) values by column as they are after :meth:`arrange`; NaN in new columns."""
        return np.where(source >= 0, np.pad(values, ((0, 0), (0, 1)))[:, source], np.nan)

    def steady(self, first: int, last: int) -> tuple[int, int]:
        """First later end, and first later start, of a unit that :meth:`present` looks at."""
        ends = [unit.end for unit in self.running if unit.end > first and unit.start <= last]
        starts = [unit.start for unit in self.running if unit.start > last]
        return min(ends, default=NEVER), min(starts, default=NEVER)

    def departed(self, sample: int) -> tuple[int, ...]:
        """Indices of the trains that are off the line from a sample on, for good."""
        coming = {unit.train for unit in self.running if unit.end > sample}
        return tuple(index for index in self.motions if index not in coming)

    def forget(self, trains: Sequence[int]) -> None:
        """Drop trains that have no columns and will have none any more."""
        for index in trains:
            del self.motions[index]
        self.running = [unit for unit in self.running if unit.train in self.motions]
        self._crossed = {k: v for k, v in self._crossed.items() if k[0] in self.motions}

    def _kind(self, unit: Unit) -> int:
        for index, other in enumerate(self._kinds):
            if other.mass.shape == unit.mass.shape and all(
                np.array_equal(getattr(unit, name), getattr(other, name))
                for name in ("mass", "damping", "stiffness", "wheelsets")
            ):
                return index
        self._kinds.append(unit)
        return len(self._kinds) - 1

    def _check_free_ends(self, train: Train, motion: TrainMotion, now: int) -> None:
        if self.scenario.line.ends == "pinned":
            return
        end_time = self.scenario.solution.end_time
        start = now * self.step
        for end in (0.0, self.length):
            times = motion.axle_times(end)
            crossing = (times > start) & (times <= (math.inf if end_time is None else end_time))
            if crossing.any():
                axle = int(np.argmax(crossing))
                raise InputError(
                    f'line.ends = "free": wheelset {axle + 1} of the train that starts at '
                    f"{train.start:g} m crosses the end x = {end:g} m at t = {times[axle]:.6g} s; "
                    "a wheelset must not run off a free end: set an earlier solution.end_time, "
                    'another train.start, or line.ends = "pinned"'
                )

    def lay_ends(self, compliance: Callable[[Array], Array]) -> None:
        """Lower the rigid rail beyond a pinned end to the level that a loaded rail has inside.

        A wheelset that crosses an end would climb its static deflection, about 1 mm, within 1 m:
        a blow of the size of its weight that no real track gives. Beyond the end the surface is
        lower by load * c, c the rail's static point compliance inside; within ``END_ZONE`` by
        what the deflection under the load lacks to that. Wheelsets that do not cross an end
        during the run never meet this surface.

        Args:
            compliance: static point compliance of the rail (m/N) at positions (n,) m.
        """
        zone = min(END_ZONE, self.length / 4)
        self._zone = np.linspace(0.0, zone, 161)
        fade = 0.5 * (1 + np.cos(np.pi * np.clip(2 * self._zone / zone - 1, 0, 1)))
        sides = []
        for place in (self._zone, self.length - self._zone):
            value = compliance(place)
            value[0] = 0.0
            sides.append(fade * (value[-1] - value))
        self._rise = np.array(sides)

    def _lay_surface(self, units: Sequence[Running], position: Array, values: Array) -> None:
        """Add to ``values`` (n, A) what :meth:`lay_ends` lays under wheelsets at ``position``."""
        crossed = []
        for running in units:
            for axle in range(running.axles.start, running.axles.stop):
                wheelset = running.train, axle
                if wheelset not in self._crossed:
                    self._crossed[wheelset] = self._ends_crossed(running, axle)
                crossed.append(self._crossed[wheelset])
        if crossed:
            load = np.concatenate([running.unit.static_loads for running in units])
            step, crossings = float(self._zone[1]), np.array(crossed, dtype=np.bool_)
            _add_ends(position, crossings, load, step, self._rise, self.length, values)

    def _ends_crossed(self, running: Running, axle: int) -> tuple[bool, bool]:
        motion, end_time = self.motions[running.train], self.scenario.solution.end_time
        first = motion.position(np.array([running.start * self.step]))[0, axle]
        last = math.inf * motion.sign
        if end_time is not None:
            last = motion.position(np.array([end_time]))[0, axle]
        return min(first, last) < 0, max(first, last) > self.length

    @property
    def kinds(self) -> list[Unit]:
        """One unit of every kind."""
        return self._kinds

    def active(self, sample: int) -> list[Running]:
        """Units on or near the line at a sample."""
        return [unit for unit in self.running if unit.start <= sample < unit.end]

    def next_change(self, sample: int) -> int:
        """First later sample at which the active units differ."""
        times = [t for unit in self.running for t in (unit.start, unit.end) if t > sample]
        return min(times, default=NEVER)

    def last_exit(self) -> float:
        """Time (s) at which the last wheelset leaves the line; 0 without trains."""
        return self._last_exit * self.step

    def position(self, time: Array) -> Array:
        """(n, W) m, all wheelsets that have columns, at times (n,) s."""
        places = [self.motions[index].position(time) for index in self.arranged]
        return np.concatenate([np.zeros((len(time), 0)), *places], axis=1)

    def roughness(self, units: Sequence[Running], position: Array, time: Array) -> Array:
        """(n, A) m: irregularity, wheel defects and end surfaces under the wheelsets of ``units``.

        Args:
            units: A wheelsets in all.
            position: (n, A) m of these wheelsets.
            time: (n,) s.
        """
        if self._profile is None:
            self._profile = build_profile(
                self.scenario.irregularity, -self._reach, self.length + self._reach, self.length
            )
        values = self._profile(position)
        if self._zone.size and self.scenario.line.ends == "pinned":
            self._lay_surface(units, position, values)
        column = 0
        for running in units:
            motion = self.motions[running.train]
            train = motion.train
            if not train.flat and not train.polygon:
                column += len(running.unit.wheelsets)
                continue
            for axle in range(len(running.unit.wheelsets)):
                number = running.axles.start + axle + 1
                flats = [flat.length for flat in train.flat if flat.wheelset == number]
                waves = [wave for wave in train.polygon if wave.wheelset == number]
                radius = float(running.unit.wheel_radius[axle])
                for length in flats:
                    values[:, column] += wheel_defect(
                        motion.travelled(time), radius, length, 1, 0.0
                    )
                for wave in waves:
                    values[:, column] += wheel_defect(
                        motion.travelled(time), radius, 0.0, wave.order, wave.amplitude
                    )
                column += 1
        return values
