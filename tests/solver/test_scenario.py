from __future__ import annotations

import itertools
import json
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from solver import (
    InputError,
    Scenario,
    load_scenario,
    load_scenario_text,
    preset_names,
    preset_text,
    scenario_schema,
    train_preset,
)

LINE = "[line]\napproach_left = 20.0\nspans = [32.0]\napproach_right = 20.0\n"
CHANNEL = '[[channel]]\nname = "a"\nlayer = "rail"\nx = 5.0\n'


@pytest.mark.parametrize("name", preset_names()["scenario"])
def test_every_scenario_preset_survives_the_round_trip_through_text(name: str) -> None:
    scenario = load_scenario(name)
    assert load_scenario_text(scenario.to_toml()) == scenario


@settings(max_examples=25, deadline=None)
@given(st.text(max_size=60), st.lists(st.floats(2, 100), max_size=4))
def test_any_description_and_spans_survive_the_round_trip(text: str, spans: list[float]) -> None:
    demo = load_scenario("demo")
    line = demo.line.model_copy(update={"spans": tuple(spans)})
    scenario = demo.model_copy(update={"description": text, "line": line, "channel": ()})
    scenario = scenario.model_copy(update={"sensor": ()})
    assert load_scenario_text(scenario.to_toml()) == scenario


def test_crh3_pattern_and_load_follow_from_its_published_numbers() -> None:
    # 24.775 m cars, 17.375 m bogie centres, 2.5 m wheelbase; (40 + 2 3.2 + 4 2.4) t g / 4 wheelsets
    train = train_preset("CRH3")
    axles = train.axle_positions
    assert len(axles) == 32
    assert axles[:5] == pytest.approx((0.0, 2.5, 17.375, 19.875, 24.775), abs=1e-12)
    assert train.mass * 9.81 / 32 == pytest.approx(137_340.0, rel=1e-12)
    assert train.length == pytest.approx(8 * 24.775)


def test_articulated_set_shares_bogies_and_has_the_published_length() -> None:
    # 200.19 m over couplers, 13 bogies, trailer bogies 18.7 m apart, wheelbase 3.0 m
    train = train_preset("articulated")
    axles = train.axle_positions
    assert len(axles) == 26
    assert train.length == pytest.approx(200.19, abs=1e-9)
    centres = [(a + b) / 2 for a, b in zip(axles[::2], axles[1::2], strict=True)]
    spacings = [b - a for a, b in itertools.pairwise(centres)]
    assert spacings[2:-2] == pytest.approx([18.7] * 8)
    assert spacings[0] == spacings[-1] == pytest.approx(14.0)
    assert all(b - a == pytest.approx(3.0) for a, b in zip(axles[::2], axles[1::2], strict=True))


def test_train_presets_have_distinct_axle_patterns() -> None:
    patterns = {train_preset(name).axle_positions for name in preset_names()["train"]}
    assert len(patterns) == len(preset_names()["train"]) >= 5


def test_speed_in_km_per_h_is_metres_per_second() -> None:
    text = LINE + '[[train]]\npreset = "CRH3"\nspeed = "360 km/h"\nstart = 0.0\n'
    assert load_scenario_text(text).train[0].speed == pytest.approx(100.0, rel=1e-15)


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        (LINE + "[track.rail]\nyung_modulus = 1.0\n", ["track.rail.yung_modulus", "unknown", "young_modulus"]),
        (LINE.replace("20.0", "-3.0"), ["line.approach_left", "-3.0 m", "greater than or equal to 0"]),
        (LINE.replace("[32.0]", "[]").replace("20.0", "0.0"), ["line", "0 m long", ">= 5 m"]),
        (LINE + "[solution]\nstep = 1.5e-9\n", ["solution.step", "1.5e-09 s", "nanoseconds"]),
        (LINE + '[solution]\nstep = "fast"\n', ["solution.step", "'fast'", "number"]),
        (LINE + '[[train]]\npreset = "TGX"\nspeed = 1\nstart = 0\n', ["train[0].preset", "TGX", "CRH3"]),
        (LINE + '[[train]]\npreset = "CRH3"\nspeed = "80 mph"\nstart = 0\n', ["train[0].speed", "80 mph", "km/h"]),
        (LINE + '[[train]]\npreset = "CRH3"\nspeed = 80\n', ["train[0].start", "missing", "m"]),
        (LINE + '[[channel]]\nname = "a"\nlayer = "rail"\nx = 90.0\n', ['"a"', "90 m", "72 m"]),
        (LINE + '[[channel]]\nname = "a"\nlayer = "bridge"\nx = 5.0\n', ['"a"', "not on a span"]),
        (LINE + '[[channel]]\nname = "a"\nlayer = "rail"\nspan = 2\nx = 5.0\n', ["span = 2", "1 span"]),
        (LINE + CHANNEL * 2, ['"a"', "twice"]),
        (LINE + "[irregularity.components]\nwavenumber=[1.0]\namplitude=[]\nphase=[0.0]\n", ["same length", "1, 0 and 1"]),
        (LINE + '[irregularity]\nspectrum = "sato"\nprofile = "x.txt"\n', ["spectrum and profile"]),
        (LINE + 'track_preset = "crts2"\n', ["line.track_preset", "unknown"]),
        ("line = 3\n", ["line", "3"]),
        ("[line\n", ["not valid TOML"]),
        ('track_preset = "wood"\n' + LINE, ["track_preset", "wood", "crts2", "paper"]),
        (LINE + "[track.slab]\nthickness = nan\n", ["track.slab.thickness", "nan m", "finite"]),
        (LINE + "[contact]\nlaw = 'rigid'\n", ["contact.law", "rigid", "hertz"]),
        (
            LINE + '[[train]]\nvehicles = [{ preset = "CRH3", count = 64 }, { preset = "CRH3" }]\nspeed = 80.0\nstart = 0.0\n',
            ["train[0].vehicles of 65 entries", "at most 64"],
        ),
        (LINE + "[solution]\nsines = [-1, 1, 1, 1]\n", ["solution.sines[0]", "-1", "greater than or equal"]),
        (
            LINE + "[solution]\nsines = [31, 31, 31, 8]\n",
            ["solution.sines = [31, 31, 31, 8]", "kink at every fastening", "euler_bernoulli"],
        ),
        (
            LINE + CHANNEL + '[[sensor]]\nchannel = "a"\npreset = "rail_500g"\nrate = 3000\nbandwidth = 1000.0\n',
            ["3000 Hz", "40000 Hz", "whole multiple"],
        ),
    ],
)  # fmt: skip
def test_wrong_entries_are_refused_by_name_value_unit_and_rule(text: str, parts: list[str]) -> None:
    with pytest.raises(InputError) as refusal:
        load_scenario_text(text, "my.toml")
    for part in parts:
        assert part in str(refusal.value)


def test_missing_file_and_unknown_preset_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        load_scenario(tmp_path / "none.toml")
    with pytest.raises(InputError, match=r"neither a \.toml file nor a preset; presets: demo"):
        load_scenario("demmo")


def test_profile_is_found_beside_the_scenario_file(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(LINE + '[irregularity]\nprofile = "r.txt"\n')
    scenario = load_scenario(tmp_path / "s.toml")
    assert scenario.irregularity.profile == str(tmp_path / "r.txt")


def test_schema_gives_a_unit_for_every_number() -> None:
    schema = scenario_schema()
    without: list[str] = []
    for model, definition in {**schema["$defs"], "Scenario": schema}.items():
        for name, field in definition["properties"].items():
            text = json.dumps(field)
            number = '"number"' in text or '"integer"' in text
            if number and "unit" not in field and name != "sines":
                without.append(f"{model}.{name}")
    assert without == []


def test_a_preset_of_every_kind_can_be_shown() -> None:
    for names in preset_names().values():
        for name in names:
            assert len(preset_text(name)) > 40
    with pytest.raises(InputError, match="no such preset"):
        preset_text("nothing")


def test_scenario_cannot_be_changed_in_place() -> None:
    scenario: Scenario = load_scenario("demo")
    with pytest.raises(ValueError, match="frozen"):
        scenario.name = "other"  # type: ignore[misc]
