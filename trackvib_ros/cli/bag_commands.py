"""Commands of the bag group: record, replay, info, recover."""

from __future__ import annotations

import dataclasses
import json
import os
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.live import Live
from rich.table import Column, Table
from rich.text import Text

from solver import InputError
from trackvib_ros import environment

if TYPE_CHECKING:
    from trackvib_ros.bag.summary import BagSummary
    from trackvib_ros.recorder import Recorder
    from trackvib_ros.replay import Player

Bag = Annotated[Path, typer.Argument(help="Bag directory or .mcap file.")]
_MEASURED = ("type", "train_type", "axle_count", "direction", "speed", "length")


def register(app: typer.Typer) -> None:
    """Add this group's commands to the application."""
    for command in (record, replay, info, recover):
        app.command()(command)


def record(
    topics: Annotated[
        list[str] | None, typer.Argument(help="Topics to record; all if none is given.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="Bag directory; must not exist. [default: trackvib_<UTC time>]"
        ),
    ] = None,
    exclude: Annotated[
        list[str] | None, typer.Option("--exclude-topics", "-x", help="Topic not to record.")
    ] = None,
    max_bag_size: Annotated[
        int | None, typer.Option("--max-bag-size", "-b", help="Start a new file after so many MB.")
    ] = None,
    max_bag_duration: Annotated[
        float | None, typer.Option("--max-bag-duration", "-d", help="... after so many seconds.")
    ] = None,
    max_cache_size: Annotated[
        int, typer.Option(help="Queue in front of the disk (MB); drops are counted.")
    ] = 64,
    use_sim_time: Annotated[
        bool, typer.Option("--use-sim-time", help="Log with the time of /clock.")
    ] = False,
    duration: Annotated[float | None, typer.Option(help="Stop after so many seconds.")] = None,
    custom_data: Annotated[
        list[str] | None, typer.Option("--custom-data", help="KEY=VALUE stored in the bag.")
    ] = None,
) -> None:
    """Record ROS topics to an MCAP bag, until Ctrl-C.

    Topics that appear later are recorded too; what was received more than a second ago survives
    kill -9 and power cuts; on a full disk the bag is finished and valid. Reads back with
    [bold]ros2 bag[/bold], Foxglove, PlotJuggler, rosbags and [bold]trackvib info[/bold].
    """
    _prepare_ros()
    from trackvib_ros import recorder_node

    console = Console(stderr=True, highlight=False)
    directory = output or Path(f"trackvib_{datetime.now(timezone.utc):%Y%m%d_%H%M%S}")
    options = recorder_node.RecordOptions(
        directory,
        topics=topics or None,
        exclude=exclude or (),
        custom_data=_pairs("--custom-data", custom_data or (), "="),
        split_bytes=_scaled("--max-bag-size", max_bag_size, 10**6, "MB"),
        split_ns=_scaled("--max-bag-duration", max_bag_duration, 10**9, "s"),
        queue_bytes=_scaled("--max-cache-size", max_cache_size, 10**6, "MB") or 1,
        use_sim_time=use_sim_time,
        duration_s=(_scaled("--duration", duration, 10**9, "s") or 0) / 1e9 or None,
    )
    console.print(f"Recording to {directory}; Ctrl-C ends it")
    with Live(console=console, auto_refresh=False, transient=True) as live:

        def show(recorder: Recorder) -> None:
            if console.is_terminal:
                live.update(_progress(recorder), refresh=True)

        recorder = recorder_node.record(options, show)
    console.print(_record_table(recorder))
    for topic, reason in recorder.skipped.items():
        console.print(f"[yellow]not recorded:[/yellow] {topic}: {reason}")
    received = {topic.lstrip("/") for topic in recorder.counts}
    for topic in topics or ():
        if topic.lstrip("/") not in received and topic not in recorder.skipped:
            console.print(f"[yellow]no message came on[/yellow] {topic}")
    if recorder.drops:
        console.print(f"[yellow]{sum(recorder.drops.values())} messages were lost[/yellow]")
    console.print(f"[bold]{directory}[/bold]: {sum(recorder.counts.values())} messages")
    if recorder.failure is not None:
        console.print(f"[bold red]trackvib:[/bold red] {recorder.failure}")
        raise typer.Exit(2)


def replay(
    bag: Bag,
    rate: Annotated[
        str, typer.Option("--rate", "-r", help="Times real time, or 'max': as fast as it is taken.")
    ] = "1",
    loop: Annotated[bool, typer.Option("--loop", "-l", help="Start again at the end.")] = False,
    clock: Annotated[
        bool, typer.Option("--clock", help="Publish /clock from the log times of the bag.")
    ] = False,
    clock_hz: Annotated[float, typer.Option(help="Rate of --clock (Hz of wall time).")] = 40.0,
    start_offset: Annotated[
        float, typer.Option("--start-offset", help="Skip so much of the bag (s).")
    ] = 0.0,
    duration: Annotated[
        float | None, typer.Option("--playback-duration", help="Play so much of the bag (s).")
    ] = None,
    topics: Annotated[
        list[str] | None, typer.Option("--topics", help="Play only this topic; may be repeated.")
    ] = None,
    exclude: Annotated[
        list[str] | None, typer.Option("--exclude-topics", "-x", help="Topic not to play.")
    ] = None,
    remap: Annotated[
        list[str] | None, typer.Option("--remap", "-m", help="/stored:=/published.")
    ] = None,
    pause: Annotated[
        bool, typer.Option("--pause", "-p", help="Start paused; SPACE goes on.")
    ] = False,
    wait_for: Annotated[
        list[str] | None,
        typer.Option("--wait-for", help="Wait until this published topic has a subscription."),
    ] = None,
) -> None:
    """Publish a bag again: the stored bytes with the stored QoS.

    SPACE pauses, and so do the services ~/pause and ~/resume of node trackvib_replay. Subscribers
    with unlimited reliable history hold the replay back, so at [bold]--rate max[/bold] a detector
    gets everything.
    """
    _prepare_ros()
    from trackvib_ros import replay_node
    from trackvib_ros.replay import ReplayOptions

    options = ReplayOptions(
        rate=_rate(rate),
        loop=loop,
        clock_hz=clock_hz if clock else 0.0,
        start_offset_s=start_offset,
        duration_s=duration,
        topics=topics or None,
        exclude=exclude or (),
        remap=_pairs("--remap", remap or (), ":="),
        paused=pause,
        wait_for=wait_for or (),
    )
    console = Console(stderr=True, highlight=False)
    with Live(console=console, auto_refresh=False, transient=True) as live:

        def show(player: Player) -> None:
            if console.is_terminal:
                state = "paused" if player.paused else "playing"
                count = sum(player.published.values())
                line = f"{state} {player.position_ns / 1e9:.3f} s, {count} messages"
                live.update(Text(line), refresh=True)

        player = replay_node.replay(bag, options, show)
    for reason in player.skipped.values():
        console.print(f"[yellow]not published:[/yellow] {reason}")
    console.print(
        f"{sum(player.published.values())} messages on {len(player.published)} topics published"
        + (f", at most {player.late_s * 1e3:.1f} ms late" if options.rate else "")
    )


def info(
    bag: Bag,
    verify: Annotated[
        bool, typer.Option(help="Check every record, not only the summaries.")
    ] = True,
    as_json: Annotated[bool, typer.Option("--json", help="For machines.")] = False,
    scenario: Annotated[
        bool, typer.Option("--scenario", help="Print only the scenario stored in the bag (TOML).")
    ] = False,
) -> None:
    """Show what is in a bag: topics, scenario, trains, events, integrity.

    An unfinished recording is recovered first. Exit status 1 if the bag is damaged.
    """
    from trackvib_ros.bag import BagReader
    from trackvib_ros.bag.summary import summarize

    reader = BagReader(bag)
    summary = summarize(reader, verify=verify)
    if scenario:
        if not summary.scenario:
            raise InputError(f"{bag} holds no scenario: it was not recorded from a trackvib sensor")
        typer.echo(summary.scenario)
        return
    if as_json:
        typer.echo(json.dumps(dataclasses.asdict(summary), indent=2))
    else:
        console = Console(highlight=False)
        if reader.recovery is not None:
            console.print(f"[yellow]{reader.recovery}[/yellow]\n", markup=True)
        _print_summary(console, summary, verify)
    if summary.problems:
        raise typer.Exit(1)


def recover(
    bag: Bag,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="For a single .mcap file: the new file to write."),
    ] = None,
) -> None:
    """Make a bag whole after a crash, a power cut or damage.

    An unfinished recording is finished in place. A damaged file is rewritten from its intact
    chunks; the original stays beside it as [bold]*.damaged[/bold].
    """
    from trackvib_ros import bag as bags

    if bag.is_dir():
        if output is not None:
            raise InputError("-o is for a single .mcap file: a bag directory is repaired in place")
        typer.echo(str(bags.recover(bag)))
        return
    report = bags.recover_file(bag, output or bag.with_name(f"{bag.stem}.recovered.mcap"))
    typer.echo(f"{report.path}: {report.messages} messages intact")
    for gap in report.gaps:
        typer.echo(f"  missing: {gap}")


def _print_summary(console: Console, summary: BagSummary, verified: bool) -> None:
    seconds = (summary.end_ns - summary.start_ns) / 1e9
    console.print(
        f"[bold]{summary.path}[/bold]{' (being recorded)' if summary.in_progress else ''}"
    )
    console.print(f"  files     {', '.join(summary.files)} ({summary.bytes / 1e6:.2f} MB)")
    console.print(f"  duration  {seconds:.3f} s from {_time(summary.start_ns)}")
    console.print(f"  messages  {summary.messages}")
    if summary.version:
        console.print(f"  recorded by trackvib {summary.version}")
    if summary.scenario:
        lines = len(summary.scenario.splitlines())
        console.print(f"  scenario  {lines} lines of TOML (info --scenario prints it)")
    if summary.seed:
        console.print(f"  seed      {summary.seed}", markup=False)
    table = Table("topic", "type", Column("messages", justify="right"), box=None)
    for name, (type_name, count) in summary.topics.items():
        table.add_row(name, type_name, str(count))
    console.print(table)
    for title, found in (("truth", summary.trains), ("detected", summary.events)):
        for statement in found:
            if statement.kind not in ("axle", "update"):
                console.print(
                    f"  {title}  {statement.stamp_ns / 1e9:.3f} s  {statement.message}"
                    f"{_measured(statement.values)}",
                    markup=False,
                )
    if summary.event_counts:
        counted = ", ".join(f"{count} {kind}" for kind, count in summary.event_counts.items())
        console.print(f"  events    {counted}")
    if summary.problems:
        console.print("[bold red]damaged[/bold red]")
        for problem in summary.problems:
            console.print(f"  {problem}", markup=False)
        console.print("  trackvib recover makes it whole from what is intact")
    elif verified:
        console.print("[green]every record is intact[/green]")


def _measured(values: dict[str, str]) -> str:
    parts = []
    for name in _MEASURED:
        if f"{name}.value" in values:
            value, sigma = float(values[f"{name}.value"]), float(values[f"{name}.sigma"])
            parts.append(f"{name} {value:.4g} ± {sigma:.2g} {values[f'{name}.unit']}")
        elif name in values:
            parts.append(f"{name} {values[name]}")
    return f" ({', '.join(parts)})" if parts else ""


def _time(nanoseconds: int) -> str:
    if nanoseconds < 10**17:  # before 1973: simulated time
        return f"{nanoseconds / 1e9:.3f} s of simulated time"
    return f"{datetime.fromtimestamp(nanoseconds / 1e9, timezone.utc):%Y-%m-%d %H:%M:%S} UTC"


def _progress(recorder: Recorder) -> Text:
    drops = sum(recorder.drops.values())
    lost = f", {drops} lost" if drops else ""
    count = sum(recorder.counts.values())
    return Text(f"{len(recorder.topics)} topics, {count} messages{lost}")


def _record_table(recorder: Recorder) -> Table:
    table = Table(
        "topic", Column("messages", justify="right"), Column("lost", justify="right"), box=None
    )
    drops = recorder.drops
    for topic, count in sorted(recorder.counts.items()):
        table.add_row(topic, str(count), str(drops.get(topic, 0)))
    return table


def _pairs(option: str, texts: Any, separator: str) -> dict[str, str]:
    pairs = {}
    for text in texts:
        key, found, value = text.partition(separator)
        if not found or not key or not value:
            raise InputError(f"{option} {text}: write it as KEY{separator}VALUE")
        pairs[key] = value
    return pairs


def _rate(text: str) -> float:
    if text == "max":
        return 0.0
    try:
        rate = float(text)
    except ValueError:
        rate = 0.0
    if not 0.0 < rate < float("inf"):
        raise InputError(f"--rate {text}: give a number greater than 0, or 'max'")
    return rate


def _scaled(option: str, value: float | None, factor: int, unit: str) -> int | None:
    if value is None:
        return None
    if value <= 0:
        raise InputError(f"{option} {value} {unit}: must be greater than 0 {unit}")
    return round(value * factor)


def _prepare_ros() -> None:
    """Check the installation; the discovery range stays the user's: others may be far away."""
    environment.require_ros()
    environment.domain_of(os.environ)
    os.environ.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", environment.profile_path())
