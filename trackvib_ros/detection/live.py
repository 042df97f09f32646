"""What can be told of a train that is not on record as a whole: it still passes, or had begun."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from .calibration import Calibration
from .delay import find_delay
from .head import MOST_UNCERTAIN, Head, HeadMatcher
from .pattern import Trace
from .record import Record
from .strength import CARRIED, excited, strong_interval

AXLE_SPACING = 6.2
"""Track per wheelset of a train on bogies (m), to count how many have passed."""
_END_SIGMA = 0.6  # m, place of the first or last wheelset by the strong energy
_SURE = 0.995
"""Least probability of a delay that nothing else confirms: a wrong one lies beyond any interval and
may take a tenth of the 5 % that one of 95 % misses."""
_CAR = 26.0  # m, a train shows its next bogie within a car


@dataclass(frozen=True)
class Partial:
    """Speed (m/s, sigma) by the part of a train that was seen.

    Attributes:
        speed: with ``sigma`` (m/s).
        direction: +1, -1, or 0 unknown.
        score: correlation, 0 to 1.
        distance: length of train seen (m).
        wheelsets: seen; estimated from the length if no pattern was compared.
        sensors: channels used.
        method: how the speed was obtained.
        types: catalogue types with their probabilities; empty if no pattern was compared.
        families: the same for families.
        start: time (s) and sigma of the first wheelset at the first of the sensors, if on record.
        end: the same of the last wheelset; ``None`` while the train passes.
        x: position of the first of the sensors (m).
    """

    speed: float
    sigma: float
    direction: int
    score: float
    distance: float
    wheelsets: int
    sensors: tuple[str, ...]
    method: str
    types: tuple[tuple[str, float], ...] = ()
    families: tuple[tuple[str, float], ...] = ()
    start: tuple[float, float] | None = None
    end: tuple[float, float] | None = None
    x: float = 0.0


def provisional(
    records: Sequence[Record],
    within: tuple[float, float],
    limits: tuple[float, float],
    matcher: HeadMatcher,
    site: Calibration,
) -> Partial | None:
    """Speed while the train passes: by the delay between the outer two rail channels, or by the
    axle pattern if only one has a signal. ``None`` while it is not clear.
    """
    rails = _excited_rails(records, within)
    if _apart(rails):
        return provisional_delay(rails, within, limits, site)
    if not rails:
        return None
    found = _by_pattern(rails[0], within, matcher)
    # the others may only not have been reached yet
    reach = max(abs(r.channel.x - rails[0].channel.x) for r in records)
    return found if found is not None and found.distance > 1.5 * reach else None


def provisional_delay(
    records: Sequence[Record],
    within: tuple[float, float],
    limits: tuple[float, float],
    site: Calibration,
) -> Partial | None:
    """Speed by the delay between the outer two rail channels; ``None`` while it is not sure."""
    rails = _excited_rails(records, within)
    delay = _by_delay(rails[0], rails[-1], within, limits, site) if _apart(rails) else None
    return delay if delay is not None and delay.score >= _SURE else None


def _excited_rails(records: Sequence[Record], within: tuple[float, float]) -> list[Record]:
    rails = (r for r in records if r.channel.layer == "rail" and excited(r, within))
    return sorted(rails, key=lambda r: r.channel.x)


def _apart(rails: Sequence[Record]) -> bool:
    return len(rails) > 1 and rails[-1].channel.x - rails[0].channel.x >= 2.0


def _by_delay(
    a: Record,
    b: Record,
    within: tuple[float, float],
    limits: tuple[float, float],
    site: Calibration,
) -> Partial | None:
    offset, covariance = site.relative([a.channel.name, b.channel.name])
    baseline = b.channel.x - a.channel.x + float(offset[1])
    found = find_delay(a, b, within, limits, (baseline, float(covariance[1, 1]) ** 0.5))
    if found is None or found.sigma > MOST_UNCERTAIN * found.speed:
        return None
    # what both channels have seen of the train
    later = b if found.direction > 0 else a
    low, high = later.window.bands[found.band]
    interval = strong_interval(later.traces(within)[found.band], high - low, within)
    if interval is None:
        return None
    distance = found.speed * (within[1] - interval[0])
    return Partial(
        found.speed,
        found.sigma,
        found.direction,
        found.probability,
        distance,
        int(max(1.0, distance / AXLE_SPACING)),
        (a.channel.name, b.channel.name),
        "delay of waveform and envelope between two rail channels",
        x=a.channel.x,
    )


def _by_pattern(
    record: Record, within: tuple[float, float], matcher: HeadMatcher
) -> Partial | None:
    best: Head | None = None
    for trace, (low, high) in zip(record.traces(within), record.window.bands, strict=True):
        interval = strong_interval(trace, high - low, within)
        head = interval and matcher.match(trace, interval[0], within[1])
        if head and (best is None or head.score > best.score):
            best = head
    if best is None or not best.clear:
        return None
    return _of_head(best, record, "axle pattern of the first wheelsets")


def _mirrored(trace: Trace) -> Trace:
    """The trace in reversed time, so that the last wheelset comes first."""
    return Trace(
        trace.name,
        trace.x,
        -trace.time[::-1],
        trace.energy[::-1],
        trace.valid[::-1],
        trace.noise,
        trace.step,
    )


def departed(
    records: Sequence[Record],
    within: tuple[float, float],
    limits: tuple[float, float],
    mirrored: HeadMatcher,
    site: Calibration,
) -> tuple[Partial | None, float]:
    """A train whose beginning is not on record, by the pattern of its end.

    Args:
        records: of the rail channels, with the noise after the train as floor.
        within: start of the record, end of the event (s).
        limits: speeds (m/s).
        mirrored: for trains read from their end.
        site: where the channels are.

    Returns:
        ``None`` if it shows no clear pattern; and how long the record is quiet at its start (s),
        infinite if that is longer than a train is.
    """
    rails = sorted((r for r in records if excited(r, within)), key=lambda r: r.channel.x)
    best: tuple[Head, Record, tuple[float, float]] | None = None
    for record in rails:
        start = max(within[0], float(record.window.time[0]))
        for trace, (low, high) in zip(record.traces(within), record.window.bands, strict=True):
            interval = strong_interval(trace, high - low, within)
            if interval is None:
                continue
            head = mirrored.match(_mirrored(trace), -interval[1], -start)
            if head and (best is None or _better(head, best[0])):
                best = head, record, (interval[0] - start, -head.start)
    if best is None:
        return None, np.inf
    head, record, (quiet, end) = best
    if not best[0].clear:
        return None, quiet
    if head.speed * quiet > _CAR:
        return None, np.inf
    found = _of_head(head, record, "axle pattern of the end of the train")
    found = replace(found, end=(end, _edge_sigma(head)))
    return _with_delay(found, rails, within, limits, site), quiet


def arrived(
    records: Sequence[Record],
    within: tuple[float, float],
    limits: tuple[float, float],
    matcher: HeadMatcher,
    site: Calibration,
) -> Partial | None:
    """A train that still passes when the record ends, by the pattern of its beginning.

    Args:
        records: of the rail channels.
        within: the event, to the end of the record (s).
        limits: speeds (m/s).
        matcher: for the first wheelsets.
        site: where the channels are.

    Returns:
        ``None`` if it shows no clear pattern, or if the record ends so quiet that it has passed.
    """
    rails = sorted((r for r in records if excited(r, within)), key=lambda r: r.channel.x)
    best: tuple[Head, Record, float] | None = None
    for record in rails:
        stop = min(within[1], float(record.window.time[-1]))
        for trace, (low, high) in zip(record.traces(within), record.window.bands, strict=True):
            interval = strong_interval(trace, high - low, within)
            if interval is None:
                continue
            head = matcher.match(trace, interval[0], stop)
            if head and (best is None or _better(head, best[0])):
                best = head, record, stop - interval[1]
    if best is None or not best[0].clear or best[0].speed * best[2] > _CAR:
        return None
    head, record, _ = best
    found = _of_head(head, record, "axle pattern of the beginning of the train")
    found = replace(found, start=(head.start, _edge_sigma(head)))
    return _with_delay(found, rails, within, limits, site)


def travelling(
    records: Sequence[Record],
    within: tuple[float, float],
    limits: tuple[float, float],
    site: Calibration,
) -> Partial | None:
    """A train of which the record lacks an end or both, by the delay between two rail channels.

    Its ends are where strong energy begins and ends at the first channel, if in the record.

    Args:
        records: of the rail channels.
        within: the event (s).
        limits: speeds (m/s).
        site: where the channels are.

    Returns:
        ``None`` if nothing surely travels, or if it is on record as a whole.
    """
    found = provisional_delay(records, within, limits, site)
    if found is None:
        return None
    record = next(r for r in records if r.channel.name == found.sensors[0])
    spans = [
        span
        for trace, (low, high) in zip(record.traces(within), record.window.bands, strict=True)
        if (span := strong_interval(trace, high - low, within)) is not None
    ]
    if not spans:
        return None
    first, last = min(start for start, _ in spans), max(end for _, end in spans)
    sigma = CARRIED / found.speed
    begins = first - float(record.window.time[0]) > _CAR / found.speed
    ends = float(record.window.time[-1]) - last > _CAR / found.speed
    if begins and ends:
        return None
    return replace(
        found,
        distance=found.speed * (last - first),
        start=(first, sigma) if begins else None,
        end=(last, sigma) if ends else None,
    )


def _better(head: Head, than: Head) -> bool:
    """Whether a band tells more than another: one in which types look alike tells no speed."""
    return (head.clear, head.score) > (than.clear, than.score)


def _edge_sigma(head: Head) -> float:
    return float(np.hypot(_END_SIGMA / head.speed, 0.005))


def _of_head(head: Head, record: Record, method: str) -> Partial:
    return Partial(
        head.speed,
        head.sigma,
        0,
        head.score,
        head.distance,
        head.passed,
        (record.channel.name,),
        method,
        head.types,
        head.families,
        x=record.channel.x,
    )


def _with_delay(
    found: Partial,
    rails: Sequence[Record],
    within: tuple[float, float],
    limits: tuple[float, float],
    site: Calibration,
) -> Partial:
    """What a pattern told, and the delay between the outer two channels if it agrees."""
    delay = None
    if _apart(rails):
        delay = _by_delay(rails[0], rails[-1], within, limits, site)
    if delay is None or abs(delay.speed - found.speed) > 3 * np.hypot(delay.sigma, found.sigma):
        return found
    weight = np.array([found.sigma, delay.sigma]) ** -2.0
    others = tuple(name for name in delay.sensors if name not in found.sensors)
    speed = float(weight @ [found.speed, delay.speed] / weight.sum())
    return replace(
        found,
        speed=speed,
        distance=found.distance * speed / found.speed,
        sigma=float(weight.sum() ** -0.5),
        direction=delay.direction,
        sensors=(*found.sensors, *others),
        method=f"{found.method}, {delay.method}",
    )
