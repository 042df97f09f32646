"""Commands of the detection group."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from solver import InputError, load_scenario_text
from trackvib_ros import __version__


@contextmanager
def _progress(title: str) -> Iterator[Callable[[int, int, str], None]]:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(title, total=None)

        def step(done: int, total: int, name: str) -> None:
            bar.update(task, completed=done, total=total, description=f"{title} {Path(name).name}")

        yield step


def _new_file(path: Path | None) -> None:
    if path is not None and path.exists():
        raise InputError(f"{path} exists: not overwriting it; name another file")


def evaluate(
    bags: Annotated[list[Path] | None, typer.Argument(help="Bags, or directories of bags.")] = None,
    detector: Annotated[
        str | None,
        typer.Option(help="Plug-in as module:factory; the built-in detector if not given."),
    ] = None,
    view: Annotated[
        list[str] | None,
        typer.Option(
            help='What the detector is given, such as "one rail, type known"; repeatable.'
        ),
    ] = None,
    by: Annotated[
        list[str] | None,
        typer.Option(help="Table by a factor of a dataset, such as snr_db, train; repeatable."),
    ] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write all scores here.")] = None,
    plot: Annotated[Path | None, typer.Option(help="Write a figure (PNG) here.")] = None,
    targets: Annotated[
        Path | None,
        typer.Option(help="Write the table of targets (Markdown) here; chooses the views itself."),
    ] = None,
    nuisance_hours: Annotated[
        float, typer.Option(help="With --targets: hours of disturbances to listen to.")
    ] = 0.0,
    nuisance_seed: Annotated[int, typer.Option(help="Seed of the disturbances.")] = 1,
    scores: Annotated[
        list[Path] | None,
        typer.Option(help="Take the scores of a --json file, run no detector; repeatable."),
    ] = None,
    schema: Annotated[bool, typer.Option(help="Print the JSON schema of --json.")] = False,
    workers: Annotated[int, typer.Option(help="Processes; 0 is one per core.")] = 0,
) -> None:
    """Score a detector on recorded bags against their ground truth."""
    from trackvib_ros import nuisances
    from trackvib_ros import scores as figures
    from trackvib_ros.accuracy import Accuracy, views_for
    from trackvib_ros.evaluate import evaluate as run

    if schema:
        typer.echo(json.dumps(figures.json_schema(), indent=1))
        return
    for path in (json_file, plot, targets):
        _new_file(path)
    if targets is not None and view:
        raise InputError("--view and --targets exclude each other: the table chooses the views")
    if targets is None and nuisance_hours:
        raise InputError("--nuisance-hours belongs to --targets: name the file of the table")
    if not 0 <= nuisance_hours <= 1000:
        raise InputError(f"--nuisance-hours {nuisance_hours:g} h: must lie from 0 to 1000 h")
    count = workers or os.cpu_count() or 1
    if scores:
        if bags:
            raise InputError(f"--scores {scores[0]} and bags exclude each other: give one of them")
        result = figures.from_json(scores)
    elif not bags:
        raise InputError("no bag: name bags or directories of bags")
    else:
        with _progress("evaluating") as step:
            chosen = views_for if targets is not None else view or ["all"]
            result = run(bags, detector, count, step, chosen)
    console = Console()
    for table in figures.tables(result, by or ()):
        console.print(table)
    for bag in result.bags:
        if bag.problem:
            console.print(f"[yellow]{bag.bag}[/yellow]: {bag.problem}")
    if json_file is not None:
        json_file.write_text(figures.to_json(result), "utf-8")
    if plot is not None:
        figures.figure(result, plot)
    if targets is not None:
        calm = None
        if nuisance_hours:
            with _progress("listening to") as step:
                calm = nuisances.watch(nuisance_hours, nuisance_seed, detector, count, step)
        text = Accuracy(result, calm).markdown("Accuracy of the detector")
        targets.write_text(text, "utf-8")
        console.print(f"[bold]{targets}[/bold] written")
    if any(bag.problem for bag in result.bags):
        raise typer.Exit(1)


def dataset(
    spec: Annotated[
        str | None,
        typer.Argument(help="Specification (TOML file, see --example), or a shipped one by name."),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Directory of the bags.")
    ] = None,
    example: Annotated[bool, typer.Option(help="Print an example specification.")] = False,
    again: Annotated[
        Path | None,
        typer.Option(help="Make one bag again from the scenario stored in it; -o names the new."),
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Instead of the specification's.")] = None,
    workers: Annotated[int, typer.Option(help="Processes; 0 is one per core.")] = 0,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask scheduler (extra [cluster]).")
    ] = None,
) -> None:
    """Make labelled bags: tracks x trains x speeds x noise x faults x seeds. Resumes by itself."""
    from trackvib_ros import dataset as make
    from trackvib_ros.dataset_spec import EXAMPLE, Spec

    console = Console()
    if example:
        typer.echo(EXAMPLE, nl=False)
        return
    if output is None:
        raise InputError("-o is missing: name the directory to make")
    if again is not None:
        if spec is not None:
            raise InputError(
                f"--again {again} and the specification {spec} exclude each other: give one"
            )
        from trackvib_ros.bag import BagReader

        with BagReader(again) as reader:
            stored = dict(reader.custom_data)
        if "scenario" not in stored:
            raise InputError(f"{again} does not hold its scenario: it cannot be made again")
        version = stored.get("trackvib_version", "unknown")
        if version != __version__:
            console.print(
                f"[yellow]{again} was made by version {version}, this is {__version__}: the new "
                "bag may differ from it[/yellow]"
            )
        scenario = load_scenario_text(stored["scenario"], str(again))
        make.write_bag(scenario, output, {k: stored[k] for k in ("case",) if k in stored})
        console.print(f"[bold]{output}[/bold] made from the scenario in {again}")
        return
    if spec is None:
        raise InputError("the specification is missing: give a TOML file, or see --example")
    cases = Spec.load(spec) if seed is None else Spec.load(spec).seeded(seed)
    with _progress("making") as step:
        outcome = make.make_dataset(cases, output, workers or None, scheduler, step)
    counts = {word: sum(o == word for o in outcome.values()) for word in ("made", "there")}
    failed = {name: o for name, o in outcome.items() if o.startswith("failed")}
    console.print(
        f"[bold]{output}[/bold]: {counts['made']} bags made, {counts['there']} were there"
    )
    for name, reason in failed.items():
        console.print(f"[red]{name}[/red] {reason}")
    if failed:
        raise typer.Exit(1)


def catalogue(
    file: Annotated[
        Path | None, typer.Argument(help="Your own catalogue; the shipped one if not given.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Axle positions as JSON.")] = False,
) -> None:
    """Check and list a catalogue of train types."""
    from rich.table import Table

    from trackvib_ros.detection import Catalogue

    known = Catalogue.load(file) if file is not None else Catalogue.default()
    if as_json:
        typer.echo(json.dumps({t.name: t.axle_positions for t in known}, indent=1))
        return
    table = Table(title=f"catalogue {known.version}", title_style="bold")
    for name in ("train", "cars", "units", "wheelsets", "length (m)", "family"):
        table.add_column(name, justify="left" if name in ("train", "family") else "right")
    for train in known:
        table.add_row(
            train.name,
            str(train.cars),
            str(train.units),
            str(len(train.axle_positions)),
            f"{train.length:.2f}",
            train.family,
        )
    Console().print(table)


def register(app: typer.Typer) -> None:
    """Add this group's commands to the application."""
    app.command()(evaluate)
    app.command()(dataset)
    app.command()(catalogue)
