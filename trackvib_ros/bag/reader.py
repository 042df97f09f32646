"""Read bags without ROS, in time order and with bounded memory, over damage if need be."""

from __future__ import annotations

import heapq
import os
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from mcap.opcode import Opcode
from mcap.records import ChunkIndex
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from solver import InputError
from trackvib_ros import pointcloud
from trackvib_ros.bag import metadata
from trackvib_ros.bag.contents import Contents, load_contents
from trackvib_ros.bag.metadata import Topic, parse_qos
from trackvib_ros.bag.recovery import BagInUseError, RecoveryReport, needs_recovery, recover
from trackvib_ros.bag.scan import (
    RawMessage,
    Record,
    check_chunk,
    chunk_records,
    parse_message,
    scan,
    walk,
)
from trackvib_ros.bag.writer import ACTIVE_SUFFIX, CUSTOM_RECORD
from trackvib_ros.waveform import Waveform

WAVEFORM_TYPE = "sensor_msgs/msg/PointCloud2"


class BagMessage(NamedTuple):
    """A stored message; times in ns, ``data`` is CDR."""

    topic: str
    type: str
    log_time_ns: int
    publish_time_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """A topic of a bag and how many messages it has."""

    topic: Topic
    count: int


class BagReader:
    """A bag directory, or a single ``.mcap`` file.

    An unfinished recording whose recorder is gone is recovered on opening; one in progress is read
    as far as it is written. Damaged chunks are left out and told of in :attr:`damage`.

    Attributes:
        path: the bag.
        recovery: what was repaired on opening.
        damage: what could not be read, one sentence each; grows while reading.
        in_progress: a recorder is still writing this bag.
    """

    def __init__(self, path: Path) -> None:
        """Open the bag.

        Raises:
            InputError: the path does not exist or is not a bag.
        """
        self.path = Path(path)
        self.recovery: RecoveryReport | None = None
        self.damage: list[str] = []
        self.in_progress = False
        self._metadata: dict[str, Any] | None = None
        self._stores: dict[str, Any] = {}
        if not self.path.exists():
            raise InputError(f"{self.path} does not exist: give a bag directory or an .mcap file")
        files = self._directory_files() if self.path.is_dir() else [self.path]
        self._files = [self._load(file) for file in files]
        if self.path.is_file() and not self._files[0].channels and self.damage:
            raise InputError(f"{self.path} is not an MCAP file: {self.damage[0]}")

    def __enter__(self) -> BagReader:
        """Return the reader; nothing is held open between calls."""
        return self

    def __exit__(self, *_: object) -> None:
        """Do nothing."""

    @cached_property
    def topics(self) -> Mapping[str, TopicInfo]:
        """Topics by name, with type, definition, hash, QoS and message count."""
        topics: dict[str, Topic] = {}
        counts: Counter[str] = Counter()
        for file in self._files:
            counts.update(file.topic_counts())
            for channel in file.channels.values():
                schema = file.schemas.get(channel.schema_id)
                if schema is not None and channel.topic not in topics:
                    topics[channel.topic] = Topic(
                        channel.topic,
                        schema.name,
                        schema.data.decode("utf-8", "replace"),
                        channel.metadata.get("topic_type_hash", ""),
                        parse_qos(channel.metadata.get("offered_qos_profiles", "")),
                    )
        listed = (self._metadata or {}).get("topics_with_message_count", [])
        for entry in listed:
            item = entry["topic_metadata"]
            if item["name"] not in topics:
                topics[item["name"]] = Topic(
                    item["name"],
                    item["type"],
                    "",
                    item.get("type_description_hash", ""),
                    parse_qos(item.get("offered_qos_profiles", [])),
                )
        return {name: TopicInfo(topics[name], counts[name]) for name in sorted(topics)}

    @property
    def metadata(self) -> Mapping[str, Any]:
        """Content of ``metadata.yaml``; for a single file what its rosbag2 record says."""
        if self._metadata is not None:
            return self._metadata
        for file in reversed(self._files):
            text = file.records.get("rosbag2", {}).get("serialized_metadata")
            content = metadata.load(text) if text else None
            if isinstance(content, dict):
                return content
        return {}

    @property
    def custom_data(self) -> Mapping[str, str]:
        """What the recorder stored beside the messages: scenario, seed, package version ..."""
        stored = self.metadata.get("custom_data")
        if stored:
            return {str(key): str(value) for key, value in stored.items()}
        return next(
            (f.records[CUSTOM_RECORD] for f in self._files if CUSTOM_RECORD in f.records), {}
        )

    @property
    def files(self) -> tuple[Path, ...]:
        """The MCAP files in recording order."""
        return tuple(file.path for file in self._files)

    @property
    def message_count(self) -> int:
        """Number of messages."""
        return sum(file.statistics.message_count for file in self._files)

    @property
    def start_ns(self) -> int:
        """Log time of the first message (ns); 0 if there is none."""
        filled = [f.statistics for f in self._files if f.statistics.message_count]
        return min((s.message_start_time for s in filled), default=0)

    @property
    def end_ns(self) -> int:
        """Log time of the last message (ns); 0 if there is none."""
        filled = [f.statistics for f in self._files if f.statistics.message_count]
        return max((s.message_end_time for s in filled), default=0)

    def messages(
        self,
        topics: Collection[str] | None = None,
        *,
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> Iterator[BagMessage]:
        """Yield messages in the order of their log time.

        Args:
            topics: only these; all if None.
            start_ns: only messages logged at this time (ns) or later.
            end_ns: only messages logged before this time (ns).

        Raises:
            InputError: a topic is not in the bag.
        """
        unknown = sorted(set(topics or ()) - set(self.topics))
        if unknown:
            raise InputError(
                f"topic {', '.join(unknown)} is not in {self.path}; "
                f"it has {', '.join(self.topics) or 'none'}"
            )
        low = 0 if start_ns is None else start_ns
        high = 2**64 if end_ns is None else end_ns
        # Chunks overlap in time only where topics were read in turns: one heap holds the overlap.
        chunks = sorted(
            (
                (chunk.message_start_time, number, chunk.chunk_start_offset, chunk)
                for number, file in enumerate(self._files)
                for chunk in file.chunks
                if chunk.message_end_time >= low and chunk.message_start_time < high
            ),
            key=lambda entry: entry[:3],
        )
        heap: list[tuple[int, int, int, int, BagMessage]] = []
        for start, number, position, chunk in chunks:
            while heap and heap[0][0] < start:
                yield heapq.heappop(heap)[-1]
            for offset, message in self._chunk_messages(self._files[number], chunk):
                item = self._bag_message(self._files[number], message)
                if (
                    item is not None
                    and low <= item.log_time_ns < high
                    and (topics is None or item.topic in topics)
                ):
                    heapq.heappush(heap, (item.log_time_ns, number, position, offset, item))
        while heap:
            yield heapq.heappop(heap)[-1]
        for file in self._files:
            if not file.chunked:
                yield from self._loose_messages(file, topics, low, high)

    def decode(self, message: BagMessage) -> Any:
        """Return the message as an object with the fields of its definition in the bag.

        Raises:
            InputError: the bag has no usable definition of the type, or the bytes do not fit it.
        """
        store = self._typestore(message.topic)
        try:
            return store.deserialize_cdr(message.data, message.type)
        except Exception as failure:
            raise InputError(
                f"message of {message.topic} at {message.log_time_ns} ns does not decode as "
                f"{message.type}: {failure}"
            ) from failure

    def waveforms(self, topic: str) -> Iterator[Waveform]:
        """Yield the blocks of a waveform topic (``sensor_msgs/PointCloud2``).

        Raises:
            InputError: the topic is not in the bag, or not of that type or layout.
        """
        if topic in self.topics and self.topics[topic].topic.type != WAVEFORM_TYPE:
            raise InputError(
                f"topic {topic} is {self.topics[topic].topic.type}: a waveform is {WAVEFORM_TYPE}"
            )
        for message in self.messages((topic,)):
            cloud = self.decode(message)
            stamp = cloud.header.stamp
            yield pointcloud.decode(
                stamp.sec * 10**9 + stamp.nanosec,
                cloud.fields,
                cloud.point_step,
                cloud.data,
                cloud.header.frame_id,
            )

    def verify(self) -> list[str]:
        """Check every record of every file; return what is damaged, one sentence each."""
        problems: list[str] = []
        for file in self._files:
            found = scan(file.path)
            problems += [f"{file.path.name}: {gap}" for gap in found.gaps]
            if not file.summary_intact and not found.gaps and not self.in_progress:
                problems.append(f"{file.path.name}: the summary is missing or damaged")
            stated = file.statistics.message_count
            counted = found.index.statistics().message_count + found.loose_messages
            if stated != counted:
                problems.append(
                    f"{file.path.name}: {counted} messages are intact, its summary says {stated}"
                )
        return problems

    def _directory_files(self) -> list[Path]:
        if needs_recovery(self.path):
            try:
                self.recovery = recover(self.path, verify=False)
            except BagInUseError:
                self.in_progress = True
            except OSError as failure:
                self.damage.append(
                    f"{self.path} could not be repaired ({os.strerror(failure.errno or 0)}): "
                    "read as it is"
                )
        try:
            self._metadata = metadata.read(self.path)
        except FileNotFoundError:
            self._metadata = None
        files = [
            self.path / Path(p).name for p in (self._metadata or {}).get("relative_file_paths", [])
        ]
        missing = [file.name for file in files if not file.exists()]
        self.damage += [f"{name} is listed in metadata.yaml but missing" for name in missing]
        files = [file for file in files if file.exists()]
        files += sorted(self.path.glob(f"*.mcap{ACTIVE_SUFFIX}"))
        if not files and self._metadata is None:
            raise InputError(f"{self.path} is not a bag: it has no metadata.yaml and no .mcap file")
        others = [file.name for file in files if ".mcap" not in file.name]
        if others:
            raise InputError(
                f"{self.path} stores {others[0]}: only MCAP storage is read; convert it with "
                "`ros2 bag convert` or `rosbags-convert`"
            )
        return files

    def _load(self, path: Path) -> Contents:
        contents = load_contents(path)
        if not contents.summary_intact and not self.in_progress:
            self.damage.append(f"{path.name}: no intact summary, read chunk by chunk")
        self.damage += [f"{path.name}: {gap}" for gap in contents.gaps]
        return contents

    def _chunk_messages(
        self, file: Contents, chunk: ChunkIndex
    ) -> Iterator[tuple[int, RawMessage]]:
        with file.path.open("rb") as stream:
            stream.seek(chunk.chunk_start_offset + 9)
            body = stream.read(chunk.chunk_length - 9)
        try:
            content = check_chunk(body)
        except ValueError as failure:
            gone = sum(1 for _ in chunk.message_index_offsets)
            self.damage.append(
                f"{file.path.name}: chunk at byte {chunk.chunk_start_offset} "
                f"({(chunk.message_end_time - chunk.message_start_time) / 1e9:.3f} s, "
                f"{gone} topics) is damaged and left out: {failure}"
            )
            return
        for offset, record in chunk_records(content):
            if isinstance(record, RawMessage):
                yield offset, record

    def _bag_message(self, file: Contents, message: RawMessage) -> BagMessage | None:
        channel = file.channels.get(message.channel)
        schema = file.schemas.get(channel.schema_id) if channel is not None else None
        if channel is None or schema is None:
            return None
        return BagMessage(
            channel.topic, schema.name, message.log_time, message.publish_time, message.data
        )

    def _loose_messages(
        self, file: Contents, topics: Collection[str] | None, low: int, high: int
    ) -> Iterator[BagMessage]:
        for found in walk(file.path):
            if isinstance(found, Record) and found.opcode == Opcode.MESSAGE:
                item = self._bag_message(file, parse_message(found.body))
                if (
                    item is not None
                    and low <= item.log_time_ns < high
                    and (topics is None or item.topic in topics)
                ):
                    yield item

    def _typestore(self, topic: str) -> Any:
        if topic not in self._stores:
            info = self.topics[topic].topic
            store = get_typestore(Stores.EMPTY)
            try:
                store.register(get_types_from_msg(info.definition, info.type))
            except Exception as failure:
                raise InputError(
                    f"the definition of {info.type} stored for {topic} cannot be parsed: {failure}"
                ) from failure
            self._stores[topic] = store
        return self._stores[topic]
