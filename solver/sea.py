"""Statistical energy analysis: the power balance of Eq. (12), in time, and its coupling.

    omega eta_r E_r + omega sum_s eta_rs n_r (E_r/n_r - E_s/n_s) = P_r - dE_r/dt

with reciprocity n_r eta_rs = n_s eta_sr (Lyon and DeJong, Theory and Application of Statistical
Energy Analysis, 1995). A long beam is a chain of segments with two subsystems each, the energy
that travels right and the energy that travels left: one reverberant subsystem would spread a
wheel's power over the whole line. For travelling energy reciprocity holds with every direction
reversed, n_r eta_rs = n_s' eta_s'r'.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import scipy.linalg
import scipy.sparse as sp
import scipy.sparse.linalg
from numpy.typing import ArrayLike, NDArray

from .errors import SolverError
from .waves import Complex, Real, WaveBeam

RECIPROCITY = 1e-9
"""Largest relative error of reciprocity that a balance accepts."""

NEGATIVE = 1e-9
"""Rounding below zero, relative to the largest energy, that is set to zero."""


@dataclass(frozen=True, eq=False)
class PowerBalance:
    """Subsystems that hold, lose and exchange energy in one frequency band.

    Attributes:
        omega: centre of the band (rad/s).
        loss: (N,) loss factors eta_r (-).
        coupling: (N, N) coupling loss factors, ``[r, s]`` is eta_rs from r to s (-), kept sparse.
        modal_density: (N,) n_r (s/rad).
        reverse: (N,) subsystem with the directions of travel reversed; itself if it has none.

    Raises:
        SolverError: a loss factor is negative, or reciprocity is violated.
    """

    omega: float
    loss: Real
    coupling: sp.csr_array
    modal_density: Real
    reverse: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, dtype=np.intp))

    def __post_init__(self) -> None:
        """Check signs and reciprocity."""
        size = len(self.loss)
        object.__setattr__(self, "coupling", sp.csr_array(self.coupling))
        if not len(self.reverse):
            object.__setattr__(self, "reverse", np.arange(size))
        for name, values in (("eta_r", self.loss), ("eta_rs", self.coupling.data)):
            if np.min(values, initial=0.0) < 0:
                raise SolverError(f"loss factor {name} = {np.min(values):g}; limit >= 0")
        flow = sp.csr_array(sp.diags_array(self.modal_density) @ self.coupling)
        error = abs(flow - flow[self.reverse][:, self.reverse].T).tocoo()
        scale = float(flow.data.max(initial=0.0))
        if error.nnz and error.data.max() > RECIPROCITY * scale:
            at = int(np.argmax(error.data))
            r, s = int(error.coords[0][at]), int(error.coords[1][at])
            other = flow[self.reverse[s], self.reverse[r]]
            raise SolverError(
                f"reciprocity n_r eta_rs = n_s eta_sr between subsystems {r} and {s}: "
                f"{flow[r, s]:.6g} s against {other:.6g} s; "
                f"limit {RECIPROCITY:g} of the largest"
            )

    @property
    def matrix(self) -> sp.csc_array:
        """A of dE/dt = P - A E (1/s), shape (N, N)."""
        total = self.loss + self.coupling.sum(axis=1)
        return sp.csc_array(self.omega * (sp.diags_array(total) - self.coupling.T))

    def steady(self, power: ArrayLike) -> Real:
        """Energies E (J) under constant powers (W), shapes (N,) or (N, k).

        Raises:
            SolverError: no loss anywhere, or a negative energy.
        """
        if not np.any(self.loss > 0):
            raise SolverError("power balance: largest loss factor = 0; a steady state needs > 0")
        solver = scipy.sparse.linalg.splu(self.matrix)
        return checked_energy(np.asarray(solver.solve(np.asarray(power, dtype=np.float64))))

    def propagator(self, step: float) -> tuple[Real, Real]:
        """(N, N) matrices of E(t + step) = decay E(t) + gain P for power constant in the step.

        Exact: decay = exp(-A step), gain = integral of exp(-A t) over the step (s).
        """
        size = len(self.loss)
        block = np.zeros((2 * size, 2 * size))
        block[:size, :size] = -self.matrix.toarray() * step
        block[:size, size:] = np.eye(size) * step
        result = scipy.linalg.expm(block)
        return np.asarray(result[:size, :size]), np.asarray(result[:size, size:])

    def dissipated(self, energy: ArrayLike) -> Real:
        """Power lost to heat by every subsystem, omega eta_r E_r (W)."""
        return self.omega * self.loss * np.asarray(energy, dtype=np.float64)


def checked_energy(energy: Real) -> Real:
    """Energies with rounding below zero removed.

    Raises:
        SolverError: an energy is negative or not finite.
    """
    if not np.all(np.isfinite(energy)):
        raise SolverError("energy of a subsystem is not finite; limit: finite")
    lowest, largest = float(energy.min(initial=0.0)), float(energy.max(initial=0.0))
    if lowest < -NEGATIVE * max(largest, abs(lowest) * 1e-6, 1e-300):
        raise SolverError(f"energy of a subsystem = {lowest:.3g} J; limit >= 0 J")
    return np.maximum(energy, 0.0)


def conductance(mobility_a: Complex, mobility_b: Complex, element: Complex) -> Real:
    """omega n_a eta_ab of two subsystems joined at one point through an element (-).

    (2/pi) Re Y_a Re Y_b / |Y_a + Y_b + Y_e|^2: blocked force of the free velocity of a, power of
    that force into b, with Re Y = pi n/(2 M) (Lyon and DeJong 1995, point-connected systems).

    Args:
        mobility_a, mobility_b: direct-field point mobilities (m/(N*s)).
        element: mobility i omega / (k + i omega c) of the spring between them (m/(N*s)).
    """
    total = mobility_a + mobility_b + element
    return np.asarray(2 / np.pi * mobility_a.real * mobility_b.real / np.abs(total) ** 2)


def _reach(omega: float, beam_a: WaveBeam, beam_b: WaveBeam) -> float:
    """Distance (m) at which the product of both direct fields has fallen to exp(-20)."""
    decay = sum(float(beam.exponents(omega)[0].real) for beam in (beam_a, beam_b))
    return min(20 / max(decay, 1e-9), 2000.0)


def fastening_conductance(
    omega: float, beam_a: WaveBeam, beam_b: WaveBeam, element: complex, spacing: float
) -> float:
    """omega n_a eta_ab per metre of two beams joined by equal point springs in a row (1/m).

    Sum of :func:`conductance` over pairs of springs, which see the same waves: the coupling loss
    factor of two direct fields (Shorter and Langley, JSV 288, 2005),
    (2/pi) sum_jk Im D_a,jk (D_tot^-1 Im D_b D_tot^-H)_jk, with the mobilities between springs.

    Args:
        omega: frequency (rad/s).
        beam_a, beam_b: the beams, losses included.
        element: mobility of a spring (m/(N*s)).
        spacing: distance of the springs (m).
    """
    distance = np.arange(1, math.ceil(_reach(omega, beam_a, beam_b) / spacing)) * spacing
    y_a = beam_a.point_mobility(omega)
    y_b = beam_b.point_mobility(omega)
    total = abs(complex(y_a + y_b + element)) ** 2
    far = (1j * omega * beam_a.transfer_receptance(omega, distance)).real
    far = far * (1j * omega * beam_b.transfer_receptance(omega, distance)).real
    pairs = float(y_a.real * y_b.real + 2 * far.sum())
    return max(2 / math.pi * pairs / total / spacing, 0.0)


def bed_conductance(omega: float, beam_a: WaveBeam, beam_b: WaveBeam, stiffness: complex) -> float:
    """omega n_a eta_ab per metre of two beams joined by a distributed spring (1/m).

    Limit of :func:`fastening_conductance` for many weak springs,
    (2/pi) |k'/omega|^2 times the integral of Re Y_a(x) Re Y_b(x) over all distances x.

    Args:
        omega: frequency (rad/s).
        beam_a, beam_b: the beams, both held by the bed (losses included).
        stiffness: k' + i omega c' of the bed (N/m^2).
    """
    shortest = 2 * math.pi / max(float(beam_a.wavenumber(omega)), float(beam_b.wavenumber(omega)))
    x = np.arange(0, _reach(omega, beam_a, beam_b), shortest / 40)
    y_a = (1j * omega * beam_a.transfer_receptance(omega, x)).real
    y_b = (1j * omega * beam_b.transfer_receptance(omega, x)).real
    joint = 2 * float(np.trapezoid(y_a * y_b, x))
    return max(2 / math.pi * abs(stiffness / omega) ** 2 * joint, 0.0)


def chain_rate(group_velocity: float, decay: float, length: float) -> float:
    """Energy leaving a segment of a chain per energy in it (1/s).

    c_g decay/(exp(decay length) - 1): a wave that enters with power P and decays like
    exp(-decay x) holds P (1 - exp(-decay length))/(c_g decay) in the segment and leaves with
    P exp(-decay length), so the chain decays exactly like the wave, for any length; c_g/length
    without loss.

    Args:
        group_velocity: velocity of energy (m/s).
        decay: energy decay omega eta/c_g (1/m).
        length: length of the segment (m).
    """
    if decay * length < 1e-9:
        return group_velocity / length
    return group_velocity * decay / math.expm1(decay * length)


@dataclass(frozen=True, slots=True)
class Chain:
    """One layer cut into segments of equal length.

    Attributes:
        group_velocity: (S,) velocity of energy (m/s).
        decay: (S,) energy decay by losses to heat (1/m).
        length: length of a segment (m).
    """

    group_velocity: Real
    decay: Real
    length: float


def chain_balance(
    omega: float, chains: list[Chain], conductances: list[Real], *, open_ends: bool = False
) -> PowerBalance:
    """Balance of layers on top of each other, each cut at the same places.

    Subsystem ``(2 layer + direction) S + segment``; direction 0 travels right.

    Args:
        omega: centre of the band (rad/s).
        chains: the layers, top first, S segments each.
        conductances: (S,) arrays, omega n eta per metre between layer i and i + 1 (1/m).
        open_ends: energy that reaches an end leaves the line; else the ends reflect it.
    """
    segments = len(chains[0].decay)
    size = 2 * len(chains) * segments
    loss, density = np.zeros(size), np.zeros(size)
    reverse = np.zeros(size, dtype=np.intp)
    inner = np.arange(segments)
    parts: list[tuple[NDArray[np.intp], NDArray[np.intp], Real]] = []
    for layer, chain in enumerate(chains):
        speed, decay, length = chain.group_velocity, chain.decay, chain.length
        # the mean decay of both segments, so that a change of damping reflects nothing
        between = np.array(
            [chain_rate(1.0, float(d), length) for d in (decay[1:] + decay[:-1]) / 2]
        )
        ends = [chain_rate(1.0, float(d), length) for d in (decay[0], decay[-1])]
        for direction in (0, 1):
            base = (2 * layer + direction) * segments
            other = (2 * layer + 1 - direction) * segments
            own = base + inner
            reverse[own] = other + inner
            loss[own] = decay * speed / omega
            # half of the modes of the segment, length / (pi c_g), travel either way
            density[own] = length / (2 * math.pi * speed)
            start, ahead = (own[:-1], own[1:]) if direction == 0 else (own[1:], own[:-1])
            source = inner[:-1] if direction == 0 else inner[1:]
            parts.append((start, ahead, between * speed[source] / omega))
            last = segments - 1 if direction == 0 else 0
            rate = ends[1 - direction] * speed[last] / omega
            if open_ends:
                loss[base + last] += rate
            else:
                parts.append((own[[last]], other + inner[[last]], np.array([rate])))
    for layer, conduct in enumerate(conductances):
        share = conduct * chains[layer].length / 4 / omega
        for a in (0, 1):
            for b in (0, 1):
                r, s = (2 * layer + a) * segments + inner, (2 * layer + 2 + b) * segments + inner
                parts.append((r, s, share / density[r]))
                parts.append((s, r, share / density[s]))
    row, column, value = (np.concatenate([part[i] for part in parts]) for i in range(3))
    coupling = sp.csr_array((value, (row, column)), shape=(size, size))
    return PowerBalance(omega, loss, coupling, density, reverse)
