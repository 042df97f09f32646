"""What comes in is checked, counted and put in order before the detector sees it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from solver import InputError
from trackvib_ros.detection import Calibration, Channel, TrainDetector, TrainEvent
from trackvib_ros.messages import read_waveform
from trackvib_ros.waveform import Waveform

RESTART_BLOCKS = 3
"""So many blocks in sequence, all off the time so far, mean that the source has started anew."""

JUMP_NS = 60_000_000_000
"""A longer step of the stamps is no gap: a damaged stamp, or the source has started anew (ns)."""

JOIN_NS = 1_000_000_000
"""After a restart, other topics this close in time belong to the same run (ns)."""

LARGEST = 1e6
"""Magnitude from which a sample is no acceleration of a track but damage (m/s²)."""


class _Source:
    """One topic: where its time stands, and odd blocks that may turn out to be a restart."""

    def __init__(self, channels: Sequence[Channel]) -> None:
        self.names = {channel.name for channel in channels}
        self.frame: str | None = None
        self.next_ns: int | None = None
        self.run = 0
        self.held: list[Waveform] = []


class Intake:
    """Feeds a detector from waveform messages of several topics, whatever they contain.

    A gap is passed on (the detector counts it as dropped samples); a block of another time is
    dropped, unless it begins a restart: then the detector finishes and forgets.

    Args:
        channels: the accelerometers by topic.
        calibration: file that keeps what passages teach of the site, read at the start if it is
            there; none by default.

    Attributes:
        not_kept: why the file could not be written, if so.
        blocks: blocks accepted, by topic.
        refused: blocks refused, by ``topic: reason``.
        last_refusal: the whole sentence of the last refusal.
        gaps: gaps in the stamps, by topic.
        missing_ns: simulated time missing in those gaps, by topic (ns).
        restarts: times that the sources started anew.

    Raises:
        InputError: the file is no calibration of these channels, or cannot be.
    """

    def __init__(self, channels: dict[str, list[Channel]], calibration: Path | None = None) -> None:
        self._file = calibration
        self._kept = None if calibration is None else _read(calibration)
        group = [c for group in channels.values() for c in group]
        self.detector = TrainDetector(group, calibration=self._kept)
        self.not_kept = ""
        self.blocks: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        self.last_refusal = ""
        self.gaps: Counter[str] = Counter()
        self.missing_ns: Counter[str] = Counter()
        self.restarts = 0
        self._now_ns = 0
        self._sources = {topic: _Source(group) for topic, group in channels.items()}

    def take(self, topic: str, message: Any) -> list[TrainEvent]:
        """Events that the next message of a topic completes; never raises for what it contains."""
        source = self._sources[topic]
        try:
            block = _cleaned(read_waveform(message))
            if set(block.channels) - source.names or not block.channels:
                raise _Refusal(
                    "unknown channels", f"channels {block.channels}, not {sorted(source.names)}"
                )
            if source.frame is not None and block.frame_id != source.frame:
                raise _Refusal("wrong frame", f'frame "{block.frame_id}", not "{source.frame}"')
            return self._accept(topic, source, block)
        except _Refusal as refusal:
            self._refuse(topic, refusal.kind, str(refusal))
        except (InputError, ValueError, TypeError, OverflowError) as error:
            self._refuse(topic, "malformed", str(error))
        return []

    def finish(self) -> list[TrainEvent]:
        """End of the stream: what the detector still has to say; it forgets everything."""
        events = self._end()
        for source in self._sources.values():
            source.next_ns = None
        return events

    def state(self, silent: Sequence[str]) -> tuple[str | None, dict[str, object]]:
        """Warning, if any, and figures for diagnostics; ``silent`` topics have no publisher."""
        refused = sum(self.refused.values())
        warnings = [f"no publisher on {', '.join(silent)}"] if silent else []
        if refused:
            warnings.append(f"{refused} blocks refused, the last: {self.last_refusal}")
        if self.not_kept:
            warnings.append(self.not_kept)
        if self.gaps:
            warnings.append(f"{sum(self.missing_ns.values()) * 1e-9:.3f} s missing in gaps")
        figures: dict[str, object] = {"restarts": self.restarts, "refused": refused}
        figures |= {f"blocks {topic}": n for topic, n in self.blocks.items()}
        figures |= {f"refused {reason}": n for reason, n in self.refused.items()}
        figures |= {f"gaps {topic}": n for topic, n in self.gaps.items()}
        return "; ".join(warnings) or None, figures

    def _end(self) -> list[TrainEvent]:
        """What the detector still has to say; then it forgets all but what is kept in the file."""
        events = self.detector.finish()
        self._keep()
        if self._file is None:
            self.detector.reset()
        else:
            self.detector = TrainDetector(
                self.detector.channels, calibration=self.detector.calibration
            )
        return events

    def _keep(self) -> None:
        learned = self.detector.calibration
        if self._file is None or learned is self._kept:
            return
        self._kept, self.not_kept = learned, ""
        try:
            learned.save(self._file)
        except InputError as failure:
            self.not_kept = str(failure)

    def _accept(self, topic: str, source: _Source, block: Waveform) -> list[TrainEvent]:
        odd = _oddity(source.next_ns, block)
        if odd is None:
            self._give_up_held(topic, source)
            return self._process(topic, source, block)
        if source.held and abs(block.stamp_ns - source.held[-1].end_ns) > block.dt_ns:
            self._give_up_held(topic, source)
        source.held.append(block)
        if len(source.held) < RESTART_BLOCKS:
            return []
        held, source.held, source.next_ns = source.held, [], None
        source.run += 1
        events: list[TrainEvent] = []
        if source.run > self.restarts:
            self.restarts = source.run
            events += self._end()
        source.run = self.restarts
        for block in held:
            events += self._process(topic, source, block)
        return events

    def _give_up_held(self, topic: str, source: _Source) -> None:
        for block in source.held:
            odd = _oddity(source.next_ns, block) or "in the past"
            self._refuse(topic, odd, f"stamp {block.stamp_ns} ns is {odd}")
        source.held = []

    def _process(self, topic: str, source: _Source, block: Waveform) -> list[TrainEvent]:
        if source.run < self.restarts and source.next_ns is not None:
            if abs(block.stamp_ns - self._now_ns) > JOIN_NS:
                source.next_ns = block.end_ns
                self._refuse(topic, "of an earlier run", f"stamp {block.stamp_ns} ns is stale")
                return []
            source.run = self.restarts
        if source.next_ns is not None and block.stamp_ns > source.next_ns + block.dt_ns // 2:
            self.gaps[topic] += 1
            self.missing_ns[topic] += block.stamp_ns - source.next_ns
        events = self.detector.process(block)
        self._keep()
        source.next_ns, source.frame = block.end_ns, block.frame_id
        source.run, self._now_ns = self.restarts, block.end_ns
        self.blocks[topic] += 1
        return events

    def _refuse(self, topic: str, kind: str, reason: str) -> None:
        self.refused[f"{topic}: {kind}"] += 1
        self.last_refusal = f"{topic}: {reason}"


def _read(file: Path) -> Calibration | None:
    if file.exists():
        return Calibration.load(file)
    if not file.parent.is_dir():
        raise InputError(f"calibration_file = {file}: there is no directory {file.parent}; make it")
    return None


class _Refusal(Exception):
    def __init__(self, kind: str, reason: str) -> None:
        super().__init__(reason)
        self.kind = kind


def _oddity(next_ns: int | None, block: Waveform) -> str | None:
    """What is wrong with the time of a block after samples up to ``next_ns``; None if nothing."""
    if next_ns is None or 0 < block.end_ns - next_ns <= JUMP_NS:
        return None
    return "in the past" if block.end_ns <= next_ns else "far in the future"


def _cleaned(block: Waveform) -> Waveform:
    """Infinite and absurd samples become dropped ones."""
    bad = ~(np.abs(block.data) <= LARGEST)
    if not bad.any():
        return block
    data = np.where(bad, np.float32(np.nan), block.data)
    return Waveform(block.stamp_ns, block.dt_ns, block.channels, data, block.frame_id)
