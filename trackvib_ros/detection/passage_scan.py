"""Which types the rail channels show, one by one and in step, and how each channel lags."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .catalogue import TrainType
from .evidence import PRIOR_CLOCK, PRIOR_UNKNOWN
from .kinematics import Motion
from .pattern import FASTEST, SLOWEST, Match, Trace, independent, refine, scan, stretched
from .place import Wave
from .record import Record
from .strength import CORE, strong_interval, struck

Array = NDArray[np.float64]

HOPELESS_SCORE = 0.40
"""Coarse correlation below which no pattern is worth refining."""

# what the rail carries beyond a train may last as long, and clipping makes it strong
_MOST_CARRIED = 1.6

_LOW_BAND_BONUS = 0.06  # of score, by which a higher band must win
_STRETCH = (
    1.25  # a delay that fits no type better than this is a clock's fault, not an unknown type
)
_STRETCH_STEP = 0.02  # 0.4 m of 20 m, within the smoothing of the scan


@dataclass(frozen=True)
class Scanned:
    """What one channel shows of the types.

    Attributes:
        trace: energy in the band that shows most.
        low: energy in the lowest band.
        wave: low-passed waveform.
        band: of the trace (Hz).
        interval: first and last strong energy (s).
        stretch: speeds tried, as fractions of span over duration of the interval.
        matches: types, best first.
    """

    trace: Trace
    low: Trace
    wave: Wave
    band: tuple[float, float]
    interval: tuple[float, float]
    stretch: tuple[float, float]
    matches: list[Match]

    @property
    def score(self) -> float:
        """Pattern correlation of the best type."""
        return self.matches[0].score if self.matches else 0.0


def scan_channel(
    record: Record,
    within: tuple[float, float],
    trains: Sequence[TrainType],
    limits: tuple[float, float],
    alone: bool,
) -> Scanned | None:
    """What a channel shows in an interval (s); ``None`` if nothing stands out of its noise.

    Args:
        record: of the channel.
        within: the event (s).
        trains: candidate types.
        limits: lowest and highest speed (m/s).
        alone: whether it is the only channel.
    """
    found = []
    whole = record.traces(within)
    window = record.window
    wave = record.wave(within)
    for trace, limited, band in zip(
        whole, record.traces(within, limited=True), window.bands, strict=True
    ):
        ways = []
        for t in (trace, limited) if struck(trace, limited, within) else (trace,):
            interval = strong_interval(t, band[1] - band[0], within)
            if interval is None:
                continue
            core = strong_interval(t, band[1] - band[0], within, CORE) or interval
            carried = min((interval[1] - interval[0]) / max(core[1] - core[0], 1e-3), _MOST_CARRIED)
            # one channel that is not clipped had better not try what it need not
            stretch = SLOWEST, FASTEST * (1.0 if alone and not wave.clipped else carried)
            matches = scan([(t, 0.0)], interval, trains, limits, stretch)
            ways.append(Scanned(t, whole[0], wave, band, interval, stretch, matches))
        if not ways:
            continue
        found.append(max(ways, key=lambda s: s.score))
    if not found:
        return None
    top = max(s.score for s in found)
    # the deflection under a wheel lies at the wheel; high bands peak where the rail is rough
    return next(
        s for s in found if s.score >= top - (_LOW_BAND_BONUS if top > HOPELESS_SCORE else 0)
    )


@dataclass(frozen=True)
class Seen:
    """Types in the rail channels, best first, and how each channel lags behind the first (s)."""

    matches: list[Match]
    direction: int
    kept: list[tuple[Scanned, float]]


def _in_step(
    usable: Sequence[Scanned], trains: Sequence[TrainType], limits: tuple[float, float]
) -> Seen | None:
    """The types in all channels at once: every wheelset passes each after its distance.

    ``None`` if the channels one by one show so much more that a wrong clock is likelier.
    """
    reference = usable[0]
    apart = [s.trace.x - reference.trace.x for s in usable]
    if max(apart) < 0.5:
        return None
    duration = max(s.interval[1] - s.interval[0] for s in usable)
    middle = float(np.mean([sum(s.interval) / 2 for s in usable]))
    interval = (middle - duration / 2, middle + duration / 2)
    stretch = SLOWEST, max(s.stretch[1] for s in usable)
    best: tuple[int, list[Match]] | None = None
    for direction in (1, -1):
        placed = [(s.trace, direction * x) for s, x in zip(usable, apart, strict=True)]
        matches = scan(placed, interval, trains, limits, stretch)
        if matches and (best is None or matches[0].score > best[1][0].score):
            best = direction, matches
    if best is None or best[1][0].score < HOPELESS_SCORE:
        return None
    direction, matches = best
    placed = [(s.trace, direction * x) for s, x in zip(usable, apart, strict=True)]
    factors = np.exp(np.arange(-np.log(_STRETCH), np.log(_STRETCH) + 1e-9, _STRETCH_STEP))
    scores = stretched(placed, matches[0], interval, factors)
    levels = independent(matches[0].train.span) * len(usable) / 2
    alone = _alone(usable)
    factor = 1.0
    if levels * np.log((1 - matches[0].score ** 2) / (1 - scores.max() ** 2)) > -np.log(
        PRIOR_UNKNOWN
    ):
        factor = float(factors[np.argmax(scores)])
    shown = max(matches[0].score, float(scores.max()))
    if levels * (np.log(1 - shown**2) - alone) > -np.log(PRIOR_CLOCK):
        return None
    placed = [(trace, factor * shift) for trace, shift in placed]
    matches = refine(placed, matches, interval)
    speed = matches[0].speed
    kept = [(s, shift / speed) for s, (_, shift) in zip(usable, placed, strict=True)]
    return Seen(matches, direction, kept)


def _alone(usable: Sequence[Scanned]) -> float:
    """ln of the part that the likeliest type leaves of the channels one by one, on average.

    What a wrong clock explains is one train: a type that each channel shows best by itself is none.
    """
    left: dict[tuple[str, bool], list[float]] = {}
    for s in usable:
        best: dict[tuple[str, bool], float] = {}
        for match in s.matches:
            key = match.train.name, match.reverse
            best[key] = max(best.get(key, 0.0), match.score)
        for key, score in best.items():
            left.setdefault(key, []).append(float(np.log(1 - score**2)))
    common = [sum(logs) / len(logs) for logs in left.values() if len(logs) == len(usable)]
    return min(common, default=0.0)


def _one_by_one(usable: Sequence[Scanned]) -> Seen:
    """The types in the first channel, with what the others show of them."""
    fine = [replace(s, matches=refine([(s.trace, 0.0)], s.matches, s.interval)) for s in usable]
    direction, kept = _delays(fine, fine[0].matches[0])
    table: dict[tuple[str, bool], float] = {}
    for s, _ in kept:
        for match in s.matches:
            key = (match.train.name, match.reverse)
            table[key] = table.get(key, 0.0) + match.score / len(kept)
    matches = [
        replace(match, score=table[match.train.name, match.reverse]) for match in fine[0].matches
    ]
    return Seen(matches, direction, kept)


def _motion(match: Match) -> Motion:
    return Motion(
        match.epoch,
        -match._distance(match.start),
        match.speed,
        match.acceleration,
        np.diag([1.0, 1.0, 1.0]),
    )


def recentred(match: Match) -> Motion:
    """The motion of a match, about the middle of its times."""
    times = match.times()
    return _motion(match).moved(float(0.5 * (times[0] + times[-1])))


def _delays(usable: Sequence[Scanned], best: Match) -> tuple[int, list[tuple[Scanned, float]]]:
    """Direction by the order of the channels, and their delays (s).

    A delay that no speed explains is kept: whether a clock or the type is wrong is for the evidence
    to say.
    """
    reference = usable[0]
    kept = [(reference, 0.0)]
    votes: list[int] = []
    doubted: list[int] = []
    for s in usable[1:]:
        delays = [
            float(np.median(m.times() - best.times()))
            for m in s.matches
            if m.train.name == best.train.name and m.reverse == best.reverse
        ]
        if not delays:
            continue
        baseline, delay = s.trace.x - reference.trace.x, delays[0]
        expected = min(
            (baseline / best.speed, -baseline / best.speed), key=lambda e: abs(delay - e)
        )
        kept.append((s, delay))
        if abs(baseline) < 0.5:
            continue
        fits = (
            abs(delay - expected) * best.speed < 0.8 or 1 / _STRETCH < delay / expected < _STRETCH
        )
        (votes if fits else doubted).append(1 if delay * baseline > 0 else -1)
    votes = votes or doubted
    if votes and abs(sum(votes)) != len(votes):
        return 0, [(reference, 0.0)]
    return (votes[0] if votes else 0), kept


def see(
    usable: Sequence[Scanned], trains: Sequence[TrainType], limits: tuple[float, float]
) -> Seen:
    """The types that the channels show, in step unless a clock is likelier to be wrong."""
    return _in_step(usable, trains, limits) or _one_by_one(usable)
