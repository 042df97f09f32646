"""One train, start to end: sensor and detector as processes, watched, then the report."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TextIO

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from solver import InputError
from trackvib_ros import messages as m
from trackvib_ros.process import Stop
from trackvib_ros.report import PassageReport

GRACE_S = 10.0
"""Time that a process gets to end before it is killed (s)."""
QUIET_LOG = ["--ros-args", "--disable-external-lib-logs"]
"""No log files of ROS's own: what the nodes say is in their output."""
_PR_SET_PDEATHSIG = 1


def _end_with_parent() -> None:
    """In a child: end when the parent dies, however it dies."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


WAVEFORM = m.waveform_topic("").name
MEND_DISK = "free some space or choose another place with -o"


class Child:
    """A node in a process of its own, its output in a file."""

    def __init__(
        self,
        node: str,
        parameters: Mapping[str, object],
        environment: Mapping[str, str],
        log: Path,
    ) -> None:
        self.name, self.log = node, log
        arguments = [sys.executable, "-m", "trackvib_ros.start", node, *QUIET_LOG]
        for name, setting in parameters.items():
            text = str(setting).lower() if isinstance(setting, bool) else str(setting)
            arguments += ["-p", f"{name}:={text}"]
        self._output: TextIO = log.open("x", encoding="utf-8")
        self._process = subprocess.Popen(
            arguments,
            env=dict(environment),
            stdin=subprocess.DEVNULL,
            stdout=self._output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            preexec_fn=_end_with_parent,
        )

    @property
    def status(self) -> int | None:
        """Exit status, None while it runs."""
        return self._process.poll()

    def interrupt(self) -> None:
        """Ask it to end."""
        if self.status is None:
            self._process.send_signal(signal.SIGINT)

    def wait(self, timeout_s: float) -> None:
        """Wait for the end, then enforce it."""
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._output.close()

    def complaint(self) -> str:
        """The last error in its log, as a sentence; or the last line."""
        lines = self.log.read_text(encoding="utf-8", errors="replace").splitlines()
        errors = [line for line in lines if "[ERROR]" in line or "[FATAL]" in line]
        last = (errors or lines or ["no message"])[-1]
        return last.split("]: ", 1)[-1]


@dataclass
class Seen:
    """What the demo has heard from the nodes."""

    time_s: float = 0.0
    end_s: float = 0.0
    first: tuple[float, float] | None = None
    last: tuple[float, float] | None = None
    factor: float = 0.0
    event: str = ""
    trouble: str = ""
    published: dict[str, int] = field(default_factory=dict)
    taken: dict[str, int] = field(default_factory=dict)

    @property
    def pace(self) -> str:
        """How fast the run was, from the first to the last word of the clock."""
        if self.first is None or self.last is None or self.last[1] <= self.first[1]:
            return "too short to tell"
        simulated, wall = (b - a for a, b in zip(self.first, self.last, strict=True))
        return f"{simulated:.2f} s simulated in {wall:.2f} s: {simulated / wall:.2f} x real time"

    @property
    def caught_up(self) -> bool:
        """True when the detector has looked at every block that the sensor has published."""
        return all(self.taken.get(topic, 0) >= n for topic, n in self.published.items())


class Watcher:
    """A ROS node that follows the run for the progress display."""

    def __init__(self) -> None:
        rclpy.init(args=QUIET_LOG, signal_handler_options=SignalHandlerOptions.NO)
        self.seen = Seen()
        self._node = rclpy.create_node("demo", enable_rosout=False)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        for topic, callback in (
            (m.DIAGNOSTICS, self._on_diagnostics),
            (m.TRAIN_EVENTS, self._on_event),
            (m.CLOCK, self._on_clock),
        ):
            self._node.create_subscription(topic.type, topic.name, callback, topic.qos)

    def spin(self, seconds: float) -> None:
        """Listen."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left)
        if self._node.count_publishers(m.CLOCK.name) > 1:
            self.seen.trouble = (
                f"ROS domain {os.environ.get('ROS_DOMAIN_ID', '0')} has another publisher of "
                f"{m.CLOCK.name}: end it, or unset ROS_DOMAIN_ID to get a domain of its own"
            )

    def close(self) -> None:
        """Leave ROS."""
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.try_shutdown()

    def _on_clock(self, message: Any) -> None:
        seen = self.seen
        seen.time_s = m.from_stamp(message.clock) * 1e-9
        seen.last = (seen.time_s, time.monotonic())
        seen.first = seen.first or seen.last

    def _on_event(self, message: DiagnosticArray) -> None:
        for event in m.read_events(message):
            if event.kind != "axle":
                self.seen.event = f"{event.kind} at {event.stamp_ns * 1e-9:.3f} s"

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            if status.name == "sensor: simulation" and "end_s" in values:
                self.seen.end_s = float(values["end_s"])
                self.seen.factor = float(values["real_time_factor"])
            if status.name == "sensor: publishing":
                self.seen.published = _counts(values, "published ")
            if status.name == "detector: input":
                self.seen.taken = _counts(values, "blocks ", "refused ")
            if values.get("failure"):
                self.seen.trouble = f"{values['failure']}; {MEND_DISK}"


def _counts(values: Mapping[str, str], *kinds: str) -> dict[str, int]:
    """Blocks by waveform topic, the kinds added up."""
    counts: dict[str, int] = {}
    for key, text in values.items():
        kind = next((kind for kind in kinds if key.startswith(kind)), None)
        if kind is not None:
            topic = key.removeprefix(kind).split(":")[0]
            if topic.endswith(WAVEFORM):
                counts[topic] = counts.get(topic, 0) + int(text)
    return counts


@contextmanager
def _display(console: Console) -> Iterator[Progress]:
    with Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.fields[note]}"),
        TimeElapsedColumn(),
        console=console,
        transient=True,
    ) as progress:
        yield progress


def run_demo(
    scenario: str,
    directory: Path,
    environment: Mapping[str, str],
    *,
    real_time_factor: float = 0.0,
    figure: bool = True,
    console: Console,
) -> int:
    """Run the demo into a new directory; returns the exit status.

    0: every train was detected; 1: one was missed; 130: interrupted (the bag is readable).

    Raises:
        InputError: the directory exists, or a node refused to start.
        SolverError: the computation failed.
    """
    try:
        directory.mkdir(parents=True)
    except OSError as error:
        raise InputError(
            f"{directory} cannot be made ({error.strerror}): name another directory with -o"
        ) from None
    stop = Stop()
    bag, logs = directory / "bag", directory / "log"
    logs.mkdir()
    common = {"autostart": True}
    children: list[Child] = []
    watcher = Watcher()
    try:
        detector = Child(
            "detector",
            {**common, "use_sim_time": True, "record_directory": bag},
            environment,
            logs / "detector.txt",
        )
        children.append(detector)
        sensor = Child(
            "sensor",
            {
                **common,
                "exit_at_end": True,
                "scenario": scenario,
                "real_time_factor": float(real_time_factor),
                "await_detectors": 1,
                "await_recorders": 1,
            },
            environment,
            logs / "sensor.txt",
        )
        children.insert(0, sensor)
        with _display(console) as progress:
            _follow(watcher, children, stop, progress)
    finally:
        for child in children:
            child.interrupt()
            child.wait(GRACE_S)
        watcher.close()
    if stop:
        console.print(_what_is_left(bag))
        return 130
    if watcher.seen.trouble:
        raise InputError(watcher.seen.trouble)
    for child in children:
        if child.status != 0:
            raise InputError(f"{child.name} node: {child.complaint()} (log: {child.log})")
    status = _tell(bag, directory, figure, console)
    console.print(f"run:    {watcher.seen.pace}", highlight=False)
    return status


def _follow(watcher: Watcher, children: Sequence[Child], stop: Stop, progress: Progress) -> None:
    """Wait for the sensor's end, a failure or a signal, and show how far the run is."""
    task = progress.add_task("assembling the track model", total=None, note="")
    seen = watcher.seen
    while not stop and all(child.status is None for child in children):
        watcher.spin(0.1)
        if seen.trouble:
            return
        if seen.time_s > 0:
            note = f"{seen.time_s:.2f} s, {seen.factor:.2f} x real time  {seen.event}"
            total = seen.end_s or None
            progress.update(
                task, description="passage", total=total, completed=seen.time_s, note=note
            )
    sensor, detector = children
    while not stop and sensor.status == 0 and detector.status is None and not seen.caught_up:
        progress.update(task, description="detector catches up")
        watcher.spin(0.1)


def _what_is_left(bag: Path) -> str:
    if not (bag / "metadata.yaml").exists():
        return "interrupted before anything was recorded"
    return f"interrupted; what was recorded so far: {bag}"


def _tell(bag: Path, directory: Path, figure: bool, console: Console) -> int:
    report = PassageReport(bag)
    for table in report.tables():
        console.print(table)
    if report.extra:
        console.print(f"[yellow]{len(report.extra)} passage(s) detected where there was none")
    console.print(f"bag:    {bag}", highlight=False)
    if figure:
        picture = directory / "passage.png"
        report.figure(picture)
        console.print(f"figure: {picture}", highlight=False)
    if not report.detected:
        console.print("[bold red]not every train was detected, or there was none")
        return 1
    return 0
