"""Benchmarks: how fast a run is, as ratios to a reference in the same call, at a stated error.

Every case runs in a process of its own on one core, so that its peak memory and CPU time are its
own. Costs are CPU seconds per simulated second, preparation excluded.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import resource
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import resources
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.signal import butter, sosfiltfilt

from solver import Scenario, Simulation, load_scenario
from trackvib_ros.sensor import SensorArray

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

Array = NDArray[np.float64]

BLOCK = 800
BAND = 2000.0
"""Errors of force and acceleration are taken below this frequency (Hz)."""

# Least work of the stepping kernel per step (solver/modal.py): what it must move at least once, if
# all that it reads again stayed in the first-level cache, and all its arithmetic.
# Wheelset on the line and mode: 8 coefficients and 2 kept values of the shape read, 2 written, all
# single precision; shape 12 flops, guessed load, displacement and load 4 each.
BYTES_PER_WHEELSET_AND_MODE = 48
FLOPS_PER_WHEELSET_AND_MODE = 24
# Mode: 8 factors read, 2 values of the state read and written, double; 2 loads read and written, 2
# values for the channels written and read, single; step 16 flops, prediction 16. Weights of a
# channel: 2, single, for four samples at a time.
BYTES_PER_MODE = 128
FLOPS_PER_MODE = 32
BYTES_PER_CHANNEL_AND_MODE = 2
FLOPS_PER_CHANNEL_AND_MODE = 4


@dataclass(frozen=True, slots=True)
class Case:
    """One benchmark, as in ``config/bench.toml``.

    Attributes:
        name: shown in the table. group: cases of one group belong together.
        scenario: scenario preset.
        cars: CRH3 cars that replace its train; 0 keeps it.
        spans: number of 32 m spans; 0 keeps the line.
        start: position of the first wheelset at t = 0 (m); None keeps the scenario's.
        trains: how many of the train run, ``headway`` (s) apart.
        solution: entries of ``[solution]`` that differ.
        sensors: whether the virtual accelerometers are run and timed too.
        reference: case that cost is compared with (ratio).
        truth: case that force and acceleration are compared with (error).
        limit: whether the share of the machine's own rate is measured.
    """

    name: str
    group: str
    scenario: str
    cars: int = 0
    spans: int = 0
    start: float | None = None
    trains: int = 1
    headway: float = 0.0
    solution: Mapping[str, Any] = field(default_factory=dict)
    sensors: bool = False
    reference: str = ""
    truth: str = ""
    limit: bool = False

    @property
    def size(self) -> float:
        """Number of cars or spans, whichever the case sets."""
        return float(self.cars or self.spans)


@dataclass(frozen=True, slots=True)
class Result:
    """What a case measured; nan where it was not.

    Attributes:
        case, group: of the case.
        states: modes (or coordinates) stepped. step: time step (s).
        simulated, cpu: simulated and CPU time (s), preparation excluded.
        steps_per_second: steps per CPU second. real_time_factor: simulated per CPU second.
        preparation: time to the end of the first block (s). peak_memory: of the process (bytes).
        ratio: cost of the reference over the cost of this case.
        force_error, acceleration_error: largest difference below 2 kHz to the case ``truth``, over
            its largest deviation from the mean.
        limit_fraction: share of the rate that the machine's memory or arithmetic allows.
    """

    case: str
    group: str
    states: int
    step: float
    simulated: float
    cpu: float
    steps_per_second: float
    real_time_factor: float
    preparation: float
    peak_memory: int
    ratio: float = math.nan
    force_error: float = math.nan
    acceleration_error: float = math.nan
    limit_fraction: float = math.nan


def load_cases() -> list[Case]:
    """The cases of ``config/bench.toml``."""
    text = resources.files("trackvib_ros").joinpath("config/bench.toml").read_text("utf-8")
    return [Case(**entry) for entry in tomllib.loads(text)["case"]]


def scenario_of(case: Case) -> Scenario:
    """The scenario that a case runs."""
    scenario = load_scenario(case.scenario)
    train = scenario.train[0]
    if case.cars:
        cars = train.vehicles[:1] * case.cars
        train = train.model_copy(update={"vehicles": cars, "preset": None})
    if case.start is not None:
        train = train.model_copy(update={"start": case.start})
    times = [train.start_time + number * case.headway for number in range(case.trains)]
    trains = tuple(train.model_copy(update={"start_time": time}) for time in times)
    scenario = scenario.model_copy(update={"train": trains})
    if case.spans:
        line = scenario.line.model_copy(update={"spans": (32.0,) * case.spans})
        scenario = scenario.model_copy(update={"line": line})
    solution = scenario.solution.model_copy(update=dict(case.solution))
    return scenario.model_copy(update={"solution": solution})


@dataclass(frozen=True, eq=False)
class _Signals:
    step: float
    force: Array
    acceleration: Array


def _run(case: Case, keep: bool) -> tuple[Result, _Signals | None]:
    begin = time.perf_counter()
    scenario = scenario_of(case)
    simulation = Simulation(scenario)
    sensors = SensorArray(scenario, simulation.channels) if case.sensors else None
    step = simulation.step_ns * 1e-9
    total = simulation.end_index
    forces, accelerations, on_line, done = [], [], 0, 0
    start, before, preparation = time.process_time(), 0, math.nan
    while done < total:
        if done == BLOCK:
            # the first block pays for what is made once: profiles, tables
            start, before = time.process_time(), BLOCK
            preparation = time.perf_counter() - begin
        block = simulation.advance(min(BLOCK, total - done))
        done += len(block.time)
        assert block.acceleration is not None
        if sensors is not None:
            sensors.push(block.acceleration)
        if case.limit:
            on_line += int(np.isfinite(block.wheelset_force).sum())
        if keep:
            forces.append(block.wheelset_force)
            accelerations.append(block.acceleration)
    cpu = time.process_time() - start
    result = Result(
        case=case.name,
        group=case.group,
        states=simulation.states,
        step=step,
        simulated=(total - before) * step,
        cpu=cpu,
        steps_per_second=(total - before) / cpu,
        real_time_factor=(total - before) * step / cpu,
        preparation=preparation,
        peak_memory=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
    )
    if case.limit:
        fastest = least_time(simulation.states, on_line / total, len(simulation.channels))
        result = replace(result, limit_fraction=fastest * (total - before) / cpu)
    if not keep:
        return result, None
    return result, _Signals(step, np.concatenate(forces), np.concatenate(accelerations))


def least_time(modes: int, wheelsets: float, channels: int) -> float:
    """Time (s) of one step if memory or arithmetic ran at the rate this machine attains.

    Both rates are measured here, in a kernel of nothing but loads and multiply-adds in single
    precision: over a working set of the step's size, and over one that stays in the first-level
    cache. The slower of the two bounds.
    """
    size = modes * (
        BYTES_PER_MODE
        + channels * BYTES_PER_CHANNEL_AND_MODE
        + wheelsets * BYTES_PER_WHEELSET_AND_MODE
    )
    flops = modes * (
        FLOPS_PER_MODE
        + channels * FLOPS_PER_CHANNEL_AND_MODE
        + wheelsets * FLOPS_PER_WHEELSET_AND_MODE
    )
    large, small = max(int(size) // 8, 1024), 1024
    per_byte = min(_product_time(large) for _ in range(3)) / (8 * large)
    per_flop = min(_product_time(small) for _ in range(3)) / (2 * small)
    return max(size * per_byte, flops * per_flop)


def _product_time(size: int) -> float:
    a, b = np.full(size, 1.0, np.float32), np.full(size, 1e-9, np.float32)
    repeats = 200_000_000 // size
    _products(a, b, 1)
    start = time.process_time()
    _products(a, b, repeats)
    return (time.process_time() - start) / repeats


@njit(cache=True, fastmath=True)
def _products(a, b, repeats):  # type: ignore[no-untyped-def]
    total = 0.0
    for r in range(repeats):
        part = a.dtype.type(0)
        for i in range(a.size):
            part += a[i] * b[i]
        total += part
        b[r % b.size] += a.dtype.type(1e-12)
    return total


def _errors(own: _Signals, truth: _Signals) -> tuple[float, float]:
    def common(signals: _Signals, values: Array) -> Array:
        sections = butter(8, BAND, fs=1 / signals.step, output="sos")
        return np.asarray(sosfiltfilt(sections, values, axis=0))

    share = round(own.step / truth.step)
    worst = []
    for name in ("force", "acceleration"):
        a, b = getattr(own, name), getattr(truth, name)
        complete = np.isfinite(a).all(axis=0) & np.isfinite(b).all(axis=0)
        x, y = common(own, a[:, complete]), common(truth, b[:, complete])[::share]
        length = min(len(x), len(y))
        inner = slice(length // 10, length - length // 10)
        x, y = x[inner], y[inner]
        peak = abs(y - y.mean(axis=0)).max(axis=0)
        worst.append(float((abs(x - y).max(axis=0) / peak).max()) if x.size else math.nan)
    return worst[0], worst[1]


def run_cases(cases: Sequence[Case]) -> Iterator[Result]:
    """Run every case, one after the other; references before what is compared with them.

    Raises:
        KeyError: a case refers to one that was not run before it.
    """
    threads = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS")
    os.environ.update(dict.fromkeys(threads, "1"))
    context = multiprocessing.get_context("spawn")
    needed = {case.truth for case in cases}
    results: dict[str, Result] = {}
    signals: dict[str, _Signals] = {}
    for case in cases:
        with context.Pool(1) as pool:
            result, own = pool.apply(_run, (case, case.name in needed or bool(case.truth)))
        if case.truth and own is not None:
            force, acceleration = _errors(own, signals[case.truth])
            result = replace(result, force_error=force, acceleration_error=acceleration)
        if case.reference:
            other = results[case.reference]
            ratio = result.real_time_factor / other.real_time_factor
            result = replace(result, ratio=ratio)
        if own is not None and case.name in needed:
            signals[case.name] = own
        results[case.name] = result
        yield result


def growth(results: Sequence[Result], sizes: Sequence[float]) -> float:
    """Exponent p of the least-squares fit of CPU time per simulated second = c * size^p."""
    cost = [result.cpu / result.simulated for result in results]
    return float(np.polyfit(np.log(sizes), np.log(cost), 1)[0])
