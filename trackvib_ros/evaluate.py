"""Score a detector on recorded bags against their ground truth. No ROS.

A detector is anything with two methods::

    class MyDetector:
        def __init__(self, channels): ...           # list of trackvib_ros.detection.Channel
        def process(self, block): return [...]       # a Waveform in, TrainEvents out
        def finish(self): return [...]               # end of the stream

and is named ``module:MyDetector``. Of its events, ``arrival`` (stamp), ``axle`` (stamp) and
``passage`` (stamp; values ``speed``, ``departure_ns``, ``type``, ``direction``) are scored.
"""

from __future__ import annotations

import importlib
import json
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from solver import InputError, preset_names, train_preset
from trackvib_ros import topics
from trackvib_ros.bag import BagReader
from trackvib_ros.detection import VIBRATION, Channel, Estimate, TrainDetector, TrainEvent
from trackvib_ros.truth import PassageTruth
from trackvib_ros.waveform import Waveform

Array = NDArray[np.float64]

MATCH_S = 2.0
"""A passage belongs to a true one if its arrival is this near, or lies within it (s)."""

AXLE_MATCH = 0.25
"""A wheelset is found if its time is right within this part of the shortest wheelbase time."""


class Detector(Protocol):
    """What can be evaluated."""

    def process(self, block: Waveform) -> list[TrainEvent]:
        """Take a block; return what it completes."""

    def finish(self) -> list[TrainEvent]:
        """Return what is left at the end of the stream."""


Factory = Callable[[list[Channel]], Detector]


@dataclass
class PassageScore:
    """One true passage and what was found of it; errors are found minus true."""

    bag: str
    train: str
    speed_kmh: float
    detected: bool
    found_type: str = ""
    direction_right: bool | None = None
    onset_s: float | None = None
    arrival_s: float | None = None
    arrival_sigma_s: float | None = None
    departure_s: float | None = None
    speed_error: float | None = None
    speed_sigma: float | None = None
    axles_true: int = 0
    axles_found: int = 0
    axles_right: int = 0
    latency_s: float | None = None


@dataclass
class BagScore:
    """Scores of one bag."""

    bag: str
    duration_s: float
    cpu_s: float
    passages: list[PassageScore] = field(default_factory=list)
    extra: int = 0
    alarms: int = 0
    problem: str = ""


def load_factory(name: str | None) -> Factory:
    """The factory of a detector: ``module:factory``; ours without a name.

    Raises:
        InputError: no such module or factory.
    """
    if name is None:
        return lambda channels: TrainDetector(channels)
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


def read_bag(path: Path) -> tuple[list[Channel], list[Waveform], list[PassageTruth]]:
    """Channels, waveform blocks in order of their end, and truths of a bag.

    Raises:
        InputError: the bag lacks channel descriptions or waveforms.
    """
    with BagReader(path) as reader:
        names = {
            suffix: [name for name in reader.topics if name.endswith("/" + suffix)]
            for suffix in (topics.CHANNELS, topics.TRUE_PASSAGES, "waveform")
        }
        channels: dict[str, Channel] = {}
        for message in reader.messages(names[topics.CHANNELS]) if names[topics.CHANNELS] else ():
            for status in reader.decode(message).status:
                values = {pair.key: pair.value for pair in status.values}
                try:
                    x = float(values["x"].removesuffix(" m"))
                    channels[status.name] = Channel(status.name, x, values["layer"])
                except (KeyError, ValueError) as failure:
                    raise InputError(f"bag {path}: channel {status.name!r}: {failure}") from None
        truths = []
        passages = names[topics.TRUE_PASSAGES]
        for message in reader.messages(passages) if passages else ():
            for status in reader.decode(message).status:
                values = {pair.key: pair.value for pair in status.values}
                truths.append(PassageTruth.from_dict(values))
        blocks = [block for name in names["waveform"] for block in reader.waveforms(name)]
    blocks.sort(key=lambda block: block.end_ns)
    used = {name for block in blocks for name in block.channels}
    missing = sorted(used - set(channels))
    if missing or not used:
        what = f"no description of channel {missing[0]!r}" if missing else "no waveform topic"
        raise InputError(f"bag {path}: {what}; record the topics channels and .../waveform")
    return [c for c in channels.values() if c.name in used], blocks, truths


def score_bag(path: Path, detector: str | None = None) -> BagScore:
    """Run a detector over one bag and compare with its truth."""
    channels, blocks, truths = read_bag(path)
    factory = load_factory(detector)
    started = time.process_time()
    subject = factory(channels)
    told: list[tuple[int, TrainEvent]] = []
    for block in blocks:
        told += [(block.end_ns, event) for event in subject.process(block)]
    end_ns = max(block.end_ns for block in blocks)
    told += [(end_ns, event) for event in subject.finish()]
    cpu = time.process_time() - started
    start_ns = min(block.stamp_ns for block in blocks)
    score = BagScore(str(path), (end_ns - start_ns) * 1e-9, cpu)
    match_events(score, told, truths)
    return score


def match_events(
    score: BagScore, told: Sequence[tuple[int, TrainEvent]], truths: Sequence[PassageTruth]
) -> None:
    """Fill a score from events, each with the stream time at which it was told (ns)."""
    summaries = [(t, e) for t, e in told if e.kind == "passage"]
    summaries = [(t, e) for t, e in summaries if e.values.get("grade") != VIBRATION]
    arrivals = [e for _, e in told if e.kind == "arrival"]
    axles = [e for _, e in told if e.kind == "axle"]
    taken: set[int] = set()
    explained: set[int] = set()
    for truth in truths:
        score.passages.append(_score_passage(score.bag, truth, summaries, taken, axles))
        line = (truth.enter_ns - 3 * 10**9, truth.leave_ns + 3 * 10**9)
        here = [i for i, e in enumerate(arrivals) if line[0] <= e.stamp_ns <= line[1]]
        explained.update(here)
        passage = score.passages[-1]
        if here and passage.detected:
            first = min(times[0] for times in truth.axle_times_ns.values())
            passage.onset_s = (min(arrivals[i].stamp_ns for i in here) - first) * 1e-9
    score.extra = len(summaries) - len(taken)
    score.alarms = len(arrivals) - len(explained)


def _score_passage(
    bag: str,
    truth: PassageTruth,
    summaries: Sequence[tuple[int, TrainEvent]],
    taken: set[int],
    axles: Sequence[TrainEvent],
) -> PassageScore:
    speed = float(np.mean(list(truth.speed_m_s.values())))
    score = PassageScore(bag, truth.train_type, 3.6 * speed, False, axles_true=truth.axle_count)
    best: tuple[float, int] | None = None
    for i, (_, event) in enumerate(summaries):
        if i in taken:
            continue
        times = np.array(_times(truth, event)) * 1e-9
        stamp = event.stamp_ns * 1e-9
        error = abs(stamp - times[0])
        if error < MATCH_S and (best is None or error < best[0]):
            best = (error, i)
    if best is None:
        return score
    taken.add(best[1])
    told_ns, event = summaries[best[1]]
    times_ns = _times(truth, event)
    score.detected = True
    score.arrival_s = (event.stamp_ns - times_ns[0]) * 1e-9
    score.arrival_sigma_s = event.sigma_s
    departure = event.values.get("departure_ns")
    if isinstance(departure, int):
        score.departure_s = (departure - times_ns[-1]) * 1e-9
    score.latency_s = (told_ns - times_ns[-1]) * 1e-9
    score.found_type = str(event.values.get("type", ""))
    direction = str(event.values.get("direction", "unknown"))
    score.direction_right = None if direction == "unknown" else direction == truth.direction
    estimate = event.values.get("speed")
    if isinstance(estimate, Estimate):
        true_speed = _mid_speed(truth, times_ns)
        score.speed_error = estimate.value / true_speed - 1
        score.speed_sigma = estimate.sigma / true_speed
    low, high = (
        event.stamp_ns - 10**9,
        (departure if isinstance(departure, int) else times_ns[-1]) + 10**9,
    )
    found = np.array([e.stamp_ns for e in axles if low <= e.stamp_ns <= high]) * 1e-9
    times = np.array(times_ns) * 1e-9
    score.axles_found = int(found.size)
    score.axles_right = pair(found, times, AXLE_MATCH * float(np.min(np.diff(times), initial=0.1)))
    return score


def _times(truth: PassageTruth, event: TrainEvent) -> tuple[int, ...]:
    """Times of the wheelsets at the event's reference channel."""
    name = event.values.get("reference")
    if isinstance(name, str) and name in truth.axle_times_ns:
        return truth.axle_times_ns[name]
    for sensor in event.sensors:
        if sensor in truth.axle_times_ns:
            return truth.axle_times_ns[sensor]
    return next(iter(truth.axle_times_ns.values()))


def _mid_speed(truth: PassageTruth, times_ns: Sequence[int]) -> float:
    """True speed as the middle of the train passes (m/s).

    The truth holds times; with the wheelset positions of the preset the motion s(t) follows. Of a
    train that is no preset the mean speed is known, the same unless it accelerates.
    """
    times = np.array(times_ns) * 1e-9
    span = float(next(iter(truth.speed_m_s.values())))
    for name, axle_times in truth.axle_times_ns.items():
        if tuple(axle_times) == tuple(times_ns):
            span = truth.speed_m_s[name]
    if truth.train_type not in preset_names()["train"] or times.size < 4:
        return span
    places = np.array(train_preset(truth.train_type).axle_positions)
    if places.size != times.size:
        return span
    epoch = float(times.mean())
    c, b, a = np.polynomial.polynomial.polyfit(times - epoch, places, 2)
    rest = places[-1] / 2 - c
    return float(np.sqrt(max(b * b + 4 * a * rest, 1e-6)))


def pair(found: Array, true: Array, tolerance: float) -> int:
    """How many of two ascending lists pair one to one within a tolerance."""
    i = j = count = 0
    while i < found.size and j < true.size:
        if abs(found[i] - true[j]) <= tolerance:
            count, i, j = count + 1, i + 1, j + 1
        elif found[i] < true[j]:
            i += 1
        else:
            j += 1
    return count


@dataclass
class Evaluation:
    """Scores of a set of bags."""

    detector: str
    bags: list[BagScore]

    @property
    def passages(self) -> list[PassageScore]:
        """All true passages."""
        return [passage for bag in self.bags for passage in bag.passages]

    def summary(self) -> dict[str, Any]:
        """The figures, by name; errors are absolute unless said."""
        found = [p for p in self.passages if p.detected]
        hours = sum(bag.duration_s for bag in self.bags) / 3600

        def spread(values: Sequence[float | None], scale: float) -> dict[str, float]:
            known = np.abs(np.array([v for v in values if v is not None])) * scale
            if not known.size:
                return {}
            return {
                "median": float(np.median(known)),
                "p95": float(np.percentile(known, 95)),
                "worst": float(known.max()),
            }

        right = sum(p.axles_right for p in found)
        precision = right / max(1, sum(p.axles_found for p in found))
        recall = right / max(1, sum(p.axles_true for p in self.passages))
        ratios = [
            p.speed_error / p.speed_sigma
            for p in found
            if p.speed_error is not None and p.speed_sigma
        ]
        onsets = [p.onset_s for p in found if p.onset_s is not None]
        directions = [p.direction_right for p in found if p.direction_right is not None]
        return {
            "bags": len(self.bags),
            "bags_failed": sum(bool(bag.problem) for bag in self.bags),
            "hours": hours,
            "passages": len(self.passages),
            "detected": len(found) / max(1, len(self.passages)),
            "extra_passages": sum(bag.extra for bag in self.bags),
            "false_alarms_per_hour": sum(bag.alarms for bag in self.bags) / max(hours, 1e-9),
            "onset_after_first_axle_ms": {"latest": max(onsets) * 1e3} if onsets else {},
            "arrival_error_ms": spread([p.arrival_s for p in found], 1e3),
            "departure_error_ms": spread([p.departure_s for p in found], 1e3),
            "latency_s": spread([p.latency_s for p in found], 1.0),
            "speed_error_percent": spread([p.speed_error for p in found], 100.0),
            "speed_sigma_calibration": float(np.sqrt(np.mean(np.square(ratios))))
            if ratios
            else None,
            "speed_within_95_percent": float(np.mean(np.abs(ratios) < 1.96)) if ratios else None,
            "axle_count_right": float(np.mean([p.axles_found == p.axles_true for p in found]))
            if found
            else None,
            "axle_precision": precision,
            "axle_recall": recall,
            "axle_f1": 2 * precision * recall / max(precision + recall, 1e-12),
            "direction_right": float(np.mean(directions)) if directions else None,
            "type_right": float(np.mean([p.found_type == p.train for p in found]))
            if found
            else None,
            "cpu_per_second": sum(bag.cpu_s for bag in self.bags) / max(hours * 3600, 1e-9),
        }

    def confusion(self) -> dict[str, dict[str, int]]:
        """How often each true type was told as which; ``missed`` if not detected."""
        table: dict[str, Counter[str]] = {}
        for p in self.passages:
            told = (p.found_type or "no type") if p.detected else "missed"
            table.setdefault(p.train, Counter())[told] += 1
        return {train: dict(counts) for train, counts in sorted(table.items())}

    def to_json(self) -> str:
        """Everything, passage by passage."""
        return json.dumps(
            {
                "detector": self.detector,
                "summary": self.summary(),
                "confusion": self.confusion(),
                "bags": [asdict(bag) for bag in self.bags],
            },
            indent=1,
        )

    def tables(self) -> list[Table]:
        """Summary and confusion, for a terminal."""
        table = Table(title=f"{self.detector}: {len(self.passages)} passages", title_style="bold")
        table.add_column("figure")
        table.add_column("value", justify="right")

        def text(value: Any) -> str:
            if value is None or value == {}:
                return "-"
            if isinstance(value, dict):
                return ", ".join(f"{name} {number:.3g}" for name, number in value.items())
            return f"{value:.4g}" if isinstance(value, float) else str(value)

        for name, value in self.summary().items():
            table.add_row(name.replace("_", " "), text(value))
        confusion = Table(title="told types by true type", title_style="bold")
        confusion.add_column("true")
        confusion.add_column("told")
        for train, counts in self.confusion().items():
            told = sorted(counts.items(), key=lambda item: -item[1])
            confusion.add_row(train, ", ".join(f"{name} {count}" for name, count in told))
        return [table, confusion]

    def figure(self, path: Path) -> None:
        """Speed error and arrival error over speed, with the stated uncertainty, as PNG.

        Raises:
            InputError: the file exists.
        """
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        if path.exists():
            raise InputError(f"{path} exists: name another file")
        found = [p for p in self.passages if p.detected]
        figure = Figure(figsize=(9, 6), layout="constrained")
        FigureCanvasAgg(figure)
        upper, lower = figure.subplots(2, 1, sharex=True)
        for train in sorted({p.train for p in found}):
            own = [p for p in found if p.train == train and p.speed_error is not None]
            upper.errorbar(
                [p.speed_kmh for p in own],
                [100 * (p.speed_error or 0) for p in own],
                [196 * (p.speed_sigma or 0) for p in own],
                fmt="o",
                markersize=3,
                elinewidth=0.7,
                label=train,
            )
            lower.plot(
                [p.speed_kmh for p in own], [1e3 * (p.arrival_s or 0) for p in own], "o", ms=3
            )
        upper.set_ylabel("speed error (%), bars 95 %")
        lower.set_ylabel("arrival error (ms)")
        lower.set_xlabel("speed (km/h)")
        upper.legend(fontsize="small")
        figure.savefig(path)


def evaluate(
    bags: Sequence[Path],
    detector: str | None = None,
    workers: int = 1,
    progress: Callable[[int, int, str], None] | None = None,
) -> Evaluation:
    """Score a detector over bags; directories of bags are searched.

    Raises:
        InputError: no bag, or the detector cannot be loaded.
    """
    load_factory(detector)
    paths = find_bags(bags)
    scores: list[BagScore] = []
    if workers > 1 and len(paths) > 1:
        with ProcessPoolExecutor(workers) as pool:
            for score in pool.map(_score_safely, paths, [detector] * len(paths)):
                scores.append(score)
                if progress:
                    progress(len(scores), len(paths), score.bag)
    else:
        for path in paths:
            scores.append(_score_safely(path, detector))
            if progress:
                progress(len(scores), len(paths), str(path))
    return Evaluation(detector or "trackvib_ros.detection:TrainDetector", scores)


def _score_safely(path: Path, detector: str | None) -> BagScore:
    try:
        return score_bag(path, detector)
    except Exception as failure:  # a plug-in may raise anything; the other bags still count
        return BagScore(str(path), 0.0, 0.0, problem=f"{type(failure).__name__}: {failure}")


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
