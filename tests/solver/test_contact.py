"""Contact: equilibrium within a step, Hertz against its linearisation, loss of contact."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from solver.contact import compression_of, force_of, hertz_constant, solve_contact, wheelset_law
from solver.scenario import Contact

HERTZ = wheelset_law(Contact(law="hertz"), 0.46)


def test_hertz_constant_and_wheelset_law():
    # one wheel under 70 kN: delta = G p^(2/3) with G = 3.86e-8 * 0.46^-0.115
    g = 3.86e-8 * 0.46**-0.115
    assert hertz_constant(0.46) == pytest.approx(g)
    delta = g * 70e3 ** (2 / 3)
    assert force_of(delta, *HERTZ) == pytest.approx(2 * 70e3)
    assert wheelset_law(Contact(stiffness=1.0e9), 0.46) == (2.0e9, 0.0)


def test_hertz_is_linear_for_small_changes_about_the_static_load():
    load = 137_340.0
    delta = compression_of(np.array([load]), np.array([HERTZ[0]]), np.array([HERTZ[1]]))[0]
    stiffness = 1.5 * load / delta
    change = 1e-5 * delta
    slope = (force_of(delta + change, *HERTZ) - force_of(delta - change, *HERTZ)) / (2 * change)
    # odd terms of the central difference: (change/delta)^2 / 24
    assert slope == pytest.approx(stiffness, rel=1e-9)
    compliance = 3e-10
    gap = delta + compliance * load
    for small in (1e-9, -1e-9):
        moved = solve_contact(gap + small, compliance, *HERTZ) - load
        assert moved == pytest.approx(small * stiffness / (1 + compliance * stiffness), rel=1e-4)


@given(
    gap=st.floats(-1e-2, 1e-2, allow_subnormal=False),
    compliance=st.floats(0, 1e-7, allow_subnormal=False),
)
@pytest.mark.parametrize("law", [HERTZ, (2.65e9, 0.0)])
def test_force_and_compression_are_in_equilibrium(law, gap, compliance):
    force = solve_contact(gap, compliance, *law)
    remaining = gap - compliance * force
    scale = max(abs(force), force_of(abs(gap), *law))
    assert force_of(remaining, *law) == pytest.approx(force, abs=1e-9 * scale)


def test_hertzian_contact_opens_and_the_linear_one_pulls():
    assert solve_contact(-1e-5, 1e-10, *HERTZ) == 0.0
    assert solve_contact(-1e-5, 0.0, 2.65e9, 0.0) == pytest.approx(-2.65e4)


@given(st.floats(1.0, 1e7))
def test_compression_inverts_the_force(force):
    for law in (HERTZ, (2.65e9, 0.0)):
        delta = compression_of(np.array([force]), *(np.array([value]) for value in law))[0]
        assert force_of(delta, *law) == pytest.approx(force, rel=1e-12)
