"""The command bench: cost, accuracy and memory of runs, in one table."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from solver import InputError

WIDTH = 110
"""Columns of the table where there is no terminal."""


def register(app: typer.Typer) -> None:
    """Add this group's command to the application."""
    app.command()(bench)


def _number(value: float, form: str) -> str:
    return "" if math.isnan(value) else format(value, form)


def bench(
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Write the results as JSON too.")
    ] = None,
    group: Annotated[
        list[str] | None, typer.Option("--group", "-g", help="Only these groups; may be repeated.")
    ] = None,
) -> None:
    """Measure how fast runs are: cost against the paper's way, error, growth, memory.

    Every case runs on one core in a process of its own; costs are CPU time, preparation excluded.
    Groups: accuracy, product, cars, spans, duration.
    """
    from trackvib_ros.bench import growth, load_cases, run_cases

    if output is not None and output.exists():
        raise InputError(f"{output} exists: name another file with -o")
    cases = load_cases()
    known = sorted({case.group for case in cases})
    for name in group or ():
        if name not in known:
            raise InputError(f"--group {name!r}: no such group; there are {', '.join(known)}")
    if group:
        cases = [case for case in cases if case.group in group]
    console = Console()
    if not console.is_terminal:
        console = Console(width=WIDTH)
    table = Table(title="cost on one core", title_style="bold")
    table.add_column("case", overflow="fold")
    for heading in (
        "modes or DOFs",
        "step\nµs",
        "steps\nper CPU s",
        "real-time\nfactor",
        "ratio to\nreference",
        "error of force /\nacceleration, %",
        "peak\nMiB",
        "of machine\nlimit, %",
    ):
        table.add_column(heading, justify="right")
    sizes = {case.name: case.size for case in cases}
    grouped = defaultdict(list)
    results = []
    with console.status("") as status:
        status.update(cases[0].name)
        for number, result in enumerate(run_cases(cases), start=1):
            results.append(result)
            grouped[result.group].append(result)
            errors = [
                _number(100 * value, ".2f")
                for value in (result.force_error, result.acceleration_error)
            ]
            table.add_row(
                result.case,
                str(result.states),
                f"{result.step * 1e6:g}",
                f"{result.steps_per_second:,.0f}",
                f"{result.real_time_factor:.3g}",
                _number(result.ratio, ".1f"),
                " / ".join(errors) if all(errors) else "",
                f"{result.peak_memory / 2**20:.0f}",
                _number(100 * result.limit_fraction, ".0f"),
            )
            status.update(cases[number].name if number < len(cases) else "")
    console.print(table)
    exponents = {}
    for name in ("cars", "spans"):
        if len(grouped[name]) > 1:
            at = [sizes[result.case] for result in grouped[name]]
            exponents[name] = growth(grouped[name], at)
            console.print(
                f"cost grows with exponent {exponents[name]:.2f} in the number of {name} "
                f"({at[0]:g} to {at[-1]:g})"
            )
    if output is not None:
        rows = [{k: None if v != v else v for k, v in asdict(result).items()} for result in results]
        content = {"results": rows, "exponents": exponents}
        output.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
        console.print(f"results: {output}")
