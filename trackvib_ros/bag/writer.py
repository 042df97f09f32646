"""Write a rosbag2 directory that survives kill -9, power cuts and full disks.

The file in work is ``NAME_n.mcap.active``; what is in it for longer than the flush interval is on
the disk. Closed files are renamed to ``NAME_n.mcap`` and listed in ``metadata.yaml``, so the
directory is a valid bag at any time.
"""

from __future__ import annotations

import os
import threading
import time
from collections import Counter, deque
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from mcap.records import Channel, Schema

from solver import InputError
from trackvib_ros import __version__
from trackvib_ros.bag import metadata
from trackvib_ros.bag.mcap_file import CHUNK_BYTES, McapFile
from trackvib_ros.bag.metadata import FileContents, Topic

ACTIVE_SUFFIX = ".active"
RESERVE_NAME = ".reserve"
RESERVE_BYTES = 256 * 1024
"""Space kept back for the summary and ``metadata.yaml`` when the disk is full (bytes)."""
CUSTOM_RECORD = "trackvib"
"""Name of the Metadata record that repeats ``custom_data`` in every file."""
VERSION_KEY = "trackvib_version"

_TICK_S = 0.05
_EMPTY_CHUNK_INDEX = 128


class BagWriter:
    """A bag in work: messages are queued by any thread and written by one of its own.

    Attributes:
        directory: the bag.
        failure: why recording stopped by itself, ``None`` while all is well.
        counts: messages accepted, by topic.
        drops: messages lost, by topic: refused because the queue was full or recording had
            stopped, or given up when the disk was full.
    """

    def __init__(
        self,
        directory: Path,
        *,
        custom_data: Mapping[str, str] | None = None,
        split_bytes: int | None = None,
        split_ns: int | None = None,
        queue_bytes: int = 64 << 20,
        flush_interval_s: float = 0.5,
    ) -> None:
        """Create the bag.

        Args:
            directory: must not exist; its parents are made.
            custom_data: stored in ``metadata.yaml`` and in every file; the package version is
                added.
            split_bytes: start a new file when this one has reached so many bytes.
            split_ns: start a new file when this one spans so many ns of log time.
            queue_bytes: bound of the queue (bytes of messages).
            flush_interval_s: a message is on the disk at most this long after it came (s), plus
                the time of one ``fdatasync``.

        Raises:
            InputError: the directory exists, or a limit is not positive.
            OSError: it cannot be created (``ENOSPC`` if the reserve does not fit).
        """
        for name, value, unit in (
            ("split_bytes", split_bytes, "bytes"),
            ("split_ns", split_ns, "ns"),
            ("queue_bytes", queue_bytes, "bytes"),
            ("flush_interval_s", flush_interval_s, "s"),
        ):
            if value is not None and value <= 0:
                raise InputError(f"{name} = {value} {unit}: must be greater than 0 {unit}")
        self.directory = Path(directory)
        self.failure: str | None = None
        self.counts: Counter[str] = Counter()
        self.drops: Counter[str] = Counter()
        self._custom_data = {VERSION_KEY: __version__, **(custom_data or {})}
        self._custom_data_pending = False
        self._distro = os.environ.get("ROS_DISTRO", "jazzy")
        self._split_bytes = split_bytes
        self._split_ns = split_ns
        self._queue_bytes = queue_bytes
        self._flush_interval = flush_interval_s
        self._topics: dict[str, Topic] = {}
        self._numbers: dict[str, int] = {}
        self._first_log_time = 2**63 - 1
        self._closed_files: list[FileContents] = []
        self._queue: deque[tuple[str, int, int, bytes]] = deque()
        self._queued = 0
        self._lock = threading.Lock()
        self._wake = threading.Event()
        self._stopping = False
        self._dirty = threading.Event()
        self._file_lock = threading.Lock()
        self._sync_error: OSError | None = None

        self._create_directory()
        try:
            self._reserved = 0
            self._reserve(RESERVE_BYTES)
            self._file = self._new_file()
        except BaseException:
            for path in self.directory.iterdir():
                path.unlink()
            self.directory.rmdir()
            raise
        self._writer = threading.Thread(target=self._write_loop, name="bag writer", daemon=True)
        self._syncer = threading.Thread(target=self._sync_loop, name="bag sync", daemon=True)
        self._writer.start()
        self._syncer.start()

    @property
    def full(self) -> bool:
        """Whether the queue has no room for another message."""
        return self._queued >= self._queue_bytes

    @property
    def room(self) -> int:
        """How much the queue takes now (bytes)."""
        return self._queue_bytes - self._queued

    @property
    def topics(self) -> tuple[Topic, ...]:
        """Topics known so far."""
        return tuple(self._topics.values())

    def add_topic(self, topic: Topic) -> None:
        """Make a topic known; it is listed in the bag even without a message.

        Raises:
            InputError: the name is known with another type or definition.
        """
        known = self._topics.get(topic.name)
        if known is not None:
            if (known.type, known.definition) != (topic.type, topic.definition):
                raise InputError(
                    f"topic {topic.name} is recorded as {known.type}, now it is {topic.type}: "
                    "one topic has one type"
                )
            return
        with self._lock:
            # A new dictionary: the writer's thread may be walking over the old one.
            self._numbers[topic.name] = len(self._topics) + 1
            self._topics = {**self._topics, topic.name: topic}

    def write(self, topic: str, log_time_ns: int, publish_time_ns: int, data: bytes) -> bool:
        """Queue one serialized message; return False (and count a drop) if it was refused.

        Never blocks on the disk.

        Raises:
            InputError: the topic is unknown or a time is negative.
        """
        if topic not in self._topics:
            raise InputError(f"topic {topic} is unknown to the bag: call add_topic first")
        if log_time_ns < 0 or publish_time_ns < 0:
            raise InputError(
                f"topic {topic}: log time {log_time_ns} ns, publish time {publish_time_ns} ns: "
                "times must not be negative"
            )
        with self._lock:
            if self._stopping or self.failure is not None or self.full:
                self.drops[topic] += 1
                return False
            self._queue.append((topic, log_time_ns, publish_time_ns, data))
            self._queued += len(data)
            self.counts[topic] += 1
        if self._queued >= CHUNK_BYTES:
            self._wake.set()
        return True

    def add_custom_data(self, values: Mapping[str, str]) -> None:
        """Store more beside the messages, in this file, in later ones and in ``metadata.yaml``."""
        with self._lock:
            self._custom_data = {**self._custom_data, **values}
            self._custom_data_pending = True

    def close(self) -> None:
        """Write what is queued and finish the bag; may be called again.

        Look at :attr:`failure` afterwards.
        """
        with self._lock:
            self._stopping = True
        self._wake.set()
        self._writer.join()
        self._dirty.set()
        self._syncer.join()

    # The writer's thread

    def _write_loop(self) -> None:
        last_flush = time.monotonic()
        while True:
            self._wake.wait(_TICK_S)
            self._wake.clear()
            with self._lock:
                batch = self._next_batch()
                stopping = self._stopping and not self._queue
                if self._queue:
                    self._wake.set()
                custom_data = self._custom_data if self._custom_data_pending else None
                self._custom_data_pending = False
            try:
                if self._sync_error is not None:
                    raise self._sync_error
                if custom_data is not None:
                    self._file.add_metadata(CUSTOM_RECORD, custom_data)
                while batch:
                    self._add(*batch[0])
                    batch.popleft()
                    if self._file.open_bytes >= CHUNK_BYTES:
                        self._flush()
                if time.monotonic() - last_flush >= self._flush_interval:
                    last_flush = time.monotonic()
                    self._flush()
                if stopping:
                    self._finish_file()
                    self._release_reserve()
                    return
            except Exception as failure:
                self._stop_recording(failure, batch)
                return

    def _next_batch(self) -> deque[tuple[str, int, int, bytes]]:
        """Take about a chunk, so that the queue's bound is the bound of all that waits."""
        batch: deque[tuple[str, int, int, bytes]] = deque()
        size = 0
        while self._queue and size < CHUNK_BYTES:
            batch.append(self._queue.popleft())
            size += len(batch[-1][3])
        self._queued -= size
        return batch

    def _add(self, topic: str, log_time: int, publish_time: int, data: bytes) -> None:
        file = self._file
        number = self._numbers[topic]
        if number not in file.index.channels:
            self._define(file, self._topics[topic], number)
        if self._split_due(log_time):
            self._finish_file()
            self._file = file = self._new_file()
            self._define(file, self._topics[topic], number)
        file.add_message(number, log_time, publish_time, data)
        self._first_log_time = min(self._first_log_time, log_time)

    def _split_due(self, log_time: int) -> bool:
        if self._first_log_time > log_time:
            return False
        if self._split_ns is not None and log_time - self._first_log_time >= self._split_ns:
            return True
        return self._split_bytes is not None and self._file.size >= self._split_bytes

    def _define(self, file: McapFile, topic: Topic, number: int) -> None:
        qos = metadata.qos_text(topic.qos)
        file.define(
            Schema(id=number, name=topic.type, encoding="ros2msg", data=topic.definition.encode()),
            Channel(
                id=number,
                topic=topic.name,
                message_encoding="cdr",
                metadata={"offered_qos_profiles": qos, "topic_type_hash": topic.type_hash},
                schema_id=number,
            ),
        )

    def _flush(self) -> None:
        if self._file.open_bytes == 0:
            return
        self._file.flush()
        self._dirty.set()
        chunks = self._file.index.chunk_count
        needed = chunks * (_EMPTY_CHUNK_INDEX + 10 * len(self._topics)) + sum(
            len(topic.definition) + 2048 for topic in self._topics.values()
        )
        if needed + RESERVE_BYTES // 2 > self._reserved:
            self._reserve(self._reserved + RESERVE_BYTES)

    def _new_file(self) -> McapFile:
        name = f"{self.directory.name}_{len(self._closed_files)}.mcap"
        file = McapFile(self.directory / (name + ACTIVE_SUFFIX))
        self._first_log_time = 2**63 - 1
        try:
            file.add_metadata("rosbag2", self._rosbag2_record([]))
            file.add_metadata(CUSTOM_RECORD, self._custom_data)
            os.fsync(file.fileno())
            metadata.sync_directory(self.directory)
        except OSError:
            file.close()
            file.path.unlink()
            raise
        return file

    def _finish_file(self, *, give_up: bool = False) -> None:
        """Close the file in work under its final name and list it; may be repeated on failure."""
        file = self._file
        if not file.finished:
            file.flush()
            self._count_lost(file.finish(lambda: self._add_closing_record(file), give_up=give_up))
        os.fsync(file.fileno())
        final = file.path.with_suffix("")
        if not final.exists():
            file.path.rename(final)
            self._closed_files.append(self._contents(file))
        metadata.write(
            self.directory,
            metadata.information(
                self._closed_files, self._topics.values(), self._custom_data, self._distro
            ),
        )
        with self._file_lock:
            file.close()

    def _add_closing_record(self, file: McapFile) -> None:
        file.add_metadata("rosbag2", self._rosbag2_record([self._contents(file)]))

    def _contents(self, file: McapFile) -> FileContents:
        totals = file.index.statistics()
        return FileContents(
            path=file.path.with_suffix("").name,
            start_ns=totals.message_start_time,
            end_ns=totals.message_end_time,
            counts={
                file.index.channels[number].topic: count
                for number, count in totals.channel_message_counts.items()
            },
        )

    def _rosbag2_record(self, files: list[FileContents]) -> dict[str, str]:
        content = metadata.information(
            [*self._closed_files, *files], self._topics.values(), self._custom_data, self._distro
        )
        return {"serialized_metadata": metadata.as_yaml(content)}

    def _stop_recording(
        self, failure: Exception, unwritten: deque[tuple[str, int, int, bytes]]
    ) -> None:
        """Finish the bag with what is on the disk; later messages are counted as drops."""
        with self._lock:
            self.failure = (
                f"recording to {self.directory} stopped: {_reason(failure)}; "
                "what was recorded before is complete"
            )
            unwritten.extend(self._queue)
            self._queue.clear()
            self._queued = 0
        for topic, *_ in unwritten:
            self._count_lost_topic(topic, 1)
        self._release_reserve()
        if self._file.closed:
            return
        self._count_lost(self._file.discard())
        try:
            self._finish_file(give_up=True)
        except OSError as second:
            self.failure += (
                f"; the last file could not be finished ({_reason(second)}): "
                f"free some space, then `trackvib recover {self.directory}`"
            )
            with self._file_lock:
                self._file.close()

    def _count_lost(self, counts: Mapping[int, int]) -> None:
        for number, count in counts.items():
            self._count_lost_topic(self._file.index.channels[number].topic, count)

    def _count_lost_topic(self, topic: str, count: int) -> None:
        with self._lock:
            self.counts[topic] -= count
            self.drops[topic] += count

    def _reserve(self, size: int) -> None:
        path = self.directory / RESERVE_NAME
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            os.posix_fallocate(descriptor, 0, size)
            self._reserved = size
        finally:
            os.close(descriptor)

    def _release_reserve(self) -> None:
        with suppress(FileNotFoundError):
            (self.directory / RESERVE_NAME).unlink()

    def _create_directory(self) -> None:
        try:
            self.directory.parent.mkdir(parents=True, exist_ok=True)
            self.directory.mkdir()
        except (FileExistsError, NotADirectoryError):
            raise InputError(
                f"{self.directory} exists already and is not overwritten: "
                "choose another directory with -o"
            ) from None
        metadata.sync_directory(self.directory.resolve().parent)

    # The syncing thread: the queue must not wait for a slow disk

    def _sync_loop(self) -> None:
        while True:
            self._dirty.wait()
            self._dirty.clear()
            try:
                with self._file_lock:
                    descriptor = self._file.fileno()
                    copy = os.dup(descriptor) if descriptor >= 0 else -1
                if copy >= 0:
                    try:
                        os.fdatasync(copy)
                    finally:
                        os.close(copy)
            except OSError as failure:
                self._sync_error = failure
                return
            if not self._writer.is_alive():
                return


def _reason(failure: Exception) -> str:
    if isinstance(failure, OSError) and failure.errno:
        return os.strerror(failure.errno)
    return f"{type(failure).__name__}: {failure}"
