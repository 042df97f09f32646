"""Power balance: closed forms, reciprocity, conservation, equipartition, the chain of segments."""

from __future__ import annotations

import numpy as np
import pytest

from solver.errors import SolverError
from solver.sea import (
    Chain,
    PowerBalance,
    bed_conductance,
    chain_balance,
    chain_rate,
    conductance,
    fastening_conductance,
)
from solver.waves import WaveBeam

OMEGA = 2 * np.pi * 3150.0


def two_subsystems(loss_1: float = 0.02, loss_2: float = 0.005) -> PowerBalance:
    density = np.array([3e-4, 8e-4])
    forward = 0.01
    coupling = np.array([[0.0, forward], [forward * density[0] / density[1], 0.0]])
    return PowerBalance(OMEGA, np.array([loss_1, loss_2]), coupling, density)


def test_two_subsystems_closed_form() -> None:
    """E_2/E_1 = eta_12/(eta_2 + eta_21) with power into 1 only (Lyon and DeJong, Eq. 3.1.12)."""
    balance = two_subsystems()
    energy = balance.steady([5.0, 0.0])
    eta_12, eta_21 = balance.coupling[0, 1], balance.coupling[1, 0]
    assert energy[1] / energy[0] == pytest.approx(eta_12 / (0.005 + eta_21), rel=1e-12)
    assert balance.dissipated(energy).sum() == pytest.approx(5.0, rel=1e-12)


def test_equipartition_of_modal_energy_as_the_damping_goes() -> None:
    balance = two_subsystems(1e-9, 1e-9)
    energy = balance.steady([5.0, 0.0])
    modal = energy / balance.modal_density
    # the difference is of the order of eta_r/eta_rs = 1e-7
    assert modal[0] == pytest.approx(modal[1], rel=1e-6)


def test_transient_conserves_energy_without_loss_and_reaches_the_steady_state() -> None:
    free = two_subsystems(0.0, 0.0)
    decay, gain = free.propagator(1e-3)
    energy = np.array([2.0, 0.0])
    for _ in range(200):
        energy = decay @ energy
    assert energy.sum() == pytest.approx(2.0, rel=1e-12)
    assert (gain @ np.array([3.0, 0.0])).sum() == pytest.approx(3.0e-3, rel=1e-12)
    lossy = two_subsystems()
    decay, gain = lossy.propagator(1e-3)
    energy = np.zeros(2)
    for _ in range(400):
        energy = decay @ energy + gain @ np.array([5.0, 1.0])
    np.testing.assert_allclose(energy, lossy.steady([5.0, 1.0]), rtol=1e-9)


def test_reciprocity_is_demanded() -> None:
    coupling = np.array([[0.0, 0.01], [0.01, 0.0]])
    with pytest.raises(SolverError, match="reciprocity"):
        PowerBalance(OMEGA, np.array([0.01, 0.01]), coupling, np.array([3e-4, 8e-4]))
    with pytest.raises(SolverError, match=r"eta_r = -0\.01"):
        PowerBalance(OMEGA, np.array([-0.01]), np.zeros((1, 1)), np.array([3e-4]))


def test_negative_energy_is_refused() -> None:
    with pytest.raises(SolverError, match="limit >= 0 J"):
        two_subsystems().steady([-1.0, 0.0])


def uniform(segments: int, speed: float, decay: float, length: float) -> Chain:
    return Chain(np.full(segments, speed), np.full(segments, decay), length)


@pytest.mark.parametrize("length", [0.65, 1.3, 2.6])
def test_chain_decays_like_the_wave_for_any_segment_length(length: float) -> None:
    """Energies ahead of the source fall by exp(-decay length) a segment, exactly."""
    decay, speed = 0.25, 2500.0
    balance = chain_balance(OMEGA, [uniform(20, speed, decay, length)], [])
    power = np.zeros(40)
    power[0] = 1.0  # travels right in the first segment
    energy = balance.steady(power)
    ratio = energy[1:19] / energy[:18]
    reflected = np.exp(-2 * decay * length * np.arange(20, 2, -1))
    np.testing.assert_allclose(ratio, np.exp(-decay * length), rtol=1e-9 + reflected.max())
    assert balance.dissipated(energy).sum() == pytest.approx(1.0, rel=1e-10)


def test_chain_rate_without_loss_is_the_time_of_flight() -> None:
    assert chain_rate(3000.0, 0.0, 1.3) == pytest.approx(3000.0 / 1.3)
    assert chain_rate(3000.0, 1e-6, 1.3) == pytest.approx(3000.0 / 1.3, rel=1e-6)


def test_three_layers_reciprocal_positive_and_balanced() -> None:
    rail = Chain(np.full(12, 2200.0), np.linspace(0.3, 0.6, 12), 0.65)
    slab = uniform(12, 4000.0, 0.05, 0.65)
    layer = uniform(12, 5000.0, 0.03, 0.65)
    links = [np.full(12, 1e-3), np.full(12, 4e-3)]
    balance = chain_balance(OMEGA, [rail, slab, layer], links)
    power = np.zeros(72)
    power[5] = power[12 + 5] = 0.5
    energy = balance.steady(power)
    assert energy.min() > 0
    assert balance.dissipated(energy).sum() == pytest.approx(1.0, rel=1e-10)
    # what the rail gives to the slab is what slab and layer lose
    segments = np.arange(72) // 24
    lost = balance.dissipated(energy)
    flow = balance.omega * (
        balance.coupling[:24, 24:48].sum(axis=1) @ energy[:24]
        - balance.coupling[24:48, :24].sum(axis=1) @ energy[24:48]
    )
    assert lost[segments > 0].sum() == pytest.approx(flow, rel=1e-10)


def beam(loss: float) -> WaveBeam:
    return WaveBeam(6.63e7, 1275.0, support_damping=loss)


def test_point_conductance_against_power_through_a_spring() -> None:
    """Free velocity of a diffuse subsystem, blocked force, power: computed step by step."""
    a, b = beam(0.0), WaveBeam(1.99e8, 2212.0)
    y_a, y_b = a.point_mobility(OMEGA), b.point_mobility(OMEGA)
    spring = 1j * OMEGA / complex(2e8)
    length = 40.0
    density = float(a.modal_density(OMEGA, length))
    energy = 1.0
    free_velocity_squared = energy / (1275.0 * length)
    force_squared = free_velocity_squared / abs(y_a + y_b + spring) ** 2
    power = force_squared * y_b.real
    assert conductance(y_a, y_b, np.asarray(spring)) * energy / density == pytest.approx(
        power, rel=1e-6
    )


def test_row_of_springs_tends_to_the_distributed_bed() -> None:
    """Springs 0.05 m apart (40 per wave) carry what the same stiffness per metre carries.

    The point form keeps the mobilities of the beams in series, which for this soft spring is an
    effect of 1e-3; the trapezoidal rule over a smooth kernel adds less.
    """
    a, b = beam(2e5), WaveBeam(1.99e8, 2212.0, support_damping=4e5)
    per_metre = 1e7
    omega, spacing = 2 * np.pi * 1000.0, 0.05
    row = fastening_conductance(omega, a, b, 1j * omega / (per_metre * spacing), spacing)
    bed = bed_conductance(omega, a, b, per_metre)
    assert row == pytest.approx(bed, rel=2e-2)
    assert bed == pytest.approx(bed_conductance(omega, b, a, per_metre), rel=1e-6)
