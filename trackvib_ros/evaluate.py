"""Score a detector on recorded bags against their ground truth. No ROS.

A detector is anything with two methods::

    class MyDetector:
        def __init__(self, channels): ...           # list of trackvib_ros.detection.Channel
        def process(self, block): return [...]       # a Waveform in, TrainEvents out
        def finish(self): return [...]               # end of the stream

and is named ``module:MyDetector``. Of its events, ``arrival`` (stamp), ``axle`` (stamp) and
``passage`` (stamp; values ``speed``, ``acceleration``, ``departure_ns``, ``departure_sigma``,
``axle_count``, ``type``, ``direction``) are scored. One whose constructor takes ``catalogue`` can
also be scored with the type or the family of the train known to it.
"""

from __future__ import annotations

import importlib
import inspect
import json
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from solver import InputError, Scenario, TrainMotion, load_scenario_text
from trackvib_ros import topics
from trackvib_ros.bag import BagReader
from trackvib_ros.channels import read_channel
from trackvib_ros.detection import (
    VIBRATION,
    Catalogue,
    Channel,
    Estimate,
    TrainDetector,
    TrainEvent,
    TrainType,
)
from trackvib_ros.truth import PassageTruth
from trackvib_ros.waveform import Waveform

Array = NDArray[np.float64]

MATCH_S = 2.0
"""A passage belongs to a true one if its arrival is this near (s)."""

AXLE_MATCH = 0.25
"""A wheelset is found if its time is right within this part of the shortest wheelbase time."""

ALARM_S = 3.0
"""An alarm is explained by a train on the line or this long before or after it (s)."""


class Detector(Protocol):
    """What can be evaluated."""

    def process(self, block: Waveform) -> list[TrainEvent]:
        """Take a block; return what it completes."""

    def finish(self) -> list[TrainEvent]:
        """Return what is left at the end of the stream."""


Factory = Callable[..., Detector]


@dataclass(frozen=True)
class View:
    """What of a bag a detector is given.

    Attributes:
        layers: channels on these layers; empty means all.
        channels: how many of them, in order of their position; 0 means all.
        known: what it knows of the train: nothing, its family or its type.
        joined_s: blocks are joined up to this length (s): cheaper, but then the stream times at
            which something is told are as coarse; 0 leaves them as recorded.
    """

    layers: tuple[str, ...] = ()
    channels: int = 0
    known: Literal["nothing", "family", "type"] = "nothing"
    joined_s: float = 0.0

    def chosen(self, channels: Sequence[Channel]) -> list[Channel]:
        """The channels of a bag that are given."""
        found = [c for c in channels if not self.layers or c.layer in self.layers]
        found.sort(key=lambda channel: channel.x)
        return found[: self.channels or None]


VIEWS: dict[str, View] = {
    "all": View(),
    "rails": View(("rail",)),
    "one rail": View(("rail",), 1, "nothing", 0.5),
    "one rail, family known": View(("rail",), 1, "family", 0.5),
    "one rail, type known": View(("rail",), 1, "type", 0.5),
    "slab, type known": View(("slab",), 1, "type", 0.5),
    "bridge, type known": View(("bridge",), 1, "type", 0.5),
    "bridge": View(("bridge",), 1, "nothing", 0.5),
}
"""By name: what of a bag a detector can be given."""


@dataclass
class PassageScore:
    """One true passage and what was found of it.

    Errors are found minus true; speeds relative to the true one, at the middle of the train.

    Attributes:
        number: of the train in the bag, from 1.
        listed: whether the detector's catalogue has the type.
        onset_s: stamp of the arrival event after the first wheelset at the first channel.
        declared_s: stream time at which the arrival event came after that wheelset.
        latency_s: stream time at which the passage came after the last wheelset at the last
            channel.
        axle_square, axle_inside, axle_scored: sum of (error / sigma)², number within 1.96 sigma,
            number of wheelsets found whose time has a sigma.
        axles_told: number of axle events; ``axles_found`` is the count that the passage states.
        updates: (error, sigma) of every speed told while the train passed, in order; against the
            true speed halfway between its first wheelset and the update.
    """

    bag: str
    view: str
    factors: dict[str, Any]
    number: int
    train: str
    listed: bool
    speed_kmh: float
    acceleration: float
    detected: bool
    found_type: str = ""
    found_family: str = ""
    family: str = ""
    direction: str = ""
    true_direction: str = ""
    onset_s: float | None = None
    declared_s: float | None = None
    arrival_s: float | None = None
    arrival_sigma_s: float | None = None
    departure_s: float | None = None
    departure_sigma_s: float | None = None
    speed_error: float | None = None
    speed_sigma: float | None = None
    acceleration_error: float | None = None
    acceleration_sigma: float | None = None
    axles_true: int = 0
    axles_found: int = 0
    axles_told: int = 0
    axles_right: int = 0
    axle_square: float = 0.0
    axle_inside: int = 0
    axle_scored: int = 0
    latency_s: float | None = None
    updates: tuple[tuple[float, float], ...] = ()
    quality: tuple[str, ...] = ()

    @property
    def direction_right(self) -> bool | None:
        """Whether the direction told is right; None if none was told."""
        return None if self.direction in ("", "unknown") else self.direction == self.true_direction

    @property
    def type_right(self) -> bool:
        """Whether the type is right: an unlisted one must be called unknown."""
        return self.found_type == (self.train if self.listed else "unknown")

    @property
    def confident(self) -> bool:
        """Whether the wheelset count was told without reservation."""
        return "axle_count_not_confident" not in self.quality


@dataclass
class BagScore:
    """Scores of one bag in one view."""

    bag: str
    view: str
    factors: dict[str, Any]
    duration_s: float
    cpu_s: float
    passages: list[PassageScore] = field(default_factory=list)
    extra: int = 0
    alarms: int = 0
    problem: str = ""


@dataclass(frozen=True)
class Recording:
    """A bag in memory.

    Attributes:
        channels: described and recorded ones.
        blocks: in order of their end.
        truths: true passages.
        scenario: of the run, if the bag has it: gives the exact motion of the trains.
        factors: what was combined to make the bag, if it is of a dataset.
    """

    channels: tuple[Channel, ...]
    blocks: tuple[Waveform, ...]
    truths: tuple[PassageTruth, ...]
    scenario: Scenario | None
    factors: dict[str, Any]

    def given(self, view: View) -> tuple[list[Channel], list[Waveform]]:
        """Channels and blocks in a view; no channel if the bag has none for it."""
        channels = view.chosen(self.channels)
        names = {channel.name for channel in channels}
        blocks = []
        for block in self.blocks:
            columns = [i for i, name in enumerate(block.channels) if name in names]
            if len(columns) == len(block.channels):
                blocks.append(block)
            elif columns:
                kept = tuple(block.channels[i] for i in columns)
                blocks.append(replace(block, channels=kept, data=block.data[:, columns]))
        return channels, joined(blocks, view.joined_s)


def joined(blocks: Sequence[Waveform], length_s: float) -> list[Waveform]:
    """Blocks of a group that follow each other without a gap, joined up to a length (s)."""
    parts: list[list[Waveform]] = []
    last: dict[tuple[str, ...], list[Waveform]] = {}
    for block in blocks:
        open_part = last.get(block.channels)
        if (
            open_part
            and open_part[-1].end_ns == block.stamp_ns
            and open_part[-1].dt_ns == block.dt_ns
            and (block.end_ns - open_part[0].stamp_ns) * 1e-9 <= length_s
        ):
            open_part.append(block)
        else:
            last[block.channels] = [block]
            parts.append(last[block.channels])
    out = [
        part[0] if len(part) == 1 else replace(part[0], data=np.concatenate([b.data for b in part]))
        for part in parts
    ]
    return sorted(out, key=lambda block: block.end_ns)


def load_factory(name: str | None) -> Factory:
    """The factory of a detector: ``module:factory``; ours without a name.

    Raises:
        InputError: no such module or factory.
    """
    if name is None:
        return TrainDetector
    module, _, attribute = name.partition(":")
    if not attribute:
        raise InputError(f"--detector {name}: must be module:factory, such as my_detector:MyPeaks")
    if "" not in sys.path:
        sys.path.insert(0, "")  # a file in the working directory
    try:
        factory = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as failure:
        raise InputError(f"--detector {name}: cannot be loaded: {failure}") from None
    if not callable(factory):
        raise InputError(f"--detector {name}: {attribute} cannot be called with a list of channels")
    return factory  # type: ignore[no-any-return]


def check_views(names: Sequence[str], detector: str | None) -> None:
    """Check that a detector can be scored in these views.

    Raises:
        InputError: no such view, or the detector takes no catalogue.
    """
    takes = "catalogue" in inspect.signature(load_factory(detector)).parameters
    for name in names:
        if name not in VIEWS:
            raise InputError(f"--view {name!r}: choose from {', '.join(map(repr, VIEWS))}")
        if VIEWS[name].known != "nothing" and not takes:
            raise InputError(
                f"--view {name!r}: the detector {detector} takes no catalogue; give its "
                "constructor the parameter catalogue, or choose another view"
            )


def read_bag(path: Path) -> Recording:
    """A bag with all that scoring needs.

    Raises:
        InputError: the bag lacks channel descriptions or waveforms.
    """
    with BagReader(path) as reader:
        names = {
            suffix: [name for name in reader.topics if name.endswith("/" + suffix)]
            for suffix in (topics.CHANNELS, topics.TRUE_PASSAGES, topics.SCENARIO, "waveform")
        }
        channels: dict[str, Channel] = {}
        for message in reader.messages(names[topics.CHANNELS]) if names[topics.CHANNELS] else ():
            for status in reader.decode(message).status:
                values = {pair.key: pair.value for pair in status.values}
                try:
                    channels[status.name] = read_channel(status.name, values)
                except InputError as failure:
                    raise InputError(f"bag {path}: {failure}") from None
        truths = []
        passages = names[topics.TRUE_PASSAGES]
        for message in reader.messages(passages) if passages else ():
            for status in reader.decode(message).status:
                values = {pair.key: pair.value for pair in status.values}
                truths.append(PassageTruth.from_dict(values))
        text = ""
        for message in reader.messages(names[topics.SCENARIO]) if names[topics.SCENARIO] else ():
            text = reader.decode(message).data
        stored = dict(reader.custom_data)
        blocks = [block for name in names["waveform"] for block in reader.waveforms(name)]
    blocks.sort(key=lambda block: block.end_ns)
    used = {name for block in blocks for name in block.channels}
    missing = sorted(used - set(channels))
    if missing or not used:
        what = f"no description of channel {missing[0]!r}" if missing else "no waveform topic"
        raise InputError(f"bag {path}: {what}; record the topics channels and .../waveform")
    return Recording(
        tuple(c for c in channels.values() if c.name in used),
        tuple(blocks),
        tuple(sorted(truths, key=lambda truth: truth.enter_ns)),
        load_scenario_text(text, f"scenario in {path}") if text else None,
        json.loads(stored.get("case", "{}")),
    )


def catalogue_for(recording: Recording, known: str) -> Catalogue:
    """The types of the trains in a recording, or of their families.

    Raises:
        InputError: a type is neither in the shipped catalogue nor described in the bag.
    """
    default = Catalogue.default()
    types: dict[str, TrainType] = {}
    for truth in recording.truths:
        own = [t for t in default if t.name == truth.train_type]
        if own:
            family = [t for t in default if t.family == own[0].family]
            types |= {t.name: t for t in (family if known == "family" else own)}
        elif recording.scenario is not None:
            places = recording.scenario.train[truth.train - 1].axle_positions
            types |= {t.name: t for t in Catalogue.from_axles({truth.train_type: places})}
        else:
            raise InputError(f"train type {truth.train_type!r} is not in the catalogue")
    return Catalogue(tuple(types.values()), f"{default.version}, {known} known")


def score_recording(
    recording: Recording, bag: str, view: str = "all", detector: str | None = None
) -> BagScore | None:
    """Run a detector over a recording and compare with its truth; None without channels for it."""
    chosen = VIEWS[view]
    channels, blocks = recording.given(chosen)
    if not channels:
        return None
    factory = load_factory(detector)
    catalogue = Catalogue.default()
    if chosen.known != "nothing":
        catalogue = catalogue_for(recording, chosen.known)
        factory = partial(factory, catalogue=catalogue)
    started = time.process_time()
    subject = factory(channels)
    told: list[tuple[int, TrainEvent]] = []
    for block in blocks:
        told += [(block.end_ns, event) for event in subject.process(block)]
    end_ns = max(block.end_ns for block in blocks)
    told += [(end_ns, event) for event in subject.finish()]
    cpu = time.process_time() - started
    start_ns = min(block.stamp_ns for block in blocks)
    score = BagScore(bag, view, recording.factors, (end_ns - start_ns) * 1e-9, cpu)
    names = [channel.name for channel in channels]
    match_events(score, told, recording.truths, names, recording.scenario, catalogue)
    return score


def match_events(
    score: BagScore,
    told: Sequence[tuple[int, TrainEvent]],
    truths: Sequence[PassageTruth],
    channels: Sequence[str] = (),
    scenario: Scenario | None = None,
    catalogue: Catalogue | None = None,
) -> None:
    """Fill a score from events, each with the stream time at which it was told (ns).

    Args:
        score: to fill.
        told: stream time (ns) and event.
        truths: true passages in order of time.
        channels: that the detector was given; all without a name.
        scenario: of the run; without it the true motion is taken from the axle times.
        catalogue: of the detector; the shipped one by default.
    """
    catalogue = catalogue or Catalogue.default()
    summaries = [(t, e) for t, e in told if e.kind == "passage"]
    summaries = [(t, e) for t, e in summaries if e.values.get("grade") != VIBRATION]
    arrivals = [(t, e) for t, e in told if e.kind == "arrival"]
    axles = [e for _, e in told if e.kind == "axle"]
    updates = [e for _, e in told if e.kind == "update"]
    taken: set[int] = set()
    explained: set[int] = set()
    margin = round(ALARM_S * 1e9)
    before = -(2**62)
    for truth in truths:
        names = [name for name in channels if name in truth.axle_times_ns]
        times = [truth.axle_times_ns[name] for name in names or truth.axle_times_ns]
        passage = _score_passage(score, truth, summaries, taken, axles, scenario, catalogue)
        score.passages.append(passage)
        line = (truth.enter_ns - margin, truth.leave_ns + margin)
        explained.update(i for i, (_, e) in enumerate(arrivals) if line[0] <= e.stamp_ns <= line[1])
        first, last = min(t[0] for t in times), max(t[-1] for t in times)
        own = [(t, e) for t, e in arrivals if max(line[0], before) <= e.stamp_ns <= truth.leave_ns]
        if own and passage.detected:
            passage.onset_s = (own[0][1].stamp_ns - first) * 1e-9
            passage.declared_s = (own[0][0] - first) * 1e-9
        own_updates = [e for e in updates if first < e.stamp_ns < last]
        passage.updates = _score_updates(own_updates, truth, first, scenario)
        if passage.latency_s is not None:
            passage.latency_s -= last * 1e-9
        before = last
    score.extra = len(summaries) - len(taken)
    score.alarms = len(arrivals) - len(explained)


def _score_passage(
    score: BagScore,
    truth: PassageTruth,
    summaries: Sequence[tuple[int, TrainEvent]],
    taken: set[int],
    axles: Sequence[TrainEvent],
    scenario: Scenario | None,
    catalogue: Catalogue,
) -> PassageScore:
    families = {train.name: train.family for train in Catalogue.default()}
    families |= {train.name: train.family for train in catalogue}
    passage = PassageScore(
        bag=score.bag,
        view=score.view,
        factors=score.factors,
        number=truth.train,
        train=truth.train_type,
        listed=truth.train_type in {train.name for train in catalogue},
        speed_kmh=3.6 * float(np.mean(list(truth.speed_m_s.values()))),
        acceleration=0.0,
        detected=False,
        family=families.get(truth.train_type, ""),
        true_direction=truth.direction,
        axles_true=truth.axle_count,
    )
    best: tuple[float, int] | None = None
    for i, (_, event) in enumerate(summaries):
        if i in taken:
            continue
        error = abs(event.stamp_ns - _times(truth, event)[1][0]) * 1e-9
        if error < MATCH_S and (best is None or error < best[0]):
            best = (error, i)
    name, times_ns = next(iter(truth.axle_times_ns.items()))
    if best is not None:
        name, times_ns = _times(truth, summaries[best[1]][1])
    true_speed, true_acceleration = _mid_motion(truth, name, scenario)
    passage.speed_kmh, passage.acceleration = 3.6 * true_speed, true_acceleration
    if best is None:
        return passage
    taken.add(best[1])
    told_ns, event = summaries[best[1]]
    values = event.values
    passage.detected = True
    passage.quality = tuple(event.quality)
    passage.arrival_s = (event.stamp_ns - times_ns[0]) * 1e-9
    passage.arrival_sigma_s = event.sigma_s
    departure, departure_sigma = values.get("departure_ns"), values.get("departure_sigma")
    if isinstance(departure, int):
        passage.departure_s = (departure - times_ns[-1]) * 1e-9
        if isinstance(departure_sigma, (int, float)):
            passage.departure_sigma_s = float(departure_sigma)
    passage.latency_s = told_ns * 1e-9
    passage.found_type = str(values.get("type", ""))
    passage.found_family = families.get(passage.found_type, "")
    passage.direction = str(values.get("direction", "unknown"))
    speed, acceleration = values.get("speed"), values.get("acceleration")
    if isinstance(speed, Estimate):
        passage.speed_error = speed.value / true_speed - 1
        passage.speed_sigma = speed.sigma / true_speed
    if isinstance(acceleration, Estimate):
        passage.acceleration_error = acceleration.value - true_acceleration
        passage.acceleration_sigma = acceleration.sigma
    _score_axles(passage, event, axles, np.array(times_ns) * 1e-9)
    return passage


def _score_updates(
    updates: Sequence[TrainEvent], truth: PassageTruth, first_ns: int, scenario: Scenario | None
) -> tuple[tuple[float, float], ...]:
    """Relative error and sigma of the speeds told while a train passes."""
    motion = TrainMotion(scenario.train[truth.train - 1]) if scenario is not None else None
    out = []
    for event in updates:
        speed = event.values.get("speed")
        if not isinstance(speed, Estimate):
            continue
        true = float(np.mean(list(truth.speed_m_s.values())))
        if motion is not None:
            true = float(motion.speed(np.array([0.5e-9 * (first_ns + event.stamp_ns)]))[0])
        out.append((speed.value / true - 1, speed.sigma / true))
    return tuple(out)


def _score_axles(
    passage: PassageScore, event: TrainEvent, axles: Sequence[TrainEvent], times: Array
) -> None:
    departure = event.values.get("departure_ns")
    low = event.stamp_ns - 10**8
    high = (departure if isinstance(departure, int) else round(times[-1] * 1e9)) + 10**8
    own = sorted((e for e in axles if low <= e.stamp_ns <= high), key=lambda e: e.stamp_ns)
    count = event.values.get("axle_count")
    passage.axles_told = len(own)
    passage.axles_found = count if isinstance(count, int) else len(own)
    found = np.array([e.stamp_ns for e in own]) * 1e-9
    pairs = pairing(found, times, AXLE_MATCH * float(np.min(np.diff(times), initial=0.1)))
    passage.axles_right = len(pairs)
    ratios = [(found[i] - times[j]) / own[i].sigma_s for i, j in pairs if own[i].sigma_s > 0]
    passage.axle_square = float(np.sum(np.square(ratios)))
    passage.axle_inside = int(np.sum(np.abs(ratios) < 1.96))
    passage.axle_scored = len(ratios)


def _times(truth: PassageTruth, event: TrainEvent) -> tuple[str, tuple[int, ...]]:
    """Reference channel of an event, and times of the wheelsets there (ns)."""
    for name in (event.values.get("reference"), *event.sensors):
        if isinstance(name, str) and name in truth.axle_times_ns:
            return name, truth.axle_times_ns[name]
    return next(iter(truth.axle_times_ns.items()))


def _mid_motion(truth: PassageTruth, name: str, scenario: Scenario | None) -> tuple[float, float]:
    """True speed (m/s) and acceleration (m/s²) as the middle of the train passes a channel.

    Without the scenario the mean speed and acceleration 0 are all that the axle times give.
    """
    if scenario is None:
        return float(truth.speed_m_s[name]), 0.0
    motion = TrainMotion(scenario.train[truth.train - 1])
    channel = next(c for c in scenario.channel if c.name == name)
    half = 0.5 * float(motion.offsets[-1])
    time = motion.time_at(scenario.channel_x(channel) + motion.sign * half)
    around = motion.speed(np.array([time - 1e-3, time, time + 1e-3]))
    return float(around[1]), float((around[2] - around[0]) / 2e-3)


def pairing(found: Array, true: Array, tolerance: float) -> list[tuple[int, int]]:
    """Pairs of two ascending lists, one to one, that agree within a tolerance."""
    i = j = 0
    pairs = []
    while i < found.size and j < true.size:
        if abs(found[i] - true[j]) <= tolerance:
            pairs.append((i, j))
            i, j = i + 1, j + 1
        elif found[i] < true[j]:
            i += 1
        else:
            j += 1
    return pairs


@dataclass
class Evaluation:
    """Scores of a set of bags."""

    detector: str
    bags: list[BagScore]

    @property
    def passages(self) -> list[PassageScore]:
        """All true passages, once per view."""
        return [passage for bag in self.bags for passage in bag.passages]

    def only(self, keep: Callable[[BagScore], bool]) -> Evaluation:
        """The bags for which ``keep`` is true."""
        return Evaluation(self.detector, [bag for bag in self.bags if keep(bag)])


def evaluate(
    bags: Sequence[Path],
    detector: str | None = None,
    workers: int = 1,
    progress: Callable[[int, int, str], None] | None = None,
    views: Sequence[str] | Callable[[dict[str, Any]], Sequence[str]] = ("all",),
) -> Evaluation:
    """Score a detector over bags; directories of bags are searched.

    Args:
        bags: bags or directories of bags.
        detector: ``module:factory``; ours if not given.
        workers: processes.
        progress: called with (done, all, name of the bag).
        views: of :data:`VIEWS`, or a function that gives them for the factors of a bag.

    Raises:
        InputError: no bag, or the detector cannot be loaded or used in a view.
    """
    check_views(views if not callable(views) else (), detector)
    paths = find_bags(bags)
    scores: list[BagScore] = []
    score = partial(_score_safely, detector=detector, views=views)
    if workers > 1 and len(paths) > 1:
        with ProcessPoolExecutor(workers) as pool:
            for number, found in enumerate(pool.map(score, paths), 1):
                scores += found
                if progress:
                    progress(number, len(paths), found[0].bag)
    else:
        for number, path in enumerate(paths, 1):
            scores += score(path)
            if progress:
                progress(number, len(paths), str(path))
    return Evaluation(detector or "trackvib_ros.detection:TrainDetector", scores)


def _score_safely(
    path: Path,
    detector: str | None,
    views: Sequence[str] | Callable[[dict[str, Any]], Sequence[str]],
) -> list[BagScore]:
    scores: list[BagScore] = []
    view = ""
    try:
        recording = read_bag(path)
        asked = views(recording.factors) if callable(views) else views
        for view in asked:
            score = score_recording(recording, str(path), view, detector)
            if score is not None:
                scores.append(score)
        if asked and not scores:
            have = ", ".join(channel.name for channel in recording.channels)
            raise InputError(
                f"no channel for the views asked for ({', '.join(asked)}); the bag has {have}"
            )
    except Exception as failure:  # a plug-in may raise anything; the other bags still count
        problem = f"{type(failure).__name__}: {failure}"
        scores.append(BagScore(str(path), view, {}, 0.0, 0.0, problem=problem))
    return scores


def find_bags(paths: Sequence[Path]) -> list[Path]:
    """Bags among the paths and in directories of bags.

    Raises:
        InputError: a path does not exist or holds no bag.
    """
    found: list[Path] = []
    for path in paths:
        if path.is_file() or (path / "metadata.yaml").is_file():
            found.append(path)
            continue
        if not path.is_dir():
            raise InputError(f"{path} does not exist: name a bag or a directory of bags")
        inner = sorted(p.parent for p in path.glob("*/metadata.yaml"))
        if not inner:
            raise InputError(f"{path} holds no bag: name a bag or a directory of bags")
        found += inner
    return found
