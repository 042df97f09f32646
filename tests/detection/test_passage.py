"""Whether wheelsets are seen whose energy hardly rises over what is beside them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from trackvib_ros.detection import Catalogue
from trackvib_ros.detection.axles import AxleFit
from trackvib_ros.detection.evidence import Explanation
from trackvib_ros.detection.kinematics import regress
from trackvib_ros.detection.passage import IN_PLACE, Hypothesis, Passage
from trackvib_ros.detection.passage_search import _apart
from trackvib_ros.detection.pattern import Trace

METRO = Catalogue.default().types[[t.name for t in Catalogue.default().types].index("metro")]
SPEED, APART = 40.0, 20.0  # m/s, m


def _passage(
    scatter: np.ndarray, direction: int = 1, contrast: float | np.ndarray = 0.2
) -> Passage:
    """A train on channels whose wheelsets are off their places by ``scatter`` (m)."""
    channels = len(scatter)
    places = np.stack([METRO.axles + k * APART for k in range(channels)])
    time = (places + scatter) / SPEED
    channel = np.repeat(np.arange(channels), METRO.axles.size)
    fit = regress(time.ravel(), places.ravel(), channel, 0.0, position_sigma=0.3)
    axles = AxleFit(
        motion=fit.motion,
        scale=fit.scale,
        time=time,
        residual=fit.residual.reshape(time.shape),
        contrast=np.broadcast_to(contrast, time.shape),
        observed=np.ones(time.shape, dtype=bool),
        offset=fit.offset,
        place=0.04 * np.eye(channels),
    )
    grid = np.arange(0.0, 10.0, 0.001)
    trace = Trace("a", 0.0, grid, np.ones(grid.size), np.ones(grid.size, bool), 1.0, 0.001)
    return Passage(
        interval=(0.0, 5.0),
        traces=(trace,) * channels,
        band=(5.0, 150.0),
        hypotheses=(Hypothesis(METRO, False, direction, 0.68, axles, probability=1.0),),
        direction=direction,
    )


def test_wheelsets_in_their_places_are_seen_without_contrast():
    rng = np.random.default_rng(1)
    shape = (2, METRO.axles.size)
    exact = _passage(rng.normal(0.0, 0.05, shape))
    # uniform in 2.2 m against normal of 5 cm: ln(2.2 / 0.125) - 1/2 a wheelset
    assert exact._in_place == pytest.approx(shape[1] * 2 * 2.37, rel=0.15)
    assert exact.confirmed
    assert not _passage(rng.normal(0.0, 0.05, shape), direction=0).confirmed


def test_wheelsets_anywhere_are_not_seen():
    rng = np.random.default_rng(2)
    strong = 0
    for _ in range(200):
        chance = _passage(rng.uniform(-1.1, 1.1, (2, METRO.axles.size)))
        assert chance._in_place < IN_PLACE / 3
        assert not chance.confirmed
        # nor where something strong is found in every window
        loud = replace(chance.hypotheses[0].fit, contrast=np.full((2, METRO.axles.size), 1.3))
        (best,) = chance.hypotheses
        chance = replace(chance, hypotheses=(replace(best, fit=loud),))
        assert chance.confirmed is (chance._in_place >= 0)
        strong += chance.confirmed
    # the spread of 48 places is known to a tenth, and the limit is a sixth below that of chance
    assert strong < 0.1 * 200


def test_one_channel_names_no_type_that_is_a_car_longer_than_what_is_strong():
    """All wheelsets of a train rise alike; where none is, the largest of noise does so by less."""
    rng = np.random.default_rng(3)
    exact = np.zeros((1, METRO.axles.size))
    named = []
    for _ in range(300):
        rise = rng.normal(1.3, 0.35, METRO.axles.size)  # ln, as at 10 dB
        alone = np.concatenate([rng.normal(0.6, 0.3, 8), rise[8:]])
        named.append([_passage(exact, 0, c).known for c in (rise, alone, alone[::-1])])
    whole, front, rear = np.sum(named, axis=0)
    # one in a thousand at either end: four or more of 600 have a chance of 0.3 %
    assert whole > 300 - 4
    # two standard deviations between eight and the rest: the test's power is nine tenths
    assert front < 0.2 * 300 and rear < 0.2 * 300


def test_a_listed_train_is_not_two_of_which_one_is_none():
    whole = _passage(np.random.default_rng(4).normal(0.0, 0.05, (2, METRO.axles.size)))
    relative = Explanation(0, "scaled", 0.9, whole.hypotheses[0].fit.motion)
    unlisted = replace(whole, explanations=(relative,))
    late = replace(whole, clock_offset=(("b", 0.2, 0.01),))
    assert whole.known and late.known and unlisted.confirmed and not unlisted.known
    assert [_apart(part, whole) for part in (whole, unlisted, late)] == [True, False, False]
    # what no type explains as a whole may be any two trains
    assert all(_apart(part, unlisted) for part in (whole, unlisted, late))
