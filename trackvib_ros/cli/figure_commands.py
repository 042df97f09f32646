"""Commands that show evidence: ``figures`` and ``validate``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from solver import (
    InputError,
    Proof,
    compare_models,
    ensemble_proofs,
    ensemble_study,
    hybrid_proofs,
    line_proofs,
)


def register(app: typer.Typer) -> None:
    """Add this group's commands to the application."""
    app.command()(figures)
    app.command()(validate)


def figures(
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the files.")],
) -> None:
    """Draw the paper's Figs. 3-8 from the scenario preset paper, and check its claims.

    Writes fig3.png ... fig8.png and claims.md: the paper's claims beside what we find.
    """
    from trackvib_ros.figures import claims, draw, output_paths, study

    output_paths(output)
    console = Console(stderr=True, highlight=False)
    with console.status("running the paper's example"):
        found = study()
        paths = draw(found, output)
    table = Table(title="the paper's example", title_style="bold", show_lines=True)
    table.add_column("the paper's claim", ratio=1)
    table.add_column("what we find", ratio=1)
    for claim in claims(found):
        table.add_row(claim.paper, claim.found)
    Console(highlight=False).print(table)
    console.print(f"{len(paths)} files in {output}")


def validate(
    seeds: Annotated[
        int, typer.Option("--seeds", help="Roughness realisations, hybrid against fe.")
    ] = 8,
    samples: Annotated[
        int, typer.Option("--samples", help="Members of every Monte-Carlo ensemble.")
    ] = 2000,
    crossover: Annotated[
        float | None, typer.Option("--crossover", help="Crossover f_g in Hz; unset: chosen.")
    ] = None,
) -> None:
    """Show what the solver must show, target beside figure, and the tables behind it.

    fe against closed forms and a second method, hybrid against fe, statistics of local modes
    against ensembles. Hybrid against fe: one wheel element at 300 km/h over CRTS II track on a
    32 m span with approaches, linear contact, Sato roughness; levels in dB are hybrid less fe.
    """
    if seeds < 2:
        raise InputError(f"--seeds = {seeds}: at least 2 are needed for a mean and its doubt")
    if samples < 50:
        raise InputError(f"--samples = {samples}: at least 50 make an ensemble")
    console = Console(highlight=False)
    progress = Console(stderr=True, highlight=False)
    with progress.status("fe, closed forms and the second method"):
        proofs = line_proofs()
    with progress.status(f"fe and hybrid, {seeds} realisations each"):
        found = compare_models(seeds, crossover)

    table = Table(
        title=f"hybrid less fe, third octaves, mean of {seeds} seeds (dB); crossover "
        f"{found.crossover:.0f} Hz",
        title_style="bold",
    )
    headings = ["Hz", "rail", "worst\nseed", "force", "slab", "layer"]
    headings += [f"rail at\n{distance:.0f} m" for distance in found.distances]
    for heading in headings:
        table.add_column(heading, justify="right")
    for i, centre in enumerate(found.centres):
        levels = [
            found.mean_level[i],
            found.level[np.argmax(np.abs(found.level[:, i])), i],
            found.force_level[i],
            found.layers["slab"][i],
            found.layers["support_layer"][i],
        ]
        table.add_row(
            f"{centre:.0f}",
            *(f"{value:+.1f}" for value in levels),
            *(
                f"{found.envelope[d, i]:+.1f}±{found.spread[d, i]:.1f}"
                for d in range(len(found.distances))
            ),
            end_section=bool(centre * 10**0.05 < found.crossover * 1.05 < centre * 10**0.15),
        )
    console.print(table)
    console.print(
        "± is the standard error of the seeds; below the crossover motion is deterministic in "
        "both models and the seeds' scatter cancels. fe resolves the support layer to 2 kHz."
    )
    worst = np.abs(found.force_rms - 1).max()
    console.print(
        f"wheelset force, rms about its mean below 5 kHz: {100 * worst:.2f} % at worst; "
        f"largest rail displacement: {100 * found.displacement.max():.3f} % at worst"
    )

    table = Table(title="cost of one passage", title_style="bold")
    for heading in ("model", "modes", "step, µs", "CPU s", "preparation, CPU s"):
        table.add_column(heading, justify="right")
    for name, run in (("fe", found.fe), ("hybrid", found.hybrid)):
        table.add_row(
            name,
            str(run.modes),
            f"{1e6 * run.step * run.ratio:.0f}",
            f"{run.stepping:.2f}",
            f"{run.preparation:.2f}",
        )
    console.print(table)

    proofs += hybrid_proofs(found)
    studies = {}
    for loss in (0.01, 0.03, 0.1, 0.3):
        with progress.status(f"{samples} free rails with loss factor {loss}"):
            bands = studies[loss] = ensemble_study(loss, samples)
        table = Table(
            title=f"statistical local modes less mean of {samples} rails (dB), loss factor {loss}; "
            "|w|², power in, local energy",
            title_style="bold",
        )
        table.add_column("Hz", justify="right")
        table.add_column("overlap", justify="right")
        for where in ("end", "span"):
            for form in ("repaired", "paper", "one rail's scatter"):
                table.add_column(f"{where}:\n{form}", justify="right")
        for band in bands:
            cells = []
            for place in (0, 1):
                for values in (band.error["repaired"], band.error["paper"]):
                    cells.append(" ".join(f"{value:+.1f}" for value in values[:, place]))
                cells.append(" ".join(f"{value:.1f}" for value in band.scatter[:, place]))
            table.add_row(f"{band.frequency:.0f}", f"{band.overlap:.2f}", *cells)
        console.print(table)
    _show_proofs(console, [*proofs, *ensemble_proofs(studies, samples)])


def _show_proofs(console: Console, proofs: list[Proof]) -> None:
    table = Table(title="what must be shown", title_style="bold")
    for heading in ("item", "target", "found", ""):
        table.add_column(heading, overflow="fold")
    for proof in proofs:
        table.add_row(proof.item, proof.target, proof.found, "met" if proof.met else "MISSED")
    console.print(table)
    console.print(f"{sum(proof.met for proof in proofs)} of {len(proofs)} met")
