"""Walk an MCAP file record by record, over damage, without trusting its summary."""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, ChunkIndex, Header, Metadata, MetadataIndex, Schema
from mcap.stream_reader import get_chunk_data_stream

from trackvib_ros.bag.mcap_file import MAGIC, FileIndex, encoded, message_index

_ZSTD_CHUNK = struct.pack("<I", 4) + b"zstd"
_BEFORE_COMPRESSION = 9 + 8 + 8 + 8 + 4
_MESSAGE_HEAD = struct.Struct("<HIQQ")
_KNOWN = frozenset(int(opcode) for opcode in Opcode)
_DAMAGED = (McapError, zstandard.ZstdError, ValueError, struct.error, MemoryError, RuntimeError)


class Gap(NamedTuple):
    """Bytes that hold no intact record."""

    offset: int
    length: int
    reason: str

    def __str__(self) -> str:
        """Return the gap in words."""
        return f"{self.length} bytes at byte {self.offset}: {self.reason}"


class RawMessage(NamedTuple):
    """A message as stored; times in ns."""

    channel: int
    log_time: int
    publish_time: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Record:
    """An intact record of the data section; ``content`` is what a chunk holds, its CRC checked."""

    offset: int
    length: int
    opcode: int
    body: bytes
    content: bytes = b""


def walk(path: Path) -> Iterator[Record | Gap]:
    """Yield every intact record of the data section in file order, and the gaps between them.

    Memory is bounded by the largest record.
    """
    size = path.stat().st_size
    if size == 0:
        yield Gap(0, 0, "empty file")
        return
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        offset = min(len(MAGIC), size)
        if data[:offset] != MAGIC:
            yield Gap(0, offset, "the magic bytes of MCAP are damaged")
        while offset < size:
            found = _record_at(data, offset, size)
            if isinstance(found, Record):
                yield found
                offset += found.length
                if found.opcode == Opcode.DATA_END:
                    return
            else:
                following = _next_chunk(data, offset + 1, size)
                yield Gap(offset, following - offset, found)
                offset = following


def chunk_records(content: bytes) -> Iterator[tuple[int, RawMessage | Schema | Channel]]:
    """Yield ``(offset, record)`` of an uncompressed chunk.

    Raises:
        ValueError: a record runs over the end of the chunk.
    """
    offset = 0
    while offset < len(content):
        if offset + 9 > len(content):
            raise ValueError("a record's head is cut off")
        opcode, length = struct.unpack_from("<BQ", content, offset)
        start, end = offset + 9, offset + 9 + length
        if end > len(content):
            raise ValueError("a record is longer than its chunk")
        if opcode == Opcode.MESSAGE:
            yield offset, parse_message(content[start:end])
        elif opcode == Opcode.SCHEMA:
            yield offset, Schema.read(_stream(content[start:end]))
        elif opcode == Opcode.CHANNEL:
            yield offset, Channel.read(_stream(content[start:end]))
        offset = end


def check_chunk(body: bytes) -> bytes:
    """Return the uncompressed content of a Chunk record's body.

    Raises:
        ValueError: it fails its CRC or does not decompress.
    """
    try:
        chunk = Chunk.read(_stream(body))
        stream, length = get_chunk_data_stream(chunk, validate_crc=True)
        content = bytes(stream.read(length))
    except _DAMAGED as failure:
        raise ValueError(str(failure)) from failure
    if length != chunk.uncompressed_size:
        raise ValueError("its uncompressed size is wrong")
    for _ in chunk_records(content):
        pass
    return content


def parse_message(body: bytes) -> RawMessage:
    """Return the message of a Message record's body.

    Raises:
        ValueError: the body is shorter than the head of a message.
    """
    if len(body) < _MESSAGE_HEAD.size:
        raise ValueError("a message without its head")
    channel, _, log_time, publish_time = _MESSAGE_HEAD.unpack_from(body)
    return RawMessage(channel, log_time, publish_time, body[_MESSAGE_HEAD.size :])


@dataclass(slots=True)
class Scan:
    """What a walk over one file found.

    Attributes:
        index: schemas, channels and intact chunks: all that a new summary needs.
        records: values of the Metadata records by name; of several the last.
        gaps: damage in file order.
        clean_end: bytes from the start that are intact and laid out as :class:`McapFile` does.
        torn_indexes: message indexes of the chunk at ``clean_end``, to be written there.
        loose_messages: messages outside chunks (other writers only).
        attachments: attachments (other writers only).
        closed: the end of the data section was reached.
    """

    index: FileIndex = field(default_factory=FileIndex)
    records: dict[str, dict[str, str]] = field(default_factory=dict)
    gaps: list[Gap] = field(default_factory=list)
    clean_end: int = 0
    torn_indexes: bytes = b""
    loose_messages: int = 0
    attachments: int = 0
    closed: bool = False


def scan(path: Path) -> Scan:
    """Check every record of a file and rebuild its index."""
    result = Scan()
    clean = True
    with path.open("rb") as file:
        for found in walk(path):
            if isinstance(found, Gap):
                result.gaps.append(found)
                clean = False
                continue
            end = found.offset + found.length
            if found.opcode == Opcode.CHUNK:
                indexes = _add_chunk(result, found)
                file.seek(end)
                stored = file.read(len(indexes))
                if clean and stored == indexes:
                    result.clean_end = end + len(indexes)
                elif clean:
                    clean = False
                    result.clean_end, result.torn_indexes = end, indexes
            elif found.opcode == Opcode.DATA_END:
                result.closed = True
                stated = struct.unpack("<I", found.body[:4])[0]
                if clean and stated not in (0, _crc(file, found.offset)):
                    result.gaps.append(Gap(0, 0, "the data section fails its CRC"))
            elif found.opcode != Opcode.MESSAGE_INDEX:
                _add_other(result, found)
                if clean:
                    result.clean_end = end
    return result


def _add_chunk(result: Scan, found: Record) -> bytes:
    chunk = Chunk.read(_stream(found.body))
    entries: dict[int, list[int]] = {}
    for offset, record in chunk_records(found.content):
        if isinstance(record, Schema):
            result.index.schemas[record.id] = record
        elif isinstance(record, Channel):
            result.index.channels[record.id] = record
        else:
            entries.setdefault(record.channel, []).extend((record.log_time, offset))
    offsets: dict[int, int] = {}
    indexes = bytearray()
    for channel, numbers in entries.items():
        offsets[channel] = found.offset + found.length + len(indexes)
        indexes += message_index(channel, numbers)
    index = ChunkIndex(
        chunk_length=found.length,
        chunk_start_offset=found.offset,
        compression=chunk.compression,
        compressed_size=len(chunk.data),
        message_end_time=chunk.message_end_time,
        message_index_length=len(indexes),
        message_index_offsets=offsets,
        message_start_time=chunk.message_start_time,
        uncompressed_size=chunk.uncompressed_size,
    )
    counts = {channel: len(numbers) // 2 for channel, numbers in entries.items()}
    result.index.add_chunk(index, counts)
    return bytes(indexes)


def _add_other(result: Scan, found: Record) -> None:
    if found.opcode == Opcode.METADATA:
        record = Metadata.read(_stream(found.body))
        result.records[record.name] = dict(record.metadata)
        result.index.metadata.append(MetadataIndex(found.offset, found.length, record.name))
    elif found.opcode == Opcode.SCHEMA:
        schema = Schema.read(_stream(found.body))
        result.index.schemas[schema.id] = schema
    elif found.opcode == Opcode.CHANNEL:
        channel = Channel.read(_stream(found.body))
        result.index.channels[channel.id] = channel
    elif found.opcode == Opcode.MESSAGE:
        result.loose_messages += 1
    elif found.opcode == Opcode.ATTACHMENT:
        result.attachments += 1


def _record_at(data: mmap.mmap, offset: int, size: int) -> Record | str:
    """Return the record at ``offset``, or why there is none."""
    if offset + 9 > size:
        return "a record's head is cut off"
    opcode, length = struct.unpack_from("<BQ", data, offset)
    if opcode not in _KNOWN:
        return "no record starts here"
    if length > size - offset - 9:
        return "a record runs over the end of the file"
    body = data[offset + 9 : offset + 9 + length]
    try:
        content = _check(opcode, body)
    except _DAMAGED as failure:
        return f"{Opcode(opcode).name.lower()} record damaged ({failure})"
    return Record(offset, 9 + length, opcode, body, content)


def _check(opcode: int, body: bytes) -> bytes:
    """Parse a record; return the uncompressed content of a chunk."""
    parsers = {
        Opcode.HEADER: Header,
        Opcode.SCHEMA: Schema,
        Opcode.CHANNEL: Channel,
        Opcode.METADATA: Metadata,
    }
    if opcode == Opcode.CHUNK:
        return check_chunk(body)
    # No CRC of their own: a flipped length must not carry the walk over intact records.
    if opcode == Opcode.MESSAGE:
        parse_message(body)
    elif opcode == Opcode.MESSAGE_INDEX:
        if len(body) < 6 or struct.unpack_from("<I", body, 2)[0] != len(body) - 6:
            raise ValueError("its length is wrong")
    elif opcode in parsers and encoded(parsers[Opcode(opcode)].read(_stream(body)))[9:] != body:
        raise ValueError("its length is wrong")
    return b""


def _next_chunk(data: mmap.mmap, start: int, size: int) -> int:
    """Return where the next intact zstd chunk starts, or ``size``."""
    position = start + _BEFORE_COMPRESSION
    while (position := data.find(_ZSTD_CHUNK, position)) >= 0:
        offset = position - _BEFORE_COMPRESSION
        if data[offset] == Opcode.CHUNK and isinstance(_record_at(data, offset, size), Record):
            return offset
        position += 1
    return size


def _crc(file: BinaryIO, length: int) -> int:
    file.seek(0)
    crc = 0
    while length > 0 and (block := file.read(min(length, 1 << 20))):
        crc = zlib.crc32(block, crc)
        length -= len(block)
    return crc


def _stream(data: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(data))
