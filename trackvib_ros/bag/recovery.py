"""Make a bag whole again after a crash, a power cut or damage on the disk."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import DataEnd

from solver import InputError
from trackvib_ros.bag import metadata
from trackvib_ros.bag.contents import load_contents
from trackvib_ros.bag.mcap_file import CHUNK_BYTES, MAGIC, McapFile, encoded
from trackvib_ros.bag.metadata import FileContents, Topic
from trackvib_ros.bag.scan import RawMessage, Record, Scan, chunk_records, parse_message, scan, walk
from trackvib_ros.bag.writer import ACTIVE_SUFFIX, CUSTOM_RECORD, RESERVE_NAME

DAMAGED_SUFFIX = ".damaged"
_PARTIAL_SUFFIX = ".partial"


class BagInUseError(InputError):
    """A recorder is still writing this bag."""


@dataclass(slots=True)
class FileReport:
    """What was done to one file.

    Attributes:
        path: name of the repaired file.
        messages: messages it holds now.
        gaps: what was missing or damaged in it.
        kept_as: name under which the damaged original was kept, if it was rewritten.
    """

    path: str
    messages: int
    gaps: list[str] = field(default_factory=list)
    kept_as: str | None = None


@dataclass(slots=True)
class RecoveryReport:
    """Account of a recovery; ``files`` lists only the files that needed it."""

    directory: Path
    files: list[FileReport] = field(default_factory=list)
    metadata_rebuilt: bool = False

    @property
    def changed(self) -> bool:
        """Whether anything had to be done."""
        return bool(self.files) or self.metadata_rebuilt

    def __str__(self) -> str:
        """Return the account for a person, several lines."""
        lines = [f"{self.directory}: {'recovered' if self.changed else 'nothing to recover'}"]
        for file in self.files:
            kept = f"; the damaged original is kept as {file.kept_as}" if file.kept_as else ""
            lines.append(f"  {file.path}: {file.messages} messages intact{kept}")
            lines.extend(f"    missing: {gap}" for gap in file.gaps)
        if self.metadata_rebuilt:
            lines.append("  metadata.yaml rebuilt from the recordings")
        return "\n".join(lines)


def needs_recovery(directory: Path) -> bool:
    """Whether a recording was left unfinished or ``metadata.yaml`` does not list every file."""
    if any(directory.glob(f"*{ACTIVE_SUFFIX}")):
        return True
    try:
        listed = [Path(name).name for name in metadata.read(directory)["relative_file_paths"]]
    except (InputError, FileNotFoundError):
        return any(directory.glob("*.mcap"))
    recordings = {name.rpartition("_")[0] for name in listed if name.endswith(".mcap")}
    found = {path.name for path in _files(directory)}
    return any(name.rpartition("_")[0] in recordings for name in found - set(listed))


def recover(directory: Path, *, verify: bool = True) -> RecoveryReport:
    """Repair every file of a bag directory and rebuild ``metadata.yaml`` if need be.

    An unfinished recording is cut behind its last intact chunk and finished. A damaged file is
    rewritten from its intact chunks; the original stays beside it as ``*.damaged``.

    Args:
        directory: the bag.
        verify: check every chunk of the finished files too, not only the unfinished one.

    Raises:
        BagInUseError: a recorder holds the bag open.
        InputError: not a bag directory.
        OSError: no space or no permission to write the repaired files.
    """
    if not directory.is_dir():
        raise InputError(f"{directory} is not a bag directory: give the directory of a recording")
    report = RecoveryReport(directory)
    active = sorted(directory.glob(f"*{ACTIVE_SUFFIX}"))
    if not active and not any(directory.glob("*.mcap")):
        raise InputError(f"{directory} holds no .mcap file: nothing can be recovered")
    for path in active:
        _lock(path)
    for path in active:
        report.files.append(_finish_active(path))
    if verify:
        for path in _files(directory):
            if path.name not in {file.path for file in report.files}:
                repaired = _verify(path)
                if repaired is not None:
                    report.files.append(repaired)
    for leftover in (RESERVE_NAME, f".{metadata.FILE_NAME}.new"):
        with suppress(FileNotFoundError):
            (directory / leftover).unlink()
    if report.files or needs_recovery(directory):
        _rebuild_metadata(directory)
        report.metadata_rebuilt = True
    return report


def recover_file(path: Path, output: Path) -> FileReport:
    """Copy every intact message of one MCAP file into a new one.

    Raises:
        InputError: ``output`` exists or ``path`` does not.
    """
    if not path.is_file():
        raise InputError(f"{path} does not exist: give an .mcap file or a bag directory")
    if output.exists():
        raise InputError(f"{output} exists already and is not overwritten: choose another with -o")
    return _rewrite(path, output, scan(path))


def _lock(path: Path) -> None:
    """Refuse if the recorder lives; its lock ends with its process, however that ended."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise BagInUseError(
            f"{path.parent} is being recorded (its file {path.name} is locked): "
            "stop the recorder first"
        ) from None
    finally:
        os.close(descriptor)


def _finish_active(path: Path) -> FileReport:
    final = path.with_suffix("")
    if final.exists():
        raise InputError(f"{path} and {final.name} exist both: move one of them away")
    found = scan(path)
    if _cut_is_enough(found):
        _cut_and_finish(path, found)
        path.rename(final)
        messages = found.index.statistics().message_count
        report = FileReport(final.name, messages, [str(gap) for gap in found.gaps])
    else:
        report = _rewrite(path, final, found)
        report.kept_as = path.rename(path.with_name(final.name + DAMAGED_SUFFIX)).name
    metadata.sync_directory(path.parent)
    if not report.gaps and not found.closed:
        report.gaps.append("the recording was not closed; at most its last second is missing")
    return report


def _cut_and_finish(path: Path, found: Scan) -> None:
    with path.open("r+b") as file:
        file.truncate(found.clean_end)
        file.seek(found.clean_end)
        # No CRC of the data section: chunks have their own, and it would mean reading all again.
        end = found.torn_indexes + encoded(DataEnd(0))
        file.write(end + found.index.summary(found.clean_end + len(end)))
        file.flush()
        os.fsync(file.fileno())


def _cut_is_enough(found: Scan) -> bool:
    return found.clean_end > len(MAGIC) and all(
        chunk.chunk_start_offset < found.clean_end for chunk in found.index.chunks
    )


def _verify(path: Path) -> FileReport | None:
    found = scan(path)
    summary_intact = load_contents(path).summary_intact
    if found.closed and not found.gaps and summary_intact:
        return None
    if not found.gaps:
        found_gaps = ["the summary section is missing or damaged"]
    else:
        found_gaps = [str(gap) for gap in found.gaps]
    partial = path.with_name(path.name + _PARTIAL_SUFFIX)
    with suppress(FileNotFoundError):
        partial.unlink()
    report = _rewrite(path, partial, found)
    report.path = path.name
    report.gaps = found_gaps
    kept = path.with_name(path.name + DAMAGED_SUFFIX)
    if kept.exists():
        raise InputError(f"{kept} is in the way: move it elsewhere, then recover again")
    path.rename(kept)
    partial.rename(path)
    metadata.sync_directory(path.parent)
    report.kept_as = kept.name
    return report


def _rewrite(source: Path, target: Path, found: Scan) -> FileReport:
    """Copy every message whose channel is known; channels may be defined in any intact chunk."""
    stated = load_contents(source)
    schemas = {**stated.schemas, **found.index.schemas}
    channels = {**stated.channels, **found.index.channels}
    file = McapFile(target)
    orphans = 0
    try:
        for name, values in found.records.items():
            file.add_metadata(name, values)
        for message in _messages(source):
            channel = channels.get(message.channel)
            schema = schemas.get(channel.schema_id) if channel is not None else None
            if channel is None or schema is None:
                orphans += 1
                continue
            if message.channel not in file.index.channels:
                file.define(schema, channel)
            file.add_message(*message)
            if file.open_bytes >= CHUNK_BYTES:
                file.flush()
        file.flush()
        file.finish(lambda: None)
        os.fsync(file.fileno())
    except BaseException:
        target.unlink()
        raise
    finally:
        file.close()
    gaps = [str(gap) for gap in found.gaps]
    if orphans:
        gaps.append(f"{orphans} messages whose channel definition is lost")
    if found.attachments:
        gaps.append(f"{found.attachments} attachments are not copied")
    return FileReport(target.name, file.index.statistics().message_count, gaps)


def _messages(source: Path) -> Iterator[RawMessage]:
    for found in walk(source):
        if isinstance(found, Record) and found.opcode == Opcode.CHUNK:
            for _, record in chunk_records(found.content):
                if isinstance(record, RawMessage):
                    yield record
        elif isinstance(found, Record) and found.opcode == Opcode.MESSAGE:
            yield parse_message(found.body)


def _rebuild_metadata(directory: Path) -> None:
    """Write ``metadata.yaml`` from the files; what only the old one knows is kept."""
    try:
        old = metadata.read(directory)
    except (InputError, FileNotFoundError):
        old = {}
    topics: dict[str, Topic] = {}
    custom: dict[str, str] = {}
    files: list[FileContents] = []
    for path in _files(directory):
        contents = load_contents(path)
        custom.update(contents.records.get(CUSTOM_RECORD, {}))
        for channel in contents.channels.values():
            schema = contents.schemas[channel.schema_id]
            topics.setdefault(
                channel.topic,
                Topic(
                    channel.topic,
                    schema.name,
                    schema.data.decode("utf-8", "replace"),
                    channel.metadata.get("topic_type_hash", ""),
                    metadata.parse_qos(channel.metadata.get("offered_qos_profiles", "")),
                ),
            )
        totals = contents.statistics
        files.append(
            FileContents(
                path.name,
                totals.message_start_time,
                totals.message_end_time,
                contents.topic_counts(),
            )
        )
    for entry in old.get("topics_with_message_count", []):
        item = entry["topic_metadata"]
        qos = metadata.parse_qos(item.get("offered_qos_profiles", []))
        hash_text = item.get("type_description_hash", "")
        topics.setdefault(item["name"], Topic(item["name"], item["type"], "", hash_text, qos))
    custom.update(old.get("custom_data") or {})
    distro = str(old.get("ros_distro") or os.environ.get("ROS_DISTRO", "jazzy"))
    metadata.write(directory, metadata.information(files, topics.values(), custom, distro))


def _files(directory: Path) -> list[Path]:
    """Return the finished files in recording order: by the number that ends their name."""

    def number(path: Path) -> tuple[int, str]:
        tail = path.stem.rpartition("_")[2]
        return (int(tail) if tail.isdigit() else 0, path.name)

    return sorted(directory.glob("*.mcap"), key=number)
