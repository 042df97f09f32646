"""The surface beyond pinned ends, on which wheelsets enter and leave."""

import numpy as np
from closed_forms import LENGTH

from solver.proofs import rolling_weight
from solver.traffic import END_ZONE, Traffic

LOAD = 1e5


def laid(start, end_time=None):
    """Traffic of one wheelset at 50 m/s with the ends laid; x and surface height under it."""
    scenario = rolling_weight(LOAD, [0.0], 50.0, start=start)
    solution = scenario.solution.model_copy(update={"end_time": end_time})
    scenario = scenario.model_copy(update={"solution": solution})
    traffic = Traffic(scenario)
    traffic.lay_ends(lambda x: 1e-9 * np.sin(np.pi * x / LENGTH) ** 2 * (1 + x / LENGTH))
    time = np.arange(0.0, (LENGTH + 10.0) / 50.0, 1e-3)
    (unit,) = traffic.running
    position = traffic.position(time)
    return position[:, 0], traffic.roughness([unit], position, time)[:, 0]


def test_a_crossing_wheelset_meets_a_surface_lowered_by_its_static_deflection():
    x, height = laid(start=-5.0)
    compliance = [1e-9 * np.sin(np.pi * END_ZONE / LENGTH) ** 2 * (1 + c) for c in (0.125, 0.875)]
    for outside, expected in zip((x < 0, x > LENGTH), compliance, strict=True):
        # beyond the end lower by load * compliance at the inner end of the zone
        np.testing.assert_allclose(height[outside], LOAD * expected, rtol=1e-12)
    inside = (x > END_ZONE) & (x < LENGTH - END_ZONE)
    assert inside.sum() > 400
    assert not height[inside].any()
    # in the outer half of the zone: what the deflection there lacks to it
    near = (x > 0.05) & (x < END_ZONE / 2)
    lacking = compliance[0] - 1e-9 * np.sin(np.pi * x[near] / LENGTH) ** 2 * (1 + x[near] / LENGTH)
    # the surface is piecewise linear over 160 pieces: c'' h^2 / 8 of 2e-11 m/N, 25 mm
    np.testing.assert_allclose(height[near], LOAD * lacking, atol=LOAD * 2e-15)


def test_a_wheelset_that_crosses_no_end_meets_no_surface():
    x, height = laid(start=1.0, end_time=0.5)
    assert not height[x < LENGTH].any()
