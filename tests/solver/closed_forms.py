"""A simply supported beam as a line of closed-form modes."""

from __future__ import annotations

import numpy as np

from solver.modes import ModalLine
from solver.proofs import SPAN, SPAN_LENGTH, span_modes

MASS, LENGTH = SPAN.mass_per_length, SPAN_LENGTH
MODES = 15


def frequencies(modes=MODES):
    return span_modes(modes)[0]


def damping_ratios(modes=MODES):
    return span_modes(modes)[1]


def beam_line(channels, modes=MODES, cells=640):
    """Modes sin(n pi x/L) of modal mass m L/2; phi^2 (2 lambda M + C) = 1, that is 2i omega_d M."""
    omega, zeta = frequencies(modes), damping_ratios(modes)
    damped = omega * np.sqrt(1 - zeta**2)
    scale = 1 / np.sqrt(2j * damped * MASS * LENGTH / 2)
    k = np.arange(1, modes + 1) * np.pi / LENGTH
    edges = np.linspace(0, LENGTH, cells + 1)
    h = LENGTH / cells
    v, d = np.sin(np.outer(edges, k)), h * k * np.cos(np.outer(edges, k))
    cubic = np.stack(
        [
            v[:-1],
            d[:-1],
            3 * (v[1:] - v[:-1]) - 2 * d[:-1] - d[1:],
            2 * (v[:-1] - v[1:]) + d[:-1] + d[1:],
        ],
        axis=1,
    )
    x = np.array(channels, dtype=float)
    return ModalLine(
        eigenvalues=-zeta * omega + 1j * damped,
        weights=np.full(modes, 2.0),
        grid_start=0.0,
        grid_step=h,
        rail_shapes=cubic * scale,
        residual=np.zeros((cells, 4)),
        channel_shapes=np.sin(np.outer(x, k)) * scale,
        channel_x=x,
        channel_residual=np.zeros((len(x), 3, 2, 5)),
        channel_band=np.full(len(x), omega[-1] / (2 * np.pi)),
        length=LENGTH,
        solved=modes,
        joint_shapes=np.zeros((0, modes), complex),
        channel_inertia=np.zeros((len(x), modes), complex),
    )
