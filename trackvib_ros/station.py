"""The virtual measuring station: the run, its sensors and its truth, advanced together. No ROS."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from solver import Block, Scenario, Simulation, Train, train_preset
from trackvib_ros.sensor import UP, SensorArray
from trackvib_ros.truth import PassageTruth
from trackvib_ros.waveform import Waveform

STEP_S = 0.02
"""Simulated time per step of the station (s): the step of ``/clock``."""


@dataclass(frozen=True, slots=True)
class WheelsetState:
    """A wheelset on the line at one instant: position (m), force of the rails on it (N, up)."""

    train: int
    number: int
    position: float
    force: float


@dataclass(frozen=True, slots=True)
class TrainState:
    """A train at one instant: position of the first wheelset (m), velocity along x (m/s)."""

    number: int
    position: float
    velocity: float
    train: Train


@dataclass(frozen=True, slots=True)
class StationStep:
    """What one step of the station gives.

    Attributes:
        time_ns: simulated time reached: the time of the first sample not yet computed (ns).
        start_ns: time of the first sample of this step (ns).
        waveforms: complete blocks of the sensor groups.
        acceleration: truth at all channels, solver rate, unfiltered (m/s², up).
        wheel_force: truth of the wheelsets that touched the line (N, up, NaN off the line); None
            if there was none.
        wheelsets: the wheelsets on the line at ``start_ns``.
        trains: trains with a wheelset on the line, at ``start_ns``.
        entered: trains whose first wheelset entered the line in this step.
    """

    time_ns: int
    start_ns: int
    waveforms: list[Waveform]
    acceleration: Waveform
    wheel_force: Waveform | None
    wheelsets: list[WheelsetState]
    trains: list[TrainState]
    entered: list[PassageTruth]


def reseeded(scenario: Scenario, seed: int) -> Scenario:
    """The scenario with another realisation of irregularity, noise, jitter and drop-outs."""
    shift = seed - scenario.irregularity.seed
    return scenario.model_copy(
        update={
            "irregularity": scenario.irregularity.model_copy(update={"seed": seed}),
            "sensor": tuple(
                sensor.model_copy(update={"seed": abs(sensor.seed + shift)})
                for sensor in scenario.sensor
            ),
        }
    )


def next_seed(scenario: Scenario, wanted: int) -> int:
    """The seed of a run that follows: as wanted, or if that is negative the scenario's and one."""
    return scenario.irregularity.seed + 1 if wanted < 0 else wanted


class Station:
    """A scenario that runs step by step.

    Args:
        scenario: what to run.
        headway: mean of random (exponentially distributed) headways after the least headway, at
            which further trains are sent for ever (s); 0 sends none.
        least_headway: shortest time between two of those trains (s).
        report: called with one-line messages while the model is assembled.

    Raises:
        InputError: the scenario cannot be run, or a sensor is impossible.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        headway: float = 0.0,
        least_headway: float = 60.0,
        report: Callable[[str], None] | None = None,
    ) -> None:
        self.scenario = scenario
        self.sensors = SensorArray(scenario, [channel.name for channel in scenario.channel])
        self.simulation = Simulation(
            scenario, outputs=("acceleration",), columns="present", report=report
        )
        self._samples = max(2, round(STEP_S * 1e9 / self.simulation.step_ns))
        self._index = self._computed = 0
        self._headway, self._least_headway = headway, least_headway
        self._random = np.random.default_rng([scenario.irregularity.seed, 0x7264])
        self._next_train_ns = self._draw_headway(0)
        self._known = -1
        self._coming: list[tuple[int, int, PassageTruth]] = []
        self._present: list[PassageTruth] = []
        # the first step loads the compiled kernel for seconds: better now than while running
        self._first: StationStep | None = self._compute()

    @property
    def time_ns(self) -> int:
        """Simulated time reached (ns)."""
        return self._index * self.simulation.step_ns

    @property
    def _computed_ns(self) -> int:
        return self._computed * self.simulation.step_ns

    @property
    def finished(self) -> bool:
        """True when the end of the run is reached; a further train ends that."""
        return self._headway == 0 and self._index >= self.simulation.end_index

    @property
    def end_s(self) -> float:
        """Simulated time at which the run ends (s); infinite with random headways."""
        if self._headway > 0:
            return float("inf")
        return self.simulation.end_index * self.simulation.step_ns * 1e-9

    def _draw_headway(self, after_ns: int) -> int:
        wait = self._least_headway + self._random.exponential(self._headway)
        return after_ns + round(wait * 1e9)

    def trigger(self, preset: str | None = None, speed: float | None = None) -> int:
        """Send another train now; returns its number, from 1.

        It is the scenario's first train unless a ``preset`` is named (or there is none: CRH3), at
        its speed unless ``speed`` (m/s) is given.

        Raises:
            InputError: no such preset or an impossible speed.
        """
        if preset or not self.scenario.train:
            train = train_preset(preset or "CRH3", speed or 300 / 3.6, 0.0)
        else:
            train = self.scenario.train[0]
        update: dict[str, object] = {"speed_profile": ()} if speed else {}
        speed = speed or train.speed
        # so that the first wheelset needs half a second to the line, outside the static zone
        away = 0.5 * speed + 1.0
        start = -away if train.direction == "forward" else self.scenario.line.length + away
        update |= {"speed": speed, "start": start, "start_time": self._computed_ns * 1e-9}
        train = train.model_copy(update=update)
        return self.simulation.add_train(train, train.start_time) + 1

    def advance(self) -> StationStep:
        """Run one step.

        Raises:
            SolverError: the computation left its valid range.
        """
        step = self._first or self._compute()
        self._first = None
        self._index = self._computed
        return step

    def _compute(self) -> StationStep:
        start_ns = self._computed_ns
        if self._headway > 0 and start_ns >= self._next_train_ns:
            self.trigger()
            self._next_train_ns = self._draw_headway(start_ns)
        block = self.simulation.advance(self._samples)
        self._computed += self._samples
        acceleration = block.acceleration
        if acceleration is None:
            raise AssertionError("the simulation was asked for acceleration")
        truth = Waveform(
            start_ns,
            self.simulation.step_ns,
            self.simulation.channels,
            (UP * acceleration).astype(np.float32),
            "line",
        )
        entered = self._admit()
        force, wheelsets = self._wheelsets(start_ns, block)
        return StationStep(
            time_ns=self._computed_ns,
            start_ns=start_ns,
            waveforms=self.sensors.push(acceleration),
            acceleration=truth,
            wheel_force=force,
            wheelsets=wheelsets,
            trains=[self._train(passage.train, start_ns) for passage in self._present],
            entered=entered,
        )

    def _wheelsets(
        self, start_ns: int, block: Block
    ) -> tuple[Waveform | None, list[WheelsetState]]:
        position, force = block.wheelset_position, block.wheelset_force
        touching = np.flatnonzero(np.isfinite(force).any(axis=0))
        if touching.size == 0:
            return None, []
        trains, numbers = block.wheelset_train[touching] + 1, block.wheelset_number[touching]
        names = tuple(f"train_{k}_wheelset_{n}" for k, n in zip(trains, numbers, strict=True))
        wave = Waveform(
            start_ns,
            self.simulation.step_ns,
            names,
            force[:, touching].astype(np.float32),
            "line",
        )
        states = [
            WheelsetState(int(k), int(n), float(position[0, w]), float(force[0, w]))
            for k, n, w in zip(trains, numbers, touching, strict=True)
            if np.isfinite(force[0, w])
        ]
        return wave, states

    def _admit(self) -> list[PassageTruth]:
        """Look at new trains, let those on the line in and those past it go; the ones let in."""
        for index, motion in self.simulation.motions.items():
            if index > self._known:
                passage = PassageTruth.of(motion, index + 1, self.scenario)
                heapq.heappush(self._coming, (passage.enter_ns, index, passage))
                self._known = index
        entered = []
        while self._coming and self._coming[0][0] < self._computed_ns:
            passage = heapq.heappop(self._coming)[2]
            if passage.leave_ns > 0:
                entered.append(passage)
        self._present = [p for p in self._present + entered if p.leave_ns >= self._computed_ns]
        return entered

    def _train(self, number: int, now_ns: int) -> TrainState:
        motion = self.simulation.motions[number - 1]
        front = float(motion.position(now_ns * 1e-9)[0])
        velocity = float(motion.sign * motion.speed(now_ns * 1e-9))
        return TrainState(number, front, velocity, motion.train)
