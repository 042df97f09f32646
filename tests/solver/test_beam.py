"""The hierarchical element against closed forms of the beam."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scipy.linalg
import scipy.optimize

from solver import SolverError
from solver.beam import BeamSection, beam_element
from solver.line import beam_field, beam_matrices

# both CHN60 rails: EI = 2.1e11 Pa * 3.217e-5 m^4, m = 60.64 kg/m, kappa G A, rho I, twice
EULER = BeamSection(2 * 6.7557e6, 2 * 60.64)
TIMOSHENKO = BeamSection(
    2 * 6.7557e6, 2 * 60.64, 2 * 0.4 * 2.1e11 / 2.6 * 77.45e-4, 2 * 60.64 * 3.217e-5 / 77.45e-4
)
LIMIT = 5000.0


def matrices(field, section, pinned=False):
    mass, stiffness = (m.toarray() for m in beam_matrices(field, section))
    held = [field.dofs[0][0], field.dofs[-1][2]] if pinned else []
    free = np.setdiff1d(np.arange(field.size), held)
    return mass[np.ix_(free, free)], stiffness[np.ix_(free, free)], free


def frequencies(field, section, pinned=False):
    mass, stiffness, _ = matrices(field, section, pinned)
    squared = scipy.linalg.eigh(stiffness, mass, eigvals_only=True)
    return np.sqrt(np.maximum(squared, 0)) / (2 * np.pi)


def pinned_closed_form(section, length, number):
    """Bending frequency of the simply supported beam with wavenumber number*pi/length (Hz)."""
    k2 = (number * np.pi / length) ** 2
    ei, m = section.bending_stiffness, section.mass_per_length
    if section.shear_stiffness is None:
        return k2 * math.sqrt(ei / m) / (2 * np.pi)
    # determinant of [[kGA k^2 - m w^2, -kGA k], [-kGA k, EI k^2 + kGA - rhoI w^2]]
    s, r = section.shear_stiffness, section.rotary_inertia
    roots = np.roots([m * r, -(s * k2 * r + m * (ei * k2 + s)), s * ei * k2 * k2])
    return math.sqrt(roots.real.min()) / (2 * np.pi)


def free_closed_form(section, length, highest):
    """All natural frequencies (Hz) of the free beam from its frequency equation, to ``highest``."""
    ei, m = section.bending_stiffness, section.mass_per_length
    if section.shear_stiffness is None:

        def equation(f):
            b = (m * (2 * np.pi * f) ** 2 / ei) ** 0.25 * length
            return math.cos(b) - 1 / math.cosh(b)
    else:
        s, r = section.shear_stiffness, section.rotary_inertia

        def equation(f):
            # free ends: theta' = 0 and w' = theta at both; one symmetric, one antisymmetric
            # 2 x 2 determinant about mid-span; their product changes sign at every root
            w2 = (2 * np.pi * f) ** 2
            half = (r * w2 + ei * m * w2 / s) / (2 * ei)
            root = math.sqrt(half * half + m * w2 * (1 - r * w2 / s) / ei)
            k, q = math.sqrt(half + root), math.sqrt(root - half)
            # w = cos kx has theta = -(k - m w2 / (s k)) sin kx; cosh: (q + m w2 / (s q)) sinh
            a, b = k - m * w2 / (s * k), q + m * w2 / (s * q)
            h = length / 2
            t = math.tanh(q * h)
            sym = -a * k * math.cos(k * h) * (q - b) * t + b * q * (k - a) * math.sin(k * h)
            ant = -a * k * math.sin(k * h) * (q - b) - b * q * t * (k - a) * math.cos(k * h)
            return sym * ant

    grid = np.linspace(1.0, highest, 20000)
    value = np.array([equation(f) for f in grid])
    change = np.flatnonzero(np.sign(value[:-1]) != np.sign(value[1:]))
    return np.array([scipy.optimize.brentq(equation, grid[i], grid[i + 1]) for i in change])


def test_pinned_euler_bernoulli_is_exact_in_the_space_of_equation_1():
    # sin(j pi x / l) lies in the space: only round-off is left, at most
    # eps * (highest / lowest frequency)^2 = 2e-16 * 1.5e8
    field = beam_field(np.array([0.0, 32.0]), [110], EULER)
    found = frequencies(field, EULER, pinned=True)[:104]
    exact = np.array([pinned_closed_form(EULER, 32.0, j) for j in range(1, 105)])
    assert exact[-1] > LIMIT
    np.testing.assert_allclose(found, exact, rtol=3e-8)


def test_pinned_shapes_are_sines():
    field = beam_field(np.array([0.0, 32.0]), [40], EULER)
    mass, stiffness, free = matrices(field, EULER, pinned=True)
    _, vectors = scipy.linalg.eigh(stiffness, mass)
    x = np.linspace(0, 32, 201)
    rows = field.rows(x).toarray()[:, free]
    for j in (1, 2, 7, 31):
        shape = rows @ vectors[:, j - 1]
        sine = np.sin(j * np.pi * x / 32) * math.sqrt(2 / (32 * EULER.mass_per_length))
        assert abs(abs(shape @ sine) / (sine @ sine) - 1) < 1e-8
        np.testing.assert_allclose(shape * np.sign(shape @ sine), sine, atol=1e-7 * sine.max())


def test_pinned_timoshenko_to_the_frequency_limit():
    # six clamped modes (the next at 9 kHz) and four residual vectors per bay: what is missing
    # is of fourth order in the frequency ratio, (4.9/9)^4 of a small participation
    nodes = np.arange(21) * 0.65
    found = frequencies(beam_field(nodes, [10] * 20, TIMOSHENKO), TIMOSHENKO, pinned=True)
    exact = [pinned_closed_form(TIMOSHENKO, 13.0, j) for j in range(1, 80)]
    exact = np.array([f for f in exact if f < LIMIT])
    for f in exact:
        nearest = found[np.argmin(abs(found - f))]
        assert nearest == pytest.approx(f, rel=1e-4)
    # below the cut-off of the shear spectrum there is nothing else
    assert np.count_nonzero(found < 4900) == np.count_nonzero(exact < 4900)


@pytest.mark.parametrize(
    ("section", "orders", "bays", "tolerance"),
    [(EULER, 12, 8, 1e-4), (TIMOSHENKO, 10, 20, 1e-4)],
    ids=["euler-bernoulli", "timoshenko"],
)
def test_free_beam_to_the_frequency_limit(section, orders, bays, tolerance):
    length = 13.0
    nodes = np.linspace(0, length, bays + 1)
    found = frequencies(beam_field(nodes, [orders] * bays, section), section)
    exact = free_closed_form(section, length, 4900.0)
    assert np.all(found[:2] < 0.05)  # two rigid modes, round-off only
    elastic = found[2 : 2 + len(exact)]
    assert len(exact) > 30
    np.testing.assert_allclose(elastic, exact, rtol=tolerance)


def test_convergence_in_the_number_of_sines():
    # clamped-free remainder after cubic matching has a jump in the fourth derivative of its odd
    # extension: sine coefficients fall as n^-5, the energy left as n^4 * n^-10 summed: n^-5
    exact = free_closed_form(EULER, 6.5, 500.0)[4]
    orders = np.array([8, 16, 32])
    error = [
        frequencies(beam_field(np.array([0, 6.5]), [n], EULER), EULER)[6] / exact - 1
        for n in orders
    ]
    rate = -np.diff(np.log(error)) / np.log(2)
    assert np.all(np.array(error) > 0)
    assert np.all(rate > 4.0)
    assert rate[-1] < 6.5


def test_elements_of_different_order_join_in_deflection_and_rotation():
    nodes = np.array([0.0, 4.0, 5.3, 9.0])
    for section in (EULER, TIMOSHENKO):
        field = beam_field(nodes, [3, 11, 6], section)
        for x in nodes[1:-1]:
            for rows in (field.rows, field.rotation_rows):
                left, right = rows(np.array([x - 1e-10])), rows(np.array([x]))
                scale = abs(rows(np.array([x - 0.5]))).max()
                assert abs(left - right).max() < 1e-7 * scale


def test_mass_matrix_is_well_conditioned():
    # one element of 72 m with 160 sines, scaled to unit diagonal: 1.8e8, as n^4, because the
    # nodal functions shrink to boundary layers of width l/n; the raw basis of Eq. (1) is
    # singular in double precision. Meshes of the presets: 6e5 (slab), 1.2e2 (rail)
    n, length = 160, 72.0
    mass, _ = beam_matrices(beam_field(np.array([0, length]), [n], EULER), EULER)
    mass = mass.toarray()
    scale = 1 / np.sqrt(mass.diagonal())
    assert np.linalg.cond(mass * scale[:, None] * scale) < 3e8
    s, weight = np.polynomial.legendre.leggauss(400)
    s = (s + 1) / 2
    raw = np.column_stack(
        [1 - 3 * s**2 + 2 * s**3, s - 2 * s**2 + s**3, 3 * s**2 - 2 * s**3, s**3 - s**2]
        + [np.sin(j * np.pi * s) for j in range(1, n + 1)]
    )
    raw_mass = raw.T @ (weight[:, None] / 2 * raw)
    scale = 1 / np.sqrt(raw_mass.diagonal())
    assert np.linalg.cond(raw_mass * scale[:, None] * scale) > 1e12
    for nodes, orders, section, limit in (
        (np.arange(19) * 4.0, [27] * 18, EULER, 1e6),
        (np.arange(21) * 0.65, [10] * 20, TIMOSHENKO, 1e3),
    ):
        mass = beam_matrices(beam_field(nodes, orders, section), section)[0].toarray()
        scale = 1 / np.sqrt(mass.diagonal())
        assert np.linalg.cond(mass * scale[:, None] * scale) < limit


def test_hierarchical_functions_are_orthonormal_clamped_modes():
    element = beam_element(0.65, TIMOSHENKO, 6)
    s, weight = np.polynomial.legendre.leggauss(40)
    x, weight = (s + 1) / 2 * 0.65, weight / 2 * 0.65
    w, theta = element.deflection(x)[:, 4:], element.rotation(x)[:, 4:]
    mass = w.T @ (weight[:, None] * TIMOSHENKO.mass_per_length * w)
    mass += theta.T @ (weight[:, None] * TIMOSHENKO.rotary_inertia * theta)
    np.testing.assert_allclose(mass, np.eye(6), atol=1e-9)
    ends = np.array([0.0, 0.65])
    assert abs(element.deflection(ends)[:, 4:]).max() < 1e-10 * abs(w).max()
    assert abs(element.rotation(ends)[:, 4:]).max() < 1e-10 * abs(theta).max()


@pytest.mark.parametrize("section", [EULER, TIMOSHENKO], ids=["euler-bernoulli", "timoshenko"])
@pytest.mark.parametrize("length", [0.05, 4.0, 400.0])
def test_cantilever_tip_is_exact_for_any_slenderness(section, length):
    # P l^3 / 3EI + P l / kGA with no hierarchical function: static shapes, no shear locking
    field = beam_field(np.array([0.0, length / 3, length]), [0, 0], section)
    _, stiffness = beam_matrices(field, section)
    stiffness = stiffness.toarray()[2:, 2:]
    tip = field.rows(np.array([length])).toarray()[0, 2:]
    shear = 0.0 if section.shear_stiffness is None else length / section.shear_stiffness
    exact = length**3 / (3 * section.bending_stiffness) + shear
    assert tip @ np.linalg.solve(stiffness, tip) == pytest.approx(exact, rel=1e-6)


def test_patch_constant_curvature_and_constant_shear():
    # a state of constant curvature and one of constant shear force pass irregular elements
    nodes = np.array([0.0, 0.4, 1.5, 1.7, 3.0])
    for n in (0, 5):
        field = beam_field(nodes, [n] * 4, TIMOSHENKO)
        _, stiffness = (m.toarray() for m in beam_matrices(field, TIMOSHENKO))
        for moment_end, force_end in ((1.0, 0.0), (3.0, 1.0)):
            load = np.zeros(field.size)
            load[field.dofs[-1][2]] = force_end
            load[field.dofs[-1][3]] = moment_end
            q = np.zeros(field.size)
            q[2:] = np.linalg.solve(stiffness[2:, 2:], load[2:])
            x = np.array([0.1, 0.9, 1.6, 2.2])
            curvature = field.rotation_rows(x, 1) @ q
            expected = (moment_end + force_end * (3.0 - x)) / TIMOSHENKO.bending_stiffness
            np.testing.assert_allclose(curvature, expected, rtol=1e-7)
            shear = (field.rows(x, 1) - field.rotation_rows(x)) @ q
            np.testing.assert_allclose(
                shear, force_end / TIMOSHENKO.shear_stiffness, rtol=1e-6, atol=1e-16
            )


@pytest.mark.parametrize("section", [EULER, TIMOSHENKO], ids=["euler-bernoulli", "timoshenko"])
def test_missing_compliance_completes_the_clamped_element(section):
    # closed form a^3 b^3 / (3 EI l^3) of the clamped Euler-Bernoulli beam; with shear: the same
    # beam cut into two elements at the load
    length, a = 1.3, 0.5
    element = beam_element(length, section, 4)
    at = np.array([a])
    own = (element.deflection(at)[0, 4:] / (2 * np.pi * element.internal_frequencies)) ** 2
    total = float(own.sum() + element.missing_compliance(at, section)[0])
    if section.shear_stiffness is None:
        exact = (a * (length - a)) ** 3 / (3 * section.bending_stiffness * length**3)
    else:
        field = beam_field(np.array([0, a, length]), [0, 0], section)
        stiffness = beam_matrices(field, section)[1].toarray()
        middle = field.dofs[0][2:4]
        exact = np.linalg.inv(stiffness[np.ix_(middle, middle)])[0, 0]
    assert total == pytest.approx(exact, rel=1e-9)
    assert element.missing_compliance(at, section)[0] > 0


def test_wavenumber_and_frequency_are_inverse():
    for section in (EULER, TIMOSHENKO):
        for f in (10.0, 1000.0, 4900.0):
            assert section.frequency(section.wavenumber(f)) == pytest.approx(f, rel=1e-10)
        assert section.frequency(np.pi / 0.65) == pytest.approx(
            pinned_closed_form(section, 0.65, 1), rel=1e-10
        )


def test_an_ill_conditioned_basis_is_refused():
    with pytest.raises(SolverError, match=r"900 hierarchical functions .*limit 1e-06"):
        beam_element(32.0, EULER, 900)
