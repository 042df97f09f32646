"""The paper's hybrid in time: three classes of local modes, superposed runs with linear contact.

The rail's sines beyond the global ones are the local set, shifted and in their own modes
(:mod:`solver.statistics`). The weight, the irregularity below the crossover and every third octave
of irregularity above it are runs of their own, each with the matrices of its centre omega:

- modes below the band, Eq. (9): the mass loses j^T j, and a wheel presses and feels the rail by
  g - phi j, the blocked force of Eq. (11); they give way to it by -phi^2/omega^2;
- modes in the band, Eq. (10): a dashpot matrix pi omega^2/2 n<j j^T>, and under the wheel, by
  direct forcing, a velocity pi/2 n<phi phi> F;
- modes above it: nothing.

The mean of j phi over the band, the blocked force of resonant modes, is left out: with constant
coefficients it makes energy above omega and the runs of bands with two or three modes grow without
bound; where they do not, it changes the force by less than 0.1 dB.

One wheel element at constant speed; Newmark's average acceleration throughout.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .errors import InputError
from .hybrid import crossover_frequency
from .irregularity import build_profile
from .line import Structure, assemble
from .local import low_pass
from .reference import vehicle_matrices
from .scenario import Scenario
from .statistics import RESONANT_BAND, Partition, partition
from .waves import rail_frequency

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ClassRun:
    """Superposed runs.

    Attributes:
        time: (n,) s.
        force: (n,) N, wheelset force, the sum of all runs.
        bands: (B,) centres of the third octaves above the crossover (Hz).
        parts: (B + 2, n) N: weight, irregularity below the crossover, every third octave.
        local_modes: number of local modes.
    """

    time: Array
    force: Array
    bands: Array
    parts: Array
    local_modes: int


@dataclass(frozen=True, eq=False)
class _Model:
    """A band's matrices of the global set and what a wheel at every sample feels of it.

    Attributes:
        mass, damping, stiffness: (G, G).
        rows: (n, G). compliance: (n,) m/N of the modes below, negative.
        mobility: (n,) m/(N*s), of the modes in the band.
    """

    mass: Array
    damping: Array
    stiffness: Array
    rows: Array
    compliance: Array
    mobility: Array


def split_rail(scenario: Scenario) -> tuple[Structure, Partition, Array, NDArray[np.bool_]]:
    """Structure with the rail's functions to the frequency limit, split at ``solution.sines``.

    Returns:
        structure, its partition, damping of the shifted global set (G, G), global coordinates (N,).
    """
    sines = scenario.solution.sines
    if sines is None:
        raise InputError("solution.sines: not stated; the classes need the number of global sines")
    line = scenario.line
    longest = max(line.approach_left, *line.spans, line.approach_right)
    limit = scenario.solution.frequency_limit
    needed = sines[0] + 2
    while rail_frequency(scenario.track, needed * math.pi / longest) < limit:
        needed += 1
    solution = scenario.solution.model_copy(update={"sines": (needed, *sines[1:])})
    structure = assemble(scenario.model_copy(update={"solution": solution}))
    is_global = np.ones(structure.size, dtype=bool)
    for table in structure.fields["rail"].dofs:
        is_global[table[4 + sines[0] :]] = False
    split = partition(structure.mass.toarray(), structure.stiffness.toarray(), is_global)
    order = np.concatenate((np.flatnonzero(is_global), np.flatnonzero(~is_global)))
    shifted = np.vstack((np.eye(int(is_global.sum())), split.global_shift))
    damping = shifted.T @ structure.damping.toarray()[np.ix_(order, order)] @ shifted
    return structure, split, np.asarray(damping), is_global


def band_model(split: Partition, damping: Array, rows: Array, phi: Array, omega: float) -> _Model:
    """Three classes about ``omega`` (rad/s); 0 is a run without local modes.

    Args:
        split, damping: see :func:`split_rail`.
        rows, phi: (n, G), (n, L) of the wheel's places, from :meth:`Partition.load`.
    """
    low = split.omega < omega / RESONANT_BAND
    near = (split.omega >= omega / RESONANT_BAND) & (split.omega <= omega * RESONANT_BAND)
    if omega == 0:
        low = near = np.zeros(len(split.omega), dtype=bool)
    # n <a a^T> is a sum over the modes of the band per its width
    share = math.pi / 2 / (omega * (RESONANT_BAND - 1 / RESONANT_BAND)) if omega else 0.0
    j, k = split.coupling[low], split.coupling[near]
    compliance = -(phi[:, low] ** 2).sum(axis=1) / omega**2 if omega else np.zeros(len(phi))
    return _Model(
        split.mass - j.T @ j,
        damping + share * omega**2 * (k.T @ k),
        split.stiffness,
        rows - phi[:, low] @ j,
        np.asarray(compliance),
        share * (phi[:, near] ** 2).sum(axis=1),
    )


def _march(
    model: _Model,
    vehicle: tuple[Array, Array, Array, Array, NDArray[np.int64]],
    spring: float,
    rough: Array,
    h: float,
    weighted: bool,
) -> Array:
    """Wheelset force (n,) of one run."""
    mass, damping, stiffness, weight, wheels = vehicle
    wheel = int(wheels[0])
    load = weight if weighted else np.zeros_like(weight)
    inverse = np.linalg.inv(model.stiffness + 2 / h * model.damping + 4 / h**2 * model.mass)
    car = np.linalg.inv(stiffness + 2 / h * damping + 4 / h**2 * mass)
    q, v, a = np.zeros((3, len(inverse)))
    z, w, b = np.zeros((3, len(weight)))
    force = np.zeros(len(rough))
    y = 0.0
    if weighted:
        force[0] = float(weight.sum())
        q = np.linalg.solve(model.stiffness, model.rows[0] * force[0])
        hung = weight.copy()
        hung[wheel] -= force[0]
        rest = np.linalg.lstsq(stiffness, hung, rcond=None)[0]
        z = rest - rest[wheel] + float(model.rows[0] @ q) + force[0] / spring + rough[0]
    for n in range(1, len(rough)):
        row, mobility = model.rows[n], float(model.mobility[n])
        push = model.mass @ (4 / h**2 * q + 4 / h * v + a) + model.damping @ (2 / h * q + v)
        free, answer = inverse @ push, inverse @ row
        alone = car @ (load + mass @ (4 / h**2 * z + 4 / h * w + b) + damping @ (2 / h * z + w))
        rail = row @ free + y + h / 2 * mobility * force[n - 1]
        give = row @ answer + h / 2 * mobility + model.compliance[n] + car[wheel, wheel]
        force[n] = (alone[wheel] - rail - rough[n]) / (give + 1 / spring)
        y += h / 2 * mobility * (force[n] + force[n - 1])
        moved, ridden = free + answer * force[n], alone - car[:, wheel] * force[n]
        a, b = 4 / h**2 * (moved - q) - 4 / h * v - a, 4 / h**2 * (ridden - z) - 4 / h * w - b
        v, w = 2 / h * (moved - q) - v, 2 / h * (ridden - z) - w
        q, z = moved, ridden
    return force


def run_classes(scenario: Scenario) -> ClassRun:
    """Wheelset force by the paper's form in time.

    Args:
        scenario: one wheel element at constant speed, linear contact, ``solution.sines`` stated.

    Raises:
        InputError: it is something else.
    """
    train, solution = scenario.train, scenario.solution
    if len(train) != 1 or len(train[0].vehicles) != 1 or len(train[0].axle_positions) != 1:
        raise InputError("train: the three classes in time are run for one wheel element")
    if train[0].speed_profile or train[0].direction != "forward" or train[0].flat:
        raise InputError("train: the three classes in time take constant speed, forward, no flats")
    if scenario.contact.law != "linear" or solution.end_time is None:
        raise InputError(
            'contact.law, solution.end_time: superposed runs need "linear" and a stated end'
        )
    structure, split, damping, is_global = split_rail(scenario)
    speed, step = train[0].speed, solution.step
    time: Array = np.arange(round(solution.end_time / step) + 1, dtype=np.float64) * step
    place = train[0].start + speed * time
    if place[0] < 0 or place[-1] > scenario.line.length:
        raise InputError("train: the three classes in time are run for a wheel on the line only")
    at = structure.rail_rows(place).toarray()
    rows, phi = split.load(at[:, is_global], at[:, ~is_global])
    crossover = crossover_frequency(scenario)
    profile = build_profile(scenario.irregularity, -30.0, scenario.line.length + 30.0, 0.0)
    count = max(1, round(10 * math.log10(solution.frequency_limit / crossover)))
    edges = np.geomspace(crossover, solution.frequency_limit, count + 1)
    below = [low_pass(profile, 2 * math.pi * f / speed)(place[:, None])[:, 0] for f in edges]
    centres = np.sqrt(edges[:-1] * edges[1:])
    vehicle = vehicle_matrices(train[0])
    spring = 2 * scenario.contact.stiffness
    plain = band_model(split, damping, rows, phi, 0.0)
    parts = [
        _march(plain, vehicle, spring, np.zeros(len(time)), step, True),
        _march(plain, vehicle, spring, below[0] - below[0][0], step, False),
    ]
    for i, centre in enumerate(centres):
        model = band_model(split, damping, rows, phi, 2 * math.pi * float(centre))
        parts.append(_march(model, vehicle, spring, below[i + 1] - below[i], step, False))
    together = np.array(parts)
    return ClassRun(time, together.sum(axis=0), centres, together, len(split.omega))
