"""A run compared with a refined one: what half the step and a finer basis change."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .quality import QualityReport
from .scenario import Scenario
from .simulation import OUTPUTS, Block, Simulation

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class CheckRow:
    """How one quantity of a run changes: peaks, and largest change divided by the refined peak."""

    quantity: str
    peak: float
    refined_peak: float
    change: float


@dataclass(frozen=True, slots=True)
class CheckResult:
    """What a finer step and basis change, and how well the run itself closes.

    Attributes:
        title: what was refined.
        rows: one per quantity.
        quality: of the run as it is, its energy balance included.
    """

    title: str
    rows: tuple[CheckRow, ...]
    quality: QualityReport


class _LowPass:
    """Streaming fourth-order low-pass that starts from a steady state."""

    def __init__(self, edge: float, step: float) -> None:
        # only checks need it, and it takes longer to import than all the rest
        from scipy import signal

        self._signal = signal
        self._sections = signal.butter(4, edge, fs=1 / step, output="sos")
        self._state: Array | None = None

    def __call__(self, values: Array) -> Array:
        if self._state is None:
            self._state = self._signal.sosfilt_zi(self._sections)[:, :, np.newaxis] * values[0]
        filtered, self._state = self._signal.sosfilt(self._sections, values, axis=0, zi=self._state)
        return np.asarray(filtered)


def check_run(
    scenario: Scenario, report: Callable[[float], None] | None = None, samples: int = 1600
) -> CheckResult:
    """Run a scenario as it is and refined, side by side, and compare sample by sample.

    Refined: half the step and a frequency limit 1.25 times as high. Both runs are compared below
    a quarter of the frequency limit, where the two sampling rates filter alike.

    Args:
        scenario: what to check.
        report: called with the share done, 0 to 1.
        samples: block length.
    """
    solution = scenario.solution
    finer = solution.model_copy(
        update={"step": solution.step / 2, "frequency_limit": 1.25 * solution.frequency_limit}
    )
    runs = (
        Simulation(scenario, outputs=OUTPUTS, balance=True),
        Simulation(scenario.model_copy(update={"solution": finer}), outputs=OUTPUTS),
    )
    edge = solution.frequency_limit / 4
    filters = [_LowPass(edge, solution.step / (1 + number)) for number in range(2)]
    width = 3 * len(runs[0].channels)
    peaks, change = np.zeros((2, 1 + width)), np.zeros(1 + width)

    def signals(block: Block) -> Array:
        parts = [block.displacement, block.velocity, block.acceleration]
        return np.concatenate([part for part in parts if part is not None], axis=1)

    done, total = 0, runs[0].end_index
    while done < total:
        count = min(samples, total - done)
        coarse, fine = runs[0].advance(count), runs[1].advance(2 * count)
        filtered = [filters[0](signals(coarse)), filters[1](signals(fine))[::2]]
        forces = [coarse.wheelset_force, fine.wheelset_force[::2]]
        on = np.isfinite(forces[0]) & np.isfinite(forces[1])
        for number in range(2):
            force = np.where(on, forces[number], 0.0)
            peaks[number, 0] = max(peaks[number, 0], np.abs(force).max(initial=0.0))
            np.maximum(peaks[number, 1:], np.abs(filtered[number]).max(0), out=peaks[number, 1:])
        difference = np.where(on, forces[0] - forces[1], 0.0)
        change[0] = max(change[0], np.abs(difference).max(initial=0.0))
        np.maximum(change[1:], np.abs(filtered[0] - filtered[1]).max(0), out=change[1:])
        done += count
        if report is not None:
            report(done / total)
    names = ["wheelset force"] + [f"{c}, {o}" for o in OUTPUTS for c in runs[0].channels]
    return CheckResult(
        title=(
            f"step {solution.step * 1e6:g} -> {solution.step * 5e5:g} us, frequency limit "
            f"{solution.frequency_limit:g} -> {finer.frequency_limit:g} Hz; channels low-passed "
            f"at {edge:g} Hz"
        ),
        rows=tuple(
            CheckRow(name, float(a), float(b), float(c / b) if b > 0 else 0.0)
            for name, a, b, c in zip(names, peaks[0], peaks[1], change, strict=True)
        ),
        quality=runs[0].quality,
    )
