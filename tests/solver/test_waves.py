"""Waves: dispersion, mobility and direct fields against closed forms and each other."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from solver import load_scenario
from solver.errors import InputError
from solver.waves import (
    LayeredTrack,
    PeriodicRail,
    WaveBeam,
    Waves,
    pinned_pinned_frequency,
    plate_beam,
    rail_beam,
)

TRACK = load_scenario("demo").track
PAPER = load_scenario("paper").track
OMEGA = 2 * np.pi * np.array([63.0, 250, 500, 1000, 1600, 2500, 4000, 5000])


def test_euler_bernoulli_point_receptance_is_the_closed_form() -> None:
    """alpha = -(1 + i)/(4 EI q^3), q^4 = (m w^2 - k' - i w c')/EI."""
    base = rail_beam(PAPER)
    beam = WaveBeam(
        base.bending_stiffness, base.mass_per_length, support_stiffness=1e8, support_damping=1.4e5
    )
    z = beam.mass_per_length * OMEGA**2 - 1e8 - 1j * OMEGA * 1.4e5
    q = (z / beam.bending_stiffness) ** 0.25
    closed = -(1 + 1j) / (4 * beam.bending_stiffness * q**3)
    np.testing.assert_allclose(beam.transfer_receptance(OMEGA, 0.0), closed, rtol=1e-10)


def test_winkler_static_limit() -> None:
    """Deflection under a static force, beta/(2 k') with beta^4 = k'/(4 EI)."""
    beam = WaveBeam(1.35e7, 121.28, support_stiffness=1.85e8)
    beta = (1.85e8 / (4 * 1.35e7)) ** 0.25
    assert beam.transfer_receptance(1e-3, 0.0).real == pytest.approx(beta / (2 * 1.85e8), rel=1e-6)


def test_timoshenko_tends_to_euler_bernoulli_and_to_the_shear_wave() -> None:
    rail = rail_beam(TRACK)
    slender = WaveBeam(rail.bending_stiffness, rail.mass_per_length, 1e16, 1e-9)
    thin = WaveBeam(rail.bending_stiffness, rail.mass_per_length)
    np.testing.assert_allclose(slender.wavenumber(OMEGA), thin.wavenumber(OMEGA), rtol=1e-4)
    np.testing.assert_allclose(
        slender.transfer_receptance(OMEGA, 0.7), thin.transfer_receptance(OMEGA, 0.7), rtol=1e-3
    )
    # without rotary inertia and with rigid bending only shear is left: c = sqrt(kGA/m)
    shear = WaveBeam(1e14, rail.mass_per_length, rail.shear_stiffness)
    speed = np.sqrt(rail.shear_stiffness / rail.mass_per_length)
    assert shear.group_velocity(2 * np.pi * 5e3) == pytest.approx(speed, rel=1e-2)


def test_group_velocity_and_modal_density_of_a_bending_beam() -> None:
    beam = plate_beam(TRACK.slab)
    phase = OMEGA / beam.wavenumber(OMEGA)
    np.testing.assert_allclose(beam.group_velocity(OMEGA), 2 * phase, rtol=1e-6)
    # modes of a pinned beam of 500 m: omega_n = sqrt(EI/m) (n pi/L)^2
    frequency = np.sqrt(beam.bending_stiffness / beam.mass_per_length)
    modes = frequency * (np.arange(1, 4000) * np.pi / 500.0) ** 2
    low, high = OMEGA[4] * 0.9, OMEGA[4] * 1.1
    counted = np.count_nonzero((modes > low) & (modes < high)) / (high - low)
    assert beam.modal_density(OMEGA[4], 500.0) == pytest.approx(counted, rel=2e-2)


def test_reciprocal_mobility_and_modal_density() -> None:
    """Mean Re Y of a bounded beam is pi n/(2 M): half that of an infinite one with n = L/(pi c)."""
    beam = WaveBeam(1.35e7, 121.28)
    mass, length = 121.28 * 30.0, 30.0
    expected = np.pi * beam.modal_density(OMEGA, length) / (2 * mass)
    np.testing.assert_allclose(beam.point_mobility(OMEGA).real, expected, rtol=1e-6)


def test_pinned_pinned_frequencies() -> None:
    """(pi/a)^2 sqrt(EI/m)/(2 pi) = 1400 Hz for the paper; Timoshenko CHN60 at 0.65 m: 954 Hz."""
    assert pinned_pinned_frequency(PAPER) == pytest.approx(1399.8, abs=0.1)
    assert pinned_pinned_frequency(TRACK) == pytest.approx(954.0, abs=1.0)
    rail = rail_beam(TRACK)
    half_wave = rail.wavenumber(2 * np.pi * pinned_pinned_frequency(TRACK))
    assert half_wave * TRACK.fastening.spacing == pytest.approx(np.pi, rel=1e-9)


@pytest.mark.parametrize("track", [TRACK, PAPER], ids=["timoshenko", "euler_bernoulli"])
def test_periodic_rail_is_reciprocal(track: object) -> None:
    rail = PeriodicRail.of_track(track)  # type: ignore[arg-type]
    for a, b in ((0.1, 0.5), (0.2, 0.2 + 4 * rail.spacing), (0.3, 5.9)):
        forth, back = rail.receptance(OMEGA, a, b), rail.receptance(OMEGA, b, a)
        np.testing.assert_allclose(forth, back, rtol=1e-8)


@pytest.mark.parametrize("track", [TRACK, PAPER], ids=["timoshenko", "euler_bernoulli"])
def test_periodic_rail_against_a_long_chain_of_supports(track: object) -> None:
    """Second method: free-beam Green's function, 81 supports solved as unknown forces.

    The ends of the row are 26 m away: below 1e-4 except near 63 Hz, so those start at 250 Hz.
    """
    rail = PeriodicRail.of_track(track)  # type: ignore[arg-type]
    supports = (np.arange(81) - 40) * rail.spacing + rail.spacing / 2
    for omega in OMEGA[1:]:
        stiffness = complex(rail.support_stiffness(omega))
        for load in (0.02, rail.spacing / 2, 0.45):
            between = rail.beam.transfer_receptance(omega, supports[:, None] - supports)
            to_load = rail.beam.transfer_receptance(omega, supports - load)
            forces = np.linalg.solve(between + np.eye(81) / stiffness, to_load)
            free = complex(rail.beam.transfer_receptance(omega, 0.0))
            expected = free - to_load @ forces
            found = rail.receptance(omega, load, load)[0]
            assert abs(found / expected - 1) < 2e-3


def test_pad_of_some_length_is_softer_at_high_frequency_and_equal_at_low() -> None:
    point = PeriodicRail.of_track(TRACK)
    long = PeriodicRail(
        point.beam, point.spacing, point.stiffness, point.damping, 0.15, point.foundation
    )
    low = 2 * np.pi * np.array([60.0])
    mean = [np.abs(r.point_receptances(low)).mean() for r in (point, long)]
    assert mean[1] == pytest.approx(mean[0], rel=5e-3)
    at_pinned = 2 * np.pi * np.array([pinned_pinned_frequency(TRACK)])
    middle = [np.abs(r.receptance(at_pinned, 0.0, 0.0))[0] for r in (point, long)]
    assert middle[1] < middle[0]
    with pytest.raises(InputError, match="pad_length"):
        PeriodicRail(point.beam, 0.3, 1e8, 1e4, 0.35)


def test_travelling_wave_carries_the_input_power_away() -> None:
    """Far field of the exact periodic rail = Re Y/(2 m' c_E) exp(-decay x), within 0.3 dB.

    0.1 dB is what the near field of the load takes into the pads next to it (0.3 dB at
    1.25 kHz, just above the first stop band).
    """
    rail = PeriodicRail.of_track(TRACK)
    omega = 2 * np.pi * np.array([1250.0, 1600, 2000, 3150, 4000, 5000])
    wave = rail.travelling(omega)
    power = (1j * omega * rail.point_receptances(omega)).real.mean(axis=0)
    mass = rail.beam.mass_per_length
    positions = rail.load_positions(8)
    for bays in (4, 15):
        distance = bays * rail.spacing
        exact = np.mean(
            [
                np.abs(omega * rail.receptance(omega, x, distance + y)) ** 2
                for x in positions
                for y in positions
            ],
            axis=0,
        )
        speed = power * wave.transverse / (2 * mass * wave.energy_velocity)
        model = speed * np.exp(-wave.decay * distance)
        np.testing.assert_allclose(10 * np.log10(exact / model), 0, atol=0.3)


def finite_row(
    track: LayeredTrack, omega: float, layer: str, sensor: float, load: float, count: int = 321
) -> complex:
    """Second method: forces of ``count`` fastenings on infinite beams, solved as unknowns."""
    one = np.array([omega])
    rail, (slab, under) = track.rail_waves(one), track.plate_waves(one)

    def field(waves: Waves, x: np.ndarray) -> np.ndarray:
        powers = np.exp(-waves.exponent[0] * np.abs(x)[..., None])
        return np.asarray((waves.amplitude[0] * powers).sum(axis=-1))

    at = (np.arange(count) - count // 2 + 0.5) * track.spacing
    pad = track.stiffness + 1j * omega * track.damping
    between = at[:, None] - at
    joint = field(rail, between) + field(slab, between) + np.eye(count) / pad
    forces = np.linalg.solve(joint, field(rail, at - load))
    if layer == "rail":
        return complex(
            field(rail, np.array([sensor - load]))[0] - field(rail, sensor - at) @ forces
        )
    return complex(field(slab if layer == "slab" else under, sensor - at) @ forces)


@pytest.mark.parametrize("layer", ["rail", "slab", "support_layer"])
def test_layered_track_against_a_row_of_fastenings(layer: Any) -> None:
    """The ends of the row are 104 m away: what they miss is the slowest wave, of the support layer."""
    track = LayeredTrack.of_track(TRACK, TRACK.bed_on_bridge)
    omega = 2 * np.pi * np.array([1250.0, 1500.0, 2000.0, 4000.0])
    place, load = 0.2, 0.45
    found = track.solve(omega).transfer(layer, "motion", place, np.array([load]), 12)
    for bay in (-12, -3, 0, 5):
        for i, w in enumerate(omega):
            expected = finite_row(track, float(w), layer, place, bay * track.spacing + load)
            assert abs(found[i, 12 + bay, 0] / expected - 1) < 5e-3


def test_fastening_force_of_the_layered_track_is_pad_stiffness_times_relative_motion() -> None:
    track = LayeredTrack.of_track(TRACK, TRACK.bed_on_subgrade)
    omega = 2 * np.pi * np.array([700.0, 1500.0, 3000.0])
    solution, middle = track.solve(omega), track.spacing / 2
    loads = np.array([0.1, 0.4])
    force = solution.transfer("rail", "fastening_force", middle, loads, 4)
    rail = solution.transfer("rail", "motion", middle, loads, 4)
    slab = solution.transfer("slab", "motion", middle, loads, 4)
    pad = (track.stiffness + 1j * omega * track.damping)[:, None, None]
    np.testing.assert_allclose(force, pad * (rail - slab), rtol=1e-7)


def test_strain_of_the_layered_track_is_the_curvature_of_the_slab() -> None:
    """Second difference over 2 cm of the deflection, whose wave is at least 0.2 m long: 2 %."""
    track = LayeredTrack.of_track(TRACK, TRACK.bed_on_subgrade)
    omega = 2 * np.pi * np.array([700.0, 1500.0])
    solution, h = track.solve(omega), 0.01
    load = np.array([0.3])
    curvature = solution.transfer("slab", "strain", 0.1, load, 3)
    left, middle, right = (
        solution.transfer("slab", "motion", x, load, 3) for x in (0.1 - h, 0.1, 0.1 + h)
    )
    difference = (left - 2 * middle + right) / h**2
    # the source of a force on the slab is smooth at 0.1 m: its fastenings are 0.2 m away
    assert np.abs(curvature / difference - 1).max() < 0.02


def test_layered_track_on_a_heavy_slab_is_the_periodic_rail_on_rigid_ground() -> None:
    track = LayeredTrack.of_track(TRACK, TRACK.bed_on_bridge)
    heavy = replace(track, slab=WaveBeam(1e14, 1e12))
    rail = PeriodicRail(track.rail, track.spacing, track.stiffness, track.damping)
    found = heavy.solve(OMEGA[2:]).transfer("rail", "motion", 0.1, np.array([0.5]), 6)
    for bay in (-6, 0, 3):
        expected = rail.receptance(OMEGA[2:], 0.5 + bay * track.spacing, 0.1)
        np.testing.assert_allclose(found[:, 6 + bay, 0], expected, rtol=1e-5)
