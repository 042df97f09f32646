"""What the solver must show, item by item: target, figure found, met or missed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike, NDArray

from .beam import BeamSection
from .line import beam_field, beam_matrices
from .modal import ModalRun
from .modes import ModalLine, complex_modes
from .reference import extrapolated_run, vehicle_matrices
from .scenario import GRAVITY, Scenario, build_scenario
from .simulation import Simulation
from .traffic import Traffic
from .validation import (
    Agreement,
    BandError,
    Comparison,
    compare_reference,
    reference_scenario,
)

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Proof:
    """One item: what is compared, the target, what was found, and whether it is met."""

    item: str
    target: str
    found: str
    met: bool


REFERENCE_STEP = 6.25e-6
"""Larger step (s) of the second method; half of it changes accelerations below 4.5 kHz by 0.4 %."""

SPAN = BeamSection(bending_stiffness=3.45e10 * 12.744, mass_per_length=29_720.0)
"""The bare span of the comparison with the closed form."""

SPAN_LENGTH = 32.0
SPAN_DAMPING = 0.02
AXLE_FORCE = 156_960.0


def span_modes(count: int) -> tuple[Array, Array]:
    """Natural frequencies (rad/s) and damping ratios of the bare span, closed form."""
    n = np.arange(1, count + 1)
    root = math.sqrt(SPAN.bending_stiffness / SPAN.mass_per_length)
    omega = (n * np.pi / SPAN_LENGTH) ** 2 * root
    alpha, beta = rayleigh(float(omega[0]))
    return np.asarray(omega, np.float64), np.asarray((alpha / omega + beta * omega) / 2)


def rayleigh(first: float) -> tuple[float, float]:
    """Factors of mass and stiffness for SPAN_DAMPING at ``first`` and 4 ``first`` (rad/s)."""
    return 2 * SPAN_DAMPING * 4 * first / 5, 2 * SPAN_DAMPING / (5 * first)


def moving_force(
    x: float, time: ArrayLike, speed: float, entry: float = 0.0, count: int = 15
) -> tuple[Array, Array]:
    """Displacement (m) and acceleration (m/s^2) of the bare span at ``x`` per unit force moving.

    Series of L. Fryba, Vibration of Solids and Structures under Moving Loads, chapter 1: every
    mode is a damped oscillator under sin(Omega t) while the force is on the span, then free.

    Args:
        x: m. time: (n,) s. speed: m/s.
        entry: time at which the force enters (s).
        count: modes of the series.
    """
    t = np.asarray(time, dtype=np.float64)[:, None] - entry
    omega, zeta = span_modes(count)
    damped, decay = omega * np.sqrt(1 - zeta**2), zeta * omega
    k = np.arange(1, count + 1) * np.pi / SPAN_LENGTH
    forcing = k * speed
    leave = SPAN_LENGTH / speed
    strength = (omega**2 - forcing**2) ** 2 + (2 * decay * forcing) ** 2
    s, c = (omega**2 - forcing**2) / strength, -2 * decay * forcing / strength
    # q = s sin + c cos + exp(-decay t) (a cos + b sin), q(0) = q'(0) = 0
    a = -c
    b = (decay * a - s * forcing) / damped

    def forced(t: Array) -> tuple[Array, Array]:
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
    shape = np.sin(k * x) * 2 / (SPAN.mass_per_length * SPAN_LENGTH)
    return np.asarray(q @ shape), np.asarray(acceleration @ shape)


def bare_span(channels: Array, sines: int = 20, kept: int = 15, cells: int = 640) -> ModalLine:
    """The bare span as a line of its own: one hierarchical element, pinned, Rayleigh damping.

    Args:
        channels: positions (m).
        sines: hierarchical functions. kept: modes. cells: of the table of shapes.
    """
    field = beam_field(np.array([0.0, SPAN_LENGTH]), [sines], SPAN)
    mass, stiffness = (matrix.toarray() for matrix in beam_matrices(field, SPAN))
    free = np.setdiff1d(np.arange(field.size), [field.dofs[0][0], field.dofs[-1][2]])
    squared, shapes = scipy.linalg.eigh(stiffness[np.ix_(free, free)], mass[np.ix_(free, free)])
    omega, real = np.sqrt(squared[:kept]), np.zeros((field.size, kept))
    real[free] = shapes[:, :kept]
    alpha, beta = rayleigh(float(omega[0]))
    values, vectors, weights = complex_modes(omega, np.diag(alpha + beta * omega**2))
    edges = np.linspace(0, SPAN_LENGTH, cells + 1)
    h = SPAN_LENGTH / cells
    v = field.rows(edges) @ real @ vectors
    d = h * (field.rows(edges, 1) @ real @ vectors)
    cubic = np.stack(
        [
            v[:-1],
            d[:-1],
            3 * (v[1:] - v[:-1]) - 2 * d[:-1] - d[1:],
            2 * (v[:-1] - v[1:]) + d[:-1] + d[1:],
        ],
        axis=1,
    )
    return ModalLine(
        eigenvalues=values,
        weights=weights,
        grid_start=0.0,
        grid_step=h,
        rail_shapes=cubic,
        residual=np.zeros((cells, 4)),
        channel_shapes=field.rows(channels) @ real @ vectors,
        channel_x=channels,
        channel_residual=np.zeros((len(channels), 3, 2, 5)),
        channel_band=np.full(len(channels), omega[-1] / (2 * np.pi)),
        length=SPAN_LENGTH,
        solved=kept,
        joint_shapes=np.zeros((0, kept), complex),
        channel_inertia=np.zeros((len(channels), kept), complex),
    )


def rolling_weight(
    force: float,
    axles: Sequence[float],
    speed: float,
    *,
    start: float = 0.0,
    step: float = 2.5e-5,
    wheelset_mass: float = 1.0,
    contact: float = 1e6,
    **more: object,
) -> Scenario:
    """Wheelsets that push the bare span with (nearly) constant forces.

    The weight hangs on springs so soft (1 N/m) that they carry it whatever the wheelset does; a
    light wheelset on a soft contact spring follows the span with no more than its own inertia.

    Args:
        force: N. axles: distances behind the first wheelset (m).
        speed: m/s. start: of the first wheelset (m). step: s.
        wheelset_mass: kg. contact: stiffness of one wheel's contact (N/m).
        more: further tables of the scenario.
    """
    vehicle = {
        "kind": "wheel_element",
        "body_mass": 4 * (force / GRAVITY - 2 * wheelset_mass),
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
            "line": {"approach_left": 0, "spans": [SPAN_LENGTH], "approach_right": 0},
            "train": [
                {"vehicles": [vehicle], "speed": speed, "start": start - axle} for axle in axles
            ],
            "contact": {"stiffness": contact},
            "solution": {"step": step, "frequency_limit": 1000.0},
            **more,
        }
    )


def span_errors(speed: float = 83.33) -> tuple[float, float]:
    """Four axles over the bare span against the closed form, largest differences per peak.

    Returns:
        displacement, and acceleration below 60 Hz, of midspan (-).
    """
    from scipy import signal

    axles = [0.0, 2.5, 17.375, 19.875]
    stepper = ModalRun(
        bare_span(np.array([SPAN_LENGTH / 2])),
        Traffic(rolling_weight(AXLE_FORCE, axles, speed, start=-0.5)),
        (0, 2),
        precision=np.float64,
    )
    time, _, _, signals = stepper.advance(int((SPAN_LENGTH + 22) / speed / 2.5e-5) + 20_000)
    exact = np.zeros((2, len(time)))
    for axle in axles:
        exact += moving_force(SPAN_LENGTH / 2, time, speed, entry=(0.5 + axle) / speed)
    exact *= AXLE_FORCE
    low = signal.butter(6, 60, fs=40_000, output="sos")
    ours, theirs = (signal.sosfiltfilt(low, part) for part in (signals[:, 1], exact[1]))
    return (
        float(np.abs(signals[:, 0] - exact[0]).max() / np.abs(exact[0]).max()),
        float(np.abs(ours - theirs).max() / np.abs(theirs).max()),
    )


def static_error() -> float:
    """A CRH3 car stands on the line for 0.02 s: largest |sum of wheelset forces/weight - 1|."""
    scenario = build_scenario(
        {
            "line": {"approach_left": 13.0, "spans": [13.0], "approach_right": 13.0},
            "train": [{"vehicles": [{"preset": "CRH3"}], "speed": 1e-3, "start": 30.0}],
            "solution": {"end_time": 0.02, "frequency_limit": 1000.0},
        }
    )
    simulation = Simulation(scenario)
    block = simulation.advance(simulation.end_index)
    weight = scenario.train[0].mass * GRAVITY
    return float(np.abs(block.wheelset_force.sum(axis=1) / weight - 1).max())


def closure_error() -> float:
    """Does the reported force close the motion of wheel, rail and profile?

    The vehicle is moved by the reported forces alone, exactly for forces that are linear in a
    step. Where the wheel passes one of the rail's channels, its compression z - u - r must be the
    one that the contact law gives to the reported force. A force that lacks an inertia, such
    as that of the wheel on the profile, leaves a gap.

    Returns:
        largest gap times contact stiffness, per static load (-).
    """
    base = reference_scenario()
    train, step = base.train[0], base.solution.step
    # the wheel is right above the channels at these samples: the rail has a kink under it
    samples = 200 + 66 * np.arange(30)
    places: Array = train.start + train.speed * step * samples.astype(np.float64)
    channel = base.channel[0]
    scenario = base.model_copy(
        update={
            "channel": tuple(
                channel.model_copy(update={"name": f"rail_{i}", "x": float(x)})
                for i, x in enumerate(places)
            )
        }
    )
    simulation = Simulation(scenario, outputs=("displacement",))
    block = simulation.advance(simulation.end_index)
    force, rail = block.wheelset_force[:, 0], block.displacement
    parts = scenario.irregularity.components
    assert rail is not None and parts is not None
    k, amplitude, phase = (
        np.array(part) for part in (parts.wavenumber, parts.amplitude, parts.phase)
    )

    def profile(x: Array) -> Array:
        return np.asarray((amplitude * np.cos(np.outer(x, k) + phase)).sum(axis=1))

    mass, damping, stiffness, weight, wheels = vehicle_matrices(train)
    size = len(weight)
    flow, push = np.zeros((2 * size, 2 * size)), np.zeros((2 * size, 2))
    flow[:size, size:] = np.eye(size)
    flow[size:, :size], flow[size:, size:] = (
        -np.linalg.solve(mass, stiffness),
        -np.linalg.solve(mass, damping),
    )
    push[size:, 0] = weight / np.diag(mass)
    push[size + wheels[0], 1] = -1 / mass[wheels[0], wheels[0]]
    # integrals over a step of constant and linear loads (Van Loan)
    whole = np.zeros((2 * size + 4, 2 * size + 4))
    whole[: 2 * size, : 2 * size], whole[: 2 * size, 2 * size : 2 * size + 2] = flow, push
    whole *= step
    whole[2 * size : 2 * size + 2, 2 * size + 2 :] = np.eye(2)
    moved = scipy.linalg.expm(whole)
    transition = moved[: 2 * size, : 2 * size]
    constant = moved[: 2 * size, 2 * size : 2 * size + 2]
    linear = moved[: 2 * size, 2 * size + 2 :]
    spring = 2 * scenario.contact.stiffness
    state = np.zeros(2 * size)
    # at rest: every spring carries its share, the wheel lies on rail and profile
    rest = np.linalg.lstsq(stiffness, weight - _at(size, wheels[0]) * force[0], rcond=None)[0]
    state[:size] = rest - rest[wheels[0]]
    wheel = np.empty(len(force))
    wheel[0] = 0.0
    for n in range(1, len(force)):
        load = np.array([1.0, force[n - 1]])
        rise = np.array([0.0, force[n] - force[n - 1]])
        state = transition @ state + constant @ load + linear @ rise
        wheel[n] = state[wheels[0]]
    under = rail[samples, np.arange(len(samples))]
    gap = wheel[samples] - under - profile(places) - force[samples] / spring
    # the level of the start is known from the first place only
    return float(np.abs(gap - gap[0]).max() * spring / force[0])


def _at(size: int, index: int) -> Array:
    vector = np.zeros(size)
    vector[index] = 1.0
    return vector


def passage_energy() -> float:
    """Energy residual of a wheel element that crosses a line of 26 m modelled to 5 kHz (-)."""
    scenario = reference_scenario(end_time=0.45)
    train = scenario.train[0].model_copy(update={"start": -5.0})
    simulation = Simulation(scenario.model_copy(update={"train": (train,)}), balance=True)
    for _ in simulation.blocks():
        pass
    residual = simulation.quality.energy_residual
    assert residual is not None
    return residual


def _percent(item: str, limit: float, found: float) -> Proof:
    return Proof(item, f"{limit:.3g} %", f"{100 * found:.2g} %", 100 * found <= limit)


def line_proofs() -> list[Proof]:
    """Closed form, static load, equilibrium, energy, and ``fe`` against the second method."""
    displacement, acceleration = span_errors()
    proofs = [
        _percent("constant loads over the bare 32 m span: displacement", 0.01, displacement),
        _percent("... acceleration below 60 Hz", 1.0, acceleration),
        _percent("static load: sum of wheelset forces less weight", 0.01, static_error()),
        _percent("reported force closes wheel, rail and profile", 0.1, closure_error()),
        _percent("energy of a passage: work less loss and change", 0.1, passage_energy()),
    ]
    scenario = reference_scenario()
    theirs = extrapolated_run(scenario, REFERENCE_STEP)
    rows = compare_reference(scenario, REFERENCE_STEP, theirs=theirs)
    for edge in sorted({row.edge for row in rows}):
        below = [row for row in rows if row.edge == edge]
        groups = {
            "wheel force": [row for row in below if row.quantity == "force"],
            "displacement, four layers": [r for r in below if r.quantity.endswith("displacement")],
            "velocity, four layers": [r for r in below if r.quantity.endswith("velocity")],
            "acceleration, slab to bridge": [
                r
                for r in below
                if r.quantity.endswith("acceleration") and not r.quantity.startswith("rail")
            ],
            "acceleration, rail": [r for r in below if r.quantity == "rail acceleration"],
        }
        for name, group in groups.items():
            item = f"fe against the second method below {edge:.0f} Hz: {name}"
            proofs.append(_agreement(item, group))
    finer = reference_scenario(limit=7000.0)
    solution = finer.solution.model_copy(update={"step": 1.25e-5})
    finer = finer.model_copy(update={"solution": solution})
    rows = compare_reference(finer, REFERENCE_STEP, edges=(4500.0,), theirs=theirs)
    proofs.append(
        _agreement("... all quantities with frequency_limit = 7000 Hz and steps of 12.5 us", rows)
    )
    return proofs


def _agreement(item: str, rows: Sequence[Agreement]) -> Proof:
    error = max(row.error for row in rows)
    correlation = min(row.correlation for row in rows)
    return Proof(
        item,
        "1 % of peak, correlation 0.999",
        f"{100 * error:.2f} %, {correlation:.6f}",
        error <= 0.01 and correlation >= 0.999,
    )


def hybrid_proofs(found: Comparison) -> list[Proof]:
    """``hybrid`` against ``fe`` over the seeds of a comparison."""
    local = found.centres * 10**0.05 > found.crossover * 1.05
    proofs = []

    def level(item: str, limit: float, values: Array) -> None:
        worst = float(values.flat[np.abs(values).argmax()])
        proofs.append(Proof(item, f"± {limit:g} dB", f"{worst:+.2f} dB", abs(worst) <= limit))

    level("hybrid less fe, rail: global third octaves, every seed", 1.0, found.level[:, ~local])
    level("... local third octaves to 5 kHz, mean of seeds", 1.5, found.mean_level[local])
    for distance, envelope in zip(found.distances, found.envelope, strict=True):
        name = f"... envelope (20 ms) at {distance:.0f} m"
        level(f"{name}, global third octaves", 1.0, envelope[~local])
        level(f"{name}, local third octaves", 1.5, envelope[local])
    rms = float(np.abs(found.force_rms - 1).max())
    third = float(np.abs(10 ** (found.force_level[local] / 20) - 1).max())
    proofs += [
        _percent("... wheel force, rms about the mean", 3.0, rms),
        _percent("... wheel force, local third octaves", 10.0, third),
        _percent("... largest rail displacement", 1.0, float(found.displacement.max())),
    ]
    fe, hybrid = found.fe, found.hybrid
    proofs.append(
        Proof(
            "hybrid cheaper than fe: modes, step, CPU of stepping one passage",
            "cheaper",
            f"{hybrid.modes} to {fe.modes}, {1e6 * hybrid.step * hybrid.ratio:.0f} to "
            f"{1e6 * fe.step * fe.ratio:.0f} us, {fe.stepping / hybrid.stepping:.1f} x",
            hybrid.stepping < fe.stepping,
        )
    )
    return proofs


OVERLAPS = (
    (0.45, math.inf, 0.6, 0.6),
    (0.15, 0.45, 1.3, 1.8),
    (0.05, 0.15, 2.0, 2.0),
)
"""Classes of modal overlap, from and to, with the target for |w|^2 (dB) driven at end and span."""

FLOW_TARGET = 0.35
"""Target for power and energy (dB)."""


def ensemble_proofs(studies: Mapping[float, Sequence[BandError]], samples: int) -> list[Proof]:
    """Statistical local modes against ensembles: worst band of every class of modal overlap.

    Met is what lies within the target and two standard errors of the ensemble's mean.

    Args:
        studies: {loss factor: bands}. samples: members of every ensemble.
    """
    bands = [band for study in studies.values() for band in study]
    proofs = []
    for low, high, *squares in OVERLAPS:
        inside = [band for band in bands if low < band.overlap <= high]
        for index, name in enumerate(("|w|²", "power in", "local energy")):
            for place, where in enumerate(("end", "span")):
                if not inside:
                    continue
                limit = squares[place] if index == 0 else FLOW_TARGET
                errors = [float(band.error["repaired"][index, place]) for band in inside]
                worst = int(np.argmax(np.abs(errors)))
                scatter = float(inside[worst].scatter[index, place])
                doubts = [float(b.scatter[index, place]) / math.sqrt(samples) for b in inside]
                doubt = doubts[worst]
                reach = f"{low:g} to {high:g}" if math.isfinite(high) else f"above {low:g}"
                proofs.append(
                    Proof(
                        f"statistics less {samples} rails, overlap {reach}, {where}: {name}",
                        f"± {limit:g} dB",
                        f"{errors[worst]:+.2f} ± {doubt:.2f} dB (one rail: {scatter:.1f} dB)",
                        all(
                            abs(error) <= limit + 2 * d
                            for error, d in zip(errors, doubts, strict=True)
                        ),
                    )
                )
    return proofs
