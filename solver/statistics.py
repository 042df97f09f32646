"""Local modes seen from the global set: exact condensation (Eqs. 5-6) and its statistics (7-13).

Time factor exp(+i omega t). After the static shift q_l = -K_ll^-1 K_lg q_g + Phi p (Craig and
Bampton 1968) the coupling is inertial only, d_k = -omega^2 j_k (Eq. 8), and the local modes add

    D_gl D_ll^-1 D_gl^T = sum_k omega^4 j_k j_k^T / (omega_k^2 (1 + i eta) - omega^2).

A point force inside the local field drives mode k by phi_k; it is carried along as one more
column, a_k = (omega^2 j_k, phi_k), so that one matrix A = sum_k a_k a_k^T/(...) holds the global
set's own condensation, the blocked force (Eq. 11) and the local part of the point receptance.

Forms of A for modes known only statistically:

- ``paper``: three sharp classes (Eqs. 9-10): a negative effective mass below the resonant band,
  -i pi n <a a^T>/(2 omega) inside, nothing above.
- ``repaired``: every natural frequency is spread evenly over +/- ``half_width``. Each mode sees the
  others as the mean medium that they make together, and the medium is such that a mode put in its
  place scatters nothing in the mean (coherent potential approximation: Soven, Phys. Rev. 156
  (1967) 809). Far from omega that is the exact term on either side, near it the damping of
  Eq. (10), lessened by what the mode gives to the rest. What scatters in the square is the
  reverberant field: a power balance between single modes (the ladder of multiple scattering),
  which at high modal overlap is the diffuse-field reciprocity of Shorter and Langley (JSV 288,
  2005), S_ff = 4 E/(pi omega n) Im D_dir.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike, NDArray

from .errors import InputError, SolverError
from .waves import Complex, Real

Form = Literal["paper", "repaired"]

RESONANT_BAND = 2 ** (1 / 6)
"""Paper's form: resonant are modes within a third octave about omega."""

SPREAD = 2 ** (1 / 12) - 1
"""Repaired form: least relative half width over which a natural frequency is spread."""

MEDIUM_TOLERANCE = 1e-9
MEDIUM_STEPS = 500


def condense(
    d_gg: ArrayLike, d_gl: ArrayLike, d_ll: ArrayLike, f_g: ArrayLike, f_l: ArrayLike
) -> tuple[Complex, Complex]:
    """Global amplitudes and local amplitudes by Eqs. (5) and (6), exact.

    Args:
        d_gg, d_gl, d_ll: dynamic stiffness, (G, G), (G, L), (L, L) (N/m).
        f_g, f_l: forces, (G,) and (L,) (N).

    Returns:
        q_g (G,), q_l (L,).
    """
    d_gg, d_gl, d_ll = (np.asarray(d, dtype=np.complex128) for d in (d_gg, d_gl, d_ll))
    f_g, f_l = (np.asarray(f, dtype=np.complex128) for f in (f_g, f_l))
    factor = scipy.linalg.lu_factor(d_ll)
    solved = scipy.linalg.lu_solve(factor, np.column_stack((d_gl.T, f_l)))
    q_g = np.linalg.solve(d_gg - d_gl @ solved[:, :-1], f_g - d_gl @ solved[:, -1])
    return np.asarray(q_g), np.asarray(solved[:, -1] - solved[:, :-1] @ q_g)


@dataclass(frozen=True, eq=False)
class Partition:
    """Global and local set after the static shift, local set in its own modes of mass 1.

    Attributes:
        mass, stiffness: (G, G) of the shifted global set (kg, N/m).
        coupling: (L, G) inertial coupling j (kg^1/2).
        omega: (L,) natural frequencies of the local set (rad/s).
        global_shift: (L0, G) static shift q_l = shift q_g.
        local_modes: (L0, L) Phi.
    """

    mass: Real
    stiffness: Real
    coupling: Real
    omega: Real
    global_shift: Real
    local_modes: Real

    def load(self, rows_g: ArrayLike, rows_l: ArrayLike) -> tuple[Real, Real]:
        """A place of the structure in shifted coordinates: (P, G) on q_g and (P, L) on p."""
        g, local = np.atleast_2d(rows_g), np.atleast_2d(rows_l)
        return g + local @ self.global_shift, local @ self.local_modes


def partition(mass: Real, stiffness: Real, is_global: NDArray[np.bool_]) -> Partition:
    """Split a structure and shift its local set.

    Raises:
        SolverError: the local set's mass or stiffness is not positive definite.
    """
    g, local = np.flatnonzero(is_global), np.flatnonzero(~is_global)
    m_ll, k_ll = mass[np.ix_(local, local)], stiffness[np.ix_(local, local)]
    m_gl, k_gl = mass[np.ix_(g, local)], stiffness[np.ix_(g, local)]
    try:
        squared, modes = scipy.linalg.eigh(k_ll, m_ll)
    except np.linalg.LinAlgError as error:
        raise SolverError(f"mass of the local set is not positive definite: {error}") from None
    if squared[0] <= 0:
        raise SolverError(f"lowest local eigenvalue = {squared[0]:.3g} 1/s^2; limit > 0")
    shift = -np.linalg.solve(k_ll, k_gl.T)
    shifted = np.vstack((np.eye(len(g)), shift))
    order = np.concatenate((g, local))
    m = shifted.T @ mass[np.ix_(order, order)] @ shifted
    k = shifted.T @ stiffness[np.ix_(order, order)] @ shifted
    coupling = modes.T @ (m_gl.T + m_ll @ shift)
    return Partition((m + m.T) / 2, (k + k.T) / 2, coupling, np.sqrt(squared), shift, modes)


def vectors(coupling: Real, forcing: Real, omega: float) -> Real:
    """a_k = (omega^2 j_k, phi_k), shape (L, G + P)."""
    return np.hstack((omega**2 * coupling, forcing))


def exact_sum(a: Real, omega_k: Real, loss: float, omega: float) -> Complex:
    """A with every mode known."""
    terms = 1 / (omega_k**2 * (1 + 1j * loss) - omega**2)
    return np.asarray((a.T * terms) @ a)


def paper_sum(a: Real, omega_k: Real, omega: float) -> Complex:
    """A by the paper's three sharp classes; the resonant mean over a third octave."""
    low = omega / RESONANT_BAND
    width = omega * (RESONANT_BAND - 1 / RESONANT_BAND)
    below = a[omega_k < low]
    near = a[(omega_k >= low) & (omega_k <= omega * RESONANT_BAND)]
    effective_mass = -(below.T @ below) / omega**2
    damping = -0.5j * np.pi / omega * (near.T @ near) / width
    return np.asarray(effective_mass + damping)


def spacings(omega_k: Real) -> Real:
    """Mean distance of each natural frequency to its two neighbours (rad/s), (L,)."""
    if len(omega_k) < 2:
        return np.zeros(len(omega_k))
    return np.asarray(np.abs(np.gradient(omega_k)))


def spread_mean(omega_k: Real, squared: Complex, half_width: Real) -> Complex:
    """Mean of 1/(w^2 - z^2) over w = omega_k +/- half_width (rad/s), z^2 ``squared``: (L,).

    It is ln((w - z)/(w + z))/(2 z) between the interval's ends, divided by its length.
    """
    z = np.sqrt(squared)
    z = np.where(z.imag > 0, -z, z)
    high, low = omega_k + half_width, omega_k - half_width
    # the branch is continuous: w - z stays in the upper half plane, because Im z < 0
    rise = np.log((high - z) / (high + z)) - np.log((low - z) / (low + z))
    return np.asarray(rise / (2 * z * (high - low)))


@dataclass(frozen=True, eq=False)
class _Medium:
    """What uncertain modes are in the mean, and how one of them departs from it.

    Attributes:
        terms: (L,) sigma, in place of 1/(omega_k^2 (1 + i eta) - omega^2).
        inverse: (G, G) of the global set's dynamic stiffness with them.
        own: (L,) 1 - sigma c, c what a mode feels of itself by way of all others.
        scattered: (L,) mean |T|^2 of the scattering T of a mode, whose mean is zero.
        stored: (L,) mean omega_k^2 |p|^2/2 per square of the field that acts on the mode.
    """

    terms: Complex
    inverse: Complex
    own: Complex
    scattered: Real
    stored: Real


def _medium(own: Complex, a: Real, omega_k: Real, loss: float, omega: float, half: Real) -> _Medium:
    """Solve <T> = 0 by fixed-point steps.

    A mode answers a field with 1/(d - c), d = omega_k^2 (1 + i eta) - omega^2; with its mean m the
    term is sigma = m/(1 + m c), and T = (1 - sigma c)((1 - sigma c)/(d - c) - sigma).

    Raises:
        SolverError: the steps do not settle.
    """
    complex_loss = 1 + 1j * loss
    terms = spread_mean(omega_k, np.full(len(omega_k), omega**2 / complex_loss), half)
    terms = terms / complex_loss
    for _ in range(MEDIUM_STEPS):
        inverse = np.linalg.inv(own - (a.T * terms) @ a)
        echo = np.einsum("kg,gh,kh->k", a, inverse, a)
        fed = echo / (1 + terms * echo)
        squared = (omega**2 + fed) / complex_loss
        mean = spread_mean(omega_k, squared, half)
        new = (mean / complex_loss) / (1 + mean / complex_loss * fed)
        change = float(np.abs(new - terms).max() / np.abs(new).max())
        terms = new
        if change < MEDIUM_TOLERANCE:
            break
    else:
        raise SolverError(
            f"mean terms of the local modes at omega = {omega:.6g} rad/s still change by "
            f"{change:.3g} after {MEDIUM_STEPS} steps; limit {MEDIUM_TOLERANCE:g}"
        )
    away = 1 - terms * fed
    answer = np.abs(mean / complex_loss) ** 2
    square = mean.imag / squared.imag / abs(complex_loss) ** 2
    weighted = (squared * mean).imag / squared.imag / abs(complex_loss) ** 2
    return _Medium(
        terms,
        np.asarray(inverse),
        away,
        np.abs(away) ** 4 * np.maximum(square - answer, 0.0),
        0.5 * np.abs(away) ** 2 * weighted,
    )


@dataclass(frozen=True, eq=False)
class Response:
    """Response to unit point forces of a structure with statistical local modes.

    Attributes:
        square: |w|^2 at the places, per |F|^2 (m^2/N^2), shape (P,).
        power: mean power in by the force of each place (W/N^2), shape (P,).
        energy: energy of the local set, as dissipated power/(omega eta) (J/N^2), shape (P,).
    """

    square: Real
    power: Real
    energy: Real


def respond(
    part: Partition,
    rows_g: Real,
    rows_p: Real,
    loss: float,
    omega: float,
    omega_k: Real | None = None,
) -> Response:
    """Exact response, local natural frequencies replaced by ``omega_k`` if given.

    Args:
        part: the structure, hysteretic loss everywhere.
        rows_g, rows_p: places, from :meth:`Partition.load`, (P, G) and (P, L).
        loss: loss factor eta (-).
        omega: frequency (rad/s).
        omega_k: (L,) rad/s.
    """
    natural = part.omega if omega_k is None else omega_k
    a = vectors(part.coupling, rows_p.T, omega)
    held = exact_sum(a, natural, loss, omega)
    g = part.mass.shape[0]
    own = part.stiffness * (1 + 1j * loss) - omega**2 * part.mass
    q = np.linalg.solve(own - held[:g, :g], rows_g.T + held[:g, g:])
    w = np.diag(rows_g @ q + held[g:, :g] @ q + held[g:, g:])
    amplitudes = a @ np.vstack((q, np.eye(len(rows_g))))
    amplitudes = amplitudes / (natural**2 * (1 + 1j * loss) - omega**2)[:, None]
    energy = 0.5 * (natural[:, None] ** 2 * np.abs(amplitudes) ** 2).sum(axis=0)
    return Response(np.abs(w) ** 2, -0.5 * omega * w.imag, energy)


def respond_statistically(
    part: Partition,
    rows_g: Real,
    rows_p: Real,
    loss: float,
    omega: float,
    form: Form = "repaired",
    half_width: Real | None = None,
) -> Response:
    """Mean response over the ensemble of local modes by the form asked for.

    Args:
        part, rows_g, rows_p, loss, omega: see :func:`respond`.
        form: see the module.
        half_width: (L,) rad/s, how far natural frequencies may lie off; by default one mean
            spacing or 1/12 octave, whichever is more. Only for ``repaired``.

    Raises:
        InputError: omega lies below the first local mode, where a power balance means nothing.
        SolverError: the mean medium is not found.
    """
    if omega < part.omega[0]:
        raise InputError(
            f"omega = {omega:.6g} rad/s lies below the first local mode, {part.omega[0]:.6g} "
            "rad/s: the statistics of local modes start there"
        )
    a = vectors(part.coupling, rows_p.T, omega)
    g = part.mass.shape[0]
    own = np.asarray(part.stiffness * (1 + 1j * loss) - omega**2 * part.mass, np.complex128)
    if form == "paper":
        held = paper_sum(a, part.omega, omega)
        q = np.linalg.solve(own - held[:g, :g], rows_g.T + held[:g, g:])
        direct = np.diag(rows_g @ q + held[g:, :g] @ q + held[g:, g:])
        motion = np.vstack((q, np.eye(len(rows_g))))
        power_in = 0.5 * omega * np.einsum("ip,ij,jp->p", motion.conj(), -held.imag, motion).real
        energy = power_in / (omega * loss)
        return Response(np.abs(direct) ** 2, -0.5 * omega * direct.imag, energy)
    if half_width is None:
        half_width = np.maximum(SPREAD * part.omega, spacings(part.omega))
    medium = _medium(own, a[:, :g], part.omega, loss, omega, half_width)
    held = (a.T * medium.terms) @ a
    q = medium.inverse @ (rows_g.T + held[:g, g:])
    direct = np.diag(rows_g @ q + held[g:, :g] @ q + held[g:, g:])
    field = np.abs(a[:, :g] @ q + a[:, g:]) ** 2
    between = np.abs(a[:, :g] @ medium.inverse @ a[:, :g].T) ** 2
    np.fill_diagonal(between, 0.0)
    # every mode hears the mean field and what all others scatter
    heard = np.linalg.solve(np.eye(len(field)) - between * medium.scattered, field)
    # by reciprocity a place hears a mode as the mode hears a force there
    reverberant = (field * medium.scattered[:, None] * heard).sum(axis=0)
    return Response(
        np.abs(direct) ** 2 + reverberant, -0.5 * omega * direct.imag, medium.stored @ heard
    )


def wavelength_classes(speed: float, crossover: float, limit: float) -> tuple[float, float]:
    """Roughness wavelengths (m) that part the paper's three classes at a speed.

    omega = 2 pi v/lambda: shorter than the first, local modes act as a mass; up to the second
    they are resonant; longer ones do not reach them.

    Args:
        speed: v (m/s).
        crossover: lowest frequency of the local set f_g (Hz).
        limit: highest frequency of the local set (Hz).

    Raises:
        InputError: crossover is not below limit.
    """
    if not 0 < crossover < limit:
        raise InputError(
            f"solution.crossover = {crossover:g} Hz: must be positive and below "
            f"solution.frequency_limit = {limit:g} Hz"
        )
    return speed / limit, speed / crossover


def effective_mass(coupling: Real) -> Real:
    """Mass added to M_gg by local modes far below omega (Eq. 9), -sum j j^T (kg), (G, G)."""
    return np.asarray(-(coupling.T @ coupling))


def effective_damping(coupling: Real, omega_k: Real, omega: float) -> Real:
    """Viscous matrix of resonant local modes (Eq. 10), pi omega^2/2 n <j j^T> (N*s/m), (G, G).

    D_gg gains +i (pi omega^3/2) n <j j^T> with exp(+i omega t); the mean is over ``omega_k``.
    """
    if len(omega_k) < 2:
        raise SolverError(f"{len(omega_k)} resonant local modes; limit >= 2 for a modal density")
    density = (len(omega_k) - 1) / (omega_k[-1] - omega_k[0])
    return np.asarray(math.pi * omega**2 / 2 * density * (coupling.T @ coupling) / len(omega_k))
