"""A plain fine finite-element model of the same line, sharing no code with the solver.

Euler-Bernoulli elements with nodes at every fastening and a few between, consistent matrices by
Gauss quadrature, Newmark with a small step, linear contact, irregularity given as components.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla

POINTS, WEIGHTS = np.polynomial.legendre.leggauss(4)
POINTS, WEIGHTS = (POINTS + 1) / 2, WEIGHTS / 2


def hermite(s, h):
    return np.array(
        [
            1 - 3 * s**2 + 2 * s**3,
            h * (s - 2 * s**2 + s**3),
            3 * s**2 - 2 * s**3,
            h * (s**3 - s**2),
        ]
    )


def curvature(s, h):
    return np.array([12 * s - 6, h * (6 * s - 4), 6 - 12 * s, h * (6 * s - 2)]) / h**2


class FineLine:
    """Four layers of beams on a common grid of nodes."""

    def __init__(self, scenario, per_bay):
        track, line = scenario.track, scenario.line
        assert track.rail.theory == "euler_bernoulli"
        bay = track.fastening.spacing
        half = bay / 2
        count = round(line.length / bay) * per_bay
        self.h = line.length / count
        self.nodes = count + 1
        layers = ["rail", "slab", "support"]
        self.base = {name: 2 * self.nodes * i for i, name in enumerate(layers)}
        size = 6 * self.nodes
        self.bridge = []
        for left, right in line.span_bounds:
            first, last = round(left / self.h), round(right / self.h)
            self.bridge.append((first, last, size))
            size += 2 * (last - first + 1)
        self.rows, self.cols, self.values = [], [], {"m": [], "c": [], "k": []}
        rail = track.rail
        beams = {
            "rail": (2 * rail.young_modulus * rail.second_moment, 2 * rail.mass_per_length),
            "slab": (track.slab.bending_stiffness, track.slab.mass_per_length),
            "support": (track.support_layer.bending_stiffness, track.support_layer.mass_per_length),
        }
        for name, (stiffness, mass) in beams.items():
            for element in range(count):
                self._beam(self.base[name] + 2 * element, stiffness, mass)
        for element in range(count):
            slab, support = (self.base[n] + 2 * element for n in ("slab", "support"))
            self._bed(track.mortar, slab, support)
            under, bed = None, track.bed_on_subgrade
            for first, last, base in self.bridge:
                if first <= element < last:
                    under, bed = base + 2 * (element - first), track.bed_on_bridge
            self._bed(bed, support, under)
        for first, last, base in self.bridge:
            length = (last - first) * self.h
            girder = track.bridge
            omega = (np.pi / length) ** 2 * np.sqrt(
                girder.bending_stiffness / girder.mass_per_length
            )
            alpha, beta = 2 * girder.damping_ratio * np.array([4 * omega / 5, 1 / (5 * omega)])
            for element in range(last - first):
                self._beam(
                    base + 2 * element,
                    girder.bending_stiffness,
                    girder.mass_per_length,
                    alpha,
                    beta,
                )
        for x in np.arange(half, line.length, bay):
            node = round(x / self.h)
            assert abs(node * self.h - x) < 1e-9
            pair = np.array([self.base["rail"] + 2 * node, self.base["slab"] + 2 * node])
            spring = 2 * np.array([[1.0, -1.0], [-1.0, 1.0]])
            self._add(
                pair, k=track.fastening.stiffness * spring, c=track.fastening.damping * spring
            )
        rows, cols = np.concatenate(self.rows), np.concatenate(self.cols)
        full = [
            sp.csc_matrix((np.concatenate(self.values[name]), (rows, cols)), shape=(size, size))
            for name in "mck"
        ]
        held = [self.base[n] + 2 * end for n in layers for end in (0, count)]
        held += [base + 2 * e for first, last, base in self.bridge for e in (0, last - first)]
        self.free = np.setdiff1d(np.arange(size), held)
        self.size = size
        self.mass, self.damping, self.stiffness = (a[self.free][:, self.free].tocsc() for a in full)

    def _add(self, dofs, **parts):
        n = len(dofs)
        self.rows.append(np.repeat(dofs, n))
        self.cols.append(np.tile(dofs, n))
        for name in "mck":
            part = parts.get(name)
            self.values[name].append(np.zeros(n * n) if part is None else part.ravel())

    def _beam(self, first, stiffness, mass, alpha=0.0, beta=0.0):
        k, m = np.zeros((4, 4)), np.zeros((4, 4))
        for s, w in zip(POINTS, WEIGHTS, strict=True):
            k += w * self.h * stiffness * np.outer(curvature(s, self.h), curvature(s, self.h))
            m += w * self.h * mass * np.outer(hermite(s, self.h), hermite(s, self.h))
        self._add(first + np.arange(4), m=m, k=k, c=alpha * m + beta * k)

    def _bed(self, bed, upper, lower):
        product = sum(
            w * self.h * np.outer(hermite(s, self.h), hermite(s, self.h))
            for s, w in zip(POINTS, WEIGHTS, strict=True)
        )
        dofs = upper + np.arange(4)
        if lower is not None:
            product = np.block([[product, -product], [-product, product]])
            dofs = np.concatenate([dofs, lower + np.arange(4)])
        self._add(dofs, k=bed.stiffness * bed.width * product, c=bed.damping * bed.width * product)

    def row(self, layer, x):
        """Row that reads the displacement of a layer at x."""
        first = 0
        base = self.base.get({"support_layer": "support"}.get(layer, layer))
        if base is None:
            first, _, base = next(b for b in self.bridge if b[0] * self.h <= x <= b[1] * self.h)
        element = min(int(x / self.h), self.nodes - 2)
        full = np.zeros(self.size)
        start = base + 2 * (element - first)
        full[start : start + 4] = hermite(x / self.h - element, self.h)
        return full[self.free]


def vehicle_matrices(vehicle):
    """Mass, damping, stiffness, weight and wheelset indices of one vehicle, front first."""
    v = vehicle
    springs = []
    if v.kind == "wheel_element":
        masses = [v.body_mass / 4, v.bogie_mass / 2, v.wheelset_mass]
        springs = [
            ({0: 1, 1: -1}, v.secondary_stiffness / 2, v.secondary_damping / 2),
            ({1: 1, 2: -1}, v.primary_stiffness, v.primary_damping),
        ]
        heavy, wheels = [1, 1, 1], [2]
    else:
        masses = [v.body_mass, v.body_inertia]
        masses += [v.bogie_mass, v.bogie_inertia] * 2 + [v.wheelset_mass] * 4
        heavy, wheels = [1, 0, 1, 0, 1, 0, 1, 1, 1, 1], [6, 7, 8, 9]
        for bogie, side in ((2, 1), (4, -1)):
            springs.append(
                (
                    {0: 1, 1: side * v.bogie_centres / 2, bogie: -1},
                    v.secondary_stiffness,
                    v.secondary_damping,
                )
            )
            for number, end in ((0, 1), (1, -1)):
                wheel = 6 + (bogie - 2) + number
                springs.append(
                    (
                        {bogie: 1, bogie + 1: end * v.wheelbase / 2, wheel: -1},
                        v.primary_stiffness,
                        v.primary_damping,
                    )
                )
    k, c = np.zeros((2, len(masses), len(masses)))
    for stretch, stiff, damp in springs:
        row = np.zeros(len(masses))
        row[list(stretch)] = list(stretch.values())
        k += stiff * np.outer(row, row)
        c += damp * np.outer(row, row)
    return np.diag(masses), c, k, 9.81 * np.array(masses) * heavy, np.array(wheels)


def simulate(scenario, step, samples, per_bay=8):
    """Wheelset forces (samples, A) and displacement, velocity, acceleration of the channels."""
    line = FineLine(scenario, per_bay)
    train = scenario.train[0]
    mv, cv, kv, weight, wheels = vehicle_matrices(train.vehicles[0])
    parts = scenario.irregularity.components
    waves = np.array([parts.wavenumber, parts.amplitude, parts.phase])
    contact = 2 * scenario.contact.stiffness
    offsets = np.array(train.axle_positions)
    axles = len(wheels)

    def roughness(x):
        return (waves[1] * np.cos(np.outer(x, waves[0]) + waves[2])).sum(axis=1)

    channels = np.array([line.row(c.layer, c.x) for c in scenario.channel])
    h = step
    line_step = spla.splu((line.stiffness + 2 / h * line.damping + 4 / h**2 * line.mass).tocsc())
    car_step = np.linalg.inv(kv + 2 / h * cv + 4 / h**2 * mv)
    select = np.zeros((axles, len(weight)))
    select[np.arange(axles), wheels] = 1
    x = train.start - offsets
    rail = np.array([line.row("rail", place) for place in x])
    static = spla.splu(line.stiffness.tocsc()).solve(rail.T)
    system = np.block([[kv, select.T], [select, -(rail @ static + np.eye(axles) / contact)]])
    solution = np.linalg.solve(system, np.concatenate([weight, roughness(x)]))
    z, force = solution[: len(weight)], solution[len(weight) :]
    states = [[static @ force, 0.0, 0.0], [z, 0.0, 0.0]]
    states = [[np.zeros_like(s[0]) + part for part in s] for s in states]
    forces, signals = np.empty((samples, axles)), np.empty((3, samples, len(channels)))
    for n in range(samples):
        if n > 0:
            x = train.start + train.speed * n * h - offsets
            rail = np.array([line.row("rail", place) for place in x])
            (u, v, a), (z, w, b) = states
            push = line.mass @ (4 / h**2 * u + 4 / h * v + a) + line.damping @ (2 / h * u + v)
            solved = line_step.solve(np.column_stack([push, rail.T]))
            alone = car_step @ (weight + mv @ (4 / h**2 * z + 4 / h * w + b) + cv @ (2 / h * z + w))
            flexible = rail @ solved[:, 1:] + select @ car_step @ select.T + np.eye(axles) / contact
            force = np.linalg.solve(flexible, select @ alone - rail @ solved[:, 0] - roughness(x))
            new = [solved[:, 0] + solved[:, 1:] @ force, alone - car_step @ select.T @ force]
            for state, moved in zip(states, new, strict=True):
                old, speed, rate = state
                state[2] = 4 / h**2 * (moved - old) - 4 / h * speed - rate
                state[1] = 2 / h * (moved - old) - speed
                state[0] = moved
        forces[n] = force
        for order in range(3):
            signals[order, n] = channels @ states[0][order]
    return forces, signals
