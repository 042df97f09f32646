"""How a node becomes a process: start, loop, signals, orderly end. The only ``main`` of the nodes.

rclpy's own signal handlers shut the context down at once, so that last messages are lost; here a
signal only asks the loop to end.
"""

from __future__ import annotations

import functools
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import FrameType
from typing import Any, NoReturn, Protocol, TypeVar

import rclpy
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import ParameterUninitializedException
from rclpy.executors import SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import Trigger

from solver import InputError, SolverError

RCLError = rclpy_implementation.RCLError

IDLE_S = 0.05
"""Longest wait of the loop (s): a signal is noticed after at most this time."""


class Stop:
    """Set by SIGINT and SIGTERM; true once the process shall end."""

    def __init__(self) -> None:
        self._signal: int | None = None
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)

    def _on_signal(self, number: int, _frame: FrameType | None) -> None:
        self._signal = number

    def __bool__(self) -> bool:
        """True once the process shall end."""
        return self._signal is not None


class Interrupted(Exception):
    """A signal came before a long task was finished."""


T = TypeVar("T")


def in_background(task: Callable[[], T], stop: Stop) -> T:
    """Result of a long task that may be left behind, unfinished, when a signal comes.

    Raises:
        Interrupted: the signal came first.
    """
    results: list[T] = []
    failures: list[BaseException] = []

    def target() -> None:
        try:
            results.append(task())
        except BaseException as failure:
            failures.append(failure)

    thread = threading.Thread(target=target, daemon=True, name="background")
    thread.start()
    while thread.is_alive():
        thread.join(IDLE_S)
        if stop:
            raise Interrupted
    if failures:
        raise failures[0]
    return results[0]


class Worker(Protocol):
    """What a node gives to the loop."""

    def work(self) -> float:
        """Do a bounded piece of work; return how long to wait for callbacks before the next (s)."""

    @property
    def done(self) -> bool:
        """True when the process shall end by itself."""

    @property
    def failure(self) -> str | None:
        """Why the node gave up, None while all is well."""


@dataclass(frozen=True)
class Setting:
    """A ROS parameter: default (or type of an array, empty), meaning with unit, range."""

    name: str
    default: bool | int | float | str | Parameter.Type
    description: str
    low: float | None = None
    high: float | None = None
    read_only: bool = False
    fixed: bool = False


def prepare(node: LifecycleNode, settings: Sequence[Setting]) -> None:
    """Make the node answer ``ros2 param`` and ``ros2 lifecycle`` as one of rclcpp does.

    Parameters are declared so that their description tells all and wrong values are refused; a
    transition that the present state does not have is refused instead of ending the process.
    """
    for setting in settings:
        note = "; change it in state unconfigured" if setting.fixed else ""
        descriptor = ParameterDescriptor(
            description=setting.description + note, read_only=setting.read_only
        )
        if setting.low is not None and setting.high is not None:
            if isinstance(setting.default, int):
                descriptor.integer_range = [
                    IntegerRange(from_value=int(setting.low), to_value=int(setting.high), step=0)
                ]
            else:
                descriptor.floating_point_range = [
                    FloatingPointRange(from_value=setting.low, to_value=setting.high, step=0.0)
                ]
        node.declare_parameter(setting.name, setting.default, descriptor)
        if value(node, setting.name) is None:  # one unset would hide all from ros2 param dump
            node.set_parameters([Parameter(setting.name, setting.default, [])])
    fixed = {setting.name for setting in settings if setting.fixed}

    def check(parameters: list[Parameter]) -> SetParametersResult:
        state = node._state_machine.current_state[1]
        for parameter in parameters:
            if parameter.name in fixed and state != "unconfigured":
                return SetParametersResult(
                    successful=False,
                    reason=f"{parameter.name} can be changed in state unconfigured only; the node "
                    f"is {state}: clean it up first",
                )
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(check)
    change = node._service_change_state.callback

    def answer(request: Any, response: Any) -> Any:
        try:
            return change(request, response)
        except RCLError:
            response.success = False
            return response

    node._service_change_state.callback = answer


def value(node: Node, name: str) -> Any:
    """Value of a declared parameter."""
    try:
        return node.get_parameter(name).value
    except ParameterUninitializedException:
        return None


def offer(node: Node, *commands: Callable[[], str]) -> None:
    """A service ``~/<name>`` (std_srvs/Trigger) for each method: answers what it says, or why not.

    The name is the method's without the underscore in front.
    """

    def service(command: Callable[[], str]) -> Callable[[Any, Any], Any]:
        def answer(_request: Any, response: Any) -> Any:
            try:
                response.message, response.success = command(), True
            except (InputError, SolverError) as failure:
                response.message = str(failure)
            except Interrupted:
                response.message = "the process is ending"
            return response

        return answer

    for command in commands:
        node.create_service(Trigger, f"~/{command.__name__.lstrip('_')}", service(command))


Transition = Callable[[Any, LifecycleState], TransitionCallbackReturn]


def transition(callback: Transition) -> Transition:
    """A lifecycle callback that fails when it raises for a user's mistake, and says why.

    Unforeseen errors are told too; rclpy alone swallows them.
    """

    @functools.wraps(callback)
    def told(node: Any, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            return callback(node, state)
        except Interrupted:
            return TransitionCallbackReturn.FAILURE
        except (InputError, SolverError, OSError) as failure:
            node.failure = str(failure)
            node.get_logger().error(node.failure)
            return TransitionCallbackReturn.FAILURE
        except Exception as error:
            node.failure = f"{callback.__name__}: {error!r}"
            node.get_logger().error(traceback.format_exc())
            node.get_logger().error(node.failure)
            return TransitionCallbackReturn.ERROR

    return told


def run(create: Callable[[Stop], Any], arguments: Sequence[str] | None = None) -> int:
    """Run a node until a signal or until it is done; returns the exit status.

    With its parameter ``autostart`` the node is configured and activated at once; otherwise that is
    left to ``ros2 lifecycle`` or a launch file.
    """
    stop = Stop()
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except RCLError as error:
        print(f"--ros-args: {error}", file=sys.stderr)
        return 2
    node = create(stop)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    try:
        if value(node, "autostart"):
            for trigger in (node.trigger_configure, node.trigger_activate):
                if stop:
                    return 0
                if trigger() != TransitionCallbackReturn.SUCCESS:
                    return 0 if stop else 2
        while not stop and not node.done:
            wait = node.work()
            executor.spin_once(timeout_sec=min(wait, IDLE_S))
    finally:
        _finish(node)
        executor.remove_node(node)
        executor.shutdown()
        node.destroy_node()
        rclpy.try_shutdown()
    return 2 if node.failure else 0


def _finish(node: LifecycleNode) -> None:
    state = node._state_machine.current_state[1]
    if state == "active":
        node.trigger_deactivate()
        state = node._state_machine.current_state[1]
    if state != "finalized":
        node.trigger_shutdown()


def main(create: Callable[[Stop], Any], arguments: Sequence[str] | None = None) -> NoReturn:
    """Run a node (see :func:`run`) and end the process; ``arguments`` default to its own."""
    status = run(create, sys.argv if arguments is None else arguments)
    if any(thread.name == "background" for thread in threading.enumerate()):
        # a task left behind cannot be cancelled, and waiting for it would not end in time
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    sys.exit(status)
