"""What a bag tells about itself: contents, scenario, trains, events, losses, integrity."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from solver import InputError
from trackvib_ros.bag.reader import BagReader

_STATUS_TYPE = "diagnostic_msgs/msg/DiagnosticArray"


@dataclass(frozen=True, slots=True)
class Statement:
    """One status of a ``DiagnosticArray``: an event, or the truth of a passage.

    Attributes:
        stamp_ns: time it is about (ns).
        name, message: of the status.
        values: its key/value pairs.
    """

    stamp_ns: int
    name: str
    message: str
    values: dict[str, str]

    @property
    def kind(self) -> str:
        """``arrival``, ``passage``, ... for an event."""
        return self.values.get("kind", self.name)


@dataclass(slots=True)
class BagSummary:
    """Contents of a bag; times in ns.

    Attributes:
        topics: type and number of messages by topic.
        scenario: TOML text, empty if the bag has none.
        seed: seeds that reproduce the recording.
        version: version of trackvib that recorded it.
        trains: truth of the passages, if it was recorded.
        events: what the detector said.
        problems: damage, one sentence each.
    """

    path: str
    files: list[str]
    bytes: int
    start_ns: int
    end_ns: int
    messages: int
    topics: dict[str, tuple[str, int]]
    scenario: str
    seed: str
    version: str
    custom_data: dict[str, str]
    trains: list[Statement] = field(default_factory=list)
    events: list[Statement] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    in_progress: bool = False

    @property
    def event_counts(self) -> Counter[str]:
        """Events by kind."""
        return Counter(event.kind for event in self.events)


def summarize(reader: BagReader, *, verify: bool = True) -> BagSummary:
    """Return the contents of a bag; with ``verify`` every record of it is checked."""
    summary = BagSummary(
        path=str(reader.path),
        files=[path.name for path in reader.files],
        bytes=sum(path.stat().st_size for path in reader.files),
        start_ns=reader.start_ns,
        end_ns=reader.end_ns,
        messages=reader.message_count,
        topics={name: (info.topic.type, info.count) for name, info in reader.topics.items()},
        scenario=reader.custom_data.get("scenario", ""),
        seed=reader.custom_data.get("seed", ""),
        version=reader.custom_data.get("trackvib_version", ""),
        custom_data=dict(reader.custom_data),
        in_progress=reader.in_progress,
    )
    for name, info in reader.topics.items():
        if not info.count or info.topic.type != _STATUS_TYPE:
            continue
        if name.endswith("train/events"):
            summary.events += statements(reader, name)
        elif name.endswith("ground_truth/passages"):
            summary.trains += statements(reader, name)
    summary.problems = list(dict.fromkeys([*reader.damage, *(reader.verify() if verify else ())]))
    return summary


def statements(reader: BagReader, topic: str) -> list[Statement]:
    """Return every status on a topic of ``DiagnosticArray``, in the order of the log times."""
    found: list[Statement] = []
    for message in reader.messages((topic,)):
        try:
            array: Any = reader.decode(message)
        except InputError as failure:
            reader.damage.append(str(failure))
            continue
        stamp = array.header.stamp
        for status in array.status:
            found.append(
                Statement(
                    stamp.sec * 10**9 + stamp.nanosec,
                    status.name,
                    status.message,
                    {pair.key: pair.value for pair in status.values},
                )
            )
    return found
