"""The paper's Figs. 3-8 from the scenario preset ``paper``, and its claims beside our numbers."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from solver import (
    ClassRun,
    InputError,
    Scenario,
    Simulation,
    load_scenario,
    pinned_pinned_frequency,
    rail_frequency,
    run_classes,
    wavelength_classes,
)

Array = NDArray[np.float64]
Signal = Literal["displacement", "velocity", "acceleration"]

REALISATIONS = 40
"""Of the roughness, for the mean spectrum of Fig. 8: 8 do not decide its highest peak."""

RESOLUTION = 25.0
"""Bandwidth (Hz) of the smoothed spectrum of Fig. 8."""

FIGURES = ("fig3", "fig4", "fig5", "fig6", "fig7", "fig8")


@dataclass(frozen=True, eq=False)
class Passage:
    """A run of the paper's example.

    Attributes:
        time: (n,) s. place: (n,) m and force: (n,) N, of the wheelset.
        displacement, velocity, acceleration: {channel: (n,)} m, m/s, m/s², positive down.
        states: size of the deterministic set. steps: number of its steps.
        cost: CPU time of stepping (s).
    """

    time: Array
    place: Array
    force: Array
    displacement: dict[str, Array]
    velocity: dict[str, Array]
    acceleration: dict[str, Array]
    states: int
    steps: int
    cost: float


@dataclass(frozen=True, slots=True)
class Claim:
    """What the paper says and what its example gives here."""

    paper: str
    found: str


def variant(
    scenario: Scenario, model: Literal["fe", "hybrid"], *, resolved: bool, seed: int = 1
) -> Scenario:
    """The example with another model; ``resolved``: as many functions as 5 kHz needs."""
    change: dict[str, Any] = {"model": model}
    if resolved:
        change |= {"sines": None, "integrator": "exponential"}
    return scenario.model_copy(
        update={
            "solution": scenario.solution.model_copy(update=change),
            "irregularity": scenario.irregularity.model_copy(update={"seed": seed}),
        }
    )


def run(scenario: Scenario) -> Passage:
    """Run a scenario with one wheelset to its end."""
    simulation = Simulation(scenario, outputs=("displacement", "velocity", "acceleration"))
    blocks = [simulation.advance(50)]
    begin = time.process_time()
    blocks += list(simulation.blocks(4000))
    cost = time.process_time() - begin

    def channels(signal: Signal) -> dict[str, Array]:
        values = np.concatenate([getattr(block, signal) for block in blocks])
        return dict(zip(simulation.channels, values.T, strict=True))

    samples = sum(len(block.time) for block in blocks)
    return Passage(
        np.concatenate([block.time for block in blocks]),
        np.concatenate([block.wheelset_position[:, 0] for block in blocks]),
        np.concatenate([block.wheelset_force[:, 0] for block in blocks]),
        channels("displacement"),
        channels("velocity"),
        channels("acceleration"),
        simulation.states,
        samples // simulation.step_ratio,
        cost,
    )


def spectrum(passages: list[Passage], channel: str) -> tuple[Array, Array]:
    """Frequency (Hz) and mean power spectral density of velocity (m²/s²/Hz), smoothed."""
    first = passages[0]
    step, n = float(first.time[1] - first.time[0]), len(first.time)
    window = np.hanning(n)
    squares = [np.abs(np.fft.rfft(p.velocity[channel] * window)) ** 2 for p in passages]
    density = 2 * step * np.mean(squares, axis=0) / (window**2).sum()
    width = max(1, round(RESOLUTION * n * step))
    frequency = np.fft.rfftfreq(n, step).astype(np.float64)
    return frequency, np.convolve(density, np.ones(width) / width, "same")


def highest(frequency: Array, density: Array, above: float, below: float) -> float:
    """Frequency (Hz) of the largest value between two frequencies (Hz)."""
    inside = (frequency > above) & (frequency < below)
    return float(frequency[inside][np.argmax(density[inside])])


def fall(passage: Passage, channel: str, x: float, distance: float = 10.0) -> float:
    """Acceleration level in 20 ms about the wheel at ``x``, less that at ``distance`` (dB)."""
    step = float(passage.time[1] - passage.time[0])
    half = round(0.01 / step)
    squares = np.cumsum(passage.acceleration[channel] ** 2)

    def level(place: float) -> float:
        at = int(np.argmin(np.abs(passage.place - place)))
        return float(squares[at + half] - squares[at - half])

    away = (level(x - distance) + level(x + distance)) / 2
    return 10 * float(np.log10(level(x) / away))


def band_differences(found: ClassRun, passage: Passage) -> Array:
    """Level of the force in the bands of ``found``, less that of a passage (dB), (B,).

    A twentieth of a run's length is left out at both ends.
    """
    inside = slice(len(found.time) // 20, -(len(found.time) // 20))
    step = float(found.time[1] - found.time[0])
    power = []
    for force in (found.force[inside], passage.force[inside]):
        tapered = (force - force.mean()) * np.hanning(len(force))
        power.append(np.abs(np.fft.rfft(tapered)) ** 2)
    frequency = np.fft.rfftfreq(len(tapered), step)
    half = 10**0.05
    bands = [(frequency >= f / half) & (frequency < f * half) for f in found.bands]
    return np.array([10 * np.log10(power[0][b].sum() / power[1][b].sum()) for b in bands])


@dataclass(frozen=True, eq=False)
class Study:
    """All runs behind the figures and the claims."""

    scenario: Scenario
    hybrid: Passage
    fe: Passage
    resolved: Passage
    resolved_hybrid: Passage
    classes: ClassRun
    seeds: list[Passage]


def study(realisations: int = REALISATIONS) -> Study:
    """Run the example: as printed (hybrid, and its global set alone) and resolved to 5 kHz."""
    scenario = load_scenario("paper")
    resolved = [
        run(variant(scenario, "fe", resolved=True, seed=seed))
        for seed in range(1, realisations + 1)
    ]
    return Study(
        scenario,
        run(scenario),
        run(variant(scenario, "fe", resolved=False)),
        resolved[0],
        run(variant(scenario, "hybrid", resolved=True)),
        run_classes(scenario),
        resolved,
    )


def claims(found: Study) -> list[Claim]:
    """The paper's claims and our numbers, inconsistencies included."""
    scenario, full = found.scenario, found.resolved
    track, line = scenario.track, scenario.line
    speed = scenario.train[0].speed
    static = scenario.train[0].mass * 9.81 / 1e3
    force = full.force / 1e3
    peak = {name: float(np.abs(a).max()) for name, a in full.acceleration.items()}
    deep = {name: 1e3 * float(np.abs(u).max()) for name, u in full.displacement.items()}
    frequency, density = spectrum(found.seeds, "rail_mid")
    _, hybrid_density = spectrum([found.hybrid], "rail_mid")
    top = highest(frequency, density, 500, 5000)
    far = np.where(np.abs(frequency / top - 1) > 0.1, density, 0.0)
    second = highest(frequency, far, 500, 5000)
    lead = 10 * np.log10(density[frequency == top].item() / density[frequency == second].item())
    hybrid_upper = highest(frequency, hybrid_density, 1000, 5000)
    middle = line.length / 2
    falls = {name: fall(full, name, middle) for name in full.acceleration}
    sines = scenario.solution.sines
    assert sines is not None
    reach = rail_frequency(track, sines[0] * np.pi / line.length)
    needed = {
        limit: next(
            n for n in range(1, 1000) if rail_frequency(track, n * np.pi / line.length) >= limit
        )
        for limit in (3000, 5000)
    }
    short, long = wavelength_classes(speed, 3000.0, 5000.0)
    differences = band_differences(found.classes, full)
    a, b = found.resolved, found.resolved_hybrid
    return [
        Claim(
            "Fig. 3: wheel-rail force varies about the static load",
            f"mean {force.mean():.1f} kN, static {static:.1f} kN; "
            f"{force.min():.0f} to {force.max():.0f} kN",
        ),
        Claim(
            "Figs. 4-5 (both captioned rail displacement): evident peaks of rail and bridge",
            f"rail {deep['rail_mid']:.2f} mm, slab {deep['slab_mid']:.2f} mm, "
            f"bridge {deep['bridge_mid']:.2f} mm",
        ),
        Claim(
            "Figs. 6-7: acceleration of the rail far above that of the bridge",
            f"rail {peak['rail_mid']:.0f}, slab {peak['slab_mid']:.1f}, support layer "
            f"{peak['support_layer_mid']:.1f}, bridge {peak['bridge_mid']:.2f} m/s² to 5 kHz",
        ),
        Claim(
            "(1) type, arrival, passing, departure and speed follow from the accelerations of rail "
            "and bridge",
            "of the rail: yes (`trackvib demo`); one wheel element has no type. "
            "Of the bridge: its displacement peaks once per passage, its acceleration shows no "
            "wheels, as (2) says itself; it gives presence, neither axles nor speed",
        ),
        Claim(
            "(1), (2): wheels can be told in the rail, not in track slab and girder",
            f"level at the wheel over level 10 m away: rail {falls['rail_mid']:.0f} dB, slab "
            f"{falls['slab_mid']:.0f} dB, support layer {falls['support_layer_mid']:.0f} dB, "
            f"bridge {falls['bridge_mid']:.0f} dB",
        ),
        Claim(
            "(2) Fig. 8: PSD of rail speed largest at about 1400 Hz, the rail's first frequency",
            f"pinned-pinned frequency {pinned_pinned_frequency(track):.0f} Hz. Mean of "
            f"{len(found.seeds)} realisations in bands of {RESOLUTION:.0f} Hz: above 500 Hz "
            f"highest at {top:.0f} Hz, {lead:.1f} dB over the next at {second:.0f} Hz; single "
            "realisations may have it elsewhere. Below 500 Hz the passage itself is higher. With "
            f"31 sines (hybrid, one realisation) highest above 1 kHz at {hybrid_upper:.0f} Hz",
        ),
        Claim(
            "35 rail degrees of freedom are the global set up to 3000 Hz",
            f"{sines[0]} sines on {line.length:g} m reach {reach:.0f} Hz; 3000 Hz needs "
            f"{needed[3000]}, 5000 Hz {needed[5000]}",
        ),
        Claim(
            "roughness wavelengths 0.005-0.25 mm",
            f"metres: at {speed * 3.6:.0f} km/h millimetres would be "
            f"{speed / 0.25e-3 / 1e3:.0f} kHz to {speed / 0.005e-3 / 1e6:.1f} MHz",
        ),
        Claim(
            "effective mass for 0.005-0.01, damping for 0.01-0.1, nothing for 0.1-0.25",
            f"for 3000-5000 Hz the limits are v/f: mass below {short:.4f} m, damping to "
            f"{long:.4f} m, nothing above",
        ),
        Claim(
            "Eq. (9) applies where omega_k = omega",
            "where omega_k << omega; equality is Eq. (10)'s case",
        ),
        Claim(
            "Eq. (10): -i pi omega³/2 n <j²>; the local modes damp the global ones",
            "subtracted in Eq. (5), with exp(+i omega t): D_gg gains +i pi omega³/2 n <j²>",
        ),
        Claim(
            'power input is estimated from "Eq. 14", which is not printed',
            "Eq. (13) is meant. It is zero here: the local modes are orthogonal to the global set "
            "of complex modes, and all power is what the wheel puts in directly",
        ),
        Claim(
            "the three classes of local modes in the time domain",
            f"superposed runs, each of {len(found.classes.bands)} third octaves above "
            f"{reach:.0f} Hz with its own M and C: force rms about the mean "
            f"{found.classes.force.std() / 1e3:.2f} kN, of fe resolved "
            f"{full.force.std() / 1e3:.2f} kN; third octaves {differences.min():+.1f} to "
            f"{differences.max():+.1f} dB of fe",
        ),
        Claim(
            "(3) the hybrid has fewer degrees of freedom and is efficient",
            f"same band to 5 kHz: fe {a.states} modes, {a.steps} steps, {a.cost:.2f} s; hybrid "
            f"{b.states} modes, {b.steps} steps, {b.cost:.2f} s of CPU; force rms about the mean "
            f"{a.force.std() / 1e3:.2f} and {b.force.std() / 1e3:.2f} kN",
        ),
    ]


def draw(found: Study, folder: Path) -> list[Path]:
    """Write fig3.png ... fig8.png and claims.md into ``folder``; returns the paths.

    Raises:
        InputError: ``folder`` is a file, or one of its files exists already.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    paths = output_paths(folder)
    folder.mkdir(parents=True, exist_ok=True)
    scenario, hybrid, full = found.scenario, found.hybrid, found.resolved
    milliseconds = 1e3 * hybrid.time
    named = "hybrid, DOF 35/35/35/10", "fe resolved to 5 kHz"

    def curves(path: Path, y: tuple[Array, Array], label: str, caption: str) -> None:
        figure, axes = plt.subplots(figsize=(8, 4.2), layout="constrained")
        axes.plot(milliseconds, y[1], lw=0.6, color="0.6", label=named[1])
        axes.plot(milliseconds, y[0], lw=0.6, color="C0", label=named[0])
        axes.set_xlabel("time (ms)")
        axes.set_ylabel(label)
        axes.legend(loc="upper right")
        axes.grid(alpha=0.3)
        figure.suptitle(caption, fontsize=9, wrap=True)
        figure.savefig(path, dpi=150)
        plt.close(figure)

    def both(signal: Signal, channel: str, factor: float) -> tuple[Array, Array]:
        return (
            factor * getattr(hybrid, signal)[channel],
            factor * getattr(full, signal)[channel],
        )

    force = hybrid.force / 1e3
    curves(
        paths[0],
        (force, full.force / 1e3),
        "wheelset force (kN)",
        f"Fig. 3  Wheel-rail force of one wheelset at 300 km/h: {force.min():.0f} to "
        f"{force.max():.0f} kN, mean {force.mean():.1f} kN",
    )
    for path, channel, number in ((paths[1], "rail_mid", 4), (paths[2], "bridge_mid", 5)):
        y = both("displacement", channel, 1e3)
        name = channel.removesuffix("_mid")
        curves(
            path,
            y,
            f"{name} displacement, down (mm)",
            f"Fig. {number}  Mid-span {name} displacement: largest {np.abs(y[0]).max():.3f} mm "
            f"({np.abs(y[1]).max():.3f} mm resolved)",
        )
    for path, channel, number in ((paths[3], "rail_mid", 6), (paths[4], "bridge_mid", 7)):
        y = both("acceleration", channel, -1.0)
        name = channel.removesuffix("_mid")
        curves(
            path,
            y,
            f"{name} acceleration, up (m/s²)",
            f"Fig. {number}  Mid-span {name} acceleration to 5 kHz: largest "
            f"{np.abs(y[0]).max():.3g} m/s² ({np.abs(y[1]).max():.3g} m/s² resolved)",
        )
    frequency, density = spectrum(found.seeds, "rail_mid")
    _, one = spectrum([hybrid], "rail_mid")
    peak = highest(frequency, density, 500, 5000)
    figure, axes = plt.subplots(figsize=(8, 4.2), layout="constrained")
    axes.semilogy(
        frequency, density, color="0.3", lw=1, label=f"{named[1]}, {len(found.seeds)} realisations"
    )
    axes.semilogy(frequency, one, color="C0", lw=0.8, label=f"{named[0]}, one realisation")
    axes.axvline(
        pinned_pinned_frequency(scenario.track), color="C3", lw=0.8, ls="--", label="pinned-pinned"
    )
    axes.set_xlim(0, 5000)
    axes.set_ylim(density[frequency < 5000].min() / 3, density.max() * 3)
    axes.set_xlabel("frequency (Hz)")
    axes.set_ylabel("PSD of rail velocity (m²/s²/Hz)")
    axes.legend()
    axes.grid(alpha=0.3)
    figure.suptitle(
        f"Fig. 8  PSD of mid-span rail velocity, {RESOLUTION:.0f} Hz bandwidth: highest above "
        f"500 Hz at {peak:.0f} Hz; pinned-pinned {pinned_pinned_frequency(scenario.track):.0f} Hz",
        fontsize=9,
    )
    figure.savefig(paths[5], dpi=150)
    plt.close(figure)
    rows = [f"| {claim.paper} | {claim.found} |" for claim in claims(found)]
    paths[6].write_text(
        "\n".join(["| the paper's claim | what we find |", "|---|---|", *rows]) + "\n",
        encoding="utf-8",
    )
    return paths


def output_paths(folder: Path) -> list[Path]:
    """The files of :func:`draw`.

    Raises:
        InputError: ``folder`` is a file, or one of its files exists already.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"output {folder}: is a file, not a folder; choose another -o")
    paths = [folder / f"{name}.png" for name in FIGURES] + [folder / "claims.md"]
    for path in paths:
        if path.exists():
            raise InputError(f"output {path}: exists already, not overwriting; choose another -o")
    return paths
