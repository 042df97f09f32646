"""One finished event: which train, when, how fast, from everything the rail channels show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from .axles import AxleFit, fit_axles
from .blind import Blind, describe
from .catalogue import Catalogue, TrainType
from .events import Channel
from .features import Window
from .kinematics import POSITION_SIGMA, Motion, robust_scale
from .pattern import Match, Trace, refine, scan

Array = NDArray[np.float64]

CONFIRM_SCORE = 0.60
"""Least pattern correlation of a confirmed train."""

KNOWN_SCORE = 0.70
"""Least pattern correlation at which a catalogue type is named."""

CONFIRM_CORRELATION = 0.6
"""Least correlation of the envelopes of two channels for a train of unknown type."""

HOPELESS_SCORE = 0.40
"""Coarse correlation below which no pattern is worth refining."""

_POSTERIOR_TEMPER = 0.5  # all wheelsets meet the same rail: their residuals are not independent
_OFFSET_COST = 12.0  # most that the place of a channel may count against a type
_MODEL_SIGMA = 0.04  # m, systematic residuals of a right type (bogies nod, pulses overlap)
_SCORE_WEIGHT = 120.0
_SCORE_NOISE = 0.03  # scores of equally right types differ by this much
_LOW_BAND_BONUS = 0.06  # of score, by which a higher band must win
_SCALE_DOUBT = 0.12  # a delay off by less speaks of an unknown type, by more of a clock
_DELAY_DOUBT = 0.015  # least disagreement of a delay that excludes a type
_MISFIT_M, _MISFIT_CHI2 = 0.07, 25.0


@dataclass(frozen=True)
class Record:
    """What is known of one channel in an event: features and noise floor per band."""

    channel: Channel
    window: Window
    floor: Array


@dataclass(frozen=True)
class Hypothesis:
    """One catalogue type in one orientation and direction, fitted to all rail channels."""

    train: TrainType
    reverse: bool
    direction: int
    score: float
    fit: AxleFit
    probability: float = 0.0

    @property
    def places(self) -> Array:
        """Distance of every wheelset behind the first (m)."""
        return self.train.oriented(self.reverse)

    @property
    def misfit(self) -> bool:
        """Whether wheelsets in the same place of a car are off by the same amount.

        Residuals are averaged over the wheelsets with the same distances to their neighbours; a
        wrong type leaves means of several centimetres where noise would average out.
        """
        gaps = np.round(np.diff(self.places, prepend=-99.0, append=self.places[-1] + 99.0), 1)
        keys = [f"{a} {b}" for a, b in pairwise(gaps)]
        good = self.fit.observed & (np.abs(self.fit.residual) < 0.5)
        square, chi2, total, within = 0.0, 0.0, 0, 0.0
        groups = []
        for key in set(keys):
            members = np.array([k == key for k in keys])
            values = self.fit.residual[:, members][good[:, members]]
            if values.size >= 4:
                groups.append(values)
                within += float(np.sum((values - values.mean()) ** 2))
                total += values.size
        if total <= len(groups) or not groups:
            return False
        variance = max(within / (total - len(groups)), 0.01**2)
        for values in groups:
            square += values.size / total * float(values.mean()) ** 2
            chi2 += values.size * float(values.mean()) ** 2 / variance
        return bool(square > _MISFIT_M**2 and chi2 > _MISFIT_CHI2)

    @property
    def mid_time(self) -> float:
        """Time at which the middle of the train passes the reference point (s)."""
        return float(self.fit.motion.time_at(0.5 * self.train.span))


@dataclass(frozen=True)
class Passage:
    """The hypotheses about one train, most probable first; empty if no pattern was found.

    Attributes:
        interval: first and last strong energy at the reference channel (s).
        traces: rail channels used, reference first, in the band that was kept.
        direction: +1, -1, or 0 if unknown.
        clock_offset: (channel, offset s, sigma s) for channels whose clock contradicts the motion.
        delay: speed by the delays between two channels (m/s), sigma; or None.
    """

    interval: tuple[float, float]
    traces: tuple[Trace, ...]
    band: tuple[float, float]
    hypotheses: tuple[Hypothesis, ...]
    direction: int
    clock_offset: tuple[tuple[str, float, float], ...] = ()
    delay: tuple[float, float] | None = None
    quality: tuple[str, ...] = ()
    coarse_score: float = 0.0
    blind: Blind | None = None

    @property
    def score(self) -> float:
        """Pattern correlation of the best hypothesis."""
        return self.hypotheses[0].score if self.hypotheses else self.coarse_score

    @property
    def known(self) -> bool:
        """Whether a catalogue type explains the pattern."""
        return (
            bool(self.hypotheses)
            and self.score >= KNOWN_SCORE
            and not self.hypotheses[0].misfit
            and not self.contradicted
        )

    @property
    def contradicted(self) -> bool:
        """Whether the delay between channels excludes the scale of every probable type."""
        if self.delay is None:
            return False
        speed, sigma = self.delay
        for h in self.hypotheses:
            if h.probability > 0.01:
                other = float(h.fit.motion.speed_at(h.mid_time))
                if abs(speed - other) < max(4 * sigma, _DELAY_DOUBT * speed):
                    return False
        return True

    @property
    def confirmed(self) -> bool:
        """Whether this is a train: by its pattern, or by what two channels agree on."""
        if self.hypotheses and self.score >= CONFIRM_SCORE:
            return True
        blind = self.blind
        return (
            blind is not None
            and blind.direction != 0
            and blind.correlation >= CONFIRM_CORRELATION
            and blind.regular >= 0.7
            and blind.times.size >= 8
            and blind.speed[1] < 0.05 * blind.speed[0]
        )


def traces_of(record: Record, within: tuple[float, float]) -> list[Trace]:
    """One trace per band, quiet outside an interval (s)."""
    window = record.window
    return [
        Trace(
            record.channel.name,
            record.channel.x,
            window.time - window.shift[b],
            window.energy[:, b],
            window.valid,
            float(record.floor[b]),
            window.step,
            (within[0] - 0.3, within[1] + 0.3),
        )
        for b in range(len(window.bands))
    ]


def smoothed(trace: Trace, width_s: float) -> Array:
    """Energy averaged over ``width_s`` about every bin."""
    return trace.mean(trace.time - width_s / 2, trace.time + width_s / 2)


def strong(trace: Trace, bandwidth: float, within: tuple[float, float]) -> NDArray[np.bool_]:
    """Bins whose 40 ms energy stands out of the noise and within 12 dB of the strong ones."""
    energy = smoothed(trace, 0.04)
    inside = (trace.time >= within[0]) & (trace.time <= within[1])
    if not inside.any():
        return inside
    top = float(np.percentile(energy[inside], 95))
    freedom = max(2 * bandwidth * 0.04, 2.0)
    limit = max(trace.noise * (1 + 6 * np.sqrt(2 / freedom)), top / 16)
    return np.asarray(inside & (energy > limit))


def strong_interval(
    trace: Trace, bandwidth: float, within: tuple[float, float]
) -> tuple[float, float] | None:
    """First and last strong energy (s)."""
    found = np.flatnonzero(strong(trace, bandwidth, within))
    if found.size < 2:
        return None
    return float(trace.time[found[0]]), float(trace.time[found[-1]])


def quiet_gaps(
    trace: Trace, bandwidth: float, interval: tuple[float, float], least_s: float
) -> list[tuple[float, float]]:
    """Stretches without strong energy, at least ``least_s`` long, inside an interval."""
    times = trace.time[strong(trace, bandwidth, interval)]
    if times.size < 2:
        return []
    gaps = np.diff(times)
    return [(float(times[i]), float(times[i + 1])) for i in np.flatnonzero(gaps > least_s)]


@dataclass(frozen=True)
class _Scanned:
    trace: Trace
    band: tuple[float, float]
    interval: tuple[float, float]
    matches: list[Match]

    @property
    def score(self) -> float:
        return self.matches[0].score if self.matches else 0.0


def _scan_channel(
    record: Record,
    within: tuple[float, float],
    trains: Sequence[TrainType],
    limits: tuple[float, float],
    truncated: bool,
) -> _Scanned | None:
    found = []
    for trace, band in zip(traces_of(record, within), record.window.bands, strict=True):
        interval = strong_interval(trace, band[1] - band[0], within)
        if interval is None:
            continue
        stretch = (0.3, 1.25) if truncated else (0.80, 1.25)
        matches = scan(trace, interval, trains, limits, stretch)
        found.append(_Scanned(trace, band, interval, matches))
    if not found:
        return None
    top = max(s.score for s in found)
    if top < HOPELESS_SCORE:
        return max(found, key=lambda s: s.score)
    # the deflection under a wheel lies at the wheel; high bands peak where the rail is rough
    best = next(s for s in found if s.score > top - _LOW_BAND_BONUS)
    return replace(best, matches=refine(best.trace, best.matches, best.interval))


def _motion(match: Match) -> Motion:
    return Motion(
        match.epoch,
        -match._distance(match.start),
        match.speed,
        match.acceleration,
        np.diag([1.0, 1.0, 1.0]),
    )


def _recentred(match: Match) -> Motion:
    times = match.times()
    return _motion(match).moved(float(0.5 * (times[0] + times[-1])))


def find_passage(
    records: Sequence[Record],
    within: tuple[float, float],
    trains: Sequence[TrainType],
    limits: tuple[float, float],
    truncated: bool = False,
) -> Passage | None:
    """The train in an interval of time, from its rail channels (reference = first by score).

    Args:
        records: rail channels.
        within: the event (s).
        trains: candidate types.
        limits: lowest and highest speed (m/s).
        truncated: the record starts inside the train.
    """
    scanned = [
        found
        for record in records
        if (found := _scan_channel(record, within, trains, limits, truncated)) is not None
    ]
    if not scanned:
        return None
    scanned.sort(key=lambda s: s.trace.x)
    top = max(s.score for s in scanned)
    usable = [s for s in scanned if s.score > max(top - 0.25, 0.3)] or [
        max(scanned, key=lambda s: s.score)
    ]
    reference = usable[0]
    interval = reference.interval
    if reference.score < HOPELESS_SCORE:
        traces = tuple(s.trace for s in scanned)
        passage = Passage(interval, traces, reference.band, (), 0, coarse_score=reference.score)
    else:
        passage = _fit_hypotheses(usable, reference)
    if passage.known:
        return passage
    # an unknown type scales the pattern: then a delay that does not fit accuses no clock
    passage = replace(passage, clock_offset=(), quality=())
    guess = None
    if passage.hypotheses:
        best = passage.hypotheses[0]
        guess = float(best.fit.motion.speed_at(best.mid_time))
    blind = describe([s.trace for s in scanned], scanned[0].interval, limits, guess)
    return replace(passage, blind=blind)


def _direction(
    usable: Sequence[_Scanned], best: Match
) -> tuple[int, list[_Scanned], list[tuple[str, float, float]], tuple[float, float] | None]:
    """Direction from the order of the channels; channels whose clock fits neither direction."""
    starts: dict[str, float] = {}
    for s in usable:
        for match in s.matches:
            if match.train.name == best.train.name and match.reverse == best.reverse:
                starts[s.trace.name] = float(np.median(match.times() - best.times()))
    reference = usable[0]
    votes = []
    offsets: list[tuple[str, float, float]] = []
    scale: tuple[float, float] | None = None
    kept = [reference]
    for s in usable[1:]:
        if s.trace.name not in starts:
            continue
        baseline = s.trace.x - reference.trace.x
        delay = starts[s.trace.name]
        if abs(baseline) < 0.5:
            kept.append(s)
            continue
        # another type of nearly the same pattern may explain the delay where the best does not
        speeds = [m.speed for m in usable[0].matches if m.score > best.score - 0.1]
        error, sign = min(
            (abs(delay - sign * baseline / v) * v, sign) for v in speeds for sign in (1, -1)
        )
        expected = baseline / best.speed
        if error < max(0.8, 0.04 * abs(baseline)):
            votes.append(sign)
            kept.append(s)
        elif abs(abs(delay / expected) - 1) < _SCALE_DOUBT:
            scale = (abs(baseline / delay), 0.05 * best.speed / abs(baseline))
        else:
            offsets.append((s.trace.name, delay - expected, 0.5 / best.speed))
    if not votes or abs(sum(votes)) != len(votes):
        return 0, [reference] if votes else kept, offsets, scale
    return votes[0], kept, offsets, scale


def _fit_hypotheses(usable: Sequence[_Scanned], reference: _Scanned) -> Passage:
    best = reference.matches[0]
    direction, kept, offsets, scale = _direction(usable, best)
    table: dict[tuple[str, bool], list[float]] = {}
    for s in kept:
        for match in s.matches:
            table.setdefault((match.train.name, match.reverse), []).append(match.score)
    hypotheses: list[Hypothesis] = []
    for match in reference.matches:
        score = sum(table[match.train.name, match.reverse]) / len(kept)
        if score < best.score - 0.25:
            continue
        places = match.train.oriented(match.reverse)
        sign = direction or 1
        shifts = [sign * (s.trace.x - reference.trace.x) for s in kept]
        fit = fit_axles([s.trace for s in kept], [places + d for d in shifts], _recentred(match))
        if not np.isfinite(fit.scale) or not 0.5 * match.speed < fit.motion.speed:
            continue
        hypotheses.append(Hypothesis(match.train, match.reverse, direction, score, fit))
    hypotheses = ranked(hypotheses)
    passage = Passage(
        interval=reference.interval,
        traces=tuple(s.trace for s in kept),
        band=reference.band,
        hypotheses=tuple(hypotheses),
        direction=direction,
        clock_offset=tuple(offsets),
        quality=("unsynchronised",) if offsets else (),
        delay=scale,
    )
    if hypotheses and direction:
        passage = replace(passage, delay=delay_speed(passage))
    return passage


def ranked(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Hypotheses with their probabilities, most probable first.

    The profile likelihood of Gaussian residuals, N ln(scale), and the pattern correlation.
    """
    if not hypotheses:
        return []
    # residuals of different hypotheses must be compared with the same outliers
    spreads = []
    for h in hypotheses:
        residual = np.clip(h.fit.residual[h.fit.observed], -0.4, 0.4)
        spreads.append(float(np.sqrt(np.mean(residual**2) + _MODEL_SIGMA**2)))
    least = min(spreads)
    # the clearest of the fits tells how well the pulses give the places of the channels
    anchor = min(float(h.fit.anchor_sigma.max()) for h in hypotheses)
    place = 2**0.5 * float(np.hypot(POSITION_SIGMA, anchor))
    top = max(h.score for h in hypotheses)
    logs = []
    for h, spread in zip(hypotheses, spreads, strict=True):
        count = int(h.fit.observed.sum())
        log = -_POSTERIOR_TEMPER * count * np.log(spread / least)
        log -= 0.5 * min(float(np.sum((h.fit.offset / place) ** 2)), _OFFSET_COST)
        logs.append(log - _SCORE_WEIGHT * max(0.0, top - h.score - _SCORE_NOISE))
    weights = np.exp(np.array(logs) - max(logs))
    weights /= weights.sum()
    out = [replace(h, probability=float(p)) for h, p in zip(hypotheses, weights, strict=True)]
    return sorted(out, key=lambda h: -h.probability)


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
    place = np.hypot(POSITION_SIGMA, fit.anchor_sigma[[a, b]])
    baseline = float(np.hypot(*place)) / (x[b] - x[a])
    return speed, speed * float(np.hypot(sigma / mean, baseline))


def excited(record: Record, within: tuple[float, float]) -> bool:
    """Whether a channel shows energy well above its floor in an interval, on enough valid bins."""
    inside = (record.window.time >= within[0]) & (record.window.time <= within[1])
    inside &= record.window.valid
    if inside.sum() < 50:
        return False
    strongest = np.percentile(record.window.energy[inside], 98, axis=0)
    return bool(np.max(strongest / record.floor) > 3.0)


def find_passages(
    records: Sequence[Record],
    within: tuple[float, float],
    catalogue: Catalogue,
    limits: tuple[float, float],
    truncated: bool = False,
) -> list[Passage]:
    """Every train in an event, in order of time: at the longest pauses, two are tried for one."""
    rails = [r for r in records if r.channel.layer == "rail" and excited(r, within)]
    if not rails:
        return []
    whole = find_passage(rails, within, catalogue.types, limits, truncated)
    if whole is None:
        return []
    return _divided(rails, within, whole, catalogue, limits, truncated, depth=3)


def _divided(
    rails: Sequence[Record],
    within: tuple[float, float],
    whole: Passage,
    catalogue: Catalogue,
    limits: tuple[float, float],
    truncated: bool,
    depth: int,
) -> list[Passage]:
    trace = whole.traces[0]
    gaps = quiet_gaps(trace, whole.band[1] - whole.band[0], within, 0.6)
    if whole.score > 0.8 or depth == 0:
        return [whole]
    for gap in sorted(gaps, key=lambda g: g[0] - g[1])[:3]:
        middle = 0.5 * (gap[0] + gap[1])
        halves = ((within[0], middle), (middle, within[1]))
        parts = []
        for half, cut in zip(halves, (truncated, False), strict=True):
            part = find_passage(rails, half, catalogue.types, limits, cut)
            if part is None or not part.confirmed:
                break
            parts.append(part)
        if len(parts) == 2 and parts[0].score + parts[1].score > 2 * whole.score + 0.1:
            return [
                found
                for half, part, cut in zip(halves, parts, (truncated, False), strict=True)
                for found in _divided(rails, half, part, catalogue, limits, cut, depth - 1)
            ]
    return [whole]
