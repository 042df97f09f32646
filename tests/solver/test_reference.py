"""Whole runs against a second method, and the second method against closed forms."""

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse.linalg as spla

from solver import InputError
from solver.line import assemble, beam_sections
from solver.reference import DEGREE, ReferenceLine, _TimoshenkoGrid, reference_run
from solver.validation import compare_reference, reference_scenario


def test_rail_elements_follow_the_dispersion_relation():
    """Pinned Timoshenko rail of 10 bays, against the closed form to 4.8 kHz."""
    track = reference_scenario().track
    grid = _TimoshenkoGrid(np.linspace(0, 6.5, 21), 0, track)
    mass, stiffness = np.zeros((2, grid.size, grid.size))
    for e, h in enumerate(np.diff(grid.corners)):
        part = slice(2 * e * DEGREE, 2 * (e + 1) * DEGREE + 2)
        m, k = grid.element_matrices(float(h))
        mass[part, part] += m
        stiffness[part, part] += k
    free = np.setdiff1d(np.arange(grid.size), [0, grid.size - 2])
    squared = scipy.linalg.eigh(
        stiffness[np.ix_(free, free)], mass[np.ix_(free, free)], eigvals_only=True
    )
    order = np.array([1, 5, 10, 20, 30, 33])
    section = beam_sections(track)["rail"]
    exact = [section.frequency(n * np.pi / 6.5) for n in order]
    np.testing.assert_allclose(np.sqrt(squared)[order - 1] / (2 * np.pi), exact, rtol=2e-6)


@pytest.mark.parametrize("theory", ["timoshenko", "euler_bernoulli"])
def test_static_compliance_is_that_of_the_solver(theory):
    """Two methods, each completed under the load by a formula of its own.

    3e-4 is what the solver's sines leave of the slab's dent under a fastening.
    """
    scenario = reference_scenario(theory)
    line, structure = ReferenceLine(scenario), assemble(scenario)
    places = 12.0 + np.array([0.0, 0.07, 0.21, 0.4, 0.55])
    loads = np.array([line.rail(x) for x in places])
    missing = np.array([line.missing(x) for x in places])
    theirs = (loads * spla.splu(line.stiffness).solve(loads.T).T).sum(axis=1) + missing
    rows = structure.rail_rows(places).toarray()
    solved = spla.spsolve(structure.stiffness.tocsc(), rows.T)
    ours = (rows * solved.T).sum(axis=1) + structure.missing_rail_compliance(places)
    np.testing.assert_allclose(ours, theirs, rtol=3e-4)
    if theory == "timoshenko":
        # the kink is no trifle: an error of its size would be seen
        assert missing.max() > 1e-3 * theirs.max()


def check(rows, limit):
    for row in rows:
        assert row.error < limit(row), row
        assert row.correlation > 0.999, row


def test_wheel_element_on_a_bridge_below_2_khz():
    """The issue's 1 % of the peak; the second method itself is within 0.2 % at this step."""
    check(compare_reference(step=12.5e-6, edges=(2000.0,)), lambda row: 0.01)


@pytest.mark.slow
def test_wheel_element_on_a_bridge_to_the_frequency_limit():
    """1 % of the peak everywhere, but for the rail's acceleration as a wheel crosses the sensor.

    There the modes above the limit, which answer statically, lack 1.1 % at 3 and 3 % at 4.5 kHz.
    """

    def limit(row):
        above = row.quantity == "rail acceleration" and row.edge > 2000
        return 0.01 * (row.edge / 2000) ** 1.5 if above else 0.01

    check(compare_reference(), limit)


@pytest.mark.slow
def test_euler_bernoulli_rail_under_a_car():
    car = {"preset": "CRH3", "bogie_centres": 4.0, "wheelbase": 2.0, "length": 7.5}
    scenario = reference_scenario("euler_bernoulli", car)
    check(compare_reference(scenario, edges=(1000.0, 2000.0)), lambda row: 0.01)


def test_what_it_does_not_do_is_refused():
    scenario = reference_scenario()
    hertz = scenario.contact.model_copy(update={"law": "hertz"})
    with pytest.raises(InputError, match=r"contact\.law"):
        reference_run(scenario.model_copy(update={"contact": hertz}), 1e-4)
    train = scenario.train[0].model_copy(update={"start": -5.0})
    with pytest.raises(InputError, match="leaves the line"):
        reference_run(scenario.model_copy(update={"train": (train,)}), 1e-4)
