"""Labelled sets of recorded passages: parallel, resumable, each bag reproducible from itself.

A case is one combination of the lists in a specification. Its complete scenario, seeds included, is
stored in its bag; :func:`write_bag` makes the same bag from that text again.
The bytes are the same if the number of BLAS threads is (``OPENBLAS_NUM_THREADS``); otherwise, or on
another processor, numbers differ in their last digits.
"""

from __future__ import annotations

import itertools
import json
import os
import shutil
import sys
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from solver import (
    InputError,
    Scenario,
    Simulation,
    load_scenario,
    load_scenario_text,
    preset_names,
    preset_text,
    train_preset,
)
from trackvib_ros import __version__, pointcloud, topics
from trackvib_ros.bag import BagWriter, Qos, Topic, message_definition, type_hash
from trackvib_ros.sensor import SensorArray
from trackvib_ros.truth import PassageTruth
from trackvib_ros.waveform import Waveform

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

LEAD_IN = 2.5
"""Time before the first wheelset reaches the line (s): the detector learns its noise floor."""

LEAD_OUT = 3.5
"""Time recorded after the last wheelset has left the line (s)."""

FAULTS = ("none", "clipping", "dropouts", "flat")
"""clipping: range at a fifth of the peak; dropouts: a tenth missing; flat: 50 mm on wheelset 5."""

_TYPES = {
    "waveform": "sensor_msgs/msg/PointCloud2",
    "text": "std_msgs/msg/String",
    "table": "diagnostic_msgs/msg/DiagnosticArray",
}


@dataclass(frozen=True)
class Case:
    """One recording: what is combined, and the seed drawn for it."""

    number: int
    scenario: str
    train: str
    speed_kmh: float
    acceleration: float
    direction: str
    gap: float
    snr_db: float | None
    fault: str
    seed: int

    @property
    def name(self) -> str:
        """Directory of the bag."""
        return f"{self.number:05d}_{self.train}_{self.speed_kmh:g}kmh"


@dataclass(frozen=True)
class Spec:
    """Lists to combine; see ``trackvib dataset --example``.

    Attributes:
        scenarios: presets or files; line, channels, sensors, contact and irregularity.
        trains: train presets.
        speeds: km/h.
        accelerations: m/s².
        directions: ``forward``, ``backward``.
        gaps: time between two trains of the kind (s); 0 is a single train.
        snr_db: rms of the clean rail signal between first and last wheelset over that of the noise
            within the sensor's bandwidth; ``None`` leaves the sensors as they are.
        faults: of :data:`FAULTS`.
        repeats: realisations per combination.
        cases: how many to draw at random of all combinations; 0 takes all.
        seed: of the draw and of every realisation.
    """

    scenarios: tuple[str, ...] = ("demo",)
    trains: tuple[str, ...] = ("CRH3",)
    speeds: tuple[float, ...] = (300.0,)
    accelerations: tuple[float, ...] = (0.0,)
    directions: tuple[str, ...] = ("forward",)
    gaps: tuple[float, ...] = (0.0,)
    snr_db: tuple[float | None, ...] = (None,)
    faults: tuple[str, ...] = ("none",)
    repeats: int = 1
    cases: int = 0
    seed: int = 1

    @classmethod
    def load(cls, path: Path) -> Spec:
        """Read a specification.

        Raises:
            InputError: names the file, the field, its value and the rule.
        """
        try:
            table = tomllib.loads(path.read_text("utf-8"))
        except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as failure:
            raise InputError(f"dataset {path}: cannot be read: {failure}") from None
        return cls.from_table(table, str(path))

    @classmethod
    def from_table(cls, table: Mapping[str, Any], name: str) -> Spec:
        """Check a specification; ``name`` is used in messages."""
        defaults = cls()
        unknown = sorted(set(table) - set(asdict(defaults)))
        if unknown:
            raise InputError(
                f"dataset {name}: unknown field {unknown[0]!r}; known are "
                f"{', '.join(sorted(asdict(defaults)))}"
            )
        values: dict[str, Any] = {}
        for key, value in table.items():
            if isinstance(getattr(defaults, key), tuple):
                if not isinstance(value, list) or not value:
                    raise InputError(f"dataset {name}: {key} = {value!r} must be a filled list")
                values[key] = tuple(None if item == "as given" else item for item in value)
            elif isinstance(value, bool) or not isinstance(value, int) or value < 0:
                raise InputError(f"dataset {name}: {key} = {value!r} must be a whole number >= 0")
            else:
                values[key] = value
        spec = cls(**values)
        choices = {
            "trains": preset_names()["train"],
            "directions": ["forward", "backward"],
            "faults": list(FAULTS),
        }
        for key, known in choices.items():
            for item in getattr(spec, key):
                if item not in known:
                    raise InputError(
                        f"dataset {name}: {key} has {item!r}; choose from {', '.join(known)}"
                    )
        ranges = {
            "speeds": (10, 500, "km/h"),
            "accelerations": (-1.5, 1.5, "m/s^2"),
            "gaps": (0, 60, "s"),
            "snr_db": (-20, 80, "dB"),
        }
        for key, (low, high, unit) in ranges.items():
            for item in getattr(spec, key):
                if item is None:
                    continue
                if not isinstance(item, (int, float)) or not low <= item <= high:
                    raise InputError(
                        f"dataset {name}: {key} has {item!r}; it must lie from {low} to {high} "
                        f"{unit}"
                    )
        if spec.repeats < 1:
            raise InputError(f"dataset {name}: repeats = {spec.repeats} must be at least 1")
        return spec

    def expand(self) -> list[Case]:
        """All cases, or the drawn ones, numbered."""
        product = list(
            itertools.product(
                self.scenarios,
                self.trains,
                self.speeds,
                self.accelerations,
                self.directions,
                self.gaps,
                self.snr_db,
                self.faults,
                range(self.repeats),
            )
        )
        random = np.random.default_rng([self.seed, 0x646174])
        if 0 < self.cases < len(product):
            chosen = np.sort(random.choice(len(product), self.cases, replace=False))
            product = [product[i] for i in chosen]
        seeds = np.random.default_rng([self.seed, 0x736565]).integers(1, 2**31, len(product))
        return [
            Case(
                number,
                scenario,
                train,
                float(speed),
                float(acceleration),
                direction,
                float(gap),
                None if snr is None else float(snr),
                fault,
                int(seed),
            )
            for number, (
                (scenario, train, speed, acceleration, direction, gap, snr, fault, _),
                seed,
            ) in enumerate(zip(product, seeds, strict=True), 1)
        ]


def _base(name: str, root: Path) -> Scenario:
    if name in preset_names()["scenario"]:
        return load_scenario_text(preset_text(name), name)
    return load_scenario(root / name)


def scenario_of(case: Case, root: Path = Path()) -> Scenario:
    """The scenario of a case, before noise and range follow from its clean signal.

    Args:
        case: what is combined.
        root: folder from which the path of a scenario file is meant.

    Raises:
        InputError: the combination is impossible.
    """
    base = _base(case.scenario, root)
    speed = case.speed_kmh / 3.6
    length = base.line.length
    trains = []
    for number in range(2 if case.gap > 0 else 1):
        train = train_preset(case.train, speed, 0.0)
        span = train.axle_positions[-1]
        lead = LEAD_IN + number * (case.gap + (span + length) / speed)
        away = speed * lead + 0.5 * case.acceleration * lead**2
        update: dict[str, Any] = {
            "direction": case.direction,
            "start": -away if case.direction == "forward" else length + away,
        }
        if case.acceleration:
            duration = LEAD_IN + 2 * (case.gap + (span + length) / speed) + 30.0
            final = max(speed + case.acceleration * duration, 1.0)
            duration = (final - speed) / case.acceleration
            update["speed_profile"] = (
                {"time": 0.0, "speed": speed},
                {"time": duration, "speed": final},
            )
        if case.fault == "flat":
            update["flat"] = ({"wheelset": 5, "length": 0.05},)
        trains.append({**train.model_dump(exclude_none=True), **update})
    content = base.model_dump(exclude_none=True)
    content["train"] = trains
    content["irregularity"]["seed"] = case.seed
    for offset, sensor in enumerate(content["sensor"]):
        sensor["seed"] = case.seed + 1 + offset
        if case.fault == "dropouts":
            sensor["dropout_rate"], sensor["dropout_duration"] = 5.0, 0.02
    return Scenario.model_validate(content)


def _truths(simulation: Simulation) -> list[PassageTruth]:
    return [
        PassageTruth.of(motion, index + 1, simulation.scenario)
        for index, motion in simulation.motions.items()
    ]


def _ended(scenario: Scenario) -> Scenario:
    """The scenario with an end after the last train."""
    truths = _truths(Simulation(scenario, outputs=("acceleration",)))
    end = max(truth.leave_ns for truth in truths) * 1e-9 + LEAD_OUT
    solution = scenario.solution.model_copy(update={"end_time": round(end, 3)})
    return scenario.model_copy(update={"solution": solution})


def _computed(scenario: Scenario) -> tuple[NDArray[np.float64], list[PassageTruth], int]:
    simulation = Simulation(scenario, outputs=("acceleration",))
    parts = [b.acceleration for b in simulation.blocks(4000) if b.acceleration is not None]
    return np.concatenate(parts), _truths(simulation), simulation.step_ns


def _worn(
    scenario: Scenario,
    case: Case,
    acceleration: NDArray[np.float64],
    truths: Sequence[PassageTruth],
    step_ns: int,
) -> Scenario:
    """Noise and range of the sensors as the case demands of the clean signal."""
    names = [channel.name for channel in scenario.channel]
    sensors = []
    for sensor in scenario.sensor:
        column = acceleration[:, names.index(sensor.channel)]
        update: dict[str, Any] = {}
        times = truths[0].axle_times_ns[sensor.channel]
        first, last = times[0] // step_ns, times[-1] // step_ns
        if case.snr_db is not None:
            rms = float(np.sqrt(np.mean(column[first:last] ** 2)))
            noise = rms * 10 ** (-case.snr_db / 20)
            update["noise_density"] = noise / float(np.sqrt(sensor.bandwidth))
            update["range"] = max(sensor.range, 8 * noise)
        if case.fault == "clipping":
            update["range"] = 0.2 * float(np.max(np.abs(column)))
        sensors.append(sensor.model_copy(update=update))
    return scenario.model_copy(update={"sensor": tuple(sensors)})


class _Messages:
    """Serialised messages of a bag, without rclpy."""

    def __init__(self) -> None:
        self._store: Any = get_typestore(Stores.EMPTY)
        for name in _TYPES.values():
            self._store.register(get_types_from_msg(message_definition(name), name))

    def _make(self, type_name: str, /, **fields: Any) -> Any:
        return self._store.types[type_name](**fields)

    def _header(self, stamp_ns: int, frame: str) -> Any:
        stamp = self._make(
            "builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9
        )
        return self._make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def waveform(self, block: Waveform) -> bytes:
        fields, step, data = pointcloud.encode(block)
        message = self._make(
            _TYPES["waveform"],
            header=self._header(block.stamp_ns, block.frame_id),
            height=1,
            width=len(data) // step,
            fields=[
                self._make(
                    "sensor_msgs/msg/PointField",
                    name=f.name,
                    offset=f.offset,
                    datatype=f.datatype,
                    count=f.count,
                )
                for f in fields
            ],
            is_bigendian=False,
            point_step=step,
            row_step=len(data),
            data=np.frombuffer(data, np.uint8),
            is_dense=False,
        )
        return bytes(self._store.serialize_cdr(message, _TYPES["waveform"]))

    def text(self, text: str) -> bytes:
        message = self._make(_TYPES["text"], data=text)
        return bytes(self._store.serialize_cdr(message, _TYPES["text"]))

    def table(self, stamp_ns: int, rows: Sequence[tuple[str, str, Mapping[str, str]]]) -> bytes:
        statuses = [
            self._make(
                "diagnostic_msgs/msg/DiagnosticStatus",
                level=0,
                name=name,
                message=text,
                hardware_id="",
                values=[
                    self._make("diagnostic_msgs/msg/KeyValue", key=k, value=v)
                    for k, v in values.items()
                ],
            )
            for name, text, values in rows
        ]
        message = self._make(
            _TYPES["table"], header=self._header(stamp_ns, "line"), status=statuses
        )
        return bytes(self._store.serialize_cdr(message, _TYPES["table"]))


def write_bag(
    scenario: Scenario,
    directory: Path,
    custom_data: Mapping[str, str] | None = None,
    computed: tuple[NDArray[np.float64], list[PassageTruth], int] | None = None,
) -> None:
    """Compute a scenario and write waveforms, channels, scenario and truth as a bag.

    The directory appears complete or not at all.

    Raises:
        InputError: the directory exists, or the scenario cannot be run.
        SolverError: the computation left its valid range.
    """
    if directory.exists():
        raise InputError(f"{directory} exists already: not overwriting it; name another directory")
    acceleration, truths, _ = computed or _computed(scenario)
    # unique across hosts; inside it the bag has its own name, which names its files
    part = directory.with_name(f".{directory.name}.{uuid.uuid4().hex}.part")
    part.mkdir(parents=True)
    try:
        _write(scenario, part / directory.name, custom_data or {}, acceleration, truths)
        (part / directory.name).rename(directory)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _write(
    scenario: Scenario,
    directory: Path,
    custom_data: Mapping[str, str],
    acceleration: NDArray[np.float64],
    truths: Sequence[PassageTruth],
) -> None:
    sensors = SensorArray(scenario, [channel.name for channel in scenario.channel])
    messages = _Messages()
    custom = {
        "scenario": scenario.to_toml(),
        "seed": str(scenario.irregularity.seed),
        "trackvib_version": __version__,
        **custom_data,
    }
    latched = Qos(durability="transient_local")
    writer = BagWriter(directory, custom_data=custom, queue_bytes=1 << 40)

    def topic(name: str, kind: str, qos: Qos) -> str:
        full = f"/{name}"
        type_ = _TYPES[kind]
        writer.add_topic(Topic(full, type_, message_definition(type_), type_hash(type_), (qos,)))
        return full

    text = topic(topics.SCENARIO, "text", latched)
    channels = topic(topics.CHANNELS, "table", latched)
    passages = topic(topics.TRUE_PASSAGES, "table", latched)
    groups = {
        group.channels: topic(topics.waveform(group.name), "waveform", Qos())
        for group in sensors.groups
    }
    by_name = {channel.name: channel for channel in scenario.channel}
    rows = [
        (
            name,
            f"accelerometer on the {by_name[name].layer}",
            {
                "layer": by_name[name].layer,
                "x": f"{scenario.channel_x(by_name[name])!r} m",
                "topic": topics.waveform(group.name),
            },
        )
        for group in sensors.groups
        for name in group.channels
    ]
    writer.write(text, 0, 0, messages.text(custom["scenario"]))
    writer.write(channels, 0, 0, messages.table(0, rows))
    entries = [
        (max(0, t.enter_ns), passages, messages.table(max(0, t.enter_ns), [_truth_row(t)]))
        for t in truths
    ]
    blocks = sensors.push(acceleration)
    entries += [(b.end_ns, groups[b.channels], messages.waveform(b)) for b in blocks]
    for stamp_ns, name, data in sorted(entries, key=lambda entry: entry[0]):
        writer.write(name, stamp_ns, stamp_ns, data)
    writer.close()
    if writer.failure is not None:
        raise OSError(writer.failure)


def _truth_row(truth: PassageTruth) -> tuple[str, str, dict[str, str]]:
    text = f"{truth.train_type}, {truth.axle_count} wheelsets, {truth.direction}"
    return f"truth: train {truth.train}", text, truth.to_dict()


def make_case(case: Case, directory: Path, root: Path = Path()) -> str:
    """Make the bag of a case in ``directory``; ``made`` or ``there`` if it was there already."""
    target = directory / case.name
    if (target / "metadata.yaml").is_file():
        return "there"
    scenario = _ended(scenario_of(case, root))
    computed = _computed(scenario)
    scenario = _worn(scenario, case, *computed)
    try:
        write_bag(scenario, target, {"case": json.dumps(asdict(case))}, computed)
    except (InputError, OSError):
        if (target / "metadata.yaml").is_file():  # another worker was faster
            return "there"
        raise
    return "made"


def make_dataset(
    spec: Spec,
    directory: Path,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Callable[[int, int, str], None] | None = None,
) -> dict[str, str]:
    """Make all bags of a specification; what is there already is kept.

    Args:
        spec: what to combine.
        directory: of the bags; ``dataset.json`` in it names the specification.
        workers: processes; all cores by default.
        scheduler: address of a Dask scheduler whose workers see the same directory.
        progress: called with (done, all, name of the bag).

    Returns:
        ``made``, ``there`` or ``failed: reason`` by name of the bag.

    Raises:
        InputError: the directory holds another dataset, or the extra ``cluster`` is missing.
    """
    root = Path.cwd()
    for name in spec.scenarios:
        _base(name, root)
    _Messages()  # fails at once, not case by case, where the message definitions are missing
    cases = spec.expand()
    directory = directory.resolve()
    index = directory / "dataset.json"
    content = json.dumps(
        {"spec": asdict(spec), "cases": [asdict(case) for case in cases]}, indent=1
    )
    if index.exists() and json.loads(index.read_text("utf-8")) != json.loads(content):
        raise InputError(
            f"{directory} holds another dataset ({index} has a different specification): choose "
            "another directory"
        )
    result: dict[str, str] = {}
    with _cluster(scheduler) if scheduler else _pool(workers) as submit:
        directory.mkdir(parents=True, exist_ok=True)
        index.write_text(content, "utf-8")
        _sweep(directory)
        for case, outcome in submit(cases, directory, root):
            if outcome == "made" and not (directory / case.name).is_dir():
                outcome = f"failed: made on a worker that does not share {directory}"
            result[case.name] = outcome
            if progress:
                progress(len(result), len(cases), f"{case.name}: {outcome}")
        _sweep(directory)
    return result


def _sweep(directory: Path) -> None:
    """Remove what killed workers left unfinished."""
    for left in directory.glob(".*.part"):
        shutil.rmtree(left, ignore_errors=True)


Submit = Callable[[Sequence[Case], Path, Path], Iterator[tuple[Case, str]]]


@contextmanager
def _pool(workers: int | None) -> Iterator[Submit]:
    with ProcessPoolExecutor(workers or os.cpu_count()) as pool:

        def submit(
            cases: Sequence[Case], directory: Path, root: Path
        ) -> Iterator[tuple[Case, str]]:
            futures = {pool.submit(make_case, case, directory, root): case for case in cases}
            for future in as_completed(futures):
                failure = future.exception()
                yield futures[future], future.result() if failure is None else f"failed: {failure}"

        yield submit


@contextmanager
def _cluster(address: str) -> Iterator[Submit]:
    try:
        from distributed import Client  # type: ignore[import-not-found,unused-ignore]
        from distributed import as_completed as completed
    except ImportError:
        raise InputError(
            "--scheduler needs Dask: install it with  pip install 'trackvib[cluster]'"
        ) from None
    if not address.rpartition(":")[2].isdigit():
        raise InputError(
            f"--scheduler {address}: must end with a port, such as tcp://192.168.0.10:8786"
        )
    try:
        client = Client(address, timeout="10s", set_as_default=False)
    except OSError as failure:
        raise InputError(
            f"--scheduler {address}: no Dask scheduler answers there ({failure}); give the address "
            "that `dask scheduler` prints, such as tcp://192.168.0.10:8786"
        ) from None
    with client:
        if not client.scheduler_info(n_workers=-1)["workers"]:
            raise InputError(
                f"--scheduler {address}: it has no worker; start some with  dask worker {address}"
            )

        def submit(
            cases: Sequence[Case], directory: Path, root: Path
        ) -> Iterator[tuple[Case, str]]:
            # The scheduler gives a lost worker's cases to another. A bag appears whole or not at
            # all, under one name, so a case that ran twice is still there once.
            futures = {
                client.submit(make_case, case, directory, root, pure=False): case for case in cases
            }
            for future in completed(futures, loop=client.loop):
                if future.status == "finished":
                    yield futures[future], future.result()
                else:
                    failure = None if future.cancelled() else future.exception()
                    yield futures[future], f"failed: {failure or 'the scheduler was lost'}"

        yield submit


EXAMPLE = """\
# Lists are combined; `cases` draws that many of all combinations.
scenarios = ["demo"]              # presets or scenario files: line, channels, sensors
trains = ["CRH3", "metro", "locomotive_hauled", "articulated"]
speeds = [80, 160, 250, 350]      # km/h
accelerations = [0.0]             # m/s^2
directions = ["forward", "backward"]
gaps = [0]                        # s between two trains; 0: one train
snr_db = [40, 20, 10, 0]          # or "as given": sensors as in the scenario
faults = ["none"]                 # none, clipping, dropouts, flat
repeats = 1
cases = 50                        # 0: all
seed = 1
"""
