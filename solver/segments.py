"""Long lines: segments with complex modes of their own, joined in time without making work.

Dense modes of a whole line cost the cube of its length to prepare and the square to keep, and every
wheelset meets all of them. A line that is cut into segments costs in proportion to its length. At a
cut every layer is severed between two fastenings, and the forces and moments that the deflections w
and rotations of both sides exchange are the unknowns. Within a step of length h they are linear and
free to jump between steps,

    lambda(t) = lambda_0 + lambda_1 (2 t/h - 1),

and the velocities on both sides agree in the mean and in the first moment:

    integral of (v_left - v_right) dt = 0,    integral of (v_left - v_right) (2 t/h - 1) dt = 0,

that is, displacements agree at the end of every step and in its mean. Then the work of lambda on
both sides is zero in every step whatever the segments do (a Galerkin method in time, as in the
discontinuous family of Lesaint and Raviart 1974), and because segments are stepped exactly and are
passive, the whole is stable for any step. It is of fourth order. Forces that are linear and
continuous, with displacements agreeing at the ends of steps only, are unstable; forces constant in
a step are stable and 6 to 60 % wrong.

The state y of :mod:`modal` becomes y + g0 phi lambda_0 + g1 phi lambda_1 at every sample, and the
mean over a step needs a second state z, so that its mean is z + (weight) p + g-terms.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg
from numba import njit
from numpy.typing import NDArray

from .beam import Array
from .contact import force_of, solve_contact
from .line import Structure, assemble, rail_cut
from .modal import (
    KERNEL,
    LANES,
    SLOW,
    Fleet,
    ModalRun,
    _step_unit,
    exponential_weights,
    modal_run,
)
from .modes import Complex, ModalLine, build_modal_line, cached_line
from .scenario import Scenario
from .traffic import Traffic

SEGMENT_LENGTH = 24.0
"""Length (m) at which segments aim at 5 kHz; the modes of a line number length * sqrt(limit)."""
WHOLE_LENGTH = 110.0
"""Length (m) at 5 kHz up to which a line is solved whole; there a step costs a third of what it
costs in segments, but the modes take 45 s and 1.2 GB."""
CUT_CLEARANCE = 2.0
"""Distance (m) that cuts keep, where they can, from bearings and channels."""
JOINT = 6
"""Coordinates that a cut severs: deflection and rotation of rail, slab and support layer."""
BLOCK = 2 * JOINT
"""Unknowns of a cut: a force or moment and its slope in the step for each."""


def find_cuts(scenario: Scenario) -> tuple[float, ...]:
    """Places (m) at which a long line is cut: bearings, and half-way along bays on subgrade.

    Spans are taken together up to about ``SEGMENT_LENGTH``, and never cut: a piece of a span would
    not be held. Short approaches stay with the span beside them.
    """
    stretch = math.sqrt(5000 / scenario.solution.frequency_limit)
    if scenario.line.length <= WHOLE_LENGTH * stretch or scenario.solution.sines is not None:
        return ()
    return cut_into(scenario, SEGMENT_LENGTH * stretch)


def cut_into(scenario: Scenario, length: float) -> tuple[float, ...]:
    """Cuts (m) into segments of about a length (m)."""
    line = scenario.line
    stretches = [(0.0, line.length)]
    cuts: list[float] = []
    if line.spans:
        left, right = line.span_bounds[0][0], line.span_bounds[-1][1]
        stretches = [(0.0, left), (right, line.length)]
        begin = left if left >= length / 2 else 0.0
        cuts += [left] if begin else []
        for a, b in line.span_bounds:
            if b - begin > 1.25 * length and a > begin:
                cuts.append(a)
                begin = a
        if line.length - right >= length / 2:
            cuts.append(right)
    channels = np.array([scenario.channel_x(channel) for channel in scenario.channel])
    for a, b in stretches:
        pieces = round((b - a) / length)
        for even in np.linspace(a, b, pieces + 1)[1:-1] if pieces > 1 else []:
            places = rail_cut(scenario, even) + scenario.track.fastening.spacing * np.arange(-5, 6)
            distance = abs(np.subtract.outer(places, channels)).min(axis=1, initial=np.inf)
            cost = abs(places - even) + 10 * np.maximum(CUT_CLEARANCE - distance, 0)
            cuts.append(float(places[np.argmin(cost)]))
    return tuple(sorted(set(cuts)))


@dataclass(frozen=True, eq=False)
class SegmentedLine:
    """A line in segments, with what :class:`ModalRun` asks of a :class:`ModalLine`.

    Attributes:
        parts: S segments, from left to right.
        cuts: (S - 1,) of the rail (m).
        eigenvalues: of all parts, one after the other (1/s).
        channel_x, channel_residual, channel_band, length: as of a :class:`ModalLine`.
    """

    parts: tuple[ModalLine, ...]
    cuts: tuple[float, ...]
    eigenvalues: Complex
    channel_x: Array
    channel_residual: Array
    channel_band: Array
    length: float

    def where(self, x: Array) -> NDArray[np.int64]:
        """Number of the segment at each place (m)."""
        return np.searchsorted(self.cuts, x, side="right").astype(np.int64)


def segmented_line(scenario: Scenario, cuts: Sequence[float]) -> SegmentedLine:
    """Modes of all segments of a line, from the disk cache where they were solved before."""
    severed: list[Structure] = []

    def solve(number: int) -> ModalLine:
        if not severed:
            severed.append(assemble(scenario, cuts))
        return build_modal_line(severed[0].part(number))

    parts = tuple(
        cached_line(scenario, partial(solve, number), (*cuts, number))
        for number in range(len(cuts) + 1)
    )
    return SegmentedLine(
        parts=parts,
        cuts=tuple(rail_cut(scenario, x) for x in cuts),
        eigenvalues=np.concatenate([part.eigenvalues for part in parts]),
        channel_x=parts[0].channel_x,
        channel_residual=np.sum([part.channel_residual for part in parts], axis=0),
        channel_band=parts[0].channel_band,
        length=scenario.line.length,
    )


def mean_weights(eigenvalues: Complex, step: float, order: int) -> tuple[Complex, ...]:
    """Weights of the mean of q over a step, and of the cut forces at its end and in its mean.

    Returns:
        m, mn, ml, mb: mean of q = m q' + mn p + ml p' + mb p'' (m without unit, others s);
        g0, g1: q gains g0 lambda_0 + g1 lambda_1 (s); k0, k1: the same of its mean (s).

    The mean over the step of the response to (t/h)^j is h j! phi_{j+2}(lambda h).
    """
    z: Complex = eigenvalues * step
    decay: Complex = np.exp(z)
    phi = [decay]
    with np.errstate(divide="ignore", invalid="ignore"):
        for j in range(1, 5):
            phi.append((phi[-1] - 1 / math.factorial(j - 1)) / z)
    small = np.abs(z) < 1.5
    for j in range(1, 5):
        series = np.zeros_like(z)
        for m in range(28):
            series += z**m / math.factorial(m + j)
        phi[j] = np.where(small, series, phi[j])
    constant, linear, quadratic = step * phi[2], step * phi[3], 2 * step * phi[4]
    now, last, before = (quadratic + linear) / 2, constant - quadratic, (quadratic - linear) / 2
    slow = (np.abs(decay) < SLOW) | (order == 1)
    now, last = np.where(slow, linear, now), np.where(slow, constant - linear, last)
    before = np.where(slow, 0.0, before)
    g0, g1 = step * phi[1], step * (2 * phi[2] - phi[1])
    return phi[1], now, last, before, g0, g1, constant, 2 * linear - constant


@dataclass(frozen=True, eq=False)
class SegmentTables:
    """Segments made ready for one step length; weights are folded into shapes as square roots.

    Modes of a segment are padded to K, a multiple of 16; vectors hold re and im of its modes, then
    those of the next segment.

    Attributes:
        first: (S + 1,) first value of each segment in the vectors; it has 2 K of them.
        cell: (S + 1,) first cell of each segment. shape: (S,) its first value in ``shapes``.
        shapes: cubic coefficients of the rail shapes, (cells, 4, 2 K) of one segment after another.
        joint: (S,) first value of each segment in ``joints``.
        joints: shapes of the severed coordinates, (J, 2 K) of one segment after the other, the
            right-hand side of a cut with opposite sign.
        sizes: (S, 2) severed coordinates at the left and right end of each segment.
        vectors: (10, N) weights of modes (complex as re, im): E, d, a, -c/E of :mod:`modal`;
            g0, g1 (:func:`mean_weights`); the mean's of q, p, p' and p''.
        compliance: (cells, 2, 4) cubics of the rail's displacement per new force, joined, and of
            the residual compliance (m/N).
        reaction: (cells, 4, 4, 12) cubics of: displacement at a wheelset per lambda_0 and lambda_1,
            displacement at the severed coordinates per force, at the end of a step and in its mean.
        inner, lower, upper: (S - 1, 12, 12) factors of the matrix of the cuts.
        channel_segment: (O,) of the displacements of the C channels and then of what each owes to
            accelerations; channel_first: (O,) first value in ``channel_weights``.
        channel_weights: of each output, (2 K,).
        channel_feed: (cells, 2, 4, O) as in :class:`ModalTables`.
        grid_start: (S,). grid_step, length: m.
    """

    first: NDArray[np.int64]
    cell: NDArray[np.int64]
    shape: NDArray[np.int64]
    shapes: NDArray[np.floating]
    joint: NDArray[np.int64]
    joints: NDArray[np.floating]
    sizes: NDArray[np.int64]
    vectors: Array
    compliance: Array
    reaction: Array
    inner: Array
    lower: Array
    upper: Array
    channel_segment: NDArray[np.int64]
    channel_first: NDArray[np.int64]
    channel_weights: Array
    channel_feed: Array
    grid_start: Array
    grid_step: float
    length: float


def _packed(values: Complex, size: int) -> Array:
    """(..., K) complex to (..., 2 size) re then im."""
    out = np.zeros((*values.shape[:-1], 2 * size))
    out[..., : values.shape[-1]] = values.real
    out[..., size : size + values.shape[-1]] = values.imag
    return out


def segment_tables(
    line: SegmentedLine,
    step: float,
    *,
    order: int = 2,
    precision: type[np.floating] = np.float32,
) -> SegmentTables:
    """Tables for a time step (s)."""
    parts = line.parts
    count = len(parts)
    sizes = np.zeros((count, 2), np.int64)
    sizes[:-1, 1] = sizes[1:, 0] = JOINT
    padded = [-(-len(part.eigenvalues) // LANES) * LANES for part in parts]
    cells = [len(part.rail_shapes) for part in parts]
    blocks = np.zeros((3, max(count - 1, 0), BLOCK, BLOCK))
    shapes, joints, vectors, compliance, reaction = [], [], [], [], []
    outputs = 2 * len(line.channel_x)
    segment = np.zeros(outputs, np.int64)
    weights: list[Array] = [np.zeros(2 * padded[0])] * outputs
    feeds: list[Array] = []
    thirds = np.vander(np.arange(4) / 3, increasing=True)
    for s, (part, size) in enumerate(zip(parts, padded, strict=True)):
        lam, root = part.eigenvalues, np.sqrt(part.weights)
        decay, now, last, before = exponential_weights(lam, step, order)
        recall = -before / decay
        m, mn, ml, mb, g0, g1, k0, k1 = mean_weights(lam, step, order)
        rail = part.rail_shapes * root
        joint: Complex = part.joint_shapes * root
        joint[sizes[s, 0] :] *= -1
        # both directions take the same rounded numbers, or work would be made
        rounded = _packed(joint, size).astype(precision)
        joints.append(rounded.ravel())
        joint = rounded[:, : len(lam)] + 1j * rounded[:, size : size + len(lam)].astype(float)
        shapes.append(_packed(rail, size).astype(precision).ravel())
        drive = decay * now + last - recall
        means = (m, m * now + ml, m * recall + mb)
        vectors.append(_packed(np.stack([decay, drive, now, recall, g0, g1, *means, mn]), size))
        own = np.stack([((thirds @ rail) ** 2 @ now).real, np.zeros(rail.shape[:2])], axis=1)
        own[:, 0] = own[:, 0] @ np.linalg.inv(thirds).T
        own[:, 1] = part.residual
        compliance.append(own)
        pair = np.zeros((len(rail), 4, 4, BLOCK))
        side = len(joint)
        for row, factor in enumerate((g0, g1, now, mn)):
            pair[:, :, row, :side] = (rail @ (joint * factor).T).real
        reaction.append(pair)
        gram = np.array(
            [[((joint * f) @ joint.T).real for f in row] for row in ((g0, g1), (k0, k1))]
        )
        left = sizes[s, 0]
        for a, b, first, second in (
            (s - 1, s - 1, slice(0, left), slice(0, left)),
            (s, s, slice(left, side), slice(left, side)),
            (s, s - 1, slice(left, side), slice(0, left)),
            (s - 1, s, slice(0, left), slice(left, side)),
        ):
            if min(a, b) < 0 or max(a, b) >= count - 1:
                continue
            # diagonal, lower (row cut below), upper
            kind, at = (0, a) if a == b else ((1, a) if a > b else (2, a))
            half = BLOCK // 2
            for i in range(2):
                for j in range(2):
                    block = gram[i, j][first, second]
                    target = blocks[kind, at, i * half :, j * half :]
                    target[: block.shape[0], : block.shape[1]] += block
        motion = part.channel_shapes - part.channel_inertia * lam**2
        channel: Complex = np.concatenate([motion, part.channel_inertia]) * root
        feeds.append(
            np.stack([(rail @ (channel * factor).T).real for factor in (now, recall)], axis=1)
        )
        for c in np.flatnonzero(abs(channel).max(axis=1, initial=0.0) > 0):
            segment[c], weights[c] = s, _packed(channel[c], size)
    inner, lower, upper = _factor(blocks)
    tables = SegmentTables(
        first=np.cumsum([0, *(2 * size for size in padded)]),
        cell=np.cumsum([0, *cells]),
        shape=np.cumsum([0, *(len(part) for part in shapes)])[:-1],
        shapes=np.concatenate(shapes),
        joint=np.cumsum([0, *(len(part) for part in joints)])[:-1],
        joints=np.concatenate(joints),
        sizes=sizes,
        vectors=np.concatenate(vectors, axis=1),
        compliance=np.concatenate(compliance),
        reaction=np.concatenate(reaction),
        inner=inner,
        lower=lower,
        upper=upper,
        channel_segment=segment,
        channel_first=np.cumsum([0, *(len(row) for row in weights)])[:-1],
        channel_weights=np.concatenate([np.zeros(0), *weights]),
        channel_feed=np.concatenate(feeds),
        grid_start=np.array([part.grid_start for part in parts]),
        grid_step=parts[0].grid_step,
        length=line.length,
    )
    _join_compliance(tables, blocks, thirds)
    return tables


def _factor(blocks: Array) -> tuple[Array, ...]:
    """Transposed factors of a block-tridiagonal matrix.

    Forward f -= lower f_before, then backward x = inner f - upper x_next.
    """
    diagonal, below, above = blocks
    inner, lower, upper = np.zeros_like(diagonal), np.zeros_like(diagonal), np.zeros_like(diagonal)
    for c in range(len(diagonal)):
        pivot = diagonal[c].copy()
        if c:
            lower[c] = below[c] @ inner[c - 1]
            pivot -= lower[c] @ above[c - 1]
        inner[c] = np.linalg.inv(pivot)
        upper[c] = inner[c] @ above[c]
    return tuple(np.ascontiguousarray(part.swapaxes(1, 2)) for part in (inner, lower, upper))


def _join_compliance(tables: SegmentTables, blocks: Array, thirds: Array) -> None:
    """Take the reaction of the cuts off the rail's displacement per new force, in place."""
    diagonal, below, above = blocks
    half = BLOCK // 2
    inverse = np.linalg.inv(thirds).T
    for s in range(len(tables.sizes)):
        cuts = [c for c in range(s - 3, s + 3) if 0 <= c < len(diagonal)]
        matrix = np.zeros((len(cuts), BLOCK, len(cuts), BLOCK))
        for i, c in enumerate(cuts):
            matrix[i, :, i] = diagonal[c]
            if i:
                matrix[i, :, i - 1], matrix[i - 1, :, i] = below[c], above[c - 1]
        flat = matrix.reshape(len(cuts) * BLOCK, -1)
        full = np.linalg.inv(flat)
        left, right = tables.sizes[s]
        rows = []
        for c, size in ((s - 1, left), (s, right)):
            if size:
                at = cuts.index(c) * BLOCK
                rows += list(range(at, at + size))
        ends = np.array(rows, int)
        both = np.r_[ends, ends + half]
        reduced = full[np.ix_(both, both)]
        cell = slice(tables.cell[s], tables.cell[s + 1])
        side = left + right
        there = tables.reaction[cell][..., :side]
        at_thirds = np.einsum("tp,cpkj->ctkj", thirds, there)
        wheel = np.concatenate([at_thirds[:, :, 0], at_thirds[:, :, 1]], axis=-1)
        joint = np.concatenate([at_thirds[:, :, 2], at_thirds[:, :, 3]], axis=-1)
        reaction = np.einsum("cti,ij,ctj->ct", wheel, reduced, joint)
        tables.compliance[cell, 0] -= reaction @ inverse


@njit(**KERNEL)
def _shape_at(c0, c1, c2, c3, s, shape):  # type: ignore[no-untyped-def]
    for k in range(shape.size):
        shape[k] = c0[k] + s * (c1[k] + s * (c2[k] + s * c3[k]))


@njit(**KERNEL)
def _add(shape, force, load):  # type: ignore[no-untyped-def]
    for k in range(load.size):
        load[k] += force * shape[k]


@njit(**KERNEL)
def _dot(a, b):  # type: ignore[no-untyped-def]
    total = 0.0
    for k in range(a.size):
        total += a[k] * b[k]
    return total


@njit(**KERNEL)
def _dot_six(a, b, c, d, e, f, x, y, p, q):  # type: ignore[no-untyped-def]
    """p += rows on x, q += rows on y, for the six rows of a joint."""
    p0, p1, p2, p3, p4, p5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    q0, q1, q2, q3, q4, q5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(a.size):
        u, v = x[k], y[k]
        p0 += a[k] * u
        p1 += b[k] * u
        p2 += c[k] * u
        p3 += d[k] * u
        p4 += e[k] * u
        p5 += f[k] * u
        q0 += a[k] * v
        q1 += b[k] * v
        q2 += c[k] * v
        q3 += d[k] * v
        q4 += e[k] * v
        q5 += f[k] * v
    p[0] += p0
    p[1] += p1
    p[2] += p2
    p[3] += p3
    p[4] += p4
    p[5] += p5
    q[0] += q0
    q[1] += q1
    q[2] += q2
    q[3] += q3
    q[4] += q4
    q[5] += q5


@njit(**KERNEL)
def _add_six(a, b, c, d, e, f, p, q, x, y):  # type: ignore[no-untyped-def]
    """x += p on rows, y += q on rows, for the six rows of a joint."""
    p0, p1, p2, p3, p4, p5 = p[0], p[1], p[2], p[3], p[4], p[5]
    q0, q1, q2, q3, q4, q5 = q[0], q[1], q[2], q[3], q[4], q[5]
    for k in range(a.size):
        x[k] += p0 * a[k] + p1 * b[k] + p2 * c[k] + p3 * d[k] + p4 * e[k] + p5 * f[k]
        y[k] += q0 * a[k] + q1 * b[k] + q2 * c[k] + q3 * d[k] + q4 * e[k] + q5 * f[k]


@njit(**KERNEL)
def _turn(w_re, w_im, p, q, re, im):  # type: ignore[no-untyped-def]
    """Add weight times load to a state that holds -im."""
    for k in range(re.size):
        re[k] += w_re[k] * p[k] - w_im[k] * q[k]
        im[k] -= w_re[k] * q[k] + w_im[k] * p[k]


@njit(**KERNEL)
def _turn_pair(a_re, a_im, b_re, b_im, p, q, r, s, re, im):  # type: ignore[no-untyped-def]
    for k in range(re.size):
        re[k] += a_re[k] * p[k] - a_im[k] * q[k] + b_re[k] * r[k] - b_im[k] * s[k]
        im[k] -= a_re[k] * q[k] + a_im[k] * p[k] + b_re[k] * s[k] + b_im[k] * r[k]


@njit(**KERNEL)
def _carry(e_re, e_im, m_re, m_im, re, im, z_re, z_im):  # type: ignore[no-untyped-def]
    """z = m y, y = E y."""
    for k in range(re.size):
        x, y = re[k], im[k]
        z_re[k] = m_re[k] * x + m_im[k] * y
        z_im[k] = m_re[k] * y - m_im[k] * x
        re[k] = e_re[k] * x + e_im[k] * y
        im[k] = e_re[k] * y - e_im[k] * x


@njit(**KERNEL)
def _cubics(c, s, out):  # type: ignore[no-untyped-def]
    for j in range(out.shape[0]):
        for k in range(out.shape[1]):
            out[j, k] = c[0, j, k] + s * (c[1, j, k] + s * (c[2, j, k] + s * c[3, j, k]))


@njit(**KERNEL)
def _cubic(c, s):  # type: ignore[no-untyped-def]
    return c[0] + s * (c[1] + s * (c[2] + s * c[3]))


@njit(**KERNEL)
def _feed(c, s, force, out):  # type: ignore[no-untyped-def]
    for o in range(out.size):
        out[o] += force * (c[0, o] + s * (c[1, o] + s * (c[2, o] + s * c[3, o])))


@njit(**KERNEL)
def _subtract_product(matrix, x, out):  # type: ignore[no-untyped-def]
    """out -= x @ matrix, row by row of the matrix."""
    for j in range(x.size):
        factor = x[j]
        for i in range(out.size):
            out[i] -= factor * matrix[j, i]


@njit(**KERNEL)
def _solve(inner, lower, upper, right, spare, cut):  # type: ignore[no-untyped-def]
    """cut = -(matrix of the cuts)^-1 right; the factors are transposed."""
    count = right.shape[0]
    for c in range(count):
        spare[c] = right[c]
        if c > 0:
            _subtract_product(lower[c], spare[c - 1], spare[c])
    for c in range(count - 1, -1, -1):
        cut[c] = 0.0
        _subtract_product(inner[c], spare[c], cut[c])
        if c < count - 1:
            _subtract_product(upper[c], cut[c + 1], cut[c])


@njit(**KERNEL)
def _march(  # type: ignore[no-untyped-def]
    first,
    first_cell,
    first_shape,
    shapes,
    first_joint,
    joints,
    sizes,
    vectors,
    compliance,
    reaction,
    inner,
    lower,
    upper,
    channel_segment,
    channel_first,
    channel_weights,
    channel_feed,
    grid_start,
    grid_step,
    length,
    modal,
    mean,
    load,
    segment,
    shape,
    kind,
    axle_first,
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
    position,
    roughness,
    force,
    outputs,
):
    parts, axles = sizes.shape[0], position.shape[1]
    cuts, half = parts - 1, inner.shape[1] // 2
    width = first[parts]
    lost, worst = 0, 0.0
    guess, next_load = np.zeros(width), np.zeros(width)
    predicted, predicted_mean = np.zeros(width), np.zeros(width)
    zeroth, slope = np.zeros(width), np.zeros(width)
    right, spare = np.zeros((cuts, 2 * half)), np.zeros((cuts, 2 * half))
    cut = np.zeros((cuts, 2 * half))
    gap, own, displacement = np.zeros(axles), np.zeros(axles), np.zeros(axles)
    at, place, on = np.zeros(axles, np.int64), np.zeros(axles), np.zeros(axles, np.bool_)
    react = np.zeros((axles, 4, 2 * half))
    scratch = np.empty(state.shape[1])
    loaded, busy = np.zeros(parts, np.bool_), np.zeros(parts, np.bool_)
    for s in range(parts):
        for k in range(first[s], first[s + 1]):
            if load[k] != 0.0:
                loaded[s] = True
    for n in range(position.shape[0]):
        outputs[n] = 0.0
        busy[:] = loaded
        any_on = False
        for i in range(axles):
            x = position[n, i]
            on[i] = 0.0 <= x <= length
            if on[i]:
                any_on = True
                s = segment[i]
                busy[s] = True
                w = first[s + 1] - first[s]
                exact = (x - grid_start[s]) / grid_step
                cell = min(max(int(exact), 0), first_cell[s + 1] - first_cell[s] - 1)
                at[i], place[i] = first_cell[s] + cell, exact - cell
                c = shapes[first_shape[s] + 4 * w * cell : first_shape[s] + 4 * w * (cell + 1)]
                _shape_at(
                    c[:w],
                    c[w : 2 * w],
                    c[2 * w : 3 * w],
                    c[3 * w :],
                    shapes.dtype.type(place[i]),
                    shape[i, :w],
                )
                _cubics(reaction[at[i]], place[i], react[i])
        right[:] = 0.0
        for s in range(parts):
            a, b = first[s], first[s + 1]
            w, h = b - a, (first[s + 1] - first[s]) // 2
            here, here_mean = modal[a:b], mean[a:b]
            if busy[s]:
                guess[a:b] = 0.0
                for i in range(axles):
                    if on[i] and segment[i] == s:
                        _add(shape[i, :w], last_force[i], guess[a:b])
                predicted[a:b] = modal[a:b]
                predicted_mean[a:b] = mean[a:b]
                here, here_mean = predicted[a:b], predicted_mean[a:b]
                v = vectors[:, a:b]
                p, q = guess[a : a + h], guess[a + h : b]
                _turn_pair(
                    v[2, :h],
                    v[2, h:],
                    v[3, :h],
                    v[3, h:],
                    p,
                    q,
                    load[a : a + h],
                    load[a + h : b],
                    here[:h],
                    here[h:],
                )
                _turn(v[9, :h], v[9, h:], p, q, here_mean[:h], here_mean[h:])
                for i in range(axles):
                    if on[i] and segment[i] == s:
                        displacement[i] = _dot(shape[i, :w], here)
            j = first_joint[s]
            for c in range(max(s - 1, 0), min(s + 1, cuts)):
                _dot_six(
                    joints[j : j + w],
                    joints[j + w : j + 2 * w],
                    joints[j + 2 * w : j + 3 * w],
                    joints[j + 3 * w : j + 4 * w],
                    joints[j + 4 * w : j + 5 * w],
                    joints[j + 5 * w : j + 6 * w],
                    here,
                    here_mean,
                    right[c, :half],
                    right[c, half:],
                )
                j += 6 * w
        _solve(inner, lower, upper, right, spare, cut)
        for u in range(kind.size):
            t = kind[u]
            begin = axle_first[u]
            count = axle_first[u + 1] - begin
            for a in range(count):
                i = begin + a
                old = last_place[i]
                s = segment[i]
                own[i] = -now[t, a, a]
                gap[i] = state[u, wheelsets[t, a]] - roughness[n, i]
                for b in range(count):
                    gap[i] += before[t, a, b] * last_force[begin + b]
                    if b < a:
                        gap[i] += now[t, a, b] * force[n, begin + b]
                    elif b > a:
                        gap[i] += now[t, a, b] * last_force[begin + b]
                if 0.0 <= old <= length:
                    exact = (old - grid_start[s]) / grid_step
                    cell = min(max(int(exact), 0), first_cell[s + 1] - first_cell[s] - 1)
                    _feed(
                        channel_feed[first_cell[s] + cell, 1],
                        exact - cell,
                        last_force[i],
                        outputs[n],
                    )
                if not on[i]:
                    force[n, i] = solve_contact(gap[i], own[i], linear[i], hertz[i])
                    continue
                moved = displacement[i]
                j = 0
                for side in range(2):
                    for row in range(sizes[s, side]):
                        c = s - 1 + side
                        moved += react[i, 0, j] * cut[c, row] + react[i, 1, j] * cut[c, half + row]
                        j += 1
                modes = _cubic(compliance[at[i], 0], place[i])
                gap[i] += modes * last_force[i] - moved
                own[i] += modes + _cubic(compliance[at[i], 1], place[i])
                f = solve_contact(gap[i], own[i], linear[i], hertz[i])
                force[n, i] = f
                _feed(channel_feed[at[i], 0], place[i], f, outputs[n])
                j = 0
                for side in range(2):
                    for row in range(sizes[s, side]):
                        c = s - 1 + side
                        right[c, row] += react[i, 2, j] * (f - last_force[i])
                        right[c, half + row] += react[i, 3, j] * (f - last_force[i])
                        j += 1
            for a in range(count):
                i = begin + a
                f = force[n, i]
                closed = gap[i] - own[i] * f
                for b in range(a + 1, count):
                    closed += now[t, a, b] * (force[n, begin + b] - last_force[begin + b])
                worst = max(worst, abs(f - force_of(closed, linear[i], hertz[i])))
            _step_unit(
                transition,
                unit_drive,
                constant,
                t,
                states[t],
                begin,
                count,
                force,
                n,
                u,
                state,
                scratch,
            )
            for a in range(count):
                i = begin + a
                last_force[i] = force[n, i]
                last_place[i] = position[n, i]
                if on[i]:
                    if touching[i] and force[n, i] <= 0.0:
                        lost += 1
                    touching[i] = force[n, i] > 0.0
                else:
                    force[n, i] = np.nan
        if any_on:
            _solve(inner, lower, upper, right, spare, cut)
        for s in range(parts):
            a, b = first[s], first[s + 1]
            w, h = b - a, (first[s + 1] - first[s]) // 2
            v, m = vectors[:, a:b], first[s] + (first[s + 1] - first[s]) // 2
            zeroth[a:b] = 0.0
            slope[a:b] = 0.0
            j = first_joint[s]
            for c in range(max(s - 1, 0), min(s + 1, cuts)):
                _add_six(
                    joints[j : j + w],
                    joints[j + w : j + 2 * w],
                    joints[j + 2 * w : j + 3 * w],
                    joints[j + 3 * w : j + 4 * w],
                    joints[j + 4 * w : j + 5 * w],
                    joints[j + 5 * w : j + 6 * w],
                    cut[c, :half],
                    cut[c, half:],
                    zeroth[a:b],
                    slope[a:b],
                )
                j += 6 * w
            _turn_pair(
                v[4, :h],
                v[4, h:],
                v[5, :h],
                v[5, h:],
                zeroth[a:m],
                zeroth[m:b],
                slope[a:m],
                slope[m:b],
                modal[a:m],
                modal[m:b],
            )
        for o in range(outputs.shape[1]):
            s, k = channel_segment[o], channel_first[o]
            a, b = first[s], first[s + 1]
            outputs[n, o] += _dot(channel_weights[k : k + b - a], modal[a:b])
        for s in range(parts):
            a, b = first[s], first[s + 1]
            w, h = b - a, (first[s + 1] - first[s]) // 2
            m = a + h
            v = vectors[:, a:b]
            _carry(
                v[0, :h],
                v[0, h:],
                v[6, :h],
                v[6, h:],
                modal[a:m],
                modal[m:b],
                mean[a:m],
                mean[m:b],
            )
            if not busy[s]:
                continue
            next_load[a:b] = 0.0
            loaded[s] = False
            for i in range(axles):
                if on[i] and segment[i] == s:
                    loaded[s] = True
                    _add(shape[i, :w], force[n, i], next_load[a:b])
            _turn(
                v[1, :h],
                v[1, h:],
                next_load[a:m],
                next_load[m:b],
                modal[a:m],
                modal[m:b],
            )
            _turn_pair(
                v[7, :h],
                v[7, h:],
                v[8, :h],
                v[8, h:],
                next_load[a:m],
                next_load[m:b],
                load[a:m],
                load[m:b],
                mean[a:m],
                mean[m:b],
            )
            load[a:b] = next_load[a:b]
    return lost, worst


class SegmentRun(ModalRun):
    """A run on a line in segments, with the interface of :class:`ModalRun`.

    A wheelset acts on one segment. At the first sample beyond a cut it is handed over: what its
    force does to the modes, from that sample on, is moved from one segment to the next, so that
    the force on the joined line is interpolated as if there were no cut.
    """

    line: SegmentedLine  # type: ignore[assignment]
    tables: SegmentTables  # type: ignore[assignment]

    def __init__(
        self,
        line: SegmentedLine,
        traffic: Traffic,
        derivatives: tuple[int, ...],
        *,
        order: int = 2,
        precision: type[np.floating] = np.float32,
    ) -> None:
        self._rest_joint = _StaticJoint(line)
        self._weights = [
            (
                exponential_weights(part.eigenvalues, traffic.step, order),
                mean_weights(part.eigenvalues, traffic.step, order),
            )
            for part in line.parts
        ]
        super().__init__(
            line,  # type: ignore[arg-type]
            traffic,
            derivatives,
            order=order,
            precision=precision,
            marching=self._march_segments,
        )
        self._mean: Array = np.zeros(len(self._modal))
        self._seen: Fleet | None = None
        self._before: tuple[Array, Array] = (np.zeros(0), np.zeros(0))

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on what limits the result."""
        parts = len(self.line.parts)
        return (
            f"line of {self.line.length:g} m in {parts} segments: within 1 % of one whole line to "
            "0.4 of solution.frequency_limit; at the limit wheel force within 1 %, rail and slab "
            "beside a cut 10 %; wheel force at a cut 2 % of its range for a few steps",
        )

    def _prepare(self, derivatives: tuple[int, ...], order: int) -> None:
        self.tables = segment_tables(
            self.line, self.traffic.step, order=order, precision=self._precision
        )
        width = int(self.tables.first[-1])
        self._modal, self._load = np.zeros(width), np.zeros(width)

    @property
    def _outputs(self) -> int:
        return 2 * len(self.line.channel_x)

    def _signals(self, outputs: Array, answer: Array) -> Array:
        """Channel outputs of samples with two more on either side, by differences of fourth order.

        The cut forces between samples are good in their mean only, and q' = lambda q + p needs
        them at the samples; displacements are as good as the method.
        """
        step, now = self.traffic.step, slice(2, -2)

        def rate(values: Array, order: int) -> Array:
            a, b, c, d, e = (values[i : len(values) - 4 + i] for i in range(5))
            return (
                c,
                (a - 8 * b + 8 * d - e) / (12 * step),
                (16 * (b + d) - a - e - 30 * c) / (12 * step**2),
                (2 * b - a - 2 * d + e) / (2 * step**3),
                (a - 4 * b + 6 * c - 4 * d + e) / step**4,
            )[order]

        motion, inertia = np.split(outputs, 2, axis=1)
        signals = [
            rate(motion + answer[:, :, 1], order)
            + rate(answer[:, :, 2], order + 1)
            + rate(inertia, order + 2)
            for order in self._derivatives
        ]
        return np.concatenate([np.zeros((len(outputs[now]), 0)), *signals], axis=1)

    def _static_shapes(self, place: Array) -> list[tuple[NDArray[np.intp], Complex]]:
        """Of each segment: which places (m) lie on it, and the rail's shapes there."""
        number = self.line.where(place)
        on = (place >= 0) & (place <= self.line.length)
        chosen = [np.flatnonzero((number == s) & on) for s in range(len(self.line.parts))]
        return [
            (at, part.rail(place[at])) for at, part in zip(chosen, self.line.parts, strict=True)
        ]

    def _joint_motion(self, shapes: list[tuple[NDArray[np.intp], Complex]], count: int) -> Array:
        """Static displacement of all severed coordinates per force at the places: (J, count)."""
        rows = []
        for s, (at, phi) in enumerate(shapes):
            part = self.line.parts[s]
            block = np.zeros((len(part.joint_shapes), count))
            static = part.joint_shapes * (part.weights / -part.eigenvalues)
            block[:, at] = (static @ phi.T).real
            rows.append(block)
        return np.concatenate([a[-JOINT:] - b[:JOINT] for a, b in pairwise(rows)])

    def _static_compliance(self, place: Array) -> Array:
        return np.array(self._compliance(place).diagonal())

    def _compliance(self, place: Array) -> Array:
        shapes = self._static_shapes(place)
        value = np.zeros((len(place), len(place)))
        for part, (at, phi) in zip(self.line.parts, shapes, strict=True):
            if len(at):
                own = (phi * (part.weights / -part.eigenvalues)) @ phi.T
                value[np.ix_(at, at)] = own.real + np.diag(part.rail_residual(place[at]))
        motion = self._joint_motion(shapes, len(place))
        value -= motion.T @ self._rest_joint.solve(motion)
        return value

    def _rest(self, place: Array, force: Array) -> None:
        """Add the state at rest under forces (N) at places (m)."""
        shapes = self._static_shapes(place)
        cut = -self._rest_joint.solve(self._joint_motion(shapes, len(place)) @ force)
        last_part = len(self.line.parts) - 1
        for s, (part, (at, phi)) in enumerate(zip(self.line.parts, shapes, strict=True)):
            (decay, now, _, before), (_, mn, _, _, g0, _, k0, _) = self._weights[s]
            lam, root = part.eigenvalues, np.sqrt(part.weights)
            load = root * (phi.T @ force[at])
            joint = np.zeros(len(lam), complex)
            if s:
                joint -= part.joint_shapes[:JOINT].T @ cut[(s - 1) * JOINT : s * JOINT]
            if s < last_part:
                joint += part.joint_shapes[-JOINT:].T @ cut[s * JOINT : (s + 1) * JOINT]
            joint *= root
            self._put(self._load, s, load)
            y = (-1 / lam - now + before / decay) * load + (-1 / lam - g0) * joint
            self._put(self._modal, s, y.conj())
            self._put(self._mean, s, ((-1 / lam - mn) * load + (-1 / lam - k0) * joint).conj())

    def _put(self, vector: NDArray[np.floating], segment: int, values: Complex) -> None:
        a, b = self.tables.first[segment : segment + 2]
        half = (b - a) // 2
        vector[a : a + len(values)] += values.real
        vector[a + half : a + half + len(values)] += values.imag

    def _march_segments(
        self,
        tables: SegmentTables,
        modal: Array,
        load: Array,
        fleet: Fleet,
        position: Array,
        roughness: Array,
        force: Array,
        outputs: Array,
    ) -> tuple[int, float]:
        """Advance by n samples, cut where a wheelset is handed over."""
        number = self.line.where(position)
        begin, lost, worst = 0, 0, 0.0
        segment = self.line.where(fleet.place)
        if self._seen is not fleet:
            self._seen, self._before = fleet, (fleet.force.copy(), fleet.place.copy())
        shape = np.empty((position.shape[1], int(np.diff(tables.first).max())), self._precision)
        while begin < len(position):
            change = (number[begin:] != segment).any(axis=1)
            stop = begin + int(np.argmax(change)) + 1 if change.any() else len(position)
            part = slice(begin, stop)
            before = fleet.force.copy(), fleet.place.copy()
            more, residual = _march(
                tables.first,
                tables.cell,
                tables.shape,
                tables.shapes,
                tables.joint,
                tables.joints,
                tables.sizes,
                tables.vectors,
                tables.compliance,
                tables.reaction,
                tables.inner,
                tables.lower,
                tables.upper,
                tables.channel_segment,
                tables.channel_first,
                tables.channel_weights,
                tables.channel_feed,
                tables.grid_start,
                tables.grid_step,
                tables.length,
                modal,
                self._mean,
                load,
                segment,
                shape,
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
                position[part],
                roughness[part],
                force[part],
                outputs[part],
            )
            if stop - begin > 1:
                before = np.nan_to_num(force[stop - 2]), position[stop - 2]
            self._before = before
            lost, worst = lost + int(more), max(worst, float(residual))
            for axle in np.flatnonzero(number[stop - 1] != segment):
                self._hand_over(fleet, int(axle), int(segment[axle]), int(number[stop - 1, axle]))
            segment = number[stop - 1].copy()
            begin = stop
        return lost, worst

    def _hand_over(self, fleet: Fleet, axle: int, old: int, new: int) -> None:
        """Move what a wheelset's last two forces still do to the modes to another segment."""
        forces = float(self._before[0][axle]), float(fleet.force[axle])
        places = float(self._before[1][axle]), float(fleet.place[axle])
        for s, sign in ((old, -1.0), (new, 1.0)):
            part = self.line.parts[s]
            (decay, _, last, before), (_, _, ml, mb, _, _, _, _) = self._weights[s]
            root = np.sqrt(part.weights)
            p1, p0 = (
                sign * f * root * part.rail(x)[0] for f, x in zip(forces, places, strict=True)
            )
            self._put(self._load, s, p0)
            self._put(self._modal, s, (before * p1 + (last + before / decay) * p0).conj())
            self._put(self._mean, s, (ml * p0 + mb * p1).conj())


class _StaticJoint:
    """Static compliance of the severed coordinates of a line, factored."""

    def __init__(self, line: SegmentedLine) -> None:
        count = JOINT * len(line.cuts)
        matrix = sp.lil_array((count, count))
        for s, part in enumerate(line.parts):
            shapes = part.joint_shapes.copy()
            shapes[: JOINT if s else 0] *= -1
            own = ((shapes * (part.weights / -part.eigenvalues)) @ shapes.T).real
            first = JOINT * max(s - 1, 0)
            rows = slice(first, first + len(own))
            matrix[rows, rows] = matrix[rows, rows] + own
        scale = 1 / np.sqrt(matrix.diagonal())
        self._scale = scale[:, None]
        scaled = sp.csc_matrix(sp.diags_array(scale) @ matrix.tocsr() @ sp.diags_array(scale))
        self._factor = scipy.sparse.linalg.splu(scaled)

    def solve(self, motion: Array) -> Array:
        """Cut forces (without sign) per motion (J, ...) of the severed coordinates."""
        scale = self._scale if motion.ndim == 2 else self._scale[:, 0]
        return np.asarray(scale * self._factor.solve(np.ascontiguousarray(scale * motion)))


def line_run(
    scenario: Scenario, traffic: Traffic, derivatives: tuple[int, ...], *, balance: bool
) -> ModalRun:
    """Run of a scenario's line: whole if it is short, else in segments, without energy balance."""
    cuts = find_cuts(scenario)
    if not cuts:
        return modal_run(scenario, traffic, derivatives, balance=balance)
    return SegmentRun(segmented_line(scenario, cuts), traffic, derivatives)
