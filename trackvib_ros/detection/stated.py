"""The speed and the times stated of a train whose wheelsets were seen, with their sigmas."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from .evidence import half_interval
from .kinematics import Motion
from .passage import Hypothesis, Passage

Array = NDArray[np.float64]
Part: TypeAlias = tuple[float, float, float]
"""Of a mixture of Gaussians: weight, mean, sigma."""

_HELD = 0.95  # probability that an interval, and the types of a speed, hold
_TWO_SIDED = 1.96  # sigmas of a Gaussian that hold as much
_GEOMETRY = 0.03  # m, wheelsets of a train against its type
_WHEELBASE = 0.1  # m, half of what wheelbases differ by: that of an unknown type is not measured
_SIZE = 0.14  # ln of car lengths from 17 to 27.5 m, equally likely: 0.48 / sqrt 12


@dataclass(frozen=True)
class Speed:
    """Speed at mid-train (m/s).

    Attributes:
        value: posterior mean over ``types``, or over the relatives of an unknown type.
        sigma: standard uncertainty.
        interval: about the value, holds 95 %.
        template: under the most probable type alone, with its sigma.
        types: the most probable ones, as many as hold 95 %; none of an unknown train.
    """

    value: float
    sigma: float
    interval: tuple[float, float]
    template: tuple[float, float]
    types: tuple[str, ...]

    @property
    def template_sigma(self) -> float:
        """Relative standard uncertainty of what scales with the speed of the most probable type."""
        return float(np.hypot(self.sigma, self.value - self.template[0])) / self.value


def speed(passage: Passage) -> Speed:
    """The speed of a train by the explanations of its wheelsets.

    While types stay ambiguous the speed is their mean: that of one of them is wrong by all they
    differ by (CRH3 and CRH2: 0.9 %) whenever the other is right. What is less likely than one in
    twenty neither shifts it nor is in the interval, and the sigma is at least that of the interval.
    With one channel and no deflection that shows the type, the sigma contains the small chance that
    the train is a relative of it, some percent larger or smaller.
    """
    best = passage.hypotheses[0]
    when = best.mid_time

    def part(probability: float, motion: Motion) -> Part:
        return probability, float(motion.speed_at(when)), motion.speed_sigma(when)

    parts = [part(e.probability, e.motion) for e in passage.explanations]
    held = _held(passage)
    if passage.known:
        meant = [part(h.probability, h.fit.motion) for h in held]
        # by what wheelsets scatter it may be a train of which only the proportions are listed
        if (unlike := passage.unlike) > 0:
            parts = [(w * (1 - unlike), v, s) for w, v, s in parts] + [
                (w * unlike, v, float(np.hypot(s, _SIZE * v))) for w, v, s in parts
            ]
    else:
        related = ("scaled", "varied")
        meant = [part(e.probability, e.motion) for e in passage.explanations if e.kind in related]
        # a type may be refused by what its pattern does not show
        meant = meant if sum(w for w, _, _ in meant) > 0 else parts
        if len(passage.traces) == 1:
            # nothing fixes the size of what the listed types only resemble
            parts = [(w, v, float(np.hypot(s, _SIZE * v))) for w, v, s in parts]
    value = _mean(meant)
    _, template, own = part(1.0, best.fit.motion)
    half = max(half_interval(parts, value, _HELD), _TWO_SIDED * own)
    # the delay between two channels bounds the size of an unlisted train; one channel cannot
    shown = len(passage.traces) > 1 or (passage.known and best.phase > 0)
    sigma = half / _TWO_SIDED if shown else _spread(parts, value)
    sigma = max(sigma, _spread(meant, value) if passage.known else own)
    types = tuple(h.train.name for h in held)
    return Speed(value, sigma, (value - half, value + half), (template, own), types)


def _held(passage: Passage) -> list[Hypothesis]:
    """The most probable types, as many as hold 95 %; none of an unknown train."""
    if not passage.known:
        return []
    before = np.cumsum([h.probability for h in passage.hypotheses])
    count = 1 + int(np.searchsorted(before, _HELD * before[-1]))
    return list(passage.hypotheses[:count])


def _mean(parts: Sequence[Part]) -> float:
    """Mean of a mixture."""
    return sum(w * v for w, v, _ in parts) / sum(w for w, _, _ in parts)


def _spread(parts: Sequence[Part], centre: float) -> float:
    """Root mean square of a mixture from a centre."""
    square = sum(w * ((v - centre) ** 2 + s**2) for w, v, s in parts)
    return float(np.sqrt(square / sum(w for w, _, _ in parts)))


def wheelsets(passage: Passage) -> tuple[Array, Array]:
    """When every wheelset passed the reference channel, and its standard uncertainty (s)."""
    best = passage.hypotheses[0]
    fit, motion = best.fit, best.fit.motion
    seen = fit.used[0]
    predicted = motion.time_at(best.places)
    if passage.known:
        # of the variance of a wheelset about its place the train itself has an unknown share, none
        # to all that its tolerance allows; with half the largest share trusted the error has the
        # variance trust (1 - trust) scale² on average, at a largest share of one whatever the true
        # one is
        trust = 0.5 * min(1.0, (_GEOMETRY / fit.scale) ** 2)
        late = -fit.residual[0] / np.maximum(motion.speed_at(predicted), 0.5)
        # the channel's own place is in the motion already
        late -= np.median(late[seen]) if seen.any() else 0.0
        scatter = float(np.sqrt(trust * (1 - trust)) * fit.scale)
    else:
        trust, late, scatter = 1.0, fit.time[0] - predicted, fit.scale
    times = predicted + np.where(seen, trust * late, 0.0)
    here = np.maximum(motion.speed_at(times), 0.5)
    sigmas = np.hypot([motion.time_sigma(float(t)) for t in times], scatter / here)
    if passage.known:
        return times, sigmas
    start, end = passage.interval
    outside = np.maximum(np.maximum(start - times, times - end), 0.0)
    return times, np.hypot(np.where(seen, _unknown_place(passage) / here, sigmas), outside)


def ends(passage: Passage, value: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """When the first and the last wheelset passed the reference channel (s), with their sigmas.

    Args:
        passage: the train.
        value: its speed (m/s).
    """
    best = passage.hypotheses[0]
    found = []
    for i in (0, -1):
        parts = []
        for h in _held(passage) or [best]:
            time = float(h.fit.motion.time_at(h.places[i]))
            parts.append(
                (h.probability if passage.known else 1.0, time, h.fit.motion.time_sigma(time))
            )
        if not passage.known and best.fit.observed[0, i]:
            parts = [(1.0, float(best.fit.time[0, i]), _unknown_place(passage) / value)]
        time = _mean(parts)
        # an unknown train ends where strong energy does rather than where another type would
        missed = 0.0 if passage.known else time - passage.interval[i]
        found.append((time, float(np.hypot(_spread(parts, time), missed))))
    return found[0], found[1]


def _unknown_place(passage: Passage) -> float:
    """How well a wheelset of an unknown type is where its pulse is (m), whatever its size."""
    fit = passage.hypotheses[0].fit
    return float(np.sqrt(fit.place[0, 0] + fit.scale**2 + _WHEELBASE**2))
