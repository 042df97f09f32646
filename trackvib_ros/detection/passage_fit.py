"""The types that channels show, fitted to their waveforms and weighed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .axles import AxleFit, Timed, fit_axles, refit, timed
from .calibration import Calibration, Measured
from .catalogue import TrainType
from .evidence import LIKELY, LISTED, Candidate, Explanation, Kind, clock_density, explain
from .kinematics import Motion, robust_scale
from .passage import Hypothesis, Passage
from .passage_scan import Scanned, recentred, see
from .pattern import Match

Array = NDArray[np.float64]

CERTAIN = 0.99
"""Probability of a type, by its pattern alone, that teaches where the channels are."""

_HOPELESS = 0.25  # of score, behind the best type
_HARDLY = 1e-12  # probability, below one in a million if places were free: moved ones are weighed
_TWIN = 0.1  # m, places of two types that differ by no more but their size have the same times
_UNSTATED = 5.0  # m, distance between channels of no use


def fit_hypotheses(
    usable: Sequence[Scanned],
    trains: Sequence[TrainType],
    limits: tuple[float, float],
    site: Calibration,
) -> Passage:
    """The train that channels show: the types fitted to them, with their probabilities.

    Args:
        usable: channels that show a pattern, reference first.
        trains: candidate types.
        limits: lowest and highest speed (m/s).
        site: where the channels are.
    """
    reference = usable[0]
    seen = see(usable, trains, limits)
    direction, kept = seen.direction, seen.kept
    fitted: list[Hypothesis] = []
    aligned: list[Sequence[Array]] = []
    names = tuple(s.trace.name for s, _ in kept)
    stated = np.array([s.trace.x - reference.trace.x for s, _ in kept])
    offset, covariance = site.relative(names)
    shifts = (direction or 1) * (stated + offset)
    rails, waves = [s.trace for s, _ in kept], tuple(s.wave for s, _ in kept)
    rough: list[tuple[Match, Timed]] = []
    for match in seen.matches:
        if match.score < seen.matches[0].score - _HOPELESS:
            continue
        # where the pattern was seen; whether the distance agrees is for the evidence to say
        places = match.train.oriented(match.reverse)
        own = [places + delay * match.speed for _, delay in kept]
        rough.append((match, timed(rails, own, recentred(match))))
    likely = [t for match, t in rough if match.score > seen.matches[0].score - LIKELY]
    deflected = not any(t.close for t in likely)
    for match, found in rough:
        fit = fit_axles(rails, found, [s.low for s, _ in kept], waves, deflected)
        if np.isfinite(fit.scale) and 0.5 * match.speed < fit.motion.speed:
            aligned.append(found.places)
            fitted.append(Hypothesis(match.train, match.reverse, direction, match.score, fit))
    fitted = _same_times(fitted, aligned)
    candidates = [Candidate(h.places, shifts, h.fit, h.score, covariance, waves) for h in fitted]
    explanations = explain(candidates)
    off, moved = _wrong(explanations, "clock"), _wrong(explanations, "moved")
    if off is not None and (moved is None or off[1] > moved[1]):
        best, _ = off
        k = best.channel
        wrong = kept[k][0]
        rest = [s for s in usable if s.trace is not wrong.trace]
        passage = fit_hypotheses(rest, trains, limits, site)
        delay = _late(fitted[best.candidate].fit, best, candidates[best.candidate].places)
        told = _clock_offset(delay, float(stated[k]) / best.motion.speed, passage.direction)
        told = told[0], float(np.hypot(told[1], 0.2 / best.motion.speed))
        # a wrong clock is another distance at every speed, a moved sensor is not: more will tell
        measured = _measure(candidates, names, direction * stated, direction) if direction else None
        return replace(
            passage,
            measured=measured,
            clock_offset=(*passage.clock_offset, (wrong.trace.name, *told)),
            quality=tuple({*passage.quality, "unsynchronised"}),
        )
    hypotheses = _with_probabilities(fitted, explanations)
    passage = Passage(
        interval=reference.interval,
        traces=tuple(s.trace for s, _ in kept),
        band=reference.band,
        hypotheses=tuple(hypotheses),
        direction=direction,
        explanations=tuple(explanations),
    )
    if hypotheses and direction:
        last = int(np.argmax(np.abs(stated)))
        share = np.zeros(len(candidates))
        np.add.at(share, [e.candidate for e in explanations], [e.probability for e in explanations])
        asked = [c for c, p in zip(candidates, share, strict=True) if p > _HARDLY]
        measured = _measure(asked, names, direction * stated, direction)
        passage = replace(
            passage,
            delay=delay_speed(passage) if moved is None else None,
            measured=measured,
            baseline=(float(offset[last]), float(covariance[last, last] ** 0.5), site.passages),
        )
        if moved is not None and measured is not None:
            k = moved[0].channel
            by = float(measured.offset[k]), float(measured.covariance[k, k] ** 0.5)
            passage = replace(passage, moved=((names[k], *by),), quality=("moved",))
    return passage


def _wrong(explanations: Sequence[Explanation], kind: Kind) -> tuple[Explanation, float] | None:
    """The best explanation by a wrong clock or place, and the probability of all of its kind.

    ``None`` if what is wrong with a channel is less likely than the rest.
    """
    wrong = [e for e in explanations if e.kind in ("clock", "moved")]
    same = [e for e in wrong if e.kind == kind]
    if not same or sum(e.probability for e in wrong) <= 0.5:
        return None
    return same[0], sum(e.probability for e in same)


def _late(fit: AxleFit, found: Explanation, places: Array) -> float:
    """By how much wheelsets pass the channel of an explanation later than the reference (s)."""
    k = found.channel
    seen = fit.observed[k] if fit.observed[k].any() else slice(None)
    return float(np.median((fit.time[k] - found.motion.time_at(places))[seen]))


def _clock_offset(delay: float, way: float, direction: int) -> tuple[float, float]:
    """Offset of a clock (s) with its sigma.

    Args:
        delay: of a channel behind the reference as recorded (s).
        way: that of a train in forward direction (s).
        direction: of the train; 0 if unknown, then the smaller offset is the likelier.
    """
    if direction:
        return delay - direction * way, 0.0
    ways = sorted((delay - way, delay + way), key=abs)
    near, far = (clock_density(offset) for offset in ways)
    return ways[0], float((far / (near + far)) ** 0.5) * 2 * abs(way)


def _same_times(
    trains: Sequence[Hypothesis], aligned: Sequence[Sequence[Array]]
) -> list[Hypothesis]:
    """Types of one shape with the same wheelset times, those of the closest fit.

    A pulse mistaken under one of them must not decide between types that differ by a per cent.
    """
    out = []
    for own, places in zip(trains, aligned, strict=True):
        twins = [h for h in trains if _one_shape(h.places, own.places)]
        closest = min(twins, key=lambda h: h.fit.scale)
        fit = own.fit if closest is own else refit(closest.fit, places)
        out.append(replace(own, fit=fit))
    return out


def _one_shape(a: Array, b: Array) -> bool:
    """Whether places (m) differ by no more than their size."""
    if a.size != b.size:
        return False
    return float(np.max(np.abs(a * (a @ b) / (a @ a) - b))) < _TWIN


def _measure(
    candidates: Sequence[Candidate], names: tuple[str, ...], stated: Array, direction: int
) -> Measured | None:
    """Where the channels are, from a train that its pattern alone tells."""
    free = _UNSTATED**2 * (np.eye(len(names)) + 1.0)
    free[0] = free[:, 0] = 0.0
    alone = [replace(c, shifts=stated, site=free) for c in candidates]
    best = explain(alone)[0]
    if best.kind != "type" or best.probability < CERTAIN:
        return None
    fit = candidates[best.candidate].fit
    if not fit.used.any(axis=1).all():
        return None
    ahead = best.motion.distance_at(fit.time) - candidates[best.candidate].places
    shift = np.array([np.median(row[seen]) for row, seen in zip(ahead, fit.used, strict=True)])
    less = np.eye(len(names)) - np.eye(len(names))[0]  # of every channel, less the first
    covariance = less @ (fit.place + np.diag(fit.scale**2 / fit.used.sum(axis=1))) @ less.T
    return Measured(names, direction * (shift - shift[0] - stated), covariance)


def _with_probabilities(
    trains: Sequence[Hypothesis], explanations: Sequence[Explanation]
) -> list[Hypothesis]:
    """Types with their probabilities and their motion, most probable first.

    If no type of the catalogue is likely, the order is that of the relatives.
    """
    total = np.zeros(len(trains))
    related = np.zeros(len(trains))
    motion: dict[int, Motion] = {}
    phase: dict[int, float] = {}
    unknown = sum(e.probability for e in explanations if e.kind in ("scaled", "varied")) > 0.5
    for e in explanations:
        if listed := e.kind in LISTED:
            total[e.candidate] += e.probability
            phase[e.candidate] = e.phase
        related[e.candidate] += e.probability
        if listed != unknown:
            motion.setdefault(e.candidate, e.motion)
    order = np.argsort(-(related if unknown else total))
    return [
        replace(
            trains[i],
            probability=float(total[i]),
            phase=phase.get(int(i), 0.0),
            fit=replace(trains[i].fit, motion=motion.get(int(i), trains[i].fit.motion)),
        )
        for i in order
    ]


def delay_speed(passage: Passage) -> tuple[float, float] | None:
    """Mean speed (m/s, sigma) at mid-train from wheelset delays between the outer two channels.

    Needs the pairing of wheelsets only, not their spacing: independent of the catalogue.
    """
    best = passage.hypotheses[0]
    if len(passage.traces) < 2:
        return None
    fit = best.fit
    x = np.array([trace.x for trace in passage.traces])
    a, b = int(np.argmin(x)), int(np.argmax(x))
    both = fit.used[a] & fit.used[b]
    if both.sum() < 4 or x[b] - x[a] < 0.5:
        return None
    delay = np.abs(fit.time[b, both] - fit.time[a, both])
    expected = np.abs(
        fit.motion.time_at(best.places[both] + passage.direction * (x[b] - passage.traces[0].x))
        - fit.motion.time_at(best.places[both] + passage.direction * (x[a] - passage.traces[0].x))
    )
    ratio = delay / expected
    centre = float(np.median(ratio))
    spread = max(robust_scale(ratio - centre, 1), 1e-6)
    good = np.abs(ratio - centre) < 4 * spread
    mean = float(ratio[good].mean())
    sigma = max(float(ratio[good].std(ddof=1)), 1e-6) / np.sqrt(good.sum())
    speed = float(fit.motion.speed_at(best.mid_time)) / mean
    baseline = fit.apart(a, b) ** 0.5 / (x[b] - x[a])
    return speed, speed * float(np.hypot(sigma / mean, baseline))
