"""The train detector: blocks of samples in, events out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from heapq import heappop, heappush

import numpy as np
from numpy.typing import NDArray

from solver import InputError
from trackvib_ros.waveform import Waveform

from . import report
from .calibration import Calibration
from .catalogue import Catalogue
from .closing import Closing, Ended
from .events import (
    POSITION_SIGMA,
    Channel,
    Estimate,
    TrainEvent,
    Value,
    check_position_sigma,
)
from .group import LEAST_BINS, Group
from .head import HeadMatcher
from .kinematics import Motion
from .live import Partial, provisional
from .occupancy import Occupancy
from .onset import GAINS
from .passage import Passage
from .record import Record

Array = NDArray[np.float64]

_HOLE_NS = 30_000_000  # a short hole is closed by samples at most this far ahead
_CHUNK_NS = 1_000_000_000
_BEFORE_NS = 2_500_000_000  # pre-trigger part of an event window
_REARM_NS = 2_000_000_000  # a bridge rings down through its threshold several times
_RISE = 10.0  # a train on rails that still ring
_LULL_NS = 250_000_000  # least quiet time after which a train may be past
_LULL_FACTOR = 1.3  # over its longest lull so far
_LULL_MARGIN = 1.15  # over the longest gap of wheelsets in the catalogue
_CHANGE = 0.02  # of the speed between the first wheelsets and the middle of a train
_UPDATE_NS = 200_000_000
_UPDATE_GROWTH = 0.25  # of the time passed, between trials
_UPDATE_AFTER = (8.0, 45.0)  # m of the train: its first bogies, its first eight wheelsets
_UPDATE_WHEELSETS = (4, 12)  # by pattern, on one channel
_UPDATE_WITHIN = 100.0  # m at the lowest speed: what is not clear by then is no train
_BEGUN = 1.6  # energy of the first half second over the quietest: a train was near, 2 dB
_CLEAR = 0.8  # correlation of a whole train; the first half of one is like a short type by 0.65


@dataclass(frozen=True)
class DetectorConfig:
    """Settings of the detector.

    Attributes:
        min_speed: lowest speed looked for (m/s).
        max_speed: highest speed looked for (m/s).
        hang: quiet time that ends an event at the latest (s); longer than the time between two
            bogies of a car at ``min_speed``. A train whose bogies follow faster ends sooner.
        max_event: an event longer than this is a changed noise level, not a train (s).
        max_lag: a group this far behind the others is taken for silent, and not waited for (s).
            What it sends nevertheless is told as ``late``, and used where nothing is told yet.
        position_sigma: standard uncertainty (m) of the positions of channels that come without
            one (:attr:`Channel.position_sigma`).
    """

    min_speed: float = 10.0
    max_speed: float = 115.0
    hang: float = 1.8
    max_event: float = 90.0
    max_lag: float = 3.0
    position_sigma: float = POSITION_SIGMA

    def __post_init__(self) -> None:
        """Check the settings."""
        if not 1 <= self.min_speed < self.max_speed <= 200:
            raise InputError(
                f"min_speed = {self.min_speed} m/s and max_speed = {self.max_speed} m/s must obey "
                "1 <= min_speed < max_speed <= 200"
            )
        for name, low, high in (("hang", 0.3, 10), ("max_event", 10, 600), ("max_lag", 0.1, 10)):
            value = getattr(self, name)
            if not low <= value <= high:
                raise InputError(f"{name} = {value} s must lie from {low} to {high} s")
        check_position_sigma(self.position_sigma)


@dataclass
class _Past:
    """Trains of known types that have passed every rail channel, or will have soon.

    Attributes:
        found: the trains.
        last_ns: end of what they explain.
        clear_ns: by channel, when no further wheelset of theirs can come.
        next_ns: by channel, when something came after that.
    """

    found: list[Passage]
    last_ns: int
    clear_ns: dict[int, int]
    next_ns: dict[int, int]


@dataclass
class _Event(Occupancy):
    """An event, with what was told and tried since its onset."""

    next_update_ns: int = 0
    updates: int = 0
    trial_ns: int = 0
    tried: dict[int, tuple[int, int | None]] | None = None
    speed: tuple[float, float] | None = None
    """By the delay between two channels (m/s), sigma: owes nothing to a pattern."""
    past: _Past | None = None
    after: dict[int, int] = field(default_factory=dict)
    """By channel, when an earlier train had passed it (ns)."""


class TrainDetector:
    """Detects trains in a stream of waveform blocks.

    Memory is bounded by the longest event (:attr:`DetectorConfig.max_event`); the final events of a
    train come ``hang`` seconds after its last wheelset at the latest, those of a known type once no
    wheelset of any type can follow.

    Args:
        channels: accelerometers, with positions.
        catalogue: train types; the shipped one by default.
        config: settings.
        calibration: what earlier passages have taught, :attr:`calibration` of another detector.

    Raises:
        InputError: no channel, a name twice, or a calibration of other channels.
    """

    def __init__(
        self,
        channels: Sequence[Channel],
        catalogue: Catalogue | None = None,
        config: DetectorConfig | None = None,
        calibration: Calibration | None = None,
    ) -> None:
        self.channels = tuple(channels)
        self.catalogue = catalogue or Catalogue.default()
        self.config = config or DetectorConfig()
        names = [channel.name for channel in self.channels]
        if not names:
            raise InputError("the detector has no channel; give at least one Channel")
        if len(set(names)) != len(names):
            raise InputError(f"channel names must differ, not {', '.join(names)}")
        if calibration is not None:
            calibration.check(self.channels)
        self._given = calibration or Calibration.untaught(self.channels, self.config.position_sigma)
        self._index = {name: i for i, name in enumerate(names)}
        self._limits = (self.config.min_speed, self.config.max_speed)
        self.reset()

    def reset(self) -> None:
        """Forget everything since the start, noise floors included: the clock jumped back."""
        self._closing = Closing(self.channels, self.catalogue, self._limits, self._given)
        self._groups: dict[tuple[str, ...], Group] = {}
        self._start_ns: int | None = None
        self._newest_ns = -(2**62)
        self._done_ns = 0
        self._event: _Event | None = None
        self._beginning = True
        self._replay = False
        self._inside = False
        self._replayed_ns = -(2**62)
        self._lowest = np.full(len(self.channels), np.inf)
        self._active_ns = np.full(len(self.channels), -(2**62), dtype=np.int64)

    @property
    def calibration(self) -> Calibration:
        """Where the channels are, as learned from the passages so far.

        How long the deflection is, is learned in the blocks after a passage, or at the end.
        """
        return self._closing.calibration

    def process(self, block: Waveform) -> list[TrainEvent]:
        """Take the next block of a group; events that it completes.

        Blocks of one group come in order of time; how samples are cut into blocks does not change
        the result. Gaps between stamps, and NaN, are dropped samples. Overlaps are cut.

        Raises:
            InputError: the block does not fit the channels, its shape or its earlier rate.
        """
        group = self._group_of(block)
        if not len(block.data):
            return []
        self._closing.study(1)
        if self._start_ns is None:
            self._start_ns = self._done_ns = block.stamp_ns
        group.stream.push(block)
        return [*self._lateness(group, block), *self._run(self._horizon(block.stamp_ns))]

    def finish(self) -> list[TrainEvent]:
        """End of the stream: events of a train still passing, flagged ``truncated_end``."""
        now = max((g.stream.end_ns or 0 for g in self._groups.values()), default=0)
        events = self._run(now)
        for group in self._groups.values():
            group.stream.flush()
        events += self._frames(2**62)
        if self._beginning:
            self._beginning = False
            self._anew(now)
            if self._replay:
                self._replay = False
                events += self._frames(2**62)
        if self._event is not None:
            events += self._close(now, cut=True)
        self._closing.study()
        return events

    def _group_of(self, block: Waveform) -> Group:
        group = self._groups.get(block.channels)
        if group is None:
            unknown = [name for name in block.channels if name not in self._index]
            if unknown:
                raise InputError(
                    f"block channel {unknown[0]!r} is not one of the detector's channels "
                    f"{', '.join(self._index)}; name it when making the detector"
                )
            for other in self._groups:
                twice = set(other) & set(block.channels)
                if twice:
                    raise InputError(f"channel {twice.pop()!r} comes in two different groups")
            if block.dt_ns <= 0 or block.dt_ns > 20_000_000:
                raise InputError(
                    f"dt_ns = {block.dt_ns} ns must be positive and at most 20 000 000 ns (50 Hz)"
                )
            index = [self._index[n] for n in block.channels]
            slow = all(self.channels[i].layer == "bridge" for i in index)
            group = Group(block, index, self._keep_s, len(self.channels), slow)
            self._groups[block.channels] = group
        if block.data.ndim != 2 or block.data.shape[1] != len(block.channels):
            raise InputError(
                f"data of shape {block.data.shape} must be (samples, {len(block.channels)} "
                "channels)"
            )
        if block.dt_ns != group.stream.dt_ns:
            raise InputError(
                f"dt_ns of {', '.join(block.channels)} changed from {group.stream.dt_ns} to "
                f"{block.dt_ns} ns; reset the detector for another rate"
            )
        return group

    @property
    def _keep_s(self) -> float:
        return self.config.max_event + self.config.hang + 5.0

    def _lateness(self, group: Group, block: Waveform) -> list[TrainEvent]:
        """Tell if a group sends what others have not been kept waiting for."""
        self._newest_ns = max(self._newest_ns, block.stamp_ns)
        behind = (self._newest_ns - block.end_ns) * 1e-9
        late = behind > (0.5 if group.late else 1.0) * self.config.max_lag
        if late == group.late:
            return []
        group.late = late
        values: dict[str, Value] = {"behind": Estimate(behind, block.dt_ns * 1e-9, "s")}
        tell = self._closing.health.tell
        return [e for c in block.channels for e in tell(self._newest_ns, c, "late", late, values)]

    def _horizon(self, newest_ns: int) -> int:
        """Time up to which every group that is not silent has come."""
        lag = round(self.config.max_lag * 1e9)
        ends = [g.stream.end_ns or 0 for g in self._groups.values()]
        heard = sum(len(g.index) for g in self._groups.values())
        if heard < len(self.channels) and self._start_ns is not None:
            ends.append(self._start_ns)
        waited = [end for end in ends if newest_ns - end <= lag]
        return min(waited, default=max(ends))

    def _run(self, horizon_ns: int) -> list[TrainEvent]:
        events: list[TrainEvent] = []
        while self._done_ns < horizon_ns:
            self._done_ns = min(self._done_ns + _CHUNK_NS, horizon_ns)
            until = self._done_ns
            for group in self._groups.values():
                group.stream.advance(self._done_ns)
                until = min(until, group.stream.resolved_ns(self._done_ns))
            events += self._frames(max(until, self._done_ns - _HOLE_NS))
        return events

    def _frames(self, until_ns: int) -> list[TrainEvent]:
        """Take bins and decision frames that end by a time, in order of time over all groups."""
        queue: list[tuple[int, int, int, int, Group, Array | None]] = []

        def await_next(order: int, group: Group) -> None:
            statistic, rises = group.rises(until_ns)
            for at_ns, local, best in rises:
                heappush(queue, (at_ns, order, local, best, group, None))
            if group.next_bin + group.stream.frame_bins <= group.stream.bins:
                end_ns = group.stream.frame_end_ns(group.next_bin)
                if end_ns <= until_ns:
                    heappush(queue, (end_ns, order, len(group.index), 0, group, statistic))

        for order, group in enumerate(self._groups.values()):
            await_next(order, group)
        events: list[TrainEvent] = []
        while queue:
            now_ns, order, local, best, group, statistic = heappop(queue)
            if local < len(group.index):
                events += self._open(now_ns, group, local, best)
                continue
            frame = group.stream.frame(group.next_bin)
            group.next_bin += group.stream.frame_bins
            in_event = self._event is not None
            if statistic is not None:
                group.onset.take(statistic)
            active = group.trigger.step(frame.energy, frame.valid & ~frame.still, frozen=in_event)
            if now_ns > self._replayed_ns:
                events += self._closing.health.step(
                    now_ns,
                    group.stream.frame_s,
                    group.index,
                    frame.mean,
                    np.sqrt(np.max(np.nan_to_num(group.trigger.floor, nan=np.inf), axis=1)),
                    frame.still,
                    frame.valid,
                    in_event,
                )
            events += self._decide(now_ns, group, active)
            if self._beginning and self._event is None and self._calmed(group):
                self._beginning = False
                self._anew(now_ns)
            if self._replay:
                self._replay = False
                return events + self._frames(until_ns)
            if self._event is not None and group.watching:
                group.onset.restart()
            group.watching = self._event is None
            if group.watching:
                # what rings on has been counted, and must not wait for its time to run out
                group.onset.restart(~self._fresh_channels(group, now_ns))
            await_next(order, group)
        return events

    def _calmed(self, group: Group) -> bool:
        """Whether a group has become much quieter than when its floor was learned, for a while."""
        calm = group.louder_before(_BEGUN)
        group.calm_s = group.calm_s + group.stream.frame_s if calm else 0.0
        return group.calm_s > self.config.hang

    def _anew(self, now_ns: int) -> None:
        """Begin again at the start of the stream, if a train was near when floors were learned.

        What a record shows in its first half second is taken for noise, unless something later in
        it is much quieter: then that is the noise, and the record is gone through once more.
        """
        groups = tuple(self._groups.values())
        if any(group.stream.dropped_bins for group in groups):
            return
        floors = [group.quietest(now_ns) for group in groups]
        pairs = zip(groups, floors, strict=True)
        if not any(np.any(g.trigger.first_floor > _BEGUN * floor) for g, floor in pairs):
            return
        for group, floor in zip(groups, floors, strict=True):
            group.begin_again(floor)
        self._event = None
        self._inside = self._replay = True
        self._replayed_ns = now_ns
        self._lowest[:] = np.inf
        self._active_ns[:] = -(2**62)

    def _open(self, now_ns: int, group: Group, local: int, best: int) -> list[TrainEvent]:
        """An event begins where energy rises, unless an earlier train rings on.

        What comes too late may have been told by others.
        """
        channel = group.index[local]
        if self._event is not None or group.late:
            return []
        if not self._fresh(channel, float(group.trigger.level[local]), now_ns):
            return []
        band, gain = divmod(best, len(GAINS))
        start = now_ns - round((group.stream.step + group.stream.shift[band]) * 1e9)
        self._event = _Event(self.channels, start)
        self._event.next_update_ns = now_ns + _UPDATE_NS
        return [report.arrival(self.channels[channel], start, GAINS[gain])]

    def _decide(self, now_ns: int, group: Group, active: NDArray[np.bool_]) -> list[TrainEvent]:
        events: list[TrainEvent] = []
        for local in np.flatnonzero(active):
            channel = group.index[local]
            level = float(group.trigger.level[local])
            if self._event is not None:
                if self._event.follow(channel, float(group.trigger.steady[local]), now_ns):
                    self._followed(self._event, channel, now_ns)
            elif self._fresh(channel, level, now_ns):
                continue  # not yet an onset
            self._active_ns[channel] = now_ns
        if self._event is None:
            self._lowest[group.index] = np.minimum(
                self._lowest[group.index], np.maximum(group.trigger.level, 1.0)
            )
        if self._event is None:
            return events
        if now_ns - self._event.last() > self._event.hang_ns(self.config.hang):
            events += self._close(now_ns)
        elif now_ns - self._event.start_ns > self.config.max_event * 1e9:
            events += self._close(now_ns)
            for other in self._groups.values():
                other.relearn()
        elif self._past(self._event, now_ns):
            events += self._pass_on(self._event, now_ns)
        elif now_ns >= self._event.next_update_ns and self._event.updates < len(_UPDATE_AFTER):
            events += self._update(self._event, now_ns)
        return events

    def _past(self, event: _Event, now_ns: int) -> bool:
        """Whether trains of known types have passed whole, before the quiet time is over.

        On every rail channel: their pattern explains all that was strong, and at their speed a
        further wheelset of any type would have come. Another train may follow soon, or be on a
        channel already.
        """
        if event.past is None and now_ns >= event.trial_ns:
            event.past = self._trial(event, now_ns)
        return event.past is not None and now_ns >= max(event.past.clear_ns.values())

    def _clear_s(self, speed: float) -> float:
        """Time within which the next wheelset of a train comes, whatever its type (s)."""
        return _LULL_MARGIN * self.catalogue.longest_gap / speed

    def _trial(self, event: _Event, now_ns: int) -> _Past | None:
        quiet = event.quiet(now_ns)
        if len(quiet) < 2:  # without a delay, half a train is a type at another speed
            return None
        if event.speed is not None:
            speed, sigma = event.speed
            # what is strong stays so beyond its wheelset: no margin
            wait = 1e9 * self.catalogue.longest_gap / (speed + 2 * sigma)
        else:
            latest = max(quiet, key=lambda c: event.strong_ns[c])
            before, after = event.lull_ns[latest]
            wait = max(_LULL_NS, _LULL_FACTOR * (after - before))
        if any((end or now_ns) - start < wait for start, end in quiet.values()):
            return None
        if quiet == event.tried:
            return None
        lasting = [now_ns - start for start, end in quiet.values() if end is None]
        event.trial_ns = now_ns + max(lasting, default=0) // 2
        event.tried = None if lasting else quiet
        origin = event.start_ns - _BEFORE_NS
        ends = {
            c: now_ns if end is None else start + round(wait) for c, (start, end) in quiet.items()
        }
        last_ns = max(start for start, _ in quiet.values())
        within = (event.start_ns - origin) * 1e-9 - 0.5, (last_ns - origin) * 1e-9 + 0.3
        rails = [r for r in self._records(event, origin, now_ns, ends) if r.channel.layer == "rail"]
        found = self._closing.search(rails, within, unlisted=False)
        if not found or not all(p.known and p.confirmed and not p.clock_offset for p in found):
            return None
        train, best = found[-1], found[-1].hypotheses[0]
        if train.direction == 0 or not (
            min(p.score for p in found) > _CLEAR or _agree(event.speed, best.fit.motion)
        ):
            return None
        past = _Past(found, last_ns, {}, {})
        for c, (start, end) in quiet.items():
            way = train.direction * (self.channels[c].x - train.traces[0].x)
            last = float(best.fit.motion.time_at(best.places[-1] + way))
            clear = self._clear_s(float(best.fit.motion.speed_at(last)))
            past.clear_ns[c] = origin + round((last + clear) * 1e9)
            if abs((start - origin) * 1e-9 - last) > clear:
                return None
            if end is not None:
                if end < past.clear_ns[c]:
                    return None
                past.next_ns[c] = end
        return past

    def _followed(self, event: _Event, channel: int, now_ns: int) -> None:
        """A channel is strong: what was taken for past is not, unless this is the next train."""
        if event.past is None or self.channels[channel].layer != "rail":
            return
        if now_ns < event.past.clear_ns.get(channel, 2**62):
            event.past = None
        else:
            event.past.next_ns.setdefault(channel, now_ns)

    def _pass_on(self, event: _Event, now_ns: int) -> list[TrainEvent]:
        """Tell the trains that are past; what came after them is an event of its own."""
        past = event.past
        assert past is not None
        events = self._close(now_ns, past)
        if self._replay or not past.next_ns:
            return events
        channel = min(past.next_ns, key=lambda c: past.next_ns[c])
        self._event = _Event(self.channels, past.next_ns[channel], after=past.clear_ns)
        self._event.next_update_ns = now_ns + _UPDATE_NS
        return [*events, report.arrival(self.channels[channel], past.next_ns[channel], GAINS[0])]

    def _fresh(self, channel: int, level: float, now_ns: int) -> bool:
        """Whether the activity of a channel is new, not what an earlier train left ringing."""
        if now_ns - self._active_ns[channel] > _REARM_NS:
            return True
        return self.channels[channel].layer == "rail" and level > _RISE * self._lowest[channel]

    def _fresh_channels(self, group: Group, now_ns: int) -> NDArray[np.bool_]:
        levels = zip(group.index, group.trigger.level, strict=True)
        return np.array([self._fresh(channel, float(level), now_ns) for channel, level in levels])

    def _close(self, now_ns: int, past: _Past | None = None, cut: bool = False) -> list[TrainEvent]:
        event = self._event
        assert event is not None
        self._event = None
        if self._beginning:
            self._beginning = False
            self._anew(now_ns)
            if self._replay:
                return []
        self._lowest[:] = np.inf
        origin = event.start_ns - _BEFORE_NS
        last = event.last() if past is None else past.last_ns
        within = (
            (event.start_ns - origin) * 1e-9 - 0.5,
            (last - origin) * 1e-9 + 0.3,
        )
        begun = None
        if self._inside:
            self._inside = False
            start = self._start_ns or 0
            speed = event.speed[0] if event.speed else self.config.min_speed
            # had the record begun inside the train, a wheelset would have come before
            if (event.start_ns - start) * 1e-9 < self._clear_s(speed):
                begun = self._rails(event, start, now_ns), start
        ends = {c: past.clear_ns[c] for c in past.next_ns} if past else {}
        records = self._records(event, origin, now_ns, ends)
        found = past.found if past else None
        return self._closing.conclude(
            Ended(records, origin, within, now_ns, last, found, cut, begun)
        )

    def _records(
        self, event: _Event, from_ns: int, to_ns: int, ends: Mapping[int, int] | None = None
    ) -> list[Record]:
        """What the channels show in an interval of an event.

        Args:
            event: some channels show it only after an earlier train.
            from_ns: start (ns).
            to_ns: end (ns).
            ends: of some channels, where a later train comes (ns).
        """
        records = [
            r for g in self._groups.values() for r in g.records(self.channels, from_ns, to_ns)
        ]
        if not event.after and not ends:
            return records
        parts = []
        for record in records:
            c = self._index[record.channel.name]
            span = event.after.get(c, from_ns), (ends or {}).get(c, to_ns)
            part = record.between(*((t - from_ns) * 1e-9 for t in span))
            if part.window.time.size > LEAST_BINS:
                parts.append(part)
        return parts

    def _update(self, event: _Event, now_ns: int) -> list[TrainEvent]:
        passed = now_ns - event.start_ns
        event.next_update_ns = now_ns + max(_UPDATE_NS, round(_UPDATE_GROWTH * passed))
        if passed * 1e-9 * self.config.min_speed > _UPDATE_WITHIN:
            return []
        origin = event.start_ns - _BEFORE_NS
        within = ((event.start_ns - origin) * 1e-9 - 0.5, (now_ns - origin) * 1e-9)
        rails = self._rails(event, origin, now_ns)
        found = provisional(rails, within, self._limits, self._heads, self.calibration)
        if found is None or not _enough(found, event.updates):
            return []
        event.updates += 1
        if found.direction:
            event.speed = found.speed, found.sigma
        return [report.update(found, now_ns)]

    @cached_property
    def _heads(self) -> HeadMatcher:
        return HeadMatcher(self.catalogue.types, self._limits)

    def _rails(self, event: _Event, from_ns: int, to_ns: int) -> list[Record]:
        return [r for r in self._records(event, from_ns, to_ns) if r.channel.layer == "rail"]


def _agree(speed: tuple[float, float] | None, motion: Motion) -> bool:
    """Whether a speed (m/s, sigma) is that of a motion."""
    if speed is None:
        return False
    told = motion.speed_at(motion.epoch)
    return bool(abs(speed[0] - told) < 2 * np.hypot(speed[1], _CHANGE * told))


def _enough(found: Partial, updates: int) -> bool:
    if found.types:
        return found.wheelsets >= _UPDATE_WHEELSETS[updates]
    return found.distance >= _UPDATE_AFTER[updates]
