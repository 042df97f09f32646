"""What an event that has ended tells: its trains, the state of the sensors, where these are."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from . import report
from .bowl import SHAPE_SIGMA
from .calibration import Calibration
from .catalogue import Catalogue
from .events import Channel, Estimate, TrainEvent, Value
from .head import HeadMatcher
from .health import HealthBook, clipped
from .live import Partial, arrived, departed, travelling
from .passage import Passage
from .passage_search import bowl_of, find_passages
from .record import Record
from .response import find_response
from .strength import CARRIED, CORE, excited, strong_interval

Array = NDArray[np.float64]

_ENOUGH = 0.5  # of what trains differ by, at which one more teaches little
_AT_ONCE_S = 0.3  # a record that is quiet for longer starts before the train
_APART = 3.0  # standard uncertainties, beyond which two speeds are not the same
_AHEAD = 1.0  # m before a first wheelset that is on record


@dataclass(frozen=True)
class Ended:
    """An event that has ended.

    Attributes:
        records: all channels, with times after ``origin_ns``.
        origin_ns: some time before the onset.
        within: onset and last activity (s after ``origin_ns``), with margins.
        now_ns: end of the records.
        last_ns: last activity.
        found: its trains, if they are known already.
        cut: whether the record ends before it is clear that nothing more comes.
        begun: the rail channels from the start of the stream on, and that start (ns), if a train
            was near then; else ``None``.
    """

    records: list[Record]
    origin_ns: int
    within: tuple[float, float]
    now_ns: int
    last_ns: int
    found: list[Passage] | None = None
    cut: bool = False
    begun: tuple[list[Record], int] | None = None


class Closing:
    """Finds the trains of ended events, and learns from them.

    Args:
        channels: all channels of the detector.
        catalogue: train types.
        limits: lowest and highest speed (m/s).
        calibration: what earlier passages have taught.

    Attributes:
        calibration: with what the events so far have taught.
        health: states of the sensors.
    """

    def __init__(
        self,
        channels: Sequence[Channel],
        catalogue: Catalogue,
        limits: tuple[float, float],
        calibration: Calibration,
    ) -> None:
        self.calibration = calibration
        self.health = HealthBook(channels)
        self._catalogue = catalogue
        self._limits = limits
        self._lessons: deque[tuple[Record, Passage]] = deque()

    def study(self, lessons: int | None = None) -> None:
        """Learn what trains have shown of their deflection, and what events need not wait for.

        Args:
            lessons: channels of a passage, the oldest first; all by default.
        """
        for _ in range(len(self._lessons) if lessons is None else lessons):
            if not self._lessons:
                return
            self._learn_bowl(*self._lessons.popleft())

    def search(
        self, records: Sequence[Record], within: tuple[float, float], unlisted: bool = True
    ) -> list[Passage]:
        """Every train that the rail channels show in an interval (s), quicker without those that no
        type explains."""
        self.study()
        return find_passages(
            records, within, self._catalogue, self._limits, self.calibration, unlisted
        )

    def conclude(self, ended: Ended) -> list[TrainEvent]:
        """The events at the end of an event; what its trains teach is kept, or to be studied."""
        records, within = ended.records, ended.within
        found = self.search(records, within) if ended.found is None else ended.found
        # part of another train has the pattern of a type at channels that contradict each other
        found = [p for p in found if not (p.clock_offset and report.cut_off(records, p))]
        if ended.begun is not None:
            rails, start_ns = ended.begun
            whole = _whole(found, (start_ns - ended.origin_ns) * 1e-9, within)
            if not (whole and found[0].known):
                part = self._truncated(rails, start_ns, ended, whole)
                if part is not None:
                    return part
        elif ended.cut and len(found) <= 1:
            rails = [r for r in records if r.channel.layer == "rail"]
            stop = (ended.now_ns - ended.origin_ns) * 1e-9
            head = arrived(rails, (within[0], stop), self._limits, self._heads, self.calibration)
            # on one channel a beginning looks like that of other types at other speeds
            if head is not None and head.direction and not _passed(found, within, head):
                return report.truncated(self._catalogue, head, ended.origin_ns, ended.now_ns)
            goes_on = _known(found) and _goes_on(found[-1], within)
            if goes_on or not any(passage.confirmed for passage in found):
                seen = travelling(rails, (within[0], stop), self._limits, self.calibration)
                if seen is not None:
                    return report.truncated(self._catalogue, seen, ended.origin_ns, ended.now_ns)
            if goes_on:
                return report.unclear(rails, ended.last_ns, ("truncated_end",))
        if not any(r.channel.layer == "rail" and excited(r, within) for r in records):
            away = [r for r in records if r.channel.layer != "rail" and excited(r, within)]
            # strong first cars end an event on a bridge early; what rings on does no harm
            span = (within[0], (ended.now_ns - ended.origin_ns) * 1e-9)
            train = find_response(away, span, self._catalogue.types, self._limits)
            if train is not None and train.confirmed:
                return report.response(self._catalogue, records, ended.origin_ns, train)
        swapped: list[str] = []
        if records and not any(passage.confirmed for passage in found):
            found, swapped = self._try_swapped(records, within, found)
        for passage in found:
            if passage.confirmed and passage.known and passage.measured is not None and not swapped:
                self.calibration = self.calibration.learned(passage.measured)
            if passage.confirmed and passage.known and not swapped and not passage.clock_offset:
                names = {trace.name for trace in passage.traces}
                self._lessons.extend((r, passage) for r in records if r.channel.name in names)
        events = self._passage_health(ended.now_ns, records, within, found, swapped)
        return events + report.closing(self._catalogue, records, ended.origin_ns, within, found)

    def _learn_bowl(self, record: Record, passage: Passage) -> None:
        """How long the deflection is, at a channel where that is not known well enough yet."""
        name = record.channel.name
        if self.calibration.wavenumber(name)[1] < _ENOUGH * SHAPE_SIGMA:
            return
        shown = bowl_of(record, passage)
        if shown is not None:
            best = passage.hypotheses[0]
            speed = float(best.fit.motion.speed_at(best.mid_time))
            self.calibration = self.calibration.learned_bowl(name, shown.value / speed, shown.sigma)

    @cached_property
    def _heads(self) -> HeadMatcher:
        return HeadMatcher(self._catalogue.types, self._limits)

    @cached_property
    def _mirrored(self) -> HeadMatcher:
        return HeadMatcher(self._catalogue.types, self._limits, mirrored=True)

    def _truncated(
        self, rails: list[Record], start_ns: int, ended: Ended, whole: bool
    ) -> list[TrainEvent] | None:
        """Events of a train whose beginning is not on record; ``None`` if that is not so.

        Args:
            rails: records of the rail channels.
            start_ns: begin of the record.
            ended: the event.
            whole: whether the pattern of a train that is on record as a whole was found.
        """
        last_ns, end = ended.last_ns, (ended.now_ns - start_ns) * 1e-9
        within = (0.0, (last_ns - start_ns) * 1e-9 + 0.3)
        found, late = departed(rails, within, self._limits, self._mirrored, self.calibration)
        if (found is None or found.direction == 0) and not whole:
            found = travelling(rails, within, self._limits, self.calibration) or found
        if found is not None and found.end is None:
            return report.truncated(self._catalogue, found, start_ns, last_ns)
        if found is not None and found.end is not None:
            quiet_s = end - found.end[0]
            if (
                ended.cut
                and found.direction == 0
                and quiet_s < self._catalogue.longest_gap / found.speed
            ):
                # neither end may be on record, and no second channel confirms the speed
                return report.unclear(rails, last_ns, ("truncated_start", "truncated_end"))
            return report.truncated(self._catalogue, found, start_ns, last_ns)
        if late > _AT_ONCE_S or whole:
            return None
        return report.unclear(rails, last_ns, ("truncated_start",))

    def _try_swapped(
        self, records: list[Record], within: tuple[float, float], found: list[Passage]
    ) -> tuple[list[Passage], list[str]]:
        """Rail channels that show no wheelsets while others do: their cables are exchanged."""
        if not any(r.channel.layer == "rail" for r in records):
            return found, []
        others = [
            replace(r, channel=replace(r.channel, layer="rail"))
            for r in records
            if r.channel.layer != "rail"
        ]
        instead = self.search(others, within) if others else []
        sure = [p for p in instead if p.known]
        return (sure, [trace.name for trace in sure[0].traces]) if sure else (found, [])

    def _passage_health(
        self,
        now_ns: int,
        records: list[Record],
        within: tuple[float, float],
        found: list[Passage],
        swapped: list[str],
    ) -> list[TrainEvent]:
        events: list[TrainEvent] = []
        trains = [passage for passage in found if passage.confirmed]
        if not trains:
            return events
        used = {trace.name for trace in trains[0].traces}
        offsets = {name: (o, sigma) for name, o, sigma in trains[0].clock_offset}
        moved = {name: (o, sigma) for name, o, sigma in trains[0].moved}
        tell = self.health.tell
        for record in records:
            name = record.channel.name
            inside = (record.window.time >= within[0]) & (record.window.time <= within[1])
            if not inside.any():
                continue
            events += tell(now_ns, name, "clipped", clipped(record.window, inside), {})
            events += tell(now_ns, name, "swapped", name in swapped, {})
            if record.channel.layer != "rail" or name in swapped:
                continue
            quiet = name not in used and not excited(record, within)
            events += tell(now_ns, name, "insensitive", quiet and not swapped, {})
            values: dict[str, Value] = {}
            if name in offsets:
                values["clock_offset"] = Estimate(*offsets[name], "s")
            events += tell(now_ns, name, "unsynchronised", name in offsets, values)
            place: dict[str, Value] = {}
            if name in moved:
                place["position_offset"] = Estimate(*moved[name], "m")
            events += tell(now_ns, name, "moved", name in moved, place)
        return events


def _known(found: Sequence[Passage]) -> bool:
    """Whether the last of the trains is of a known type."""
    return bool(found) and found[-1].known


def _beside(train: Passage, within: tuple[float, float]) -> tuple[float, float]:
    """For how long strong energy goes on before and behind a train of a known type (m)."""
    best, motion = train.hypotheses[0], train.hypotheses[0].fit.motion
    core = strong_interval(train.traces[0], train.band[1] - train.band[0], within, CORE)
    start, end = motion.distance_at(np.array(core or train.interval)) - best.places[[0, -1]]
    return max(0.0, -float(start)), max(0.0, float(end))


def _whole(found: Sequence[Passage], start: float, within: tuple[float, float]) -> bool:
    """Whether the first of the trains is on record, from ``start`` (s), with its first wheelset.

    If the record begins as strong as its wheelsets, farther before the first of them than the rail
    carries that, there are more.
    """
    if not found or not found[0].confirmed or not found[0].hypotheses:
        return False
    motion = found[0].hypotheses[0].fit.motion
    if found[0].known:
        ahead = _beside(found[0], within)[0]
        if -float(motion.distance_at(start)) - CARRIED < ahead > CARRIED:
            return False
    return float(motion.time_at(-_AHEAD)) > start


def _goes_on(train: Passage, within: tuple[float, float]) -> bool:
    """Whether a train of a known type is the beginning of a longer one.

    What the rail carries is heard before the first wheelset as after the last: what is strong for
    longer after it, and for more than the longest gap of the train, is more of it.
    """
    ahead, behind = _beside(train, within)
    return behind - ahead > float(np.max(np.diff(train.hypotheses[0].places)))


def _passed(found: Sequence[Passage], within: tuple[float, float], head: Partial) -> bool:
    """Whether a train of a known type has passed, and is not the beginning of a longer one.

    A train that goes on can look like a shorter one that is faster.

    Args:
        found: trains.
        within: the event (s).
        head: what its beginning tells, whole trains among the rest.
    """
    if not _known(found) or _goes_on(found[-1], within):
        return False
    best, motion = found[-1].hypotheses[0], found[-1].hypotheses[0].fit.motion
    sigma = np.hypot(head.sigma, motion.speed_sigma(best.mid_time))
    return bool(abs(head.speed - motion.speed_at(best.mid_time)) < _APART * sigma)
