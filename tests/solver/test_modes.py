"""Modes and modal tables against direct solutions of the same matrices, and the disk cache."""

from __future__ import annotations

import os

import numpy as np
import pytest
import scipy.sparse as sp
import scipy.sparse.linalg

from solver import SolverError, build_scenario, modes
from solver import cache as storage
from solver.line import assemble
from solver.modes import build_modal_line, complex_modes, modal_line, real_modes, reduced_modes


def scenario(limit=800.0, **tables):
    base = {
        "line": {"approach_left": 5.0, "spans": [12.0], "approach_right": 5.0},
        "solution": {"frequency_limit": limit},
        "channel": [
            {"name": "rail", "layer": "rail", "x": 9.3},
            {"name": "slab", "layer": "slab", "x": 11.0},
            {"name": "girder", "layer": "bridge", "span": 1, "x": 6.0},
            {"name": "pad", "quantity": "fastening_force", "layer": "rail", "x": 11.0},
            {"name": "bearing", "quantity": "bearing_force", "layer": "bridge", "x": 5.0},
        ],
    }
    return build_scenario({**base, **tables})


@pytest.fixture(scope="module")
def structure():
    return assemble(scenario())


@pytest.fixture(scope="module")
def line(structure):
    return build_modal_line(structure)


def direct(structure, frequency, x):
    """Rail receptance at x and channel responses to a force on the rail at x: (1 + C,)."""
    w = 2 * np.pi * frequency
    matrix = structure.stiffness - w**2 * structure.mass + 1j * w * structure.damping
    row = structure.rail_rows(x).toarray()[0]
    q = scipy.sparse.linalg.splu(sp.csc_array(matrix)).solve(row.astype(complex))
    found = [row @ q + structure.missing_rail_compliance(np.array([x]))[0]]
    for channel in structure.scenario.channel:
        p = structure.probe(channel)
        found.append(
            (
                p.displacement_rows @ q
                + 1j * w * (p.velocity_rows @ q)
                - w**2 * (p.acceleration_rows @ q)
            )[0]
        )
    return np.array(found)


def test_real_modes_diagonalise_mass_and_stiffness(structure):
    omega, shapes = real_modes(structure)
    n = structure.size
    assert shapes.shape == (n, n)
    np.testing.assert_allclose(shapes.T @ structure.mass @ shapes, np.eye(n), atol=1e-8)
    stiffness = shapes.T @ structure.stiffness @ shapes
    np.testing.assert_allclose(
        stiffness / np.outer(omega, omega), np.eye(n), atol=1e-8 * (omega[-1] / omega[0])
    )


def test_complex_modes_solve_the_quadratic_problem(structure):
    omega, real = real_modes(structure)
    damping = real.T @ structure.damping @ real
    values, vectors, weights = complex_modes(omega, damping)
    residual = values**2 * vectors + damping @ vectors * values + omega[:, None] ** 2 * vectors
    scale = abs(values) ** 2 * np.linalg.norm(vectors, axis=0)
    assert (np.linalg.norm(residual, axis=0) / scale).max() < 1e-8
    norm = 2 * values * (vectors**2).sum(0) + (vectors * (damping @ vectors)).sum(0)
    np.testing.assert_allclose(norm, 1.0, atol=1e-9)
    # every state is counted once: pairs and real ones make 2 n
    assert weights.sum() == 2 * len(omega)
    assert np.any(weights == 1.0)  # overdamped modes of the girder's Rayleigh damping
    # completeness: sum of phi phi.T over all eigenvalues is 0, of lambda phi phi.T is M^-1
    zero = (vectors * weights) @ vectors.T
    assert abs(zero.real).max() < 1e-7 * (abs(vectors) ** 2).sum(1).max()
    unit = ((vectors * weights * values) @ vectors.T).real
    np.testing.assert_allclose(unit, np.eye(len(omega)), atol=1e-6)


def test_modal_receptance_with_all_modes_is_the_direct_solution(structure):
    omega, real = real_modes(structure)
    values, vectors, weights = complex_modes(omega, real.T @ structure.damping @ real)
    pair = weights > 1
    shape = (structure.rail_rows(9.3) @ real @ vectors)[0]
    for f in (5.0, 90.0, 700.0):
        s = 2j * np.pi * f
        found = (shape**2 / (s - values)).sum()
        found += (shape[pair].conj() ** 2 / (s - values[pair].conj())).sum()
        exact = direct(structure, f, 9.3)[0]
        exact -= structure.missing_rail_compliance(np.array([9.3]))[0]
        assert abs(found - exact) < 1e-8 * abs(exact)


def test_repeated_eigenvalues_are_made_orthogonal():
    # two identical uncoupled oscillators, mixed by a rotation: any basis is an eigenbasis
    omega = np.array([10.0, 10.0, 25.0])
    damping = np.diag([2.0, 2.0, 1.0])
    values, vectors, weights = complex_modes(omega, damping)
    pair = weights > 1
    s = 3.0j
    found = (vectors / (s - values)) @ vectors.T
    found = (
        found + (vectors[:, pair].conj() / (s - values[pair].conj())) @ vectors[:, pair].conj().T
    )
    exact = np.linalg.inv(s**2 * np.eye(3) + s * damping + np.diag(omega**2))
    np.testing.assert_allclose(found, exact, atol=1e-12)


def test_overdamped_mode_gives_two_real_eigenvalues():
    values, vectors, weights = complex_modes(np.array([4.0]), np.array([[10.0]]))
    np.testing.assert_allclose(values, [-2.0, -8.0], atol=1e-12)
    np.testing.assert_allclose(weights, 1.0)
    # residues of 1 / ((s + 2)(s + 8)) are +1/6 and -1/6
    np.testing.assert_allclose(vectors[0] ** 2, [1 / 6, -1 / 6], atol=1e-12)


def test_critical_damping_and_instability_are_refused():
    with pytest.raises(SolverError, match="defective"):
        complex_modes(np.array([5.0]), np.array([[10.0]]))
    with pytest.raises(SolverError, match="unstable"):
        complex_modes(np.array([5.0]), np.array([[-1.0]]))


def test_residual_vectors_keep_the_dashpots(structure):
    # modes to 960 Hz: the slab beside a fastening is 40 % off at 500 Hz without the pads'
    # residual vectors, 0.5 % with them
    full = real_modes(structure)
    limit = 960.0
    kept = np.searchsorted(full[0], 2 * np.pi * limit)
    row = structure.rail_rows(11.05).toarray()[0]
    slab = structure.rows("slab", np.array([11.0])).toarray()[0]
    errors = {}
    bases = {
        "cut": (full[0][:kept], full[1][:, :kept]),
        "residual": reduced_modes(structure, limit),
    }
    for name, (omega, real) in bases.items():
        damping = real.T @ structure.damping @ real
        worst = 0.0
        for f in (100.0, 300.0, 500.0):
            w = 2 * np.pi * f
            found = (slab @ real) @ np.linalg.solve(
                np.diag(omega**2 - w**2) + 1j * w * damping, real.T @ row
            )
            exact = direct(structure, f, 11.05)[2]
            worst = max(worst, abs(found - exact) / abs(exact))
        errors[name] = worst
    assert errors["residual"] < 0.01
    assert errors["cut"] > 0.3


def test_table_and_residual_against_direct_solutions(structure, line):
    # half the limit: of the rail's residual compliance (1/2.3)^2 is missing
    for x in (9.3, 9.425, 11.0, 20.02):
        for f in (1.0, 30.0, 200.0, 400.0):
            exact = direct(structure, f, x)
            rail = line.rail_receptance(np.array([f]), x)[0]
            assert abs(rail - exact[0]) < 0.012 * abs(exact[0])
            if x in (9.425, 11.0):  # near the channels
                for channel in (1, 2):
                    found = line.channel_receptance(np.array([f]), channel, x)[0]
                    assert abs(found - exact[1 + channel]) < 0.02 * abs(exact[1 + channel])


def test_forces_come_from_the_same_modes(structure, line):
    for f in (5.0, 40.0, 150.0):
        exact = direct(structure, f, 11.2)
        for channel in (3, 4):
            found = line.channel_receptance(np.array([f]), channel, 11.2)[0]
            assert abs(found - exact[1 + channel]) < 0.02  # of the unit load


def test_static_point_compliance_is_exact(structure, line):
    # kept modes and residual together are K^-1 and the shear kink, whatever was dropped
    x = np.array([0.7, 3.1, 9.36, 11.0, 16.51, 21.3])
    modal = (line.weights * (line.rail(x) ** 2 / -line.eigenvalues).real).sum(axis=1)
    exact = [direct(structure, 0.0, p)[0].real for p in x]
    # cubic cells leave 1e-4: the table's wavenumber times its step is 0.8 at the limit
    np.testing.assert_allclose(modal + line.rail_residual(x), exact, rtol=2e-4)


def test_rail_table_has_the_kinks_at_the_fastenings(structure, line):
    row = structure.fastenings[12]
    step = 1e-3
    left = (line.rail(row - 1e-9) - line.rail(row - step)) / step
    right = (line.rail(row + step) - line.rail(row + 1e-9)) / step
    kink = abs(right - left).max(axis=0)
    smooth = abs(line.rail(row + 2 * step) - 2 * line.rail(row + step) + line.rail(row + 1e-9)).max(
        axis=0
    )
    assert np.median(kink) > 10 * np.median(smooth / step)


def test_slope_is_the_derivative_of_the_table(line):
    x = np.array([2.222, 7.91, 13.37])
    h = 1e-5
    difference = (line.rail(x + h) - line.rail(x - h)) / (2 * h)
    np.testing.assert_allclose(line.rail(x, 1), difference, atol=1e-6 * abs(difference).max())


def test_nothing_off_the_line(line):
    assert not np.any(line.rail(np.array([-0.1, 22.1])))


def test_modes_without_participation_are_dropped():
    # equal damping; mode 1 never moves the rail, mode 2 is seen by the channel alone, mode 3 is
    # weak in both against its neighbour 4, mode 5 is alone in its band and so its own measure
    values = np.array([-5 + 100j, -5 + 101j, -5 + 102j, -5 + 103j, -5 + 900j])
    rail = np.array([0.0, 1e-6, 1e-6, 1e-4, 2e-6])
    channel = np.array([[1.0, 1e-1, 1e-5, 1e-3, 1e-9]])
    kept = modes._participating(values, np.full(5, 2.0), rail, channel)
    np.testing.assert_array_equal(kept, [False, True, False, True, True])
    # no channel: only what a wheel feels beside its contact, 2 |phi|^2 / 5 > 4e-13 m/N
    bare = modes._participating(values, np.full(5, 2.0), rail, np.zeros((0, 5)))
    np.testing.assert_array_equal(bare, [False, False, False, True, True])


def test_modes_dropped_below_the_limit_do_not_answer_statically(structure, line, monkeypatch):
    # an expansion about rest is worthless above a mode's own frequency
    limit = 2 * np.pi * structure.scenario.solution.frequency_limit

    def every_other(values, *_):
        return (abs(values) > limit) | (np.arange(len(values)) % 2 == 0)

    monkeypatch.setattr(modes, "_participating", lambda values, *_: np.ones(len(values), bool))
    whole = build_modal_line(structure).channel_residual
    monkeypatch.setattr(modes, "_participating", every_other)
    thinned = build_modal_line(structure)
    assert len(thinned.eigenvalues) < len(line.eigenvalues)
    np.testing.assert_allclose(
        thinned.channel_residual, whole, atol=1e-9 * np.abs(whole).max(), rtol=1e-9
    )


def test_too_large_a_line_is_refused(structure, monkeypatch):
    monkeypatch.setattr(modes, "SIZE_LIMIT", 100)
    with pytest.raises(SolverError, match=r"has \d+ coordinates; limit of the modal solution 100"):
        build_modal_line(structure)


def small(**tables):
    return scenario(60.0, line={"approach_left": 6.0, "spans": [], "approach_right": 0.0}, **tables)


NO_CHANNEL = {"channel": []}


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setattr(
        storage.platformdirs, "user_cache_dir", lambda *_, **__: str(tmp_path / "c")
    )
    return tmp_path / "c"


def test_cache_returns_the_same_line(cache, monkeypatch):
    first = modal_line(small(**NO_CHANNEL))
    assert len(list(cache.glob("line-*.npz"))) == 1
    monkeypatch.setattr(modes, "build_modal_line", lambda *_: pytest.fail("solved again"))
    # trains, seeds and names are no part of the line
    again = modal_line(
        small(**NO_CHANNEL, name="other", irregularity={"spectrum": "sato", "seed": 9})
    )
    for field in ("eigenvalues", "rail_shapes", "residual", "channel_shapes"):
        np.testing.assert_array_equal(getattr(first, field), getattr(again, field))
    assert isinstance(again.grid_step, float)


def test_cache_tells_lines_apart_and_survives_damage(cache):
    modal_line(small(**NO_CHANNEL))
    modal_line(small(**NO_CHANNEL, track={"mortar": {"stiffness": 5e8}}))
    stored = list(cache.glob("line-*.npz"))
    assert len(stored) == 2
    for path in stored:
        path.write_bytes(b"PK\x03\x04 broken")
    assert np.all(np.isfinite(modal_line(small(**NO_CHANNEL)).residual))
    assert not list(cache.glob("*.part"))


def test_cache_is_bounded(cache, monkeypatch):
    monkeypatch.setattr(storage, "CACHE_BYTES", 1)
    modal_line(small(**NO_CHANNEL))
    modal_line(small(**NO_CHANNEL, track={"mortar": {"stiffness": 5e8}}))
    assert len(list(cache.glob("line-*.npz"))) == 1


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes everywhere")
def test_unwritable_cache_is_skipped(tmp_path, monkeypatch):
    (tmp_path / "c").mkdir(mode=0o500)
    monkeypatch.setattr(
        storage.platformdirs, "user_cache_dir", lambda *_, **__: str(tmp_path / "c")
    )
    assert modal_line(small(**NO_CHANNEL)).solved > 0


def test_cache_in_an_impossible_place_is_skipped(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("not a folder")
    place = str(tmp_path / "file" / "c")
    monkeypatch.setattr(storage.platformdirs, "user_cache_dir", lambda *_, **__: place)
    assert modal_line(small(**NO_CHANNEL)).solved > 0
