"""Irregularity: realisations against their target spectra, shapes of defects, refusals."""

import itertools

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.signal import welch

from solver.errors import InputError
from solver.irregularity import WAVELENGTHS, build_profile, spectrum, wavelengths, wheel_defect
from solver.scenario import Components, Defect, Irregularity


@pytest.mark.parametrize("name", ["sato", "tbt3352", "german_low", "iso3095"])
def test_realisation_has_the_target_spectrum(name):
    irregularity = Irregularity(spectrum=name, seed=4)
    shortest, longest = WAVELENGTHS[name]
    length = max(60 * longest, 4.0)
    profile = build_profile(irregularity, 0.0, length, length)
    step = shortest / 6
    x = np.arange(0, length, step)
    segment = int(4 * longest / step)
    k, psd = welch(profile(x), fs=2 * np.pi / step, nperseg=segment, window="hann")
    inside = (k > 3 * np.pi / longest) & (k < 0.6 * 2 * np.pi / shortest)
    ratio = psd[inside] / spectrum(irregularity, k[inside])
    # octave means over many lines and ~ 2 length/segment segments of independent phases
    edges = np.geomspace(k[inside][0], k[inside][-1] * 1.001, 5)
    segments = 2 * len(x) / segment - 1
    for low, high in itertools.pairwise(edges):
        band = (k[inside] >= low) & (k[inside] < high)
        if band.sum() < 3:
            continue
        error = 1 / np.sqrt(segments * band.sum() / 2)
        # windowing a steep spectrum leaks: 5 %
        assert abs(ratio[band].mean() - 1) < 4 * error + 0.05


def test_variance_is_the_integral_of_the_spectrum():
    irregularity = Irregularity(spectrum="sato", roughness_coefficient=4.15e-8)
    profile = build_profile(irregularity, 0.0, 400.0, 400.0)
    # S = A/k^3 from 0.25 m down to 0.005 m: A/2 (k1^-2 - k2^-2)
    k1, k2 = 2 * np.pi / 0.25, 2 * np.pi / 0.005
    variance = 4.15e-8 / 2 * (k1**-2 - k2**-2)
    # the standard error of the variance over 400 m of bandwidth-limited noise is below 2 %
    assert np.var(profile(np.arange(0, 400, 1e-3))) == pytest.approx(variance, rel=0.06)


def test_published_values():
    # German low disturbance at 0.1 rad/m, worked out by hand from its formula
    value = 4.032e-7 * 0.8246**2 / ((0.01 + 0.0206**2) * (0.01 + 0.8246**2))
    assert spectrum(Irregularity(spectrum="german_low"), 0.1) == pytest.approx(value)
    # the pieces of TB/T 3352 meet at their corners
    for corner in (0.0187, 0.0474, 0.1533):
        k = 2 * np.pi * corner * np.array([1 - 1e-6, 1 + 1e-6])
        low, high = spectrum(Irregularity(spectrum="tbt3352"), k)
        assert high == pytest.approx(low, rel=0.005)
    # ISO 3095: the third octave about 0.1 m holds 4.9 dB re 1 um
    k = 2 * np.pi / 0.1 * 10 ** np.linspace(-0.05, 0.05, 2001)
    power = np.trapezoid(spectrum(Irregularity(spectrum="iso3095"), k), k)
    assert 10 * np.log10(power / 1e-12) == pytest.approx(4.9, abs=0.05)


def test_same_seed_same_profile_whatever_is_asked_for():
    irregularity = Irregularity(spectrum="sato", seed=7)
    x = np.linspace(10, 12, 4001)
    one = build_profile(irregularity, -30.0, 100.0, 72.0)(x)
    two = build_profile(irregularity, 5.0, 20.0, 72.0)(x)
    np.testing.assert_allclose(one, two, atol=1e-15)
    other = build_profile(Irregularity(spectrum="sato", seed=8), 5.0, 20.0, 72.0)(x)
    assert abs(np.corrcoef(one, other)[0, 1]) < 0.3


def test_components_are_interpolated_closely():
    parts = Components(wavenumber=(0.7, 150.0), amplitude=(3e-4, 1e-6), phase=(0.3, 2.7))
    profile = build_profile(Irregularity(components=parts), -5.0, 30.0, 20.0)
    x = np.linspace(-4, 29, 20001)
    exact = 3e-4 * np.cos(0.7 * x + 0.3) + 1e-6 * np.cos(150 * x + 2.7)
    # cubic Hermite: (k h)^4/384 with at least 10 points per wave
    assert np.abs(profile(x) - exact).max() < 1e-6 * (2 * np.pi / 10) ** 4 / 384


def test_defects():
    dip = Defect(shape="dip", x=5.0, length=3.0, depth=1e-3)
    joint = Defect(shape="joint", x=10.0, length=1.0, depth=5e-4)
    wavy = Defect(shape="corrugation", x=15.0, length=1.2, depth=1e-4, wavelength=0.06)
    profile = build_profile(Irregularity(defect=(dip, joint, wavy)), 0, 20, 20)
    assert profile(5.0) == pytest.approx(1e-3)
    assert profile(4.25) == pytest.approx(5e-4)
    assert profile(10.0) == pytest.approx(5e-4, rel=0.01)
    assert profile(10.25) == pytest.approx(2.5e-4, rel=1e-6)
    waves = profile(np.linspace(14.4, 15.6, 12001))
    assert waves.max() == pytest.approx(1e-4, rel=1e-4)
    assert (np.diff(np.sign(waves - 5e-5)) != 0).sum() == 40
    assert np.abs(profile(np.array([3.4, 6.6, 9.4, 14.3, 18.0]))).max() == 0
    with pytest.raises(InputError, match="whole number of wavelengths"):
        build_profile(
            Irregularity(
                defect=(Defect(shape="corrugation", x=5, length=1.0, depth=1e-4, wavelength=0.3),)
            ),
            0,
            10,
            10,
        )


def test_profile_from_file(tmp_path):
    x = np.linspace(-2, 12, 57)
    r = 1e-3 * np.sin(x)
    file = tmp_path / "r.txt"
    np.savetxt(file, np.column_stack([x, r]))
    profile = build_profile(Irregularity(profile=str(file)), -5, 15, 10)
    at = np.linspace(0, 10, 1001)
    np.testing.assert_allclose(profile(at), CubicSpline(x, r)(at), atol=1e-10)
    assert profile(-4.0) == pytest.approx(r[0])


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("0 0\n1 zero\n", "two columns of numbers"),
        ("0 0 0\n20 0 0\n", "3 columns"),
        ("0 0\n0 1e-3\n20 0\n", "row 2 has x = 0 m after 0 m"),
        ("0 0\nnan 1e-3\n20 0\n", "row 2 is not finite"),
        ("1 0\n5 0\n", "covers x = 1 to 5 m, but the line runs from 0 to 10 m"),
    ],
)
def test_wrong_profile_files_are_refused(tmp_path, rows, message):
    file = tmp_path / "r.txt"
    file.write_text(rows)
    with pytest.raises(InputError, match=message):
        build_profile(Irregularity(profile=str(file)), 0, 10, 10)


def test_missing_profile_and_empty_spectrum_are_refused(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        build_profile(Irregularity(profile=str(tmp_path / "none.txt")), 0, 10, 10)
    with pytest.raises(InputError, match="leave nothing"):
        wavelengths(Irregularity(spectrum="sato", wavelength_min=0.3))


def test_flat_and_polygon():
    radius, length = 0.46, 0.06
    travelled = np.linspace(0, 2 * 2 * np.pi * radius, 200_001)
    flat = wheel_defect(travelled, radius, length, 1, 0.0)
    # depth of a worn flat, L^2/(8 R) (Newton and Clark 1979)
    assert flat.max() == pytest.approx(length**2 / (8 * radius), rel=1e-6)
    assert np.mean(flat > 0) == pytest.approx(length / (2 * np.pi * radius), rel=1e-3)
    waves = wheel_defect(travelled, radius, 0.0, 20, 1e-5)
    assert (np.diff(np.sign(waves)) != 0).sum() == 2 * 2 * 20
    assert waves.max() == pytest.approx(1e-5)
