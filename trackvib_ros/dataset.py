"""Labelled sets of recorded passages: parallel, resumable, each bag reproducible from itself.

A case is one combination of the lists in a specification. Its complete scenario, seeds included, is
stored in its bag; :func:`write_bag` makes the same bag from that text again.
The bytes are the same if the number of BLAS threads is (``OPENBLAS_NUM_THREADS``); otherwise, or on
another processor, numbers differ in their last digits.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from solver import InputError, Scenario, Sensor, Simulation, TrainMotion
from trackvib_ros import __version__, pointcloud, topics
from trackvib_ros.bag import BagWriter, Qos, Topic, message_definition, type_hash
from trackvib_ros.channels import channel_values
from trackvib_ros.dataset_spec import Case, Spec, as_table
from trackvib_ros.sensor import SensorArray, VirtualSensor
from trackvib_ros.truth import PassageTruth
from trackvib_ros.waveform import Waveform

LEAD_OUT = 3.5
"""Time recorded after the last wheelset has left the line (s)."""

_TYPES = {
    "waveform": "sensor_msgs/msg/PointCloud2",
    "text": "std_msgs/msg/String",
    "table": "diagnostic_msgs/msg/DiagnosticArray",
}


def _truths(scenario: Scenario) -> list[PassageTruth]:
    return [
        PassageTruth.of(TrainMotion(train), number, scenario)
        for number, train in enumerate(scenario.train, 1)
    ]


def _ended(scenario: Scenario) -> Scenario:
    """The scenario with an end after the last train."""
    end = max(truth.leave_ns for truth in _truths(scenario)) * 1e-9 + LEAD_OUT
    solution = scenario.solution.model_copy(update={"end_time": round(end, 3)})
    return scenario.model_copy(update={"solution": solution})


def _computed(scenario: Scenario) -> NDArray[np.float64]:
    simulation = Simulation(scenario, outputs=("acceleration",))
    parts = [b.acceleration for b in simulation.blocks(4000) if b.acceleration is not None]
    return np.concatenate(parts)


def _clean(sensor: Sensor, acceleration: NDArray[np.float64], step_ns: int) -> NDArray[np.float64]:
    """Samples (m/s²) that a sensor without noise, limits and drop-outs would give."""
    perfect = {"noise_density": 0.0, "bits": 32, "dropout_rate": 0.0, "bias": 0.0}
    peak = 2 * float(np.max(np.abs(acceleration))) + 1.0
    ideal = sensor.model_copy(update={**perfect, "range": peak, "coupling": "AC"})
    return VirtualSensor(ideal, step_ns).push(acceleration).astype(np.float64)


def _worn(scenario: Scenario, case: Case, acceleration: NDArray[np.float64]) -> Scenario:
    """Noise and range of the sensors as the case demands of the clean signal."""
    if case.snr_db is None and case.fault != "clipping":
        return scenario
    names = [channel.name for channel in scenario.channel]
    truth = _truths(scenario)[0]
    sensors = []
    for sensor in scenario.sensor:
        column = acceleration[:, names.index(sensor.channel)]
        clean = _clean(sensor, column, scenario.solution.step_ns)
        times = truth.axle_times_ns[sensor.channel]
        first, last = (round(times[i] * 1e-9 * sensor.rate) for i in (0, -1))
        update: dict[str, Any] = {}
        if case.snr_db is not None:
            rms = float(np.sqrt(np.mean(clean[first : last + 1] ** 2)))
            noise = rms * 10 ** (-case.snr_db / 20)
            update["noise_density"] = noise / float(np.sqrt(sensor.rate / 2))
            update["range"] = max(sensor.range, 8 * noise)
        if case.fault == "clipping":
            update["range"] = 0.2 * float(np.max(np.abs(clean)))
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
    acceleration: NDArray[np.float64] | None = None,
) -> None:
    """Compute a scenario and write waveforms, channels, scenario and truth as a bag.

    The directory appears complete or not at all.

    Args:
        scenario: with an end time.
        directory: of the bag.
        custom_data: added to the bag's metadata.
        acceleration: what the solver gave for this scenario, (samples, channels) in m/s², positive
            down; computed if not given.

    Raises:
        InputError: the directory exists, or the scenario cannot be run.
        SolverError: the computation left its valid range.
    """
    if directory.exists():
        raise InputError(f"{directory} exists already: not overwriting it; name another directory")
    if acceleration is None:
        acceleration = _computed(scenario)
    # unique across hosts; inside it the bag has its own name, which names its files
    part = directory.with_name(f".{directory.name}.{uuid.uuid4().hex}.part")
    part.mkdir(parents=True)
    try:
        _write(scenario, part / directory.name, custom_data or {}, acceleration)
        (part / directory.name).rename(directory)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _write(
    scenario: Scenario,
    directory: Path,
    custom_data: Mapping[str, str],
    acceleration: NDArray[np.float64],
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
    # no flush by the clock: on a busy machine it would cut chunks elsewhere, and the bag would not
    # be the same again
    writer = BagWriter(
        directory, custom_data=custom, queue_bytes=1 << 40, flush_interval_s=math.inf
    )

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
                **channel_values(scenario, name),
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
        for t in _truths(scenario)
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


def make_case(case: Case, directory: Path, spec: Spec) -> str:
    """Make the bag of a case in ``directory``; ``made`` or ``there`` if it was there already."""
    target = directory / case.name
    if (target / "metadata.yaml").is_file():
        return "there"
    scenario = _ended(spec.scenario_of(case))
    acceleration = _computed(scenario)
    scenario = _worn(scenario, case, acceleration)
    try:
        write_bag(scenario, target, {"case": json.dumps(asdict(case))}, acceleration)
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
    _Messages()  # fails at once, not case by case, where the message definitions are missing
    cases = spec.expand()
    directory = directory.resolve()
    index = directory / "dataset.json"
    content = json.dumps(
        {"spec": as_table(spec), "cases": [asdict(case) for case in cases]}, indent=1
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
        for case, outcome in submit(cases, directory, spec):
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


Submit = Callable[[Sequence[Case], Path, Spec], Iterator[tuple[Case, str]]]


@contextmanager
def _pool(workers: int | None) -> Iterator[Submit]:
    with ProcessPoolExecutor(workers or os.cpu_count()) as pool:

        def submit(
            cases: Sequence[Case], directory: Path, spec: Spec
        ) -> Iterator[tuple[Case, str]]:
            futures = {pool.submit(make_case, case, directory, spec): case for case in cases}
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
            cases: Sequence[Case], directory: Path, spec: Spec
        ) -> Iterator[tuple[Case, str]]:
            # The scheduler gives a lost worker's cases to another. A bag appears whole or not at
            # all, under one name, so a case that ran twice is still there once.
            futures = {
                client.submit(make_case, case, directory, spec, pure=False): case for case in cases
            }
            for future in completed(futures, loop=client.loop):
                if future.status == "finished":
                    yield futures[future], future.result()
                else:
                    failure = None if future.cancelled() else future.exception()
                    yield futures[future], f"failed: {failure or 'the scheduler was lost'}"

        yield submit
