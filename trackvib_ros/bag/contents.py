"""What one MCAP file holds: from its summary if that is intact, else from a walk over it."""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path

from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.stream_reader import StreamReader

from trackvib_ros.bag.mcap_file import MAGIC
from trackvib_ros.bag.scan import Gap, scan

_FOOTER = struct.Struct("<BQQQI")


@dataclass(slots=True)
class Contents:
    """Index of one file.

    Attributes:
        path: the file.
        schemas, channels: by id.
        chunks: position and time span of every chunk, in file order.
        statistics: message counts and times.
        records: values of the Metadata records by name; of several the last.
        summary_intact: False if the index comes from a walk over the file.
        gaps: damage found by that walk.
        chunked: False if messages lie outside chunks (other writers only).
    """

    path: Path
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    statistics: Statistics = field(default_factory=lambda: _statistics({}))
    records: dict[str, dict[str, str]] = field(default_factory=dict)
    summary_intact: bool = False
    gaps: list[Gap] = field(default_factory=list)
    chunked: bool = True

    def topic_counts(self) -> Counter[str]:
        """Return messages by topic."""
        counts: Counter[str] = Counter()
        for number, count in self.statistics.channel_message_counts.items():
            if number in self.channels:
                counts[self.channels[number].topic] += count
        return counts


def load_contents(path: Path) -> Contents:
    """Return the index of one file."""
    try:
        return _from_summary(path)
    except (McapError, ValueError, struct.error):
        return _from_walk(path)


def _from_summary(path: Path) -> Contents:
    with path.open("rb") as file:
        size = file.seek(0, 2)
        footer_at = size - len(MAGIC) - _FOOTER.size
        if footer_at < len(MAGIC):
            raise ValueError("too short for a footer")
        file.seek(footer_at)
        tail = file.read()
        opcode, length, start, _, crc = _FOOTER.unpack_from(tail)
        if opcode != Opcode.FOOTER or length != 20 or not tail.endswith(MAGIC):
            raise ValueError("no footer")
        if not len(MAGIC) <= start < footer_at:
            raise ValueError("no summary")
        file.seek(start)
        summary = file.read(footer_at - start)
        if crc and crc != zlib.crc32(tail[:25], zlib.crc32(summary)):
            raise ValueError("the summary fails its CRC")
        contents = Contents(path, summary_intact=True)
        statistics: Statistics | None = None
        indexes: list[MetadataIndex] = []
        for record in StreamReader(BytesIO(summary + tail), skip_magic=True).records:
            if isinstance(record, Schema):
                contents.schemas[record.id] = record
            elif isinstance(record, Channel):
                contents.channels[record.id] = record
            elif isinstance(record, ChunkIndex):
                contents.chunks.append(record)
            elif isinstance(record, MetadataIndex):
                indexes.append(record)
            elif isinstance(record, Statistics):
                statistics = record
        if statistics is None:
            raise ValueError("no statistics")
        contents.statistics = statistics
        contents.chunked = bool(contents.chunks) or statistics.message_count == 0
        for index in indexes:
            file.seek(index.offset)
            records = StreamReader(BytesIO(file.read(index.length)), skip_magic=True).records
            metadata = next(records)
            if isinstance(metadata, Metadata):
                contents.records[metadata.name] = dict(metadata.metadata)
    return contents


def _from_walk(path: Path) -> Contents:
    found = scan(path)
    return Contents(
        path,
        found.index.schemas,
        found.index.channels,
        found.index.chunks,
        found.index.statistics(),
        found.records,
        gaps=found.gaps,
        chunked=not found.loose_messages,
    )


def _statistics(counts: dict[int, int]) -> Statistics:
    return Statistics(0, 0, counts, 0, sum(counts.values()), 0, 0, 0, 0)
