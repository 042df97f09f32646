"""Runs of whole scenarios: balance, symmetry, streaming, trains at run time, refusals."""

import numpy as np
import pytest
from closed_forms import LENGTH, MASS, beam_line, damping_ratios, frequencies

from solver import InputError, Simulation, SolverError, build_scenario, check_run
from solver.modal import ModalRun
from solver.modes import modal_line
from solver.proofs import rolling_weight
from solver.traffic import RUN_IN, Traffic

ALL = ("displacement", "velocity", "acceleration")


def table(**changes):
    """A short crts2 line to 700 Hz; mirror-symmetric, 24 bays."""
    scenario = {
        "line": {"approach_left": 5.2, "spans": [5.2], "approach_right": 5.2},
        "train": [{"preset": "wheel_element", "speed": 60.0, "start": 5.0}],
        "irregularity": {"spectrum": "sato", "wavelength_min": 0.1},
        "channel": [
            {"name": "rail", "layer": "rail", "x": 7.0},
            {"name": "bridge", "layer": "bridge", "x": 7.0},
        ],
        "solution": {"frequency_limit": 700.0, "step": 5e-5},
    }
    for key, value in changes.items():
        scenario[key] = {**scenario.get(key, {}), **value} if isinstance(value, dict) else value
    return scenario


def run(scenario, outputs=ALL):
    simulation = Simulation(build_scenario(scenario), outputs=outputs)
    return simulation, simulation.advance(simulation.end_index)


def test_energy_of_a_passage_balances():
    """Work of the moving force on the beam = stored + dissipated, mode by mode."""
    modes = 10
    wave = {"components": {"wavenumber": [9.0], "amplitude": [3e-4], "phase": [0.2]}}
    scenario = rolling_weight(
        156_960.0, [0.0], 60.0, start=-2.0, wheelset_mass=2000.0, contact=1.325e9, irregularity=wave
    )
    line = beam_line([16.0] * modes, modes=modes)
    # channels that read the modal coordinates themselves
    k = np.arange(1, modes + 1) * np.pi / LENGTH
    scale = line.channel_shapes[0] / np.sin(k * 16.0)
    line.channel_shapes[:] = np.diag(scale)
    samples = int((LENGTH + 4) / 60.0 / 2.5e-5)
    stepper = ModalRun(line, Traffic(scenario), (0, 1), precision=np.float64)
    time, position, force, signals = stepper.advance(samples)
    q, v = signals[:, :modes], signals[:, modes:]
    mass, omega, zeta = MASS * LENGTH / 2, frequencies(modes), damping_ratios(modes)
    stored = 0.5 * mass * (v**2 + omega**2 * q**2).sum(axis=1)
    dissipated = np.trapezoid((2 * zeta * omega * mass * v**2).sum(axis=1), time)
    under = (np.sin(position * k) * v).sum(axis=1)
    work = np.trapezoid(np.nan_to_num(force[:, 0]) * under, time)
    # 0.1 % is asked for; the trapezoidal sums above are exact to 1e-4 at 25 us
    assert stored[-1] - stored[0] + dissipated == pytest.approx(work, rel=2e-4)
    assert dissipated > 0.1 * work > 0


@pytest.mark.parametrize(("model", "tolerance"), [("fe", 1e-3), ("hybrid", 5e-3)])
def test_a_run_balances_the_energy_of_its_line(model, tolerance):
    """Work of the wheels = loss + change of energy for the damping as it is: 0.1 %.

    Trapezoidal sums of power with 6 steps a period, as the hybrid has them at its crossover, err
    by (2 pi/6)^2/12 = 9 % of what comes from there, a few per cent of all power: 0.5 %.

    The motion is put together from the complex modes and weighed with M, C and K, so the balance
    fails if stepping, normalisation or truncation is wrong.
    """
    solution = {"model": model, "end_time": 0.25}
    if model == "hybrid":
        solution |= {"frequency_limit": 2500.0, "step": 2.5e-5}
    simulation = Simulation(build_scenario(table(solution=solution)), balance=True)
    for _ in simulation.blocks(777):
        pass
    run = simulation._run if model == "fe" else simulation._run._run
    work, lost, change = run._balance.totals()
    assert lost > 0.1 * abs(change)
    assert simulation.quality.energy_residual < tolerance
    # the same without a tenth of the loss does not close
    assert abs(work - 0.9 * lost - change) > 2 * tolerance * max(abs(work), abs(change))


@pytest.mark.parametrize("law", ["linear", "hertz"])
def test_static_start_carries_the_weight_and_stays(law):
    scenario = table(
        train=[
            {
                "vehicles": [{"preset": "CRH3", "bogie_centres": 7.5, "length": 11}],
                "speed": 1e-3,
                "start": 13.0,
            }
        ],
        irregularity={"spectrum": None, "wavelength_min": None},
        contact={"law": law},
        solution={"end_time": 0.02},
    )
    simulation, block = run(scenario)
    weight = simulation.scenario.train[0].mass * 9.81
    sums = block.wheelset_force.sum(axis=1)
    # single-precision shapes: 1e-6; asked for is 0.01 %
    np.testing.assert_allclose(sums, weight, rtol=1e-5)
    assert np.abs(block.acceleration).max() < 0.02
    # a bridge channel's displacement is the static one: constant
    still = np.broadcast_to(block.displacement[:1], block.displacement.shape)
    np.testing.assert_allclose(block.displacement, still, rtol=5e-4)


def test_impulse_of_the_contact_forces_is_that_of_the_weight():
    """Newton's second law for the train: momentum gained = (weight - contact forces) integrated."""
    scenario = build_scenario(table(solution={"end_time": 0.1}))
    traffic = Traffic(scenario)
    stepper = ModalRun(modal_line(scenario), traffic, (), precision=np.float64)
    forces, momenta = [], []
    for _ in range(403):
        stepper.advance(1)
        fleet, unit, step = stepper._fleet, traffic.kinds[0], stepper._steps[0]
        force = fleet.force.copy()
        # the stepper keeps the state before the next sample; undo its last step
        shifted = np.linalg.solve(
            step.transition, fleet.state[0] - step.drive @ force - step.constant
        )
        if forces:
            state = shifted + step.now @ force + step.before @ forces[-1]
            momenta.append(np.diag(unit.mass) @ state[len(unit.weight) :])
        forces.append(force)
    chain = np.concatenate(forces)
    # forces are quadratic in every step, through three samples
    impulse = (5 * chain[2:] + 8 * chain[1:-1] - chain[:-2]).sum() / 12 * traffic.step
    gained = momenta[-1] - momenta[0]
    weight = unit.weight.sum() * (len(chain) - 2) * traffic.step
    assert np.ptp(chain) > 1e4
    assert gained == pytest.approx(weight - impulse, abs=1e-7 * weight)


def test_backward_is_the_mirror_image_of_forward():
    length = 15.6
    dip = {"shape": "dip", "x": 9.0, "length": 1.0, "depth": 3e-4}
    ahead = table(
        irregularity={"spectrum": None, "wavelength_min": None, "defect": [dip]},
        solution={"end_time": 0.1},
    )
    back = table(
        train=[
            {
                "preset": "wheel_element",
                "speed": 60.0,
                "start": length - 5.0,
                "direction": "backward",
            }
        ],
        irregularity={
            "spectrum": None,
            "wavelength_min": None,
            "defect": [{**dip, "x": length - 9.0}],
        },
        channel=[{**c, "x": length - c["x"]} for c in ahead["channel"]],
        solution={"end_time": 0.1},
    )
    (_, one), (_, two) = run(ahead), run(back)
    np.testing.assert_allclose(one.wheelset_position, length - two.wheelset_position)
    # single-precision shapes on another grid
    for name in ("wheelset_force", "displacement", "velocity"):
        a, b = getattr(one, name), getattr(two, name)
        assert np.abs(a - b).max() < 2e-3 * np.abs(a).max()


def test_blocks_are_a_cut_of_the_whole_run():
    scenario = build_scenario(table(solution={"end_time": 0.05}))
    whole = Simulation(scenario, outputs=ALL).advance(1001)
    simulation = Simulation(scenario, outputs=ALL)
    assert simulation.end_index == 1001
    blocks = list(simulation.blocks(137))
    assert [block.index for block in blocks] == list(range(0, 1001, 137))
    for name in ("time", "wheelset_position", "wheelset_force", *ALL):
        joined = np.concatenate([getattr(block, name) for block in blocks])
        np.testing.assert_allclose(joined, getattr(whole, name), rtol=1e-9, atol=1e-9)


def test_force_is_reported_on_the_line_only():
    scenario = table(
        train=[{"preset": "wheel_element", "speed": 60.0, "start": -RUN_IN - 5.0}],
        solution={"end_time": 1.0},
    )
    _, block = run(scenario, outputs=("acceleration",))
    assert block.displacement is None
    x = block.wheelset_position[:, 0]
    inside = np.abs(x - 7.8) <= 7.8
    clear = np.abs(np.abs(x - 7.8) - 7.8) > 1e-9
    on = np.isfinite(block.wheelset_force[:, 0])
    np.testing.assert_array_equal(on[clear], inside[clear])
    # nothing moves before the wheelset comes
    assert np.abs(block.acceleration[x < -0.1]).max() == 0
    assert np.isfinite(block.acceleration).all()


def test_two_trains_meet_and_a_third_is_added():
    trains = [
        {"preset": "wheel_element", "speed": 60.0, "start": -3.0},
        {"preset": "wheel_element", "speed": 50.0, "start": 18.0, "direction": "backward"},
    ]
    known = build_scenario(table(train=[*trains, {**trains[0], "start_time": 0.1}]))
    whole = Simulation(known, outputs=("displacement",)).advance(8000)
    simulation = Simulation(build_scenario(table(train=trains)), outputs=("displacement",))
    first = simulation.advance(1000)
    assert first.wheelset_force.shape == (1000, 2)
    assert simulation.add_train(known.train[0], start_time=0.1) == 2
    rest = simulation.advance(7000)
    assert list(rest.wheelset_train) == [0, 1, 2]
    assert list(rest.wheelset_number) == [1, 1, 1]
    np.testing.assert_allclose(rest.wheelset_position, whole.wheelset_position[1000:])
    on = np.isfinite(rest.wheelset_force[:, 2])
    np.testing.assert_array_equal(on, np.isfinite(whole.wheelset_force[1000:, 2]))
    # the late one has a shorter run-in
    np.testing.assert_allclose(
        rest.displacement, whole.displacement[1000:], atol=0.02 * np.abs(whole.displacement).max()
    )


def test_hertzian_loss_of_contact_is_counted():
    bump = {"components": {"wavenumber": [40.0], "amplitude": [3e-4], "phase": [0.0]}}
    scenario = table(
        irregularity={"spectrum": None, "wavelength_min": None, **bump},
        contact={"law": "hertz"},
        solution={"end_time": 0.08},
    )
    simulation, block = run(scenario)
    force = block.wheelset_force[:, 0]
    away = (block.wheelset_position[:, 0] > 3) & (block.wheelset_position[:, 0] < 12.6)
    lifts = ((force[1:] == 0) & (force[:-1] > 0) & away[1:]).sum()
    assert simulation.quality.lost_contacts == lifts > 3
    assert np.nanmin(force) == 0
    assert simulation.quality.equilibrium_residual < 1e-9


def test_wheel_flat_strikes_once_per_revolution():
    vehicle = {"preset": "wheel_element", "speed": 60.0, "start": 1.0}
    scenario = table(
        train=[{**vehicle, "flat": [{"wheelset": 1, "length": 0.03}]}],
        irregularity={"spectrum": None, "wavelength_min": None},
        contact={"law": "hertz"},
        solution={"end_time": 0.2},
    )
    _, struck = run(scenario)
    _, round_ = run({**scenario, "train": [vehicle]})
    change = np.abs(struck.wheelset_force - round_.wheelset_force)[:, 0]
    rolled = struck.wheelset_position[:, 0] - 1.0
    circumference = 2 * np.pi * 0.46
    peaks = [
        change[(rolled > n * circumference) & (rolled < n * circumference + 0.5)].max()
        for n in range(4)
    ]
    assert min(peaks) > 2e4


def test_check_run_names_every_quantity_and_shrinks_with_the_step():
    scenario = build_scenario(table(solution={"end_time": 0.03}))
    shares = []
    result = check_run(scenario, report=shares.append)
    assert result.rows[0].quantity == "wheelset force"
    assert len(result.rows) == 1 + 2 * 3
    assert shares[-1] == 1.0
    assert "50 -> 25 us" in result.title
    # 700 Hz are not enough for the acceleration of a rail; displacements do not mind
    assert all(0 < row.change < 0.01 for row in result.rows if "displacement" in row.quantity)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"solution": {"step": 1e-3}}, "too long for solution.frequency_limit = 700 Hz"),
        (
            {"solution": {"step": 6e-4}},
            r"wheelset of 2400 kg resonates on its contact at 167 Hz; at most 0.000476 s",
        ),
        (
            {"line": {"ends": "free"}, "solution": {"end_time": 0.3}},
            "wheelset 1 of the train that starts at 5 m crosses the end x = 15.6 m at t = 0.17",
        ),
        ({"irregularity": {"wavelength_min": 0.3}}, "leave nothing"),
    ],
)
def test_wrong_scenarios_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        Simulation(build_scenario(table(**changes))).advance(1)


@pytest.mark.parametrize("integrator", ["exponential", "newmark"])
def test_divergence_is_a_typed_error_and_no_nan_comes_out(integrator):
    """A state that is not finite, put in by hand: no step that is accepted diverges by itself."""
    solution = {"integrator": integrator, "step": 2e-4}
    simulation = Simulation(build_scenario(table(solution=solution)))
    simulation.advance(20)
    run = simulation._run
    if integrator == "newmark":
        run._line.u[3] = np.nan
    else:
        run._modal.ravel()[3] = np.nan
    with pytest.raises(SolverError, match=r" = nan N before|change by nan N after"):
        simulation.advance(20)


def test_a_wheel_force_beyond_all_bounds_is_a_typed_error(monkeypatch):
    monkeypatch.setattr("solver.modal.FORCE_LIMIT", 1e-2)
    simulation = Simulation(build_scenario(table()))
    with pytest.raises(
        SolverError, match=r"force of a wheelset = .* N before t = .*; limit 1\.\d+e\+03 N"
    ):
        simulation.advance(20)


def test_a_train_out_of_nowhere_is_refused():
    simulation = Simulation(build_scenario(table()))
    simulation.advance(100)
    train = simulation.scenario.train[0]
    with pytest.raises(InputError, match=r"wheelset 1 would be at x = .* on the line of 15.6 m"):
        simulation.add_train(train, start_time=0.0)


def test_no_train_is_silence():
    _, block = run(table(train=[], solution={"end_time": 0.01}))
    assert block.wheelset_force.shape == (201, 0)
    assert not block.acceleration.any()
