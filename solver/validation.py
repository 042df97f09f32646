"""Evidence: fe against a second method, hybrid against fe, statistics against ensembles."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .hybrid import crossover_frequency
from .reference import Histories, extrapolated_run
from .scenario import Scenario, build_scenario, load_scenario
from .simulation import Simulation
from .statistics import (
    Partition,
    Response,
    partition,
    respond,
    respond_statistically,
    spacings,
)
from .waves import Real, rail_beam

THIRD_OCTAVES = np.array([630.0, 800, 1000, 1250, 1600, 2000, 2500, 3150, 4000, 5000])
"""Nominal centres (Hz) of the bands of the ensemble study."""


ADDED_MASS = 0.15
"""Share of the rail's mass that random masses add."""

MASSES = 12


def decibel(a: ArrayLike, b: ArrayLike) -> Real:
    """10 lg(a/b), both quantities squares."""
    return np.asarray(10 * np.log10(np.asarray(a) / np.asarray(b)))


class FreeRail:
    """A free rail of 9.75 m on 15 fastenings, Eq. (1) with 60 sines, 8 of them global.

    The first local mode is at 488 Hz, the last at 20 kHz. Loads: on the rail's end, where all
    sines vanish (only the global set is driven), and inside the span.
    """

    length = 9.75
    sines = 60
    global_sines = 8
    places = (0.0, 4.1)

    def __init__(self) -> None:
        track = load_scenario("demo").track
        beam = rail_beam(track)
        self.mass_per_length = beam.mass_per_length
        nodes, weights = np.polynomial.legendre.leggauss(200)
        x, w = self.length / 2 * (nodes + 1), self.length / 2 * weights
        value, curvature = self.shapes(x), self.shapes(x, curvature=True)
        self.mass: Real = beam.mass_per_length * (value.T * w) @ value
        stiffness = beam.bending_stiffness * (curvature.T * w) @ curvature
        fastenings = self.shapes((np.arange(15) + 0.5) * track.fastening.spacing)
        self.stiffness: Real = stiffness + 2 * track.fastening.stiffness * fastenings.T @ fastenings
        self.is_global: NDArray[np.bool_] = np.arange(4 + self.sines) < 4 + self.global_sines

    def shapes(self, x: ArrayLike, curvature: bool = False) -> Real:
        """Functions of Eq. (1), or their second derivatives, at ``x`` (m): (len(x), 64)."""
        place = np.atleast_1d(np.asarray(x, dtype=np.float64))
        s, n = place / self.length, np.arange(1, self.sines + 1) * math.pi / self.length
        if curvature:
            hermite = np.array(
                [
                    (-6 + 12 * s) / self.length**2,
                    (-4 + 6 * s) / self.length,
                    (6 - 12 * s) / self.length**2,
                    (-2 + 6 * s) / self.length,
                ]
            )
            return np.hstack((hermite.T, -(n**2) * np.sin(np.outer(place, n))))
        hermite = np.array(
            [
                1 - 3 * s**2 + 2 * s**3,
                self.length * (s - 2 * s**2 + s**3),
                3 * s**2 - 2 * s**3,
                self.length * (s**3 - s**2),
            ]
        )
        return np.hstack((hermite.T, np.sin(np.outer(place, n))))

    def mass_spread(self, part: Partition) -> Real:
        """(L,) rad/s: half width of natural frequencies under random masses, first order.

        A mass m at x lowers omega_k by omega_k m phi_k(x)^2/2; the sum of MASSES of them, at
        random places, is spread like an interval of sqrt(3) standard deviations.
        """
        x = (np.arange(2000) + 0.5) / 2000 * self.length
        local = self.shapes(x)[:, ~self.is_global] @ part.local_modes
        each = ADDED_MASS * self.mass_per_length * self.length / MASSES
        deviation = part.omega / 2 * each * math.sqrt(MASSES) * (local**2).std(axis=0)
        return np.asarray(math.sqrt(3) * deviation)

    def split(self, extra_mass: tuple[Real, Real] | None = None) -> tuple[Partition, Real, Real]:
        """Partition and the rows of both places; ``extra_mass``: positions (m), masses (kg)."""
        mass = self.mass
        if extra_mass is not None:
            rows = self.shapes(extra_mass[0])
            mass = mass + (rows.T * extra_mass[1]) @ rows
        part = partition(mass, self.stiffness, self.is_global)
        rows = self.shapes(np.array(self.places))
        return part, *part.load(rows[:, self.is_global], rows[:, ~self.is_global])


@dataclass(frozen=True, slots=True)
class BandError:
    """Statistical forms against an ensemble in one third octave, both load places.

    Attributes:
        frequency: centre (Hz).
        overlap: modal overlap n eta omega (-).
        error: {form: (3, 2)} dB of |w|^2, power, energy, against the ensemble mean.
        scatter: (3, 2) dB, standard deviation of one member's band level.
    """

    frequency: float
    overlap: float
    error: dict[Literal["paper", "repaired"], Real]
    scatter: Real


def _rows(response: Response) -> Real:
    return np.array([response.square, response.power, response.energy])


def ensemble_study(
    loss: float,
    samples: int = 500,
    disorder: Literal["modes", "masses"] = "modes",
    seed: int = 0,
    bands: ArrayLike = THIRD_OCTAVES,
) -> list[BandError]:
    """Monte-Carlo means of :class:`FreeRail` against both statistical forms, per third octave.

    Args:
        loss: hysteretic loss factor (-).
        samples: members of the ensemble.
        disorder: modes: every local natural frequency moves by up to one mean spacing either
            way; masses: 12 masses at random places add 15 % of the rail's mass, which moves natural
            frequencies by 1.5 %; the repaired form is told so.
        seed: of the ensemble.
        bands: centres (Hz).
    """
    rail, random = FreeRail(), np.random.default_rng(seed)
    part, rows_g, rows_p = rail.split()
    count = len(part.omega)
    ends = (2 * part.omega[0] - part.omega[1], 2 * part.omega[-1] - part.omega[-2])
    extended = np.concatenate(([ends[0]], part.omega, [ends[1]]))
    members: list[tuple[Partition, Real, Real, Real]] = []
    for _ in range(samples):
        if disorder == "modes":
            moved = np.arange(count) + random.uniform(-1, 1, count)
            omega_k = np.interp(moved, np.arange(-1, count + 1), extended)
            members.append((part, rows_g, rows_p, omega_k))
        else:
            each = ADDED_MASS * rail.mass_per_length * rail.length / MASSES
            places = random.uniform(0, rail.length, MASSES)
            other = rail.split((places, np.full(MASSES, each)))
            members.append((*other, other[0].omega))
    theory = part, rows_g, rows_p
    half_width = None
    if disorder == "masses":
        # the mean structure: the extra mass smeared over the rail
        smeared = partition(rail.mass * (1 + ADDED_MASS), rail.stiffness, rail.is_global)
        rows = rail.shapes(np.array(rail.places))
        theory = smeared, *smeared.load(rows[:, rail.is_global], rows[:, ~rail.is_global])
        half_width = rail.mass_spread(smeared)
    result = []
    for centre in np.asarray(bands, dtype=np.float64):
        omegas = 2 * np.pi * centre * 2 ** (np.linspace(-1, 1, 5) / 6 * 0.8)
        levels = np.zeros((samples, 3, 2))
        forms: dict[Literal["paper", "repaired"], Real] = {}
        for omega in omegas:
            for i, (p, g, f, omega_k) in enumerate(members):
                levels[i] += _rows(respond(p, g, f, loss, float(omega), omega_k))
        for form in ("paper", "repaired"):
            total = np.sum(
                [
                    _rows(respond_statistically(*theory, loss, float(w), form, half_width))
                    for w in omegas
                ],
                axis=0,
            )
            forms[form] = decibel(total, levels.mean(axis=0))
        near = 2 * np.pi * centre
        gap = float(np.interp(near, theory[0].omega, spacings(theory[0].omega)))
        result.append(
            BandError(float(centre), loss * near / gap, forms, decibel(levels, 1.0).std(axis=0))
        )
    return result


def comparison_scenario(
    model: Literal["fe", "hybrid"], seed: int, crossover: float | None = None
) -> Scenario:
    """One wheel element at 300 km/h over CRTS II track, seven rail channels within two bays."""
    spacing = 0.65
    places = 32.5 + spacing * np.array([0.0, 0.25, 0.5, 1.0, 1.3, 1.5, 1.75])
    channels = [{"name": f"rail_{i}", "layer": "rail", "x": float(x)} for i, x in enumerate(places)]
    channels += [
        {"name": layer, "layer": layer, "x": 36.0} for layer in ("slab", "support_layer", "bridge")
    ]
    solution: dict[str, object] = {"model": model, "seed": seed, "end_time": 1.4}
    if crossover is not None:
        solution["crossover"] = crossover
    return build_scenario(
        {
            "line": {"approach_left": 20.0, "spans": [32.0], "approach_right": 20.0},
            "train": [{"preset": "wheel_element", "speed": "300 km/h", "start": -30.0}],
            "contact": {"law": "linear"},
            "irregularity": {"spectrum": "sato", "seed": seed},
            "channel": channels,
            "solution": solution,
        }
    )


@dataclass(frozen=True, slots=True)
class Run:
    """One passage. Rail channels come first.

    Attributes:
        force: (n,) N. place: (n,) m, of the wheelset.
        acceleration, displacement: (n, C).
        modes, step, ratio: of the deterministic set: its size, the output's step (s) and the steps
            of the output that one of its steps spans.
        preparation, stepping: CPU time (s).
    """

    force: Real
    place: Real
    acceleration: Real
    displacement: Real
    modes: int
    step: float
    ratio: int
    preparation: float
    stepping: float


def run_passage(scenario: Scenario) -> Run:
    """Run a scenario of one wheelset to its end."""
    begin = time.process_time()
    simulation = Simulation(scenario, outputs=("displacement", "acceleration"))
    blocks = [simulation.advance(100)]
    middle = time.process_time()
    blocks += list(simulation.blocks(8000))
    end = time.process_time()
    return Run(
        np.concatenate([block.wheelset_force[:, 0] for block in blocks]),
        np.concatenate([block.wheelset_position[:, 0] for block in blocks]),
        np.concatenate([block.acceleration for block in blocks if block.acceleration is not None]),
        np.concatenate([block.displacement for block in blocks if block.displacement is not None]),
        simulation.states,
        simulation.step_ns * 1e-9,
        simulation.step_ratio,
        middle - begin,
        end - middle,
    )


COMPARED = 10 ** (np.arange(20, 38) / 10)
"""Exact centres (Hz) of the third octaves 100 Hz to 5 kHz."""

DISTANCES = (0.0, 5.0, 10.0, 15.0)
"""Distances (m) of wheel and channel at which envelopes are compared."""

WINDOW = 0.02
"""Length (s) of the running mean square."""


def band_signals(signal: Real, step: float, centres: Real = COMPARED) -> Real:
    """Third-octave parts of a signal, ideal filters: (B, n) from (n,)."""
    spectrum = np.fft.rfft(signal)
    frequency = np.fft.rfftfreq(len(signal), step)
    out = np.empty((len(centres), len(signal)))
    for i, centre in enumerate(centres):
        inside = (frequency >= centre * 10**-0.05) & (frequency < centre * 10**0.05)
        out[i] = np.fft.irfft(np.where(inside, spectrum, 0), len(signal))
    return out


def envelopes(run: Run, channel_x: Real) -> Real:
    """Mean squares in WINDOW at DISTANCES, both sides, mean over the rail channels, (D, B)."""
    half = round(WINDOW / run.step / 2)
    total = np.zeros((len(DISTANCES), len(COMPARED)))
    for c, x in enumerate(channel_x):
        squares = np.cumsum(band_signals(run.acceleration[:, c], run.step) ** 2, axis=1)
        for d, distance in enumerate(DISTANCES):
            for side in (-1, 1):
                at = int(np.argmin(np.abs(run.place - (x + side * distance))))
                total[d] += (squares[:, at + half] - squares[:, at - half]) / (2 * half)
    return np.asarray(total / (2 * len(channel_x)))


@dataclass(frozen=True, eq=False)
class Comparison:
    """hybrid against fe over several seeds of roughness; dB are hybrid less fe.

    Attributes:
        crossover: f_g (Hz).
        centres: (B,) Hz. distances: (D,) m.
        level: (seeds, B) dB, rail acceleration over the passage, mean of the channels.
        mean_level: (B,) dB of the seed means. layers: {layer: (B,) dB of the seed means}.
        envelope: (D, B) dB of the seed means. spread: (D, B) dB, standard error of ``envelope``.
        force_level: (B,) dB of the seed means. force_rms: (seeds,) ratio of the rms about the mean.
        displacement: (seeds,) largest relative difference of rail displacement peaks.
        fe, hybrid: the runs of the last seed.
    """

    crossover: float
    centres: Real
    distances: Real
    level: Real
    mean_level: Real
    layers: dict[str, Real]
    envelope: Real
    spread: Real
    force_level: Real
    force_rms: Real
    displacement: Real
    fe: Run
    hybrid: Run


def compare_models(seeds: int = 8, crossover: float | None = None) -> Comparison:
    """Run both models over ``seeds`` realisations and compare them."""
    found: dict[str, list[dict[str, Real]]] = {"fe": [], "hybrid": []}
    runs: dict[str, Run] = {}
    for seed in range(1, seeds + 1):
        for model in ("fe", "hybrid"):
            scenario = comparison_scenario(model, seed, crossover)
            run = run_passage(scenario)
            runs[model] = run
            x = np.array([c.x for c in scenario.channel if c.layer == "rail"])
            on = (run.place > 5) & (run.place < scenario.line.length - 5)
            force = run.force[on] - run.force[on].mean()
            parts = band_signals(force, run.step)
            below = np.fft.rfftfreq(len(force), run.step) < scenario.solution.frequency_limit
            limited = np.fft.irfft(np.where(below, np.fft.rfft(force), 0), len(force))
            squares = np.array(
                [
                    (band_signals(run.acceleration[:, c], run.step) ** 2).mean(axis=1)
                    for c in range(run.acceleration.shape[1])
                ]
            )
            found[model].append(
                {
                    "rail": squares[: len(x)].mean(axis=0),
                    "slab": squares[len(x)],
                    "support_layer": squares[len(x) + 1],
                    "bridge": squares[len(x) + 2],
                    "envelope": envelopes(run, x),
                    "force": (parts**2).mean(axis=1),
                    "rms": np.array(limited.std()),
                    "peak": np.abs(run.displacement[:, : len(x)]).max(axis=0),
                }
            )

    def mean(model: str, name: str) -> Real:
        return np.asarray(np.mean([entry[name] for entry in found[model]], axis=0))

    def every(model: str, name: str) -> Real:
        return np.array([entry[name] for entry in found[model]])

    relative = [
        every(model, "envelope").std(axis=0, ddof=1) / mean(model, "envelope") / math.sqrt(seeds)
        for model in ("fe", "hybrid")
    ]
    return Comparison(
        crossover_frequency(comparison_scenario("hybrid", 1, crossover)),
        COMPARED,
        np.array(DISTANCES),
        decibel(every("hybrid", "rail"), every("fe", "rail")),
        decibel(mean("hybrid", "rail"), mean("fe", "rail")),
        {
            layer: decibel(mean("hybrid", layer), mean("fe", layer))
            for layer in ("slab", "support_layer", "bridge")
        },
        decibel(mean("hybrid", "envelope"), mean("fe", "envelope")),
        np.asarray(10 / math.log(10) * np.hypot(*relative)),
        decibel(mean("hybrid", "force"), mean("fe", "force")),
        every("hybrid", "rms") / every("fe", "rms"),
        np.abs(every("hybrid", "peak") / every("fe", "peak") - 1).max(axis=1),
        runs["fe"],
        runs["hybrid"],
    )


REFERENCE_EDGES = (1000.0, 2000.0, 3000.0, 4500.0)
"""Low-pass edges (Hz) at which histories are compared with the second method."""

KERNEL = 1.5e-3
"""Half length (s) of the low-pass filter: a Kaiser-windowed sinc, the same at both rates."""


def reference_scenario(
    theory: Literal["timoshenko", "euler_bernoulli"] = "timoshenko",
    vehicle: dict[str, object] | None = None,
    end_time: float = 0.06,
    limit: float = 5000.0,
) -> Scenario:
    """A vehicle over a bridge of 16 bays between approaches of 12, irregularity to 4 kHz.

    The front wheelset runs from x = 10 m over the rail channel at x = 13 m, in the middle of a
    bay. The irregularity has the third octaves of Sato's spectrum, 31.5 Hz to 4 kHz at 300 km/h.

    Args:
        theory: of the rail.
        vehicle: vehicle table; a wheel element of CRH3 if not given.
        end_time: s. limit: frequency limit (Hz).
    """
    wavenumber = 2 * np.pi * 1000 * 10 ** (np.arange(-15, 7) / 10) / (300 / 3.6)
    # third octaves of 4.15e-7/k^3 as one component each
    amplitude = np.sqrt(2 * 4.15e-7 / wavenumber**2 * (10**0.05 - 10**-0.05))
    places = {"rail": 13.0, "slab": 13.2, "support_layer": 13.0, "bridge": 12.0}
    return build_scenario(
        {
            "track": {"rail": {"theory": theory}},
            "line": {"approach_left": 7.8, "spans": [10.4], "approach_right": 7.8},
            "train": [
                {
                    "vehicles": [vehicle or {"preset": "CRH3_wheel_element"}],
                    "speed": "300 km/h",
                    "start": 10.0,
                }
            ],
            "contact": {"law": "linear"},
            "irregularity": {
                "components": {
                    "wavenumber": wavenumber.tolist(),
                    "amplitude": amplitude.tolist(),
                    "phase": (2.4 * np.arange(len(wavenumber))).tolist(),
                }
            },
            "channel": [{"name": n, "layer": n, "x": x} for n, x in places.items()],
            "solution": {"end_time": end_time, "frequency_limit": limit},
        }
    )


@dataclass(frozen=True, slots=True)
class Agreement:
    """fe against the second method below one edge, the worse of all wheelsets.

    Attributes:
        quantity: such as ``force`` or ``rail acceleration``.
        edge: low-pass edge (Hz).
        error: largest difference per peak; of the force per range of its values (-).
        correlation: coefficient (-).
    """

    quantity: str
    edge: float
    error: float
    correlation: float


def compare_reference(
    scenario: Scenario | None = None,
    step: float = 6.25e-6,
    edges: tuple[float, ...] = REFERENCE_EDGES,
    theirs: Histories | None = None,
) -> list[Agreement]:
    """``fe`` against :func:`solver.reference.extrapolated_run`, sample by sample.

    Both are low-passed by the same filter; velocity and acceleration of the second method are
    derivatives of its displacement.

    Args:
        scenario: see :func:`reference_scenario`.
        step: larger step of the second method (s), a whole part of the scenario's.
        edges: low-pass edges (Hz).
        theirs: histories of the second method at ``step``, if they are there already.
    """
    scenario = reference_scenario() if scenario is None else scenario
    simulation = Simulation(scenario, outputs=("displacement", "velocity", "acceleration"))
    block = simulation.advance(simulation.end_index)
    theirs = extrapolated_run(scenario, step) if theirs is None else theirs
    ratio = round(scenario.solution.step / step)
    rows = []
    for edge in edges:

        def low(values: Real, h: float, edge: float = edge) -> Real:
            half = round(KERNEL / h)
            time = np.arange(-half, half + 1) * h
            weights = np.sinc(2 * edge * time) * np.kaiser(len(time), 8.0)
            weights /= weights.sum()
            columns = [np.convolve(column, weights, "same") for column in values.T]
            return np.asarray(np.stack(columns, axis=1), np.float64)

        motion = low(theirs.displacement, step)
        pairs = [("force", block.wheelset_force, low(theirs.force, step))]
        for name in ("displacement", "velocity", "acceleration"):
            pairs.append((name, getattr(block, name), motion))
            motion = np.gradient(motion, step, axis=0)
        # twice the filter's length is spoilt at either end
        inside = slice(round(2 * KERNEL / scenario.solution.step), None)
        for name, values, other in pairs:
            a, b = low(values, scenario.solution.step)[inside], other[::ratio][inside]
            a, b = a[: -inside.start], b[: -inside.start]
            for c in range(a.shape[1]):
                one, two = a[:, c], b[:, c]
                peak = float(np.ptp(two) if name == "force" else np.abs(two).max())
                label = name if name == "force" else f"{scenario.channel[c].name} {name}"
                error = float(np.abs(one - two).max()) / peak
                rows.append(Agreement(label, edge, error, float(np.corrcoef(one, two)[0, 1])))
    worst: dict[tuple[str, float], Agreement] = {}
    for row in rows:
        key = row.quantity, row.edge
        if key not in worst or row.error > worst[key].error:
            worst[key] = row
    return list(worst.values())
