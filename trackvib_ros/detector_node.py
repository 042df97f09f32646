"""The train detector as a lifecycle node: waveforms in, events out, optionally all recorded."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from solver import InputError
from trackvib_ros import messages as m
from trackvib_ros.detection import Channel, TrainEvent
from trackvib_ros.listening import Listening
from trackvib_ros.outbox import Outbox
from trackvib_ros.process import Stop, prepare, transition, value
from trackvib_ros.recorder import Recorder
from trackvib_ros.settings import DETECTOR_SETTINGS


class DetectorNode(LifecycleNode):  # type: ignore[misc]
    """Configure reads the parameters, activate listens, deactivate says what is left to say."""

    def __init__(self, stop: Stop, **arguments: Any) -> None:
        super().__init__("detector", **arguments)
        self.failure: str | None = None
        self._listening: Listening | None = None
        self._channels: dict[str, list[Channel]] = {}
        self._description: Any = None
        self._recorder: Recorder | None = None
        self._outbox = Outbox(self)
        prepare(self, DETECTOR_SETTINGS)
        for topic in (m.DIAGNOSTICS, m.TRAIN_EVENTS, m.TRAIN_OCCUPIED, m.TRAIN_SPEED):
            self._outbox.open(topic)
        self.create_timer(1.0, self._report, clock=Clock(clock_type=ClockType.STEADY_TIME))

    @transition
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Read the channels, or wait for their description; create the bag."""
        names = value(self, "channel_names")
        if names:
            self._channels = m.channels_by_topic(
                names,
                value(self, "channel_positions"),
                value(self, "channel_layers"),
                value(self, "channel_topics"),
                value(self, "channel_position_sigma"),
            )
        if value(self, "record_directory"):
            directory = Path(value(self, "record_directory"))
            self._recorder = Recorder(self, directory, use_sim_time=True)
            self._recorder.start()
        return super().on_configure(state)

    @transition
    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Subscribe."""
        if self._channels:
            self._listen(self._channels)
        else:
            self._description = self.create_subscription(
                m.CHANNELS.type, m.CHANNELS.name, self._on_channels, m.CHANNELS.qos
            )
        return super().on_activate(state)

    @transition
    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop listening; a train still passing is reported as far as it was seen."""
        if self._description is not None:
            self.destroy_subscription(self._description)
            self._description = None
        self._be_quiet()
        return super().on_deactivate(state)

    @transition
    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Finish the bag."""
        if self._recorder is not None:
            self._outbox.acknowledged(1.0)
            self._recorder.close()
            if self._recorder.failure:
                self.failure = self._recorder.failure
                self.get_logger().error(self.failure)
        self._recorder = None
        self._channels = {}
        return super().on_cleanup(state)

    @transition
    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Finish everything."""
        return self.on_cleanup(state)

    @property
    def done(self) -> bool:
        """True when the process shall end: it could not start."""
        return self.failure is not None and value(self, "autostart") and self._recorder is None

    def work(self) -> float:
        """Nothing but callbacks; returns how long to wait for them (s)."""
        self._outbox.flush()
        return 1.0

    def _on_channels(self, message: DiagnosticArray) -> None:
        try:
            channels = m.read_channels(message)
            if self._listening is None or channels != self._listening.channels:
                self._be_quiet()
                self._listen(channels)
        except InputError as failure:
            self.get_logger().error(str(failure))

    def _listen(self, channels: dict[str, list[Channel]]) -> None:
        qos = m.BEST_EFFORT_STREAM if value(self, "best_effort") else m.STREAM
        kept = value(self, "calibration_file")
        file = Path(kept) if kept else None
        self._listening = Listening(self, channels, qos, self._publish, file)

    def _be_quiet(self) -> None:
        if self._listening is not None:
            self._listening.close()
        self._listening = None

    def _publish(self, events: Sequence[TrainEvent]) -> None:
        for event in events:
            for topic, message in m.event_messages(event):
                self._outbox.put(topic, message)
        self._outbox.flush()

    def _report(self) -> None:
        components = []
        if self._listening is not None:
            components.append(("input", *self._listening.state()))
        elif self._description is not None:
            components.append(("input", f"waiting for topic {m.CHANNELS.name}", {}))
        else:
            components.append(("input", None, {"state": "not active"}))
        if self._recorder is not None:
            components.append(("recorder", *self._recorder.state()))
        stamp = self.get_clock().now().nanoseconds
        self._outbox.put(m.DIAGNOSTICS, m.diagnostics_message(stamp, self.get_name(), components))
