"""An hour of random traffic at full speed, recorded: nothing lost, memory and cost flat.

``pytest -m slow -s tests/ros/test_long_run.py`` prints the curve. TRACKVIB_LONG_RUN_S: its length.
The lead is told by diagnostics that are up to a second old, which adds what was published meanwhile.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from tests.ros.harness import (
    QUICK,
    Graph,
    Processes,
    ended,
    graph_of_test,
    own_domain,
    processes_of_test,
)
from tests.ros.test_nodes import figures, warning
from trackvib_ros import messages as m
from trackvib_ros.bag import BagReader

pytestmark = [pytest.mark.ros, pytest.mark.slow]
processes = pytest.fixture(processes_of_test)
SIMULATED_S = float(os.environ.get("TRACKVIB_LONG_RUN_S", "3600"))
MARKS = 24
STREAMS = ("rail/waveform", "bridge/waveform")


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> Iterator[Graph]:
    own_domain(monkeypatch, offset=3)
    yield from graph_of_test()


@dataclass(frozen=True)
class Mark:
    """Where the run is: simulated and wall time (s), CPU time (s) and memory (MiB) of processes."""

    simulated: float
    wall: float
    cpu: tuple[float, ...]
    memory: tuple[float, ...]
    lead: int

    @classmethod
    def now(cls, simulated: float, pids: list[int], lead: int) -> Mark:
        cpu, memory = [], []
        for pid in pids:
            fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
            cpu.append((int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK"))
            pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
            memory.append(pages * os.sysconf("SC_PAGE_SIZE") / 2**20)
        return cls(simulated, time.monotonic(), tuple(cpu), tuple(memory), lead)

    def row(self, last: Mark) -> str:
        """A line of the curve, about the time since the last mark."""
        passed = self.simulated - last.simulated
        cost = [(b - a) / passed for a, b in zip(last.cpu, self.cpu, strict=True)]
        return (
            f"{self.simulated:9.1f} {passed / (self.wall - last.wall):8.2f}"
            + "".join(f"{1e3 * c:9.1f}" for c in cost)
            + f"{passed / 1e-4 / (self.wall - last.wall):11.0f}"
            + "".join(f"{size:9.1f}" for size in self.memory)
            + f"{self.lead:7d}"
        )


HEAD = """
                    CPU, ms per simulated s                      memory, MiB
simulated  x real    sensor detector recorder    steps/s   sensor detector recorder  lead,
   time, s   time                                                                    blocks"""


def test_an_hour_at_full_speed_loses_nothing_and_does_not_grow(
    graph: Graph, processes: Processes, tmp_path: Path
) -> None:
    heard = graph.listen(m.DIAGNOSTICS)
    detector = processes.node("detector", use_sim_time=True)
    recorder = processes.command("record", "-o", str(tmp_path / "bag"))
    sensor = processes.node(
        "sensor",
        scenario=str(QUICK),
        real_time_factor=0.0,
        headway_mean=30.0,
        headway_least=20.0,
        await_detectors=1,
        await_recorders=1,
    )
    pids = [process.pid for process in (sensor, detector, recorder)]
    leads = [0]

    def simulated() -> float:
        del heard[:-20]
        return float(figures(heard, "sensor: simulation").get("time_s", "0"))

    def published(topic: str) -> int:
        return int(figures(heard, "sensor: publishing").get(f"published {topic}", "0"))

    def taken(topic: str) -> int:
        return int(figures(heard, "detector: input").get(f"blocks {topic}", "0"))

    graph.until(lambda: simulated() > 1.0, "the start")
    curve = [Mark.now(simulated(), pids, 0)]
    print(HEAD)
    while simulated() < SIMULATED_S:
        while simulated() < curve[-1].simulated + SIMULATED_S / MARKS:
            before = simulated()
            graph.until(lambda before=before: simulated() > before, "further simulated time")
            leads.append(published(STREAMS[0]) - taken(STREAMS[0]))
        curve.append(Mark.now(simulated(), pids, max(leads)))
        print(curve[-1].row(curve[-2]), flush=True)
        leads = [0]
    assert graph.trigger("sensor/pause").success
    graph.until(
        lambda: (
            figures(heard, "sensor: simulation").get("state") == "paused"
            and all(published(topic) == taken(topic) for topic in STREAMS)
        ),
        "the last block at the detector",
    )
    told = figures(heard, "detector: input")
    assert told["refused"] == "0"
    assert not any(key.startswith("gaps") for key in told)
    assert warning(heard, "detector: input") == ""
    blocks = {topic: published(topic) for topic in STREAMS}
    for process in (recorder, sensor, detector):
        process.send_signal(signal.SIGTERM)
        status, text = ended(process)
        assert status == 0, text

    reader = BagReader(tmp_path / "bag")
    assert reader.verify() == []
    for topic in STREAMS:
        waves = list(reader.waveforms(f"/{topic}"))
        assert len(waves) == blocks[topic]
        assert waves[0].stamp_ns == 0
        assert all(b.stamp_ns == a.end_ns for a, b in pairwise(waves))
    last_ns = waves[-1].end_ns
    passages = [
        p
        for x in reader.messages(("/ground_truth/passages",))
        for p in m.read_passages(reader.decode(x))
    ]
    events = [
        e for x in reader.messages(("/train/events",)) for e in m.read_events(reader.decode(x))
    ]
    over = [p for p in passages if p.leave_ns < last_ns - 3_000_000_000]
    found = [e for e in events if e.kind == "passage"]
    print(f"{blocks} blocks, 0 lost; {len(found)} passages detected of {len(passages)} sent")
    assert len(over) <= len(found) <= len(passages)
    half = curve[len(curve) // 2 :]
    for process in range(3):
        sizes = [mark.memory[process] for mark in half]
        # queues and allocators fill in the first half; after that 2 % of noise
        assert max(sizes) < 1.02 * sizes[0], sizes
