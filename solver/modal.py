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

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from .contact import force_of, solve_contact
from .errors import SolverError
from .modes import RESIDUAL_STEP, ModalLine
from .traffic import Running, Traffic
from .vehicle import UnitStep, block_units, discretise, static_start

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

LANES = 16
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

    K is padded with zeros to a multiple of 16; weights are folded into the shapes as square roots.

    Attributes:
        shapes: (cells, 8, K) re and im of the four cubic coefficients of the rail shapes.
        decay, drive: (2, K) re and im of E and d.
        predict: (4, K) re and im of a and of -c/E.
        compliance: (2, cells, 4) m/N, cubic coefficients: displacement of the modes at a wheelset
            per its new force; residual compliance.
        channel_weights: (O, 2K) output = channel_weights @ (re, -im of y) + feed-through.
        channel_feed: (2, cells, 4, O) cubic coefficients of the feed-through per new, last force.
        start_weights: (2, K) complex: y before sample 0 = start_weights[0] p for a static p.
        grid_start, grid_step, length: m.
    """

    shapes: NDArray[np.floating]
    decay: Array
    drive: Array
    predict: Array
    compliance: Array
    channel_weights: Array
    channel_feed: Array
    start_weights: Complex
    grid_start: float
    grid_step: float
    length: float

    @property
    def size(self) -> int:
        """Padded number of modes."""
        return int(self.decay.shape[1])


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
        precision: of the rail shapes.
    """
    modes = len(line.eigenvalues)
    size = -(-modes // LANES) * LANES
    root = np.sqrt(line.weights)
    cells = len(line.rail_shapes)
    shapes = line.rail_shapes * root
    lam = line.eigenvalues
    decay, now, last, before = exponential_weights(lam, step, order)
    recall = -before / decay

    packed = np.zeros((cells, 8, size), dtype=precision)
    packed[:, 0::2, :modes] = shapes.real
    packed[:, 1::2, :modes] = shapes.imag

    def split(values: Complex) -> Array:
        out = np.zeros((2, size))
        out[0, :modes], out[1, :modes] = values.real, values.imag
        return out

    ends = np.stack([shapes[:, 0], shapes.sum(axis=1)])
    slopes = np.stack([shapes[:, 1], shapes[:, 1] + 2 * shapes[:, 2] + 3 * shapes[:, 3]])
    (v0, v1), (d0, d1) = (ends**2 @ now).real, (2 * ends * slopes @ now).real
    own = np.stack([v0, d0, 3 * (v1 - v0) - 2 * d0 - d1, 2 * (v0 - v1) + d0 + d1], axis=-1)

    channel = line.channel_shapes * root
    weights, feeds = [], []
    for derivative in derivatives:
        observe = channel * lam**derivative
        weights.append(observe)
        direct = channel * lam if derivative == 2 else 0.0 * channel
        feeds.append(((observe * now + direct).T, (observe * recall).T))
    outputs = len(derivatives) * len(channel)
    channel_weights = np.zeros((outputs, 2 * size))
    channel_feed = np.zeros((2, cells, 4, outputs))
    if outputs:
        stacked = np.concatenate(weights)
        channel_weights[:, :modes] = stacked.real
        channel_weights[:, size : size + modes] = stacked.imag
        for row in range(2):
            matrix = np.concatenate([feed[row] for feed in feeds], axis=1)
            channel_feed[row] = (shapes.reshape(-1, modes) @ matrix).real.reshape(cells, 4, outputs)
    start = np.zeros(size, dtype=np.complex128)
    start[:modes] = -1 / lam - now - recall
    return ModalTables(
        shapes=packed,
        decay=split(decay),
        drive=split(decay * now + last - recall),
        predict=np.concatenate([split(now), split(recall)]),
        compliance=np.stack([own, line.residual]),
        channel_weights=channel_weights,
        channel_feed=channel_feed,
        start_weights=start,
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
        transition: (T, S, S). drive: (T, S, A). constant: (T, S).
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
    drive, constant = np.zeros((kinds, most, axles)), np.zeros((kinds, most))
    now, before = np.zeros((kinds, axles, axles)), np.zeros((kinds, axles, axles))
    where = np.zeros((kinds, axles), dtype=np.int64)
    for i, (step, indices) in enumerate(zip(steps, wheelsets, strict=True)):
        n, a = len(step.constant), len(indices)
        transition[i, :n, :n] = step.transition
        drive[i, :n, :a], constant[i, :n] = step.drive, step.constant
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
    load: Array,
    fleet: Fleet,
    position: Array,
    roughness: Array,
    force: Array,
    outputs: Array,
) -> tuple[int, float]:
    """Advance by n samples, compiled.

    Args:
        tables: of the line.
        modal: (2K,) re and -im of the state y, overwritten.
        load: (2K,) re and im of p at the last sample, overwritten.
        fleet: units on or near the line; their state is overwritten.
        position: (n, W) m of the fleet's axles.
        roughness: (n, W) m, irregularity plus wheel defects under them.
        force: (n, W) N, filled; NaN while off the line.
        outputs: (n, O) filled with the channel outputs.

    Returns:
        number of times an axle lost contact on the line, largest equilibrium residual (N).
    """
    width, axles = len(modal), position.shape[1]
    lost, residual = _march(
        tables.shapes.reshape(len(tables.shapes), -1),
        tables.decay,
        tables.drive,
        tables.predict,
        tables.compliance,
        tables.channel_weights,
        tables.channel_feed,
        tables.grid_start,
        tables.grid_step,
        tables.length,
        modal,
        load,
        np.empty((axles, width), dtype=tables.shapes.dtype),
        np.empty((2, width)),
        np.empty((min(CHUNK, len(position)), width)),
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
        np.empty(axles),
        np.empty(axles),
        np.empty(fleet.state.shape[1]),
        position,
        roughness,
        force,
        outputs,
    )
    return int(lost), float(residual)


CHUNK = 32
"""Samples of the modes that are kept until the channels are read, so that they stay cached."""

KERNEL = {"cache": True, "fastmath": FASTMATH, "error_model": "numpy"}


# Slices, not offsets, in the innermost loops: indices that might be negative are not vectorised.
@njit(**KERNEL)
def _shape_at(c0, c1, c2, c3, s, shape):  # type: ignore[no-untyped-def]
    """Rail shapes at s in a cell, re and im in a row."""
    for k in range(shape.size):
        shape[k] = c0[k] + s * (c1[k] + s * (c2[k] + s * c3[k]))


@njit(**KERNEL)
def _add_four(a, b, c, d, f0, f1, f2, f3, load):  # type: ignore[no-untyped-def]
    for k in range(load.size):
        load[k] += f0 * a[k] + f1 * b[k] + f2 * c[k] + f3 * d[k]


@njit(**KERNEL)
def _add_one(a, f, load):  # type: ignore[no-untyped-def]
    for k in range(load.size):
        load[k] += f * a[k]


@njit(**KERNEL)
def _step_modes(  # type: ignore[no-untyped-def]
    decay_re, decay_im, drive_re, drive_im, load_re, load_im, re, im
):
    """y = E y + d p; im holds -im of y, so that a real part is a plain scalar product."""
    for k in range(re.size):
        x, y, p, q = re[k], im[k], load_re[k], load_im[k]
        re[k] = decay_re[k] * x + decay_im[k] * y + drive_re[k] * p - drive_im[k] * q
        im[k] = decay_re[k] * y - decay_im[k] * x - drive_re[k] * q - drive_im[k] * p


@njit(**KERNEL)
def _sum_loads(shape, pushing, pushed, force, load):  # type: ignore[no-untyped-def]
    """Sum of shapes times forces over the wheelsets that push."""
    load[:] = 0.0
    m = 0
    while m + 3 < pushed:
        a, b, c, d = pushing[m], pushing[m + 1], pushing[m + 2], pushing[m + 3]
        _add_four(
            shape[a], shape[b], shape[c], shape[d], force[a], force[b], force[c], force[d], load
        )
        m += 4
    while m < pushed:
        _add_one(shape[pushing[m]], force[pushing[m]], load)
        m += 1


@njit(**KERNEL)
def _predict(  # type: ignore[no-untyped-def]
    now_re, now_im, last_re, last_im, guess_re, guess_im, load_re, load_im, re, im, out_re, out_im
):
    """q = y + a p - (c/E) p' with p guessed; out_im holds -im of q."""
    for k in range(re.size):
        p, q, r, s = guess_re[k], guess_im[k], load_re[k], load_im[k]
        out_re[k] = re[k] + now_re[k] * p - now_im[k] * q + last_re[k] * r - last_im[k] * s
        out_im[k] = im[k] - now_re[k] * q - now_im[k] * p - last_re[k] * s - last_im[k] * r


@njit(**KERNEL)
def _dot_four(weights, a, b, c, d):  # type: ignore[no-untyped-def]
    p, q, r, s = 0.0, 0.0, 0.0, 0.0
    for k in range(weights.size):
        p += weights[k] * a[k]
        q += weights[k] * b[k]
        r += weights[k] * c[k]
        s += weights[k] * d[k]
    return p, q, r, s


@njit(**KERNEL)
def _dot(weights, a):  # type: ignore[no-untyped-def]
    total = 0.0
    for k in range(weights.size):
        total += weights[k] * a[k]
    return total


@njit(**KERNEL)
def _observe(history, weights, outputs):  # type: ignore[no-untyped-def]
    """outputs += history @ weights.T; threads of a BLAS would cost more than they save here."""
    samples = history.shape[0]
    for o in range(weights.shape[0]):
        n = 0
        while n + 3 < samples:
            p, q, r, s = _dot_four(
                weights[o], history[n], history[n + 1], history[n + 2], history[n + 3]
            )
            outputs[n, o] += p
            outputs[n + 1, o] += q
            outputs[n + 2, o] += r
            outputs[n + 3, o] += s
            n += 4
        while n < samples:
            outputs[n, o] += _dot(weights[o], history[n])
            n += 1


@njit(**KERNEL)
def _cubic(c, s):  # type: ignore[no-untyped-def]
    return c[0] + s * (c[1] + s * (c[2] + s * c[3]))


@njit(**KERNEL)
def _feed(c, s, force, out):  # type: ignore[no-untyped-def]
    for o in range(out.size):
        out[o] += force * (c[0, o] + s * (c[1, o] + s * (c[2, o] + s * c[3, o])))


@njit(**KERNEL)
def _march(  # type: ignore[no-untyped-def]
    shapes,
    decay,
    drive,
    predict,
    compliance,
    channel_weights,
    channel_feed,
    grid_start,
    grid_step,
    length,
    modal,
    load,
    shape,
    spare,
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
    gap,
    own,
    scratch,
    position,
    roughness,
    force,
    outputs,
):
    size = decay.shape[1]
    width = 2 * size
    last_cell = shapes.shape[0] - 1
    lost = 0
    worst = 0.0
    pushing = np.empty(position.shape[1], np.int64)
    for n in range(position.shape[0]):
        row = n % history.shape[0]
        history[row] = modal
        outputs[n] = 0.0
        pushed = 0
        for i in range(position.shape[1]):
            x = position[n, i]
            if 0.0 <= x <= length:
                at = (x - grid_start) / grid_step
                cell = min(int(at), last_cell)
                c = shapes[cell]
                _shape_at(
                    c[:width],
                    c[width : 2 * width],
                    c[2 * width : 3 * width],
                    c[3 * width :],
                    shapes.dtype.type(at - cell),
                    shape[i],
                )
                pushing[pushed] = i
                pushed += 1
        if pushed > 0:
            guess, predicted = spare[0], spare[1]
            _sum_loads(shape, pushing, pushed, last_force, guess)
            _predict(
                predict[0],
                predict[1],
                predict[2],
                predict[3],
                guess[:size],
                guess[size:],
                load[:size],
                load[size:],
                modal[:size],
                modal[size:],
                predicted[:size],
                predicted[size:],
            )
        for u in range(kind.size):
            t = kind[u]
            begin = first[u]
            count = first[u + 1] - begin
            for a in range(count):
                i = begin + a
                x, old = position[n, i], last_place[i]
                own[i] = -now[t, a, a]
                gap[i] = state[u, wheelsets[t, a]] - roughness[n, i]
                for b in range(count):
                    gap[i] += before[t, a, b] * last_force[begin + b]
                    if b < a:
                        gap[i] += now[t, a, b] * force[n, begin + b]
                    elif b > a:
                        gap[i] += now[t, a, b] * last_force[begin + b]
                if 0.0 <= old <= length and outputs.shape[1] > 0:
                    at = (old - grid_start) / grid_step
                    cell = min(int(at), last_cell)
                    _feed(channel_feed[1, cell], at - cell, last_force[i], outputs[n])
                if not 0.0 <= x <= length:
                    force[n, i] = solve_contact(gap[i], own[i], linear[i], hertz[i])
                    continue
                at = (x - grid_start) / grid_step
                cell = min(int(at), last_cell)
                s = at - cell
                modes = _cubic(compliance[0, cell], s)
                gap[i] += modes * last_force[i] - _dot(shape[i], spare[1])
                own[i] += modes + _cubic(compliance[1, cell], s)
                f = solve_contact(gap[i], own[i], linear[i], hertz[i])
                force[n, i] = f
                _feed(channel_feed[0, cell], s, f, outputs[n])
            for a in range(count):
                i = begin + a
                f = force[n, i]
                closed = gap[i] - own[i] * f
                for b in range(a + 1, count):
                    closed += now[t, a, b] * (force[n, begin + b] - last_force[begin + b])
                worst = max(worst, abs(f - force_of(closed, linear[i], hertz[i])))
            for r in range(states[t]):
                total = constant[t, r] + _dot(transition[t, r, : states[t]], state[u, : states[t]])
                for a in range(count):
                    total += unit_drive[t, r, a] * force[n, begin + a]
                scratch[r] = total
            state[u, : states[t]] = scratch[: states[t]]
            for a in range(count):
                i = begin + a
                last_force[i] = force[n, i]
                last_place[i] = position[n, i]
                if 0.0 <= position[n, i] <= length:
                    if touching[i] and force[n, i] <= 0.0:
                        lost += 1
                    touching[i] = force[n, i] > 0.0
                else:
                    force[n, i] = np.nan
        _sum_loads(shape, pushing, pushed, last_force, load)
        _step_modes(
            decay[0],
            decay[1],
            drive[0],
            drive[1],
            load[:size],
            load[size:],
            modal[:size],
            modal[size:],
        )
        if row == history.shape[0] - 1 or n == position.shape[0] - 1:
            _observe(history[: row + 1], channel_weights, outputs[n - row : n + 1])
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
    size = tables.size
    decay = tables.decay[0] + 1j * tables.decay[1]
    drive = tables.drive[0] + 1j * tables.drive[1]
    now_weight = tables.predict[0] + 1j * tables.predict[1]
    last_weight = tables.predict[2] + 1j * tables.predict[3]
    p = load[:size] + 1j * load[size:]
    lost, worst = 0, 0.0

    def locate(x: float) -> tuple[int, Array]:
        at = (x - tables.grid_start) / tables.grid_step
        cell = min(int(at), len(tables.shapes) - 1)
        return cell, np.asarray((at - cell) ** np.arange(4), np.float64)

    def shape_at(x: float) -> Complex:
        cell, powers = locate(x)
        coefficients = tables.shapes[cell].reshape(4, 2, size).astype(np.float64)
        return np.asarray(powers @ coefficients[:, 0] + 1j * (powers @ coefficients[:, 1]))

    for n in range(len(position)):
        y = modal[:size] - 1j * modal[size:]
        outputs[n] = tables.channel_weights @ modal
        shapes = {i: shape_at(x) for i, x in enumerate(position[n]) if 0 <= x <= tables.length}
        guess = sum((fleet.force[i] * shape for i, shape in shapes.items()), np.zeros(size))
        q = y + now_weight * guess + last_weight * p
        p = np.zeros(size, dtype=np.complex128)
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
                fleet.transition[t, :states, :states] @ fleet.state[u, :states]
                + fleet.drive[t, :states, :count] @ new
                + fleet.constant[t, :states]
            )
            lost += int((on & fleet.touching[axles] & (new <= 0)).sum())
            fleet.touching[axles] = np.where(on, new > 0, fleet.touching[axles])
            fleet.force[axles], fleet.place[axles] = new, x
            force[n, axles] = np.where(on, new, np.nan)
        y = decay * y + drive * p
        modal[:size], modal[size:] = y.real, -y.imag
        load[:size], load[size:] = p.real, p.imag
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


class ModalRun:
    """A run by exponential stepping: the state of modes and units, advanced in chunks.

    Args:
        line: modes of the line.
        traffic: the trains.
        derivatives: 0, 1, 2 for displacement, velocity, acceleration of the channels.
        order: interpolation of forces in time, see :func:`modal_tables`.
        precision: of the rail shapes; single precision changes forces and accelerations by less
            than 1e-5 of their peaks and is a third faster.
        marching: :func:`march` or its readable twin.
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
    ) -> None:
        self.line = line
        self.traffic = traffic
        self.tables = modal_tables(
            line, traffic.step, derivatives, order=order, precision=precision
        )
        traffic.lay_ends(self._static_compliance)
        self.lost_contacts = 0
        self.equilibrium_residual = 0.0
        self._order = order
        self._march = marching
        self._derivatives = derivatives
        self._residual = one_sided_cubics(line.channel_residual)
        self._next = 0
        self._held: list[Array] = []
        self._modal: Array = np.zeros(2 * self.tables.size)
        self._load: Array = np.zeros(2 * self.tables.size)
        self._units: list[Running] = []
        self._loads: Array = np.zeros(0)
        self._fleet: Fleet | None = None
        self._steps: list[UnitStep] = []
        self._until = 0

    def _static_compliance(self, place: Array) -> Array:
        line = self.line
        kept = (line.weights * (line.rail(place) ** 2 / -line.eigenvalues).real).sum(axis=1)
        return np.asarray(kept + line.rail_residual(place))

    ratio = 1

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
        now, step = slice(2, -2), self.traffic.step
        h, g0, g1 = np.moveaxis(answer, 2, 0)

        def rate(values: Array, order: int) -> Array:
            a, b, c, d = values[:-4], values[1:-3], values[3:-1], values[4:]
            return (
                values[now],
                (c - b) / (2 * step),
                (c - 2 * values[now] + b) / step**2,
                (d - 2 * c + 2 * b - a) / (2 * step**3),
            )[order]

        signals = outputs[now]
        width = answer.shape[1]
        for number, derivative in enumerate(self._derivatives):
            columns = slice(number * width, (number + 1) * width)
            signals[:, columns] += rate(g0, derivative) + rate(g1, derivative + 1)
            if derivative > 0:
                signals[:, columns] += rate(h, derivative - 1)
        return time[now], position[now], force[now], signals

    def _march_on(self, samples: int) -> list[Array]:
        """Time, position, force, outputs of the kept modes, sums h, g0, g1 of :meth:`advance`."""
        time: Array = (self._next + np.arange(samples, dtype=np.float64)) * self.traffic.step
        position = self.traffic.position(time)
        force = np.full(position.shape, np.nan)
        outputs = np.empty((samples, len(self.tables.channel_weights)))
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
        lost, residual = self._march(
            self.tables, self._modal, self._load, self._fleet, place, roughness, own_force, outputs
        )
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

    def _check(self, time: Array, force: Array, outputs: Array) -> None:
        if self._units:
            limit = FORCE_LIMIT * self._loads
            bad = ~(np.nanmax(np.abs(force), axis=0, initial=0.0) <= limit)
            assert self._fleet is not None
            bad |= ~np.isfinite(self._fleet.force)
            if bad.any():
                axle = int(np.argmax(bad))
                value = np.nanmax(np.abs(np.append(force[:, axle], self._fleet.force[axle])))
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

    def _start(
        self, units: list[Running], position: Array, time: float
    ) -> tuple[list[Array], list[Array], list[Array]]:
        """Static start of units: state before the sample, forces and places of each."""
        if not units:
            return [], [], []
        places = [position[unit.columns] for unit in units]
        place = np.concatenate(places)
        roughness = self.traffic.roughness(units, place[np.newaxis], np.array([time]))[0]
        shapes = self.line.rail(place)
        weights = self.line.weights
        compliance = (shapes * (-weights / self.line.eigenvalues) @ shapes.T).real
        on_line = (place >= 0) & (place <= self.line.length)
        compliance += np.diag(self.line.rail_residual(place))
        whole = block_units([unit.unit for unit in units])
        law = np.concatenate([unit.law for unit in units], axis=1)
        rest, force = static_start(whole, law, compliance, roughness)
        if on_line.any():
            load = (shapes * np.sqrt(weights)).T @ force
            y = self.tables.start_weights[: len(load)] * load
            self._load[: len(load)] += load.real
            self._load[self.tables.size : self.tables.size + len(load)] += load.imag
            self._modal[: len(load)] += y.real
            self._modal[self.tables.size : self.tables.size + len(load)] -= y.imag
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
