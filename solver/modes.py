"""Modes of the line: real ones of (M, K), then complex ones of (M, C, K), as tables.

With complex modes normalised to ``phi.T (2 lambda M + C) phi = 1`` the receptance is
``(s^2 M + s C + K)^-1 = sum phi phi.T / (s - lambda)`` over all eigenvalues (Foss 1958), and
``q' = lambda q + phi.T F`` are uncoupled although the damping is not proportional.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse as sp
import scipy.sparse.csgraph
from numpy.typing import NDArray

from .beam import Array
from .cache import cached
from .errors import SolverError
from .line import Structure, assemble
from .scenario import Scenario

Complex = NDArray[np.complex128]

FORMAT = 14

RESIDUAL_REACH = 8.0
"""Distance (m) from a channel beyond which dropped modes do not answer a wheel; faded out over
its second half, because a jump would be an impulse in the velocity."""
RESIDUAL_STEP = 0.01
"""Grid of the static answer of the dropped modes (m)."""

REAL_MARGIN = 1.15
"""Real modes are taken up to this multiple of the frequency limit."""
RESIDUAL_TOLERANCE = 1e-4
RAIL_SHARE = 1e-3
CHANNEL_SHARE = 1e-2
CONTACT_COMPLIANCE = 4e-10
"""Of the two contacts of a wheelset (m/N), in series with the rail's."""
GRID_PHASE = 0.8
JOINT_SHIFTS = (0.7, 1.0)
"""Frequencies, in frequency limits, at which the answer of dropped modes at a cut is exact."""
SIZE_LIMIT = 9000
"""Coordinates above which dense modes are refused: 2200 take 16 s on one core, time grows with
the cube, memory with the square."""


@dataclass(frozen=True, eq=False)
class ModalLine:
    """What time stepping needs of a line.

    ``q' = eigenvalues q + phi(x) F``; a real field is ``sum(weights * Re(shape * q))``.

    Attributes:
        eigenvalues: (K,) lambda (1/s), Im >= 0.
        weights: (K,) 2 for an eigenvalue that stands for its conjugate pair, 1 for a real one.
        grid_start, grid_step: cells of the rail table: cell i starts at
            ``grid_start + i * grid_step`` (m).
        rail_shapes: (cells, 4, K) cubic coefficients of phi over the cell's coordinate in
            [0, 1]; fastenings lie on cell edges, where the rail has kinks.
        residual: (cells, 4) point compliance of the rail that the kept modes miss (m/N), cubic
            in the cell's coordinate: exact static compliance less theirs.
        channel_shapes: (C, K); displacement, strain or force of channel c is
            ``sum(weights * Re(channel_shapes[c] * q))``.
        channel_x: (C,) position of each channel (m).
        channel_residual: (C, 3, 2, P) for forces on the rail at ``channel_x`` - j (first) and + j
            times ``RESIDUAL_STEP``, per force: the sum of phi phi.T over the kept modes (1/s),
            which is zero over all modes, and what they miss of the channel's answer, per force
            and per rate of force (s). Dropped modes answer a passing wheel almost statically:
            ``(K + s C + ...)^-1 = K^-1 - s K^-1 C K^-1 + ...`` less the same terms of the kept
            modes, ``-sum phi phi.T (1/lambda + s/lambda^2 + ...)``.
        channel_band: (C,) valid band of each channel (Hz).
        length: of the line (m).
        solved: number of complex modes that were computed, K of them kept.
        joint_shapes: (J, K); deflections and rotations of the layers at the cuts that bound a
            segment, left cut first; (0, K) for a whole line.
        channel_inertia: (C, K); the part of ``channel_shapes`` that is due to accelerations,
            without its factor lambda^2.
    """

    eigenvalues: Complex
    weights: Array
    grid_start: float
    grid_step: float
    rail_shapes: Complex
    residual: Array
    channel_shapes: Complex
    channel_x: Array
    channel_residual: Array
    channel_band: Array
    length: float
    solved: int
    joint_shapes: Complex
    channel_inertia: Complex

    def rail(self, x: Array | float, derivative: int = 0) -> Complex:
        """Shapes of the rail (or their slope) at ``x`` (m), zero off the line: (len(x), K)."""
        x = np.atleast_1d(np.asarray(x, float))
        position = (x - self.grid_start) / self.grid_step
        cell = np.clip(position.astype(int), 0, len(self.rail_shapes) - 1)
        s = (position - cell)[:, None]
        c = self.rail_shapes[cell]
        if derivative == 0:
            value = c[:, 0] + s * (c[:, 1] + s * (c[:, 2] + s * c[:, 3]))
        else:
            value = (c[:, 1] + s * (2 * c[:, 2] + 3 * s * c[:, 3])) / self.grid_step
        value[(x < 0) | (x > self.length)] = 0
        return np.asarray(value)

    def rail_residual(self, x: Array) -> Array:
        """Point compliance of the rail that the kept modes miss (m/N), zero off the line."""
        position = (x - self.grid_start) / self.grid_step
        cell = np.clip(position.astype(int), 0, len(self.residual) - 1)
        s = position - cell
        c = self.residual[cell].T
        value = c[0] + s * (c[1] + s * (c[2] + s * c[3]))
        return np.where((x < 0) | (x > self.length), 0.0, value)

    def rail_receptance(self, frequency: Array, x: float, y: float | None = None) -> Complex:
        """Receptance of the rail (m/N) at ``x`` for a force at ``y`` (default x): (F,)."""
        return self._receptance(frequency, self.rail(x)[0], x if y is None else y, y in (None, x))

    def channel_receptance(self, frequency: Array, channel: int, y: float) -> Complex:
        """Channel response per force on the rail at ``y`` (m): (F,)."""
        return self._receptance(frequency, self.channel_shapes[channel], y, False)

    def _receptance(self, frequency: Array, shape: Complex, y: float, own: bool) -> Complex:
        s = 2j * np.pi * np.asarray(frequency, float)[:, None]
        product = shape * self.rail(y)[0]
        pair = self.weights > 1
        value = (product / (s - self.eigenvalues)).sum(axis=1)
        value += (product[pair].conj() / (s - self.eigenvalues[pair].conj())).sum(axis=1)
        if own:
            value += self.rail_residual(np.array([y]))
        return np.asarray(value)


def real_modes(structure: Structure, limit: float | None = None) -> tuple[Array, Array]:
    """Undamped modes up to ``limit`` (Hz): angular frequencies (n,), shapes (N, n), mass 1.

    Raises:
        SolverError: mass or stiffness is not positive definite.
    """
    scale = 1 / np.sqrt(structure.mass.diagonal())
    mass = structure.mass.toarray() * scale[:, None] * scale
    stiffness = structure.stiffness.toarray() * scale[:, None] * scale
    try:
        # all vectors by divide and conquer are faster than a large subset
        squared, vectors = scipy.linalg.eigh(
            stiffness, mass, driver="gvd", overwrite_a=True, overwrite_b=True, check_finite=False
        )
    except np.linalg.LinAlgError as error:
        raise SolverError(
            f"mass matrix of {structure.size} coordinates is not positive definite: {error}; "
            "use fewer hierarchical functions"
        ) from None
    if squared[0] <= 0:
        raise SolverError(
            f"lowest eigenvalue of the stiffness = {squared[0]:.3g} 1/s^2; limit > 0: a part of "
            "the track is not held"
        )
    omega = np.sqrt(squared)
    count = len(omega) if limit is None else int(np.searchsorted(omega, 2 * np.pi * limit))
    return omega[:count], vectors[:, :count] * scale[:, None]


def complex_modes(omega: Array, damping: Array) -> tuple[Complex, Complex, Array]:
    """Complex modes of ``q'' + damping q' + omega^2 q = 0`` in real modal coordinates.

    Returns:
        eigenvalues (K,) with Im >= 0, vectors (n, K) with
        ``phi.T (2 lambda + damping) phi = 1``, weights (K,): 2 for a pair, 1 for a real one.

    Raises:
        SolverError: an eigenvalue has a positive real part, or the modes are defective.
    """
    n = len(omega)
    state = np.block([[np.zeros((n, n)), np.diag(omega)], [-np.diag(omega), -damping]])
    values, vectors = scipy.linalg.eig(state, overwrite_a=True, check_finite=False)
    vectors = vectors.astype(complex, copy=False)
    upper = values.imag >= 0
    values, vectors = values[upper], vectors[:, upper]
    worst = float((values.real / np.maximum(abs(values), 1e-300)).max())
    if worst > 1e-9:
        raise SolverError(f"damping ratio of a mode = {-worst:.3g}; limit >= 0: unstable")
    order = np.argsort(abs(values))
    values, vectors = values[order], vectors[:, order]
    # state (omega q, q'): the velocity half is lambda q, the better scaled one
    shapes = vectors[:n] / omega[:, None]
    velocity = vectors[n:]
    _orthogonalise_clusters(values, shapes, velocity, damping)
    norm = 2 * (shapes * velocity).sum(axis=0) + (shapes * (damping @ shapes)).sum(axis=0)
    size = abs(shapes * velocity).sum(axis=0)
    flat = int(np.argmin(abs(norm) / size))
    if abs(norm[flat]) < 1e-8 * size[flat]:
        raise SolverError(
            f"modes at {values[flat]:.6g} 1/s are defective: norm = "
            f"{abs(norm[flat]) / size[flat]:.3g}; limit 1e-8"
        )
    return values, shapes / np.sqrt(norm), np.where(values.imag > 0, 2.0, 1.0)


def _orthogonalise_clusters(
    values: Complex, shapes: Complex, velocity: Complex, damping: Array
) -> None:
    """Make vectors of (nearly) equal eigenvalues orthogonal in the bilinear form, in place."""
    close = abs(np.subtract.outer(values, values)) < 1e-7 * abs(values)
    _, label = scipy.sparse.csgraph.connected_components(
        sp.csr_matrix(close.astype(np.int8)), directed=False
    )
    for group in np.flatnonzero(np.bincount(label) > 1):
        chosen = np.flatnonzero(label == group)
        a, b = shapes[:, chosen], velocity[:, chosen]
        gram = a.T @ b + b.T @ a + a.T @ damping @ a
        root = scipy.linalg.inv(scipy.linalg.sqrtm((gram + gram.T) / 2))
        shapes[:, chosen], velocity[:, chosen] = a @ root, b @ root


def reduced_modes(structure: Structure, limit: float) -> tuple[Array, Array]:
    """Undamped modes up to ``limit`` (Hz) and what the pads' dashpots need beyond: (n,), (N, n).

    The dashpots of the fastenings act at points and so excite modes far above the limit. Their
    static part, the residual response to a unit force on rail and slab at every fastening, is
    added as residual vectors (MacNeal 1971), rotated into frequencies of their own. Without them
    the slab is 1 to 30 % wrong between 500 and 2000 Hz however many modes are kept.

    Of the coordinates at the cuts of a segment the response of the dropped modes is added at
    rest and at ``JOINT_SHIFTS`` of the frequency limit. What passes a cut is then
    exact at these frequencies, to first order in the frequency squared.

    Raises:
        SolverError: the line has too many coordinates for a dense eigenproblem.
    """
    if structure.size > SIZE_LIMIT:
        raise SolverError(
            f"{structure.bounds[1] - structure.bounds[0]:g} m of line to "
            f"{structure.scenario.solution.frequency_limit:g} Hz "
            f"has {structure.size} coordinates; limit of the modal solution {SIZE_LIMIT}: shorten "
            "the line or lower solution.frequency_limit"
        )
    omega, shapes = real_modes(structure)
    count = int(np.searchsorted(omega, 2 * np.pi * limit))
    at = structure.fastenings
    points = sp.vstack([structure.rows("rail", at), structure.rows("slab", at)])
    residual = (points @ shapes[:, count:]).T / omega[count:, None]
    basis = _independent(residual)
    if structure.cuts:
        force = (structure.joint_rows() @ shapes[:, count:]).T
        vectors = [basis]
        for shift in (0.0, *JOINT_SHIFTS):
            at_rest = omega[count:] ** 2
            moving = (
                at_rest - (2 * np.pi * shift * structure.scenario.solution.frequency_limit) ** 2
            )
            answer = force * (omega[count:] / moving)[:, None]
            vectors.append(answer / np.linalg.norm(answer, axis=0))
        basis = _independent(np.hstack(vectors))
    coordinates = basis / omega[count:, None]
    compliance, rotation = np.linalg.eigh(coordinates.T @ coordinates)
    extra = shapes[:, count:] @ (coordinates @ rotation / np.sqrt(compliance))
    return (
        np.concatenate([omega[:count], 1 / np.sqrt(compliance)]),
        np.hstack([shapes[:, :count], extra]),
    )


def _independent(vectors: Array) -> Array:
    """Orthonormal basis of the columns, directions of little size left out."""
    left, size, _ = np.linalg.svd(vectors, full_matrices=False)
    return np.asarray(left[:, size > RESIDUAL_TOLERANCE * size[0]] if len(size) else left)


@dataclass(frozen=True, eq=False)
class LineForms:
    """What the complex modes of a line are made of, for its energies.

    Attributes:
        omega: (n,) of the undamped modes of mass 1 (rad/s).
        damping: (n, n) in their coordinates (1/s).
        vectors: (n, K) complex modes in their coordinates.
        frequency_limit: Hz.
    """

    omega: Array
    damping: Array
    vectors: Complex
    frequency_limit: float


def build_modal_line(structure: Structure) -> ModalLine:
    """Modal tables of a line or of a segment of one, computed."""
    return solve_modal_line(structure)[0]


def solve_modal_line(structure: Structure) -> tuple[ModalLine, LineForms]:
    """Modal tables of a structure, and what its energies need beside them.

    All modes of a segment are kept, because a truncated sum of complex modes need not be passive.
    """
    scenario = structure.scenario
    limit = scenario.solution.frequency_limit
    joints = structure.joint_rows()
    omega, real = reduced_modes(structure, REAL_MARGIN * limit)
    damping = real.T @ (structure.damping @ real)
    values, vectors, weights = complex_modes(omega, damping)
    solved = len(values)
    # the modes made of residual vectors lie above the limit and stay: without them the slab
    # beside a fastening loses 5 % of its acceleration peak below 4.5 kHz
    start, step, cells = _grid(structure)
    edges = np.asarray(start + step * np.arange(cells + 1), np.float64)
    rail = _cubics(structure, real, edges)
    # twice a real product is half the work of one with complex factors
    table = np.empty((cells, 4, len(values)), complex)
    flat = rail.reshape(4 * cells, -1)
    table.real = (flat @ np.ascontiguousarray(vectors.real)).reshape(table.shape)
    table.imag = (flat @ np.ascontiguousarray(vectors.imag)).reshape(table.shape)
    channels = np.empty((len(scenario.channel), len(values)), complex)
    inertia = np.empty_like(channels)
    for number, channel in enumerate(scenario.channel):
        probe = structure.probe(channel)
        inertia[number] = ((probe.acceleration_rows @ real) @ vectors)[0]
        channels[number] = (
            (probe.displacement_rows @ real) @ vectors
            + (probe.velocity_rows @ real) @ vectors * values
        )[0] + inertia[number] * values**2
    kept = np.ones(solved, bool)
    if not structure.cuts:
        kept = _participating(values, weights, abs(table[:, 0]).max(axis=0), abs(channels))
    # a mode below the limit does not answer statically: dropped for its small share, it is left out
    answered = kept | (abs(values) < 2 * np.pi * limit)
    known, known_values = vectors[:, answered], values[answered]
    known_channels = channels[:, answered]
    values, vectors, weights = values[kept], vectors[:, kept], weights[kept]
    inertia = inertia[:, kept]
    table, channels = np.ascontiguousarray(table[:, :, kept]), channels[:, kept]
    inverse = _flexibility(structure)
    static_weights = weights / -values

    thirds = np.vander(np.arange(4) / 3, increasing=True)
    places_in_cell = np.asarray(edges[:-1, None] + step * np.arange(4) / 3, np.float64)
    residual = np.empty((cells, 4))
    for begin in range(0, cells, 256):
        cell = slice(begin, begin + 256)
        x = np.clip(places_in_cell[cell].ravel(), *structure.bounds)
        at = structure.rail_rows(x)
        exact = np.asarray(at.multiply(at @ inverse).sum(axis=1)).ravel()
        exact += structure.missing_rail_compliance(x)
        kept = ((thirds @ table[cell]) ** 2 @ static_weights).real
        residual[cell] = exact.reshape(-1, 4) - kept
    places = np.array([scenario.channel_x(channel) for channel in scenario.channel])
    built = ModalLine(
        eigenvalues=values,
        weights=weights,
        grid_start=start,
        grid_step=step,
        rail_shapes=table,
        residual=residual @ np.linalg.inv(thirds).T,
        channel_shapes=channels,
        channel_x=places,
        channel_residual=_channel_residual(
            structure,
            inverse,
            known_channels,
            lambda x: structure.rail_rows(x) @ real @ known,
            known_values,
        ),
        channel_band=np.array([structure.channel_band(c) for c in scenario.channel]),
        length=structure.length,
        solved=solved,
        joint_shapes=joints @ real @ vectors,
        channel_inertia=inertia,
    )
    return built, LineForms(omega, damping, vectors, limit)


def _flexibility(structure: Structure) -> Array:
    """Inverse of the stiffness, scaled to unit diagonal first: (N, N)."""
    scale = 1 / np.sqrt(structure.stiffness.diagonal())
    scaled = structure.stiffness.toarray() * scale[:, None] * scale
    inverse = scipy.linalg.inv(scaled, assume_a="pos", check_finite=False)
    return np.asarray(inverse * scale[:, None] * scale)


def _participating(values: Complex, weights: Array, rail: Array, channels: Array) -> np.ndarray:
    """Modes that matter for a wheel or for a channel.

    A mode's share is its resonant response ``weight |phi_c| max |phi_rail| / |Re lambda|``. At
    the wheel it is held against the compliance of a wheel-rail contact, in a channel against the
    largest share within a third of an octave on both sides. ``rail`` and ``channels``: (K,) and
    (C, K) magnitudes of the shapes.
    """
    frequency = abs(values)
    order = np.argsort(frequency)
    low = np.searchsorted(frequency[order], frequency[order] / 1.26)
    high = np.searchsorted(frequency[order], frequency[order] * 1.26, side="right")
    resonant = weights * rail / np.maximum(abs(values.real), 1e-12 * frequency)
    matters = np.asarray(resonant * rail > RAIL_SHARE * CONTACT_COMPLIANCE)
    for channel in channels:
        share = (resonant * channel)[order]
        strongest = np.array([share[a:b].max() for a, b in zip(low, high, strict=True)])
        matters[order] |= share > CHANNEL_SHARE * strongest
    return matters


def _channel_residual(
    structure: Structure,
    inverse: Array,
    channels: Complex,
    rail: Callable[[Array], Complex],
    values: Complex,
) -> Array:
    """Answers of the channels to forces near them, to first order in s, less those kept."""
    count = round(RESIDUAL_REACH / RESIDUAL_STEP) + 1
    reach = np.linspace(0.0, (count - 1) * RESIDUAL_STEP, count)
    result = np.zeros((len(channels), 3, 2, len(reach)))
    weights = np.where(values.imag > 0, 2.0, 1.0)
    fade = 0.5 + 0.5 * np.cos(np.pi * np.clip(2 * reach / RESIDUAL_REACH - 1, 0, 1))
    for number, channel in enumerate(structure.scenario.channel):
        place = structure.scenario.channel_x(channel)
        probe = structure.probe(channel)
        static = (probe.displacement_rows @ inverse)[0]
        rate = (probe.velocity_rows @ inverse)[0] - inverse @ (structure.damping @ static)
        for side, sign in enumerate((-1.0, 1.0)):
            loads = place + sign * reach
            on = (loads >= structure.bounds[0]) & (loads <= structure.bounds[1])
            rows, shapes = structure.rail_rows(loads[on]), rail(loads[on])
            for order, exact in enumerate((0 * static, static, rate)):
                kept = shapes @ (-weights * channels[number] / values**order)
                result[number, order, side, on] = rows @ exact - kept.real
            here = structure.bounds[0] <= place <= structure.bounds[1]
            if here and channel.layer == "rail" and channel.quantity == "motion":
                missing = structure.missing_rail_deflection(loads[on], place)
                result[number, 1, side, on] += missing
    return result * fade


def _grid(structure: Structure) -> tuple[float, float, int]:
    """Start (m), step (m) and number of cells: fastenings on edges, rail waves resolved."""
    from .line import beam_sections

    scenario = structure.scenario
    wavenumber = beam_sections(scenario.track)["rail"].wavenumber(scenario.solution.frequency_limit)
    spacing = scenario.track.fastening.spacing
    step = spacing / (2 * math.ceil(spacing * wavenumber / GRID_PHASE / 2))
    first = float(structure.fastenings[0]) if len(structure.fastenings) else 0.0
    left, right = structure.bounds
    start = first - step * math.ceil((first - left) / step - 1e-9)
    return start, step, math.ceil((right - start) / step - 1e-9)


def _cubics(structure: Structure, real: Array, edges: Array) -> Array:
    """Cubic coefficients of the real rail shapes over every cell: (cells, 4, n)."""
    a, b = np.clip(edges[:-1], *structure.bounds), np.clip(edges[1:], *structure.bounds)
    field, h = structure.fields["rail"], (b - a)[:, None]
    # slopes are taken just inside the cell: the rail may have a kink at its edge
    inner = 1e-7 * (b - a)
    left, right = field.rows(a) @ real, field.rows(b) @ real
    left_slope = field.rows(a + inner, 1) @ real * h
    right_slope = field.rows(b - inner, 1) @ real * h
    c0, c1 = left, left_slope
    c2 = 3 * (right - left) - 2 * left_slope - right_slope
    c3 = 2 * (left - right) + left_slope + right_slope
    # the first and last cell may stick out of the line: t = alpha + beta s there
    alpha = ((edges[:-1] - a) / (b - a))[:, None]
    beta = ((edges[1:] - edges[:-1]) / (b - a))[:, None]
    return np.stack(
        [
            c0 + alpha * (c1 + alpha * (c2 + alpha * c3)),
            beta * (c1 + alpha * (2 * c2 + 3 * alpha * c3)),
            beta**2 * (c2 + 3 * alpha * c3),
            beta**3 * c3,
        ],
        axis=1,
    )


def modal_line(scenario: Scenario) -> ModalLine:
    """Modal tables of a scenario's line, from the disk cache when it was solved before.

    Raises:
        SolverError: see :func:`real_modes` and :func:`complex_modes`.
    """
    return cached_line(scenario, lambda: build_modal_line(assemble(scenario)))


def cached_line(
    scenario: Scenario, solve: Callable[[], ModalLine], part: Sequence[float] = ()
) -> ModalLine:
    """What ``solve`` gives, from the disk cache when it was solved before.

    Args:
        part: numbers (m) that tell this segment from others of the same line.
    """
    return cached(_cache_key(scenario, part), ModalLine, solve)


def _cache_key(scenario: Scenario, segment: Sequence[float]) -> dict[str, object]:
    part = scenario.model_dump(
        mode="json", include={"track", "line", "channel", "solution", "irregularity"}
    )
    return {
        "track": part["track"],
        "line": part["line"],
        "channel": part["channel"],
        "solution": {key: part["solution"][key] for key in ("frequency_limit", "sines")},
        "format": FORMAT,
        "part": list(segment),
    }
