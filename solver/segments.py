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
    _cubic,
    _feed,
    _step_unit,
    aligned,
    exponential_weights,
    modal_run,
)
from .modes import Complex, ModalLine, build_modal_line, cached_line
from .scenario import Scenario
from .traffic import Traffic

SEGMENT_LENGTH = 24.0
"""Length (m) at which segments aim at 5 kHz; the modes of a line number length * sqrt(limit)."""
WHOLE_LENGTH = 110.0
"""Length (m) at 5 kHz up to which a line is solved whole; there a step costs half to four fifths of
what it costs in segments, but the modes take 45 s and 1.2 GB, in segments 5 s."""
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

    Modes of a segment are padded to a multiple of 32, and to K of the largest where arrays hold
    all segments; a complex value takes two places, re and im.

    Attributes:
        size: (S,) modes of each segment, padded.
        cell: (S + 1,) first cell of each segment. shape: (S,) its first value in ``shapes``.
        shapes: cubic coefficients of the rail shapes, (cells, 4, 2, size) of one segment after
            another.
        joints: (S, 12, 2, K) shapes of the severed coordinates at the left and right end of each
            segment, the right-hand side of a cut with opposite sign; zero at the ends of the line.
        vectors: (S, 9, 2, K) weights of modes: E; the mean's of y; g1 (:func:`mean_weights`); d;
            the mean's of p' and p'' of the step to come; a and -c/E of :mod:`modal`; the mean's of
            p.
        compliance: (cells, 2, 4) cubics of the rail's displacement per new force, joined, and of
            the residual compliance (m/N).
        reaction: (cells, 4, 4, 12) cubics of: displacement at a wheelset per lambda_0 and lambda_1,
            displacement at the severed coordinates per force, at the end of a step and in its mean.
        inner, lower, upper: (S - 1, 12, 12) factors of the matrix of the cuts.
        channel_segment: (O,) of the displacements of the C channels and then of what each owes to
            accelerations; -1 if there is nothing.
        channel_weights: (O, 2, K).
        channel_feed: (cells, 2, 4, O) as in :class:`ModalTables`.
        grid_start: (S,). grid_step, length, step: m, m, s.
    """

    size: NDArray[np.int64]
    cell: NDArray[np.int64]
    shape: NDArray[np.int64]
    shapes: NDArray[np.floating]
    joints: NDArray[np.floating]
    vectors: Array
    compliance: Array
    reaction: Array
    inner: Array
    lower: Array
    upper: Array
    channel_segment: NDArray[np.int64]
    channel_weights: NDArray[np.floating]
    channel_feed: Array
    grid_start: Array
    grid_step: float
    length: float
    step: float


def _packed(values: Complex, size: int) -> Array:
    """(..., K) complex to (..., 2, size), re and im."""
    out = np.zeros((*values.shape[:-1], 2, size))
    out[..., 0, : values.shape[-1]] = values.real
    out[..., 1, : values.shape[-1]] = values.imag
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
    padded = [-(-len(part.eigenvalues) // LANES) * LANES for part in parts]
    largest = max(padded)
    cells = [len(part.rail_shapes) for part in parts]
    blocks = np.zeros((3, max(count - 1, 0), BLOCK, BLOCK))
    shapes, compliance, reaction, feeds = [], [], [], []
    joints = aligned((count, BLOCK, 2, largest), precision)
    vectors = aligned((count, 9, 2, largest), np.float64)
    outputs = 2 * len(line.channel_x)
    segment = np.full(outputs, -1, np.int64)
    weights = aligned((outputs, 2, largest), precision)
    thirds = np.vander(np.arange(4) / 3, increasing=True)
    for s, (part, size) in enumerate(zip(parts, padded, strict=True)):
        lam, root = part.eigenvalues, np.sqrt(part.weights)
        decay, now, last, before = exponential_weights(lam, step, order)
        recall = -before / decay
        m, mn, ml, mb, g0, g1, k0, k1 = mean_weights(lam, step, order)
        rail = part.rail_shapes * root
        joint: Complex = np.zeros((BLOCK, len(lam)), complex)
        joint[0 if s else JOINT : BLOCK if s < count - 1 else JOINT] = part.joint_shapes * root
        joint[JOINT:] *= -1
        # both directions take the same rounded numbers, or work would be made
        joints[s] = _packed(joint, largest)
        joint = joints[s, :, 0, : len(lam)] + 1j * joints[s, :, 1, : len(lam)].astype(float)
        shapes.append(_packed(rail, size).astype(precision).ravel())
        drive = decay * now + last - recall
        rows = (decay, m, g1, drive, m * now + ml, m * recall + mb, now, recall, mn)
        vectors[s] = _packed(np.stack(rows), largest)
        own = np.stack([((thirds @ rail) ** 2 @ now).real, np.zeros(rail.shape[:2])], axis=1)
        own[:, 0] = own[:, 0] @ np.linalg.inv(thirds).T
        own[:, 1] = part.residual
        compliance.append(own)
        pair = np.zeros((len(rail), 4, 4, BLOCK))
        for row, factor in enumerate((g0, g1, now, mn)):
            pair[:, :, row] = (rail @ (joint * factor).T).real
        reaction.append(pair)
        gram = np.array(
            [[((joint * f) @ joint.T).real for f in row] for row in ((g0, g1), (k0, k1))]
        )
        left, right = slice(0, JOINT), slice(JOINT, BLOCK)
        for a, b, first, second in (
            (s - 1, s - 1, left, left),
            (s, s, right, right),
            (s, s - 1, right, left),
            (s - 1, s, left, right),
        ):
            if min(a, b) < 0 or max(a, b) >= count - 1:
                continue
            # diagonal, lower (row cut below), upper
            kind, at = (0, a) if a == b else ((1, a) if a > b else (2, a))
            for i, end in enumerate((left, right)):
                for j, value in enumerate((left, right)):
                    blocks[kind, at, end, value] += gram[i, j][first, second]
        motion = part.channel_shapes - part.channel_inertia * lam**2
        channel: Complex = np.concatenate([motion, part.channel_inertia]) * root
        feeds.append(
            np.stack([(rail @ (channel * factor).T).real for factor in (now, recall)], axis=1)
        )
        for c in np.flatnonzero(abs(channel).max(axis=1, initial=0.0) > 0):
            segment[c], weights[c] = s, _packed(channel[c], largest)
    inner, lower, upper = _factor(blocks)
    tables = SegmentTables(
        size=np.array(padded),
        cell=np.cumsum([0, *cells]),
        shape=np.cumsum([0, *(len(part) for part in shapes)])[:-1],
        shapes=np.concatenate(shapes),
        joints=joints,
        vectors=vectors,
        compliance=np.concatenate(compliance),
        reaction=np.concatenate(reaction),
        inner=inner,
        lower=lower,
        upper=upper,
        channel_segment=segment,
        channel_weights=weights,
        channel_feed=np.concatenate(feeds),
        grid_start=np.array([part.grid_start for part in parts]),
        grid_step=parts[0].grid_step,
        length=line.length,
        step=step,
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
    for s in range(len(tables.size)):
        cuts = [c for c in range(s - 3, s + 3) if 0 <= c < len(diagonal)]
        matrix = np.zeros((len(cuts), BLOCK, len(cuts), BLOCK))
        for i, c in enumerate(cuts):
            matrix[i, :, i] = diagonal[c]
            if i:
                matrix[i, :, i - 1], matrix[i - 1, :, i] = below[c], above[c - 1]
        flat = matrix.reshape(len(cuts) * BLOCK, -1)
        full = np.linalg.inv(flat)
        own = [(c, half * side) for side, c in enumerate((s - 1, s)) if c in cuts]
        ends = np.array([cuts.index(c) * BLOCK + i for c, _ in own for i in range(half)], int)
        kept = np.array([first + i for _, first in own for i in range(half)], int)
        both = np.r_[ends, ends + half]
        reduced = full[np.ix_(both, both)]
        cell = slice(tables.cell[s], tables.cell[s + 1])
        there = tables.reaction[cell][..., kept]
        at_thirds = np.einsum("tp,cpkj->ctkj", thirds, there)
        wheel = np.concatenate([at_thirds[:, :, 0], at_thirds[:, :, 1]], axis=-1)
        joint = np.concatenate([at_thirds[:, :, 2], at_thirds[:, :, 3]], axis=-1)
        reaction = np.einsum("cti,ij,ctj->ct", wheel, reduced, joint)
        tables.compliance[cell, 0] -= reaction @ inverse


# As in modal, arrays come whole: a slice costs as much as the work on 100 modes.
@njit(**KERNEL)
def _add_shape(shapes, s, size, force, i, shape, load):  # type: ignore[no-untyped-def]
    """Rail shape of wheelset i, at s in a cell, and its load."""
    for part in range(2):
        for k in range(size):
            v = shapes[0, part, k] + s * (
                shapes[1, part, k] + s * (shapes[2, part, k] + s * shapes[3, part, k])
            )
            shape[i, part, k] = v
            load[part, k] += force * v


@njit(**KERNEL)
def _add_load(shape, i, size, force, load):  # type: ignore[no-untyped-def]
    for part in range(2):
        for k in range(size):
            load[part, k] += force * shape[i, part, k]


@njit(**KERNEL)
def _clear(values, size):  # type: ignore[no-untyped-def]
    for part in range(2):
        for k in range(size):
            values[part, k] = 0.0


@njit(**KERNEL)
def _dot(weights, i, size, values):  # type: ignore[no-untyped-def]
    total = 0.0
    for part in range(2):
        for k in range(size):
            total += weights[i, part, k] * values[part, k]
    return total


@njit(**KERNEL)
def _read_gaps(joints, s, first, size, here, here_mean, at, right, c):  # type: ignore[no-untyped-def]
    """Gaps of the six coordinates of a cut, at the end of a step and in its mean."""
    p0, p1, p2, p3, p4, p5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    q0, q1, q2, q3, q4, q5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for part in range(2):
        for k in range(size):
            u, v = here[at, part, k], here_mean[at, part, k]
            a, b = joints[s, first, part, k], joints[s, first + 1, part, k]
            d, e = joints[s, first + 2, part, k], joints[s, first + 3, part, k]
            f, g = joints[s, first + 4, part, k], joints[s, first + 5, part, k]
            p0 += a * u
            p1 += b * u
            p2 += d * u
            p3 += e * u
            p4 += f * u
            p5 += g * u
            q0 += a * v
            q1 += b * v
            q2 += d * v
            q3 += e * v
            q4 += f * v
            q5 += g * v
    right[c, 0] += p0
    right[c, 1] += p1
    right[c, 2] += p2
    right[c, 3] += p3
    right[c, 4] += p4
    right[c, 5] += p5
    right[c, 6] += q0
    right[c, 7] += q1
    right[c, 8] += q2
    right[c, 9] += q3
    right[c, 10] += q4
    right[c, 11] += q5


@njit(**KERNEL)
def _pull(joints, s, first, size, cut, c, keep, sums):  # type: ignore[no-untyped-def]
    """Modal loads of lambda_0 and lambda_1 of a cut; keep = 0 forgets what the sums held."""
    p0, p1, p2, p3, p4, p5 = cut[c, 0], cut[c, 1], cut[c, 2], cut[c, 3], cut[c, 4], cut[c, 5]
    q0, q1, q2, q3, q4, q5 = cut[c, 6], cut[c, 7], cut[c, 8], cut[c, 9], cut[c, 10], cut[c, 11]
    for part in range(2):
        for k in range(size):
            a, b = joints[s, first, part, k], joints[s, first + 1, part, k]
            d, e = joints[s, first + 2, part, k], joints[s, first + 3, part, k]
            f, g = joints[s, first + 4, part, k], joints[s, first + 5, part, k]
            zeroth = p0 * a + p1 * b + p2 * d + p3 * e + p4 * f + p5 * g
            slope = q0 * a + q1 * b + q2 * d + q3 * e + q4 * f + q5 * g
            sums[0, part, k] = keep * sums[0, part, k] + zeroth
            sums[1, part, k] = keep * sums[1, part, k] + slope


@njit(**KERNEL)
def _carry(vectors, s, size, step, sums, modal, mean, seen):  # type: ignore[no-untyped-def]
    """Cut forces on the state y, which ends its step; then z = m y, y = E y. All hold -im."""
    for k in range(size):
        p, q, r, t = sums[0, 0, k], sums[0, 1, k], sums[1, 0, k], sums[1, 1, k]
        a, b = vectors[s, 1, 0, k], vectors[s, 1, 1, k]
        c, d = vectors[s, 2, 0, k], vectors[s, 2, 1, k]
        e, f = vectors[s, 0, 0, k], vectors[s, 0, 1, k]
        # g0 = step m
        x = modal[s, 0, k] + step * (a * p - b * q) + c * r - d * t
        y = modal[s, 1, k] - step * (a * q + b * p) - c * t - d * r
        seen[0, k] = x
        seen[1, k] = y
        mean[s, 0, k] = a * x + b * y
        mean[s, 1, k] = a * y - b * x
        modal[s, 0, k] = e * x + f * y
        modal[s, 1, k] = e * y - f * x


@njit(**KERNEL)
def _drive(vectors, s, size, new, load, modal, mean):  # type: ignore[no-untyped-def]
    """Forces of the wheelsets on y and z; the new load becomes the last one."""
    for k in range(size):
        p, q, r, t = new[0, k], new[1, k], load[s, 0, k], load[s, 1, k]
        a, b = vectors[s, 3, 0, k], vectors[s, 3, 1, k]
        c, d = vectors[s, 4, 0, k], vectors[s, 4, 1, k]
        e, f = vectors[s, 5, 0, k], vectors[s, 5, 1, k]
        modal[s, 0, k] += a * p - b * q
        modal[s, 1, k] -= a * q + b * p
        mean[s, 0, k] += c * p - d * q + e * r - f * t
        mean[s, 1, k] -= c * q + d * p + e * t + f * r
        load[s, 0, k] = p
        load[s, 1, k] = q


@njit(**KERNEL)
def _predict(vectors, s, size, guess, load, modal, mean, here, here_mean):  # type: ignore[no-untyped-def]
    """q at the end of the step and in its mean, with the wheelsets' forces guessed."""
    for k in range(size):
        p, q, r, t = guess[0, k], guess[1, k], load[s, 0, k], load[s, 1, k]
        a, b = vectors[s, 6, 0, k], vectors[s, 6, 1, k]
        c, d = vectors[s, 7, 0, k], vectors[s, 7, 1, k]
        e, f = vectors[s, 8, 0, k], vectors[s, 8, 1, k]
        here[0, 0, k] = modal[s, 0, k] + a * p - b * q + c * r - d * t
        here[0, 1, k] = modal[s, 1, k] - a * q - b * p - c * t - d * r
        here_mean[0, 0, k] = mean[s, 0, k] + e * p - f * q
        here_mean[0, 1, k] = mean[s, 1, k] - e * q - f * p


@njit(**KERNEL)
def _react(cubics, cell, s, i, react):  # type: ignore[no-untyped-def]
    for row in range(4):
        for j in range(BLOCK):
            react[i, row, j] = cubics[cell, 0, row, j] + s * (
                cubics[cell, 1, row, j]
                + s * (cubics[cell, 2, row, j] + s * cubics[cell, 3, row, j])
            )


@njit(**KERNEL)
def _subtract_product(matrix, c, x, d, out):  # type: ignore[no-untyped-def]
    """out[c] -= x[d] @ matrix[c], row by row of the matrix."""
    for j in range(BLOCK):
        factor = x[d, j]
        for i in range(BLOCK):
            out[c, i] -= factor * matrix[c, j, i]


@njit(**KERNEL)
def _solve(inner, lower, upper, right, spare, cut):  # type: ignore[no-untyped-def]
    """cut = -(matrix of the cuts)^-1 right; the factors are transposed."""
    count = right.shape[0]
    for c in range(count):
        for i in range(BLOCK):
            spare[c, i] = right[c, i]
        if c > 0:
            _subtract_product(lower, c, spare, c - 1, spare)
    for c in range(count - 1, -1, -1):
        for i in range(BLOCK):
            cut[c, i] = 0.0
        _subtract_product(inner, c, spare, c, cut)
        if c < count - 1:
            _subtract_product(upper, c, cut, c + 1, cut)


@njit(**KERNEL)
def _march(  # type: ignore[no-untyped-def]
    size,
    first_cell,
    first_shape,
    shapes,
    joints,
    vectors,
    compliance,
    reaction,
    inner,
    lower,
    upper,
    channel_segment,
    channel_weights,
    channel_feed,
    grid_start,
    grid_step,
    length,
    step,
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
    parts, (samples, axles) = size.shape[0], position.shape
    cuts, largest = parts - 1, modal.shape[2]
    lost, worst = 0, 0.0
    guess, new_load = np.zeros((2, largest), shapes.dtype), np.zeros((2, largest))
    here, here_mean = np.zeros((1, 2, largest)), np.zeros((1, 2, largest))
    sums, seen = np.zeros((2, 2, largest)), np.zeros((2, largest))
    right, spare = np.zeros((cuts, BLOCK)), np.zeros((cuts, BLOCK))
    cut = np.zeros((cuts, BLOCK))
    gap, own, displacement = np.zeros(axles), np.zeros(axles), np.zeros(axles)
    at, place, on = np.zeros(axles, np.int64), np.zeros(axles), np.zeros(axles, np.bool_)
    push, pushed = np.zeros(axles), np.zeros(axles, np.bool_)
    react = np.zeros((axles, 4, BLOCK))
    scratch = np.empty(state.shape[1])
    loaded = np.zeros(parts, np.bool_)
    members, many = np.zeros((parts, axles), np.int64), np.zeros(parts, np.int64)
    for i in range(axles):
        members[segment[i], many[segment[i]]] = i
        many[segment[i]] += 1
    watching, watched = np.zeros((parts, outputs.shape[1]), np.int64), np.zeros(parts, np.int64)
    for o in range(outputs.shape[1]):
        s = channel_segment[o]
        if s >= 0:
            watching[s, watched[s]] = o
            watched[s] += 1
    for s in range(parts):
        for part in range(2):
            for k in range(size[s]):
                if load[s, part, k] != 0.0:
                    loaded[s] = True
    # a turn is the last sample's forces on the modes, then the prediction and forces of this one
    for n in range(samples + 1):
        any_on = False
        if n < samples:
            for o in range(outputs.shape[1]):
                outputs[n, o] = 0.0
            for i in range(axles):
                x = position[n, i]
                on[i] = 0.0 <= x <= length
                if on[i]:
                    any_on = True
                    s = segment[i]
                    exact = (x - grid_start[s]) / grid_step
                    cell = min(max(int(exact), 0), first_cell[s + 1] - first_cell[s] - 1)
                    at[i], place[i] = first_cell[s] + cell, exact - cell
                    _react(reaction, at[i], place[i], i, react)
            right[:] = 0.0
        for s in range(parts):
            w = size[s]
            if n > 0:
                if s > 0:
                    _pull(joints, s, 0, w, cut, s - 1, 0.0, sums)
                if s < cuts:
                    _pull(joints, s, JOINT, w, cut, s, min(s, 1) * 1.0, sums)
                _carry(vectors, s, w, step, sums, modal, mean, seen)
                for m in range(watched[s]):
                    o = watching[s, m]
                    outputs[n - 1, o] += _dot(channel_weights, o, w, seen)
                pushing = False
                for m in range(many[s]):
                    pushing = pushing or pushed[members[s, m]]
                if pushing or loaded[s]:
                    _clear(new_load, w)
                    for m in range(many[s]):
                        i = members[s, m]
                        if pushed[i]:
                            _add_load(shape, i, w, push[i], new_load)
                    _drive(vectors, s, w, new_load, load, modal, mean)
                loaded[s] = pushing
            if n == samples:
                continue
            busy = loaded[s]
            for m in range(many[s]):
                busy = busy or on[members[s, m]]
            if busy:
                _clear(guess, w)
                for m in range(many[s]):
                    i = members[s, m]
                    if on[i]:
                        cell = first_shape[s] + 8 * w * (at[i] - first_cell[s])
                        _add_shape(
                            shapes[cell : cell + 8 * w].reshape(4, 2, w),
                            shapes.dtype.type(place[i]),
                            w,
                            shapes.dtype.type(last_force[i]),
                            i,
                            shape,
                            guess,
                        )
                _predict(vectors, s, w, guess, load, modal, mean, here, here_mean)
                for m in range(many[s]):
                    i = members[s, m]
                    if on[i]:
                        displacement[i] = _dot(shape, i, w, here[0])
                if s > 0:
                    _read_gaps(joints, s, 0, w, here, here_mean, 0, right, s - 1)
                if s < cuts:
                    _read_gaps(joints, s, JOINT, w, here, here_mean, 0, right, s)
            else:
                if s > 0:
                    _read_gaps(joints, s, 0, w, modal, mean, s, right, s - 1)
                if s < cuts:
                    _read_gaps(joints, s, JOINT, w, modal, mean, s, right, s)
        if n == samples:
            break
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
                    cell += first_cell[s]
                    local = exact - (cell - first_cell[s])
                    _feed(channel_feed, cell, 1, local, last_force[i], outputs, n)
                if not on[i]:
                    force[n, i] = solve_contact(gap[i], own[i], linear[i], hertz[i])
                    continue
                moved = displacement[i]
                for side in range(2):
                    c, j = s - 1 + side, JOINT * side
                    if 0 <= c < cuts:
                        for row in range(JOINT):
                            moved += react[i, 0, j + row] * cut[c, row]
                            moved += react[i, 1, j + row] * cut[c, JOINT + row]
                modes = _cubic(compliance, at[i], 0, place[i])
                gap[i] += modes * last_force[i] - moved
                own[i] += modes + _cubic(compliance, at[i], 1, place[i])
                f = solve_contact(gap[i], own[i], linear[i], hertz[i])
                force[n, i] = f
                _feed(channel_feed, at[i], 0, place[i], f, outputs, n)
                for side in range(2):
                    c, j = s - 1 + side, JOINT * side
                    if 0 <= c < cuts:
                        for row in range(JOINT):
                            change = f - last_force[i]
                            right[c, row] += react[i, 2, j + row] * change
                            right[c, JOINT + row] += react[i, 3, j + row] * change
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
                pushed[i], push[i] = on[i], force[n, i]
                if on[i]:
                    if touching[i] and force[n, i] <= 0.0:
                        lost += 1
                    touching[i] = force[n, i] > 0.0
                else:
                    force[n, i] = np.nan
        if any_on:
            _solve(inner, lower, upper, right, spare, cut)
    return lost, worst


class SegmentRun(ModalRun):
    """A run on a line in segments, with the interface of :class:`ModalRun`.

    A wheelset acts on one segment. At the first sample beyond a cut it is handed over: what its
    force does to the modes, from that sample on, is moved from one segment to the next, so that
    the force on the joined line is interpolated as if there were no cut.

    Args:
        line, traffic, derivatives, order, precision: as of :class:`ModalRun`.
        balance: an energy balance was asked for; there is none here, and the notes say so.
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
        balance: bool = False,
    ) -> None:
        self._balance_missing = balance
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
        self._seen: Fleet | None = None
        self._before: tuple[Array, Array] = (np.zeros(0), np.zeros(0))

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on what limits the result."""
        parts = len(self.line.parts)
        limits: tuple[str, ...] = (
            f"line of {self.line.length:g} m in {parts} segments: within 1 % of one whole line to "
            "0.4 of solution.frequency_limit; at the limit wheel force within 1 %, rail and slab "
            "beside a cut 10 %; wheel force at a cut 2 % of its range for a few steps",
        )
        if self._balance_missing:
            limits += ("energy balance: not available for a line in segments",)
        return limits

    def _prepare(self, derivatives: tuple[int, ...], order: int) -> None:
        self.tables = segment_tables(
            self.line, self.traffic.step, order=order, precision=self._precision
        )
        width = (len(self.tables.size), 2, int(self.tables.size.max()))
        self._modal, self._mean = aligned(width, np.float64), aligned(width, np.float64)
        self._load = aligned(width, np.float64)

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
        vector[segment, 0, : len(values)] += values.real
        vector[segment, 1, : len(values)] += values.imag

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
        shape = aligned((position.shape[1], *modal.shape[1:]), self._precision)
        while begin < len(position):
            change = (number[begin:] != segment).any(axis=1)
            stop = begin + int(np.argmax(change)) + 1 if change.any() else len(position)
            part = slice(begin, stop)
            before = fleet.force.copy(), fleet.place.copy()
            more, residual = _march(
                tables.size,
                tables.cell,
                tables.shape,
                tables.shapes,
                tables.joints,
                tables.vectors,
                tables.compliance,
                tables.reaction,
                tables.inner,
                tables.lower,
                tables.upper,
                tables.channel_segment,
                tables.channel_weights,
                tables.channel_feed,
                tables.grid_start,
                tables.grid_step,
                tables.length,
                tables.step,
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
    """Run of a scenario's line: whole if it is short, else in segments.

    Segments have no energy balance; if it is asked for, the run's notes say that it is missing.
    """
    cuts = find_cuts(scenario)
    if not cuts:
        return modal_run(scenario, traffic, derivatives, balance=balance)
    return SegmentRun(segmented_line(scenario, cuts), traffic, derivatives, balance=balance)
