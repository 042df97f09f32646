"""Exact exponential stepping of complex modes under wheelsets that move along them.

Each mode obeys q' = lambda q + p with p = sum of phi(x_i) F_i over the wheelsets on the line. With
p interpolated over the step h through its samples p'', p', p (the last two and the new one),

    q = E q' + a p + b p' + c p'',   E = exp(lambda h),

the weights a, b, c being integrals of exp(lambda (h - t)) times Lagrange polynomials. In place of
q the stepper keeps y, with q = y + a p - (c/E) p', which needs no memory of p:

    y_next = E y + d p,   d = E a + b + c/E.

The displacement of the rail at a wheelset is a sum over the modes of q, predicted with the last
forces at the new positions, plus its own tabled compliance times the change of its force. The
changes of the other forces in the same step are left out: they are second order in the step.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from .contact import force_of, solve_contact
from .energy import EnergyBalance
from .errors import SolverError
from .line import assemble
from .modes import RESIDUAL_STEP, ModalLine, modal_line, solve_modal_line
from .scenario import Scenario
from .traffic import Running, Traffic
from .vehicle import UnitStep, block_units, discretise, static_start

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

LANES = 32
"""Modes are padded to a multiple of this, so that vectors of any width leave no rest."""

FASTMATH = {"contract", "reassoc", "nsz", "arcp"}
"""Freedoms given to the compiler; not-a-number and infinity keep their meaning."""

SLOW = 0.05
"""Modes that decay below this factor within one step are given forces linear in the step."""


def exponential_weights(eigenvalues: Complex, step: float, order: int) -> tuple[Complex, ...]:
    """E, a, b, c of the step ``q = E q' + a p + b p' + c p''`` (all (K,); a, b, c in s).

    With the functions phi_j(z) = (phi_{j-1}(z) - 1/(j-1)!)/z, phi_0 = exp, the integral of
    exp(lambda (h - t)) (t/h)^j over the step is h j! phi_{j+1}(lambda h).
    """
    z: Complex = eigenvalues * step
    decay: Complex = np.exp(z)
    phi = [decay]
    with np.errstate(divide="ignore", invalid="ignore"):
        for j in range(1, 4):
            phi.append((phi[-1] - 1 / math.factorial(j - 1)) / z)
    small = np.abs(z) < 0.7
    for j in range(1, 4):
        series = np.zeros_like(z)
        for m in range(18):
            series += z**m / math.factorial(m + j)
        phi[j] = np.where(small, series, phi[j])
    constant, linear, quadratic = step * phi[1], step * phi[2], 2 * step * phi[3]
    if order == 1:
        return decay, linear, constant - linear, np.zeros_like(decay)
    now, before = (quadratic + linear) / 2, (quadratic - linear) / 2
    last = constant - quadratic
    slow = np.abs(decay) < SLOW
    now[slow], last[slow], before[slow] = linear[slow], (constant - linear)[slow], 0.0
    return decay, now, last, before


@dataclass(frozen=True, eq=False)
class ModalTables:
    """A :class:`ModalLine` made ready for one step length.

    K is padded with zeros to a multiple of 32; weights are folded into the shapes as square roots.

    Attributes:
        shapes: (cells, 4, 2 K) cubic coefficients of the rail shapes, re then im.
        decay, drive: (2, K) re and im of E and d.
        now, recall: (2, K) re and im of a and -c/E.
        compliance: (2, cells, 4) m/N, cubic coefficients: displacement of the modes at a wheelset
            per its new force; residual compliance.
        channel_weights: (O, 2 K) output = channel_weights @ (re, -im of y) + feed-through.
        channel_feed: (2, cells, 4, O) cubic coefficients of the feed-through per new, last force.
        start_weights: (K,) complex: y before sample 0 = start_weights p for a static p.
        grid_start, grid_step, length: m.
    """

    shapes: NDArray[np.floating]
    decay: Array
    drive: Array
    now: Array
    recall: Array
    compliance: Array
    channel_weights: NDArray[np.floating]
    channel_feed: Array
    start_weights: Complex
    grid_start: float
    grid_step: float
    length: float

    def unpack(self, values: NDArray[np.floating]) -> Complex:
        """Complex values of the modes without the padding, of (2, K) or (2 K,)."""
        parts = values.astype(np.float64).reshape(self.decay.shape)
        whole: Complex = parts[0] + 1j * parts[1]
        return whole[: len(self.start_weights)]


def aligned(shape: tuple[int, ...], precision: np.dtype | type[np.floating]) -> Any:
    """Zeros that begin on a line of the cache, which vectors then never straddle."""
    size = math.prod(shape) * np.dtype(precision).itemsize
    memory = np.zeros(size + 64, dtype=np.uint8)
    begin = -memory.ctypes.data % 64
    return memory[begin : begin + size].view(precision).reshape(shape)


def pack(values: Complex, precision: type[np.floating] = np.float64) -> Any:
    """Modes on the last axis, re and im one after the other and padded: (..., 2, K)."""
    *others, modes = values.shape
    packed = aligned((*others, 2, -(-modes // LANES) * LANES), precision)
    packed[..., 0, :modes], packed[..., 1, :modes] = values.real, values.imag
    return packed


def modal_tables(
    line: ModalLine,
    step: float,
    derivatives: tuple[int, ...],
    *,
    order: int = 2,
    precision: type[np.floating] = np.float64,
) -> ModalTables:
    """Tables for a time step (s); channel outputs are ordered derivative by derivative.

    Args:
        line: modes of the line.
        step: time step (s).
        derivatives: 0, 1, 2 for displacement, velocity, acceleration of the channels.
        order: 1 or 2, interpolation of the forces in time.
        precision: of the shapes of rail and channels.
    """
    root = np.sqrt(line.weights)
    cells = len(line.rail_shapes)
    lam = line.eigenvalues
    decay, now, last, before = exponential_weights(lam, step, order)
    recall = -before / decay

    channel = line.channel_shapes * root
    outputs = len(derivatives) * len(channel)
    observe = [channel * lam**derivative for derivative in derivatives]
    direct = [channel * lam * (derivative == 2) for derivative in derivatives]
    feeds = [
        np.concatenate([np.zeros((0, len(lam))), *rows]).T
        for rows in (
            [one * now + other for one, other in zip(observe, direct, strict=True)],
            [one * recall for one in observe],
        )
    ]
    width = pack(lam).size
    channel_weights = aligned((outputs, width), precision)
    channel_feed = np.zeros((2, cells, 4, outputs))
    if outputs:
        channel_weights[:] = pack(np.concatenate(observe)).reshape(outputs, -1)
    packed, own = aligned((cells, 4, width), precision), np.empty((cells, 4))
    for begin in range(0, cells, 32):
        part = slice(begin, begin + 32)
        # by parts, because fresh memory costs more than this arithmetic
        shapes = line.rail_shapes[part] * root
        packed[part] = pack(shapes, precision).reshape(len(shapes), 4, width)
        ends = np.stack([shapes[:, 0], shapes.sum(axis=1)])
        slopes = np.stack([shapes[:, 1], shapes[:, 1] + 2 * shapes[:, 2] + 3 * shapes[:, 3]])
        (v0, v1), (d0, d1) = (ends**2 @ now).real, (2 * ends * slopes @ now).real
        own[part] = np.stack(
            [v0, d0, 3 * (v1 - v0) - 2 * d0 - d1, 2 * (v0 - v1) + d0 + d1], axis=-1
        )
        for row, feed in enumerate(feeds):
            answer = (shapes.reshape(-1, len(lam)) @ feed).real
            channel_feed[row, part] = answer.reshape(len(shapes), 4, outputs)
    return ModalTables(
        shapes=packed,
        decay=pack(decay),
        drive=pack(decay * now + last - recall),
        now=pack(now),
        recall=pack(recall),
        compliance=np.stack([own, line.residual]),
        channel_weights=channel_weights,
        channel_feed=channel_feed,
        start_weights=-1 / lam - now - recall,
        grid_start=line.grid_start,
        grid_step=line.grid_step,
        length=line.length,
    )


@dataclass(eq=False)
class Fleet:
    """Units that are being stepped: constant matrices padded to common sizes, and their state.

    Units of the same kind share matrices; axles of all units are numbered through.

    Attributes:
        kind: (U,) index into the matrices. first: (U + 1,) first axle of each unit.
        transition: (T, S, S) of column to row. drive: (T, A, S). constant: (T, S).
        now, before: (T, A, A) m/N, wheelset displacement per new and last forces.
        wheelsets: (T, A) index of the wheelset displacements. states: (T,) length of the state.
        linear, hertz: (W,) contact law of every axle.
        state: (U, S). force, place: (W,) force (N) and position (m) at the last sample.
        touching: (W,) whether the axle was in contact at the last sample.
    """

    kind: NDArray[np.int64]
    first: NDArray[np.int64]
    transition: Array
    drive: Array
    constant: Array
    now: Array
    before: Array
    wheelsets: NDArray[np.int64]
    states: NDArray[np.int64]
    linear: Array
    hertz: Array
    state: Array
    force: Array
    place: Array
    touching: NDArray[np.bool_]


def build_fleet(
    steps: list[UnitStep],
    wheelsets: list[NDArray[np.intp]],
    kind: list[int],
    law: list[Array],
    state: list[Array],
    force: list[Array],
    place: list[Array],
) -> Fleet:
    """Pad matrices of all kinds and gather the units' states.

    Args:
        steps, wheelsets: discretised unit and wheelset indices of every kind.
        kind: kind of every unit.
        law: (2, A) linear stiffness and Hertz factor of the axles of every unit.
        state, force, place: of every unit at its last sample.
    """
    kinds, most = len(steps), max((len(step.constant) for step in steps), default=0)
    axles = max((len(indices) for indices in wheelsets), default=0)
    transition = np.zeros((kinds, most, most))
    drive, constant = np.zeros((kinds, axles, most)), np.zeros((kinds, most))
    now, before = np.zeros((kinds, axles, axles)), np.zeros((kinds, axles, axles))
    where = np.zeros((kinds, axles), dtype=np.int64)
    for i, (step, indices) in enumerate(zip(steps, wheelsets, strict=True)):
        n, a = len(step.constant), len(indices)
        transition[i, :n, :n] = step.transition.T
        drive[i, :a, :n], constant[i, :n] = step.drive.T, step.constant
        now[i, :a, :a], before[i, :a, :a] = step.now[indices], step.before[indices]
        where[i, :a] = indices
    padded = np.zeros((len(kind), most))
    for i, values in enumerate(state):
        padded[i, : len(values)] = values
    forces = np.concatenate([np.zeros(0), *force])
    return Fleet(
        kind=np.array(kind, dtype=np.int64),
        first=np.cumsum([0] + [len(wheelsets[k]) for k in kind], dtype=np.int64),
        transition=transition,
        drive=drive,
        constant=constant,
        now=now,
        before=before,
        wheelsets=where,
        states=np.array([len(step.constant) for step in steps], dtype=np.int64),
        linear=np.concatenate([np.zeros(0), *(pair[0] for pair in law)]),
        hertz=np.concatenate([np.zeros(0), *(pair[1] for pair in law)]),
        state=padded,
        force=forces,
        place=np.concatenate([np.zeros(0), *place]),
        touching=forces > 0,
    )


def march(
    tables: ModalTables,
    modal: Array,
    load: NDArray[np.floating],
    fleet: Fleet,
    position: Array,
    roughness: Array,
    force: Array,
    outputs: Array,
) -> tuple[int, float]:
    """Advance by n samples, compiled.

    Args:
        tables: of the line.
        modal: (2, K) re and -im of the state y, overwritten.
        load: (2, K) re and im of p at the last sample, overwritten.
        fleet: units on or near the line; their state is overwritten.
        position: (n, W) m of the fleet's axles.
        roughness: (n, W) m, irregularity plus wheel defects under them.
        force: (n, W) N, filled; NaN while off the line.
        outputs: (n, O) filled with the channel outputs.

    Returns:
        number of times an axle lost contact on the line, largest equilibrium residual (N).
    """
    axles, precision = position.shape[1], tables.shapes.dtype
    size = tables.decay.shape[1]
    lost, residual = _march(
        tables.shapes,
        tables.decay,
        tables.drive,
        tables.now,
        tables.recall,
        tables.compliance,
        tables.channel_weights,
        tables.channel_feed,
        tables.grid_start,
        tables.grid_step,
        tables.length,
        modal,
        load,
        aligned((axles + 1, 2 * size), precision),
        aligned((2, size), precision),
        aligned((2, size), precision),
        aligned((CHUNK, 2 * size), precision),
        fleet.kind,
        fleet.first,
        fleet.transition,
        fleet.drive,
        fleet.constant,
        fleet.now,
        fleet.before,
        fleet.wheelsets,
        fleet.states,
        fleet.linear,
        fleet.hertz,
        fleet.state,
        fleet.force,
        fleet.place,
        fleet.touching,
        np.empty(fleet.state.shape[1]),
        position,
        roughness,
        force,
        outputs,
    )
    return int(lost), float(residual)


CHUNK = 8
"""Samples of the modes that are kept until the channels are read, four at a time."""

KERNEL = {"cache": True, "fastmath": FASTMATH, "error_model": "numpy"}


# Arrays come whole, with an index: making a slice costs as much as the work on 100 modes.
@njit(**KERNEL)
def _shape_two(shapes, c, d, s, r, shape, a, b, f, g, load):  # type: ignore[no-untyped-def]
    """Rail shapes of wheelsets a and b, at s in cell c and at r in cell d, and their loads."""
    for k in range(load.size):
        v = shapes[c, 0, k] + s * (shapes[c, 1, k] + s * (shapes[c, 2, k] + s * shapes[c, 3, k]))
        w = shapes[d, 0, k] + r * (shapes[d, 1, k] + r * (shapes[d, 2, k] + r * shapes[d, 3, k]))
        shape[a, k] = v
        shape[b, k] = w
        load[k] += f * v + g * w


@njit(**KERNEL)
def _read_shapes(shapes, cell, place, here, count, shape, force, load):  # type: ignore[no-untyped-def]
    """Shapes under the wheelsets on the line, and the sum of shapes times forces."""
    for k in range(load.size):
        load[k] = 0.0
    for m in range(0, count, 2):
        a, b = here[m], here[m + 1]
        _shape_two(
            shapes, cell[a], cell[b], place[a], place[b], shape, a, b, force[a], force[b], load
        )


@njit(**KERNEL)
def _add_four(shape, a, b, c, d, f0, f1, f2, f3, load):  # type: ignore[no-untyped-def]
    for k in range(load.size):
        load[k] += f0 * shape[a, k] + f1 * shape[b, k] + f2 * shape[c, k] + f3 * shape[d, k]


@njit(**KERNEL)
def _sum_loads(shape, pushing, pushed, force, load):  # type: ignore[no-untyped-def]
    """Sum of shapes times forces over the wheelsets that push."""
    for k in range(load.size):
        load[k] = 0.0
    for m in range(0, pushed, 4):
        a, b, c, d = pushing[m], pushing[m + 1], pushing[m + 2], pushing[m + 3]
        _add_four(shape, a, b, c, d, force[a], force[b], force[c], force[d], load)


@njit(**KERNEL)
def _step_modes(decay, drive, load, modal):  # type: ignore[no-untyped-def]
    """y = E y + d p; modal holds -im of y, so that a real part is a plain scalar product."""
    for k in range(modal.shape[1]):
        x, y, p, q = modal[0, k], modal[1, k], load[0, k], load[1, k]
        e, f, a, b = decay[0, k], decay[1, k], drive[0, k], drive[1, k]
        modal[0, k] = e * x + f * y + a * p - b * q
        modal[1, k] = e * y - f * x - a * q - b * p


@njit(**KERNEL)
def _decay_modes(decay, modal):  # type: ignore[no-untyped-def]
    """y = E y."""
    for k in range(modal.shape[1]):
        x, y, e, f = modal[0, k], modal[1, k], decay[0, k], decay[1, k]
        modal[0, k] = e * x + f * y
        modal[1, k] = e * y - f * x


@njit(**KERNEL)
def _predict(now, recall, guess, load, modal, predicted):  # type: ignore[no-untyped-def]
    """q = y + a p - (c/E) p' with p guessed; predicted holds -im of q."""
    for k in range(modal.shape[1]):
        p, q, r, s = guess[0, k], guess[1, k], load[0, k], load[1, k]
        a, b, c, d = now[0, k], now[1, k], recall[0, k], recall[1, k]
        predicted[0, k] = modal[0, k] + a * p - b * q + c * r - d * s
        predicted[1, k] = modal[1, k] - a * q - b * p - c * s - d * r


@njit(**KERNEL)
def _keep(modal, history, row):  # type: ignore[no-untyped-def]
    for k in range(modal.size):
        history[row, k] = modal[k]


@njit(**KERNEL)
def _dot_four(weights, row, values, a, b, c, d):  # type: ignore[no-untyped-def]
    zero = weights.dtype.type(0)
    p, q, r, s = zero, zero, zero, zero
    for k in range(weights.shape[1]):
        p += weights[row, k] * values[a, k]
        q += weights[row, k] * values[b, k]
        r += weights[row, k] * values[c, k]
        s += weights[row, k] * values[d, k]
    return p, q, r, s


@njit(**KERNEL)
def _displace(shape, pushing, pushed, modes, displacement):  # type: ignore[no-untyped-def]
    """What the modes move the rail at every wheelset that pushes."""
    for m in range(0, pushed, 4):
        a, b, c, d = pushing[m], pushing[m + 1], pushing[m + 2], pushing[m + 3]
        p, q, r, s = _dot_four(modes, 0, shape, a, b, c, d)
        displacement[a], displacement[b], displacement[c], displacement[d] = p, q, r, s


@njit(**KERNEL)
def _observe(history, weights, begin, end, outputs):  # type: ignore[no-untyped-def]
    """outputs[begin:end] += history @ weights.T; starting a BLAS would cost more than it saves.

    Rows of ``history`` beyond ``end - begin`` are read but not used: that every sample goes the
    same way keeps its bits independent of how a run is cut.
    """
    for n in range(0, end - begin, 4):
        at, left = begin + n, end - begin - n
        for o in range(weights.shape[0]):
            p, q, r, s = _dot_four(weights, o, history, n, n + 1, n + 2, n + 3)
            outputs[at, o] += p
            if left > 1:
                outputs[at + 1, o] += q
            if left > 2:
                outputs[at + 2, o] += r
            if left > 3:
                outputs[at + 3, o] += s


@njit(**KERNEL)
def _cubic(c, row, cell, s):  # type: ignore[no-untyped-def]
    return c[row, cell, 0] + s * (c[row, cell, 1] + s * (c[row, cell, 2] + s * c[row, cell, 3]))


@njit(**KERNEL)
def _feed(c, row, cell, s, force, outputs, n):  # type: ignore[no-untyped-def]
    for o in range(outputs.shape[1]):
        outputs[n, o] += force * (
            c[row, cell, 0, o]
            + s * (c[row, cell, 1, o] + s * (c[row, cell, 2, o] + s * c[row, cell, 3, o]))
        )


@njit(**KERNEL)
def _step_unit(transition, drive, constant, t, states, first, axles, force, n, u, state, scratch):  # type: ignore[no-untyped-def]
    for r in range(states):
        scratch[r] = constant[t, r]
    for c in range(states):
        factor = state[u, c]
        for r in range(states):
            scratch[r] += factor * transition[t, c, r]
    for a in range(axles):
        factor = force[n, first + a]
        for r in range(states):
            scratch[r] += factor * drive[t, a, r]
    for r in range(states):
        state[u, r] = scratch[r]


@njit(**KERNEL)
def _march(  # type: ignore[no-untyped-def]
    shapes,
    decay,
    drive,
    now_weight,
    recall,
    compliance,
    channel_weights,
    channel_feed,
    grid_start,
    grid_step,
    length,
    modal,
    load,
    shape,
    guess,
    predicted,
    history,
    kind,
    first,
    transition,
    unit_drive,
    constant,
    now,
    before,
    wheelsets,
    states,
    linear,
    hertz,
    state,
    last_force,
    last_place,
    touching,
    scratch,
    position,
    roughness,
    force,
    outputs,
):
    samples, axles = position.shape
    last_cell = len(shapes) - 1
    flat_modal, flat_load, flat_guess = modal.ravel(), load.ravel(), guess.ravel()
    flat_predicted = predicted.reshape(1, 2 * predicted.shape[1])
    rows = len(history)
    lost = 0
    worst = 0.0
    # the wheelsets on the line, filled up to a multiple of four with one that never pushes
    count, pushed = 0, 0
    here, pushing = np.full(axles + 4, axles), np.full(axles + 4, axles)
    cell, local = np.zeros(axles + 1, np.int64), np.zeros(axles + 1)
    place, push = np.zeros(axles + 1, shapes.dtype), np.zeros(axles + 1, shapes.dtype)
    displacement, gap, own = np.zeros(axles + 1), np.empty(axles), np.empty(axles)
    # a turn is the last sample's forces on the modes, then the prediction and forces of this one
    for n in range(samples + 1):
        row = n % rows
        if n < samples:
            count = 0
            for i in range(axles):
                x = position[n, i]
                if 0.0 <= x <= length:
                    at = (x - grid_start) / grid_step
                    cell[i] = min(int(at), last_cell)
                    local[i] = at - cell[i]
                    here[count] = i
                    count += 1
            here[count : count + 3] = axles
            for o in range(outputs.shape[1]):
                outputs[n, o] = 0.0
        if n > 0 and pushed > 0:
            _sum_loads(shape, pushing, pushed, push, flat_load)
            _step_modes(decay, drive, load, modal)
        elif n > 0:
            _decay_modes(decay, modal)
        if n == samples:
            break
        _keep(flat_modal, history, row)
        if count > 0:
            for m in range(count):
                push[here[m]] = last_force[here[m]]
                place[here[m]] = local[here[m]]
            _read_shapes(shapes, cell, place, here, count, shape, push, flat_guess)
            _predict(now_weight, recall, guess, load, modal, predicted)
            _displace(shape, here, count, flat_predicted, displacement)
        for u in range(kind.size):
            t = kind[u]
            begin = first[u]
            own_axles = first[u + 1] - begin
            for a in range(own_axles):
                i = begin + a
                x, old = position[n, i], last_place[i]
                own[i] = -now[t, a, a]
                gap[i] = state[u, wheelsets[t, a]] - roughness[n, i]
                for b in range(own_axles):
                    gap[i] += before[t, a, b] * last_force[begin + b]
                    if b < a:
                        gap[i] += now[t, a, b] * force[n, begin + b]
                    elif b > a:
                        gap[i] += now[t, a, b] * last_force[begin + b]
                if 0.0 <= old <= length:
                    at = (old - grid_start) / grid_step
                    old_cell = min(int(at), last_cell)
                    _feed(channel_feed, 1, old_cell, at - old_cell, last_force[i], outputs, n)
                if not 0.0 <= x <= length:
                    force[n, i] = solve_contact(gap[i], own[i], linear[i], hertz[i])
                    continue
                s = local[i]
                modes = _cubic(compliance, 0, cell[i], s)
                gap[i] += modes * last_force[i] - displacement[i]
                own[i] += modes + _cubic(compliance, 1, cell[i], s)
                f = solve_contact(gap[i], own[i], linear[i], hertz[i])
                force[n, i] = f
                _feed(channel_feed, 0, cell[i], s, f, outputs, n)
            for a in range(own_axles):
                i = begin + a
                f = force[n, i]
                closed = gap[i] - own[i] * f
                for b in range(a + 1, own_axles):
                    closed += now[t, a, b] * (force[n, begin + b] - last_force[begin + b])
                worst = max(worst, abs(f - force_of(closed, linear[i], hertz[i])))
            _step_unit(
                transition,
                unit_drive,
                constant,
                t,
                states[t],
                begin,
                own_axles,
                force,
                n,
                u,
                state,
                scratch,
            )
            for a in range(own_axles):
                i = begin + a
                last_force[i] = force[n, i]
                last_place[i] = position[n, i]
                if 0.0 <= position[n, i] <= length:
                    if touching[i] and force[n, i] <= 0.0:
                        lost += 1
                    touching[i] = force[n, i] > 0.0
                else:
                    force[n, i] = np.nan
        if pushed > 0 and count == 0:
            for k in range(flat_load.size):
                flat_load[k] = 0.0
        pushed = count
        for m in range(count + 3):
            pushing[m] = here[m]
        for m in range(count):
            push[here[m]] = last_force[here[m]]
        if row == rows - 1 or n == samples - 1:
            _observe(history, channel_weights, n - row, n + 1, outputs)
    return lost, worst


def march_reference(
    tables: ModalTables,
    modal: Array,
    load: Array,
    fleet: Fleet,
    position: Array,
    roughness: Array,
    force: Array,
    outputs: Array,
) -> tuple[int, float]:
    """What :func:`march` does, in a form to be read; a thousand times slower."""
    decay, drive = tables.unpack(tables.decay), tables.unpack(tables.drive)
    now_weight, last_weight = tables.unpack(tables.now), tables.unpack(tables.recall)
    p = tables.unpack(load)
    lost, worst = 0, 0.0

    def locate(x: float) -> tuple[int, Array]:
        at = (x - tables.grid_start) / tables.grid_step
        cell = min(int(at), len(tables.shapes) - 1)
        return cell, np.asarray((at - cell) ** np.arange(4), np.float64)

    def shape_at(x: float) -> Complex:
        cell, powers = locate(x)
        return sum(
            (power * tables.unpack(tables.shapes[cell, j]) for j, power in enumerate(powers)),
            np.zeros_like(decay),
        )

    for n in range(len(position)):
        y = tables.unpack(modal).conj()
        outputs[n] = tables.channel_weights @ modal.ravel()
        shapes = {i: shape_at(x) for i, x in enumerate(position[n]) if 0 <= x <= tables.length}
        guess = sum((fleet.force[i] * shape for i, shape in shapes.items()), np.zeros_like(y))
        q = y + now_weight * guess + last_weight * p
        p = np.zeros_like(y)
        for u, t in enumerate(fleet.kind):
            axles = slice(fleet.first[u], fleet.first[u + 1])
            count = axles.stop - axles.start
            now, before = fleet.now[t, :count, :count], fleet.before[t, :count, :count]
            last, x = fleet.force[axles].copy(), position[n, axles]
            on = (x >= 0) & (x <= tables.length)
            was_on = (fleet.place[axles] >= 0) & (fleet.place[axles] <= tables.length)
            new = np.zeros(count)
            gaps, compliances = np.zeros(count), np.zeros(count)
            for a in range(count):
                known = np.where(np.arange(count) < a, new, last)
                known[a] = 0.0
                gap = fleet.state[u, fleet.wheelsets[t, a]] - roughness[n, axles][a]
                gap += before[a] @ last + now[a] @ known
                own = -now[a, a]
                if was_on[a]:
                    cell, powers = locate(fleet.place[axles][a])
                    outputs[n] += last[a] * (powers @ tables.channel_feed[1, cell])
                if on[a]:
                    cell, powers = locate(x[a])
                    shape = shapes[axles.start + a]
                    modes, rest = (powers @ tables.compliance[i, cell] for i in range(2))
                    gap += modes * last[a] - (shape * q).real.sum()
                    own += modes + rest
                law = fleet.linear[axles][a], fleet.hertz[axles][a]
                new[a] = solve_contact(gap, own, *law)
                gaps[a], compliances[a] = gap, own
                if on[a]:
                    p += shape * new[a]
                    outputs[n] += new[a] * (powers @ tables.channel_feed[0, cell])
            later: Array = np.triu(now, 1) @ (new - last)
            for a in range(count):
                law = fleet.linear[axles][a], fleet.hertz[axles][a]
                closed = gaps[a] - compliances[a] * new[a] + later[a]
                worst = max(worst, abs(float(new[a]) - force_of(float(closed), *law)))
            states = fleet.states[t]
            fleet.state[u, :states] = (
                fleet.state[u, :states] @ fleet.transition[t, :states, :states]
                + new @ fleet.drive[t, :count, :states]
                + fleet.constant[t, :states]
            )
            lost += int((on & fleet.touching[axles] & (new <= 0)).sum())
            fleet.touching[axles] = np.where(on, new > 0, fleet.touching[axles])
            fleet.force[axles], fleet.place[axles] = new, x
            force[n, axles] = np.where(on, new, np.nan)
        y = decay * y + drive * p
        modal[:], load[:] = pack(y.conj()), pack(p)
    return lost, float(worst)


FORCE_LIMIT = 1e4
"""Wheelset force per static load beyond which a run counts as diverged."""


def one_sided_cubics(values: Array) -> Array:
    """Cubic coefficients of evenly spaced samples: (..., P) to (..., P - 1, 4)."""
    spline = CubicSpline(np.arange(values.shape[-1]), values, axis=-1)
    return np.ascontiguousarray(np.moveaxis(spline.c[::-1], (0, 1), (-1, -2)))


@njit(**KERNEL)
def _dropped_answer(  # type: ignore[no-untyped-def]
    place, force, channel_x, residual, step, answer
):
    cells = residual.shape[3]
    for n in range(place.shape[0]):
        for i in range(place.shape[1]):
            if math.isnan(force[n, i]):
                continue
            for c in range(channel_x.size):
                away = (place[n, i] - channel_x[c]) / step
                side = 1 if away > 0.0 else 0
                away = abs(away)
                if away < cells:
                    cell = int(away)
                    s = away - cell
                    for order in range(3):
                        a = residual[c, order, side, cell]
                        value = a[0] + s * (a[1] + s * (a[2] + s * a[3]))
                        answer[n, c, order] += force[n, i] * value


@njit(**KERNEL)
def _rate(values, n, c, part, order, step):  # type: ignore[no-untyped-def]
    """Derivative of a column at row n by central differences."""
    if order == 0:
        return values[n, c, part]
    if order == 1:
        return (values[n + 1, c, part] - values[n - 1, c, part]) / (2 * step)
    if order == 2:
        ends = values[n + 1, c, part] + values[n - 1, c, part]
        return (ends - 2 * values[n, c, part]) / step**2
    near = values[n + 1, c, part] - values[n - 1, c, part]
    return (values[n + 2, c, part] - values[n - 2, c, part] - 2 * near) / (2 * step**3)


@njit(**KERNEL)
def _add_dropped(answer, derivative, step, signals, begin):  # type: ignore[no-untyped-def]
    """Add the dropped modes' answer to the columns of one derivative."""
    for n in range(signals.shape[0]):
        for c in range(answer.shape[1]):
            total = _rate(answer, n + 2, c, 1, derivative, step)
            total += _rate(answer, n + 2, c, 2, derivative + 1, step)
            if derivative > 0:
                total += _rate(answer, n + 2, c, 0, derivative - 1, step)
            signals[n, begin + c] += total


class ModalRun:
    """A run by exponential stepping: the state of modes and units, advanced in chunks.

    Args:
        line: modes of the line.
        traffic: the trains.
        derivatives: 0, 1, 2 for displacement, velocity, acceleration of the channels.
        order: interpolation of forces in time, see :func:`modal_tables`.
        precision: of the shapes and of the sums over modes; single precision changes forces and
            accelerations by less than 1e-4 of their peaks, the modes themselves are always double.
        marching: :func:`march` or its readable twin.
        balance: energy balance of the same line, to be fed.
    """

    def __init__(
        self,
        line: ModalLine,
        traffic: Traffic,
        derivatives: tuple[int, ...],
        *,
        order: int = 2,
        precision: type[np.floating] = np.float32,
        marching: Callable[..., tuple[int, float]] = march,
        balance: EnergyBalance | None = None,
    ) -> None:
        self.line = line
        self._balance = balance
        self.traffic = traffic
        self._precision = precision
        self._modal: Array = np.zeros(0)
        self._load: NDArray[np.floating] = np.zeros(0)
        self._prepare(derivatives, order)
        traffic.lay_ends(self._static_compliance)
        self.lost_contacts = 0
        self.equilibrium_residual = 0.0
        self._order = order
        self._march = marching
        self._derivatives = derivatives
        self._residual = one_sided_cubics(line.channel_residual)
        self._next = 0
        self._held: list[Array] = []
        self._units: list[Running] = []
        self._loads: Array = np.zeros(0)
        self._fleet: Fleet | None = None
        self._steps: list[UnitStep] = []
        self._until = 0

    def _prepare(self, derivatives: tuple[int, ...], order: int) -> None:
        self.tables = modal_tables(
            self.line, self.traffic.step, derivatives, order=order, precision=self._precision
        )
        self._modal = aligned(self.tables.decay.shape, np.float64)
        self._load = aligned(self.tables.decay.shape, self._precision)

    def _static_compliance(self, place: Array) -> Array:
        line = self.line
        kept = (line.weights * (line.rail(place) ** 2 / -line.eigenvalues).real).sum(axis=1)
        return np.asarray(kept + line.rail_residual(place))

    ratio = 1

    @property
    def _outputs(self) -> int:
        """Columns that the kernel fills."""
        return len(self._derivatives) * len(self.line.channel_x)

    @property
    def states(self) -> int:
        """Number of modes of the line that are stepped."""
        return len(self.line.eigenvalues)

    @property
    def channel_band(self) -> Array:
        """(C,) valid band of every channel (Hz)."""
        return self.line.channel_band

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on what limits the result."""
        return ()

    @property
    def next_sample(self) -> int:
        """First sample that is not computed yet."""
        return self._next

    def arrange(self, trains: Sequence[int], departed: Sequence[int] = ()) -> None:
        """Give columns to these trains, some of which may be new, and forget the departed."""
        source = self.traffic.arrange(trains)
        self.traffic.forget(departed)
        if self._held:
            self._held[1] = self.traffic.position(self._held[0])
            self._held[2] = self.traffic.rearranged(self._held[2], source)
        self._until = 0

    def advance(self, samples: int) -> tuple[Array, Array, Array, Array]:
        """The next samples: time (n,), position (n, W), force (n, W), channel outputs (n, O).

        The modes are two samples ahead of what is handed out, because the answer of the dropped
        modes is g0 + dg1/dt with sums g0, g1 over the moving forces, by central differences. The
        derivative of the kept modes' displacement is sum(shape (lambda q + p)); its last part
        h = sum(shape p), zero if all modes were kept, is a third such sum.

        Raises:
            SolverError: a force or a channel diverged.
        """
        first = self._next == 0
        ahead = self._march_on(samples + 2 if first else samples)
        # at rest before the start
        held = [np.repeat(part[:1], 2, axis=0) for part in ahead] if first else self._held
        time, position, force, outputs, answer = (
            np.concatenate(parts) for parts in zip(held, ahead, strict=True)
        )
        self._held = [part[-4:].copy() for part in (time, position, force, outputs, answer)]
        now = slice(2, -2)
        return time[now], position[now], force[now], self._signals(outputs, answer)

    def _signals(self, outputs: Array, answer: Array) -> Array:
        """Channel outputs (n, O) of samples with two more on either side."""
        signals = outputs[2:-2]
        width = answer.shape[1]
        for number, derivative in enumerate(self._derivatives):
            _add_dropped(answer, derivative, self.traffic.step, signals, number * width)
        return signals

    def _march_on(self, samples: int) -> list[Array]:
        """Time, position, force, outputs of the kept modes, sums h, g0, g1 of :meth:`advance`."""
        time: Array = (self._next + np.arange(samples, dtype=np.float64)) * self.traffic.step
        position = self.traffic.position(time)
        force = np.full(position.shape, np.nan)
        outputs = np.empty((samples, self._outputs))
        answer = np.zeros((samples, len(self.line.channel_x), 3))
        done = 0
        while done < samples:
            if self._next >= self._until:
                active = self.traffic.active(self._next)
                self._change_units(active, position[done], time[done])
                self._until = self.traffic.next_change(self._next)
            stop = min(samples, done + self._until - self._next)
            part = slice(done, stop)
            self._march_chunk(time[part], position[part], force[part], outputs[part], answer[part])
            self._next += stop - done
            done = stop
        return [time, position, force, outputs, answer]

    def _march_chunk(
        self, time: Array, position: Array, force: Array, outputs: Array, answer: Array
    ) -> None:
        assert self._fleet is not None
        columns = [c for unit in self._units for c in range(unit.columns.start, unit.columns.stop)]
        place = np.ascontiguousarray(position[:, columns])
        roughness = self.traffic.roughness(self._units, place, time)
        own_force = np.empty(place.shape)
        lost, residual = 0, 0.0
        # the energy balance wants the state of every step
        size = len(place) if self._balance is None else 1
        for part in (slice(n, n + size) for n in range(0, len(place), size)):
            before = None if self._balance is None else (self._modal.copy(), self._load.copy())
            new_lost, new_residual = self._march(
                self.tables,
                self._modal,
                self._load,
                self._fleet,
                place[part],
                roughness[part],
                own_force[part],
                outputs[part],
            )
            lost, residual = lost + new_lost, max(residual, new_residual)
            if before is not None:
                self._sample(*before, place[part.start], own_force[part.start])
        force[:, columns] = own_force
        _dropped_answer(
            place, own_force, self.line.channel_x, self._residual, RESIDUAL_STEP, answer
        )
        self._check(time, own_force, outputs)
        self.lost_contacts += lost
        if self._units:
            self.equilibrium_residual = max(
                self.equilibrium_residual, residual / float(self._loads.max())
            )

    def _sample(self, modal: Array, load: NDArray[np.floating], place: Array, force: Array) -> None:
        """Give the energy balance a sample, from the state before it."""
        assert self._balance is not None
        tables = self.tables
        new = self._balance.load(place, force)
        amplitude = tables.unpack(modal).conj() + tables.unpack(tables.now) * new
        self._balance.sample(amplitude + tables.unpack(tables.recall) * tables.unpack(load), new)

    @property
    def energy_residual(self) -> float | None:
        """Of the energy balance, see :class:`EnergyBalance`; None without one."""
        return None if self._balance is None else self._balance.residual

    def _check(self, time: Array, force: Array, outputs: Array) -> None:
        if self._units:
            limit = FORCE_LIMIT * self._loads
            bad = ~(np.fmax.reduce(np.abs(force), axis=0, initial=0.0) <= limit)
            assert self._fleet is not None
            bad |= ~np.isfinite(self._fleet.force)
            if bad.any():
                axle = int(np.argmax(bad))
                forces = np.append(force[:, axle], self._fleet.force[axle])
                value = float(np.fmax.reduce(np.abs(forces)))
                raise SolverError(
                    f"force of a wheelset = {value:.3g} N before t = {time[-1]:.6g} s; limit "
                    f"{limit[axle]:.3g} N: the run diverged, shorten solution.step"
                )
        if not np.isfinite(self._modal).all() or not np.isfinite(outputs).all():
            raise SolverError(
                f"a mode is not finite before t = {time[-1]:.6g} s; limit 1e308: the run "
                "diverged, shorten solution.step"
            )

    def _change_units(self, active: list[Running], position: Array, time: float) -> None:
        """Take in units that start now, let go those that have left."""
        while len(self._steps) < len(self.traffic.kinds):
            unit = self.traffic.kinds[len(self._steps)]
            self._steps.append(discretise(unit, self.traffic.step, self._order))
        kept = {id(unit): index for index, unit in enumerate(self._units)}
        fresh = [unit for unit in active if id(unit) not in kept]
        states, forces, places = self._start(fresh, position, time)
        begun = {id(unit): index for index, unit in enumerate(fresh)}
        state, force, place = [], [], []
        for running in active:
            if id(running) in begun:
                index = begun[id(running)]
                state.append(states[index])
                force.append(forces[index])
                place.append(places[index])
            else:
                assert self._fleet is not None
                index = kept[id(running)]
                axles = slice(self._fleet.first[index], self._fleet.first[index + 1])
                length = self._fleet.states[self._fleet.kind[index]]
                state.append(self._fleet.state[index, :length].copy())
                force.append(self._fleet.force[axles].copy())
                place.append(self._fleet.place[axles].copy())
        self._units = active
        self._loads = np.concatenate([np.zeros(0), *(u.unit.static_loads for u in active)])
        self._fleet = build_fleet(
            self._steps,
            [unit.wheelsets for unit in self.traffic.kinds],
            [unit.kind for unit in active],
            [unit.law for unit in active],
            state,
            force,
            place,
        )

    def _compliance(self, place: Array) -> Array:
        """Static displacement of the rail at places (n,) m per force there: (n, n) m/N."""
        shapes = self.line.rail(place)
        compliance = (shapes * (-self.line.weights / self.line.eigenvalues) @ shapes.T).real
        return np.asarray(compliance + np.diag(self.line.rail_residual(place)))

    def _rest(self, place: Array, force: Array) -> None:
        """Add the state at rest under forces (N) at places (m)."""
        load = (self.line.rail(place) * np.sqrt(self.line.weights)).T @ force
        self._load += pack(load)
        self._modal += pack((self.tables.start_weights * load).conj())

    def _start(
        self, units: list[Running], position: Array, time: float
    ) -> tuple[list[Array], list[Array], list[Array]]:
        """Static start of units: state before the sample, forces and places of each."""
        if not units:
            return [], [], []
        places = [position[unit.columns] for unit in units]
        place = np.concatenate(places)
        roughness = self.traffic.roughness(units, place[np.newaxis], np.array([time]))[0]
        on_line = (place >= 0) & (place <= self.line.length)
        compliance = self._compliance(place)
        whole = block_units([unit.unit for unit in units])
        law = np.concatenate([unit.law for unit in units], axis=1)
        rest, force = static_start(whole, law, compliance, roughness)
        if on_line.any():
            self._rest(place, force)
        states, forces, first, axle = [], [], 0, 0
        for unit in units:
            size, axles = len(unit.unit.weight), len(unit.unit.wheelsets)
            step = self._steps[unit.kind]
            own = force[axle : axle + axles]
            state = np.concatenate([rest[first : first + size], np.zeros(size)])
            states.append(state - (step.now + step.before) @ own)
            forces.append(own)
            first += size
            axle += axles
        return states, forces, places


def modal_run(
    scenario: Scenario, traffic: Traffic, derivatives: tuple[int, ...], *, balance: bool
) -> ModalRun:
    """Run of a scenario's line, its modes from the cache; with an energy balance computed anew."""
    if not balance:
        return ModalRun(modal_line(scenario), traffic, derivatives)
    line, forms = solve_modal_line(assemble(scenario))
    return ModalRun(line, traffic, derivatives, balance=EnergyBalance(line, forms, traffic.step))
