"""The virtual measuring station as a lifecycle node: publishes, owns ``/clock``, takes commands."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from solver import InputError, Scenario, SolverError, load_scenario
from trackvib_ros import messages as m
from trackvib_ros.process import (
    Interrupted,
    Stop,
    in_background,
    prepare,
    transition,
    value,
)
from trackvib_ros.run import Component, Run
from trackvib_ros.settings import SENSOR_SETTINGS
from trackvib_ros.station import Station, reseeded


class SensorNode(LifecycleNode):  # type: ignore[misc]
    """Configure assembles the scenario, activate runs it, deactivate pauses, cleanup frees."""

    def __init__(self, stop: Stop, **arguments: Any) -> None:
        super().__init__("sensor", **arguments)
        self.failure: str | None = None
        self._stop = stop
        self.run: Run | None = None
        self._active = False
        self._resets = 0
        prepare(self, SENSOR_SETTINGS)
        self.add_post_set_parameters_callback(self._on_parameters)
        self._diagnostics = self.create_publisher(
            m.DIAGNOSTICS.type, m.DIAGNOSTICS.name, m.DIAGNOSTICS.qos
        )
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(1.0, self._report, clock=steady)
        self.create_timer(0.1, self._show, clock=steady)
        for name, command in (
            ("trigger_passage", self._trigger_passage),
            ("pause", self._pause),
            ("resume", self._resume),
            ("step", self._step),
            ("reset", self._reset),
        ):
            self.create_service(Trigger, f"~/{name}", self._answer(command))

    @transition
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load the scenario, assemble the model, create the topics."""
        self.failure = None
        try:
            scenario = load_scenario(value(self, "scenario"))
            if value(self, "seed") >= 0:
                scenario = reseeded(scenario, value(self, "seed"))
            self._assemble(scenario)
        except (InputError, SolverError) as failure:
            self._give_up(failure)
            return TransitionCallbackReturn.FAILURE
        except Interrupted:
            return TransitionCallbackReturn.FAILURE
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
        self.run = Run(self, station, value(self, "ground_truth"))
        self.run.detectors = value(self, "await_detectors")
        self.run.recorders = value(self, "await_recorders")
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
            self._give_up(failure)
            self.trigger_deactivate()
            return 0.0

    def _give_up(self, failure: Exception) -> None:
        self.failure = str(failure)
        self.get_logger().error(str(failure))

    def _on_parameters(self, parameters: list[Parameter]) -> None:
        if self.run is not None:
            self.run.pace.hold()
            self.run.pace.factor = value(self, "real_time_factor")

    def _report(self) -> None:
        if self.run is None:
            components: list[Component] = [
                ("simulation", self.failure, {"state": "not configured"})
            ]
        else:
            components = self.run.components()
        stamp = 0 if self.run is None else self.run.time_ns
        self._diagnostics.publish(m.diagnostics_message(stamp, self.get_name(), components))

    def _show(self) -> None:
        if self.run is not None and self._active:
            self.run.show()

    def _answer(self, command: Callable[[Run], str]) -> Callable[[Any, Any], Any]:
        def answer(_request: Any, response: Any) -> Any:
            try:
                if self.run is None or not self._active:
                    raise InputError("the node is not active: configure and activate it first")
                response.message, response.success = command(self.run), True
            except (InputError, SolverError) as failure:
                response.message = str(failure)
            except Interrupted:
                response.message = "the process is ending"
            return response

        return answer

    def _trigger_passage(self, run: Run) -> str:
        preset, speed = value(self, "trigger_train"), value(self, "trigger_speed")
        return f"train {run.trigger(preset or None, speed or None)} is coming"

    def _pause(self, run: Run) -> str:
        run.pause()
        return f"paused at {run.time_ns} ns"

    def _resume(self, run: Run) -> str:
        run.resume()
        return f"running from {run.time_ns} ns"

    def _step(self, run: Run) -> str:
        return f"running to {run.step(value(self, 'step_duration'))} ns"

    def _reset(self, run: Run) -> str:
        self._resets += 1
        scenario = run.station.scenario
        seed = value(self, "seed")
        seed = scenario.irregularity.seed + 1 if seed < 0 else seed
        self._assemble(reseeded(scenario, seed))
        return f"restarted at 0 s with seed {seed}"
