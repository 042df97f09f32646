"""Vehicles: M y'' + C y' + K y = g M 1 - P^T F, y positive down, F the wheelset forces.

A *unit* is a set of vehicles that suspensions connect: one car, one wheel element, or the cars
that share Jacobs bogies. Trains are lists of units; couplers carry no vertical force.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, expm

from .contact import compression_of
from .scenario import GRAVITY, Car, Train, WheelElement

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Unit:
    """Linear model of vehicles that are connected to each other.

    Attributes:
        mass, damping, stiffness: (N, N) kg or kg m², N·s/m, N/m.
        weight: (N,) N, gravity on the degrees of freedom.
        wheelsets: (A,) indices of the wheelset displacements, front first.
        wheel_radius: (A,) m.
    """

    mass: Array
    damping: Array
    stiffness: Array
    weight: Array
    wheelsets: NDArray[np.intp]
    wheel_radius: Array

    @cached_property
    def static_loads(self) -> Array:
        """(A,) N, wheelset forces at rest on a rigid flat track."""
        size = len(self.weight)
        free = np.setdiff1d(np.arange(size), self.wheelsets)
        rest = np.zeros(size)
        rest[free] = np.linalg.solve(self.stiffness[np.ix_(free, free)], self.weight[free])
        return (self.weight - self.stiffness @ rest)[self.wheelsets]


class _Assembly:
    def __init__(self) -> None:
        self.masses: list[float] = []
        self.heavy: list[bool] = []
        self.springs: list[tuple[dict[int, float], float, float]] = []

    def add(self, mass: float, heavy: bool = True) -> int:
        self.masses.append(mass)
        self.heavy.append(heavy)
        return len(self.masses) - 1

    def connect(self, elongation: dict[int, float], stiffness: float, damping: float) -> None:
        self.springs.append((elongation, stiffness, damping))

    def unit(self, wheelsets: list[int], radii: list[float]) -> Unit:
        size = len(self.masses)
        stiffness, damping = np.zeros((size, size)), np.zeros((size, size))
        for elongation, k, c in self.springs:
            row = np.zeros(size)
            for index, factor in elongation.items():
                row[index] = factor
            stiffness += k * np.outer(row, row)
            damping += c * np.outer(row, row)
        masses = np.array(self.masses)
        return Unit(
            mass=np.diag(masses),
            damping=damping,
            stiffness=stiffness,
            weight=GRAVITY * masses * np.array(self.heavy),
            wheelsets=np.array(wheelsets, dtype=np.intp),
            wheel_radius=np.array(radii),
        )


def _wheel_element(vehicle: WheelElement) -> Unit:
    assembly = _Assembly()
    body = assembly.add(vehicle.body_mass / 4)
    bogie = assembly.add(vehicle.bogie_mass / 2)
    wheelset = assembly.add(vehicle.wheelset_mass)
    assembly.connect(
        {body: 1.0, bogie: -1.0}, vehicle.secondary_stiffness / 2, vehicle.secondary_damping / 2
    )
    assembly.connect(
        {bogie: 1.0, wheelset: -1.0}, vehicle.primary_stiffness, vehicle.primary_damping
    )
    return assembly.unit([wheelset], [vehicle.wheel_radius])


def _cars(cars: list[Car]) -> Unit:
    """Cars of 10 degrees of freedom; neighbours share a bogie (pitch positive: front end down)."""
    assembly = _Assembly()
    wheelsets: list[int] = []
    radii: list[float] = []

    def bogie(car: Car) -> int:
        bounce = assembly.add(car.bogie_mass)
        pitch = assembly.add(car.bogie_inertia, heavy=False)
        for arm in (car.wheelbase / 2, -car.wheelbase / 2):
            wheelset = assembly.add(car.wheelset_mass)
            assembly.connect(
                {bounce: 1.0, pitch: arm, wheelset: -1.0},
                car.primary_stiffness,
                car.primary_damping,
            )
            wheelsets.append(wheelset)
            radii.append(car.wheel_radius)
        return bounce

    shared: int | None = None
    for car in cars:
        body = assembly.add(car.body_mass)
        pitch = assembly.add(car.body_inertia, heavy=False)
        front = bogie(car) if shared is None else shared
        rear = bogie(car)
        for bounce, arm in ((front, car.bogie_centres / 2), (rear, -car.bogie_centres / 2)):
            assembly.connect(
                {body: 1.0, pitch: arm, bounce: -1.0},
                car.secondary_stiffness,
                car.secondary_damping,
            )
        shared = rear if car.shared_rear_bogie else None
    return assembly.unit(wheelsets, radii)


def build_units(train: Train) -> list[Unit]:
    """The units of a train, front first."""
    units: list[Unit] = []
    connected: list[Car] = []
    for vehicle in train.vehicles:
        if isinstance(vehicle, WheelElement):
            units.append(_wheel_element(vehicle))
            continue
        connected.append(vehicle)
        if not vehicle.shared_rear_bogie:
            units.append(_cars(connected))
            connected = []
    return units


@dataclass(frozen=True, eq=False)
class UnitStep:
    """Exact time step of a unit's state (y, y') under forces interpolated in time.

    With the state before the force of the new sample is known, s, and its forces F of this and F'
    of the last sample: (y, y') = s + now F + before F', and the next s is
    ``transition`` s + ``drive`` F + ``constant``.

    Attributes:
        transition: (2N, 2N). drive, now, before: (2N, A). constant: (2N,).
    """

    transition: Array
    drive: Array
    now: Array
    before: Array
    constant: Array


def discretise(unit: Unit, step: float, order: int) -> UnitStep:
    """Discretise a unit for a time step (s).

    Args:
        unit: the unit.
        step: time step (s).
        order: 1: forces linear in the step; 2: quadratic through the last two and the new sample.

    The integrals of exp(A (h - t)) B (t/h)^j follow from one exponential of an augmented matrix
    (Van Loan, IEEE Trans. Autom. Control 23(3), 1978).
    """
    size, axles = len(unit.weight), len(unit.wheelsets)
    inverse = np.diag(1 / np.diag(unit.mass))
    flow = np.block(
        [
            [np.zeros((size, size)), np.eye(size)],
            [-inverse @ unit.stiffness, -inverse @ unit.damping],
        ]
    )
    push = np.zeros((2 * size, axles + 1))
    push[size + unit.wheelsets, np.arange(axles)] = -inverse[unit.wheelsets, unit.wheelsets]
    push[size:, axles] = inverse @ unit.weight
    inputs = axles + 1
    total = 2 * size + 3 * inputs
    augmented = np.zeros((total, total))
    augmented[: 2 * size, : 2 * size] = flow * step
    augmented[: 2 * size, 2 * size : 2 * size + inputs] = push * step
    for j in range(2):
        at = 2 * size + j * inputs
        augmented[at : at + inputs, at + inputs : at + 2 * inputs] = np.eye(inputs)
    result = expm(augmented)
    transition = result[: 2 * size, : 2 * size]
    constant, linear, quadratic = (
        factor * result[: 2 * size, 2 * size + j * inputs : 2 * size + (j + 1) * inputs]
        for j, factor in enumerate((1.0, 1.0, 2.0))
    )
    if order == 1:
        past, present, future = np.zeros_like(linear), constant - linear, linear
    else:
        past = (quadratic - linear) / 2
        present = constant - quadratic
        future = (quadratic + linear) / 2
    before = -np.linalg.solve(transition, past)
    drive = transition @ future + present - before
    return UnitStep(
        transition=transition,
        drive=np.ascontiguousarray(drive[:, :axles]),
        now=np.ascontiguousarray(future[:, :axles]),
        before=np.ascontiguousarray(before[:, :axles]),
        constant=np.ascontiguousarray(constant[:, axles]),
    )


def block_units(units: list[Unit]) -> Unit:
    """Several units as one, for the static start and the full-matrix integrator."""
    sizes = np.cumsum([0] + [len(unit.weight) for unit in units])
    return Unit(
        mass=block_diag(*(unit.mass for unit in units)),
        damping=block_diag(*(unit.damping for unit in units)),
        stiffness=block_diag(*(unit.stiffness for unit in units)),
        weight=np.concatenate([unit.weight for unit in units]),
        wheelsets=np.concatenate(
            [start + unit.wheelsets for start, unit in zip(sizes[:-1], units, strict=True)]
        ),
        wheel_radius=np.concatenate([unit.wheel_radius for unit in units]),
    )


def static_start(
    unit: Unit, law: Array, compliance: Array, roughness: Array
) -> tuple[Array, Array]:
    """Static equilibrium of units on the track.

    Every bogie pitches freely on its wheelsets and every body on its bogies, so the wheelset
    forces are those on a rigid flat track, whatever lies under the wheelsets.

    Args:
        unit: one unit, or several as a block.
        law: (2, A) linear stiffness and Hertz factor of every wheelset.
        compliance: (A, A) m/N, rail displacement under wheelset i per force of wheelset j.
        roughness: (A,) m.

    Returns:
        displacements (N,) m or rad, and wheelset forces (A,) N.
    """
    force = unit.static_loads
    rest = np.zeros(len(unit.weight))
    rest[unit.wheelsets] = compliance @ force + roughness + compression_of(force, *law)
    free = np.setdiff1d(np.arange(len(rest)), unit.wheelsets)
    load = unit.weight[free] - unit.stiffness[np.ix_(free, unit.wheelsets)] @ rest[unit.wheelsets]
    rest[free] = np.linalg.solve(unit.stiffness[np.ix_(free, free)], load)
    return rest, force
