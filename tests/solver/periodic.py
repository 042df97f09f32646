"""Exact receptance of the infinite track on discrete fastenings, as a test oracle.

Rail, slab and support layer are infinite continuous beams with closed-form Green's functions
(residues of their wavenumber receptances); the fastening forces follow from a Floquet (Bloch)
transform over one Brillouin zone. No mesh, no modes, nothing shared with ``solver.line`` but the
section properties.
"""

from __future__ import annotations

import numpy as np

from solver.line import RAILS, beam_sections

LOSS = 1e-7  # moves the undamped rail's poles off the real axis, outgoing waves only


def _green(numerator, denominator):
    """Terms A, k of g(x) = sum A exp(i k |x|) from polynomials in k^2 (lowest power first)."""
    square = np.polynomial.polynomial.polyroots(denominator).astype(complex)
    k = np.sqrt(square)
    k = np.where(k.imag > 0, k, -k)
    slope = np.polynomial.polynomial.polyval(square, np.polynomial.polynomial.polyder(denominator))
    top = np.polynomial.polynomial.polyval(square, numerator)
    return 1j * top / (slope * 2 * k), k


def _terms(track, omega):
    sections = beam_sections(track)
    rail, slab, layer = sections["rail"], sections["slab"], sections["support_layer"]
    lossy = 1 + 1j * LOSS
    bending = rail.bending_stiffness * lossy
    inertia = rail.mass_per_length * omega**2
    if rail.shear_stiffness is None:
        rail_terms = _green([1.0], [-inertia, 0, bending])
    else:
        shear = rail.shear_stiffness * lossy
        turn = shear - rail.rotary_inertia * omega**2
        rail_terms = _green(
            [turn, bending],
            [-inertia * turn, shear * turn - inertia * bending - shear**2, shear * bending],
        )
    mortar = (track.mortar.stiffness + 1j * omega * track.mortar.damping) * track.mortar.width
    bed = track.bed_on_subgrade
    ground = (bed.stiffness + 1j * omega * bed.damping) * bed.width
    upper = np.array([mortar - slab.mass_per_length * omega**2, 0, slab.bending_stiffness])
    lower = np.array(
        [mortar + ground - layer.mass_per_length * omega**2, 0, layer.bending_stiffness]
    )
    determinant = np.polynomial.polynomial.polymul(upper, lower).astype(complex)
    determinant[0] -= mortar**2
    return rail_terms, _green(lower, determinant)


def _comb(terms, offset, kappa, spacing):
    """sum over n of g(n a - offset) exp(-i kappa n a), 0 <= offset < a."""
    total = 0
    for amplitude, k in zip(*terms, strict=True):
        forward = np.exp(1j * (k - kappa) * spacing)
        backward = np.exp(1j * (k + kappa) * spacing)
        right = forward * np.exp(-1j * k * offset) / (1 - forward)
        left = np.exp(1j * k * offset) / (1 - backward)
        total = total + amplitude * (right + left)
    return total


def rail_receptance(track, frequency, position, points=8192):
    """Driving-point receptance of the rail (m/N, whole track) at ``position`` from a fastening (m).

    ``frequency`` is a scalar in Hz; ``points`` is the number of wavenumbers in the zone.
    """
    omega = 2 * np.pi * frequency
    spacing = track.fastening.spacing
    rail, slab = _terms(track, omega)
    pad = RAILS * (track.fastening.stiffness + 1j * omega * track.fastening.damping)
    kappa = (np.arange(points) + 0.5) * 2 * np.pi / spacing / points
    own = _comb(rail, 0.0, kappa, spacing) + _comb(slab, 0.0, kappa, spacing)
    there = _comb(rail, position, kappa, spacing)
    back = _comb(rail, position, -kappa, spacing)
    # the free rail's own term is averaged over the zone too: only so its poles cancel
    return np.mean(_comb(rail, 0.0, kappa, spacing) - there * back / (1 / pad + own))


def winkler_receptance(track, frequency):
    """Receptance of the rail alone on a continuous bed of pads on rigid ground (m/N)."""
    omega = 2 * np.pi * frequency
    section = beam_sections(track)["rail"]
    bed = RAILS * (track.fastening.stiffness + 1j * omega * track.fastening.damping)
    bed = bed / track.fastening.spacing
    if section.shear_stiffness is None:
        terms = _green(
            [1.0], [bed - section.mass_per_length * omega**2, 0, section.bending_stiffness]
        )
    else:
        shear, bending = section.shear_stiffness, section.bending_stiffness
        turn = shear - section.rotary_inertia * omega**2
        inertia = section.mass_per_length * omega**2 - bed
        terms = _green(
            [turn, bending],
            [-inertia * turn, shear * turn - inertia * bending - shear**2, shear * bending],
        )
    return terms[0].sum()
