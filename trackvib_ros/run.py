"""A run of the station on the wire: pace, pause, back-pressure, what goes to which topic."""

from __future__ import annotations

import time
from collections.abc import Mapping

from rclpy.node import Node

from solver import InputError, Train
from trackvib_ros import messages as m
from trackvib_ros.clock import Pace, SimulationClock
from trackvib_ros.outbox import Outbox
from trackvib_ros.station import Station, StationStep

WAIT_S = 0.02
"""Wall time between two looks at subscriptions or a full middleware (s)."""

DELIVERY_S = 10.0
"""Time that readers get to take what is left of a run that is over (s)."""
HURRY_S = 0.5
"""The same for a run that is cut short (s)."""

Component = tuple[str, str | None, Mapping[str, object]]


def without_run(failure: str | None) -> list[Component]:
    """What ``/diagnostics`` says while there is no run."""
    return [("simulation", failure, {"state": "not configured"})]


class Run:
    """Publishes a station step by step.

    Args:
        node: publishers and clock become this node's.
        station: what runs.
        truth: whether ``ground_truth/...`` is published.
        detectors, recorders: subscriptions to wait for before the first step: both on waveform
            topics, recorders on every data topic.

    Attributes:
        pace: its factor may be changed at any time.
        station: what runs.
    """

    def __init__(
        self, node: Node, station: Station, *, truth: bool, detectors: int, recorders: int
    ) -> None:
        self.pace = Pace(1.0)
        self.station = station
        self._detectors, self._recorders = detectors, recorders
        self._truth = truth
        self._outbox = Outbox(node)
        self._clock = SimulationClock(node)
        self._pause_at_ns: int | None = None
        self._started = False
        self._most_subscriptions: dict[str, int] = {}
        self._last: StationStep | None = None
        self._shown: StationStep | None = None
        self._wall_s = 0.0
        self._measured = (time.monotonic(), 0)
        self._groups = {group.name: group.channels for group in station.sensors.groups}
        self._waveforms = {m.waveform_topic(name).name for name in self._groups}
        self._open()
        self._outbox.put(m.SCENARIO, m.scenario_message(station.scenario))
        self._outbox.put(m.CHANNELS, m.channels_message(station.scenario, self._groups))
        self._outbox.flush()

    def _open(self) -> None:
        topics = [m.SCENARIO, m.CHANNELS, m.MARKERS]
        for name, channels in self._groups.items():
            topics.append(m.waveform_topic(name))
            topics += [m.acceleration_topic(channel) for channel in channels]
        if self._truth:
            topics += [m.TRUE_ACCELERATION, m.TRUE_WHEEL_FORCE, m.TRUE_WHEELSETS]
            topics += [m.TRUE_TRAIN, m.TRUE_PASSAGES]
        for topic in topics:
            self._outbox.open(topic)
        for train in self.station.scenario.train:
            self._open_wheel_forces(train)

    def _open_wheel_forces(self, train: Train) -> None:
        for number in range(1, len(train.axle_positions) + 1):
            self._outbox.open(m.wheel_force_topic(number))

    @property
    def finished(self) -> bool:
        """True when the run is over and everything is published."""
        return self.station.finished and self._outbox.pending == 0

    @property
    def state(self) -> str:
        """``waiting`` for subscriptions, ``running``, ``blocked``, ``paused`` or ``finished``."""
        if self.finished:
            return "finished"
        if not self._started:
            return "waiting"
        if self._outbox.pending:
            return "blocked"
        return "paused" if self._paused else "running"

    @property
    def _paused(self) -> bool:
        return self._pause_at_ns is not None and self.station.time_ns >= self._pause_at_ns

    def pause(self) -> None:
        """Stop simulated time after the step at hand."""
        self._pause_at_ns = self.station.time_ns

    def resume(self) -> None:
        """Let simulated time go on."""
        self._pause_at_ns = None
        self.pace.hold()

    def step(self, duration_s: float) -> int:
        """Run for ``duration_s`` of simulated time, then pause; returns that time (ns).

        Raises:
            InputError: the run is not paused.
        """
        if not self._paused:
            raise InputError("the run is not paused: call the service pause first")
        self._pause_at_ns = self.station.time_ns + round(duration_s * 1e9)
        self.pace.hold()
        return self._pause_at_ns

    def hold(self) -> None:
        """The node is inactive: simulated time stands still."""
        self.pace.hold()

    def trigger(self, preset: str | None, speed: float | None) -> int:
        """Send a train now; see :meth:`Station.trigger`."""
        number = self.station.trigger(preset, speed)
        self._open_wheel_forces(self.station.simulation.motions[number - 1].train)
        return number

    def advance(self) -> float:
        """Do one step if it is due; returns the wall time until there may be more to do (s).

        Raises:
            SolverError: the computation left its valid range.
        """
        if not self._outbox.flush():
            return 0.0
        if not self._started:
            self._started = self._subscribed()
            self.pace.hold()
        if not self._started or self._paused or self.station.finished:
            self.pace.hold()
            return WAIT_S
        delay = self.pace.delay(self.station.time_ns)
        if delay > 0:
            return delay
        began = time.perf_counter()
        step = self.station.advance()
        self._wall_s += time.perf_counter() - began
        self._publish(step)
        return 0.0

    def _subscribed(self) -> bool:
        counts = self._outbox.subscriptions()
        return all(
            count >= self._recorders + (self._detectors if name in self._waveforms else 0)
            for name, count in counts.items()
        )

    def _publish(self, step: StationStep) -> None:
        put = self._outbox.put
        for waveform in step.waveforms:
            put(m.waveform_topic(waveform.frame_id), m.waveform_message(waveform))
            for channel, message in m.acceleration_messages(waveform):
                put(m.acceleration_topic(channel), message)
        for wheelset in step.wheelsets:
            message = m.wheel_force_message(step.start_ns, wheelset)
            put(m.wheel_force_topic(wheelset.number), message)
        if self._truth:
            for passage in step.entered:
                put(m.TRUE_PASSAGES, m.passage_message(passage))
            put(m.TRUE_ACCELERATION, m.waveform_message(step.acceleration))
            if step.wheel_force is not None:
                put(m.TRUE_WHEEL_FORCE, m.waveform_message(step.wheel_force))
                put(m.TRUE_WHEELSETS, m.wheelsets_message(step.start_ns, step.wheelsets))
            for train in step.trains:
                put(m.TRUE_TRAIN, m.train_message(step.start_ns, train))
        self._last = step
        self._outbox.flush()
        self._clock.set(step.time_ns)

    def show(self) -> None:
        """Publish the markers of the last step, if they are new."""
        step = self._last
        if step is not None and step is not self._shown and self._outbox.pending == 0:
            self._shown = step
            message = m.marker_message(
                step.start_ns, self.station.scenario, step.trains, step.wheelsets
            )
            self._outbox.put(m.MARKERS, message)
            self._outbox.flush()

    def components(self) -> list[Component]:
        """What ``/diagnostics`` says about the run."""
        now, time_ns = time.monotonic(), self.station.time_ns
        wall, since_ns = self._measured
        self._measured = (now, time_ns)
        wall_s, self._wall_s = self._wall_s, 0.0
        behind_s, self.pace.behind_s = self.pace.behind_s, 0.0
        simulated_s = (time_ns - since_ns) * 1e-9
        quality = self.station.simulation.quality
        subscriptions = self._outbox.subscriptions()
        lost = [
            name
            for name, count in subscriptions.items()
            if count < self._most_subscriptions.get(name, 0)
        ]
        for name, count in subscriptions.items():
            self._most_subscriptions[name] = max(count, self._most_subscriptions.get(name, 0))
        return [
            (
                "simulation",
                None,
                {
                    "state": self.state,
                    "time_s": time_ns * 1e-9,
                    "end_s": self.station.end_s,
                    "real_time_factor": round(simulated_s / (now - wall), 3),
                    "wall_per_simulated": round(wall_s / simulated_s, 4) if simulated_s else 0.0,
                    "late_s": round(self.pace.late_s, 3),
                    "behind_s": round(behind_s, 4),
                    "lost_contacts": quality.lost_contacts,
                    "equilibrium_residual": f"{quality.equilibrium_residual:.3g}",
                },
            ),
            (
                "sensors",
                "samples clipped" if self.station.sensors.clipped else None,
                {
                    "clipped": self.station.sensors.clipped,
                    "dropped": self.station.sensors.dropped,
                },
            ),
            (
                "publishing",
                f"subscriptions lost on {', '.join(lost)}" if lost else None,
                {
                    "pending": self._outbox.pending,
                    "refusals": self._outbox.refusals,
                    **{f"published {name}": n for name, n in self._outbox.published.items()},
                    **{f"subscriptions {name}": subscriptions[name] for name in self._waveforms},
                },
            ),
        ]

    @property
    def time_ns(self) -> int:
        """Simulated time reached (ns)."""
        return self.station.time_ns

    def close(self) -> bool:
        """Free the topics; False if a reader has not taken everything in reasonable time."""
        patience = DELIVERY_S if self.finished else HURRY_S
        complete = self._outbox.flush() and self._outbox.acknowledged(patience)
        self._clock.close()
        self._outbox.close()
        return complete
