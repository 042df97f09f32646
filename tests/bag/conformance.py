"""Three independent readers of a bag, brought to one form: mcap, rosbags and the npm readers."""

from __future__ import annotations

import base64
import dataclasses
import json
import math
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

SOURCE = Path(__file__).parent / "npm"
NpmReader = Callable[[list[Path]], list[dict[str, Any]]]


@pytest.fixture(scope="session")
def npm(request: pytest.FixtureRequest) -> NpmReader:
    """The npm readers, installed once into pytest's cache."""

    def missing(reason: str) -> None:
        if os.environ.get("CI") == "true":
            pytest.fail(f"the npm MCAP readers are part of the proof: {reason}")
        pytest.skip(reason)

    if shutil.which("node") is None or shutil.which("npm") is None:
        missing("node and npm are not installed")
    cache: Path = request.config.cache.mkdir("npm")  # type: ignore[union-attr]
    wanted = (SOURCE / "package.json").read_text()
    stamp = cache / "installed.json"
    if not stamp.is_file() or stamp.read_text() != wanted:
        shutil.copy(SOURCE / "package.json", cache)
        done = subprocess.run(
            ["npm", "install", "--no-audit", "--no-fund", "--ignore-scripts"],
            cwd=cache,
            capture_output=True,
            text=True,
        )
        if done.returncode:
            missing(f"npm could not install the readers: {done.stderr.strip()[-300:]}")
        stamp.write_text(wanted)
    shutil.copy(SOURCE / "read.mjs", cache)

    def read(paths: list[Path]) -> list[dict[str, Any]]:
        done = subprocess.run(
            ["node", "read.mjs", *(str(path.resolve()) for path in paths)],
            cwd=cache,
            capture_output=True,
            text=True,
            check=True,
        )
        return [json.loads(line) for line in done.stdout.splitlines()]

    return read


def plain(value: Any) -> Any:
    """A decoded message as JSON knows it, NaN as text, bytes in base 64."""
    if dataclasses.is_dataclass(value):
        return {
            field.name: plain(getattr(value, field.name))
            for field in dataclasses.fields(value)
            if not (field.name.startswith("__") or field.name.isupper())  # constants
        }
    if isinstance(value, np.ndarray) and value.dtype == np.uint8:
        return base64.b64encode(value.tobytes()).decode()
    if isinstance(value, np.ndarray):
        return [plain(item) for item in value.tolist()]
    if isinstance(value, list):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else ("Infinity" if value > 0 else "-Infinity")
    return value


def by_mcap(paths: list[Path]) -> list[dict[str, Any]]:
    """Read with ``mcap``; decode with the definitions in the file."""
    rows = []
    for path in paths:
        stores: dict[int, Any] = {}
        with path.open("rb") as file:
            for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
                assert schema is not None
                if schema.id not in stores:
                    stores[schema.id] = get_typestore(Stores.EMPTY)
                    stores[schema.id].register(
                        get_types_from_msg(schema.data.decode(), schema.name)
                    )
                value = stores[schema.id].deserialize_cdr(message.data, schema.name)
                rows.append(
                    {
                        "topic": channel.topic,
                        "type": schema.name,
                        "encoding": [channel.message_encoding, schema.encoding],
                        "hash": channel.metadata["topic_type_hash"],
                        "log": str(message.log_time),
                        "publish": str(message.publish_time),
                        "value": plain(value),
                    }
                )
    return rows


def by_rosbags(bag: Path) -> list[dict[str, Any]]:
    """Read the directory with ``rosbags``; decode with its own definitions of Jazzy."""
    store = get_typestore(Stores.ROS2_JAZZY)
    with Reader(bag) as reader:
        return [
            {
                "topic": connection.topic,
                "type": connection.msgtype,
                "hash": connection.digest,
                "log": str(time),
                "value": plain(store.deserialize_cdr(data, connection.msgtype)),
            }
            for connection, time, data in reader.messages()
        ]


def check_bag(bag: Path, npm: NpmReader) -> list[dict[str, Any]]:
    """Assert that the three agree on every message, and with ``metadata.yaml``; return them."""
    information = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    paths = [bag / name for name in information["relative_file_paths"]]
    first, second, third = (
        sorted(rows, key=_key) for rows in (by_mcap(paths), npm(paths), by_rosbags(bag))
    )
    assert len(first) == len(second) == len(third)
    for mcap_row, npm_row, rosbags_row in zip(first, second, third, strict=True):
        assert npm_row == mcap_row
        assert rosbags_row == {k: v for k, v in mcap_row.items() if k in rosbags_row}
    assert information["version"] == 9 and information["storage_identifier"] == "mcap"
    assert information["message_count"] == len(first)
    times = [int(row["log"]) for row in first]
    start = information["starting_time"]["nanoseconds_since_epoch"]
    assert (start, information["duration"]["nanoseconds"]) == (min(times), max(times) - min(times))
    for entry in information["topics_with_message_count"]:
        topic = entry["topic_metadata"]
        rows = [row for row in first if row["topic"] == topic["name"]]
        assert len(rows) == entry["message_count"]
        assert topic["type_description_hash"].startswith("RIHS01_")
        assert {row["hash"] for row in rows} <= {topic["type_description_hash"]}
        assert {tuple(row["encoding"]) for row in rows} <= {("cdr", "ros2msg")}
        hashed = get_typestore(Stores.ROS2_JAZZY).hash_rihs01(topic["type"])
        assert topic["type_description_hash"] == hashed, "as a third party computes it"
    return first


def _key(row: dict[str, Any]) -> tuple[Any, ...]:
    stamp = row["value"].get("header", {}).get("stamp", {})
    return (row["topic"], int(row["log"]), stamp.get("sec", 0), stamp.get("nanosec", 0))
