"""Speeds, times and their sigmas over trains drawn from the model by which they are stated."""

from dataclasses import replace

import numpy as np
import pytest

from tests.detection.test_evidence import BASELINE, SPEED, candidate
from trackvib_ros.detection import Catalogue, stated
from trackvib_ros.detection.catalogue import TrainType
from trackvib_ros.detection.evidence import explain
from trackvib_ros.detection.passage import Hypothesis, Passage
from trackvib_ros.detection.pattern import Trace

CRH3 = Catalogue.default()["CRH3"]
TWIN = TrainType("twin", tuple(1.009 * CRH3.axles), CRH3.cars)
TRACES = tuple(
    Trace(name, x, np.arange(4.0), np.ones(4), np.ones(4, dtype=bool), 1.0, 1.0)
    for name, x in (("a", 0.0), ("b", BASELINE))
)


def passage(true, place, seed):
    """A train whose pulses lie beyond its wheelsets by N(0, place²) m at every channel."""
    rng = np.random.default_rng(1000 + seed)
    offsets = place * rng.standard_normal(2) / SPEED
    found = []
    for train in (CRH3, TWIN):
        one = candidate(train.axles, true.axles, offsets=offsets, seed=seed, place=place)
        found.append(replace(one, fit=replace(one.fit, contrast=np.ones(one.fit.time.shape))))
    explanations = explain(found)
    hypotheses = [
        Hypothesis(t, False, 1, c.score, replace(c.fit, motion=e.motion), e.probability)
        for e in explanations
        if e.kind == "type"
        for t, c in (((CRH3, TWIN)[e.candidate], found[e.candidate]),)
    ]
    return Passage((0.0, 1.0), TRACES, (5.0, 150.0), tuple(hypotheses), 1, tuple(explanations))


@pytest.mark.parametrize("place", [0.03, 0.1, 0.3])
def test_the_speed_of_ambiguous_types_is_their_mean_with_its_sigma(place):
    rng = np.random.default_rng(3)
    runs, told, ratio, template, sure = 60, [], [], [], []
    for seed in range(runs):
        true = (CRH3, TWIN)[int(rng.integers(2))]
        found = passage(true, place, seed)
        assert found.known
        speed = stated.speed(found)
        told.append(speed.value - SPEED)
        ratio.append(told[-1] / speed.sigma)
        template.append(speed.template[0] - SPEED)
        sure.append(next(h.probability for h in found.hypotheses if h.train is true))
    # of runs cases told with probability p the part p is right, within 2.6 standard errors
    sure = np.array(sure)
    odds = np.maximum(sure, 1 - sure)
    error = np.sqrt(np.sum(odds * (1 - odds)))
    assert abs(np.sum(sure > 0.5) - np.sum(odds)) < 2.6 * error + 1.0
    # the mean has the least square error of all that can be told, the most probable type has not
    assert np.mean(np.square(told)) <= np.mean(np.square(template)) * (1 + 1e-9) + 1e-9
    # 60 intervals of 95 % hold 57 +- 1.7 times
    assert np.sum(np.abs(ratio) < 1.96) >= 53


def test_a_sure_type_has_its_own_speed():
    found = passage(CRH3, 0.02, 1)
    speed = stated.speed(found)
    assert speed.types == ("CRH3",)
    assert speed.value == speed.template[0]


def test_arrival_and_departure_within_their_sigmas():
    ratio = []
    for seed in range(60):
        for (time, sigma), place in zip(
            stated.ends(passage(CRH3, 0.05, seed), SPEED), CRH3.axles[[0, -1]], strict=True
        ):
            ratio.append((time - place / SPEED) / sigma)
    # 60 trains, whose two ends err together: an rms of 1 +- 0.09
    assert 0.75 < np.sqrt(np.mean(np.square(ratio))) < 1.25
