"""Which explanation of the wheelset times is right: a type of the catalogue, a relative of it, a
wrong clock, a misstated place.

Every explanation is a linear model with Gaussian effects: place of wheelset i at channel c,

    p_ci = s0 + v t + a t²/2 + place_c + class_k(i) + noise (+ its own effects),

so its evidence and the motion under it follow in closed form (Rasmussen & Williams, Gaussian
Processes for Machine Learning, 2006, eq. 2.43). An unknown train is a catalogue type whose size and
gaps may differ: what is left of its speed is what the data and this prior allow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.special import ndtr

from .axles import AxleFit
from .kinematics import PRIOR_ACCELERATION, Motion
from .place import ALIKE, FAR, Wave, agreement, classes

Array = NDArray[np.float64]
Kind: TypeAlias = Literal["type", "scaled", "varied", "moved", "clock"]

PRIOR_UNKNOWN = 0.05
"""Prior probability that a train is not in the catalogue."""

PRIOR_CLOCK = 1e-3
"""Prior probability that a channel's clock is off: rarer than an unlisted train by far."""

PRIOR_MOVED = 1e-3
"""Prior probability that a channel is not where it is said to be, beyond what a tape explains."""

LISTED: tuple[Kind, ...] = ("type", "moved", "clock")
"""Explanations by a type of the catalogue."""

# m, at every channel wheelsets with other neighbours have other pulses: on computed passages at 20
# and 40 dB rms 0.012 m, one in twenty beyond 0.03 m; more where noise hides a pulse
_CLASS_SIGMA = 0.03
_LEAN_SIGMA = 0.012  # m, the same of both wheelsets of a bogie: the rms of them all
_END_SIGMA = 0.01  # m, beside that, of outermost wheelsets (40 dB), as no neighbours precede them
_LEAST_NOISE = 0.003  # m, the same: the scatter at 40 dB, finer agreement is chance
_SCALE = 0.04  # catalogue types of one shape differ this much in size (CRH1 : CR400AF 6 %)
_SCALE_VARIED = 0.08
_SHAPE = 0.06  # m, how well the gaps of such relatives agree after scaling
_GAP_NEAR, _GAP_FAR = 0.2, 0.6  # m, spread of wheelbases and of the other gaps between types
_NEAR = 3.5  # m
_CLOCK_S = (0.01, 0.1, 1.0)  # a wrong clock is off by ms or by s, every decade as likely
_MOVED_M = (0.1, 1.0)  # the same of a misstated place
_OUTLIER = 2.5
_SAME_PULSE = 1.25  # m, half a wheelbase
_LEAST_COMMON = 0.75  # share of the places, so that what is left out can be accidents
_COARSE = 0.2  # m, scatter at which nothing finer than a wheelbase can be told
_COARSE_COST = 7.0  # ln of odds: its tails are not Gaussian and imitate other gaps
_LEAST_SHARE = 0.6  # of the scatter about the best type that must be noise
_NULL_LOG = float(np.log(2.2))  # a wheelset found anywhere within its window of 2.2 m
_SCORE_WEIGHT = 120.0
_SCORE_NOISE = 0.03  # scores of equally right types differ by this much
LIKELY = 2 * _SCORE_NOISE
"""Of score, behind the best, at which a type may well be right."""


@dataclass(frozen=True)
class Candidate:
    """A fitted type.

    Attributes:
        places: nominal, behind the first wheelset (m).
        shifts: of every channel along the direction of travel (m).
        fit: to all channels.
        score: of its pattern.
        site: covariance of the shifts (m²).
        waves: low-passed waveforms of the channels; without any they do not count.
    """

    places: Array
    shifts: Array
    fit: AxleFit
    score: float
    site: Array
    waves: tuple[Wave, ...] = ()


@dataclass(frozen=True)
class Explanation:
    """One model of the passage.

    Attributes:
        candidate: index of the type it starts from.
        kind: ``type`` as in the catalogue; ``scaled`` a relative of the same shape; ``varied`` one
            with other gaps; ``clock`` the type, and the clock of ``channel`` is off; ``moved`` the
            type, and ``channel`` is not where it is said to be.
        probability: posterior.
        motion: under this model, with covariance.
        phase: log likelihood of the low-passed waveforms under it against noise.
    """

    candidate: int
    kind: Kind
    probability: float
    motion: Motion
    channel: int = -1
    phase: float = 0.0


def _lean(places: Array) -> Array:
    """Which side of every wheelset's bogie the nearer other bogie is on: 1 before, -1 behind, 0."""
    gaps = np.diff(places)
    bogie = np.concatenate([[0], np.cumsum(gaps > _NEAR)])
    between = np.concatenate([[np.inf], gaps[gaps > _NEAR], [np.inf]])
    before, behind = between[:-1], between[1:]
    nearer = np.minimum(before, behind) < FAR
    lean = np.where(nearer & (np.abs(before - behind) > ALIKE), np.sign(behind - before), 0.0)
    return np.asarray(lean[bogie])


def _at_ends(places: Array) -> Array:
    """Variance (m²) of wheelsets by neighbours that they lack before the train or behind it."""
    near = [np.exp(-2 * np.abs(places - end) / FAR) for end in (places[0], places[-1])]
    return np.asarray(_END_SIGMA**2 * (near[0] + near[1]), dtype=np.float64)


def _noise(candidate: Candidate) -> float:
    """Scatter of wheelsets of one class about their median (m), outliers limited."""
    alike = classes(candidate.places)
    residual = candidate.fit.residual
    rest, members = [], 0
    for c in range(residual.shape[0]):
        for k in np.unique(alike):
            use = candidate.fit.observed[c] & (alike == k)
            if use.sum() >= 3:
                rest.append(residual[c, use] - np.median(residual[c, use]))
                members += int(use.sum())
    if not rest:
        return 0.1
    off = np.concatenate(rest)
    limit = 4 * max(1.4826 * float(np.median(np.abs(off))), _LEAST_NOISE)
    square = float(np.sum(np.minimum(np.abs(off), limit) ** 2)) / max(members - len(rest), 1)
    return max(float(np.sqrt(square)), _LEAST_NOISE)


def _same_pulses(a: Candidate, b: Candidate) -> bool:
    """Whether two candidates take the same pulses for their wheelsets, one by one."""
    if a.places.size != b.places.size:
        return False
    apart = np.abs(a.fit.time - b.fit.time) * abs(a.fit.motion.speed)
    return float(np.median(apart)) < _SAME_PULSE


def _comparable(
    candidate: Candidate, likely: Sequence[Candidate], noise: float
) -> NDArray[np.bool_] | None:
    """(channels, wheelsets): places of a candidate that fit every likely one of the same pulses.

    Every candidate looks for its wheelsets in windows of its own; a pulse mistaken for a wheelset
    in one of them is an accident, and must not choose between types that differ by a per cent.
    Many such places are no accident but a wrong type: then all places count. A train of equal cars
    fits again one car later, but there its wheelsets are others.
    """
    peers = [c for c in likely if c.fit.scale <= 2 * noise and _same_pulses(candidate, c)]
    if not peers:
        return None
    good = np.all(
        [c.fit.observed & (np.abs(c.fit.residual) <= _OUTLIER * noise) for c in peers], axis=0
    )
    enough = _LEAST_COMMON * min(c.fit.observed.sum() for c in peers)
    return np.asarray(good) if good.sum() >= enough else None


def _model(
    candidate: Candidate,
    noise: float,
    speed: float,
    effects: Sequence[Array],
    seen: NDArray[np.bool_],
) -> tuple[float, Motion]:
    """Log evidence against wheelsets anywhere, and the motion.

    Args:
        candidate: the type.
        noise: of a wheelset (m).
        speed: of the type of the highest score (m/s).
        seen: (channels, wheelsets) that count.
        effects: random effects of unit variance on the places, each of shape (channels, wheelsets).
    """
    fit, start = candidate.fit, candidate.fit.motion
    t = fit.time[seen] - start.epoch
    # what the first regression left, so that nothing large cancels
    rest = (candidate.places[None, :] + candidate.shifts[:, None])[seen]
    rest = rest - start.distance_at(fit.time[seen])
    excess = np.maximum(1.0, np.abs(fit.residual[seen]) / (_OUTLIER * noise))
    z = np.stack([effect[seen] for effect in effects], axis=1)
    ends = np.broadcast_to(_at_ends(candidate.places), seen.shape)[seen]
    factor = linalg.cho_factor(np.diag((noise * excess) ** 2 + ends) + z @ z.T, lower=True)
    x = np.stack([np.ones_like(t), t, 0.5 * t * t], axis=1)
    solved = linalg.cho_solve(factor, np.column_stack([x, rest]))
    prior = PRIOR_ACCELERATION**-2
    normal = x.T @ solved[:, :3] + np.diag([1e-9, 1e-9, prior])
    right = x.T @ solved[:, 3] - np.array([0.0, 0.0, prior * start.acceleration])
    change = np.linalg.solve(normal, right)
    misfit = float(rest @ solved[:, 3] + prior * start.acceleration**2 - right @ change)
    log = -0.5 * misfit - float(np.sum(np.log(np.diag(factor[0]))))
    log -= 0.5 * float(np.linalg.slogdet(normal)[1])
    log += t.size * (_NULL_LOG - 0.5 * float(np.log(2 * np.pi)))
    # a density of times, not of places, or the smaller of two types of one shape would be favoured
    log += t.size * float(np.log(start.speed / speed))
    motion = Motion(
        start.epoch,
        start.distance + float(change[0]),
        start.speed + float(change[1]),
        start.acceleration + float(change[2]),
        np.linalg.inv(normal),
    )
    return log, motion


def _in_phase(candidate: Candidate, motion: Motion, places: Array, speed: float) -> float:
    """Log likelihood of the low-passed waveforms if the wheelsets have these places (m).

    All is scaled to one common speed (m/s), that types of one shape but another size are asked
    about the same waves.
    """
    if not candidate.waves:
        return 0.0
    fit = candidate.fit
    own = float(motion.speed_at(motion.time_at(0.5 * places[-1])))
    if not (np.all(np.diff(places) > 0) and own > 0):
        return 0.0
    scale = speed / own
    motion = Motion(
        motion.epoch,
        scale * motion.distance,
        scale * motion.speed,
        scale * motion.acceleration,
        scale**2 * motion.covariance,
    )
    places = scale * places
    ahead = [
        places + float(np.median((motion.distance_at(time) - places)[seen]))
        if seen.any()
        else places
        for time, seen in zip(fit.time, fit.observed, strict=True)
    ]
    return agreement(candidate.waves, motion, ahead).log


def clock_density(offset: float) -> float:
    """Prior density (1/s) of the offset of a clock that is off (s)."""
    w = np.array(_CLOCK_S)
    return float(np.mean(np.exp(-0.5 * (offset / w) ** 2) / w)) / float(np.sqrt(2 * np.pi))


def explain(candidates: Sequence[Candidate]) -> list[Explanation]:
    """Every explanation with its posterior probability, most probable first."""
    if not candidates:
        return []
    top = max(c.score for c in candidates)
    likely = [c for c in candidates if c.score > top - LIKELY]
    # classes of few wheelsets understate it
    noise = max(min(_noise(c) for c in likely), _LEAST_SHARE * min(c.fit.scale for c in likely))
    speed = max(likely, key=lambda c: c.score).fit.motion.speed
    found: list[tuple[float, float, int, Kind, int, Motion]] = []
    for index, c in enumerate(candidates):
        channels, axles = c.fit.observed.shape
        common = _comparable(c, likely, noise)
        use = c.fit.observed if common is None else c.fit.observed & common
        alike = classes(c.places)
        base: list[Array] = []
        variances, directions = np.linalg.eigh(c.fit.place + c.site)
        for variance, along_channels in zip(variances, directions.T, strict=True):
            if variance > 1e-12:
                base.append(np.outer(np.sqrt(variance) * along_channels, np.ones(axles)))
        for k in range(int(alike.max()) + 1):
            # what all wheelsets have in common is in the place of the channel
            share = (alike == k) - np.mean(alike == k)
            for row in np.eye(channels):
                base.append(_CLASS_SIGMA * np.outer(row, share))
        lean = _lean(c.places)
        for row in np.eye(channels):
            base.append(_LEAN_SIGMA * np.outer(row, lean - np.mean(lean)))
        # the noise is in the times: effects that grow along the train must follow fitted places,
        # or a train of free size shrinks to lessen its noise
        noisy = np.where(c.fit.observed, c.fit.residual, 0.0)
        square = float(c.places @ c.places)
        rounded = np.round(np.diff(c.places), 1)
        gaps = np.unique(rounded)
        before = [np.concatenate([[0.0], np.cumsum(rounded == gap)]) for gap in gaps]
        # what a relative differs by, per metre of its size and of every gap
        differs = np.stack([c.places, *before])
        follow = [row - float(row @ c.places) / square * noisy for row in differs]
        near = np.where(gaps < _NEAR, _GAP_NEAR, _GAP_FAR)
        spread: dict[Kind, Array] = {
            "scaled": np.array([_SCALE, *np.full(gaps.size, _SHAPE)]),
            "varied": np.array([_SCALE_VARIED, *near]),
        }
        scaled, varied = (
            [s * f for s, f in zip(spread[kind], follow, strict=True)]
            for kind in ("scaled", "varied")
        )
        unlisted = float(np.log(PRIOR_UNKNOWN / 2))
        coarse = unlisted - _COARSE_COST * min(1.0, noise / _COARSE)
        prior = float(-np.log(len(candidates))) - _SCORE_WEIGHT * max(
            0.0, top - c.score - _SCORE_NOISE
        )
        trials: list[tuple[Kind, int, float, list[Array]]] = [
            ("type", -1, float(np.log(1 - PRIOR_UNKNOWN)), []),
            ("scaled", -1, coarse if channels > 1 else unlisted, scaled),
            ("varied", -1, coarse, varied),
        ]
        pace = abs(c.fit.motion.speed)
        for k in range(1, channels):
            row = np.zeros((channels, axles))
            row[k] = 1.0
            clock = float(np.log(PRIOR_CLOCK / len(_CLOCK_S)))
            trials += [("clock", k, clock, [width * pace * row]) for width in _CLOCK_S]
            moved = float(np.log(PRIOR_MOVED / len(_MOVED_M)))
            trials += [("moved", k, moved, [width * row]) for width in _MOVED_M]
        weighed: list[tuple[float, Kind, int, Motion]] = []
        for kind, channel, log_prior, more in trials:
            log, motion = _model(c, noise, speed, [*base, *more], use)
            if motion.speed > 0:
                weighed.append((log + prior + log_prior, kind, channel, motion))
        if not weighed:
            continue
        # what relatives have for places is not good enough to be asked for their phase; it is that
        # of the type, before sensors as they are said to be or as they would have to be
        wrong = [w for w in weighed if w[1] in ("clock", "moved")]
        phase = _in_phase(c, weighed[0][3], c.places, speed)
        other = phase
        if wrong and (best := max(wrong, key=lambda w: w[0]))[0] > weighed[0][0]:
            other = _in_phase(c, best[3], c.places, speed)
        shown = {"type": phase, "clock": other, "moved": other}
        found += [
            (log, shown.get(kind, max(phase, other)), index, kind, k, motion)
            for log, kind, k, motion in weighed
        ]
    if not found:
        return []
    # wheelsets that only rattle have no pulse below 100 Hz: then noise explains the waveforms
    logs = np.array([f[0] for f in found]) + np.logaddexp(0.0, [f[1] for f in found])
    weights = np.exp(logs - logs.max())
    weights /= weights.sum()
    out = [
        Explanation(index, kind, float(w), motion, channel, phase)
        for w, (_, phase, index, kind, channel, motion) in zip(weights, found, strict=True)
    ]
    return sorted(out, key=lambda e: -e.probability)


def half_interval(
    parts: Sequence[tuple[float, float, float]], centre: float, share: float = 0.95
) -> float:
    """Half the width of the interval about ``centre`` that holds ``share`` of a mixture.

    Args:
        parts: (probability, mean, sigma).
        centre: of the interval.
        share: of the probability.
    """
    weight, mean, sigma = (np.array(column) for column in zip(*parts, strict=True))
    sigma = np.maximum(sigma, 1e-12)
    low, high = 0.0, float(np.max(np.abs(mean - centre) + 8 * sigma))
    for _ in range(60):
        half = 0.5 * (low + high)
        inside = ndtr((centre + half - mean) / sigma) - ndtr((centre - half - mean) / sigma)
        if float(np.sum(weight * inside) / weight.sum()) < share:
            low = half
        else:
            high = half
    return high
