"""A second method: plain nodal finite elements of a scenario, stepped by Newmark.

It shares no equation with the rest of the solver but the scenario's numbers: own beams (Timoshenko
rail: nodal elements of degree ``DEGREE`` in deflection and rotation; all others: cubic Hermite,
many to a bay), own matrices, own vehicles, full matrices throughout, no modes. Linear contact,
irregularity given as components, one train at constant speed.

Three details decide whether such a model can serve as a yardstick at kilohertz:

- Two-node Timoshenko elements with exact static shapes converge only with h^2: with 24 to a bay
  of 0.65 m natural frequencies are still 0.2 % high at 2.8 kHz and 0.4 % at 3.6 kHz. Two such
  models differ by percents there, and neither is right. Elements of degree 7, two to a bay, are
  within 1e-6 to 4.8 kHz.
- A Timoshenko beam has a kink under a point load. What an element misses of it is added to the
  compliance of the contact; without it the force carries a ripple of the element's period.

- Newmark's acceleration of the node that a wheel crosses rings, so that accelerations are better
  taken from the displacements.

Newmark's error is even in the step, so that two runs extrapolate to fourth order (Richardson).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg
from numpy.typing import NDArray

from .errors import InputError
from .scenario import GRAVITY, Car, Channel, Scenario, Track, Train, WheelElement

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

DEGREE = 7
RAIL_PER_BAY = 2
OTHERS_PER_BAY = 10


@dataclass(frozen=True, eq=False)
class Histories:
    """What the method computes at its steps.

    Attributes:
        time: (n,) s. force: (n, A) N, both wheels of a wheelset.
        displacement: (n, C) m, of the channels, positive down.
    """

    time: Array
    force: Array
    displacement: Array


class _Matrices:
    """Mass, damping and stiffness, collected entry by entry."""

    def __init__(self) -> None:
        self.rows: list[Indices] = []
        self.columns: list[Indices] = []
        self.values: dict[str, list[Array]] = {"mass": [], "damping": [], "stiffness": []}

    def add(self, dofs: Indices, **parts: Array) -> None:
        n = len(dofs)
        self.rows.append(np.repeat(dofs, n))
        self.columns.append(np.tile(dofs, n))
        for name, values in self.values.items():
            values.append(np.ravel(parts[name]) if name in parts else np.zeros(n * n))

    def matrix(self, name: str, free: Indices, size: int) -> sp.csc_matrix:
        entries = (np.concatenate(self.rows), np.concatenate(self.columns))
        full = sp.csc_matrix((np.concatenate(self.values[name]), entries), shape=(size, size))
        return sp.csc_matrix(full[free][:, free])


def _hermite(s: float, h: float, derivative: int = 0) -> Array:
    """Cubic Hermite functions at s = x/h, or their second derivatives."""
    if derivative == 2:
        return np.array([12 * s - 6, h * (6 * s - 4), 6 - 12 * s, h * (6 * s - 2)]) / h**2
    return np.array(
        [1 - 3 * s**2 + 2 * s**3, h * s * (1 - s) ** 2, s**2 * (3 - 2 * s), h * s**2 * (s - 1)]
    )


_POINTS = 0.5 - 0.5 * np.cos(np.pi * np.arange(DEGREE + 1) / DEGREE)
_POWERS = np.linalg.inv(np.vander(_POINTS, increasing=True))
"""Column i: coefficients of the polynomial that is 1 at point i of [0, 1] and 0 at the others."""


def _nodal(s: float, derivative: bool = False) -> Array:
    """Lagrange polynomials on the points of an element at s = x/h, or their slopes."""
    order = np.arange(DEGREE + 1)
    if derivative:
        return np.asarray((order[1:] * s ** order[:-1]) @ _POWERS[1:])
    return np.asarray((s**order) @ _POWERS)


class _Grid:
    """Nodes of one layer: coordinate ``base + 2 i`` deflects, the next one rotates."""

    def __init__(self, nodes: Array, base: int, ends: tuple[float, float]) -> None:
        self.nodes, self.base, self.ends = nodes, base, ends

    @property
    def size(self) -> int:
        return 2 * len(self.nodes)

    def element(self, x: float) -> int:
        last = len(self.nodes) - 2
        return int(np.clip(np.searchsorted(self.nodes, x, side="right") - 1, 0, last))

    def row(self, x: float) -> tuple[Indices, Array]:
        """Coordinates and values of the deflection at x."""
        e = self.element(x)
        h = float(self.nodes[e + 1] - self.nodes[e])
        return self.base + 2 * e + np.arange(4), _hermite((x - self.nodes[e]) / h, h)


class _TimoshenkoGrid(_Grid):
    """Elements of degree DEGREE; their inner nodes are nodes like all others."""

    def __init__(self, corners: Array, base: int, track: Track) -> None:
        self.corners = corners
        inner = corners[:-1, None] + np.diff(corners)[:, None] * _POINTS[:-1]
        nodes = np.append(inner.ravel(), corners[-1])
        super().__init__(nodes, base, (float(corners[0]), float(corners[-1])))
        rail = track.rail
        shear_modulus = rail.young_modulus / (2 * (1 + rail.poisson_ratio))
        self.bending = 2 * rail.young_modulus * rail.second_moment
        self.shear = 2 * rail.shear_coefficient * shear_modulus * rail.area
        self.mass = 2 * rail.mass_per_length
        self.rotary = self.mass * rail.second_moment / rail.area
        self._bubbles: dict[float, Array] = {}

    def _locate(self, x: float) -> tuple[int, float, float]:
        last = len(self.corners) - 2
        e = int(np.clip(np.searchsorted(self.corners, x, side="right") - 1, 0, last))
        h = float(self.corners[e + 1] - self.corners[e])
        return e, h, float(x - self.corners[e]) / h

    def row(self, x: float) -> tuple[Indices, Array]:
        e, _, s = self._locate(x)
        return self.base + 2 * (e * DEGREE + np.arange(DEGREE + 1)), _nodal(s)

    def element_matrices(self, h: float) -> tuple[Array, Array]:
        """Mass and stiffness of one element, deflections and rotations alternating."""
        count = 2 * (DEGREE + 1)
        mass, stiffness = np.zeros((count, count)), np.zeros((count, count))
        points, weights = np.polynomial.legendre.leggauss(DEGREE + 1)
        for s, w in zip((points + 1) / 2, weights / 2 * h, strict=True):
            value, slope = _nodal(float(s)), _nodal(float(s), True) / h
            deflection, rotation, twist, curve = np.zeros((4, count))
            deflection[0::2], rotation[1::2] = value, value
            twist[0::2], twist[1::2], curve[1::2] = slope, -value, slope
            mass += w * self.mass * np.outer(deflection, deflection)
            mass += w * self.rotary * np.outer(rotation, rotation)
            stiffness += w * self.shear * np.outer(twist, twist)
            stiffness += w * self.bending * np.outer(curve, curve)
        return mass, stiffness

    def missing(self, x: float) -> float:
        """Compliance (m/N) at x of the clamped element that its polynomials miss."""
        _, h, s = self._locate(x)
        if not 1e-9 < s < 1 - 1e-9:
            return 0.0
        a, b, bend, shear = s * h, (1 - s) * h, self.bending, self.shear
        # a clamped beam under a point load by Castigliano: reactions R, M0 at the left end
        system = np.array(
            [
                [h**3 / (3 * bend) + h / shear, h**2 / (2 * bend)],
                [h**2 / (2 * bend), h / bend],
            ]
        )
        load = np.array([b**3 / (3 * bend) + a * b**2 / (2 * bend) + b / shear, b**2 / (2 * bend)])
        exact = b**3 / (3 * bend) + b / shear - load @ np.linalg.solve(system, load)
        if h not in self._bubbles:
            _, stiffness = self.element_matrices(h)
            inverse = np.linalg.inv(stiffness[2:-2, 2:-2])
            self._bubbles[h] = np.asarray(inverse[0::2, 0::2], np.float64)
        inner = _nodal(s)[1:-1]
        return float(exact - inner @ self._bubbles[h] @ inner)


class ReferenceLine:
    """The line of a scenario by nodal finite elements; M, C, K sparse, supports eliminated."""

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        track, line = scenario.track, scenario.line
        if track.variation or track.fastening.pad_length > 0:
            raise InputError(
                "track.variation or track.fastening.pad_length: the reference method takes uniform "
                "track on point fastenings only"
            )
        spacing = track.fastening.spacing
        first = track.fastening.first_offset
        rows = np.arange(spacing / 2 if first is None else first, line.length - 1e-6, spacing)
        bounds = [x for pair in line.span_bounds for x in pair]
        channels = {
            layer: [scenario.channel_x(c) for c in scenario.channel if c.layer == layer]
            for layer in ("rail", "slab", "support_layer", "bridge")
        }
        size = 0
        self.grids: list[tuple[str, _Grid]] = []
        fine = spacing / OTHERS_PER_BAY
        common = _nodes(np.concatenate([[0, line.length], bounds, rows]), fine)
        timoshenko = track.rail.theory == "timoshenko"
        for layer in ("rail", "slab", "support_layer"):
            if layer == "rail" and timoshenko:
                corners = _nodes(
                    np.concatenate([[0, line.length], rows, channels["rail"]]),
                    spacing / RAIL_PER_BAY,
                )
                grid: _Grid = _TimoshenkoGrid(corners, size, track)
            else:
                grid = _Grid(common, size, (0.0, line.length))
            self.grids.append((layer, grid))
            size += grid.size
        for left, right in line.span_bounds:
            part = common[(common > left - 1e-9) & (common < right + 1e-9)]
            self.grids.append(("bridge", _Grid(part, size, (left, right))))
            size += self.grids[-1][1].size
        self._entries = _Matrices()
        self._beams(track)
        self._beds(track)
        rail, slab = self.grids[0][1], self.grids[1][1]
        pad = 2 * np.array([[1.0, -1.0], [-1.0, 1.0]])
        for x in rows:
            pair = np.array([_node(rail, x), _node(slab, x)])
            self._entries.add(
                pair,
                stiffness=track.fastening.stiffness * pad,
                damping=track.fastening.damping * pad,
            )
        held: list[int] = []
        for layer, grid in self.grids:
            ends = [grid.base, grid.base + grid.size - 2]
            if layer == "bridge" and track.bridge.bearing_stiffness is not None:
                for end in ends:
                    self._entries.add(
                        np.array([end]), stiffness=np.array([track.bridge.bearing_stiffness])
                    )
            elif layer == "bridge" or line.ends == "pinned":
                held += ends
        free = np.setdiff1d(np.arange(size), held)
        self._place = np.full(size, -1)
        self._place[free] = np.arange(len(free))
        self.size = len(free)
        self.mass, self.damping, self.stiffness = (
            self._entries.matrix(name, free, size) for name in ("mass", "damping", "stiffness")
        )

    def _beams(self, track: Track) -> None:
        rail = track.rail
        sections = {
            "rail": (2 * rail.young_modulus * rail.second_moment, 2 * rail.mass_per_length),
            "slab": (track.slab.bending_stiffness, track.slab.mass_per_length),
            "support_layer": (
                track.support_layer.bending_stiffness,
                track.support_layer.mass_per_length,
            ),
            "bridge": (track.bridge.bending_stiffness, track.bridge.mass_per_length),
        }
        for layer, grid in self.grids:
            if isinstance(grid, _TimoshenkoGrid):
                for e, h in enumerate(np.diff(grid.corners)):
                    m, k = grid.element_matrices(float(h))
                    dofs = grid.base + 2 * e * DEGREE + np.arange(2 * (DEGREE + 1))
                    self._entries.add(dofs, mass=m, stiffness=k)
                continue
            bending, mass = sections[layer]
            alpha = beta = 0.0
            if layer == "bridge":
                length = grid.ends[1] - grid.ends[0]
                omega = (np.pi / length) ** 2 * np.sqrt(bending / mass)
                ratio = track.bridge.damping_ratio
                alpha, beta = 2 * ratio * 4 * omega / 5, 2 * ratio / (5 * omega)
            for e, h in enumerate(np.diff(grid.nodes)):
                k, m = (
                    _integral(round(float(h), 9), 2) * bending,
                    _integral(round(float(h), 9), 0) * mass,
                )
                dofs = grid.base + 2 * e + np.arange(4)
                self._entries.add(dofs, mass=m, stiffness=k, damping=alpha * m + beta * k)

    def _beds(self, track: Track) -> None:
        slab, layer = self.grids[1][1], self.grids[2][1]
        bridges = [grid for name, grid in self.grids if name == "bridge"]
        for e, h in enumerate(np.diff(slab.nodes)):
            own = _integral(round(float(h), 9), 0)
            middle = float(slab.nodes[e]) + h / 2
            coupled = np.block([[own, -own], [-own, own]])
            upper, lower = (grid.base + 2 * e + np.arange(4) for grid in (slab, layer))
            mortar = track.mortar
            self._entries.add(
                np.concatenate([upper, lower]),
                stiffness=mortar.stiffness * mortar.width * coupled,
                damping=mortar.damping * mortar.width * coupled,
            )
            under = [grid for grid in bridges if grid.ends[0] < middle < grid.ends[1]]
            if under:
                bed = track.bed_on_bridge
                dofs = np.concatenate(
                    [lower, under[0].base + 2 * under[0].element(middle) + np.arange(4)]
                )
            else:
                bed, dofs, coupled = track.bed_on_subgrade, lower, own
            self._entries.add(
                dofs,
                stiffness=bed.stiffness * bed.width * coupled,
                damping=bed.damping * bed.width * coupled,
            )

    def _vector(self, dofs: Indices, values: Array) -> Array:
        vector = np.zeros(self.size)
        at = self._place[dofs]
        vector[at[at >= 0]] = values[at >= 0]
        return vector

    def rail(self, x: float) -> Array:
        """(N,) deflection of the rail at x (m) per coordinate."""
        return self._vector(*self.grids[0][1].row(x))

    def missing(self, x: float) -> float:
        """Compliance (m/N) of the rail at x (m) that no coordinate carries."""
        grid = self.grids[0][1]
        return grid.missing(x) if isinstance(grid, _TimoshenkoGrid) else 0.0

    def channel(self, channel: Channel) -> Array:
        """(N,) motion of a channel per coordinate."""
        x = self.scenario.channel_x(channel)
        grid = next(
            grid
            for layer, grid in self.grids
            if layer == channel.layer and grid.ends[0] <= x <= grid.ends[1]
        )
        return self._vector(*grid.row(x))


def _nodes(fixed: Array, longest: float) -> Array:
    """The fixed places and between them equal parts, none longer than ``longest`` (m)."""
    fixed = np.unique(np.round(fixed, 9))
    parts = [
        np.linspace(a, b, int(np.ceil((b - a) / longest - 1e-6)) + 1)[:-1]
        for a, b in pairwise(fixed)
    ]
    return np.asarray(np.append(np.concatenate(parts), fixed[-1]), np.float64)


def _node(grid: _Grid, x: float) -> int:
    return grid.base + 2 * int(np.argmin(np.abs(grid.nodes - x)))


@lru_cache(maxsize=1024)
def _integral(h: float, derivative: int) -> Array:
    points, weights = np.polynomial.legendre.leggauss(4)
    total = np.zeros((4, 4))
    for s, w in zip((points + 1) / 2, weights / 2 * h, strict=True):
        shape = _hermite(float(s), h, derivative)
        total += w * np.outer(shape, shape)
    return total


def vehicle_matrices(train: Train) -> tuple[Array, Array, Array, Array, Indices]:
    """Mass, damping, stiffness, weight and wheelset coordinates of a train, front first."""
    masses: list[float] = []
    weight: list[float] = []
    springs: list[tuple[dict[int, float], float, float]] = []
    wheels: list[int] = []

    def body(mass: float, heavy: bool = True) -> int:
        masses.append(mass)
        weight.append(GRAVITY * mass if heavy else 0.0)
        return len(masses) - 1

    def wheelset(vehicle: Car | WheelElement, stretch: dict[int, float]) -> None:
        wheels.append(body(vehicle.wheelset_mass))
        springs.append(
            ({**stretch, wheels[-1]: -1.0}, vehicle.primary_stiffness, vehicle.primary_damping)
        )

    for vehicle in train.vehicles:
        if isinstance(vehicle, WheelElement):
            car, bogie = body(vehicle.body_mass / 4), body(vehicle.bogie_mass / 2)
            half = vehicle.secondary_stiffness / 2, vehicle.secondary_damping / 2
            springs.append(({car: 1.0, bogie: -1.0}, *half))
            wheelset(vehicle, {bogie: 1.0})
            continue
        if vehicle.shared_rear_bogie:
            raise InputError("train.vehicles: the reference method takes no shared bogies")
        car, pitch = body(vehicle.body_mass), body(vehicle.body_inertia, False)
        for side in (1.0, -1.0):
            bogie, turn = body(vehicle.bogie_mass), body(vehicle.bogie_inertia, False)
            stretch = {car: 1.0, pitch: side * vehicle.bogie_centres / 2, bogie: -1.0}
            springs.append((stretch, vehicle.secondary_stiffness, vehicle.secondary_damping))
            for end in (1.0, -1.0):
                wheelset(vehicle, {bogie: 1.0, turn: end * vehicle.wheelbase / 2})
    stiffness, damping = np.zeros((2, len(masses), len(masses)))
    for stretch, k, c in springs:
        row = np.zeros(len(masses))
        row[list(stretch)] = list(stretch.values())
        stiffness += k * np.outer(row, row)
        damping += c * np.outer(row, row)
    return np.diag(masses), damping, stiffness, np.array(weight), np.array(wheels)


def reference_run(scenario: Scenario, step: float) -> Histories:
    """Static start, then Newmark's average acceleration to the scenario's end.

    All wheelsets must be on the line throughout.

    Args:
        scenario: one train at constant speed, linear contact, irregularity as components.
        step: time step (s).

    Raises:
        InputError: the scenario asks for what this method does not do.
    """
    solution, contact = scenario.solution, scenario.contact
    if len(scenario.train) != 1 or scenario.train[0].speed_profile:
        raise InputError("train: the reference method takes one train at constant speed")
    if contact.law != "linear" or solution.end_time is None:
        raise InputError(
            'contact.law, solution.end_time: the reference method takes "linear" and a stated end'
        )
    parts = scenario.irregularity.components
    waves = np.zeros((3, 0))
    if parts is not None:
        waves = np.array([parts.wavenumber, parts.amplitude, parts.phase])
    line, train = ReferenceLine(scenario), scenario.train[0]
    mass, damping, stiffness, weight, wheels = vehicle_matrices(train)
    sign = 1.0 if train.direction == "forward" else -1.0
    samples = round(solution.end_time / step) + 1
    time: Array = np.arange(samples, dtype=np.float64) * step
    place = train.start + sign * (train.speed * time[:, None] - np.array(train.axle_positions))
    if place.min() < 0 or place.max() > scenario.line.length:
        raise InputError("train: a wheelset leaves the line, which the reference method lacks")
    rough = np.zeros_like(place)
    for k, amplitude, phase in waves.T:
        rough += amplitude * np.cos(k * place + phase)

    axles, h = len(wheels), step
    # symmetric and definite: half the fill of the default ordering
    solve = scipy.sparse.linalg.splu(
        sp.csc_matrix(line.stiffness + 2 / h * line.damping + 4 / h**2 * line.mass),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    ).solve
    car = np.linalg.inv(stiffness + 2 / h * damping + 4 / h**2 * mass)
    pick = np.zeros((axles, len(weight)))
    pick[np.arange(axles), wheels] = 1.0
    spring = np.eye(axles) / (2 * contact.stiffness)
    channels = np.array([line.channel(c) for c in scenario.channel]).reshape(-1, line.size)

    def under(n: int) -> tuple[Array, Array]:
        rail = np.array([line.rail(float(x)) for x in place[n]])
        return rail, spring + np.diag([line.missing(float(x)) for x in place[n]])

    rail, contacts = under(0)
    static = scipy.sparse.linalg.splu(line.stiffness).solve(rail.T)
    system = np.block([[stiffness, pick.T], [pick, -(rail @ static + contacts)]])
    rest = np.linalg.solve(system, np.concatenate([weight, rough[0]]))
    z, force = rest[: len(weight)], rest[len(weight) :]
    u = static @ force
    v, a, w, b = np.zeros_like(u), np.zeros_like(u), np.zeros_like(z), np.zeros_like(z)
    forces, displacement = np.empty((samples, axles)), np.empty((samples, len(channels)))
    forces[0], displacement[0] = force, channels @ u
    for n in range(1, samples):
        rail, contacts = under(n)
        push = line.mass @ (4 / h**2 * u + 4 / h * v + a) + line.damping @ (2 / h * u + v)
        solved = solve(np.column_stack([push, rail.T]))
        alone = car @ (weight + mass @ (4 / h**2 * z + 4 / h * w + b) + damping @ (2 / h * z + w))
        flexible = rail @ solved[:, 1:] + pick @ car @ pick.T + contacts
        force = np.linalg.solve(flexible, pick @ alone - rail @ solved[:, 0] - rough[n])
        moved, ridden = solved[:, 0] + solved[:, 1:] @ force, alone - car @ pick.T @ force
        a, b = (
            4 / h**2 * (moved - u) - 4 / h * v - a,
            4 / h**2 * (ridden - z) - 4 / h * w - b,
        )
        v, w = 2 / h * (moved - u) - v, 2 / h * (ridden - z) - w
        u, z = moved, ridden
        forces[n], displacement[n] = force, channels @ u
    return Histories(time, forces, displacement)


def extrapolated_run(scenario: Scenario, step: float) -> Histories:
    """Two runs with ``step`` (s) and half of it, extrapolated to fourth order at ``step``."""
    coarse, fine = reference_run(scenario, step), reference_run(scenario, step / 2)
    return Histories(
        coarse.time,
        (4 * fine.force[::2] - coarse.force) / 3,
        (4 * fine.displacement[::2] - coarse.displacement) / 3,
    )
