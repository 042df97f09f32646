"""What was found of one train: the hypotheses about it, and whether it is one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from .axles import AxleFit
from .blind import Blind
from .calibration import Measured
from .catalogue import TrainType
from .evidence import Explanation
from .passage_scan import HOPELESS_SCORE
from .pattern import Trace

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

UNLIKE = 0.26
"""Scatter (m) from which on it is likelier that of an unlisted train about the nearest type: ln of
that of listed trains on one channel is -3.4 ± 0.9 (computed passages of 0 to 40 dB), of unlisted
ones -1.0 ± 0.5, and these are one in twenty."""

_SCATTER = ((-3.4, 0.9, 0.95), (-1.0, 0.5, 0.05))  # of listed and unlisted trains, as above

SEEN = 0.5
"""ln of energy (2 dB) by which a wheelset that is seen rises over what is beside it."""

IN_STEP_SCORE = 0.535
"""Least pattern correlation of two channels in step, of a train whose deflection shows it too: as
significant as :data:`SCATTERED_SCORE` of one (1 - r² is the root of that of one). If the places of
the wheelsets agree as well, these two tell more than the correlation, which holes spoil."""

IN_PHASE = 30.0
"""ln of the likelihood at which the deflection shows a train: odds of e^20 after all its trials."""

IN_PLACE = 30.0
"""The same of wheelsets whose places agree, two channels in step."""

_WINDOW = 2.2  # m, in which a wheelset is looked for

LEAST_SEEN = 8
"""Wheelsets of a pattern (two cars) to be seen on one channel, all where a train has fewer: three
blows of a hammer in the right places have the correlation of a railcar on three bogies."""

# of the rise (ln) of all wheelsets, least one of those of two cars at either end: about 0 where no
# train is, nine tenths and more where one is, down to 0 dB
_ENDS = 1 / 3
_WEAKER = 1e-3
"""Part of trains, all of whose wheelsets are alike, of which an end ranks so low: with two ends one
right name in 500 is refused, as rarely as noise passed for the end of a longer type (1 in 540
computed passages, p 7e-5). Of 216 right names the lowest had 1.4e-3, uniform as it should be."""


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
        moved: (channel, offset m, sigma m) for channels that are not where they are said to be.
        delay: speed by the delays between two channels (m/s), sigma; or None.
        measured: where the channels are, if the pattern alone tells the type.
        baseline: learned correction of the distance between the outer two channels that was
            used (m), sigma, passages it was learned from; or None.
        contradicted: whether wheelsets that were found without a type are not those of the best.
        struck: whether blows hide its wheelsets, of which only the sum shows the type.
    """

    interval: tuple[float, float]
    traces: tuple[Trace, ...]
    band: tuple[float, float]
    hypotheses: tuple[Hypothesis, ...]
    direction: int
    explanations: tuple[Explanation, ...] = ()
    clock_offset: tuple[tuple[str, float, float], ...] = ()
    moved: tuple[tuple[str, float, float], ...] = ()
    delay: tuple[float, float] | None = None
    measured: Measured | None = None
    baseline: tuple[float, float, int] | None = None
    quality: tuple[str, ...] = ()
    coarse_score: float = 0.0
    blind: Blind | None = None
    contradicted: bool = False
    struck: bool = False

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
        if self.struck:
            return True
        if self.contradicted or not self._patterned(KNOWN_SCORE) or self.unknown >= 0.5:
            return False
        return self._covered and not (self.alone and self._doubted(UNLIKE))

    @property
    def alone(self) -> bool:
        """Whether one channel shows it."""
        return self.direction == 0 and len(self.traces) == 1

    @property
    def unlike(self) -> float:
        """Probability that a type is a relative's, by what wheelsets on one channel scatter about
        its places; 0 where the deflection or a second channel shows these."""
        best = self.hypotheses[0]
        if not self.alone or best.phase > IN_PHASE:
            return 0.0
        at = np.log(max(best.fit.scale, 1e-3))
        listed, other = (p / s * np.exp(-0.5 * ((at - m) / s) ** 2) for m, s, p in _SCATTER)
        return float(other / (listed + other))

    def _doubted(self, scatter: float) -> bool:
        """Whether wheelsets scatter by more than this (m) and no deflection shows the type."""
        best = self.hypotheses[0]
        return best.fit.scale > scatter and not (best.phase > 0 and self.unknown < 0.5)

    @property
    def _covered(self) -> bool:
        """Whether no end of the pattern lies where the rails are quiet."""
        contrast = self.hypotheses[0].fit.contrast.mean(axis=0)
        middle = float(np.median(contrast))
        if not self.alone and middle < SEEN:
            return True
        both = contrast[:LEAST_SEEN], contrast[LEAST_SEEN:]
        ends = (both, (contrast[-LEAST_SEEN:], contrast[:-LEAST_SEEN]))
        if any(float(np.median(end)) <= _ENDS * middle for end, _ in ends):
            return False
        # where noise is as strong, the largest of it in a window passes for a wheelset
        return not self.alone or all(
            stats.mannwhitneyu(end, rest, alternative="less").pvalue > _WEAKER
            for end, rest in ends
            if rest.size
        )

    def _patterned(self, least: float) -> bool:
        """Whether a type's pattern is seen with this correlation, or clearly without wheelsets."""
        if not self.hypotheses:
            return False
        fit = self.hypotheses[0].fit
        seen = np.sum(fit.observed & (fit.contrast > SEEN), axis=1)
        shown = max(fit.in_phase, self.hypotheses[0].phase if self.unknown < 0.5 else 0.0)
        if shown > IN_PHASE and self.direction != 0:
            return self.score >= (HOPELESS_SCORE if self._in_place > IN_PLACE else IN_STEP_SCORE)
        if self.direction != 0 and self._in_place + shown < 0:
            return False  # both are ln of likelihoods, and scores do not outweigh them
        if np.all(seen < np.minimum(LEAST_SEEN, fit.observed.sum(axis=1))) and not (
            self.direction != 0 and self._in_place > IN_PLACE
        ):
            return False
        doubted = self.direction == 0 and self._doubted(SCATTERED)
        return self.score >= (SCATTERED_SCORE if doubted else least)

    @property
    def _in_place(self) -> float:
        """ln of the likelihood that wheelsets lie where the type has them, not anywhere."""
        fit = self.hypotheses[0].fit
        gain = np.log(_WINDOW / (np.sqrt(2 * np.pi) * max(fit.scale, 1e-3))) - 0.5
        return float(fit.used.sum() * gain)

    @property
    def confirmed(self) -> bool:
        """Whether this is a train: by its pattern, or by what two channels agree on."""
        if self.struck:
            return True
        # a pattern that no type explains, at channels that contradict each other, is chance
        if self._patterned(CONFIRM_SCORE) and (self.known or not self.clock_offset):
            return True
        return self.blind is not None and self.blind.travels

    def ahead_of(self, after: Passage) -> float:
        """Distance (m) of the first wheelset of the train after it behind its own last one."""
        end, start, speed = self.interval[1], after.interval[0], np.inf
        if self.hypotheses and after.hypotheses:
            best, motion = self.hypotheses[0], after.hypotheses[0].fit.motion
            end = float(best.fit.motion.time_at(best.places[-1]))
            start, speed = float(motion.time_at(0.0)), float(best.fit.motion.speed_at(end))
        return (start - end) * speed
