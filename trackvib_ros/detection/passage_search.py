"""One finished event: which trains, when, how fast, from everything the rail channels show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from . import struck
from .blind import CONFIDENT, at_site, describe, describe_alone
from .bowl import WAVENUMBER, Corner, corner
from .calibration import Calibration
from .catalogue import Catalogue, TrainType
from .passage import CONFIRM_SCORE, Passage
from .passage_fit import CERTAIN, fit_hypotheses
from .passage_scan import HOPELESS_SCORE, scan_channel
from .record import Record
from .single import Shown
from .strength import excited, quiet_gaps

_EXACT = 0.1  # m, scatter of wheelsets at which no unlisted train is mistaken for their type
_AROUND_S = 0.5  # s, of an interval of strong energy that belongs to its train


def find_passage(
    records: Sequence[Record],
    within: tuple[float, float],
    trains: Sequence[TrainType],
    limits: tuple[float, float],
    site: Calibration,
    unlisted: bool = True,
) -> Passage | None:
    """The train in an interval of time, from its rail channels (reference = first by score).

    Args:
        records: rail channels.
        within: the event (s).
        trains: candidate types.
        limits: lowest and highest speed (m/s).
        site: where the channels are.
        unlisted: whether to describe what no type explains, and to try types that explain little.
    """
    scanned = [
        found
        for record in records
        if (found := scan_channel(record, within, trains, limits, len(records) == 1)) is not None
    ]
    if not scanned:
        return None
    scanned.sort(key=lambda s: s.trace.x)
    top = max(s.score for s in scanned)
    usable = [s for s in scanned if s.score > max(top - 0.25, 0.3)] or [
        max(scanned, key=lambda s: s.score)
    ]
    reference = usable[0]
    if top < (HOPELESS_SCORE if unlisted else CONFIRM_SCORE):
        traces = tuple(s.trace for s in scanned)
        passage = Passage(reference.interval, traces, reference.band, (), 0, coarse_score=top)
    else:
        passage = fit_hypotheses(usable, trains, limits, site)
    if not unlisted or passage.known:
        return passage
    if len(records) < 2:
        return passage
    blind = describe(records, within, reference.interval, limits, reference.trace.limited)
    blind = blind and at_site(blind, site)
    if blind is not None and blind.travels and passage.clock_offset:
        # an unlisted train is likelier than a pattern at either channel and a wrong clock
        return replace(
            passage,
            hypotheses=(),
            coarse_score=passage.score,
            clock_offset=(),
            quality=(),
            blind=blind,
        )
    return replace(passage, blind=blind)


def find_passages(
    records: Sequence[Record],
    within: tuple[float, float],
    catalogue: Catalogue,
    limits: tuple[float, float],
    site: Calibration | None = None,
    unlisted: bool = True,
) -> list[Passage]:
    """Every train in an event, in order of time: at the longest pauses, two are tried for one.

    Without ``unlisted`` none that no type explains, quicker.
    """
    site = site or Calibration.untaught([r.channel for r in records])
    rails = [r for r in records if r.channel.layer == "rail" and excited(r, within)]
    if not rails:
        return []
    whole = find_passage(rails, within, catalogue.types, limits, site, unlisted)
    if whole is None:
        return []
    found = _divided(rails, within, whole, catalogue, limits, site, unlisted, depth=3)
    if unlisted and len(rails) > 1 and not any(p.known or _counted(p) for p in found):
        hidden = struck.find(rails, within, catalogue.types, limits)
        return found if hidden is None else [hidden]
    if len(rails) > 1 or not unlisted:
        return found
    return [
        p
        if p.known and p.hypotheses[0].fit.scale < _EXACT
        else _described(rails[0], within, p, limits, site)
        for p in found
    ]


def _apart(part: Passage, whole: Passage) -> bool:
    """Whether a part of what may be one train can be a train of its own.

    What is one, by its type or as it travels, is not two before a sensor that is late or elsewhere,
    nor is a listed one two of which one is not.
    """
    one = whole.known or (whole.blind is not None and whole.blind.travels)
    if not part.confirmed or (one and (part.clock_offset or part.moved)):
        return False
    return part.known or not whole.known


def _counted(passage: Passage) -> bool:
    """Whether the wheelsets of a train of no listed type were seen."""
    blind = passage.blind
    return blind is not None and blind.travels and blind.regular >= CONFIDENT


def bowl_of(record: Record, passage: Passage) -> Corner | None:
    """The corner of the deflection that a train of a known type shows at a rail channel.

    ``None`` if the type, or the deflection, is not beyond doubt.
    """
    best = passage.hypotheses[0]
    wave = record.wave()
    if best.probability < CERTAIN:
        return None
    apart = passage.direction * (record.channel.x - passage.traces[0].x)
    if passage.direction == 0 and record.channel.name != passage.traces[0].name:
        return None
    motion = best.fit.motion
    times = motion.time_at(best.places + apart)
    found = corner(wave, times, WAVENUMBER * motion.speed)
    found = found and corner(wave, found.times, found.value)
    return found if found is not None and found.worth(placed=True) > 0 else None


def _described(
    record: Record,
    within: tuple[float, float],
    passage: Passage,
    limits: tuple[float, float],
    site: Calibration,
) -> Passage:
    """What the only rail channel tells of a train that no type explains, or not beyond doubt."""
    guess = None
    if passage.hypotheses:
        best = passage.hypotheses[0]
        guess = float(best.fit.motion.speed_at(best.mid_time))
    start, end = passage.interval
    alone = (max(within[0], start - _AROUND_S), min(within[1], end + _AROUND_S))
    band = record.window.bands.index(passage.band)
    bowl = site.wavenumber(record.channel.name)
    shown = Shown(record, alone, passage.interval, limits, guess, band, bowl)
    blind = describe_alone(shown)
    if not passage.known:
        return replace(passage, blind=blind)
    best = passage.hypotheses[0]
    if blind is None or not blind.contradicts(best.places, best.fit.motion, shown.wave):
        return passage
    return replace(passage, blind=blind, contradicted=True)


def _divided(
    rails: Sequence[Record],
    within: tuple[float, float],
    whole: Passage,
    catalogue: Catalogue,
    limits: tuple[float, float],
    site: Calibration,
    unlisted: bool,
    depth: int,
) -> list[Passage]:
    trace, types = whole.traces[0], catalogue.types
    gaps = quiet_gaps(trace, whole.band[1] - whole.band[0], within, 0.6)
    if whole.score > 0.8 or depth == 0:
        return [whole]
    # a part in which something travels gives the whole most of its delay
    travels = whole.known or (whole.blind is not None and whole.blind.direction != 0)
    for gap in sorted(gaps, key=lambda g: g[0] - g[1])[:3]:
        middle = 0.5 * (gap[0] + gap[1])
        halves = ((within[0], middle), (middle, within[1]))
        parts: list[Passage] = []
        for half in halves:
            part = find_passage(rails, half, types, limits, site, unlisted and travels)
            if part is None or not _apart(part, whole):
                break
            parts.append(part)
        better = len(parts) == 2 and parts[0].score + parts[1].score > 2 * whole.score + 0.1
        if better and parts[0].ahead_of(parts[1]) > catalogue.longest_gap:
            if unlisted and not travels and not all(part.known for part in parts):
                tried = [find_passage(rails, half, types, limits, site) for half in halves]
                parts = [part for part in tried if part is not None]
            return [
                found
                for half, part in zip(halves, parts, strict=True)
                for found in _divided(
                    rails, half, part, catalogue, limits, site, unlisted, depth - 1
                )
            ]
    return [whole]
