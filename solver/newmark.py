"""The paper's integrator: Newmark's average acceleration on the full matrices.

With beta = 1/4 and gamma = 1/2 every step solves

    (K + 2/h C + 4/h^2 M) u = f + M (4/h^2 u' + 4/h v' + a') + C (2/h u' + v')

for the line (sparse, factored once) and for every unit, joined by the contact forces of the step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg
from numpy.typing import NDArray

from .contact import force_of, solve_contact
from .errors import SolverError
from .line import Structure
from .traffic import Running, Traffic
from .vehicle import Unit, static_start

Array = NDArray[np.float64]

SWEEPS = 100
CONTACT_TOLERANCE = 1e-11
"""Largest change of a contact force, per static load, at which a step is accepted."""


@dataclass(eq=False)
class _State:
    """Displacement, velocity and acceleration at the last sample."""

    u: Array
    v: Array
    a: Array

    def pushed(self, h: float, mass: object, damping: object) -> Array:
        """What the last state adds to the load of a step."""
        inertia = mass @ (4 / h**2 * self.u + 4 / h * self.v + self.a)  # type: ignore[operator]
        return np.asarray(inertia + damping @ (2 / h * self.u + self.v))  # type: ignore[operator]

    def move(self, u: Array, h: float) -> None:
        v = 2 / h * (u - self.u) - self.v
        self.a = 4 / h**2 * (u - self.u) - 4 / h * self.v - self.a
        self.u, self.v = u, v


class NewmarkRun:
    """A run on the full matrices of line and vehicles.

    Args:
        structure: the assembled line.
        traffic: the trains.
        derivatives: 0, 1, 2 for displacement, velocity, acceleration of the channels. Strain and
            force channels are differentiated backwards in time.
    """

    ratio = 1

    def __init__(
        self, structure: Structure, traffic: Traffic, derivatives: tuple[int, ...]
    ) -> None:
        self.structure = structure
        self.traffic = traffic
        self.lost_contacts = 0
        self.equilibrium_residual = 0.0
        self._start_energy = 0.0
        self.work = 0.0
        self.dissipated = 0.0
        self._derivatives = derivatives
        h = traffic.step
        self._mass, self._damping, stiffness = (
            sp.csc_matrix(matrix)
            for matrix in (structure.mass, structure.damping, structure.stiffness)
        )
        self._static = scipy.sparse.linalg.splu(stiffness)
        self._factor = scipy.sparse.linalg.splu(
            sp.csc_matrix(stiffness + 2 / h * self._damping + 4 / h**2 * self._mass)
        )
        probes = [structure.probe(channel) for channel in structure.scenario.channel]
        self._rows = [
            sp.csr_matrix(sp.vstack([getattr(probe, name) for probe in probes]))
            if probes
            else sp.csr_matrix((0, structure.size))
            for name in ("displacement_rows", "velocity_rows", "acceleration_rows")
        ]
        self._motion = np.array(
            [channel.quantity == "motion" for channel in structure.scenario.channel], dtype=bool
        )
        self._line = _State(*np.zeros((3, structure.size)))
        self._cars: dict[int, _State] = {}
        self._inverses: list[Array] = []
        self._signals = np.zeros((3, len(probes)))
        self._units: list[Running] = []
        self._force: Array = np.zeros(0)
        self._load: Array = np.zeros(structure.size)
        self._touching: dict[int, NDArray[np.bool_]] = {}
        self._next = 0
        self._until = 0
        traffic.lay_ends(self._point_compliance)

    @property
    def states(self) -> int:
        """Number of coordinates of the line that are stepped."""
        return self.structure.size

    @property
    def channel_band(self) -> Array:
        """(C,) valid band of every channel (Hz)."""
        channels = self.structure.scenario.channel
        return np.array([self.structure.channel_band(channel) for channel in channels])

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on what limits the result."""
        return (
            "Newmark's average acceleration lengthens periods by (omega h)^2/12: "
            f"1 % at {0.346 / (2 * np.pi * self.traffic.step):.0f} Hz",
        )

    @property
    def next_sample(self) -> int:
        """First sample that is not computed yet."""
        return self._next

    def arrange(self, trains: Sequence[int], departed: Sequence[int] = ()) -> None:
        """Give columns to these trains, some of which may be new, and forget the departed."""
        self.traffic.arrange(trains)
        self.traffic.forget(departed)
        self._until = 0

    @property
    def energy_residual(self) -> float | None:
        """|stored + dissipated - work| of the line per work or energy, whichever is larger."""
        if self._next == 0:
            return None
        balance = self.energy() - self._start_energy + self.dissipated - self.work
        return abs(balance) / max(abs(self.work), self.energy(), 1e-300)

    def energy(self) -> float:
        """Kinetic and potential energy of the line (J)."""
        state = self._line
        return 0.5 * float(
            state.v @ (self._mass @ state.v) + state.u @ (self.structure.stiffness @ state.u)
        )

    def advance(self, samples: int) -> tuple[Array, Array, Array, Array]:
        """The next samples: time (n,), position (n, W), force (n, W), channel outputs (n, O).

        Raises:
            SolverError: the contact forces of a step do not converge, or the run diverged.
        """
        time: Array = (self._next + np.arange(samples, dtype=np.float64)) * self.traffic.step
        position = self.traffic.position(time)
        force = np.full(position.shape, np.nan)
        width = len(self._motion)
        outputs = np.empty((samples, width * len(self._derivatives)))
        done = 0
        while done < samples:
            if self._next >= self._until:
                self._change_units(position[done], time[done])
                self._until = self.traffic.next_change(self._next)
            stop = min(samples, done + self._until - self._next)
            columns = [c for u in self._units for c in range(u.columns.start, u.columns.stop)]
            place = position[done:stop, columns]
            roughness = self.traffic.roughness(self._units, place, time[done:stop])
            for n in range(stop - done):
                on = (place[n] >= 0) & (place[n] <= self.traffic.length)
                new = self._step(place[n], on, roughness[n], still=self._next == 0)
                force[done + n, columns] = np.where(on, new, np.nan)
                self._observe()
                for number, derivative in enumerate(self._derivatives):
                    part = slice(number * width, (number + 1) * width)
                    outputs[done + n, part] = self._signals[derivative]
                self._next += 1
            done = stop
        if not np.isfinite(outputs).all() or not np.isfinite(self._line.u).all():
            raise SolverError(
                f"a displacement is not finite before t = {time[-1]:.6g} s; limit 1e308 m: the "
                "run diverged, shorten solution.step"
            )
        return time, position, force, outputs

    def _rail(self, place: Array, on: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Rows (A, N) of the rail under the wheelsets, zero off the line; missing compliance."""
        rows = np.zeros((len(place), self.structure.size))
        missing = np.zeros(len(place))
        if on.any():
            rows[on] = self.structure.rail_rows(place[on]).toarray()
            missing[on] = self.structure.missing_rail_compliance(place[on])
        return rows, missing

    def _step(self, place: Array, on: NDArray[np.bool_], roughness: Array, still: bool) -> Array:
        h = self.traffic.step
        if still:
            self._start_energy = self.energy()
            return self._force
        rows, missing = self._rail(place, on)
        pushed = self._line.pushed(h, self._mass, self._damping)
        solved = self._factor.solve(np.column_stack([pushed, rows.T]))
        free, response = solved[:, 0], solved[:, 1:]
        compliance = rows @ response + np.diag(missing)
        gap = -roughness - rows @ free
        axle, frees = 0, []
        for running in self._units:
            unit, inverse = running.unit, self._inverses[running.kind]
            state = self._cars[id(running)]
            alone = inverse @ (unit.weight + state.pushed(h, unit.mass, unit.damping))
            frees.append(alone)
            own = slice(axle, axle + len(unit.wheelsets))
            gap[own] += alone[unit.wheelsets]
            compliance[own, own] += inverse[np.ix_(unit.wheelsets, unit.wheelsets)]
            axle = own.stop
        force = self._contact(gap, compliance)
        before, speed = self._line.u, self._line.v
        self._line.move(free + response @ force, h)
        mean = (self._line.v + speed) / 2
        load = rows.T @ force
        self.work += float((self._load + load) / 2 @ (self._line.u - before))
        self.dissipated += h * float(mean @ (self._damping @ mean))
        self._load = load
        axle = 0
        for running, alone in zip(self._units, frees, strict=True):
            unit, inverse = running.unit, self._inverses[running.kind]
            own = slice(axle, axle + len(unit.wheelsets))
            push = inverse[:, unit.wheelsets] @ force[own]
            self._cars[id(running)].move(alone - push, h)
            touching = self._touching[id(running)]
            self.lost_contacts += int((on[own] & touching & (force[own] <= 0)).sum())
            self._touching[id(running)] = force[own] > 0
            axle = own.stop
        self._force = force
        return force

    def _contact(self, gap: Array, compliance: Array) -> Array:
        """Contact forces by Gauss-Seidel; wheelsets hardly feel each other within a step."""
        if not len(gap):
            return np.zeros(0)
        law = np.concatenate([unit.law for unit in self._units], axis=1)
        scale = max(float(unit.unit.static_loads.max()) for unit in self._units)
        force: Array = self._force.copy()
        own = np.diag(compliance).copy()
        coupling = compliance - np.diag(own)
        for _ in range(SWEEPS):
            last = force.copy()
            for i in range(len(gap)):
                reach = float(gap[i] - coupling[i] @ force)
                force[i] = solve_contact(reach, own[i], law[0, i], law[1, i])
            if np.abs(force - last).max() <= CONTACT_TOLERANCE * scale:
                break
        else:
            raise SolverError(
                f"contact forces still change by {np.abs(force - last).max():.3g} N after "
                f"{SWEEPS} sweeps; limit {CONTACT_TOLERANCE * scale:.3g} N: shorten solution.step"
            )
        closed = gap - compliance @ force
        miss = [abs(f - force_of(d, *k)) for f, d, k in zip(force, closed, law.T, strict=True)]
        self.equilibrium_residual = max(self.equilibrium_residual, max(miss) / scale)
        return force

    def _observe(self) -> None:
        state = self._line
        d, v, a = self._rows
        before = self._signals.copy()
        self._signals[0] = np.asarray(d @ state.u + v @ state.v + a @ state.a)
        self._signals[1], self._signals[2] = np.asarray(d @ state.v), np.asarray(d @ state.a)
        derived = ~self._motion
        if derived.any():
            last = before if self._next > 0 else self._signals.copy()
            for order in (1, 2):
                change = self._signals[order - 1] - last[order - 1]
                self._signals[order, derived] = change[derived] / self.traffic.step
            if self._next == 0:
                self._signals[1:, derived] = 0.0

    def _point_compliance(self, place: Array) -> Array:
        rows = self.structure.rail_rows(place).toarray()
        value = (rows * self._static.solve(rows.T).T).sum(axis=1)
        return np.asarray(value + self.structure.missing_rail_compliance(place))

    def _inverse(self, unit: Unit) -> Array:
        h = self.traffic.step
        matrix = unit.stiffness + 2 / h * unit.damping + 4 / h**2 * unit.mass
        return np.asarray(np.linalg.inv(matrix))

    def _change_units(self, position: Array, time: float) -> None:
        while len(self._inverses) < len(self.traffic.kinds):
            self._inverses.append(self._inverse(self.traffic.kinds[len(self._inverses)]))
        active = self.traffic.active(self._next)
        known = {id(unit) for unit in self._units}
        fresh = [unit for unit in active if id(unit) not in known]
        forces: dict[int, Array] = {}
        axle = 0
        for running in self._units:
            count = len(running.unit.wheelsets)
            forces[id(running)] = self._force[axle : axle + count]
            axle += count
        if fresh:
            self._settle(fresh, position, time, forces)
        self._units = active
        self._force = np.concatenate([np.zeros(0), *(forces[id(unit)] for unit in active)])
        self._cars = {id(unit): self._cars[id(unit)] for unit in active}
        self._touching = {id(unit): self._touching[id(unit)] for unit in active}

    def _settle(
        self, fresh: list[Running], position: Array, time: float, forces: dict[int, Array]
    ) -> None:
        """Static start of new units, and at t = 0 of the line under them."""
        place = np.concatenate([position[unit.columns] for unit in fresh])
        on = (place >= 0) & (place <= self.traffic.length)
        roughness = self.traffic.roughness(fresh, place[np.newaxis], np.array([time]))[0]
        rows, missing = self._rail(place, on)
        response = self._static.solve(rows.T)
        compliance = rows @ response + np.diag(missing)
        loads = np.concatenate([unit.unit.static_loads for unit in fresh])
        if self._next == 0:
            self._line.u = response @ loads
            self._load = rows.T @ loads
        axle = 0
        for running in fresh:
            own = slice(axle, axle + len(running.unit.wheelsets))
            # the level under each wheelset counts all units, so each starts as if on rough ground
            level = roughness[own] + compliance[own] @ loads
            none = np.zeros((own.stop - axle, own.stop - axle))
            rest, force = static_start(running.unit, running.law, none, level)
            self._cars[id(running)] = _State(rest, np.zeros(len(rest)), np.zeros(len(rest)))
            self._touching[id(running)] = force > 0
            forces[id(running)] = force
            axle = own.stop
