"""What a labelled set of recordings consists of: the specification and its cases."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from solver import (
    InputError,
    Scenario,
    Train,
    TrainMotion,
    build_scenario,
    load_scenario,
    load_scenario_text,
    preset_names,
    train_preset,
)

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

LEAD_IN = 2.5
"""Time before the first wheelset reaches the line (s): the detector learns its noise floor."""

FAULTS = ("none", "clipping", "dropouts")
"""clipping: range at a fifth of the peak; dropouts: a tenth of the samples missing."""

FLAT_LENGTH = 0.05
"""Length of a wheel flat (m)."""

DROPOUT_RATE, DROPOUT_DURATION = 5.0, 0.02
"""Drop-outs per second and their mean length (s): a tenth of the samples."""

Range = tuple[float, float]


@dataclass(frozen=True)
class Case:
    """One recording: what is combined, and the seed drawn for it.

    Attributes:
        sensors: channels whose sensors are kept; empty keeps all.
        others: as in :class:`Group`.
    """

    number: int
    group: str
    scenario: str
    train: str
    speed_kmh: float
    acceleration: float
    direction: str
    gap: float
    flats: int
    snr_db: float | None
    sensors: tuple[str, ...]
    fault: str
    seed: int

    @property
    def name(self) -> str:
        """Directory of the bag."""
        return f"{self.number:05d}_{self.train}_{self.speed_kmh:.0f}kmh"


@dataclass(frozen=True)
class Group:
    """Lists to combine; see ``trackvib dataset --example``.

    In ``speeds``, ``accelerations`` and ``gaps`` a pair is a range, of which every case draws.

    Attributes:
        name: of the group.
        scenarios: presets, files or ``[scenario.NAME]`` tables; line, channels, sensors, contact
            and irregularity.
        trains: presets or ``[train.NAME]`` tables.
        speeds: of the train until t = 0 (km/h).
        accelerations: from t = 0 on (m/s²).
        directions: ``forward``, ``backward``.
        gaps: time between the last wheelset of a train and the first of a second one of the kind
            at the middle of the line (s); 0 is a single train.
        flats: number of wheelsets with a flat of 50 mm, drawn at random.
        snr_db: rms of a sensor's clean samples between first and last wheelset over the rms of the
            white noise in them (0 Hz to half the rate), for each sensor; ``None`` leaves the
            sensors as they are.
        sensors: sets of channels whose sensors are kept; an empty one keeps all.
        faults: of :data:`FAULTS`.
        repeats: realisations per combination.
        cases: how many to draw at random of all combinations; 0 takes all.
    """

    name: str = "all"
    scenarios: tuple[str, ...] = ("demo",)
    trains: tuple[str, ...] = ("CRH3",)
    speeds: tuple[float | Range, ...] = (300.0,)
    accelerations: tuple[float | Range, ...] = (0.0,)
    directions: tuple[str, ...] = ("forward",)
    gaps: tuple[float | Range, ...] = (0.0,)
    flats: tuple[int, ...] = (0,)
    snr_db: tuple[float | None, ...] = (None,)
    sensors: tuple[tuple[str, ...], ...] = ((),)
    faults: tuple[str, ...] = ("none",)
    repeats: int = 1
    cases: int = 0


_RANGES: dict[str, tuple[float, float, str]] = {
    "speeds": (10, 500, "km/h"),
    "accelerations": (-1.5, 1.5, "m/s^2"),
    "gaps": (0, 60, "s"),
    "snr_db": (-20, 80, "dB"),
    "flats": (0, 100, "wheelsets"),
}
_DRAWN = ("speeds", "accelerations", "gaps")
_WHOLE = ("repeats", "cases")


@dataclass(frozen=True)
class Spec:
    """Groups of cases, with the scenarios and trains that they name.

    Attributes:
        groups: what to combine.
        seed: of every draw and realisation.
        scenarios: complete scenarios as TOML by name.
        trains: complete trains (the ``[[train]]`` table of a scenario) by name.
    """

    groups: tuple[Group, ...] = (Group(),)
    seed: int = 1
    scenarios: Mapping[str, str] = field(default_factory=dict)
    trains: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @classmethod
    def load(cls, source: str | Path) -> Spec:
        """Read a specification file, or a shipped one by its bare name.

        Scenario files in it are meant from its folder.

        Raises:
            InputError: names the file, the field, its value and the rule.
        """
        path = Path(source)
        try:
            shipped = path.suffix != ".toml"
            text = _shipped(str(source)) if shipped else path.read_text("utf-8")
            table = tomllib.loads(text)
        except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as failure:
            raise InputError(f"dataset {source}: cannot be read: {failure}") from None
        return cls.from_table(table, str(source), path.parent)

    @classmethod
    def from_table(cls, table: Mapping[str, Any], name: str, folder: Path = Path()) -> Spec:
        """Check a specification; ``name`` is used in messages, ``folder`` for scenario files."""
        table = dict(table)
        where = f"dataset {name}"
        seed = _whole(table.pop("seed", 1), f"{where}: seed")
        scenarios = {
            key: build_scenario({"name": key, **entry}, f"{where}, scenario {key}").to_toml()
            for key, entry in _tables(table, "scenario", where).items()
        }
        trains = {
            key: _train_table(key, entry, f"{where}, train {key}")
            for key, entry in _tables(table, "train", where).items()
        }
        entries = table.pop("group", None)
        common = _fields(table, where, "group, scenario, seed, train")
        groups = [Group(**common)]
        if entries is not None:
            if not isinstance(entries, list) or not entries:
                raise InputError(f"{where}: group must be one or more [[group]] tables")
            groups = []
            for index, entry in enumerate(entries, 1):
                own = _fields(entry, f"{where}, group {entry.get('name', index)!r}", "")
                groups.append(Group(**{**common, "name": f"group {index}", **own}))
        names = [group.name for group in groups]
        if len(set(names)) < len(names):
            raise InputError(f"{where}: names of groups must differ, not {', '.join(names)}")
        for group in groups:
            here = f"{where}, group {group.name!r}" if entries is not None else where
            for scenario in group.scenarios:
                if scenario not in scenarios:
                    scenarios[scenario] = _scenario_text(scenario, folder)
            known = [*trains, *preset_names()["train"]]
            for train in group.trains:
                if train not in known:
                    raise InputError(
                        f"{here}: trains has {train!r}; choose from {', '.join(known)}, or "
                        f"describe it in [train.{train}]"
                    )
            _check_sensors(group, scenarios, here)
        return cls(tuple(groups), seed, scenarios, trains)

    def seeded(self, seed: int) -> Spec:
        """The same combinations with other draws and realisations."""
        return replace(self, seed=_whole(seed, "seed"))

    def expand(self) -> list[Case]:
        """All cases, numbered, group by group."""
        cases: list[Case] = []
        for index, group in enumerate(self.groups):
            cases += self._expand(group, index, len(cases) + 1)
        return cases

    def _expand(self, group: Group, index: int, first: int) -> list[Case]:
        product: list[tuple[Any, ...]] = list(
            itertools.product(
                group.scenarios,
                group.trains,
                group.speeds,
                group.accelerations,
                group.directions,
                group.gaps,
                group.flats,
                group.snr_db,
                group.sensors,
                group.faults,
                range(group.repeats),
            )
        )
        random = np.random.default_rng([self.seed, index, 0x646174])
        if 0 < group.cases < len(product):
            chosen = np.sort(random.choice(len(product), group.cases, replace=False))
            product = [product[i] for i in chosen]
        seeds = np.random.default_rng([self.seed, index, 0x736565]).integers(1, 2**31, len(product))

        def drawn(item: float | Range, digits: int) -> float:
            if isinstance(item, tuple):
                return round(float(random.uniform(*item)), digits)
            return float(item)

        cases = []
        for number, (row, seed) in enumerate(zip(product, seeds, strict=True), first):
            scenario, train, speed, rate, direction, gap, flats, snr, sensors, fault, _ = row
            cases.append(
                Case(
                    number=number,
                    group=group.name,
                    scenario=scenario,
                    train=train,
                    speed_kmh=drawn(speed, 2),
                    acceleration=drawn(rate, 3),
                    direction=direction,
                    gap=drawn(gap, 3),
                    flats=flats,
                    snr_db=None if snr is None else float(snr),
                    sensors=tuple(sensors),
                    fault=fault,
                    seed=int(seed),
                )
            )
        return cases

    def scenario_of(self, case: Case) -> Scenario:
        """The scenario of a case, before noise and range follow from its clean signal.

        Raises:
            InputError: the combination is impossible.
        """
        text = self.scenarios.get(case.scenario) or _scenario_text(case.scenario, Path())
        base = load_scenario_text(text, case.scenario)
        content = base.model_dump(exclude_none=True)
        first = _first_train(self._train(case), case, base.line.length)
        trains = [first]
        if case.gap > 0:
            times = TrainMotion(first).axle_times(base.line.length / 2)
            later = float(times[-1] - times[0]) + case.gap
            trains.append(first.model_copy(update={"start_time": round(later, 9)}))
        content["train"] = [train.model_dump(exclude_none=True) for train in trains]
        content["irregularity"]["seed"] = case.seed
        kept = [s for s in content["sensor"] if not case.sensors or s["channel"] in case.sensors]
        for offset, sensor in enumerate(content["sensor"]):
            sensor["seed"] = case.seed + 1 + offset
            if case.fault == "dropouts":
                sensor["dropout_rate"] = DROPOUT_RATE
                sensor["dropout_duration"] = DROPOUT_DURATION
        content["sensor"] = kept
        return Scenario.model_validate(content)

    def _train(self, case: Case) -> Train:
        speed = case.speed_kmh / 3.6
        if case.train in self.trains:
            return Train.model_validate({**self.trains[case.train], "speed": speed})
        return train_preset(case.train, speed, 0.0)


def _first_train(train: Train, case: Case, length: float) -> Train:
    speed = case.speed_kmh / 3.6
    away = speed * LEAD_IN + 0.5 * case.acceleration * LEAD_IN**2
    content = train.model_dump(exclude_none=True)
    content["direction"] = case.direction
    content["start"] = -away if case.direction == "forward" else length + away
    if case.acceleration:
        duration = LEAD_IN + 2 * (train.axle_positions[-1] + length) / speed + 30.0
        final = max(speed + case.acceleration * duration, 1.0)
        content["speed_profile"] = (
            {"time": 0.0, "speed": speed},
            {"time": (final - speed) / case.acceleration, "speed": final},
        )
    wheelsets = len(train.axle_positions)
    if case.flats > wheelsets:
        raise InputError(
            f"flats = {case.flats} wheelsets: the train {case.train} has {wheelsets} only"
        )
    if case.flats:
        random = np.random.default_rng([case.seed, 0x666C61])
        flat = np.sort(random.choice(wheelsets, case.flats, replace=False)) + 1
        content["flat"] = tuple({"wheelset": int(n), "length": FLAT_LENGTH} for n in flat)
    return Train.model_validate(content)


def _shipped(name: str) -> str:
    folder = resources.files("trackvib_ros").joinpath("config")
    names = sorted(
        path.name.removeprefix("dataset_").removesuffix(".toml")
        for path in folder.iterdir()
        if path.name.startswith("dataset_")
    )
    if name not in names:
        raise InputError(
            f"dataset {name}: neither a .toml file nor a shipped one; shipped: {', '.join(names)}"
        )
    return folder.joinpath(f"dataset_{name}.toml").read_text("utf-8")


def _scenario_text(name: str, folder: Path) -> str:
    scenario = load_scenario(name if not name.endswith(".toml") else folder / name)
    return scenario.to_toml()


def _tables(table: dict[str, Any], key: str, where: str) -> dict[str, Mapping[str, Any]]:
    entries = table.pop(key, {})
    if not isinstance(entries, dict) or not all(isinstance(e, dict) for e in entries.values()):
        raise InputError(f"{where}: {key} must be tables such as [{key}.NAME]")
    return entries


def _train_table(name: str, entry: Mapping[str, Any], where: str) -> dict[str, Any]:
    """A train described in the specification, vehicle presets expanded, named as preset."""
    if name in preset_names()["train"]:
        raise InputError(f"{where}: there is a train preset of this name; choose another one")
    unknown = sorted(set(entry) - {"vehicles"})
    if unknown or "vehicles" not in entry:
        raise InputError(f"{where}: state vehicles, and only them, not {', '.join(unknown) or '-'}")
    train = {"preset": name, "vehicles": entry["vehicles"], "speed": 10.0, "start": 0.0}
    line = {"approach_left": 10.0, "approach_right": 0.0, "spans": []}
    scenario = build_scenario({"line": line, "train": [train]}, where)
    return scenario.train[0].model_dump(exclude_none=True)


def _whole(value: object, where: str) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise InputError(f"{where} = {value!r} must be a whole number >= 0")
    return value


def _fields(table: Mapping[str, Any], where: str, others: str) -> dict[str, Any]:
    """Checked fields of a group."""
    defaults = Group()
    known = {f.name for f in fields(Group)}
    unknown = sorted(set(table) - known)
    if unknown:
        also = f", {others}" if others else ""
        raise InputError(
            f"{where}: unknown field {unknown[0]!r}; known are {', '.join(sorted(known))}{also}"
        )
    values: dict[str, Any] = {}
    for key, value in table.items():
        if key == "name":
            if not isinstance(value, str) or not value:
                raise InputError(f"{where}: name = {value!r} must be a text")
            values[key] = value
        elif key in _WHOLE:
            values[key] = _whole(value, f"{where}: {key}")
        elif not isinstance(value, list) or not value:
            raise InputError(f"{where}: {key} = {value!r} must be a filled list")
        else:
            values[key] = tuple(_item(key, item, where) for item in value)
    if values.get("repeats", defaults.repeats) < 1:
        raise InputError(f"{where}: repeats = {values['repeats']} must be at least 1")
    return values


def _item(key: str, item: Any, where: str) -> Any:
    """One checked entry of a list of a group."""
    if key == "snr_db" and item == "as given":
        return None
    if key in _RANGES:
        low, high, unit = _RANGES[key]
        pair = key in _DRAWN and isinstance(item, list)
        numbers = item if pair else [item]
        whole = key == "flats"
        right = all(
            isinstance(n, int if whole else (int, float)) and not isinstance(n, bool)
            for n in numbers
        )
        if (
            not right
            or not all(low <= n <= high for n in numbers)
            or (pair and (len(item) != 2 or item[0] >= item[1]))
        ):
            form = "a whole number" if whole else "a number"
            form += " or a pair [from, to]" if key in _DRAWN else ""
            raise InputError(
                f"{where}: {key} has {item!r}; it must be {form} from {low:g} to {high:g} {unit}"
            )
        return tuple(float(n) for n in item) if pair else item
    if key == "sensors":
        if not isinstance(item, list) or not all(isinstance(n, str) for n in item):
            raise InputError(f"{where}: sensors has {item!r}; it must be a list of channel names")
        return tuple(item)
    choices = {"directions": ("forward", "backward"), "faults": FAULTS}.get(key)
    if not isinstance(item, str) or (choices and item not in choices):
        rule = f"choose from {', '.join(choices)}" if choices else "it must be a name"
        raise InputError(f"{where}: {key} has {item!r}; {rule}")
    return item


def _check_sensors(group: Group, scenarios: Mapping[str, str], where: str) -> None:
    for name in group.scenarios:
        channels = [s.channel for s in load_scenario_text(scenarios[name], name).sensor]
        if not channels:
            raise InputError(f"{where}: scenario {name!r} has no [[sensor]]: nothing to record")
        for chosen in group.sensors:
            for channel in chosen:
                if channel not in channels:
                    raise InputError(
                        f"{where}: sensors has {channel!r}; scenario {name!r} has sensors on "
                        f"{', '.join(channels)}"
                    )


def as_table(spec: Spec) -> dict[str, Any]:
    """The specification as plain data, for the index of a dataset."""
    return asdict(spec)


EXAMPLE = """\
# Lists are combined; `cases` draws that many of all combinations. A pair [from, to] in speeds,
# accelerations or gaps is a range of which every case draws. The same lists may stand in several
# [[group]] tables with a name; what stands above them then holds for all of them.
scenarios = ["demo"]              # presets, files, or tables [scenario.NAME] in this file
trains = ["CRH3", "metro", "locomotive_hauled", "articulated"]  # presets or [train.NAME]
speeds = [80, 160, [200, 350]]    # km/h
accelerations = [0.0]             # m/s^2
directions = ["forward", "backward"]
gaps = [0]                        # s between two trains; 0: one train
flats = [0]                       # wheelsets with a flat of 50 mm
snr_db = [40, 20, 10, 0]          # or "as given": sensors as in the scenario
sensors = [[]]                    # channels whose sensors are kept; []: all
faults = ["none"]                 # none, clipping, dropouts
repeats = 1
cases = 50                        # 0: all
seed = 1
"""
