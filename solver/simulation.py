"""A run, streamed: trains cross the line and blocks of samples come out."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from .contact import compression_of, wheelset_law
from .errors import InputError
from .hybrid import HybridRun
from .line import assemble
from .modal import ModalRun
from .motion import TrainMotion
from .newmark import NewmarkRun
from .quality import QualityReport
from .scenario import Scenario, Train
from .segments import line_run
from .traffic import Traffic
from .vehicle import build_units

Array = NDArray[np.float64]
Output = Literal["displacement", "velocity", "acceleration"]
OUTPUTS: tuple[Output, ...] = ("displacement", "velocity", "acceleration")

CONTACT_PHASE = 0.5
"""Largest phase (rad) of a wheelset on its contact springs in one step."""

LOOK_AHEAD = 0.5
"""Time (s) before a train runs in at which it gets its columns: no run computes further ahead."""

SETTLE_TIME = 3.0
"""Time (s) that a run of unstated end goes on after the last wheelset has left the line."""


@dataclass(frozen=True, slots=True)
class Block:
    """Consecutive samples of a run.

    Attributes:
        index: number of the first sample since t = 0.
        time: (n,) s.
        wheelset_train: (W,) index of the train of every wheelset: trains count in the order of
            ``scenario.train``, then as they are added.
        wheelset_number: (W,) number of the wheelset in its train, from 1.
        wheelset_position: (n, W) m, all wheelsets of the trains that have columns.
        wheelset_force: (n, W) N, both wheels of a wheelset on the rails; NaN off the line.
        displacement: (n, C) m, positive down, solver rate, unfiltered; None when not asked for.
            Channels of strain (-) or force (N) give their value here.
        velocity: (n, C), time derivative of ``displacement``.
        acceleration: (n, C), time derivative of ``velocity``.
    """

    index: int
    time: Array
    wheelset_train: NDArray[np.intp]
    wheelset_number: NDArray[np.intp]
    wheelset_position: Array
    wheelset_force: Array
    displacement: Array | None
    velocity: Array | None
    acceleration: Array | None


class Simulation:
    """The coupled run of a scenario, one block after the other.

    Sample k is at t = k * step; sample 0 is the static start.

    Args:
        scenario: what to run.
        outputs: which derivatives of the channel signals the blocks carry.
        columns: which trains have columns in the blocks: ``all``, for the whole run, so that blocks
            can be joined; or those ``present``, within half a second of the block or nearer, and a
            train that has left is forgotten, so that a run without end keeps its cost and memory.
        balance: balance the line's energy too where that is not had for nothing: with exponential
            steps. The modes are then computed anew, and stepping costs about three times as much.
            A line in segments has none; its quality then says so.
        report: called with one-line messages on what is being prepared.

    Raises:
        InputError: the scenario asks for what cannot be run.

    Attributes:
        scenario: the scenario, without trains added at run time.
        step_ns: time step (ns).
        channels: channel names, one per column of the block's signals.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        outputs: Sequence[Output] = ("acceleration",),
        columns: Literal["all", "present"] = "all",
        balance: bool = False,
        report: Callable[[str], None] | None = None,
    ) -> None:
        tell = report or (lambda message: None)
        self.scenario = scenario
        self.step_ns = scenario.solution.step_ns
        self.channels = tuple(channel.name for channel in scenario.channel)
        self._outputs: tuple[Output, ...] = tuple(name for name in OUTPUTS if name in outputs)
        self._traffic = Traffic(scenario)
        self._forgets = columns == "present"
        self._steady = (0, 0)
        self._index = 0
        _check_step(scenario)
        for train in scenario.train:
            _check_contact(scenario, train)
        derivatives = tuple(OUTPUTS.index(name) for name in self._outputs)
        tell("modes of the line: computed once, then kept")
        self._run: ModalRun | HybridRun | NewmarkRun
        if scenario.solution.model == "hybrid":
            self._run = HybridRun(scenario, self._traffic, derivatives, balance=balance)
        elif scenario.solution.integrator == "newmark":
            self._run = NewmarkRun(assemble(scenario), self._traffic, derivatives)
        else:
            self._run = line_run(scenario, self._traffic, derivatives, balance=balance)
        tell(f"{self.states} modes; compiling or loading the stepping kernel")

    @property
    def motions(self) -> Mapping[int, TrainMotion]:
        """Kinematics of every train that is not forgotten, by its index."""
        return self._traffic.motions

    @property
    def end_index(self) -> int:
        """Number of samples from t = 0 to the end of the run."""
        end = self.scenario.solution.end_time
        if end is None:
            end = self._traffic.last_exit() + SETTLE_TIME
        return math.floor(end / (self.step_ns * 1e-9) + 1e-9) + 1

    @property
    def states(self) -> int:
        """Number of modes, or with Newmark coordinates, that are stepped."""
        return self._run.states

    @property
    def step_ratio(self) -> int:
        """Samples per step of the deterministic set: 1, more for the hybrid."""
        return self._run.ratio

    @property
    def quality(self) -> QualityReport:
        """How far the samples so far can be trusted."""
        return QualityReport(
            samples=self._index,
            equilibrium_residual=self._run.equilibrium_residual,
            energy_residual=self._run.energy_residual,
            lost_contacts=self._run.lost_contacts,
            valid_band=dict(zip(self.channels, self._run.channel_band.tolist(), strict=True)),
            notes=self._run.notes,
        )

    def advance(self, samples: int) -> Block:
        """The next ``samples`` samples; there is no end to a run.

        Raises:
            SolverError: the computation left its valid range.
        """
        index = self._index
        if self._forgets:
            self._rearrange(samples)
        time, position, force, signals = self._run.advance(samples)
        self._index += samples
        width = len(self.channels)
        parts: dict[Output, Array] = {
            name: signals[:, i * width : (i + 1) * width] for i, name in enumerate(self._outputs)
        }
        return Block(
            index=index,
            time=time,
            wheelset_train=self._traffic.wheelset_train,
            wheelset_number=self._traffic.wheelset_number,
            wheelset_position=position,
            wheelset_force=force,
            displacement=parts.get("displacement"),
            velocity=parts.get("velocity"),
            acceleration=parts.get("acceleration"),
        )

    def _rearrange(self, samples: int) -> None:
        """Columns for the trains near the line in the next samples; the departed are forgotten."""
        ahead = math.ceil(LOOK_AHEAD / (self.step_ns * 1e-9))
        first, last = self._index, self._index + samples + ahead
        end, start = self._steady
        if first < end and last < start:
            return
        present = self._traffic.present(first, last)
        if present != self._traffic.arranged:
            self._run.arrange(present, self._traffic.departed(first))
        self._steady = self._traffic.steady(first, last)

    def blocks(self, samples: int = 800) -> Iterator[Block]:
        """Blocks of ``samples`` samples to ``end_index``; the last one may be shorter."""
        while self._index < self.end_index:
            yield self.advance(min(samples, self.end_index - self._index))

    def add_train(self, train: Train, start_time: float) -> int:
        """Add a train that is at ``train.start`` at ``start_time`` (s); returns its index.

        Its wheelsets may be columns of the blocks from the next one on.

        Raises:
            InputError: a wheelset would appear on the line out of nowhere.
        """
        train = train.model_copy(update={"start_time": start_time})
        _check_contact(self.scenario, train)
        now = self._run.next_sample * self.step_ns * 1e-9
        place = TrainMotion(train).position(now)
        if (
            self._run.next_sample > 0
            and ((place >= 0) & (place <= self.scenario.line.length)).any()
        ):
            axle = int(np.argmax((place >= 0) & (place <= self.scenario.line.length)))
            raise InputError(
                f"train added at t = {now:.6g} s: its wheelset {axle + 1} would be at x = "
                f"{place[axle]:.6g} m, on the line of {self.scenario.line.length:g} m already: "
                "choose a later start_time or a start farther away"
            )
        if isinstance(self._run, HybridRun):
            self._run.check(train)
        index = self._traffic.add(train, self._run.next_sample)
        self._run.arrange((*self._traffic.arranged, index))
        self._steady = (0, 0)
        return index


def _check_step(scenario: Scenario) -> None:
    step, limit = scenario.solution.step, scenario.solution.frequency_limit
    if step * limit > 0.5:
        raise InputError(
            f"solution.step = {step:g} s is too long for solution.frequency_limit = {limit:g} Hz: "
            f"at most 1/(2 frequency_limit) = {0.5 / limit:.3g} s"
        )


def _check_contact(scenario: Scenario, train: Train) -> None:
    """Refuse a step that does not resolve a wheelset on its contact springs."""
    step = scenario.solution.step
    for unit in build_units(train):
        masses = unit.mass[unit.wheelsets, unit.wheelsets]
        for load, mass, radius in zip(unit.static_loads, masses, unit.wheel_radius, strict=True):
            law = np.array(wheelset_law(scenario.contact, float(radius)))[:, np.newaxis]
            compression = float(compression_of(np.array([load]), *law)[0])
            stiffness = load / compression * (1.5 if scenario.contact.law == "hertz" else 1.0)
            angular = math.sqrt(stiffness / mass)
            if angular * step > CONTACT_PHASE:
                raise InputError(
                    f"solution.step = {step:g} s is too long: a wheelset of {mass:g} kg resonates "
                    f"on its contact at {angular / (2 * math.pi):.0f} Hz; at most "
                    f"{CONTACT_PHASE / angular:.3g} s"
                )
