"""Receptance of a long line against the exact infinite periodic track, direct and modal."""

from __future__ import annotations

import numpy as np
import periodic
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg

from solver import build_scenario
from solver.line import assemble, beam_sections

CENTRES = 1000 * 10 ** (np.arange(-13, 8) / 10)
"""Third octaves from 50 Hz to 5 kHz."""


def subgrade(length, limit=5000.0, **track):
    return build_scenario(
        {
            "line": {"approach_left": length / 2, "approach_right": length / 2, "spans": []},
            "solution": {"frequency_limit": limit},
            "track": track,
        }
    )


def direct(structure, frequency, positions):
    """Driving-point receptance of the rail (m/N) by solving D(omega) u = F: (F, positions)."""
    positions = np.asarray(positions)
    rows = structure.rail_rows(positions).toarray()
    found = np.empty((len(frequency), len(positions)), complex)
    for i, f in enumerate(frequency):
        w = 2 * np.pi * f
        matrix = structure.stiffness - w**2 * structure.mass + 1j * w * structure.damping
        solved = scipy.sparse.linalg.splu(sp.csc_array(matrix)).solve(rows.T.astype(complex))
        found[i] = np.einsum("ij,ji->i", rows, solved)
    return found + structure.missing_rail_compliance(positions)


def band_level(values):
    return 10 * np.log10((abs(values) ** 2).mean(axis=1))


@pytest.mark.parametrize("theory", ["timoshenko", "euler_bernoulli"])
def test_third_octaves_of_the_infinite_periodic_track(theory):
    # Both are taken at the complex frequency f (1 - 0.005 i): at the pinned-pinned frequency the
    # infinite undamped rail has a pole and the finite line (62.4 m) echoes from its ends; a decay
    # of 0.5 % in observation resolves both. Eight lines per third octave, the same for both.
    frequency = (CENTRES[:, None] * 10 ** ((np.arange(8) - 3.5) / 80)).ravel() * (1 - 0.005j)
    scenario = subgrade(62.4, rail={"theory": theory})
    positions = {"mid-bay": (31.2, 0.325), "fastening": (31.525, 0.0), "between": (31.4, 0.125)}
    found = direct(assemble(scenario), frequency, [x for x, _ in positions.values()])
    for column, (name, (_, offset)) in enumerate(positions.items()):
        exact = np.array(
            [periodic.rail_receptance(scenario.track, f, offset, 4096) for f in frequency]
        )
        difference = band_level(found[:, column].reshape(-1, 8)) - band_level(exact.reshape(-1, 8))
        worst = int(np.argmax(abs(difference)))
        assert abs(difference[worst]) < 0.2, (name, CENTRES[worst], difference)


@pytest.mark.parametrize(
    ("theory", "spacing", "expected"),
    [
        ("timoshenko", 0.65, 954.0),
        ("euler_bernoulli", 0.65, 1241.0),
        ("euler_bernoulli", 0.612, 1400.0),
    ],
)
def test_pinned_pinned_frequency(theory, spacing, expected):
    # the rail between two fastenings vibrates as a simply supported beam: its mid-bay receptance
    # peaks there, and the closed form gives the figures of the literature. The line's first mode
    # lies above the band edge by 4 (1 / bays)^2 = 4e-4; the lines are 7.5e-4 apart.
    scenario = subgrade(
        100 * spacing, limit=2000.0, rail={"theory": theory}, fastening={"spacing": spacing}
    )
    section = beam_sections(scenario.track)["rail"]
    closed = section.frequency(np.pi / spacing)
    assert closed == pytest.approx(expected, abs=1.0)
    frequency = closed * np.linspace(0.985, 1.015, 41)
    found = direct(assemble(scenario), frequency, [50 * spacing])[:, 0]
    assert frequency[np.argmax(abs(found))] == pytest.approx(closed, rel=1.5e-3)


@pytest.mark.parametrize("theory", ["timoshenko", "euler_bernoulli"])
def test_winkler_limit_of_the_periodic_track(theory):
    # same stiffness per metre from pads ever closer, on a rigid base: the oracle itself
    track = subgrade(20.0, rail={"theory": theory}).track
    rigid = track.mortar.model_copy(update={"stiffness": 1e16, "damping": 0.0})
    ground = track.bed_on_subgrade.model_copy(update={"stiffness": 1e16, "damping": 0.0})
    for f in (50.0, 400.0, 1500.0):
        errors = []
        for spacing in (0.2, 0.1, 0.05):
            pad = track.fastening.model_copy(
                update={
                    "spacing": spacing,
                    "stiffness": 60e6 * spacing / 0.65,
                    "damping": 4.77e4 * spacing / 0.65,
                }
            )
            dense = track.model_copy(
                update={"fastening": pad, "mortar": rigid, "bed_on_subgrade": ground}
            )
            limit = periodic.winkler_receptance(dense, f)
            found = periodic.rail_receptance(dense, f, 0.3 * spacing, 4096)
            errors.append(abs(found - limit) / abs(limit))
        assert errors[0] > 2 * errors[1] > 4 * errors[2]
        assert errors[2] < 2e-3


def test_static_load_on_discrete_supports():
    # the periodic track at (almost) zero frequency is the closed form of the static rail; 137.3 kN;
    # 6e-6 is what the sines of the slab leave under its fastenings
    scenario = subgrade(41.6)
    structure = assemble(scenario)
    for x, offset in ((20.8, 0.325), (21.125, 0.0), (20.95, 0.175)):
        found = 137.3e3 * direct(structure, [1e-3], [x])[0, 0].real
        exact = 137.3e3 * periodic.rail_receptance(scenario.track, 1e-3, offset).real
        assert found == pytest.approx(exact, rel=1e-5)
        assert 0.4e-3 < exact < 1.2e-3


def test_receptance_is_reciprocal():
    scenario = build_scenario(
        {
            "line": {"approach_left": 5.0, "spans": [16.0], "approach_right": 4.0},
            "solution": {"frequency_limit": 1000.0},
            "channel": [
                {"name": "rail", "layer": "rail", "x": 12.3},
                {"name": "slab", "layer": "slab", "x": 9.1},
            ],
        }
    )
    structure = assemble(scenario)
    w = 2 * np.pi * 700.0
    matrix = structure.stiffness - w**2 * structure.mass + 1j * w * structure.damping
    factor = scipy.sparse.linalg.splu(sp.csc_array(matrix))
    rail = structure.rail_rows(np.array([7.7])).toarray()[0]
    for channel in scenario.channel:
        row = structure.probe(channel).displacement_rows.toarray()[0]
        there = row @ factor.solve(rail.astype(complex))
        back = rail @ factor.solve(row.astype(complex))
        assert abs(there - back) < 1e-9 * abs(there)
