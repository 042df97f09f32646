"""The motion of a train whose wheelsets have loads of their own.

Power cars are heavier than coaches, the last bogie of an articulated train carries half of what the
others do, and a wagon may be empty. All channels see the same loads: taken as misfit they would be
counted once a channel, and shift the motion by more than it says.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .kinematics import PRIOR_ACCELERATION
from .response_search import FINE, PASSED, PASSED_SPREAD, ResponseFit, Search

Array = NDArray[np.float64]

_STEPS = 4  # of Gauss and Newton
_FIRST = 0.1  # of the mean load, standard deviation to begin with
_SPREAD = 0.005, 0.5  # its range
_FURTHEST = 0.2  # of the shortest waves over the train, largest step of the motion


def loaded(search: Search, fit: ResponseFit) -> ResponseFit:
    """The fit with loads, and with the motion and its covariance that are most probable with them.

    ``y(t) = sum_i (1 + e_i) r(t - t_i)`` with ``e_i`` of one variance and the same for all
    observations. Motion, loads and responses are solved for together (Gauss and Newton), the
    variance of the loads by expectation and maximization; the covariance is marginal.

    Args:
        search: what was seen.
        fit: with one response for all wheelsets.
    """
    size = fit.places.size
    spread, covariance = _FIRST, np.zeros((2, 2))
    expected = PASSED * fit.train.span / search.duration
    most = _FURTHEST * FINE / fit.train.span * fit.speed
    fit = replace(fit, loads=tuple(np.ones(size)))
    for _ in range(_STEPS):
        normal, right = np.zeros((size + 2, size + 2)), np.zeros(size + 2)
        for model in fit.models:
            own, wanted = model.information(fit.places, fit.speed, fit.acceleration, fit.loads)
            normal, right = normal + own, right + wanted
        loads = np.array(fit.loads)
        normal[range(size), range(size)] += spread**-2
        right[:size] -= (loads - 1) * spread**-2
        prior = np.array([PASSED_SPREAD * fit.speed, PRIOR_ACCELERATION]) ** -2
        normal[[-2, -1], [-2, -1]] += prior
        right[-2:] -= prior * np.array([fit.speed - expected, fit.acceleration])
        inverse = np.asarray(np.linalg.inv(normal), dtype=np.float64)
        step = inverse @ right
        step *= min(1.0, most / max(abs(float(step[-2])), 1e-12))
        loads = loads + step[:size]
        variance = float(np.mean((loads - 1) ** 2 + np.diag(inverse)[:size]))
        spread = float(np.clip(np.sqrt(variance), *_SPREAD))
        v, a = fit.speed + float(step[-2]), fit.acceleration + float(step[-1])
        fit = replace(fit, speed=v, acceleration=a, loads=tuple(float(x) for x in loads))
        fit, covariance = search.weighted(fit), inverse[-2:, -2:]
    fit = replace(fit, covariance=covariance)
    return replace(fit, covariance=search.beside(fit, FINE).covariance)
