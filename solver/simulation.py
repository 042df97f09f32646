"""A run, streamed: trains cross the line and blocks of samples come out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from .motion import TrainMotion
from .quality import QualityReport
from .scenario import Scenario, Train

Array = NDArray[np.float64]
Output = Literal["displacement", "velocity", "acceleration"]

SETTLE_TIME = 2.0
"""Time (s) that a run of unstated end goes on after the last wheelset has left the line."""


@dataclass(frozen=True, slots=True)
class Block:
    """Consecutive samples of a run.

    Attributes:
        index: number of the first sample since t = 0.
        time: (n,) s.
        wheelset_position: (n, W) m, all wheelsets of all trains in order of ``scenario.train``.
        wheelset_force: (n, W) N, both wheels of a wheelset on the rails; NaN off the line.
        displacement: (n, C) m, positive down, solver rate, unfiltered; None when not asked for.
            Channels of strain (-) or force (N) give their value here.
        velocity: (n, C), time derivative of ``displacement``.
        acceleration: (n, C), time derivative of ``velocity``.
    """

    index: int
    time: Array
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
        report: called with one-line messages on what is being prepared.

    Raises:
        InputError: the scenario asks for what cannot be run.

    Attributes:
        scenario: the scenario, trains added at run time included.
        step_ns: time step (ns).
        end_index: number of samples from t = 0 to the end of the run.
        channels: channel names, one per column of the block's signals.
        motions: kinematics of every train.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        outputs: Sequence[Output] = ("acceleration",),
        report: Callable[[str], None] | None = None,
    ) -> None:
        self.scenario = scenario
        self.step_ns = scenario.solution.step_ns
        self.channels = tuple(channel.name for channel in scenario.channel)
        self.motions = [TrainMotion(train) for train in scenario.train]
        self.end_index = 0
        self._outputs = tuple(outputs)

    @property
    def train_of_wheelset(self) -> NDArray[np.intp]:
        """(W,) index into ``scenario.train`` of every wheelset."""
        counts = [len(motion.offsets) for motion in self.motions]
        return np.repeat(np.arange(len(counts)), counts)

    @property
    def quality(self) -> QualityReport:
        """How far the samples so far can be trusted."""
        raise NotImplementedError

    def advance(self, samples: int) -> Block:
        """The next ``samples`` samples.

        Raises:
            SolverError: the computation left its valid range.
        """
        raise NotImplementedError

    def blocks(self, samples: int = 800) -> Iterator[Block]:
        """Blocks of ``samples`` samples to ``end_index``; the last one may be shorter."""
        raise NotImplementedError

    def add_train(self, train: Train, start_time: float) -> int:
        """Add a train that is at ``train.start`` at ``start_time`` (s); returns its index.

        Its wheelsets are columns of the blocks from the next one on.

        Raises:
            InputError: a wheelset would appear on the line out of nowhere.
        """
        raise NotImplementedError
