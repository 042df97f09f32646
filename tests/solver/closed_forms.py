"""A simply supported beam as a line of modes, and closed forms of forces that move over it."""

from __future__ import annotations

import numpy as np

from solver.modes import ModalLine
from solver.scenario import build_scenario

STIFFNESS = 3.45e10 * 12.744
MASS = 29720.0
LENGTH = 32.0
SHARE = 0.02
MODES = 15


def frequencies(modes=MODES):
    n = np.arange(1, modes + 1)
    return (n * np.pi / LENGTH) ** 2 * np.sqrt(STIFFNESS / MASS)


def damping_ratios(modes=MODES):
    """Rayleigh damping of 2 % at the first two modes (omega_2 = 4 omega_1)."""
    omega = frequencies(modes)
    alpha, beta = 2 * SHARE * 4 * omega[0] / 5, 2 * SHARE / (5 * omega[0])
    return (alpha / omega + beta * omega) / 2


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
    )


def moving_force(x, t, speed, entry=0.0, modes=MODES):
    """Displacement and acceleration at ``x`` per unit force that enters at time ``entry``.

    Series of L. Fryba, Vibration of Solids and Structures under Moving Loads, chapter 1: every
    mode is a damped oscillator under sin(Omega t) while the force is on the span, then free.
    """
    t = np.asarray(t, dtype=float)[:, None] - entry
    omega, zeta = frequencies(modes), damping_ratios(modes)
    damped, decay = omega * np.sqrt(1 - zeta**2), zeta * omega
    k = np.arange(1, modes + 1) * np.pi / LENGTH
    forcing = k * speed
    leave = LENGTH / speed
    strength = (omega**2 - forcing**2) ** 2 + (2 * decay * forcing) ** 2
    s, c = (omega**2 - forcing**2) / strength, -2 * decay * forcing / strength
    # q = s sin + c cos + exp(-decay t) (a cos + b sin), q(0) = q'(0) = 0
    a = -c
    b = (decay * a - s * forcing) / damped

    def forced(t):
        e = np.exp(-decay * t)
        q = s * np.sin(forcing * t) + c * np.cos(forcing * t)
        q = q + e * (a * np.cos(damped * t) + b * np.sin(damped * t))
        v = forcing * (s * np.cos(forcing * t) - c * np.sin(forcing * t))
        v = v + e * (
            (damped * b - decay * a) * np.cos(damped * t)
            - (damped * a + decay * b) * np.sin(damped * t)
        )
        return q, v

    on = (t >= 0) & (t <= leave)
    q, v = forced(np.clip(t, 0, leave))
    end_q, end_v = forced(np.array([[leave]]))
    free = np.clip(t - leave, 0, None)
    e = np.exp(-decay * free)
    sine = (end_v + decay * end_q) / damped
    q_free = e * (end_q * np.cos(damped * free) + sine * np.sin(damped * free))
    v_free = e * (
        (damped * sine - decay * end_q) * np.cos(damped * free)
        - (damped * end_q + decay * sine) * np.sin(damped * free)
    )
    after = t > leave
    q, v = np.where(after, q_free, np.where(on, q, 0)), np.where(after, v_free, np.where(on, v, 0))
    acceleration = np.where(on, np.sin(forcing * t), 0) - 2 * decay * v - omega**2 * q
    shape = np.sin(k * x) * 2 / (MASS * LENGTH)
    return q @ shape, acceleration @ shape


def rolling_weight(
    force, axles, speed, *, start=0.0, step=2.5e-5, wheelset_mass=1.0, contact=1e6, **more
):
    """Scenario of wheelsets that push with (nearly) constant forces on a 32 m span.

    The weight hangs on springs so soft (1 N/m) that they carry it whatever the wheelset does; a
    light wheelset on a soft contact spring follows the beam with no more than its own inertia.
    """
    vehicle = {
        "kind": "wheel_element",
        "body_mass": 4 * (force / 9.81 - 2 * wheelset_mass),
        "bogie_mass": 2 * wheelset_mass,
        "wheelset_mass": wheelset_mass,
        "primary_stiffness": 1.0,
        "primary_damping": 0.0,
        "secondary_stiffness": 2.0,
        "secondary_damping": 0.0,
        "wheel_radius": 0.46,
        "length": 1.0,
    }
    return build_scenario(
        {
            "line": {"approach_left": 0, "spans": [LENGTH], "approach_right": 0},
            "train": [
                {"vehicles": [vehicle], "speed": speed, "start": start - axle} for axle in axles
            ],
            "contact": {"stiffness": contact},
            "solution": {"step": step, "frequency_limit": 1000.0},
            **more,
        }
    )
