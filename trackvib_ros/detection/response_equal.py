"""The trains of equal cars that explain all observations best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .kinematics import PRIOR_ACCELERATION
from .response_search import FINE, KEPT, PASSED, PASSED_SPREAD, ResponseFit, Search, ranked
from .unlisted import CAR, EqualCars, like, starts

Array = NDArray[np.float64]

_CARS = (30.0, 13.5)  # m, longest and shortest cars, at the lowest and the highest speed: no wagons
_ABOUT = -0.12, 0.12  # ln of speed, range of a train of equal cars: one car of four
_STARTS = 4  # trains to begin with, by a first look
_LIKE = 3  # the same, by the cars of listed types
_RATES = 0.1  # difference of the logarithms of their rates
_GROWN = 3  # of them that are followed


def _harmonics(fit: ResponseFit) -> list[ResponseFit]:
    """The fit with cars twice and half as long."""
    assert fit.cars is not None
    found = []
    for factor in (0.5, 2.0):
        number = max(2, round(fit.cars.cars * factor))
        v, a = factor * fit.speed, factor * fit.acceleration
        found += [replace(fit.of(kind), speed=v, acceleration=a) for kind in fit.cars.kinds(number)]
    return found


def unlisted(given: Search, listed: Sequence[ResponseFit]) -> list[ResponseFit]:
    """The trains of equal cars, and no others, by a first look, and the one that explains most.

    Their speed is that of cars of :data:`CAR`. The second one, which may have a locomotive, is
    sought from the first and from the cars of the listed types that explain most: an unlisted train
    like one of them must not go by its name because it was not tried. That disturbances are no
    trains is asked of the first one, as the second one is freer, and of a long second one.
    """
    sizes = [limit * CAR[0] / length for limit, length in zip(given.limits, _CARS, strict=True)]
    search = Search(given.seen, (sizes[0], sizes[1]))
    found = []
    for cars in starts():
        near = search.coarse(cars.train, False, bent=False, about=_ABOUT)
        found += [(fit, cars) for fit in near[:1]]
    pool: list[ResponseFit] = []
    plain: list[ResponseFit] = []
    if found:
        found.sort(key=lambda pair: -pair[0].evidence)
        fit, cars = found[0]
        best = search.refined(search.coarse(cars.train, False, about=_ABOUT)[:2] or [fit])[0]
        best = _plain(search, best.of(cars))
        plain.append(best)
        pool.append(best)
        leaders = [best, *listed[:1]]
        for fit, cars in found[1:]:
            if len(pool) > _STARTS:
                break
            if all(abs(np.log(fit.speed / other.speed)) > _RATES for other in pool):
                pool += [replace(fit.of(cars), models=f.models) for f in leaders]
    for fit in listed[:_LIKE]:
        alike = like(fit.train)
        if alike is not None:
            cars, length = alike
            ratio = CAR[0] / length
            v, a = ratio * fit.speed, ratio * fit.acceleration
            pool.append(replace(fit.of(cars), speed=v, acceleration=a, reverse=False))
    pool = grown(search, pool)
    # a bogie in the middle of a car looks like shorter cars, and the other way round
    pool += grown(search, [other for fit in pool[:1] for other in _harmonics(fit)], 1)
    if not pool:
        return []
    final = []
    pool = ranked(pool)
    for fit in [f for f in pool[:2] if f.evidence > pool[0].evidence - KEPT]:
        fit = search.weighted(search.climb(fit, FINE, 2))
        final.append(search.climb(grown(search, [fit])[0], FINE, 2))
    return [*(plain or ranked(final)[:1]), ranked(final)[0]]


def _plain(search: Search, fit: ResponseFit) -> ResponseFit:
    """The train of equal cars alone near a first one."""
    for kind in (EqualCars.numbers, EqualCars.proportions, EqualCars.numbers):
        assert fit.cars is not None
        near = 1 + 0.06 * FINE / fit.train.span * np.arange(-2.0, 3.0, 2.0)
        v, a = fit.speed * near, np.full(near.size, fit.acceleration)
        trials = kind(fit.cars)
        values = [float(search.total(fit.of(trial), v, a).max()) for trial in trials]
        fit = fit.of(trials[int(np.argmax(values))])
    return search.climb(search.weighted(search.climb(fit, FINE, 2)), FINE, 2)


def grown(search: Search, fits: Sequence[ResponseFit], followed: int = _GROWN) -> list[ResponseFit]:
    """The trains of equal cars that one change of a kind after the other makes of some.

    Of the ``followed`` likely ones only, most probable first.
    """
    low, high = search.limits
    fits = [fit for fit in fits if low <= fit.speed <= high]
    kinds = EqualCars.numbers, EqualCars.powered, EqualCars.proportions, EqualCars.numbers
    for kind in kinds:
        fits = [
            max(
                (changed(search, fit, cars) for cars in kind(fit.cars)),
                key=lambda each: each.evidence,
            )
            for fit in fits
            if fit.cars is not None
        ]
        fits = ranked(fits)[:followed]
    return list(fits)


def ends_sigma(search: Search, fit: ResponseFit, unit: float) -> float:
    """How well the times (s) of first and last wheelset of a train of equal cars are known.

    A vehicle more or less at an end, of its own size, changes what all others do but little: rms
    over all that are tried, as far as the evidence tells.

    Args:
        unit: difference of evidence that stands for a factor e.
    """
    assert fit.cars is not None
    trials = [changed(search, fit, cars) for cars in (*fit.cars.numbers(), *fit.cars.powered())]
    evidence = np.array([trial.evidence for trial in trials])
    weight = np.exp((evidence - evidence.max()) / unit)
    half = np.array([0.5 * trial.train.span / trial.speed for trial in trials])
    middle = np.array([trial.models[-1].centre for trial in trials])
    ends = np.stack([middle - half, middle + half])
    mean = ends @ weight / weight.sum()
    return float(np.sqrt(np.mean((ends - mean[:, None]) ** 2 @ weight / weight.sum())))


def changed(search: Search, fit: ResponseFit, cars: EqualCars) -> ResponseFit:
    """The fit with other equal cars, of which the first, the last or the middle stays."""
    assert fit.cars is not None
    new = fit.of(cars)
    before, after = fit.cars.ends, cars.ends
    keep = [b - a for b, a in zip(before, after, strict=True)]
    shifts = np.unique(np.round([0.0, *keep], 3)) / fit.speed
    total = np.zeros(shifts.size)
    for model in fit.models:
        total += model.evidence(new.comb(model), new.places.size, model.centre + shifts)[0]
    i = int(np.argmax(total))
    models = tuple(replace(m, centre=float(m.centre + shifts[i])) for m in fit.models)
    expected = PASSED * new.train.span / search.duration
    prior = -0.5 * (np.log(new.speed / expected) / PASSED_SPREAD) ** 2
    prior -= 0.5 * (new.acceleration / PRIOR_ACCELERATION) ** 2
    return replace(new, models=models, evidence=float(total[i]) + float(prior))


def proportions(
    search: Search, fit: ResponseFit, trials: Sequence[EqualCars]
) -> tuple[ResponseFit, Array]:
    """The best of some trains of equal cars, and the evidence of all of them.

    At the passing time of the fit.
    """
    v, a = np.array([fit.speed]), np.array([fit.acceleration])
    near = [fit.of(trial) for trial in trials]
    values = np.array([float(search.total(each, v, a)[0]) for each in near])
    best = near[int(np.argmax(values))]
    return replace(best, evidence=float(values.max())), values
