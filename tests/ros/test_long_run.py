"""An hour of random traffic at full speed: nothing lost, memory flat. Run with ``-m slow -s``."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
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

pytestmark = [pytest.mark.ros, pytest.mark.slow]
processes = pytest.fixture(processes_of_test)
SIMULATED_S = float(os.environ.get("TRACKVIB_LONG_RUN_S", "3600"))


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> Iterator[Graph]:
    own_domain(monkeypatch, offset=3)
    yield from graph_of_test()


def memory_mb(pid: int) -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def test_an_hour_at_full_speed_loses_nothing_and_does_not_grow(
    graph: Graph, processes: Processes
) -> None:
    heard = graph.listen(m.DIAGNOSTICS)
    detector = processes.node("detector", use_sim_time=True)
    sensor = processes.node(
        "sensor",
        scenario=str(QUICK),
        real_time_factor=0.0,
        headway_mean=60.0,
        headway_least=20.0,
        await_detectors=1,
    )
    curve: list[tuple[float, float, float]] = []
    marks = 20

    def simulated() -> float:
        del heard[:-20]
        return float(figures(heard, "sensor: simulation").get("time_s", "0"))

    for k in range(1, marks + 1):
        end = SIMULATED_S * k / marks
        while simulated() < end:  # a minute at most for each piece of it
            before = simulated()
            graph.until(lambda before=before: simulated() > before, "further simulated time")
        curve.append((simulated(), memory_mb(sensor.pid), memory_mb(detector.pid)))
        print("simulated {:7.1f} s   sensor {:6.1f} MB   detector {:6.1f} MB".format(*curve[-1]))
    assert graph.trigger("sensor/pause").success
    topics = ("rail/waveform", "bridge/waveform")

    def all_taken() -> bool:
        told, taken = figures(heard, "sensor: publishing"), figures(heard, "detector: input")
        state = figures(heard, "sensor: simulation").get("state")
        return state == "paused" and all(
            told[f"published {topic}"] == taken.get(f"blocks {topic}") for topic in topics
        )

    graph.until(all_taken, "the last block at the detector")
    taken = figures(heard, "detector: input")
    assert taken["refused"] == "0"
    assert not any(key.startswith("gaps") for key in taken)
    assert warning(heard, "detector: input") == ""
    half = len(curve) // 2
    for column in (1, 2):
        grown = max(c[column] for c in curve[half:]) - max(c[column] for c in curve[: half + 1])
        # the queues fill in the first half; after that 1 % of noise of the allocator per process
        assert grown < 0.02 * curve[half][column], curve
    for process in (sensor, detector):
        process.send_signal(signal.SIGTERM)
        assert ended(process)[0] == 0
