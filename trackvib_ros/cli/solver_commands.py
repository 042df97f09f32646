"""Commands of the solver group: ``simulate`` and ``scenario``."""

from __future__ import annotations

import json
import tempfile
import time
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, BinaryIO

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from solver import (
    InputError,
    QualityReport,
    Scenario,
    Simulation,
    check_run,
    load_scenario,
    preset_names,
    preset_text,
    scenario_schema,
)

Array = NDArray[np.float64]

BLOCK = 1600
"""Samples between two movements of the progress bar."""


def _messages() -> Console:
    return Console(stderr=True, highlight=False)


def check_output(path: Path, suffix: str, force: bool) -> None:
    """Refuse a path that is not to be written.

    Raises:
        InputError: exists already, wrong suffix, or no such folder.
    """
    if path.suffix != suffix:
        raise InputError(f"output {path}: must end in {suffix}")
    if not path.parent.is_dir():
        raise InputError(f"output {path}: there is no folder {path.parent}; make it first")
    if path.exists() and not force:
        raise InputError(
            f"output {path}: exists already, not overwriting; choose another -o or add --force"
        )


class _Column:
    """One array of the archive, written block by block in a file of its own."""

    def __init__(self, path: Path, shape: tuple[int, ...]) -> None:
        self.path = path
        self._file: BinaryIO = path.open("wb")
        header = {"descr": "<f8", "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_2_0(self._file, header)

    def append(self, values: Array) -> None:
        self._file.write(np.ascontiguousarray(values, dtype="<f8").tobytes())

    def close(self) -> None:
        self._file.close()


@contextmanager
def _own_folder(output: Path) -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix=f".{output.name}.", dir=output.parent) as folder:
        yield Path(folder)


def simulate_to_file(
    simulation: Simulation, output: Path, progress: Progress | None = None
) -> None:
    """Run to the end and write an ``.npz``: bounded memory, final name only when complete.

    Arrays: ``time`` (s), ``wheelset_force`` (N, NaN off the line), ``wheelset_position`` (m, at
    t = 0), ``displacement``, ``velocity``, ``acceleration`` (SI, samples x channels, positive
    down, unfiltered, solver rate), ``channels``, ``step_ns``, ``scenario`` (TOML text).
    """
    samples, channels = simulation.end_index, len(simulation.channels)
    wheelsets = sum(len(train.axle_positions) for train in simulation.scenario.train)
    task = progress.add_task("simulate", total=samples) if progress else None
    with _own_folder(output) as folder:
        columns = {
            "time": _Column(folder / "time.npy", (samples,)),
            "wheelset_force": _Column(folder / "wheelset_force.npy", (samples, wheelsets)),
            **{
                name: _Column(folder / f"{name}.npy", (samples, channels))
                for name in ("displacement", "velocity", "acceleration")
            },
        }
        start: Array = np.zeros(wheelsets)
        for block in simulation.blocks(BLOCK):
            if block.index == 0:
                start = block.wheelset_position[0]
            for name, column in columns.items():
                column.append(getattr(block, name))
            if progress is not None and task is not None:
                progress.advance(task, len(block.time))
        for column in columns.values():
            column.close()
        small: dict[str, Any] = {
            "wheelset_position": start,
            "channels": np.array(simulation.channels, dtype=np.str_),
            "step_ns": np.array(simulation.step_ns),
            "scenario": np.array(simulation.scenario.to_toml()),
        }
        archive = folder / output.name
        with zipfile.ZipFile(archive, "w", zipfile.ZIP_STORED, allowZip64=True) as target:
            for name, column in columns.items():
                target.write(column.path, f"{name}.npy")
            for name, values in small.items():
                with target.open(f"{name}.npy", "w") as file:
                    np.lib.format.write_array(file, values, allow_pickle=False)
        archive.replace(output)


def _progress(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:3.0f} %"),
        TimeRemainingColumn(),
        console=console,
    )


def _show_quality(console: Console, report: QualityReport) -> None:
    console.print(
        f"quality: equilibrium residual {report.equilibrium_residual:.1e} of the static load, "
        f"{report.lost_contacts} lost contact(s)"
    )
    bands = ", ".join(f"{name} {band:.0f} Hz" for name, band in report.valid_band.items())
    if bands:
        console.print(f"valid band: {bands}")
    for note in report.notes:
        console.print(f"note: {note}")


def simulate(
    scenario: Annotated[str, typer.Argument(help="scenario file (.toml) or scenario preset")],
    output: Annotated[Path, typer.Option("-o", "--output", help="result, an .npz file")],
    force: Annotated[bool, typer.Option(help="overwrite the output")] = False,
    check: Annotated[
        bool, typer.Option(help="also run with half the step and a finer basis; show what changes")
    ] = False,
) -> None:
    """Compute a scenario without ROS; write forces and channel signals to an .npz file."""
    check_output(output, ".npz", force)
    loaded = load_scenario(scenario)
    console = _messages()
    simulation = Simulation(
        loaded,
        outputs=("displacement", "velocity", "acceleration"),
        report=lambda message: console.print(message),
    )
    began = time.perf_counter()
    with _progress(console) as progress:
        simulate_to_file(simulation, output, progress)
    taken = time.perf_counter() - began
    simulated = simulation.end_index * simulation.step_ns * 1e-9
    console.print(
        f"{output}: {simulation.end_index} samples of {simulation.step_ns * 1e-3:g} us, "
        f"{simulated:.3f} s in {taken:.2f} s ({simulated / taken:.2f} x real time), "
        f"{output.stat().st_size / 1e6:.1f} MB"
    )
    _show_quality(console, simulation.quality)
    if check:
        _show_check(console, loaded)


def _show_check(console: Console, scenario: Scenario) -> None:
    with _progress(console) as progress:
        task = progress.add_task("check", total=1.0)
        result = check_run(scenario, report=lambda share: progress.update(task, completed=share))
    table = Table(title=result.title)
    for heading in ("quantity", "this run", "refined", "change / peak"):
        table.add_column(heading, justify="left" if heading == "quantity" else "right")
    for row in result.rows:
        table.add_row(
            row.quantity, f"{row.peak:.6g}", f"{row.refined_peak:.6g}", f"{row.change:.3%}"
        )
    console.print(table)
    balance = result.quality.energy_residual
    if balance is not None:
        console.print(
            f"energy of the line: work less loss and change of energy is {balance:.1e} "
            "of the work or the energy"
        )


scenarios = typer.Typer(help="Show scenario presets and the schema.", no_args_is_help=True)


@scenarios.callback(invoke_without_command=True)
def _schema(
    schema: Annotated[
        bool, typer.Option("--schema", help="Print the JSON schema of a scenario, with units.")
    ] = False,
) -> None:
    if schema:
        typer.echo(json.dumps(scenario_schema(), indent=2))
        raise typer.Exit


@scenarios.command("list")
def list_presets() -> None:
    """List all presets by kind."""
    for kind, names in preset_names().items():
        typer.echo(f"{kind}: {', '.join(names)}")


@scenarios.command("show")
def show_preset(preset: Annotated[str, typer.Argument(help="preset of any kind")]) -> None:
    """Print a preset as TOML text."""
    typer.echo(preset_text(preset), nl=False)


def register(app: typer.Typer) -> None:
    """Add this group's commands to the application."""
    app.command()(simulate)
    app.add_typer(scenarios, name="scenario")
