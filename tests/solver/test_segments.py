"""Lines in segments: what joins them does no work, and the joined line is the whole one."""

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp
from scipy.integrate import quad
from scipy.signal import butter, sosfiltfilt

from solver import Simulation, segments
from solver.line import assemble, rail_cut
from solver.modal import ModalRun, exponential_weights
from solver.modes import build_modal_line
from solver.scenario import build_scenario
from solver.segments import (
    JOINT,
    SegmentRun,
    cut_into,
    find_cuts,
    line_run,
    mean_weights,
    segmented_line,
)
from solver.traffic import Traffic

SPACING = 0.64
UNDAMPED = {
    "fastening": {"spacing": SPACING, "damping": 0.0},
    "mortar": {"damping": 0.0},
    "bed_on_bridge": {"damping": 0.0},
    "bed_on_subgrade": {"damping": 0.0},
    "bridge": {"damping_ratio": 0.0},
}


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


def case(limit=500.0, *, spans=(16.0,), approach=19.2, **tables):
    """A line of whole bays, symmetric about its middle."""
    given = {
        "track": {"fastening": {"spacing": SPACING}},
        "line": {"approach_left": approach, "spans": list(spans), "approach_right": approach},
        "solution": {"frequency_limit": limit, "step": round(1e9 / (8 * limit)) * 1e-9},
        "contact": {"law": "linear"},
        "irregularity": {
            "components": {"wavenumber": [4.0, 11.0], "amplitude": [2e-4, 5e-5], "phase": [0, 1]}
        },
        "channel": [
            {"name": "rail", "layer": "rail", "x": 15.3},
            {"name": "slab", "layer": "slab", "x": 24.0},
            {"name": "layer", "layer": "support_layer", "x": 28.3},
            {"name": "bridge", "layer": "bridge", "x": 27.2},
            {"name": "strain", "layer": "slab", "x": 22.1, "quantity": "strain", "fibre": 0.1},
            {"name": "pad", "layer": "rail", "x": 24.3, "quantity": "fastening_force"},
            {"name": "bearing", "layer": "bridge", "x": 19.2, "quantity": "bearing_force"},
        ],
    }
    return build_scenario({**given, **tables})


def wheel(**changes):
    return [{"preset": "wheel_element", "speed": 60.0, "start": 6.0, **changes}]


def seg_run(scenario, length, derivatives=(0,), **options):
    line = segmented_line(scenario, cut_into(scenario, length))
    return SegmentRun(line, Traffic(scenario), derivatives, precision=np.float64, **options)


def test_cuts_stand_at_bearings_and_between_fastenings():
    scenario = case(spans=[32.0, 32.0, 12.0, 12.0], approach=60.0, channel=[])
    cuts = cut_into(scenario, 24.0)
    bearings = {x for bounds in scenario.line.span_bounds for x in bounds}
    on_bridge = [x for x in cuts if 60.0 <= x <= 148.0]
    assert set(on_bridge) <= bearings
    assert on_bridge == [60.0, 92.0, 124.0, 148.0]
    for x in set(cuts) - bearings:
        assert (x / SPACING) % 1 == pytest.approx(0.0, abs=1e-6)
    assert np.diff([0.0, *cuts, scenario.line.length]).max() <= 32.0


def test_short_lines_stay_whole_and_long_ones_do_not():
    assert find_cuts(case(5000.0)) == ()
    assert find_cuts(case(5000.0, spans=[32.0] * 10)) != ()
    # modes of a line number its length times the root of the limit
    assert find_cuts(case(500.0, spans=[32.0] * 4)) == ()


def test_a_severed_line_that_is_held_together_is_the_line():
    scenario = case(200.0)
    whole, cuts = assemble(scenario), cut_into(scenario, 16.0)
    severed = assemble(scenario, cuts)
    parts = [severed.part(number) for number in range(len(cuts) + 1)]
    assert sum(part.size for part in parts) == severed.size
    # each segment's joints, with opposite signs on both sides of a cut
    blocks = [[None] * len(parts) for _ in cuts]
    for number, part in enumerate(parts):
        rows = part.joint_rows()
        if number:
            blocks[number - 1][number] = -rows[:JOINT]
        if number < len(cuts):
            blocks[number][number] = rows[-JOINT:]
    jump = sp.block_array(blocks).toarray()
    together = scipy.linalg.null_space(jump)
    matrices = {
        name: scipy.linalg.block_diag(*(getattr(part, name).toarray() for part in parts))
        for name in ("mass", "damping", "stiffness")
    }
    x = 17.9
    for frequency in (5.0, 60.0, 190.0):
        s = 2j * np.pi * frequency

        def dynamic(of, s=s):
            return of["stiffness"] + s * of["damping"] + s**2 * of["mass"]

        joined = together.T @ dynamic(matrices) @ together
        row = np.concatenate([part.rail_rows(x).toarray()[0] for part in parts]) @ together
        got = row @ np.linalg.solve(joined, row)
        own = {name: getattr(whole, name).toarray() for name in ("mass", "damping", "stiffness")}
        row = whole.rail_rows(x).toarray()[0]
        # the mesh has one node more in the bays that are cut
        assert got == pytest.approx(row @ np.linalg.solve(dynamic(own), row), rel=2e-3)


@pytest.mark.parametrize("eigenvalue", [-1e-3, -30 + 900j, -200 + 3e4j, -5e3 + 2e4j])
def test_mean_weights_are_the_mean_of_the_exact_response(eigenvalue):
    step, order = 2.5e-5, 2
    lam = np.array([eigenvalue], complex)
    m, mn, ml, mb, g0, g1, k0, k1 = (value[0] for value in mean_weights(lam, step, order))

    def response(t, load):
        def integrand(r, pick):
            return pick(np.exp(lam[0] * (t - r)) * load(r / step))

        parts = [quad(integrand, 0, t, args=(p,), epsrel=1e-11)[0] for p in (np.real, np.imag)]
        return parts[0] + 1j * parts[1]

    points, weights = np.polynomial.legendre.leggauss(12)

    def mean(load):
        return sum(
            w / 2 * response(step * (p + 1) / 2, load) for p, w in zip(points, weights, strict=True)
        )

    if abs(np.exp(eigenvalue * step)) < 0.05:
        pytest.skip("forces are linear")
    assert m == pytest.approx(np.expm1(lam[0] * step) / (lam[0] * step), rel=1e-9)
    assert mn == pytest.approx(mean(lambda s: s * (s + 1) / 2), rel=1e-8)
    assert ml == pytest.approx(mean(lambda s: 1 - s * s), rel=1e-8)
    assert mb == pytest.approx(mean(lambda s: s * (s - 1) / 2), rel=1e-8)
    assert g0 == pytest.approx(response(step, lambda s: 1.0), rel=1e-8)
    assert g1 == pytest.approx(response(step, lambda s: 2 * s - 1), rel=1e-7)
    assert k0 == pytest.approx(mean(lambda s: 1.0), rel=1e-8)
    assert k1 == pytest.approx(mean(lambda s: 2 * s - 1), rel=1e-7)


def energy(run):
    """Of undamped modes in which q' = i omega q + phi F: sum of omega |q|^2."""
    total = 0.0
    for number, part in enumerate(run.line.parts):
        re, im = run._modal[number, :, : len(part.eigenvalues)]
        total += (part.eigenvalues.imag * (re**2 + im**2)).sum()
    return total


@pytest.mark.parametrize("precision", [np.float32, np.float64])
def test_cut_forces_do_no_work(precision):
    scenario = case(track=UNDAMPED, channel=[])
    run = SegmentRun(
        segmented_line(scenario, cut_into(scenario, 16.0)),
        Traffic(scenario),
        (),
        precision=precision,
    )
    random = np.random.default_rng(1)
    run._modal[:] = random.normal(size=run._modal.shape) * (run.tables.vectors[:, :1, 0] != 0)
    # the first step closes the gaps of a random state
    run.advance(1)
    before = energy(run)
    run.advance(5000)
    # rounded shapes are the same for motion and force, so that single precision keeps it too
    assert energy(run) == pytest.approx(before, rel=1e-10)


def test_the_joint_is_of_fourth_order():
    scenario = case(track=UNDAMPED, channel=[])
    line = segmented_line(scenario, cut_into(scenario, 16.0))
    omega = [part.eigenvalues.imag for part in line.parts]
    # phi = psi / sqrt(2 i omega) with real shapes psi of mass 1
    psi = [
        (part.joint_shapes * np.sqrt(2j * w)).real
        for part, w in zip(line.parts, omega, strict=True)
    ]
    count = [len(w) for w in omega]
    jump = np.zeros((JOINT * len(line.cuts), sum(count)))
    for c in range(len(line.cuts)):
        rows = slice(c * JOINT, (c + 1) * JOINT)
        jump[rows, sum(count[:c]) : sum(count[: c + 1])] = psi[c][-JOINT:]
        jump[rows, sum(count[: c + 1]) : sum(count[: c + 2])] = -psi[c + 1][:JOINT]
    free = scipy.linalg.null_space(jump)
    all_omega = np.concatenate(omega)
    squared, vectors = scipy.linalg.eigh(free.T @ (all_omega[:, None] ** 2 * free))
    mode = int(np.searchsorted(np.sqrt(squared), 2 * np.pi * 200.0))
    frequency, start = float(np.sqrt(squared[mode])), free @ vectors[:, mode]

    def error(step):
        changed = scenario.model_copy(
            update={"solution": scenario.solution.model_copy(update={"step": step})}
        )
        run = SegmentRun(line, Traffic(changed), (), precision=np.float64)
        # the state before sample 0; nothing acts on the modes in that step
        y = np.sqrt(all_omega * 1j) * start
        first = 0
        for number, size in enumerate(count):
            run._put(run._modal, number, y[first : first + size].conj())
            first += size
        samples = round(0.02 / step)
        run._march_on(samples)
        left = []
        for number, size in enumerate(count):
            left.append(run._modal[number, 0, :size] - 1j * run._modal[number, 1, :size])
        # the state after the last sample lacks the cut forces of the next step: go back to it
        left = [y / np.exp(1j * w * step) for y, w in zip(left, omega, strict=True)]
        time = (samples - 1) * step
        exact = np.sqrt(all_omega * 1j) * (
            np.cos(frequency * time) * start
            + 1j * frequency / all_omega * np.sin(frequency * time) * start
        )
        weight = np.sqrt(all_omega)
        return np.linalg.norm(weight * (np.concatenate(left) - exact)) / np.linalg.norm(
            weight * exact
        )

    coarse, fine = error(2e-4), error(1e-4)
    assert np.log2(coarse / fine) > 3.5


@pytest.fixture(scope="module")
def passages():
    """A wheelset over a line that is whole, and in segments."""
    scenario = case(train=wheel())
    whole = ModalRun(
        build_modal_line(assemble(scenario)), Traffic(scenario), (0, 2), precision=np.float64
    )
    line = segmented_line(scenario, cut_into(scenario, 16.0))
    joined = SegmentRun(line, Traffic(scenario), (0, 2), precision=np.float64)
    samples = int(40.0 / 60.0 / scenario.solution.step)
    return scenario, whole.advance(samples), joined.advance(samples)


def test_a_passage_is_that_over_the_whole_line(passages):
    scenario, (_, _, force, signals), (_, _, joined_force, joined) = passages
    width = len(scenario.channel)
    error = abs(joined - signals).max(axis=0) / abs(signals).max(axis=0)
    # the dropped modes answer a cut statically; strain and forces converge slower than motion
    assert (error[:4] < 5e-3).all()
    assert (error[4:width] < 5e-2).all()
    # accelerations up to 0.4 of the limit
    low = butter(8, 0.4 * 500.0, fs=1 / scenario.solution.step, output="sos")
    wanted, got = (
        sosfiltfilt(low, values[:, width : width + 4], axis=0) for values in (signals, joined)
    )
    assert (abs(got - wanted).max(axis=0) < 4e-2 * abs(wanted).max(axis=0)).all()
    away = abs(force - joined_force) / np.nanmax(abs(force - np.nanmean(force)))
    # a change of segment shows in the force of a few steps
    assert np.nanmax(away) < 0.05
    assert np.sqrt(np.nanmean(away**2)) < 5e-3


def test_both_directions_are_mirror_images():
    channel = [
        {"name": "left", "layer": "rail", "x": 15.3},
        {"name": "right", "layer": "rail", "x": 54.4 - 15.3},
    ]
    smooth = {"irregularity": {}, "channel": channel}
    there = seg_run(case(train=wheel(start=6.004), **smooth), 16.0)
    back = seg_run(case(train=wheel(start=54.4 - 6.004, direction="backward"), **smooth), 16.0)
    _, _, force, signals = there.advance(2500)
    _, _, mirrored_force, mirrored = back.advance(2500)
    np.testing.assert_allclose(mirrored_force, force, rtol=1e-6)
    np.testing.assert_allclose(mirrored[:, ::-1], signals, atol=1e-6 * abs(signals).max())


def test_samples_do_not_depend_on_blocks():
    scenario = case(train=wheel())
    _, _, force, signals = seg_run(scenario, 16.0, (2,)).advance(2000)
    run = seg_run(scenario, 16.0, (2,))
    parts = [run.advance(size) for size in (1, 3, 700, 2, 1, 1, 792, 500)]
    np.testing.assert_array_equal(np.concatenate([part[2] for part in parts]), force)
    np.testing.assert_array_equal(np.concatenate([part[3] for part in parts]), signals)


def test_rest_is_rest():
    scenario = case(train=wheel(speed=1e-3), irregularity={})
    _, _, force, signals = seg_run(scenario, 16.0).advance(400)
    assert np.ptp(force) < 1e-5 * force.mean()
    # the rail lies 0.5 mm lower under the wheelset
    assert abs(signals[:, :4] - signals[0, :4]).max() < 1e-9


def test_a_train_longer_than_a_segment_over_three_spans(monkeypatch):
    monkeypatch.setattr(segments, "WHOLE_LENGTH", 10.0)
    monkeypatch.setattr(segments, "SEGMENT_LENGTH", 5.0)
    scenario = case(
        400.0,
        spans=[16.0, 16.0, 16.0],
        train=[{"preset": "CRH3", "speed": 80.0, "start": -30.0}],
        contact={"law": "hertz"},
        irregularity={},
        solution={"frequency_limit": 400.0, "end_time": 0.9},
    )
    sim = Simulation(scenario, outputs=("displacement",), balance=True)
    assert isinstance(sim._run, SegmentRun)
    shown = np.concatenate([block.displacement for block in sim.blocks(1000)])
    quality = sim.quality
    assert quality.lost_contacts == 0
    assert quality.equilibrium_residual < 1e-9
    assert quality.energy_residual is None
    assert any("m in 5 segments" in note for note in quality.notes)
    assert "energy balance: not available for a line in segments" in quality.notes
    monkeypatch.setattr(segments, "WHOLE_LENGTH", 1e9)
    reference = line_run(scenario, Traffic(scenario), (0,), balance=False)
    assert not isinstance(reference, SegmentRun)
    _, _, _, signals = reference.advance(len(shown))
    error = abs(shown - signals).max(axis=0) / abs(signals).max(axis=0)
    assert (error[:4] < 2e-2).all()


def test_segments_come_from_the_cache(monkeypatch):
    scenario = case(channel=[])
    cuts = cut_into(scenario, 16.0)
    first = segmented_line(scenario, cuts)
    monkeypatch.setattr(segments, "build_modal_line", lambda *_: pytest.fail("solved again"))
    again = segmented_line(scenario, cuts)
    np.testing.assert_array_equal(again.eigenvalues, first.eigenvalues)
    assert again.cuts == tuple(rail_cut(scenario, x) for x in cuts)


def test_weights_of_the_mean_join_those_of_the_end():
    # q gains the same from q' = lambda q + p whichever way the step is summed
    lam, step = np.array([-40 + 2000j]), 1e-4
    decay, now, last, before = exponential_weights(lam, step, 2)
    m, mn, ml, mb, *_ = mean_weights(lam, step, 2)
    z = lam * step
    np.testing.assert_allclose(decay - 1, z * m, rtol=1e-12)
    for end, mean, share in ((now, mn, 5 / 12), (last, ml, 2 / 3), (before, mb, -1 / 12)):
        np.testing.assert_allclose(end, z * mean + share * step, rtol=1e-9)
