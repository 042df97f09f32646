"""``metadata.yaml`` of a rosbag2 directory, version 9, and the QoS text inside MCAP channels."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from solver import InputError

FILE_NAME = "metadata.yaml"
VERSION = 9
INFINITE_NS = 9223372036854775807
_INFINITE = {"sec": 9223372036, "nsec": 854775807}
_KEY = "rosbag2_bagfile_information"
_Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


@dataclass(frozen=True, slots=True)
class Qos:
    """Quality of service that a publisher offers; durations in ns, ``INFINITE_NS`` = unlimited.

    DDS does not announce history and depth, hence rosbag2's ``unknown``; the depth is the one a
    player uses.
    """

    reliability: str = "reliable"
    durability: str = "volatile"
    history: str = "unknown"
    depth: int = 10
    deadline_ns: int = INFINITE_NS
    lifespan_ns: int = INFINITE_NS
    liveliness: str = "automatic"
    lease_ns: int = INFINITE_NS

    def as_dict(self) -> dict[str, Any]:
        """Return the mapping rosbag2 writes."""
        return {
            "history": self.history,
            "depth": self.depth,
            "reliability": self.reliability,
            "durability": self.durability,
            "deadline": _duration(self.deadline_ns),
            "lifespan": _duration(self.lifespan_ns),
            "liveliness": self.liveliness,
            "liveliness_lease_duration": _duration(self.lease_ns),
            "avoid_ros_namespace_conventions": False,
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Qos:
        """Read a profile of any rosbag2 version; older ones number their policies."""

        def policy(key: str, numbers: Sequence[str]) -> str:
            value = values.get(key, "unknown")
            if isinstance(value, int):
                return numbers[value] if 0 <= value < len(numbers) else "unknown"
            return str(value)

        return cls(
            reliability=policy("reliability", ("system_default", "reliable", "best_effort")),
            durability=policy("durability", ("system_default", "transient_local", "volatile")),
            history=policy("history", ("system_default", "keep_last", "keep_all", "unknown")),
            depth=int(values.get("depth", 10)),
            deadline_ns=_nanoseconds(values.get("deadline")),
            lifespan_ns=_nanoseconds(values.get("lifespan")),
            liveliness=policy("liveliness", ("system_default", "automatic", "", "manual_by_topic")),
            lease_ns=_nanoseconds(values.get("liveliness_lease_duration")),
        )


def qos_text(profiles: Iterable[Qos]) -> str:
    """Return the YAML text of channel metadata ``offered_qos_profiles``."""
    return yaml.safe_dump([qos.as_dict() for qos in profiles], sort_keys=False)


def parse_qos(value: object) -> tuple[Qos, ...]:
    """Read profiles from a YAML text (channels, bags before version 9) or a list."""
    items = load(value) if isinstance(value, str) else value
    return tuple(Qos.from_dict(item) for item in items) if isinstance(items, list) else ()


@dataclass(frozen=True, slots=True)
class Topic:
    """A recorded topic.

    Attributes:
        name: absolute name.
        type: ``package/msg/Type``.
        definition: ``ros2msg`` text with all dependencies.
        type_hash: ``RIHS01_...`` (REP-2011), empty if unknown.
        qos: profiles the publishers offer, frozen when the topic was first seen.
    """

    name: str
    type: str
    definition: str
    type_hash: str = ""
    qos: tuple[Qos, ...] = (Qos(),)


@dataclass(slots=True)
class FileContents:
    """Messages in one file; times in ns, both 0 without messages."""

    path: str
    start_ns: int = 0
    end_ns: int = 0
    counts: dict[str, int] = field(default_factory=dict)

    @property
    def message_count(self) -> int:
        """Number of messages in the file."""
        return sum(self.counts.values())


def information(
    files: Sequence[FileContents],
    topics: Iterable[Topic],
    custom_data: Mapping[str, str],
    ros_distro: str,
) -> dict[str, Any]:
    """Return the content of ``metadata.yaml`` below its outer key."""
    filled = [file for file in files if file.message_count]
    start = min((file.start_ns for file in filled), default=0)
    end = max((file.end_ns for file in filled), default=0)
    return {
        "version": VERSION,
        "storage_identifier": "mcap",
        "duration": {"nanoseconds": end - start},
        "starting_time": {"nanoseconds_since_epoch": start},
        "message_count": sum(file.message_count for file in files),
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic.name,
                    "type": topic.type,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": [qos.as_dict() for qos in topic.qos],
                    "type_description_hash": topic.type_hash,
                },
                "message_count": sum(file.counts.get(topic.name, 0) for file in files),
            }
            for topic in topics
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file.path for file in files],
        "files": [
            {
                "path": file.path,
                "starting_time": {"nanoseconds_since_epoch": file.start_ns},
                "duration": {"nanoseconds": file.end_ns - file.start_ns},
                "message_count": file.message_count,
            }
            for file in files
        ],
        "custom_data": dict(custom_data) or None,
        "ros_distro": ros_distro,
    }


def load(text: str) -> Any:
    """Parse YAML, with libyaml where PyYAML has it: ten times faster."""
    return yaml.load(text, Loader=_Loader)


def as_yaml(content: Mapping[str, Any]) -> str:
    """Return YAML text that yaml-cpp, ruamel and PyYAML read alike."""
    return yaml.dump(dict(content), Dumper=_Dumper, sort_keys=False, width=10**6)


def write(directory: Path, content: Mapping[str, Any]) -> None:
    """Replace ``metadata.yaml`` so that a crash leaves the old or the new one, never a part."""
    temporary = directory / f".{FILE_NAME}.new"
    with temporary.open("w", encoding="utf-8") as file:
        file.write(as_yaml({_KEY: dict(content)}))
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(directory / FILE_NAME)
    sync_directory(directory)


def read(directory: Path) -> dict[str, Any]:
    """Return the content of ``metadata.yaml`` below its outer key.

    Raises:
        InputError: it cannot be read as rosbag2 metadata.
        FileNotFoundError: there is none.
    """
    path = directory / FILE_NAME
    try:
        content = load(path.read_text(encoding="utf-8"))
        information = content[_KEY]
        if not isinstance(information["relative_file_paths"], list):
            raise TypeError("relative_file_paths is not a list")
    except (yaml.YAMLError, KeyError, TypeError, UnicodeDecodeError) as failure:
        raise InputError(
            f"{path} is not rosbag2 metadata ({failure}); "
            f"`trackvib recover {directory}` rebuilds it from the recordings"
        ) from failure
    return dict(information)


def sync_directory(directory: Path) -> None:
    """Make creations and renames in a directory survive a power cut."""
    descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class _Dumper(yaml.SafeDumper):
    """No anchors (equal QoS profiles are one object in memory), ``~`` for an empty value."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


_Dumper.add_representer(
    type(None), lambda dumper, _: dumper.represent_scalar("tag:yaml.org,2002:null", "~")
)


def _duration(value_ns: int) -> dict[str, int]:
    if value_ns >= INFINITE_NS:
        return dict(_INFINITE)
    return {"sec": value_ns // 10**9, "nsec": value_ns % 10**9}


def _nanoseconds(value: object) -> int:
    if not isinstance(value, Mapping):
        return INFINITE_NS
    total = int(value.get("sec", 0)) * 10**9 + int(value.get("nsec", 0))
    # Some tools write an unlimited duration as zero seconds, others as 2^31 - 1.
    return INFINITE_NS if total <= 0 or total >= 2147483647 * 10**9 else total
