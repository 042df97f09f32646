"""Simulated time: the one publisher of ``/clock``, and the pace at which it runs."""

from __future__ import annotations

import time
from collections.abc import Callable

from rclpy.clock import Clock as RosClock
from rclpy.clock import ClockType
from rclpy.node import Node

from trackvib_ros.messages import CLOCK, clock_message

REPEAT_S = 0.1
"""Wall time after which the clock is repeated while simulated time stands still (s)."""

LAG_LIMIT_S = 1.0
"""A run that is further behind than this is not caught up (s)."""


class Pace:
    """When the next step of simulated time is due.

    Args:
        factor: simulated seconds per wall second; 0 is as fast as possible.
        now: monotonic wall clock (s).

    Attributes:
        late_s: wall time given up so far because the run could not keep pace (s).
        behind_s: longest time by which a step began late; whoever reads it may set it to 0 (s).
    """

    def __init__(self, factor: float, now: Callable[[], float] = time.monotonic) -> None:
        self.factor = factor
        self.late_s = 0.0
        self.behind_s = 0.0
        self._now = now
        self._origin: tuple[float, int] | None = None

    def hold(self) -> None:
        """Simulated time stands still (paused, waiting): the next step is due at once."""
        self._origin = None

    def delay(self, time_ns: int) -> float:
        """Wall time until the step that begins at ``time_ns`` is due (s), 0 if it is."""
        if self.factor <= 0:
            return 0.0
        now = self._now()
        if self._origin is None:
            self._origin = (now, time_ns)
        wall, simulated_ns = self._origin
        due = wall + (time_ns - simulated_ns) * 1e-9 / self.factor
        self.behind_s = max(self.behind_s, now - due)
        if now - due > LAG_LIMIT_S:
            self.late_s += now - due
            self._origin = (now, time_ns)
            return 0.0
        return max(0.0, due - now)


class SimulationClock:
    """Publishes simulated time: at once when it moves, and repeated while it stands still.

    Time zero is never published, as it means *no clock yet* in ROS.

    Args:
        node: publishes; must not itself use simulated time.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._publisher = node.create_publisher(CLOCK.type, CLOCK.name, CLOCK.qos)
        self._timer = node.create_timer(
            REPEAT_S, self._publish, clock=RosClock(clock_type=ClockType.STEADY_TIME)
        )
        self._time_ns = 0

    @property
    def time_ns(self) -> int:
        """Simulated time last set (ns)."""
        return self._time_ns

    def set(self, time_ns: int) -> None:
        """Move to ``time_ns``; backwards is a reset, which every subscriber notices."""
        self._time_ns = time_ns
        self._timer.reset()
        self._publish()

    def close(self) -> None:
        """Stop publishing."""
        self._node.destroy_timer(self._timer)
        self._node.destroy_publisher(self._publisher)

    def _publish(self) -> None:
        if self._time_ns > 0:
            self._publisher.publish(clock_message(self._time_ns))
