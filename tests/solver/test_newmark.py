"""Newmark on the full matrices: energy, order, agreement with the exponential steps."""

import numpy as np
import pytest

from solver import Simulation, build_scenario


def scenario(integrator="newmark", step=5e-5, law="linear", end=0.012, limit=1500.0, sines=None):
    return build_scenario(
        {
            # a Timoshenko rail has a kink under the wheel, which the full matrices never resolve
            "track": {"rail": {"theory": "euler_bernoulli"}},
            "line": {"approach_left": 5.2, "spans": [5.2], "approach_right": 5.2},
            "train": [{"preset": "wheel_element", "speed": 60.0, "start": 7.8}],
            "contact": {"law": law},
            # the wheel starts in the middle of a bay and of the line, where nothing has a slope
            "irregularity": {"defect": [{"shape": "dip", "x": 8.2, "length": 0.6, "depth": 2e-4}]},
            "channel": [
                {"name": "rail", "layer": "rail", "x": 8.0},
                {"name": "slab", "layer": "slab", "x": 8.0},
                {"name": "bridge", "layer": "bridge", "x": 8.0},
                {"name": "pad", "layer": "rail", "x": 8.0, "quantity": "fastening_force"},
            ],
            "solution": {
                "integrator": integrator,
                "step": step,
                "frequency_limit": limit,
                "end_time": end,
                **({"sines": sines} if sines else {}),
            },
        }
    )


def run(**options):
    simulation = Simulation(
        scenario(**options), outputs=("displacement", "velocity", "acceleration")
    )
    return simulation, simulation.advance(simulation.end_index)


def test_energy_of_the_line_balances_in_every_step():
    simulation = Simulation(scenario())
    simulation.advance(1)
    start = simulation._run.energy()
    simulation.advance(simulation.end_index - 1)
    newmark = simulation._run
    change = newmark.energy() - start + newmark.dissipated
    assert newmark.work > 0
    # average acceleration conserves energy exactly; what is left is the solution of the equations
    assert change == pytest.approx(newmark.work, rel=1e-9)
    assert simulation.quality.equilibrium_residual < 1e-9
    assert simulation.quality.energy_residual < 1e-9


def test_second_order_in_the_step():
    # few functions, so that the steps resolve every mode of the full matrices
    steps = (2e-4, 1e-4, 5e-5, 1.25e-5)
    forces = [
        run(step=h, end=0.01, sines=[6, 4, 4, 4])[1].wheelset_force[:: round(2e-4 / h), 0]
        for h in steps
    ]
    errors = [np.abs(force - forces[-1]).max() for force in forces[:-1]]
    rates = np.log2(np.array(errors[:-1]) / errors[1:])
    # the reference has 1/16 of the last error, which adds log2(1 + 1/16 ...) < 0.1
    assert (rates > 1.8).all()
    assert (rates < 2.3).all()


@pytest.mark.parametrize("law", ["linear", "hertz"])
def test_agrees_with_exponential_steps(law):
    _, paper = run(law=law)
    _, ours = run(law=law, integrator="exponential")
    dynamic = np.ptp(ours.wheelset_force)
    assert dynamic > 10e3
    # the modes end at 1.15 * 1500 Hz, the full matrices do not: on the rail at the wheel that
    # leaves 0.2 % of the force (0.1 % with 3000 Hz, where the test takes a minute)
    assert np.abs(paper.wheelset_force - ours.wheelset_force).max() < 0.004 * dynamic
    # rail, slab, bridge, pad force
    for column, tolerance in enumerate((1e-3, 3e-4, 1e-3, 3e-3)):
        one, two = paper.displacement[:, column], ours.displacement[:, column]
        assert np.abs(one - two).max() < tolerance * np.abs(two).max()
    for column, tolerance in ((1, 0.01), (2, 2e-3)):
        one, two = paper.velocity[:, column], ours.velocity[:, column]
        assert np.abs(one - two).max() < tolerance * np.abs(two).max()


def test_stays_at_rest_when_nothing_moves_the_wheel():
    table = scenario().model_dump(mode="json", exclude_none=True)
    table["irregularity"] = {}
    table["train"][0]["speed"] = 1e-3
    simulation = Simulation(build_scenario(table))
    block = simulation.advance(60)
    np.testing.assert_allclose(block.wheelset_force[:, 0], 14_000 * 9.81, rtol=1e-6)
