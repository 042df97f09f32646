"""One MCAP file: written chunk by chunk so that every moment leaves a repairable file.

Record layouts come from the ``mcap`` package; the order of records, the index kept in memory and
what happens when the disk refuses are decided here. Specification: https://mcap.dev/spec
"""

from __future__ import annotations

import fcntl
import os
import struct
import zlib
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from itertools import pairwise
from pathlib import Path

import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

from trackvib_ros import __version__

MAGIC: bytes = MCAP0_MAGIC
PROFILE = "ros2"
CHUNK_BYTES = 768 * 1024
"""Uncompressed chunk size of rosbag2."""
ZSTD_LEVEL = 1
DEFINITIONS_EVERY = 32
"""Chunks after which schemas and channels are written again: a damaged chunk costs itself only."""

_MESSAGE = struct.Struct("<BQHIQQ")
_EMPTY_MESSAGE_INDEX = 1 + 8 + 2 + 4
_NEVER = 2**63 - 1


def encoded(record: McapRecord) -> bytes:
    """Return the bytes of one record."""
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())


@dataclass(slots=True)
class FileIndex:
    """What the summary section of one file says.

    The chunk indexes are kept as they will be written: a recording of weeks has millions of them.
    """

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    metadata: list[MetadataIndex] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)
    start: int = _NEVER
    end: int = 0
    _chunks: list[bytes] = field(default_factory=list)

    @property
    def chunk_count(self) -> int:
        """Number of chunks."""
        return len(self._chunks)

    @property
    def chunks(self) -> list[ChunkIndex]:
        """All chunk indexes in file order."""
        return [_chunk_index(record) for record in self._chunks]

    def add_chunk(self, index: ChunkIndex, counts: Mapping[int, int]) -> None:
        """Append a chunk that holds so many messages of each channel."""
        self._chunks.append(encoded(index))
        self.start = min(self.start, index.message_start_time)
        self.end = max(self.end, index.message_end_time)
        for channel, count in counts.items():
            self.counts[channel] = self.counts.get(channel, 0) + count

    def drop_last_chunk(self) -> tuple[ChunkIndex, dict[int, int]]:
        """Forget the last chunk; return it and how many messages of each channel it holds."""
        last = _chunk_index(self._chunks.pop())
        offsets = [
            *last.message_index_offsets.values(),
            last.chunk_start_offset + last.chunk_length + last.message_index_length,
        ]
        lengths = [after - before for before, after in pairwise(offsets)]
        counts = {
            channel: (length - _EMPTY_MESSAGE_INDEX) // 16
            for channel, length in zip(last.message_index_offsets, lengths, strict=True)
        }
        for channel, count in counts.items():
            self.counts[channel] -= count
            if not self.counts[channel]:
                del self.counts[channel]
        chunks = self.chunks
        self.start = min((c.message_start_time for c in chunks), default=_NEVER)
        self.end = max((c.message_end_time for c in chunks), default=0)
        return last, counts

    def statistics(self) -> Statistics:
        """Return the totals over all chunks."""
        return Statistics(
            attachment_count=0,
            channel_count=len(self.channels),
            channel_message_counts=dict(self.counts),
            chunk_count=len(self._chunks),
            message_count=sum(self.counts.values()),
            message_end_time=self.end,
            message_start_time=0 if self.start == _NEVER else self.start,
            metadata_count=len(self.metadata),
            schema_count=len(self.schemas),
        )

    def summary(self, start: int) -> bytes:
        """Return the summary section, footer and closing magic for a summary at ``start``."""
        groups = (
            (Opcode.SCHEMA, [encoded(schema) for schema in self.schemas.values()]),
            (Opcode.CHANNEL, [encoded(channel) for channel in self.channels.values()]),
            (Opcode.STATISTICS, [encoded(self.statistics())]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.METADATA_INDEX, [encoded(index) for index in self.metadata]),
        )
        body = RecordBuilder()
        offsets: list[SummaryOffset] = []
        for opcode, records in groups:
            if records:
                group_start = body.count
                for record in records:
                    body.write(record)
                offsets.append(SummaryOffset(opcode, start + group_start, body.count - group_start))
        offset_start = start + body.count
        for offset in offsets:
            offset.write(body)
        data = bytes(body.end())
        head = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offset_start)
        crc = zlib.crc32(head, zlib.crc32(data))
        return data + encoded(Footer(start, offset_start, crc)) + MAGIC


@dataclass(slots=True)
class _OpenChunk:
    records: bytearray = field(default_factory=bytearray)
    entries: dict[int, list[int]] = field(default_factory=dict)
    start: int = _NEVER
    end: int = 0

    @property
    def counts(self) -> dict[int, int]:
        return {channel: len(entries) // 2 for channel, entries in self.entries.items()}


def _chunk_index(record: bytes) -> ChunkIndex:
    return ChunkIndex.read(ReadDataStream(BytesIO(record[9:])))


def message_index(channel: int, entries: list[int]) -> bytes:
    """Return a MessageIndex record; ``entries`` alternates log time (ns) and offset (bytes)."""
    size = 8 * len(entries)
    head = struct.pack("<BQHI", Opcode.MESSAGE_INDEX, 6 + size, channel, size)
    return head + struct.pack(f"<{len(entries)}Q", *entries)


class McapFile:
    """Writer of one file.

    Every append is atomic: it is in the file as a whole or the file is cut back to where it was and
    ``OSError`` is raised. The file is locked (``flock``) while it is open, which tells a recovery
    that its recorder is alive.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.index = FileIndex()
        self._open = _OpenChunk()
        self._defined: set[int] = set()
        self._compressor = zstandard.ZstdCompressor(level=ZSTD_LEVEL)
        self._end = 0
        self._crc = 0
        self.finished = False
        self._fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._append(MAGIC + encoded(Header(PROFILE, f"trackvib {__version__}")))
        except OSError:
            os.close(self._fd)
            raise

    @property
    def size(self) -> int:
        """Bytes in the file, without the open chunk."""
        return self._end

    @property
    def open_bytes(self) -> int:
        """Uncompressed bytes waiting in the open chunk."""
        return len(self._open.records)

    @property
    def open_counts(self) -> dict[int, int]:
        """Messages of each channel waiting in the open chunk."""
        return self._open.counts

    @property
    def closed(self) -> bool:
        """Whether the descriptor is closed."""
        return self._fd < 0

    def fileno(self) -> int:
        """Return the descriptor, for ``fdatasync``."""
        return self._fd

    def define(self, schema: Schema, channel: Channel) -> None:
        """Make a channel known; its records are written before its first message."""
        self.index.schemas[schema.id] = schema
        self.index.channels[channel.id] = channel

    def add_message(self, channel: int, log_time: int, publish_time: int, data: bytes) -> None:
        """Put a message in the open chunk; :meth:`flush` writes it."""
        chunk = self._open
        if channel not in self._defined:
            self._defined.add(channel)
            definition = self.index.channels[channel]
            chunk.records += encoded(self.index.schemas[definition.schema_id])
            chunk.records += encoded(definition)
        entries = chunk.entries.get(channel)
        if entries is None:
            entries = chunk.entries[channel] = []
        entries.append(log_time)
        entries.append(len(chunk.records))
        chunk.records += _MESSAGE.pack(
            Opcode.MESSAGE, 22 + len(data), channel, 0, log_time, publish_time
        )
        chunk.records += data
        if log_time < chunk.start:
            chunk.start = log_time
        if log_time > chunk.end:
            chunk.end = log_time

    def flush(self) -> None:
        """Write the open chunk with its message indexes, if it holds a message.

        Raises:
            OSError: nothing was written; the chunk stays open until :meth:`discard`.
        """
        chunk = self._open
        if not chunk.entries:
            return
        raw = bytes(chunk.records)
        packed = self._compressor.compress(raw)
        body = encoded(Chunk("zstd", packed, chunk.end, chunk.start, zlib.crc32(raw), len(raw)))
        offsets: dict[int, int] = {}
        indexes = bytearray()
        for channel, entries in chunk.entries.items():
            offsets[channel] = self._end + len(body) + len(indexes)
            indexes += message_index(channel, entries)
        index = ChunkIndex(
            chunk_length=len(body),
            chunk_start_offset=self._end,
            compression="zstd",
            compressed_size=len(packed),
            message_end_time=chunk.end,
            message_index_length=len(indexes),
            message_index_offsets=offsets,
            message_start_time=chunk.start,
            uncompressed_size=len(raw),
        )
        self._append(body + indexes)
        self.index.add_chunk(index, chunk.counts)
        self._open = _OpenChunk()
        if self.index.chunk_count % DEFINITIONS_EVERY == 0:
            self._defined.clear()

    def discard(self) -> dict[int, int]:
        """Give up the open chunk; return how many messages of each channel went with it."""
        lost = self._open.counts
        self._open = _OpenChunk()
        self._defined.clear()
        return lost

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Write a Metadata record."""
        data = encoded(Metadata(name, dict(values)))
        self.index.metadata.append(MetadataIndex(self._end, len(data), name))
        try:
            self._append(data)
        except OSError:
            self.index.metadata.pop()
            raise

    def finish(self, closing: Callable[[], None], *, give_up: bool = False) -> dict[int, int]:
        """Write the metadata that ``closing`` adds, then the summary.

        Args:
            closing: calls :meth:`add_metadata`; called again after messages were given up.
            give_up: on a full disk, give up the last chunks until the summary fits.

        Returns:
            How many messages of each channel were given up.

        Raises:
            OSError: it does not fit; the file is as it was before.
        """
        given_up: dict[int, int] = {}
        while not self.finished:
            end, crc, metadata = self._end, self._crc, list(self.index.metadata)
            try:
                closing()
                data_end = encoded(DataEnd(self._crc))
                self._append(data_end + self.index.summary(self._end + len(data_end)))
                self.finished = True
            except OSError:
                self._end, self._crc, self.index.metadata = end, crc, metadata
                self._cut()
                if not give_up or not self.index.chunk_count:
                    raise
                last, counts = self.index.drop_last_chunk()
                for channel, count in counts.items():
                    given_up[channel] = given_up.get(channel, 0) + count
                self._end = last.chunk_start_offset
                self._cut()
                self._crc = self._crc_of_file()
        return given_up

    def close(self) -> None:
        """Close the descriptor and with it the lock."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def _append(self, data: bytes) -> None:
        view = memoryview(data)
        position = self._end
        try:
            while view:
                written = os.pwrite(self._fd, view, position)
                position += written
                view = view[written:]
        except OSError:
            self._cut()
            raise
        self._crc = zlib.crc32(data, self._crc)
        self._end = position

    def _cut(self) -> None:
        with suppress(OSError):
            os.ftruncate(self._fd, self._end)

    def _crc_of_file(self) -> int:
        crc = 0
        for offset in range(0, self._end, 1 << 20):
            crc = zlib.crc32(os.pread(self._fd, min(1 << 20, self._end - offset), offset), crc)
        return crc
