"""The proofs themselves: each figure against its target, and each fails when it should."""

import numpy as np
import pytest

import solver.proofs as proofs
from solver.proofs import closure_error, ensemble_proofs, passage_energy, static_error
from solver.validation import BandError


def test_static_load_is_the_weight():
    # single-precision sums over the modes; asked for is 1e-4
    assert static_error() < 1e-5


def test_reported_force_closes_wheel_rail_and_profile():
    """2.5e-4 of the static load is measured: forces are taken as linear within a step."""
    assert closure_error() < 1e-3


def test_a_force_without_the_inertia_on_the_profile_does_not_close(monkeypatch):
    """What one peer reports: the wheel then does not follow the profile."""

    class Without(proofs.Simulation):
        def advance(self, samples):
            block = super().advance(samples)
            scenario = self.scenario
            parts = scenario.irregularity.components
            k, amplitude, phase = (
                np.array(part) for part in (parts.wavenumber, parts.amplitude, parts.phase)
            )
            train = scenario.train[0]
            curve = amplitude * (k * train.speed) ** 2
            x = block.wheelset_position
            block.wheelset_force[:] += train.vehicles[0].wheelset_mass * (
                curve[0] * np.cos(k[0] * x + phase[0])
            )
            return block

    monkeypatch.setattr(proofs, "Simulation", Without)
    assert closure_error() > 1e-2


@pytest.mark.slow
def test_energy_of_a_passage_to_5_khz():
    assert passage_energy() < 1e-3


def test_a_missed_target_is_said():
    error = {"repaired": np.array([[0.1, 0.2], [0.2, 0.6], [0.0, 0.1]]), "paper": np.zeros((3, 2))}
    band = BandError(1000.0, 0.5, error, np.full((3, 2), 1.0))
    found = ensemble_proofs({0.1: [band]}, 900)
    missed = [proof for proof in found if not proof.met]
    assert len(found) == 6
    assert len(missed) == 1
    assert "span: power in" in missed[0].item
    assert missed[0].found.startswith("+0.60 ± 0.03")


@pytest.mark.parametrize("count", [8, 15])
def test_modes_of_the_hierarchical_span_are_the_closed_form(count):
    line = proofs.bare_span(np.array([16.0]), kept=count)
    omega, zeta = proofs.span_modes(count)
    np.testing.assert_allclose(abs(line.eigenvalues), omega, rtol=1e-6)
    np.testing.assert_allclose(-line.eigenvalues.real / omega, zeta, rtol=1e-5)
