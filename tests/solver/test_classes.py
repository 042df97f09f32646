"""The paper's three classes in time: the matrices over frequency, superposition, fe."""

from __future__ import annotations

import numpy as np
import pytest

from solver import InputError, Scenario, load_scenario, run_classes
from solver.classes import _march, band_model, split_rail
from solver.reference import vehicle_matrices
from solver.statistics import paper_sum, vectors


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return load_scenario("paper")


def test_a_band_has_the_three_classes_of_the_paper_at_its_centre(scenario: Scenario) -> None:
    """D of the band's M, C, K = own D less Eqs. (9) and (10); the wheel's blocks likewise."""
    structure, split, damping, is_global = split_rail(scenario)
    at = structure.rail_rows(np.array([9.3, 16.2])).toarray()
    rows, phi = split.load(at[:, is_global], at[:, ~is_global])
    omega = 2 * np.pi * 2800.0
    model = band_model(split, damping, rows, phi, omega)
    g = len(split.mass)
    held = paper_sum(vectors(split.coupling, phi.T, omega), split.omega, omega)
    own = split.stiffness + 1j * omega * damping - omega**2 * split.mass
    mine = model.stiffness + 1j * omega * model.damping - omega**2 * model.mass
    np.testing.assert_allclose(mine, own - held[:g, :g], rtol=1e-9, atol=1e-6 * abs(own).max())
    point = model.compliance + model.mobility / (1j * omega)
    np.testing.assert_allclose(point, np.diag(held[g:, g:]), rtol=1e-9)
    # the blocked force of the modes below: the real part of the mixed block
    np.testing.assert_allclose(
        (model.rows - rows).T, held[:g, g:].real, atol=1e-9 * np.abs(rows).max()
    )
    # the mass that is left is one: every mode below gives away no more than it has
    assert np.linalg.eigvalsh(model.mass).min() > 0


def test_runs_superpose(scenario: Scenario) -> None:
    """Linear: the sum of runs is the run of the sum, but for rounding in stiff modes (6e-7)."""
    structure, split, damping, is_global = split_rail(scenario)
    step = scenario.solution.step
    place = 12.0 + scenario.train[0].speed * step * np.arange(300)
    at = structure.rail_rows(place).toarray()
    rows, phi = split.load(at[:, is_global], at[:, ~is_global])
    model = band_model(split, damping, rows, phi, 2 * np.pi * 3000.0)
    rough = 2e-6 * (1 - np.cos(2 * np.pi * place / 0.03))
    vehicle = vehicle_matrices(scenario.train[0])
    spring = 2 * scenario.contact.stiffness

    def march(rough: np.ndarray, weighted: bool) -> np.ndarray:
        return _march(model, vehicle, spring, rough - rough[0], step, weighted)

    together = march(rough, True)
    np.testing.assert_allclose(march(0 * rough, True) + march(rough, False), together, rtol=5e-6)
    assert np.ptp(together) > 1e3


def test_what_cannot_be_superposed_is_refused(scenario: Scenario) -> None:
    hertz = scenario.contact.model_copy(update={"law": "hertz"})
    with pytest.raises(InputError, match=r"contact\.law"):
        run_classes(scenario.model_copy(update={"contact": hertz}))
    solution = scenario.solution.model_copy(update={"sines": None})
    with pytest.raises(InputError, match=r"solution\.sines"):
        run_classes(scenario.model_copy(update={"solution": solution}))
    train = scenario.train[0].model_copy(update={"direction": "backward"})
    with pytest.raises(InputError, match="forward"):
        run_classes(scenario.model_copy(update={"train": (train,)}))
