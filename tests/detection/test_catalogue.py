import numpy as np
import pytest

import solver
from solver import InputError
from trackvib_ros.detection import Catalogue

CATALOGUE = Catalogue.default()


@pytest.mark.parametrize("name", ["CRH3", "CRH3x2", "metro", "locomotive_hauled", "articulated"])
def test_types_equal_the_solver_presets(name):
    train = solver.train_preset(name, 50.0, 0.0)
    # both are sums of the same decimal numbers; 1 um is far above rounding
    np.testing.assert_allclose(CATALOGUE[name].axles, train.axle_positions, atol=1e-6)
    assert CATALOGUE[name].length == pytest.approx(train.length, abs=1e-6)


def test_every_solver_train_is_known():
    known = set(solver.preset_names()["train"]) - {"wheel_element"}
    assert known <= {train.name for train in CATALOGUE}


def test_symmetry_and_orientation():
    assert CATALOGUE["CRH3"].symmetric
    train = CATALOGUE["locomotive_hauled"]
    assert not train.symmetric
    reverse = train.oriented(True)
    assert reverse[0] == 0
    np.testing.assert_allclose(np.diff(reverse), np.diff(train.axles)[::-1])


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("version = 1", r"no \[\[train\]\]"),
        ("not toml", "not valid TOML"),
        ('[[train]]\nname = "x"\ncars = []', "cars must be a list"),
        ('[[train]]\nname = "x"\ncars = [{length = 20}]', "bogie_centres = None"),
        ('[[train]]\nname = "x"\nwheels = 3', "unknown field 'wheels'"),
        (
            '[[train]]\nname = "x"\ncars = [{length = 20, axles = [3, 3.1]}]',
            "at least 0.5 m apart",
        ),
        (
            '[[train]]\nname = "x"\ncars = [{length = 20, bogie_centres = 25, wheelbase = 2}]',
            "bogie_centres = 25",
        ),
        (
            '[[train]]\nname = "x"\nunits = 0\n'
            "cars = [{length = 20, bogie_centres = 15, wheelbase = 2}]",
            "units = 0",
        ),
    ],
)
def test_wrong_entries_are_named(text, named):
    with pytest.raises(InputError, match=named):
        Catalogue.parse(text, "mine.toml")


def test_own_file(tmp_path):
    path = tmp_path / "own.toml"
    path.write_text(
        'version = "7"\n[[train]]\nname = "tram"\n'
        "cars = [{count = 2, length = 10, bogie_centres = 6, wheelbase = 1.8}]\n"
    )
    own = Catalogue.load(path)
    assert own.version == "7"
    assert own["tram"].axle_positions == pytest.approx((0, 1.8, 6, 7.8, 10, 11.8, 16, 17.8))
    with pytest.raises(InputError, match=r"none\.toml"):
        Catalogue.load(tmp_path / "none.toml")


def test_from_arrays():
    own = Catalogue.from_axles({"mine": [100.0, 102.5, 117.4]})
    assert own["mine"].axle_positions == pytest.approx((0, 2.5, 17.4))
    with pytest.raises(InputError, match="not in the catalogue; it has mine"):
        own["yours"]


def test_longest_gap_of_wheelsets():
    own = Catalogue.from_axles({"short": [0.0, 2.5, 9.0, 11.5], "wagons": [0.0, 12.25, 13.0]})
    assert own.longest_gap == 12.25


def test_axles_without_a_name_are_refused():
    with pytest.raises(InputError, match="mapping of names to axle positions"):
        Catalogue.from_axles([0.0, 2.5, 17.4, 19.9])
