"""The motions and types that explain all observations best, from a coarse grid on."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .catalogue import TrainType
from .kinematics import PRIOR_ACCELERATION
from .response_model import (
    OCTAVES,
    Model,
    Observation,
    Spectrum,
)
from .unlisted import EqualCars

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

CORRELATED = 3.0
"""Misfit is not white: its neighbouring coefficients go together, so that this many count as one.
Mean square of error over sigma of the speed on computed passages when counted as independent."""

COARSE = 8.0
"""Shortest waves that are compared at first (m), shorter ones where a train is short."""

PASSED, PASSED_SPREAD = 0.95, 0.15
"""Part of the time between first and last wheelset in which 5 to 95 % of the energy come; its
relative spread."""

KEPT = 15.0
"""Evidence below the best at which a hypothesis is dropped."""

_MOST_MISFIT, _LEAST_MISFIT = 0.5, 0.001  # part of the spectrum that no response explains
_DEVIATIONS = 0.1, 0.3, 1.0  # power of what wheelsets of a car differ by, over the misfit
_REACHES, _RINGS = (40.0, 20.0, 10.0), (1.0, 0.5, 0.2)  # m before and after a wheelset; s
_MIDDLE, FINE = 4.0, 2.0  # m, shortest waves that are compared, later
_RANGE = (-0.35, 0.40)  # ln of speed about that of the passing time
_DECELERATION = 0.4  # of the speed, largest change over a passage
_LARGEST = 1.0  # m/s²
_PLACED = 0.3  # of its own width, distance of the centroid of a response from its wheelset
_WAVES = 14  # on a train, at least, at first: as many as on the shortest shipped one (112 m)
_NEIGHBOUR = 0.3  # cycles at the ends of a train between trial motions
_PART = 6  # wheelsets, at least, whose amplitude is measured by itself
_SHRUNK, _WEAKEST, _HEAVIEST = 1.5, 0.65, 2.5
_BLUR = 0.4  # of the evidence, what a coarse grid and an unknown misfit may cost
_CLEAR = 20.0  # evidence of a motion without acceleration
_MOST = 10  # hypotheses that are followed
_VARIED = 6  # of them whose wheelsets may differ
_PEAKS = 5  # of a type and orientation


@dataclass(frozen=True)
class ResponseFit:
    """One type in one orientation, fitted to all observations.

    Attributes:
        models: one per observation.
        motion: its distance is that of the first wheelset past the reference channel.
        evidence: ln of the marginal likelihood over that of a disturbance.
        common: the fit with one response for all wheelsets, if they may differ here.
        cars: what the train is made of, if it is none of the catalogue.
        loads: of the wheelsets over their mean, if they were sought.
    """

    train: TrainType
    reverse: bool
    speed: float
    acceleration: float
    evidence: float
    models: tuple[Model, ...] = ()
    covariance: Array | None = None
    common: ResponseFit | None = None
    cars: EqualCars | None = None
    loads: tuple[float, ...] = ()

    def of(self, cars: EqualCars) -> ResponseFit:
        """The fit with another train of equal cars."""
        return replace(self, train=cars.train, cars=cars)

    @property
    def places(self) -> Array:
        """Distance of every wheelset behind the middle of the train (m)."""
        return self.train.oriented(self.reverse) - 0.5 * self.train.span

    def comb(self, model: Model) -> ComplexArray:
        """:meth:`Model.comb` of its motion."""
        v, a = np.array([self.speed]), np.array([self.acceleration])
        return model.comb(self.places, v, a, self.loads)

    @property
    def amplitudes(self) -> Array:
        """How strongly the parts of the train answer, 1 for the common response, front first."""
        places = self.places
        parts = int(np.clip(places.size // _PART, 3, 8))
        groups = np.array_split(places, parts)
        normal, right = np.zeros((parts, parts)), np.zeros(parts)
        for model in self.models:
            own, wanted = model.shares(groups, places, self.speed, self.acceleration)
            normal, right = normal + own, right + wanted
        normal[np.diag_indices(parts)] += 1e-9 * np.trace(normal)
        return np.asarray(np.linalg.solve(normal, right), dtype=np.float64)

    @property
    def alike(self) -> bool:
        """Whether all parts of the train answer alike, but for a heavier vehicle.

        A few blows that happen to lie like some wheelsets do not.
        """
        size = self.amplitudes
        usual = float(np.median(size))
        return bool(
            usual < _SHRUNK and size.min() > _WEAKEST * usual and size.max() < _HEAVIEST * usual
        )


class Search:
    """Trial motions against some observations of one passage.

    The speed is that at which the middle of the train passes, taken as the same at all channels.
    """

    def __init__(self, seen: Sequence[Observation], limits: tuple[float, float]) -> None:
        self.seen = list(seen)
        self.limits = limits
        self.duration = min(s.duration for s in self.seen)

    def models(self, speed: float, wave: float, reach: float, ring: float) -> list[Model]:
        """Models for waves from ``wave`` (m) at about a speed, with one support."""
        room = 2 * reach / speed + ring
        return [
            Model(Spectrum(s, room, speed / wave), reach / speed, reach / speed + ring)
            for s in self.seen
        ]

    def coarse(
        self,
        train: TrainType,
        reverse: bool,
        bent: bool = True,
        about: tuple[float, float] | None = None,
    ) -> list[ResponseFit]:
        """The best motions of a train on long waves.

        Args:
            train, reverse: the train.
            bent: whether it may accelerate.
            about: range of the logarithm of its speed, for a train of free proportions: with short
                waves some of them look like any burst.
        """
        wave = COARSE if about else min(COARSE, train.span / _WAVES)
        expected = PASSED * train.span / self.duration
        speeds = expected * np.exp(np.arange(*(about or _RANGE), _NEIGHBOUR * wave / train.span))
        speeds = speeds[(speeds >= self.limits[0]) & (speeds <= self.limits[1])]
        if not speeds.size:
            return []
        bend = 4 * wave / self.duration**2
        most = min(_LARGEST, _DECELERATION * expected / self.duration) if bent else 0.0
        bends = np.clip(
            np.arange(-np.ceil(most / bend), np.ceil(most / bend) + 1) * bend, -most, most
        )
        places = train.oriented(reverse) - 0.5 * train.span
        prior = -0.5 * (np.log(speeds / expected) / PASSED_SPREAD) ** 2
        models = self.models(expected, wave, _REACHES[0], _RINGS[0])
        if not all(model.spectrum.usable for model in models):
            return []
        spacing = max(0.5 * _REACHES[0] / expected, 0.02)
        far = np.ceil(0.15 * self.duration / spacing)
        centres = np.arange(-far, far + 1) * spacing
        found = []
        for a in bends:
            each = [
                m.evidence(m.comb(places, speeds, np.full(speeds.size, a)), places.size, centres)
                for m in models
            ]
            total = prior - 0.5 * (a / PRIOR_ACCELERATION) ** 2
            total = total + sum(e.max(axis=1) for e in each)
            before, after = np.r_[-np.inf, total[:-1]], np.r_[total[1:], -np.inf]
            for i in np.flatnonzero((total >= before) & (total >= after)):
                placed = tuple(
                    replace(m, centre=float(centres[np.argmax(e[i])]))
                    for m, e in zip(models, each, strict=True)
                )
                v, score = float(speeds[i]), float(total[i])
                found.append(ResponseFit(train, reverse, v, float(a), score, placed))
        apart: list[ResponseFit] = []
        for fit in ranked(found):
            near = 2 * _NEIGHBOUR * wave / train.span
            if all(abs(fit.speed / other.speed - 1) > near for other in apart):
                apart.append(fit)
        return apart[:_PEAKS]

    def scan(self, oriented: Sequence[tuple[TrainType, bool]]) -> list[ResponseFit]:
        """:meth:`coarse` of all types; accelerations only of the likely ones, if any is."""
        fits = [fit for t, r in oriented for fit in self.coarse(t, r, bent=False)]
        top = max((fit.evidence for fit in fits), default=0.0)
        near = {
            (fit.train.name, fit.reverse)
            for fit in fits
            if top < _CLEAR or fit.evidence > (1 - _BLUR) * top - KEPT
        }
        return [f for t, r in oriented if (t.name, r) in near for f in self.coarse(t, r)]

    def total(self, fit: ResponseFit, v: Array, a: Array) -> Array:
        """Evidence and prior of motions near a fit, shape (motions,)."""
        places = fit.places
        expected = PASSED * fit.train.span / self.duration
        out = -0.5 * (a / PRIOR_ACCELERATION) ** 2
        out = out - 0.5 * (np.log(v / expected) / PASSED_SPREAD) ** 2
        for m in fit.models:
            combs = m.comb(places, v, a, fit.loads)
            out = out + m.evidence(combs, places.size, np.array([m.centre]))[:, 0]
        return out

    def climb(self, fit: ResponseFit, wave: float, steps: int) -> ResponseFit:
        """Newton steps to the top of a quadratic through nine motions about the last one."""
        dv = 0.12 * wave / fit.train.span
        grid = np.array([(i, j) for i in (-1.0, 0.0, 1.0) for j in (-1.0, 0.0, 1.0)])
        x, y = grid.T
        design = np.stack([np.ones(9), x, y, 0.5 * x * x, x * y, 0.5 * y * y], axis=1)
        v, a, covariance = fit.speed, fit.acceleration, None
        best, highest = (v, a), -np.inf
        for _ in range(steps):
            scale = np.array([dv * v, min(wave * (v / fit.train.span) ** 2, 0.3)])
            values = self.total(fit, v + scale[0] * x, a + scale[1] * y)
            top = int(np.argmax(values))
            if values[top] > highest:
                best = float(v + scale[0] * x[top]), float(a + scale[1] * y[top])
                highest = float(values[top])
            c = np.linalg.lstsq(design, values, rcond=None)[0]
            bend = -np.array([[c[3], c[4]], [c[4], c[5]]])
            if np.linalg.eigvalsh(bend)[0] > 0:
                move = np.linalg.solve(bend, c[1:3])
                move *= min(1.0, 1.5 / max(float(np.abs(move).max()), 1e-12))
                covariance = np.linalg.inv(bend) * np.outer(scale, scale)
            else:
                move, covariance = grid[top], None
            v, a = float(v + scale[0] * move[0]), float(a + scale[1] * move[1])
        value = float(self.total(fit, np.array([v]), np.array([a]))[0])
        if value < highest:  # no quadratic at this distance
            (v, a), value = best, highest
        return replace(fit, speed=v, acceleration=a, evidence=value, covariance=covariance)

    def adapted(self, fit: ResponseFit, wave: float, reference: float) -> ResponseFit:
        """The fit with models for finer waves, of the support and misfit with most evidence."""
        models = []
        for k, old in enumerate(fit.models):
            seen, reach = self.seen[k], old.before * reference
            best: tuple[float, Model] | None = None
            first = wave == _MIDDLE
            for r in _REACHES if first else (reach,):
                for ring in _RINGS if first else (old.after - old.before,):
                    spectrum = Spectrum(seen, 2 * r / reference + ring, reference / wave)
                    if not spectrum.usable:
                        continue
                    # one octave more than before
                    misfit = (old.misfit[0], *old.misfit[:-1])
                    model = Model(spectrum, r / reference, r / reference + ring, misfit)
                    free = max(reach - r, 0.0) / reference
                    centres = old.centre + np.linspace(-free, free, 5 if free else 1)
                    value, placed = self._placed(model, fit, centres)
                    if best is None or value > best[0]:
                        best = value, placed
            # too few coefficients on finer waves: the coarser ones stay
            models.append(old if best is None else best[1])
        return self.weighted(replace(fit, models=tuple(models)))

    def beside(self, fit: ResponseFit, wave: float) -> ResponseFit:
        """The fit at the best of its neighbouring maxima, its variance that of all of them."""
        v: Array = fit.speed * (1 + 0.12 * wave / fit.train.span * np.arange(-8.0, 9.0))
        values = self.total(fit, v, np.full(v.size, fit.acceleration))
        weight = np.exp((values - values.max()) / CORRELATED)
        mean = float(weight @ v / weight.sum())
        variance = float(weight @ (v - mean) ** 2 / weight.sum()) / CORRELATED
        covariance = fit.covariance
        if covariance is not None:
            covariance = covariance + np.diag([max(variance - covariance[0, 0], 0.0), 0.0])
        best = int(np.argmax(values))
        return replace(
            fit, speed=float(v[best]), evidence=float(values[best]), covariance=covariance
        )

    def weighted(self, fit: ResponseFit) -> ResponseFit:
        """The fit with the misfits of most evidence, of one octave after the other."""
        models = []
        for model in fit.models:
            combs, here = fit.comb(model), np.array([model.centre])
            best, top = model, float(model.evidence(combs, fit.places.size, here)[0, 0])
            for octave, factor in itertools.product(range(OCTAVES), (0.5, 2.0)):
                while True:
                    misfit = list(best.misfit)
                    misfit[octave] *= factor
                    if not _LEAST_MISFIT <= misfit[octave] <= _MOST_MISFIT:
                        break
                    trial = replace(best, misfit=tuple(misfit))
                    value = float(trial.evidence(combs, fit.places.size, here)[0, 0])
                    if value <= top:
                        break
                    best, top = trial, value
            models.append(best)
        return replace(fit, models=tuple(models))

    def shared(self, fits: Sequence[ResponseFit]) -> list[ResponseFit]:
        """Every fit with the models of whichever fit suit it best, most probable first.

        What one of two like trains has found of a response, the other one must be allowed, too:
        types must not be told apart by how well a search went.
        """
        trials = [[fit.models[k] for fit in fits] for k in range(len(self.seen))]
        return ranked([self._settled(self._suited(fit, trials, fits), FINE) for fit in fits])

    def varied(self, fits: Sequence[ResponseFit]) -> list[ResponseFit]:
        """The likely ones of shared fits with wheelsets that may differ within a car.

        By how much is sought at the most probable listed type and at the most probable train of
        equal cars, and allowed to all. Most probable first.
        """
        leaders: dict[bool, ResponseFit] = {}
        for fit in fits:
            leaders.setdefault(fit.cars is None, fit)
        least = (1 - _BLUR) * fits[0].evidence - KEPT
        near = [*leaders.values()]
        rest = [f for f in fits if f.evidence > least and all(f is not n for n in near)]
        near += rest[: _VARIED - len(near)]
        models = [self._deviating(fit) for fit in leaders.values()]
        trials = [[each[k] for each in models] for k in range(len(self.seen))]
        top: dict[bool, float] = {}
        found = []
        for fit in near:
            moved = self.climb(self._suited(fit, trials, near), FINE, 2)
            best = top[fit.cars is None] = max(moved.evidence, top.get(fit.cars is None, -np.inf))
            # the maxima beside it are asked where they count
            likely = moved.evidence > best - KEPT
            beside = self.beside(moved, FINE) if likely else fit
            found.append(replace(moved, covariance=beside.covariance, common=fit))
        return ranked(found)

    def _deviating(self, fit: ResponseFit) -> list[Model]:
        """Its models with the deviations and misfits of most evidence.

        Wheelsets may differ by what the common response leaves over, and most where that is most.
        """
        out = []
        for model in fit.models:
            here = np.array([model.centre])
            trials = [
                replace(
                    model,
                    deviation=tuple(deviation * m for m in model.misfit),
                    misfit=tuple(part * m for m in model.misfit),
                )
                for deviation in _DEVIATIONS
                for part in (1.0, 0.5, 0.25)
            ]
            placed = [self._placed(trial, fit, here) for trial in trials]
            out.append(max(placed, key=lambda pair: pair[0])[1])
        return out

    def _suited(
        self, fit: ResponseFit, trials: Sequence[Sequence[Model]], fits: Sequence[ResponseFit]
    ) -> ResponseFit:
        """The fit with the models, of those of every observation, and the centres, of the fits,
        that suit it best."""
        models = []
        for k, each in enumerate(trials):
            centres = np.unique(np.round([f.models[k].centre for f in fits], 4))
            distinct = {(m.before, m.after, m.misfit, m.deviation): m for m in each}
            placed = [self._placed(model, fit, centres) for model in distinct.values()]
            models.append(max(placed, key=lambda pair: pair[0])[1])
        return replace(fit, models=tuple(models))

    def _placed(self, model: Model, fit: ResponseFit, centres: Array) -> tuple[float, Model]:
        """Evidence of a model at the best of its centres."""
        values = model.evidence(fit.comb(model), fit.places.size, centres)[0]
        i = int(np.argmax(values))
        return float(values[i]), replace(model, centre=float(centres[i]))

    def _settled(self, fit: ResponseFit, wave: float) -> ResponseFit:
        """The top near a fit, its variance that of the maxima beside it."""
        moved = self.climb(fit, wave, 2)
        told = self.beside(moved, wave)
        return replace(moved, covariance=told.covariance)

    def transferred(
        self, oriented: Sequence[tuple[TrainType, bool]], fits: Sequence[ResponseFit]
    ) -> list[ResponseFit]:
        """Every type in the passing time, and with the models, of the fit that suits it best."""
        found = []
        for train, reverse in oriented:
            best: ResponseFit | None = None
            for fit in fits:
                ratio = train.span / fit.train.span
                near = 1 + 0.12 * FINE / train.span * np.arange(-4.0, 5.0, 2.0)
                v, a = ratio * fit.speed * near, np.full(near.size, ratio * fit.acceleration)
                if not self.limits[0] <= ratio * fit.speed <= self.limits[1]:
                    continue
                trial = replace(fit, train=train, reverse=reverse, cars=None)
                values = self.total(trial, v, a)
                i = int(np.argmax(values))
                if best is None or values[i] > best.evidence:
                    v_best, a_best, value = float(v[i]), float(a[i]), float(values[i])
                    best = replace(trial, speed=v_best, acceleration=a_best, evidence=value)
            if best is not None:
                found.append(best)
        return ranked(found)[:_PEAKS]

    def passing(self, fit: ResponseFit, channel: int, unit: float) -> tuple[float, float]:
        """When the middle of the train passes a channel (s), sigma.

        By waveform and energy of the channel; where they contradict each other, sigma is wider.

        Args:
            unit: difference of evidence that stands for a factor e.
        """
        both = [self._place(fit, k, unit) for k in (2 * channel, 2 * channel + 1)]
        time, sigma = np.array(both).T
        weight = sigma**-2 / np.sum(sigma**-2)
        mean = float(weight @ time)
        contradiction = float(np.sum(((time - mean) / sigma) ** 2))
        return mean, float(np.sqrt(max(1.0, contradiction) / np.sum(sigma**-2)))

    def _place(self, fit: ResponseFit, k: int, unit: float) -> tuple[float, float]:
        """When the middle of the train passes by observation ``k`` (s), sigma.

        A response begins before its wheelset and rings after it; computed passages have its
        centroid within 0.3 of its own width of the wheelset (rms), but for free vibration. Which
        support it has, and where, is known as far as the evidence tells: mean and spread over all
        that are tried.
        """
        old = fit.models[k]
        top, step = float(old.spectrum.f[-1]), FINE / fit.speed
        far = _REACHES[0] / fit.speed
        centres = old.centre + np.arange(-far, far + 0.5 * step, step)
        values, places, widths = [], [], []
        for reach, ring in itertools.product(_REACHES, _RINGS):
            before = reach / fit.speed
            spectrum = Spectrum(self.seen[k], 2 * before + ring, top)
            model = replace(old, spectrum=spectrum, before=before, after=before + ring)
            combs = fit.comb(model)
            values.append(model.evidence(combs, fit.places.size, centres)[0])
            place, width = model.centroids(combs, fit.places.size, centres, k % 2 == 0)
            places.append(place)
            widths.append(width)
        value, place, width = (np.concatenate(each) for each in (values, places, widths))
        weight = np.exp((value - value.max()) / unit)
        weight /= weight.sum()
        mean = float(weight @ place)
        variance = float(weight @ ((place - mean) ** 2 + (_PLACED * width) ** 2))
        return old.spectrum.epoch + mean, float(np.hypot(np.sqrt(variance), self.seen[k].rings))

    def refined(self, fits: Sequence[ResponseFit]) -> list[ResponseFit]:
        """The likely ones of coarse fits on finer and finer waves, most probable first."""
        for wave in (_MIDDLE, FINE):
            best = max(fits, key=lambda fit: fit.evidence)
            kept = KEPT + (_BLUR * abs(best.evidence) if wave == _MIDDLE else 0.0)
            near = [fit for fit in fits if fit.evidence > best.evidence - kept]
            leaders = {id(fit): fit for fit in sorted(near, key=lambda fit: fit.evidence)}
            first = {fit.train.name: id(fit) for fit in leaders.values()}
            near.sort(key=lambda fit: (first[fit.train.name] != id(fit), -fit.evidence))
            fits = []
            for fit in near[:_MOST]:
                moved = self.beside(self.adapted(fit, wave, best.speed), wave)
                fits.append(self._settled(self.weighted(self.climb(moved, wave, 2)), wave))
        return ranked(fits)


def ranked(fits: Sequence[ResponseFit]) -> list[ResponseFit]:
    """Fits, most probable first."""
    return sorted(fits, key=lambda fit: -fit.evidence)


def distinct(fits: Sequence[ResponseFit]) -> list[ResponseFit]:
    """Fits without those that a better one of the same type repeats."""
    kept: list[ResponseFit] = []
    for fit in fits:
        alike = [f for f in kept if f.train is fit.train and f.reverse == fit.reverse]
        near = 2 * _NEIGHBOUR * COARSE / fit.train.span
        if all(abs(f.speed / fit.speed - 1) > near for f in alike):
            kept.append(fit)
    return kept
