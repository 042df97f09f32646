"""The assembled line: statics, balance of forces, spans, variations, presets."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse as sp
import scipy.sparse.linalg

from solver import SolverError, build_scenario, load_scenario
from solver.line import assemble, beam_sections
from solver.modes import real_modes

WEIGHT = 137.3e3


def scenario(**tables):
    base = {
        "line": {"approach_left": 6.0, "spans": [16.0], "approach_right": 6.0},
        "solution": {"frequency_limit": 500.0},
    }
    for name, table in tables.items():
        base[name] = {**base.get(name, {}), **table} if isinstance(table, dict) else table
    return build_scenario(base)


def static(structure, x, load=WEIGHT):
    """Coordinates under a wheelset standing at x."""
    force = load * structure.rail_rows(x).toarray()[0]
    return scipy.sparse.linalg.spsolve(sp.csc_array(structure.stiffness), force)


def channels_of(quantity, layer, positions):
    return [
        {"name": f"{quantity}_{i}", "quantity": quantity, "layer": layer, "x": float(x)}
        for i, x in enumerate(positions)
    ]


def read(structure, q):
    """Static reading of every channel."""
    return np.array(
        [(structure.probe(c).displacement_rows @ q)[0] for c in structure.scenario.channel]
    )


def test_matrices_are_symmetric_and_definite():
    structure = assemble(scenario())
    for name in ("mass", "damping", "stiffness"):
        matrix = getattr(structure, name).toarray()
        assert abs(matrix - matrix.T).max() < 1e-9 * abs(matrix).max()
        scale = 1 / np.sqrt(np.maximum(matrix.diagonal(), 1e-30 * matrix.diagonal().max()))
        lowest = scipy.linalg.eigvalsh(matrix * scale[:, None] * scale)[0]
        assert lowest > -1e-9
        if name != "damping":
            assert lowest > 0


def test_mass_of_the_line():
    # a rigid descent of the free line moves exactly its mass
    structure = assemble(scenario(line={"ends": "free"}))
    x = np.linspace(0, 28, 400)
    rows = sp.vstack([structure.rows(layer, x) for layer in ("rail", "slab", "support_layer")])
    descent = scipy.sparse.linalg.lsqr(rows, np.ones(rows.shape[0]), atol=1e-14, btol=1e-14)[0]
    sections = beam_sections(structure.scenario.track)
    expected = 28 * sum(
        sections[layer].mass_per_length for layer in ("rail", "slab", "support_layer")
    )
    assert descent @ structure.mass @ descent == pytest.approx(expected, rel=1e-6)


def test_fastening_forces_carry_the_load():
    probe = scenario(line={"ends": "free"})
    positions = assemble(probe).fastenings
    structure = assemble(
        scenario(line={"ends": "free"}, channel=channels_of("fastening_force", "rail", positions))
    )
    q = static(structure, 14.2)
    forces = read(structure, q)
    assert forces.sum() == pytest.approx(WEIGHT, rel=1e-9)
    assert forces @ positions == pytest.approx(WEIGHT * 14.2, rel=1e-8)
    assert 0.2 < forces.max() / WEIGHT < 0.5


@pytest.mark.parametrize("bearing", [None, 5e9], ids=["rigid", "elastic"])
def test_bearings_and_ground_carry_the_load(bearing):
    tables = {
        "line": {"ends": "free"},
        "track": {} if bearing is None else {"bridge": {"bearing_stiffness": bearing}},
    }
    structure = assemble(
        scenario(channel=channels_of("bearing_force", "bridge", [6.0, 22.0]), **tables)
    )
    q = static(structure, 11.0)
    left, right = read(structure, q)
    points, weights = np.polynomial.legendre.leggauss(60)
    ground = 0.0
    bed = structure.scenario.track.bed_on_subgrade
    for a in (0.0, 22.0):
        x = a + 3 * (points + 1)
        ground += 3 * weights @ (structure.rows("support_layer", x) @ q)
    ground *= bed.stiffness * bed.width
    assert left + right + ground == pytest.approx(WEIGHT, rel=1e-8)
    assert left > right > 0


def test_moving_load_reaction_includes_the_inertia_of_the_girder():
    # resonant girder: the reaction of rigid bearings must balance bed force less inertia
    structure = assemble(
        scenario(
            line={"approach_left": 0.0, "approach_right": 0.0, "ends": "free"},
            channel=channels_of("bearing_force", "bridge", [0.0, 16.0]),
            # the mass-proportional part of Rayleigh damping is a force from outside
            track={"bridge": {"damping_ratio": 0.0}},
        )
    )
    w = 2 * np.pi * 40.0
    matrix = structure.stiffness - w**2 * structure.mass + 1j * w * structure.damping
    force = structure.rail_rows(5.0).toarray()[0].astype(complex)
    q = scipy.sparse.linalg.spsolve(sp.csc_array(matrix), force)
    reaction = sum(
        (p.displacement_rows + 1j * w * p.velocity_rows - w**2 * p.acceleration_rows) @ q
        for p in map(structure.probe, structure.scenario.channel)
    )
    sections = beam_sections(structure.scenario.track)
    points, weights = np.polynomial.legendre.leggauss(12)
    breaks = np.unique([0.0, *structure.fastenings, 16.0])  # kinks of the rail
    half = np.diff(breaks)[:, None] / 2
    x, weights = (breaks[:-1, None] + half * (points + 1)).ravel(), (half * weights).ravel()
    inertia = sum(
        weights @ (structure.rows(layer, x) @ q) * section.mass_per_length * -(w**2)
        for layer, section in sections.items()
    )
    assert abs(reaction[0] + inertia - 1) < 1e-8


def test_strain_of_the_girder_and_of_the_rail():
    # midspan bending of a bare-like girder: strain = M fibre / EI with M from its bed forces
    structure = assemble(
        scenario(
            channel=[
                {
                    "name": "girder",
                    "quantity": "strain",
                    "layer": "bridge",
                    "span": 1,
                    "x": 8.0,
                    "fibre": 1.5,
                }
            ]
        )
    )
    q = static(structure, 14.0)
    strain = read(structure, q)[0]
    points, weights = np.polynomial.legendre.leggauss(80)
    x = 6 + 8 * (points + 1)
    bed = structure.scenario.track.bed_on_bridge
    pressure = (
        bed.stiffness
        * bed.width
        * ((structure.rows("support_layer", x) - structure.rows("bridge", x)) @ q)
    )
    # moment at mid-span of a simply supported beam under p(x): integral of p min(s, l - s) / 2
    moment = 8 * weights @ (pressure * np.minimum(x - 6, 22 - x) / 2)
    section = beam_sections(structure.scenario.track)["bridge"]
    assert strain == pytest.approx(moment * 1.5 / section.bending_stiffness, rel=2e-3)
    assert strain > 0


def test_bare_span_frequency_and_rayleigh_damping():
    # track made negligible: the girder alone has f1 = (pi/l)^2 sqrt(EI/m) / 2 pi = 5.3 Hz and the
    # given ratio at f1 and at f2 = 4 f1
    light = {"density": 1e-3, "young_modulus": 1.0}
    structure = assemble(
        scenario(
            line={"approach_left": 0.0, "spans": [32.0], "approach_right": 0.0},
            track={
                "rail": {
                    "theory": "euler_bernoulli",
                    "mass_per_length": 1e-3,
                    "young_modulus": 1e3,
                },
                "slab": light,
                "support_layer": light,
                "mortar": {"damping": 0.0},
                "bed_on_bridge": {"damping": 0.0},
                "fastening": {"damping": 0.0},
            },
            solution={"frequency_limit": 100.0, "sines": [4, 4, 4, 6]},
        )
    )
    omega, shapes = real_modes(structure)
    for number in (1, 2):
        exact = (number * np.pi / 32) ** 2 * np.sqrt(3.795e11 / 3.2e4)
        ratio = shapes[:, number - 1] @ structure.damping @ shapes[:, number - 1]
        assert omega[number - 1] == pytest.approx(exact, rel=1e-5)
        assert ratio / (2 * omega[number - 1]) == pytest.approx(0.02, rel=1e-4)
    assert omega[0] / (2 * np.pi) == pytest.approx(5.3, abs=0.05)


@pytest.mark.parametrize("spans", [[], [16.0], [12.0, 16.0, 12.0]])
@pytest.mark.parametrize("ends", ["pinned", "free"])
def test_any_number_of_spans(spans, ends):
    structure = assemble(scenario(line={"spans": spans, "ends": ends}))
    assert ("bridge" in structure.fields) == bool(spans)
    assert sum(structure.dofs.values()) == structure.size
    for layer in structure.fields:
        assert structure.rows(layer, np.linspace(0, structure.length, 50)).shape[1] == (
            structure.size
        )
    end = structure.rows("slab", np.array([0.0, structure.length]))
    assert (abs(end).sum() < 1e-12) == (ends == "pinned")
    assert real_modes(structure, 100.0)[0][0] > 0


def test_bridge_field_is_empty_off_the_spans():
    structure = assemble(scenario())
    off, on = structure.rows("bridge", np.array([3.0, 25.0])), structure.rows("bridge", 10.0)
    assert off.nnz == 0
    assert on.nnz > 0


def test_first_row_and_spacing():
    assert assemble(scenario()).fastenings[0] == pytest.approx(0.325)
    moved = assemble(scenario(track={"fastening": {"first_offset": 0.1, "spacing": 0.6}}))
    np.testing.assert_allclose(moved.fastenings[:2], [0.1, 0.7])
    assert moved.fastenings[-1] <= 28.0
    at_end = assemble(scenario(track={"fastening": {"first_offset": 0.0}}))
    assert at_end.fastenings[0] == 0.0


def test_pad_length_tends_to_the_point_spring():
    # an Euler-Bernoulli rail tilts on a pad of length p: second order in p; a Timoshenko rail
    # also loses part of its shear kink, first order in p, of p / (12 kGA) against 1 / k: 1e-3
    def deflection(pad, theory):
        structure = assemble(
            scenario(track={"fastening": {"pad_length": pad}, "rail": {"theory": theory}})
        )
        return structure.rail_rows(14.0).toarray()[0] @ static(structure, 14.0)

    lengths = (0.0, 0.01, 0.02, 0.04)
    bending = np.array([deflection(pad, "euler_bernoulli") for pad in lengths])
    change = bending[1:] / bending[0] - 1
    np.testing.assert_allclose(change[1:] / change[:-1], 4.0, rtol=0.1)
    assert 0 < change[-1] < 1e-3
    shear = np.array([deflection(pad, "timoshenko") for pad in lengths[:2]])
    assert -6e-4 < shear[1] / shear[0] - 1 < 0


def test_missing_pad_and_degraded_mortar():
    row = 14.0 - 0.65 / 2 + 0.325  # a fastening row lies at 13.975 m
    weak = {"parameter": "fastening.stiffness", "start": 13.9, "end": 14.05, "factor": 0.0}
    soft = {"parameter": "mortar.stiffness", "start": 12.0, "end": 15.5, "factor": 0.01}
    channel = channels_of("fastening_force", "rail", [row])
    sound = assemble(scenario(channel=channel))
    hanging = assemble(scenario(channel=channel, track={"variation": [weak]}))
    assert read(hanging, static(hanging, 13.975))[0] == 0.0
    assert read(sound, static(sound, 13.975))[0] > 0.2 * WEIGHT
    degraded = assemble(scenario(channel=channel, track={"variation": [soft]}))
    slab = np.array([13.975])
    assert (degraded.rows("slab", slab) @ static(degraded, 13.975))[0] > 1.2 * (
        sound.rows("slab", slab) @ static(sound, 13.975)
    )[0]
    # overlapping variations multiply
    twice = {"parameter": "mortar.stiffness", "start": 12.0, "end": 15.5, "factor": 0.1}
    product = assemble(scenario(track={"variation": [twice, twice]}))
    difference = product.stiffness - assemble(scenario(track={"variation": [soft]})).stiffness
    assert abs(difference).max() < 1e-9 * abs(product.stiffness).max()


def test_paper_preset_has_its_degrees_of_freedom_and_says_its_band():
    structure = assemble(load_scenario("paper"))
    assert dict(structure.dofs) == {"rail": 35, "slab": 35, "support_layer": 35, "bridge": 10}
    # 31 half waves on 32 m: (31 pi / 32)^2 sqrt(EI/m) / 2 pi = 492 Hz for a CHN60 rail
    assert structure.valid_band["rail"] == pytest.approx(492.0, abs=0.5)
    for channel in structure.scenario.channel:
        assert structure.channel_band(channel) <= 492.1


def test_default_resolution_follows_the_frequency_limit():
    sizes = []
    for limit in (500.0, 2000.0, 5000.0):
        structure = assemble(scenario(solution={"frequency_limit": limit}))
        sizes.append(structure.size)
        assert structure.valid_band["rail"] == limit
        assert structure.valid_band["slab"] == limit
        assert structure.valid_band["support_layer"] == min(limit, 2000.0)
        assert structure.valid_band["bridge"] == min(limit, 700.0)
    assert sizes[0] < sizes[1] < sizes[2]


def test_coarser_support_layer_and_bridge_leave_rail_and_slab_alone(monkeypatch):
    # what LAYER_LIMIT costs: responses to a force on the rail, against all layers to 5 kHz
    from solver import line

    case = scenario(solution={"frequency_limit": 5000.0})
    responses = []
    for limits in (line.LAYER_LIMIT, {}):
        monkeypatch.setattr(line, "LAYER_LIMIT", limits)
        structure = assemble(case)
        rows = sp.vstack(
            [
                structure.rail_rows(np.array([14.0, 17.0])),
                structure.rows("slab", np.array([14.1, 17.0])),
            ]
        ).toarray()
        found = []
        for f in (30.0, 300.0, 1000.0, 2300.0, 4700.0):
            w = 2 * np.pi * f
            matrix = structure.stiffness - w**2 * structure.mass + 1j * w * structure.damping
            factor = scipy.sparse.linalg.splu(sp.csc_array(matrix))
            found.append(rows @ factor.solve(rows[0].astype(complex)))
        responses.append(np.array(found))
    coarse, fine = responses
    error = abs(coarse - fine) / abs(fine)
    assert error[:, :2].max() < 2e-4
    assert error[:, 2:].max() < 2e-3


def test_unsupported_line_is_refused():
    loose = [
        {"parameter": "bed.stiffness", "start": -1.0, "end": 99.0, "factor": 0.0},
    ]
    case = scenario(line={"spans": [], "ends": "free"}, track={"variation": loose})
    with pytest.raises(SolverError, match="not held"):
        real_modes(assemble(case))


def test_probe_refuses_what_the_line_does_not_have():
    case = scenario(
        line={"spans": []}, channel=channels_of("bearing_force", "support_layer", [3.0])
    )
    structure = assemble(case)
    with pytest.raises(SolverError, match="spans = 0"):
        structure.probe(case.channel[0])
