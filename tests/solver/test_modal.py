"""The stepper against closed forms, against its readable twin, and its convergence."""

import numpy as np
import pytest
from closed_forms import LENGTH, beam_line, frequencies
from scipy.integrate import quad, solve_ivp

from solver.modal import ModalRun, exponential_weights, march, march_reference
from solver.proofs import AXLE_FORCE as AXLE
from solver.proofs import moving_force, rolling_weight, span_errors
from solver.scenario import GRAVITY
from solver.traffic import Traffic


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("eigenvalue", [-1e-3, -30 + 900j, -200 + 3e4j, -5e3 + 2e4j, -4e5])
def test_weights_integrate_polynomial_forces_exactly(order, eigenvalue):
    step = 2.5e-5
    decay, now, last, before = exponential_weights(np.array([eigenvalue], complex), step, order)
    effective = 1 if abs(np.exp(eigenvalue * step)) < 0.05 else order
    for power in range(effective + 1):

        def part(t, pick, power=power):
            return pick(np.exp(eigenvalue * (step - t)) * (t / step) ** power)

        split = [step * 0.99] if abs(eigenvalue) > 1e5 else None
        exact = quad(part, 0, step, args=(np.real,), points=split, epsabs=0, epsrel=1e-13)[0]
        exact += 1j * quad(part, 0, step, args=(np.imag,), epsabs=1e-22, epsrel=1e-12)[0]
        value = now[0] + last[0] * (power == 0) + before[0] * (-1.0) ** power
        assert value == pytest.approx(exact, rel=1e-9)
    assert decay[0] == pytest.approx(np.exp(eigenvalue * step))


def run(scenario, line, derivatives, samples, **options):
    stepper = ModalRun(line, Traffic(scenario), derivatives, precision=np.float64, **options)
    return stepper, stepper.advance(samples)


CRITICAL = LENGTH / np.pi * frequencies()[0]


@pytest.mark.parametrize("ratio", [0.15, 0.5, 1.3])
def test_constant_force_over_a_beam_follows_the_series(ratio):
    # speeds below and above the critical one, at which the force keeps pace with the first mode
    speed = ratio * CRITICAL
    scenario = rolling_weight(AXLE, [0.0], 1.0, start=-1.0)
    train = scenario.train[0].model_copy(update={"speed": speed})
    scenario = scenario.model_copy(update={"train": (train,)})
    line = beam_line([10.0, 16.0])
    samples = int((LENGTH + 1) / speed / 2.5e-5) + 4000
    _, (time, _, force, signals) = run(scenario, line, (0,), samples)
    for column, x in enumerate((10.0, 16.0)):
        exact, _ = moving_force(x, time, speed, entry=1.0 / speed)
        error = np.abs(signals[:, column] - AXLE * exact).max()
        # what is left is the inertia of the light wheelset, not the stepping
        assert error < 5e-5 * np.abs(AXLE * exact).max()
    assert np.nanmax(np.abs(force / AXLE - 1)) < 5e-4


def test_train_of_forces_on_the_bare_span():
    """Four axles of 156 960 N at 83.33 m/s on a hierarchical element against the series.

    Asked for are 0.01 % and, below 60 Hz, 1 %; 20 sines and exact steps leave the inertia of the
    light wheelsets.
    """
    displacement, acceleration = span_errors()
    assert displacement < 2e-5
    assert acceleration < 1e-4


def heavy(step=2.5e-5, law="linear"):
    """A wheelset of 2 t under a constant weight on the rough beam, 183 Hz on its contact spring."""
    scenario = rolling_weight(
        AXLE,
        [0.0],
        60.0,
        start=4.0,
        step=step,
        wheelset_mass=2000.0,
        contact=1.325e9,
        irregularity={
            "components": {
                "wavenumber": [6.0, 25.0],
                "amplitude": [4e-4, 5e-5],
                "phase": [0.3, 1.0],
            }
        },
    )
    contact = scenario.contact.model_copy(update={"law": law})
    return scenario.model_copy(update={"contact": contact})


def test_unsprung_mass_over_a_rough_beam_follows_an_independent_integration():
    """Mass on its contact spring on the beam: all modes and the mass in one system of ODEs."""
    scenario = heavy()
    line = beam_line([16.0], modes=8)
    samples = 8000
    _, (time, _, force, signals) = run(scenario, line, (0, 1), samples)
    mass, hanging = 2000.0, AXLE - 2000.0 * GRAVITY
    contact = 2 * scenario.contact.stiffness
    parts = scenario.irregularity.components
    k = np.arange(1, 9) * np.pi / LENGTH
    omega, zeta = frequencies(8), -line.eigenvalues.real / frequencies(8)
    modal = 29720.0 * LENGTH / 2

    def roughness(x):
        waves = zip(parts.wavenumber, parts.amplitude, parts.phase, strict=True)
        return sum(a * np.cos(w * x + p) for w, a, p in waves)

    def push(t, z, q):
        x = 4.0 + 60.0 * t
        return contact * (z - np.sin(k * x) @ q - roughness(x))

    def flow(t, y):
        z, v, q, r = y[0], y[1], y[2:10], y[10:]
        f = push(t, z, q)
        shape = np.sin(k * (4.0 + 60.0 * t))
        return np.concatenate(
            [
                [v, GRAVITY + (hanging - f) / mass],
                r,
                shape * f / modal - 2 * zeta * omega * r - omega**2 * q,
            ]
        )

    rest = np.sin(k * 4.0) * AXLE / modal / omega**2
    z0 = np.sin(k * 4.0) @ rest + roughness(4.0) + AXLE / contact
    start = np.concatenate([[z0, 0.0], rest, np.zeros(8)])
    exact = solve_ivp(
        flow, (0, time[-1]), start, t_eval=time, method="DOP853", rtol=1e-10, atol=1e-13
    ).y
    forces = np.array(
        [push(t, z, q) for t, z, q in zip(time, exact[0], exact[2:10].T, strict=True)]
    )
    middle = np.sin(k * 16.0)
    assert np.ptp(forces) > AXLE
    # the rest is the step of 25 us: contact resonance at 183 Hz, roughness to 239 Hz
    assert np.abs(force[:, 0] - forces).max() < 1e-4 * np.ptp(forces)
    for column, part in enumerate((exact[2:10], exact[10:])):
        wanted = middle @ part
        assert np.abs(signals[:, column] - wanted).max() < 1e-4 * np.ptp(wanted)


@pytest.mark.parametrize("law", ["linear", "hertz"])
def test_kernel_and_readable_twin_agree(law):
    scenario = heavy(law=law)
    line = beam_line([16.0, 20.0])
    results = [
        run(scenario, line, (0, 1, 2), 400, marching=marching)[1]
        for marching in (march, march_reference)
    ]
    for fast, readable in zip(*results, strict=True):
        np.testing.assert_allclose(fast, readable, rtol=1e-9, atol=1e-9 * np.abs(readable).max())


def test_kernel_and_readable_twin_agree_with_seven_wheelsets_of_which_one_leaves_and_one_enters():
    # the kernel takes wheelsets by twos and fours: seven, six and seven again leave a rest
    axles = [0.0, 2.5, 5.0, 9.0, 12.0, 20.0, 31.9]
    scenario = rolling_weight(AXLE, axles, 60.0, start=31.75)
    line = beam_line([16.0, 20.0])
    fast, readable = (
        run(scenario, line, (0, 2), 300, marching=marching)[1]
        for marching in (march, march_reference)
    )
    on_line = np.isfinite(fast[2]).sum(axis=1)
    assert set(on_line) == {6, 7}
    for one, other in zip(fast, readable, strict=True):
        scale = np.nanmax(np.abs(other))
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9 * scale)


def test_single_precision_of_shapes_changes_little():
    line, scenario = beam_line([16.0, 20.0]), heavy(law="hertz")
    exact = ModalRun(line, Traffic(scenario), (2,), precision=np.float64).advance(4000)
    single = ModalRun(line, Traffic(scenario), (2,)).advance(4000)
    for one, other in zip(exact[2:], single[2:], strict=True):
        # sums of 15 modes and the force through a contact of 2.6 GN/m: some 1e-7 of the static
        # load of 157 kN, whose dynamic part is as large here
        assert np.abs(one - other).max() < 1e-5 * np.ptp(one)


@pytest.mark.parametrize(("order", "rate"), [(1, 1.9), (2, 2.8)])
def test_order_of_convergence_in_the_step(order, rate):
    line = beam_line([16.0])
    forces = []
    for refinement in (1, 2, 4, 16):
        step = 2e-4 / refinement
        _, (_, _, force, _) = run(heavy(step), line, (), 1000 * refinement, order=order)
        forces.append(force[::refinement, 0])
    errors = [np.abs(force - forces[-1]).max() for force in forces[:-1]]
    assert np.log2(errors[0] / errors[1]) > rate
    assert np.log2(errors[1] / errors[2]) > rate


def test_blocks_do_not_depend_on_how_they_are_cut():
    scenario = rolling_weight(AXLE, [0.0, 3.0], 60.0, start=-24.99)
    line = beam_line([16.0])
    whole = ModalRun(line, Traffic(scenario), (0, 2)).advance(20000)
    cut = ModalRun(line, Traffic(scenario), (0, 2))
    pieces = [cut.advance(n) for n in (1, 2, 31, 7, 9000, 33, 10926)]
    for one, many in zip(whole, zip(*pieces, strict=True), strict=True):
        many = np.concatenate(many)
        np.testing.assert_allclose(one, many, rtol=1e-12, atol=1e-14 * np.nanmax(np.abs(one)))


def test_equilibrium_closes_in_every_step():
    scenario = heavy()
    stepper, _ = run(scenario, beam_line([16.0]), (), 4000)
    assert stepper.equilibrium_residual < 1e-12
