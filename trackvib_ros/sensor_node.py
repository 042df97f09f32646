"""The virtual measuring station as a lifecycle node: publishes, owns ``/clock``, takes commands."""

from __future__ import annotations

from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter

from solver import InputError, Scenario, SolverError, load_scenario
from trackvib_ros import messages as m
from trackvib_ros.process import Stop, in_background, offer, prepare, transition, value
from trackvib_ros.run import Run, without_run
from trackvib_ros.settings import SENSOR_SETTINGS
from trackvib_ros.station import Station, next_seed, reseeded


class SensorNode(LifecycleNode):  # type: ignore[misc]
    """Configure assembles the scenario, activate runs it, deactivate pauses, cleanup frees."""

    def __init__(self, stop: Stop, **arguments: Any) -> None:
        super().__init__("sensor", **arguments)
        self.failure: str | None = None
        self._stop = stop
        self.run: Run | None = None
        self._active = False
        prepare(self, SENSOR_SETTINGS)
        self.add_post_set_parameters_callback(self._on_parameters)
        self._diagnostics = self.create_publisher(
            m.DIAGNOSTICS.type, m.DIAGNOSTICS.name, m.DIAGNOSTICS.qos
        )
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(1.0, self._report, clock=steady)
        self.create_timer(0.1, self._show, clock=steady)
        offer(self, self._trigger_passage, self._pause, self._resume, self._step, self._reset)

    @transition
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load the scenario, assemble the model, create the topics."""
        self.failure = None
        scenario = load_scenario(value(self, "scenario"))
        if value(self, "seed") >= 0:
            scenario = reseeded(scenario, value(self, "seed"))
        self._assemble(scenario)
        return super().on_configure(state)

    def _assemble(self, scenario: Scenario) -> None:
        def assemble() -> Station:
            return Station(
                scenario,
                headway=value(self, "headway_mean"),
                least_headway=value(self, "headway_least"),
                report=self.get_logger().info,
            )

        station = in_background(assemble, self._stop)
        if self.run is not None:
            self.run.close()
        self.run = Run(
            self,
            station,
            truth=value(self, "ground_truth"),
            detectors=value(self, "await_detectors"),
            recorders=value(self, "await_recorders"),
        )
        self.run.pace.factor = value(self, "real_time_factor")

    @transition
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Run."""
        self._active = True
        return super().on_activate(state)

    @transition
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Pause in simulated time."""
        self._active = False
        if self.run is not None:
            self.run.hold()
        self._report()
        return super().on_deactivate(state)

    @transition
    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Free model and topics."""
        self._active = False
        if self.run is not None and not self.run.close():
            self.get_logger().warning("a subscriber has not taken everything")
        self.run = None
        return super().on_cleanup(state)

    @transition
    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Free everything; the node is of no use afterwards."""
        return self.on_cleanup(state)

    @property
    def done(self) -> bool:
        """True when the process shall end: the run is over and that is wanted, or it failed."""
        if self.failure is not None and value(self, "autostart"):
            return True
        over = self.run is not None and self.run.finished
        return over and bool(value(self, "exit_at_end"))

    def work(self) -> float:
        """Advance the run if it is due; returns the time to wait for callbacks (s)."""
        if self.run is None or not self._active:
            return 1.0
        try:
            return self.run.advance()
        except SolverError as failure:
            self.failure = str(failure)
            self.get_logger().error(self.failure)
            self.trigger_deactivate()
            return 0.0

    def _on_parameters(self, parameters: list[Parameter]) -> None:
        if self.run is not None:
            self.run.pace.hold()
            self.run.pace.factor = value(self, "real_time_factor")

    def _report(self) -> None:
        stamp = 0 if self.run is None else self.run.time_ns
        components = without_run(self.failure) if self.run is None else self.run.components()
        self._diagnostics.publish(m.diagnostics_message(stamp, self.get_name(), components))

    def _show(self) -> None:
        if self.run is not None and self._active:
            self.run.show()

    @property
    def _running(self) -> Run:
        if self.run is None or not self._active:
            raise InputError("the node is not active: configure and activate it first")
        return self.run

    def _trigger_passage(self) -> str:
        preset, speed = value(self, "trigger_train"), value(self, "trigger_speed")
        return f"train {self._running.trigger(preset or None, speed or None)} is coming"

    def _pause(self) -> str:
        self._running.pause()
        return f"paused at {self._running.time_ns} ns"

    def _resume(self) -> str:
        self._running.resume()
        return f"running from {self._running.time_ns} ns"

    def _step(self) -> str:
        return f"running to {self._running.step(value(self, 'step_duration'))} ns"

    def _reset(self) -> str:
        scenario = self._running.station.scenario
        seed = next_seed(scenario, value(self, "seed"))
        self._assemble(reseeded(scenario, seed))
        return f"restarted at 0 s with seed {seed}"
