"""Vehicles: weights, rigid motions, an independent integration, Jacobs bogies, static start."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from solver.motion import TrainMotion
from solver.scenario import GRAVITY, SpeedPoint, preset_names, train_preset
from solver.vehicle import block_units, build_units, discretise, static_start

TRAINS = preset_names()["train"]


@pytest.mark.parametrize("name", TRAINS)
def test_units_carry_the_weight_and_the_axles_of_their_train(name):
    train = train_preset(name)
    units = build_units(train)
    assert sum(len(unit.wheelsets) for unit in units) == len(train.axle_positions)
    weight = sum(unit.weight.sum() for unit in units)
    assert weight == pytest.approx(train.mass * GRAVITY, rel=1e-12)
    loads = np.concatenate([unit.static_loads for unit in units])
    assert (loads > 0).all()
    assert loads.sum() == pytest.approx(weight, rel=1e-12)


@pytest.mark.parametrize("name", TRAINS)
def test_units_move_rigidly_without_force(name):
    for unit in build_units(train_preset(name)):
        value = np.linalg.eigvalsh(unit.stiffness)
        # as many motions without strain as wheelsets: the loads are statically determinate
        assert (value < 1e-9 * value[-1]).sum() == len(unit.wheelsets)
        bounce = np.where(unit.weight > 0, 1.0, 0.0)
        assert np.abs(unit.stiffness @ bounce).max() < 1e-9 * value[-1]
        assert np.abs(unit.damping @ bounce).max() < 1e-9 * np.abs(unit.damping).max()


def test_crh3_wheelset_load_and_wheel_element():
    (element,) = build_units(train_preset("wheel_element"))
    # (40000/4 + 3200/2 + 2400) kg * 9.81
    assert element.static_loads[0] == pytest.approx(14_000 * 9.81)
    car = build_units(train_preset("CRH3"))[0]
    np.testing.assert_allclose(car.static_loads, (40e3 + 2 * 3200 + 4 * 2400) * 9.81 / 4)


def test_bounce_frequency_of_a_car_is_that_of_springs_in_series():
    car = build_units(train_preset("CRH3"))[0]
    held = np.setdiff1d(np.arange(10), car.wheelsets)
    matrix = np.linalg.solve(car.mass[np.ix_(held, held)], car.stiffness[np.ix_(held, held)])
    frequencies = np.sort(np.sqrt(np.linalg.eigvals(matrix).real)) / (2 * np.pi)
    # bounce of body and both bogies together: 2 degrees of freedom
    k2, k1, body, bogie = 2 * 0.8e6, 4 * 2.08e6, 40e3, 2 * 3200.0
    two = np.linalg.eigvals(np.array([[k2 / body, -k2 / body], [-k2 / bogie, (k1 + k2) / bogie]]))
    for value in np.sqrt(two.real) / (2 * np.pi):
        assert np.abs(frequencies - value).min() < 1e-9


def test_articulated_train_shares_bogies_in_one_unit():
    train = train_preset("articulated")
    units = build_units(train)
    # power car, 8 trailers on 9 bogies, power car
    assert [len(unit.wheelsets) for unit in units] == [4, 18, 4]
    # 8 bodies and 9 bogies of two motions each, 18 wheelsets
    assert len(units[1].weight) == 2 * 8 + 2 * 9 + 18
    loads = units[1].static_loads
    np.testing.assert_allclose(loads, loads[::-1], rtol=1e-9)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("name", ["CRH3", "wheel_element"])
def test_exact_step_follows_an_independent_integration(name, order):
    unit = build_units(train_preset(name))[0]
    axles, size, step = len(unit.wheelsets), len(unit.weight), 5e-3
    exact_step = discretise(unit, step, order)
    coefficients = np.random.default_rng(1).normal(0, 1e5, (3, axles))
    if order == 1:
        coefficients[2] = 0

    def force(t):
        return coefficients[0] + coefficients[1] * t / step + coefficients[2] * (t / step) ** 2

    def flow(t, y):
        load = unit.weight.copy()
        load[unit.wheelsets] -= force(t)
        load -= unit.stiffness @ y[:size] + unit.damping @ y[size:]
        return np.concatenate([y[size:], load / np.diag(unit.mass)])

    start = np.random.default_rng(2).normal(0, 1e-3, 2 * size)
    steps = 3
    s = start - exact_step.now @ force(0.0) - exact_step.before @ force(-step)
    for n in range(steps + 1):
        state = s + exact_step.now @ force(n * step) + exact_step.before @ force((n - 1) * step)
        s = exact_step.transition @ s + exact_step.drive @ force(n * step) + exact_step.constant
    reference = solve_ivp(flow, (0, steps * step), start, method="DOP853", rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(state, reference.y[:, -1], rtol=1e-8, atol=1e-9)


def test_static_start_balances_weight_on_an_elastic_rough_track():
    whole = block_units(build_units(train_preset("CRH3"))[:2])
    random = np.random.default_rng(3)
    flexible = random.normal(size=(8, 8))
    compliance = 1e-9 * (flexible @ flexible.T)
    roughness = 1e-4 * random.normal(size=8)
    law = np.array([np.zeros(8), np.full(8, 2 / 4.2e-8**1.5)])
    rest, force = static_start(whole, law, compliance, roughness)
    assert force.sum() == pytest.approx(whole.weight.sum(), rel=1e-12)
    up = np.zeros(len(whole.weight))
    up[whole.wheelsets] = force
    np.testing.assert_allclose(whole.stiffness @ rest, whole.weight - up, atol=1e-6)
    delta = rest[whole.wheelsets] - compliance @ force - roughness
    np.testing.assert_allclose(2 * (delta / 4.2e-8) ** 1.5, force, rtol=1e-8)


@pytest.mark.parametrize("direction", ["forward", "backward"])
def test_motion_under_a_speed_profile(direction):
    profile = tuple(SpeedPoint(time=t, speed=v) for t, v in [(0, 20), (2, 60), (5, 60), (9, 10)])
    train = train_preset("CRH3").model_copy(
        update={
            "speed_profile": profile,
            "direction": direction,
            "start": 7.0,
            "start_time": 1.5,
        }
    )
    motion = TrainMotion(train)
    time = np.linspace(-3, 15, 3601)
    position = motion.position(time)
    assert position.shape == (3601, 32)
    speed = np.gradient(position[:, 0], time) * motion.sign
    # the gradient of a quadratic is exact except across corners
    np.testing.assert_allclose(speed[1:-1], motion.speed(time)[1:-1], atol=0.06)
    assert motion.position(1.5)[0] == 7.0
    for x in (position[200, 0], position[1500, 0], position[3500, 0]):
        times = motion.axle_times(x)
        assert motion.position(motion.time_at(x))[0] == pytest.approx(x, abs=1e-9)
        for axle, t in enumerate(times):
            assert motion.position(t)[axle] == pytest.approx(x, abs=1e-8)
