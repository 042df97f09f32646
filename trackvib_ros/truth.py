"""What really happens, for comparison with what is detected: no ROS, no imperfections."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from solver import InputError, Scenario, TrainMotion


@dataclass(frozen=True, slots=True)
class PassageTruth:
    """One train's passage, known from its prescribed motion.

    Attributes:
        train: number of the train in the run, from 1.
        train_type: preset of the train, or ``custom``.
        direction: ``forward`` (towards increasing x) or ``backward``.
        length_m: length over couplers (m).
        enter_ns: time at which the first wheelset enters the line (ns).
        leave_ns: time at which the last wheelset leaves the line (ns).
        axle_times_ns: for each sensor channel, the times at which the wheelsets pass it (ns), front
            first.
        speed_m_s: for each sensor channel, the mean speed over the passage of the wheelsets (m/s).
    """

    train: int
    train_type: str
    direction: str
    length_m: float
    enter_ns: int
    leave_ns: int
    axle_times_ns: Mapping[str, tuple[int, ...]]
    speed_m_s: Mapping[str, float]

    @property
    def axle_count(self) -> int:
        """Number of wheelsets."""
        return len(next(iter(self.axle_times_ns.values()), ()))

    @classmethod
    def of(cls, motion: TrainMotion, number: int, scenario: Scenario) -> PassageTruth:
        """Truth of train ``number`` (from 1) of a run, at every channel that has a sensor."""
        sensors = {sensor.channel for sensor in scenario.sensor}
        times = {
            channel.name: motion.axle_times(scenario.channel_x(channel))
            for channel in scenario.channel
            if channel.name in sensors
        }
        ends = np.concatenate([motion.axle_times(0.0), motion.axle_times(scenario.line.length)])
        reach = float(motion.offsets[-1])
        return cls(
            train=number,
            train_type=motion.train.preset or "custom",
            direction=motion.train.direction,
            length_m=motion.train.length,
            enter_ns=round(float(ends.min()) * 1e9),
            leave_ns=round(float(ends.max()) * 1e9),
            axle_times_ns={
                name: tuple(round(t * 1e9) for t in axles.tolist()) for name, axles in times.items()
            },
            speed_m_s={
                name: reach / float(axles[-1] - axles[0])
                if axles.size > 1
                else float(motion.speed(axles[0]))
                for name, axles in times.items()
            },
        )

    def to_dict(self) -> dict[str, str]:
        """Flat text pairs; :meth:`from_dict` reverses it."""
        pairs = {
            "train": str(self.train),
            "train_type": self.train_type,
            "direction": self.direction,
            "axle_count": str(self.axle_count),
            "length_m": repr(self.length_m),
            "enter_ns": str(self.enter_ns),
            "leave_ns": str(self.leave_ns),
        }
        for name, times in self.axle_times_ns.items():
            pairs[f"{name}.arrival_ns"] = str(times[0])
            pairs[f"{name}.departure_ns"] = str(times[-1])
            pairs[f"{name}.speed_m_s"] = repr(self.speed_m_s[name])
            pairs[f"{name}.axle_times_ns"] = json.dumps(times)
        return pairs

    @classmethod
    def from_dict(cls, pairs: Mapping[str, str]) -> PassageTruth:
        """The passage written by :meth:`to_dict`.

        Raises:
            InputError: something is missing or is no number.
        """
        suffix = ".axle_times_ns"
        try:
            names = [key.removesuffix(suffix) for key in pairs if key.endswith(suffix)]
            return cls(
                train=int(pairs["train"]),
                train_type=pairs["train_type"],
                direction=pairs["direction"],
                length_m=float(pairs["length_m"]),
                enter_ns=int(pairs["enter_ns"]),
                leave_ns=int(pairs["leave_ns"]),
                axle_times_ns={name: tuple(json.loads(pairs[name + suffix])) for name in names},
                speed_m_s={name: float(pairs[f"{name}.speed_m_s"]) for name in names},
            )
        except (KeyError, ValueError) as error:
            raise InputError(f"not the truth of a passage: {error}") from None
