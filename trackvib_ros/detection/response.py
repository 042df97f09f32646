"""Trains from slab, support layer or bridge alone: one common response to every wheelset.

Where single wheelsets cannot be seen, a channel still answers every wheelset in the same way, only
later: ``y(t) = sum_i r(t - t_i) + noise``, with the wheelset times ``t_i`` of a type at a speed and
an acceleration, and an unknown response ``r`` of limited length. For a trial motion ``r`` follows
by least squares; the marginal likelihood tells how well the channel repeats itself at the
wheelsets, and an ``r`` flexible enough for any motion pays for it there (its logarithmic
determinant). All is done on Fourier coefficients, whose normal equations are Toeplitz matrices.

Two things are observed in every channel: the low-passed waveform (load, bridge modes), and the
energy of a band, to which every wheelset adds its own (no coherence is needed, as at low speed,
where roughness outweighs the moving load). All observations share the motion and each has its own
``r``: influence lines at two places are not shifted copies of each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .catalogue import TrainType
from .events import Channel
from .evidence import PRIOR_UNKNOWN, half_interval
from .kinematics import Motion
from .record import Record
from .response_equal import ends_sigma, proportions, unlisted
from .response_loads import loaded
from .response_model import (
    USUAL_MISFIT,
    Observation,
    comb,
    observations,
    strong_extent,
)
from .response_search import (
    COARSE,
    CORRELATED,
    KEPT,
    PASSED,
    PASSED_SPREAD,
    ResponseFit,
    Search,
    distinct,
)
from .unlisted import ALTERNATIVES, CAR, CHOICES, NUMBERS_APART, WITH_POWER

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

CONFIRM_EVIDENCE = 30.0
"""Least ln of the evidence for a train over a disturbance of the same spectrum and duration."""

CERTAIN_EVIDENCE = 100.0
"""Evidence that needs no more support: 57 disturbances of a minute each on a slab channel had up to
69, with all shipped types to choose from."""

_SYSTEMATIC = 0.05, 0.02
"""Share of the evidence by which models of like trains differ because none is exact, in units of
one e-fold of belief: with one response for all wheelsets (of 27 computed passages of a metro five
had a train of somewhat other proportions more than a fifth better than itself), and with wheelsets
that may differ within a car (of 16 passages of equal cars all but one within 6 %, 2 % on average).
"""

HELD = 0.95
"""Probability that the family of a named type, and the interval of a speed, hold."""

_REPEATED = 4, 3
"""Equal cars at least, where everything else was chosen freely, and without locomotives: bursts of
hum or of spikes look like two cars, or two cars and a locomotive, with an evidence of up to 370 (of
30 disturbances of a minute)."""

_FEWEST = 8
"""Wheelsets of a train: three bogies are as many blows (of 20 minutes of disturbances on a slab
one of spikes had an evidence of 133 for a railcar, and one of a road vehicle 109)."""

_TWO_SIDED = 1.96  # sigmas of a Gaussian that hold as much
_SHORTEST_S = 0.3


def tempered(evidence: float, varied: bool = True) -> float:
    """Difference of evidence that stands for a factor e between two trains."""
    return CORRELATED + _SYSTEMATIC[varied] * max(evidence, 0.0)


def _orientations(trains: Sequence[TrainType]) -> list[tuple[TrainType, bool]]:
    return [(t, r) for t in trains for r in ((False,) if t.symmetric else (False, True))]


@dataclass(frozen=True)
class ResponsePassage:
    """A train by its response: what can be told without seeing its wheelsets.

    Attributes:
        fits: types with their motions, most probable first.
        probabilities: of the fits.
        channels: names of the channels used, reference first.
        middle: time at which the middle of the train passes the reference (s), sigma.
        direction: +1, -1, or 0 if unknown.
        duration: between 5 and 95 % of the energy (s).
        spectral: speed by the bogie-passing spectrum (m/s), sigma; or None.
        unlisted: the train of equal cars that explains most, at the speed of cars of :data:`CAR`.
        plain: the same without locomotives, by a first look.
        choice: ln of the mean over all proportions, the usual ones most, of what they explain, over
            the best ones'.
        types: number of types to choose from.
    """

    fits: tuple[ResponseFit, ...]
    probabilities: tuple[float, ...]
    channels: tuple[Channel, ...]
    middle: tuple[float, float]
    direction: int
    duration: float
    spectral: tuple[float, float] | None
    unlisted: ResponseFit | None = None
    plain: ResponseFit | None = None
    choice: float = 0.0
    types: int = 1

    @property
    def unknown(self) -> float:
        """Probability that the train is not in the catalogue.

        The types of the catalogue share one prior, trains of equal cars the other one; of both it
        is the mean that counts, not the best: what is chosen freely is paid for. Where a type had
        to be chosen, too, the fits with one response for all wheelsets are asked as well and the
        larger probability holds: wheelsets that may differ hide a wrong distance of the bogies.
        """
        if self.unlisted is None or not self.fits:
            return 0.0 if self.fits else 1.0
        cars = self.unlisted.cars
        choices = 1 if cars is None else cars.choices
        top = self.fits[0].evidence
        unit = tempered(top)
        listed = sum(np.exp((fit.evidence - top) / unit) for fit in self.fits) / self.types
        gain = (self.unlisted.evidence - top) / unit + self.choice - np.log(NUMBERS_APART * listed)
        top = max((fit.common or fit).evidence for fit in self.fits)
        common = (self.unlisted.common or self.unlisted).evidence
        plain = (common - top) / tempered(top, False) - np.log(ALTERNATIVES)
        gain = max(gain, plain) if self.types > 1 else min(gain, plain)
        gain -= float(np.log(choices))
        odds = PRIOR_UNKNOWN / (1 - PRIOR_UNKNOWN) * np.exp(min(gain, 50.0))
        return float(odds / (1 + odds))

    @property
    def listed(self) -> bool:
        """Whether a type of the catalogue explains the train as well as any other would."""
        if self.unknown >= 0.5:
            return False
        return self.unlisted is None or self._train(self.fits[0]) or not self._train(self.unlisted)

    @property
    def families(self) -> dict[str, float]:
        """Probability of every family, most probable first."""
        found: dict[str, float] = {}
        for p, fit in zip(self.probabilities, self.fits, strict=True):
            found[fit.train.family] = found.get(fit.train.family, 0.0) + (1 - self.unknown) * p
        return dict(sorted(found.items(), key=lambda item: -item[1]))

    @property
    def known(self) -> bool:
        """Whether a type is named: its family holds, and no other train is left.

        Trains of like proportions differ by less than wheelsets do within a car, so that the most
        probable one of several is often wrong. Where only one type may be it, nothing is chosen.
        """
        return self.listed and (self.types == 1 or max(self.families.values()) >= HELD)

    @property
    def best(self) -> ResponseFit:
        """The most probable fit; of the train of equal cars if no type of the catalogue is."""
        return self.fits[0] if self.listed or self.unlisted is None else self.unlisted

    @property
    def confirmed(self) -> bool:
        """Whether this is a train.

        Blows, rain or a hum can have some evidence too, but no common response explains three
        quarters of their waveform or of their energy, unless the evidence is overwhelming.
        """
        return any(self._train(fit) for fit in (*self.fits[:1], self.plain, self.unlisted) if fit)

    def _train(self, fit: ResponseFit) -> bool:
        common = fit.common or fit
        choices = 1
        if fit.places.size < _FEWEST:
            return False
        if fit.cars is not None:
            choices = CHOICES if fit is self.plain else CHOICES * WITH_POWER
            if fit.cars.cars < _REPEATED[fit is self.plain]:
                return False
        chosen = CORRELATED * float(np.log(choices))
        evidence = common.evidence - chosen
        certain = evidence > CERTAIN_EVIDENCE
        explained = min(model.unexplained for model in common.models) <= USUAL_MISFIT
        # wagons are empty or loaded: a known train need not weigh the same everywhere
        alike = common.alike or (certain and fit.cars is None)
        clear = evidence > CONFIRM_EVIDENCE and common.covariance is not None
        return clear and (explained or certain) and alike

    @property
    def unit(self) -> float:
        """What counts as one of correlated misfits; a train of equal cars is only like the true
        one."""
        return CORRELATED if self.listed else tempered(self.best.evidence)

    @property
    def motion(self) -> Motion:
        """Of the first wheelset past the reference, with what correlated misfit adds."""
        best = self.best
        covariance = np.zeros((3, 3))
        if best.covariance is not None:
            covariance[1:, 1:] = self.unit * best.covariance
        covariance[0, 0] = (self.middle[1] * best.speed) ** 2
        covariance[1, 1] += (best.acceleration * self.passing_sigma) ** 2
        if not self.listed:
            covariance[1, 1] += (CAR[1] * best.speed) ** 2
        half = 0.5 * best.train.span
        return Motion(self.middle[0], half, best.speed, best.acceleration, covariance)

    @property
    def passing_sigma(self) -> float:
        """How far (s) what answers may lie from the reference: all channels share one speed, and
        a bridge answers where it is soft."""
        apart = np.array([c.x - self.channels[0].x for c in self.channels])
        return float(np.hypot(self.middle[1], np.sqrt(np.mean(apart**2)) / self.best.speed))

    @property
    def relative(self) -> float:
        """Relative sigma of the time that the train takes, whatever its size."""
        best = self.best
        own = self.unit * best.covariance[0, 0] if best.covariance is not None else 0.0
        variance = float(own) / best.speed**2
        if self.listed:
            rate = best.speed / best.train.span
            pairs = zip(self.probabilities, self.fits, strict=True)
            variance += sum(p * (f.speed / f.train.span / rate - 1) ** 2 for p, f in pairs)
        return float(np.sqrt(variance))

    @property
    def by_duration(self) -> tuple[float, float]:
        """Speed by passing time and length (m/s), sigma."""
        speed = PASSED * self.best.train.span / self.duration
        return speed, PASSED_SPREAD * speed

    @property
    def speed(self) -> tuple[float, float, float]:
        """Speed of the middle of the train, sigma, half the interval that holds it (m/s).

        The mean of the trains that together hold 95 %: while types are ambiguous, the speed of one
        of them is wrong by all they differ by whenever another one is right.
        """
        listed = 1 - self.unknown
        parts = [
            (listed * p, fit.speed, float(np.sqrt(CORRELATED * fit.covariance[0, 0])))
            for p, fit in zip(self.probabilities, self.fits, strict=True)
            if fit.covariance is not None
        ]
        if self.unlisted is not None:
            parts.append((self.unknown, self.unlisted.speed, CAR[1] * self.unlisted.speed))
        own = self.motion.speed_sigma(self.middle[0])
        if not parts:
            return self.best.speed, own, _TWO_SIDED * own
        parts.sort(reverse=True)
        before = np.cumsum([p for p, _, _ in parts])
        held = parts[: 1 + int(np.searchsorted(before, HELD * before[-1]))]
        weight, value, sigma = (np.array(column) for column in zip(*held, strict=True))
        mean = float(weight @ value / weight.sum())
        spread = float(np.sqrt(weight @ ((value - mean) ** 2 + sigma**2) / weight.sum()))
        half = max(half_interval(parts, mean, HELD), _TWO_SIDED * own)
        return mean, max(spread, half / _TWO_SIDED), half


def _spectral(fit: ResponseFit) -> tuple[float, float] | None:
    """Speed (m/s, sigma) by the lines of the spectrum alone (multiples of v over the car length).

    Maximum likelihood of exponentially distributed power about noise and lines (Whittle); ``None``
    where another speed, as one half, explains the lines better.
    """
    model = fit.models[1]
    s = model.spectrum
    low = s.f <= fit.speed / COARSE
    if not low.any():
        return None
    v = fit.speed * np.exp(np.arange(-0.8, 0.8, 0.1 * COARSE / fit.train.span))
    power = np.abs(s.y[low]) ** 2
    bend = np.full(v.size, fit.acceleration)
    lines = np.abs(comb(fit.places, s.f[low], v, bend)) ** 2 / fit.places.size
    misfit = model.unexplained
    mean = s.noise[low] + s.excess[low] * (misfit + lines) / (1 + misfit)
    score = -s.share * np.sum(np.log(mean) + power / mean, axis=1)
    i = int(np.argmax(score))
    if not 0 < i < v.size - 1:
        return None
    bend_here = 2 * score[i] - score[i - 1] - score[i + 1]
    step = float(v[i + 1] - v[i])
    shift = 0.5 * (score[i + 1] - score[i - 1]) / bend_here
    sigma = step * float(np.sqrt(CORRELATED / bend_here))
    found = float(v[i]) + shift * step
    return (found, sigma) if abs(found - fit.speed) < 4 * sigma + 0.01 * found else None


def find_response(
    records: Sequence[Record],
    within: tuple[float, float],
    trains: Sequence[TrainType],
    limits: tuple[float, float],
) -> ResponsePassage | None:
    """The train that explains the channels best; ``None`` without anything to explain.

    Args:
        records: channels of any layer; the first is the reference.
        within: the event (s).
        trains: candidate types.
        limits: lowest and highest speed (m/s).
    """
    seen: list[Observation] = []
    used: list[Channel] = []
    oriented = _orientations(trains)
    for record in records:
        extent = strong_extent(record, within)
        if extent is None or extent[1] - extent[0] < _SHORTEST_S:
            continue
        series = observations(record, within, extent)
        if len(series) < 2:
            continue
        best, top = series[1], -np.inf
        for energy in series[1:]:
            alone = Search([energy], limits)
            for train, reverse in oriented:
                for fit in alone.coarse(train, reverse, bent=False):
                    if fit.evidence > top:
                        best, top = energy, fit.evidence
        seen += [series[0], best]
        used.append(record.channel)
    if not seen:
        return None
    search = Search(seen, limits)
    coarse = search.scan(oriented)
    listed = search.refined(coarse) if any(fit.evidence > 0 for fit in coarse) else []
    others = unlisted(search, listed)
    listed += search.transferred(oriented, [*listed[:2], *others])
    together = search.shared([*listed, *others])
    if not together or together[0].evidence < 0:
        return None
    first = others[0].cars if others else None
    plain = next((fit for fit in together if fit.cars is not None and fit.cars == first), None)
    equal = next((fit for fit in together if fit.cars is not None), None)
    together = [fit for fit in together if fit.cars is None or fit is equal]
    if together[0].evidence > CONFIRM_EVIDENCE:  # else no train is told
        together = search.varied(together)
    fits = [fit for fit in together if fit.cars is None]
    other = next((fit for fit in together if fit.cars is not None), None)
    choice = 0.0
    if other is not None and other.cars is not None and other.common is not None:
        near = other.cars.proportions()
        other, values = proportions(search, other, near)
        gains = (values - values.max()) / tempered(float(values.max()))
        usual = np.array([cars.prior for cars in near])
        choice = float(np.log(usual @ np.exp(gains) / usual.sum()))
    top = fits[0].evidence if fits else 0.0
    unit = tempered(top)
    likely = [fit for fit in distinct(fits) if fit.evidence > top - KEPT * unit / CORRELATED]
    weight = np.exp([(fit.evidence - top) / unit for fit in likely])
    likely = [_by_loads(search, fit) for fit in likely]
    channels = tuple(used)
    told = ResponsePassage(
        tuple(likely),
        tuple(float(w) for w in weight / weight.sum()),
        channels,
        (0.0, 0.0),
        0,
        search.duration,
        None,
        other,
        plain,
        choice,
        len(trains),
    )
    placed = [search.passing(told.best, k, told.unit) for k in range(len(used))]
    middle, sigma = placed[0]
    if not told.listed and told.unlisted is not None:
        common = told.unlisted.common or told.unlisted
        own = ends_sigma(search, common, tempered(common.evidence, False))
        # the vehicles at its ends may be others: up to half a car more or less, each as likely
        half = 0.5 * CAR[0] / common.speed
        sigma = float(np.sqrt(sigma**2 + own**2 + half**2 / 3))
    return replace(
        told,
        middle=(middle, sigma),
        direction=_direction(channels, placed, told.best.speed) if told.listed else 0,
        spectral=_spectral(told.best) if told.listed else None,
    )


def _by_loads(search: Search, fit: ResponseFit) -> ResponseFit:
    """The fit with the motion of the one that has a load for every wheelset."""
    own = loaded(search, fit.common or fit)
    return replace(fit, speed=own.speed, acceleration=own.acceleration, covariance=own.covariance)


def _direction(
    channels: Sequence[Channel], placed: Sequence[tuple[float, float]], speed: float
) -> int:
    """+1 or -1 by the two outer slab channels if their delay is clear and agrees with the speed.

    Not by bridge channels: a span answers where it is soft, not where its sensor is.
    """
    slabs = [k for k, channel in enumerate(channels) if channel.layer != "bridge"]
    if len(slabs) < 2:
        return 0
    a = min(slabs, key=lambda k: channels[k].x)
    b = max(slabs, key=lambda k: channels[k].x)
    delay = placed[b][0] - placed[a][0]
    sigma = float(np.hypot(placed[a][1], placed[b][1]))
    expected = (channels[b].x - channels[a].x) / speed
    if abs(delay) < 4 * sigma or abs(abs(delay) - expected) > 3 * sigma:
        return 0
    return 1 if delay > 0 else -1
