"""How fast the live path keeps pace: sensor, detector and recorder of the 8-car train on DDS.

``python -m tests.ros.live`` prints a table: real time, then as fast as nothing is lost, then the
largest factor that is kept, sought in steps of 10 % downwards from what all haste reached with the
train on the line. A factor is kept if no step begins later than one block (20 ms) and no block is
lost. CPU is that per simulated second with the train on the line; the other figures are of this
machine with all that runs on it.
"""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import time
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

from tests.ros.harness import Graph, Processes, ended
from trackvib_ros import messages as m
from trackvib_ros.bag import BagReader
from trackvib_ros.environment import complete, free_domain

BLOCK_S = 0.02
ON_LINE = (1.6, 4.2)
"""Simulated time with the most wheelsets on the line of the demo (s)."""
SCENARIO = "demo"


@dataclass
class Outcome:
    """What a run at a factor gave."""

    behind_s: float = 0.0
    late_s: float = 0.0
    pace: list[tuple[float, ...]] = field(default_factory=list)
    lost: int = 0
    blocks: int = 0

    @property
    def factor(self) -> float:
        """Simulated per wall time while the train was on the line."""
        return (self.pace[-1][0] - self.pace[0][0]) / (self.pace[-1][1] - self.pace[0][1])

    def cost(self, process: int) -> float:
        """CPU time of a process per simulated time while the train was on the line."""
        spent = self.pace[-1][2 + process] - self.pace[0][2 + process]
        return spent / (self.pace[-1][0] - self.pace[0][0])

    @property
    def kept(self) -> bool:
        return self.lost == 0 and self.late_s == 0 and self.behind_s <= BLOCK_S


def _values(message: Any, name: str) -> dict[str, str]:
    for status in message.status:
        if status.name == name:
            return {pair.key: pair.value for pair in status.values}
    return {}


def _cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def run(factor: float, folder: Path) -> Outcome:
    """One passage at a factor, recorded by the detector's recorder."""
    graph, processes, outcome = Graph(), Processes(), Outcome()
    heard = graph.listen(m.DIAGNOSTICS)
    pids: list[int] = []

    def on_clock(message: Any) -> None:
        simulated = m.from_stamp(message.clock) * 1e-9
        if ON_LINE[0] <= simulated <= ON_LINE[1]:
            outcome.pace.append((simulated, time.monotonic(), *(_cpu_s(pid) for pid in pids)))

    graph.tester.create_subscription(m.CLOCK.type, m.CLOCK.name, on_clock, m.CLOCK.qos)
    try:
        bag = folder / f"bag_{factor:.3f}"
        detector = processes.node("detector", use_sim_time=True, record_directory=str(bag))
        sensor = processes.node(
            "sensor",
            scenario=SCENARIO,
            real_time_factor=float(factor),
            await_detectors=1,
            await_recorders=1,
        )
        pids += [sensor.pid, detector.pid]
        told: dict[str, str] = {}

        def finished() -> bool:
            while heard:
                message = heard.pop(0)
                told.update(_values(message, "sensor: publishing"))
                state = _values(message, "sensor: simulation")
                outcome.behind_s = max(outcome.behind_s, float(state.get("behind_s", 0)))
                outcome.late_s = max(outcome.late_s, float(state.get("late_s", 0)))
                told.update(state)
            return told.get("state") == "finished"

        graph.until(finished, "end of the run")
        for process in (sensor, detector):
            process.send_signal(signal.SIGINT)
            status, text = ended(process)
            if status:
                raise SystemExit(text)
        reader = BagReader(bag)
        for topic in [name for name in reader.topics if name.endswith("/waveform")]:
            waves = list(reader.waveforms(topic))
            outcome.blocks += len(waves)
            outcome.lost += int(told[f"published {topic.lstrip('/')}"]) - len(waves)
            outcome.lost += sum(b.stamp_ns != a.end_ns for a, b in pairwise(waves))
        return outcome
    finally:
        processes.close()
        graph.close()


def main() -> None:
    os.environ["ROS_DOMAIN_ID"] = str(free_domain())
    complete(os.environ)
    print(
        f"{SCENARIO}, detector and recorder running; load of the machine {os.getloadavg()[0]:.1f}"
    )
    print(
        "factor  reached  latest step, ms  given up, s  blocks  lost  CPU sensor, detector + recorder"
    )

    def show(factor: float, outcome: Outcome) -> None:
        cpu = "  ".join(f"{outcome.cost(process):.2f}" for process in range(2))
        late = "" if factor == 0 else f"{1e3 * outcome.behind_s:.1f}"
        print(
            f"{factor or 'all haste':>6}  {outcome.factor:7.2f}  {late:>15}  {outcome.late_s:11.2f}"
            f"  {outcome.blocks:6d}  {outcome.lost:4d}  {cpu:>24}",
            flush=True,
        )

    with tempfile.TemporaryDirectory() as folder:
        real = run(1.0, Path(folder))
        show(1.0, real)
        haste = run(0.0, Path(folder))
        show(0.0, haste)
        factor = haste.factor
        while factor > 0.2:
            factor = round(0.9 * factor, 3)
            outcome = run(factor, Path(folder))
            show(factor, outcome)
            if outcome.kept:
                print(f"largest factor kept: {factor}")
                return
    sys.exit("no factor was kept")


if __name__ == "__main__":
    main()
