"""One finished event: which train, when, how fast, from everything the rail channels show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .axles import AxleFit, fit_axles, refit
from .blind import Blind, at_site, describe, describe_alone
from .bowl import WAVENUMBER, Corner, corner
from .calibration import Calibration, Measured
from .catalogue import Catalogue, TrainType
from .evidence import PRIOR_CLOCK, PRIOR_UNKNOWN, Candidate, Explanation, explain
from .health import clipped
from .kinematics import Motion, robust_scale
from .pattern import FASTEST, SLOWEST, Match, Trace, independent, refine, scan, stretched
from .place import Wave
from .record import Record

Array = NDArray[np.float64]

CONFIRM_SCORE = 0.60
"""Least pattern correlation of a confirmed train."""

KNOWN_SCORE = 0.62
"""Least pattern correlation at which a catalogue type is named."""

SCATTERED = 0.45
"""Scatter (m) of wheelsets about their places at which these tell too little: in windows of 2.2 m
pulses that have nothing to do with the type scatter by 0.635 m; here half of that variance is
left."""

SCATTERED_SCORE = 0.70
"""Least pattern correlation at which a type is named by the pattern of one channel alone."""

CLOCK_SCORE = 0.85
"""Least pattern correlation at which a clock, and not an unlisted train, is held responsible for
delays that no type explains: patterns of unlisted trains correlate with listed ones up to 0.83."""

SEEN = 0.5
"""ln of energy (2 dB) by which a wheelset that is seen rises over what is beside it."""

IN_STEP_SCORE = 0.535
"""Least pattern correlation of two channels in step, of a train whose deflection shows it too: as
significant as :data:`SCATTERED_SCORE` of one (1 - r² is the root of that of one)."""

IN_PHASE = 30.0
"""ln of the likelihood at which the deflection shows a train: odds of e^20 after all its trials."""

LEAST_SEEN = 8
"""Wheelsets of a pattern (two cars) to be seen on one channel, all where a train has fewer: three
blows of a hammer in the right places have the correlation of a railcar on three bogies."""

HOPELESS_SCORE = 0.40
"""Coarse correlation below which no pattern is worth refining."""

_CERTAIN = 0.99
"""Probability of a type, by its pattern alone, that teaches where the channels are."""

# of the rise (ln) of all wheelsets, least one of those of two cars at either end: about 0 where no
# train is, nine tenths and more where one is, down to 0 dB
_ENDS = 1 / 3

_TWIN = 0.1  # m, places of two types that differ by no more but their size have the same times

_AROUND_S = 0.5  # s, of an interval of strong energy that belongs to its train

_UNSTATED = 0.5  # m, distance between channels of no use

_STRONG, _CORE = 1 / 16, 1 / 4  # of the strong energy, 12 and 6 dB below
# what the rail carries beyond a train may last as long, and clipping makes it strong
_MOST_CARRIED = 1.6

_LOW_BAND_BONUS = 0.06  # of score, by which a higher band must win
_STRETCH = (
    1.25  # a delay that fits no type better than this is a clock's fault, not an unknown type
)
_STRETCH_STEP = 0.02  # 0.4 m of 20 m, within the smoothing of the scan


@dataclass(frozen=True)
class Hypothesis:
    """One catalogue type in one orientation and direction, fitted to all rail channels."""

    train: TrainType
    reverse: bool
    direction: int
    score: float
    fit: AxleFit
    probability: float = 0.0
    phase: float = 0.0  # log likelihood of the low-passed waveforms against noise

    @property
    def places(self) -> Array:
        """Distance of every wheelset behind the first (m)."""
        return self.train.oriented(self.reverse)

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
        explanations: types, relatives of them and wrong clocks, most probable first.
        clock_offset: (channel, offset s, sigma s) for channels whose clock contradicts the motion.
        delay: speed by the delays between two channels (m/s), sigma; or None.
        measured: where the channels are, if the pattern alone tells the type.
        baseline: learned correction of the distance between the outer two channels that was
            used (m), sigma, passages it was learned from; or None.
    """

    interval: tuple[float, float]
    traces: tuple[Trace, ...]
    band: tuple[float, float]
    hypotheses: tuple[Hypothesis, ...]
    direction: int
    explanations: tuple[Explanation, ...] = ()
    clock_offset: tuple[tuple[str, float, float], ...] = ()
    delay: tuple[float, float] | None = None
    measured: Measured | None = None
    baseline: tuple[float, float, int] | None = None
    quality: tuple[str, ...] = ()
    coarse_score: float = 0.0
    blind: Blind | None = None

    @property
    def score(self) -> float:
        """Pattern correlation of the best hypothesis."""
        return self.hypotheses[0].score if self.hypotheses else self.coarse_score

    @property
    def unknown(self) -> float:
        """Probability that the type is not in the catalogue."""
        return sum(e.probability for e in self.explanations if e.kind in ("scaled", "varied"))

    @property
    def known(self) -> bool:
        """Whether a catalogue type explains the pattern."""
        return self._patterned(KNOWN_SCORE) and self.unknown < 0.5 and self._covered

    @property
    def _covered(self) -> bool:
        """Whether, on one channel, no end of the pattern lies where the rail is quiet."""
        if self.direction != 0 or len(self.traces) > 1:
            return True
        contrast = self.hypotheses[0].fit.contrast[0]
        ends = contrast[:LEAST_SEEN], contrast[-LEAST_SEEN:]
        least = _ENDS * float(np.median(contrast))
        return all(float(np.median(end)) > least for end in ends)

    def _patterned(self, least: float) -> bool:
        """Whether a type's pattern is seen with this correlation, or clearly without wheelsets."""
        if not self.hypotheses:
            return False
        fit = self.hypotheses[0].fit
        seen = np.sum(fit.observed & (fit.contrast > SEEN), axis=1)
        if fit.in_phase > IN_PHASE and self.direction != 0:
            return self.score >= IN_STEP_SCORE
        if np.all(seen < np.minimum(LEAST_SEEN, fit.observed.sum(axis=1))):
            return False
        scattered = fit.scale > SCATTERED
        alone = self.direction == 0
        # unless the deflection under the wheels shows the type
        shown = self.hypotheses[0].phase > 0 and self.unknown < 0.5
        doubted = scattered and alone and not shown
        return self.score >= (SCATTERED_SCORE if doubted else least)

    @property
    def confirmed(self) -> bool:
        """Whether this is a train: by its pattern, or by what two channels agree on."""
        # a pattern that no type explains, at channels that contradict each other, is chance
        if self._patterned(CONFIRM_SCORE) and (self.known or not self.clock_offset):
            return True
        return self.blind is not None and self.blind.travels


def smoothed(trace: Trace, width_s: float) -> Array:
    """Energy averaged over ``width_s`` about every bin."""
    return trace.mean(trace.time - width_s / 2, trace.time + width_s / 2)


def strong(
    trace: Trace, bandwidth: float, within: tuple[float, float], below: float = _STRONG
) -> NDArray[np.bool_]:
    """Bins whose 40 ms energy stands out of the noise and within 12 dB of the strong ones."""
    energy = smoothed(trace, 0.04)
    inside = (trace.time >= within[0]) & (trace.time <= within[1])
    if not inside.any():
        return inside
    top = float(np.percentile(energy[inside], 95))
    freedom = max(2 * bandwidth * 0.04, 2.0)
    limit = max(trace.noise * (1 + 6 * np.sqrt(2 / freedom)), top * below)
    return np.asarray(inside & (energy > limit))


def strong_interval(
    trace: Trace, bandwidth: float, within: tuple[float, float], below: float = _STRONG
) -> tuple[float, float] | None:
    """First and last strong energy (s)."""
    found = np.flatnonzero(strong(trace, bandwidth, within, below))
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
    low: Trace
    wave: Wave
    band: tuple[float, float]
    interval: tuple[float, float]
    stretch: tuple[float, float]
    matches: list[Match]

    @property
    def score(self) -> float:
        return self.matches[0].score if self.matches else 0.0


def _scan_channel(
    record: Record,
    within: tuple[float, float],
    trains: Sequence[TrainType],
    limits: tuple[float, float],
    alone: bool,
) -> _Scanned | None:
    found = []
    whole = record.traces(within)
    window = record.window
    inside = (window.time >= within[0]) & (window.time <= within[1])
    wave = Wave(window.time - window.low_shift, window.low, window.valid, clipped(window, inside))
    for trace, limited, band in zip(
        whole, record.traces(within, limited=True), window.bands, strict=True
    ):
        interval = strong_interval(trace, band[1] - band[0], within)
        if interval is None:
            continue
        core = strong_interval(trace, band[1] - band[0], within, _CORE) or interval
        carried = min((interval[1] - interval[0]) / max(core[1] - core[0], 1e-3), _MOST_CARRIED)
        # one channel that is not clipped had better not try what it need not
        stretch = SLOWEST, FASTEST * (1.0 if alone and not wave.clipped else carried)
        ways = [
            _Scanned(
                t,
                whole[0],
                wave,
                band,
                interval,
                stretch,
                scan([(t, 0.0)], interval, trains, limits, stretch),
            )
            for t in (trace, limited)
        ]
        found.append(max(ways, key=lambda s: s.score))
    if not found:
        return None
    top = max(s.score for s in found)
    # the deflection under a wheel lies at the wheel; high bands peak where the rail is rough
    return next(
        s for s in found if s.score >= top - (_LOW_BAND_BONUS if top > HOPELESS_SCORE else 0)
    )


@dataclass(frozen=True)
class _Seen:
    """Types in the rail channels, best first, and how each channel lags behind the first (s)."""

    matches: list[Match]
    direction: int
    kept: list[tuple[_Scanned, float]]
    offsets: list[tuple[str, float, float]]


def _in_step(
    usable: Sequence[_Scanned], trains: Sequence[TrainType], limits: tuple[float, float]
) -> _Seen | None:
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
    alone = float(np.mean([np.log(1 - s.score**2) for s in usable]))
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
    return _Seen(matches, direction, kept, [])


def _one_by_one(usable: Sequence[_Scanned]) -> _Seen:
    """The types in the first channel, with what the others show of them."""
    fine = [replace(s, matches=refine([(s.trace, 0.0)], s.matches, s.interval)) for s in usable]
    direction, kept, offsets = _delays(fine, fine[0].matches[0])
    table: dict[tuple[str, bool], float] = {}
    for s, _ in kept:
        for match in s.matches:
            key = (match.train.name, match.reverse)
            table[key] = table.get(key, 0.0) + match.score / len(kept)
    matches = [
        replace(match, score=table[match.train.name, match.reverse]) for match in fine[0].matches
    ]
    return _Seen(matches, direction, kept, offsets)


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
        if (found := _scan_channel(record, within, trains, limits, len(records) == 1)) is not None
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
        passage = _fit_hypotheses(usable, trains, limits, site)
    off = bool(passage.clock_offset)
    if not unlisted or (passage.known and not (off and passage.score < CLOCK_SCORE)):
        return passage
    if len(records) < 2:
        return passage
    blind = describe(records, within, reference.interval, limits)
    blind = blind and at_site(blind, site)
    if blind is not None and blind.travels and off:
        # an unlisted train is likelier than a pattern at either channel and a wrong clock
        return replace(
            passage,
            hypotheses=(),
            coarse_score=passage.score,
            clock_offset=(),
            quality=(),
            blind=blind,
        )
    if passage.known:
        return passage
    return replace(passage, blind=blind)


def _delays(
    usable: Sequence[_Scanned], best: Match
) -> tuple[int, list[tuple[_Scanned, float]], list[tuple[str, float, float]]]:
    """Direction by the order of the channels; the delays (s) of those whose clock can be right."""
    reference = usable[0]
    kept = [(reference, 0.0)]
    votes: list[int] = []
    offsets: list[tuple[str, float, float]] = []
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
        if abs(baseline) < 0.5:
            kept.append((s, delay))
        elif abs(delay - expected) * best.speed < 0.8 or 1 / _STRETCH < delay / expected < _STRETCH:
            votes.append(1 if delay * baseline > 0 else -1)
            kept.append((s, delay))
        else:
            offsets.append((s.trace.name, delay - expected, 0.5 / best.speed))
    if votes and abs(sum(votes)) != len(votes):
        return 0, [(reference, 0.0)], offsets
    return (votes[0] if votes else 0), kept, offsets


def _fit_hypotheses(
    usable: Sequence[_Scanned],
    trains: Sequence[TrainType],
    limits: tuple[float, float],
    site: Calibration,
) -> Passage:
    reference = usable[0]
    seen = _in_step(usable, trains, limits) or _one_by_one(usable)
    direction, kept, offsets = seen.direction, seen.kept, seen.offsets
    fitted: list[Hypothesis] = []
    aligned: list[list[Array]] = []
    names = tuple(s.trace.name for s, _ in kept)
    stated = np.array([s.trace.x - reference.trace.x for s, _ in kept])
    offset, covariance = site.relative(names)
    shifts = (direction or 1) * (stated + offset)
    for match in seen.matches:
        score = match.score
        if score < seen.matches[0].score - 0.25:
            continue
        places = match.train.oriented(match.reverse)
        aligned.append([places + delay * match.speed for _, delay in kept])
        fit = fit_axles(
            [s.trace for s, _ in kept],
            # where the pattern was seen; whether the distance agrees is for the evidence to say
            aligned[-1],
            _recentred(match),
            [s.low for s, _ in kept],
            [s.wave for s, _ in kept],
        )
        if not np.isfinite(fit.scale) or not 0.5 * match.speed < fit.motion.speed:
            aligned.pop()
            continue
        fitted.append(Hypothesis(match.train, match.reverse, direction, score, fit))
    fitted = _same_times(fitted, aligned)
    waves = tuple(s.wave for s, _ in kept)
    candidates = [Candidate(h.places, shifts, h.fit, h.score, covariance, waves) for h in fitted]
    explanations = explain(candidates)
    if explanations and explanations[0].kind == "clock":
        wrong = kept[explanations[0].channel][0]
        fit, motion = fitted[explanations[0].candidate].fit, explanations[0].motion
        k = explanations[0].channel
        late = fit.time[k] - motion.time_at(
            candidates[explanations[0].candidate].places + shifts[k]
        )
        told = (wrong.trace.name, float(np.median(late)), 0.2 / motion.speed)
        rest = [s for s in usable if s.trace is not wrong.trace]
        passage = _fit_hypotheses(rest, trains, limits, site)
        return replace(
            passage,
            clock_offset=(*passage.clock_offset, told),
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
        clock_offset=tuple(offsets),
        quality=("unsynchronised",) if offsets else (),
    )
    if hypotheses and direction:
        last = int(np.argmax(np.abs(stated)))
        passage = replace(
            passage,
            delay=delay_speed(passage),
            measured=_measure(candidates, names, direction * stated, direction),
            baseline=(float(offset[last]), float(covariance[last, last] ** 0.5), site.passages),
        )
    return passage


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
    if best.kind != "type" or best.probability < _CERTAIN:
        return None
    fit = candidates[best.candidate].fit
    if not fit.used.any(axis=1).all():
        return None
    ahead = best.motion.distance_at(fit.time) - candidates[best.candidate].places
    shift = np.array([np.median(row[seen]) for row, seen in zip(ahead, fit.used, strict=True)])
    variance = fit.place_sigma**2 + fit.scale**2 / fit.used.sum(axis=1)
    covariance = np.diag(variance) + variance[0]
    covariance[0] = covariance[:, 0] = 0.0
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
        if e.kind == "type":
            total[e.candidate] += e.probability
            phase[e.candidate] = e.phase
        related[e.candidate] += e.probability
        if (e.kind == "type") != unknown:
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
    baseline = float(np.hypot(*fit.place_sigma[[a, b]])) / (x[b] - x[a])
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
    if len(rails) > 1 or not unlisted:
        return found
    return [p if p.known else _described(rails[0], within, p, limits, site) for p in found]


def bowl_of(record: Record, passage: Passage) -> Corner | None:
    """The corner of the deflection that a train of a known type shows at a rail channel.

    ``None`` if the type, or the deflection, is not beyond doubt.
    """
    best = passage.hypotheses[0]
    window = record.window
    wave = Wave(window.time - window.low_shift, window.low, window.valid)
    if best.probability < _CERTAIN:
        return None
    apart = passage.direction * (record.channel.x - passage.traces[0].x)
    if passage.direction == 0 and record.channel.name != passage.traces[0].name:
        return None
    motion = best.fit.motion
    times = motion.time_at(best.places + apart)
    found = corner(wave, times, WAVENUMBER * motion.speed)
    found = found and corner(wave, found.times, found.value)
    return found if found is not None and found.worth(2) > 0 else None


def _described(
    record: Record,
    within: tuple[float, float],
    passage: Passage,
    limits: tuple[float, float],
    site: Calibration,
) -> Passage:
    """What the only rail channel tells of a train that no type explains."""
    guess = None
    if passage.hypotheses:
        best = passage.hypotheses[0]
        guess = float(best.fit.motion.speed_at(best.mid_time))
    start, end = passage.interval
    alone = (max(within[0], start - _AROUND_S), min(within[1], end + _AROUND_S))
    band = record.window.bands.index(passage.band)
    bowl = site.wavenumber(record.channel.name)
    blind = describe_alone(record, alone, passage.interval, limits, guess, band, bowl)
    return replace(passage, blind=blind)


def apart(first: Passage, second: Passage) -> float:
    """Distance (m) of the first wheelset of a train behind the last one of the train before it."""
    end, start, speed = first.interval[1], second.interval[0], np.inf
    if first.hypotheses and second.hypotheses:
        best, after = first.hypotheses[0], second.hypotheses[0].fit.motion
        end = float(best.fit.motion.time_at(best.places[-1]))
        start, speed = float(after.time_at(0.0)), float(best.fit.motion.speed_at(end))
    return (start - end) * speed


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
            if part is None or not part.confirmed:
                break
            parts.append(part)
        better = len(parts) == 2 and parts[0].score + parts[1].score > 2 * whole.score + 0.1
        if better and apart(parts[0], parts[1]) > catalogue.longest_gap:
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
