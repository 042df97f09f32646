"""The process of ``trackvib record``."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import rclpy
from rclpy.signals import SignalHandlerOptions

from trackvib_ros.process import Stop
from trackvib_ros.recorder import Recorder

_POLL_S = 0.005
_SHOW_S = 0.5


@dataclass(frozen=True, slots=True)
class RecordOptions:
    """What ``trackvib record`` was asked for; see :class:`Recorder`."""

    directory: Path
    topics: Sequence[str] | None = None
    exclude: Collection[str] = ()
    custom_data: Mapping[str, str] = field(default_factory=dict)
    split_bytes: int | None = None
    split_ns: int | None = None
    queue_bytes: int = 64 << 20
    use_sim_time: bool = False
    duration_s: float | None = None


def record(options: RecordOptions, show: Callable[[Recorder], None]) -> Recorder:
    """Record until a signal, the given duration or a failure; returns the closed recorder.

    Args:
        options: what to record.
        show: called now and then with the recorder.

    Raises:
        InputError: the directory exists or an option is out of range.
        OSError: the directory cannot be created.
    """
    stop = Stop()
    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("trackvib_recorder", start_parameter_services=False)
    try:
        recorder = Recorder(
            node,
            options.directory,
            topics=options.topics,
            exclude=options.exclude,
            custom_data=options.custom_data,
            split_bytes=options.split_bytes,
            split_ns=options.split_ns,
            queue_bytes=options.queue_bytes,
            use_sim_time=options.use_sim_time,
        )
        try:
            end = time.monotonic() + (options.duration_s or float("inf"))
            next_show = 0.0
            while not stop and recorder.failure is None and time.monotonic() < end:
                recorder.poll()
                if time.monotonic() >= next_show:
                    next_show = time.monotonic() + _SHOW_S
                    show(recorder)
                time.sleep(_POLL_S)
        finally:
            recorder.close()
        if recorder.failure is not None:
            node.get_logger().error(recorder.failure)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return recorder
