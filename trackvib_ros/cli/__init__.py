"""The ``trackvib`` command: one typer application, one module per group of commands."""

from __future__ import annotations

import errno
import importlib
import os
import sys
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from solver import InputError, SolverError
from trackvib_ros import __version__

app = typer.Typer(
    name="trackvib",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="rich",
    pretty_exceptions_enable=False,
    help=(
        "Virtual trackside vibration sensor.\n\n"
        "A high-speed train crosses a ballastless track on a bridge; its vibration is computed, "
        "published over ROS 2, recorded and the train detected from it.\n\n"
        "Start with [bold]trackvib demo[/bold], then [bold]trackvib scenario show demo[/bold] "
        "and [bold]trackvib simulate[/bold]."
    ),
)

COMMAND_MODULES = (
    "solver_commands",
    "detection_commands",
    "bag_commands",
    "ros_commands",
    "bench_commands",
    "figure_commands",
)


def _version(value: bool) -> None:
    if value:
        typer.echo(f"trackvib {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


def _register() -> None:
    for module in COMMAND_MODULES:
        importlib.import_module(f"{__name__}.{module}").register(app)


def main() -> None:
    """Run the command line; user mistakes end with one sentence and exit status 2."""
    _register()
    error = Console(stderr=True, soft_wrap=True, highlight=False)
    try:
        app()
    except (InputError, SolverError) as failure:
        error.print(f"[bold red]trackvib:[/bold red] {escape(str(failure))}", markup=True)
        sys.exit(2)
    except OSError as failure:
        if failure.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EROFS):
            raise
        where = f" ({failure.filename})" if failure.filename else ""
        error.print(
            f"[bold red]trackvib:[/bold red] {os.strerror(failure.errno)}{where}: "
            "free some space or choose another place with -o"
        )
        sys.exit(2)


__all__ = ["app", "main"]
