"""Fault injection: killed, cut, flipped, zeroed and disk-full recordings.

Each case damages a recording whose every message is known, and reads the result with this
project's reader, with ``mcap`` and with ``rosbags``. Nothing altered may come back, everything in
an intact chunk must come back, and the account must tell that something is missing.
"""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader

from tests.bag import sample
from trackvib_ros.bag import BagInUseError, BagReader, BagWriter, recover, writer
from trackvib_ros.bag.contents import load_contents
from trackvib_ros.bag.mcap_file import McapFile
from trackvib_ros.bag.scan import scan

CUTS, ZEROED, FLIPS_OPEN, FLIPS_CLOSED, KILLS, LIMITS = 70, 25, 45, 45, 10, 15
assert CUTS + ZEROED + FLIPS_OPEN + FLIPS_CLOSED + KILLS + LIMITS >= 200

NAME = "passage"
Key = tuple[str, int, int, bytes]


@dataclass(frozen=True)
class Recording:
    """A finished file with about 30 chunks, and what each of its chunks holds."""

    data: bytes
    chunks: tuple[tuple[int, int, tuple[Key, ...]], ...]

    @property
    def messages(self) -> Counter[Key]:
        return Counter(key for _, _, keys in self.chunks for key in keys)

    def intact(self, damaged: range | list[int]) -> Counter[Key]:
        """Messages of the chunks that none of the damaged bytes lies in."""
        return Counter(
            key
            for start, end, keys in self.chunks
            if not any(start <= byte < end for byte in damaged)
            for key in keys
        )


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer, "CHUNK_BYTES", 12_000)
        directory = sample.write_sample(tmp_path_factory.mktemp("whole") / NAME)
    path = directory / f"{NAME}_0.mcap"
    reader = BagReader(path)
    chunks = []
    for chunk in load_contents(path).chunks:
        keys = tuple(
            (m.topic, m.log_time_ns, m.publish_time_ns, m.data)
            for m in reader.messages(
                start_ns=chunk.message_start_time, end_ns=chunk.message_end_time + 1
            )
        )
        assert len(keys) == sum(1 for _ in keys)
        start = chunk.chunk_start_offset
        chunks.append((start, start + chunk.chunk_length, keys))
    result = Recording(path.read_bytes(), tuple(chunks))
    assert len(chunks) > 15 and result.messages.total() == 101
    return result


def place(directory: Path, data: bytes, *, finished: bool, whole: Path | None = None) -> Path:
    directory.mkdir()
    (directory / (f"{NAME}_0.mcap" + ("" if finished else ".active"))).write_bytes(data)
    return directory


def read_three_ways(directory: Path) -> Counter[Key]:
    """Read a bag with three readers, which must agree."""
    reader = BagReader(directory)
    own = Counter((m.topic, m.log_time_ns, m.publish_time_ns, m.data) for m in reader.messages())
    assert reader.damage == []
    second: Counter[Key] = Counter()
    for path in reader.files:
        with path.open("rb") as file:
            for _, channel, message in make_reader(file, validate_crcs=True).iter_messages():
                second[channel.topic, message.log_time, message.publish_time, message.data] += 1
    assert second == own
    with Reader(directory) as rosbags_reader:
        third = Counter((c.topic, t, bytes(d)) for c, t, d in rosbags_reader.messages())
        assert rosbags_reader.message_count == own.total()
    assert third == Counter((topic, log, data) for topic, log, _, data in own.elements())
    return own


def test_cut_recordings_yield_every_whole_chunk(recording: Recording, tmp_path: Path) -> None:
    draw = random.Random(1)
    size = len(recording.data)
    cuts = [0, 1, 8, 9, size - 1, *(draw.randrange(size) for _ in range(CUTS - 5))]
    for number, cut in enumerate(cuts):
        directory = place(tmp_path / str(number), recording.data[:cut], finished=False)
        reader = BagReader(directory)
        assert reader.recovery is not None
        found = read_three_ways(directory)
        assert found == recording.intact(range(cut, size)), cut
        assert reader.recovery.files[0].gaps or found == recording.messages
        assert sorted(p.suffix for p in directory.iterdir() if p.suffix != ".damaged") == [
            ".mcap",
            ".yaml",
        ]


def test_zeroed_tails_as_after_a_power_cut(recording: Recording, tmp_path: Path) -> None:
    draw = random.Random(2)
    size = len(recording.data)
    for number in range(ZEROED):
        cut = draw.randrange(100, size)
        data = recording.data[:cut] + bytes(size - cut)
        directory = place(tmp_path / str(number), data, finished=False)
        # A chunk may end in bytes that are zero anyway.
        altered = [k for k in range(cut, size) if recording.data[k] != 0]
        assert read_three_ways(directory) == recording.intact(altered), cut


@pytest.mark.parametrize(("finished", "cases"), [(False, FLIPS_OPEN), (True, FLIPS_CLOSED)])
def test_flipped_bits_cost_only_their_chunk(
    recording: Recording, tmp_path: Path, finished: bool, cases: int
) -> None:
    draw = random.Random(3 + finished)
    for number in range(cases):
        flips = [draw.randrange(len(recording.data)) for _ in range(draw.choice((1, 1, 2, 5)))]
        data = bytearray(recording.data)
        for byte in flips:
            data[byte] ^= 1 << draw.randrange(8)
        directory = place(tmp_path / str(number), bytes(data), finished=finished)
        report = recover(directory)
        found = read_three_ways(directory)
        lost = recording.messages - found
        assert not found - recording.messages, (number, flips)
        assert not recording.intact(flips) - found, (number, flips)
        if lost:
            assert report.files and report.files[0].gaps
        if finished and report.files:
            kept = directory / str(report.files[0].kept_as)
            assert kept.read_bytes() == data


def test_damaged_file_is_read_without_being_touched(recording: Recording, tmp_path: Path) -> None:
    start, end, _ = recording.chunks[5]
    data = bytearray(recording.data)
    data[(start + end) // 2] ^= 0x10
    path = place(tmp_path / "bag", bytes(data), finished=True) / f"{NAME}_0.mcap"
    reader = BagReader(path)
    found = Counter((m.topic, m.log_time_ns, m.publish_time_ns, m.data) for m in reader.messages())
    assert found == recording.intact([(start + end) // 2])
    assert any(f"byte {start}" in sentence for sentence in reader.damage)
    assert any(f"byte {start}" in sentence for sentence in reader.verify())
    assert path.read_bytes() == data


def test_lost_definitions_are_repeated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writer, "CHUNK_BYTES", 5_000)
    monkeypatch.setattr("trackvib_ros.bag.mcap_file.DEFINITIONS_EVERY", 8)
    directory = sample.write_sample(tmp_path / NAME)
    path = directory / f"{NAME}_0.mcap"
    contents = load_contents(path)
    first = contents.chunks[0]
    total = contents.statistics.message_count
    data = bytearray(path.read_bytes()[: contents.chunks[-1].chunk_start_offset])
    data[first.chunk_start_offset + 60] ^= 1
    broken = place(tmp_path / "broken", bytes(data), finished=False)
    report = recover(broken)
    lost = total - read_three_ways(broken).total()
    assert 0 < lost <= 8, "the first and the last chunk hold a few messages each"
    assert "channel definition" not in str(report)


KILLED = """
import sys, time
from pathlib import Path
from tests.bag import sample
from trackvib_ros.bag import BagWriter
writer = BagWriter(Path(sys.argv[1]), custom_data={"seed": "7"})
for name in sample.TYPES:
    writer.add_topic(sample.topic(name))
types = sample.store()
period = float(sys.argv[2])
print("ready", flush=True)
number = 0
while True:
    data = sample.text_cdr(types, f"message {number}")
    writer.write(sample.LATCHED, time.time_ns(), number, data)
    print(time.monotonic_ns(), flush=True)
    number += 1
    time.sleep(period)
"""


def test_killed_recorders_lose_less_than_a_second(tmp_path: Path) -> None:
    draw = random.Random(5)
    delays = sorted(draw.uniform(0.3, 3.0) for _ in range(KILLS))
    recordings = [(tmp_path / f"k{n}", delay) for n, delay in enumerate(delays)]
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", KILLED, str(directory), str(draw.choice((0.005, 0.05)))],
            stdout=subprocess.PIPE,
            text=True,
        )
        for directory, _ in recordings
    ]
    for process in processes:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
    ready = time.monotonic()
    for (directory, delay), process in zip(recordings, processes, strict=True):
        time.sleep(max(0.0, ready + delay - time.monotonic()))
        os.kill(process.pid, signal.SIGKILL)
        killed_at = time.monotonic_ns()
        output, _ = process.communicate(timeout=20)
        written = [int(line) for line in output.split()]
        found = read_three_ways(directory)
        numbers = sorted(publish for _, _, publish, _ in found)
        assert numbers == list(range(len(numbers))), "a prefix, without holes"
        old = sum(stamp < killed_at - 1_000_000_000 for stamp in written)
        assert len(numbers) >= old, f"{old - len(numbers)} messages older than 1 s are lost"


def test_bag_in_work_is_not_touched_but_readable(tmp_path: Path) -> None:
    types = sample.store()
    bag = BagWriter(tmp_path / "live", flush_interval_s=0.05)
    bag.add_topic(sample.topic(sample.LATCHED))
    bag.write(sample.LATCHED, 5, 5, sample.text_cdr(types, "early"))
    deadline = time.monotonic() + 20
    while (reader := BagReader(tmp_path / "live")).message_count == 0:
        assert time.monotonic() < deadline
    assert reader.in_progress and not reader.damage
    with pytest.raises(BagInUseError, match="stop the recorder first"):
        recover(tmp_path / "live")
    bag.close()
    assert read_three_ways(tmp_path / "live").total() == 1


def test_flushed_messages_are_synced_to_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[int] = []
    real = os.fdatasync

    def observed(descriptor: int) -> None:
        size = os.fstat(descriptor).st_size
        real(descriptor)
        synced.append(size)

    monkeypatch.setattr(os, "fdatasync", observed)
    bag = BagWriter(tmp_path / NAME, flush_interval_s=0.05)
    bag.add_topic(sample.topic(sample.LATCHED))
    bag.write(sample.LATCHED, 5, 5, sample.text_cdr(sample.store(), "kept"))
    path = tmp_path / NAME / f"{NAME}_0.mcap.active"
    deadline = time.monotonic() + 20
    while not (synced and scan(path).index.chunks):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    while synced[-1] < path.stat().st_size:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    bag.close()


def test_metadata_lost_or_stale_is_rebuilt(tmp_path: Path) -> None:
    directory = sample.write_sample(tmp_path / NAME, split_ns=500_000_000)
    wanted = (directory / "metadata.yaml").read_text()
    whole = read_three_ways(directory)
    (directory / "metadata.yaml").unlink()
    assert read_three_ways(directory) == whole
    rebuilt = BagReader(directory)
    assert rebuilt.custom_data["seed"] == "7"
    stale = wanted.replace(f"- {NAME}_3.mcap\n", "")
    assert stale != wanted
    (directory / "metadata.yaml").write_text(stale)
    assert read_three_ways(directory) == whole
    (directory / "metadata.yaml").write_text("torn: [")
    assert read_three_ways(directory) == whole


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    mount = tmp_path / "disk"
    mount.mkdir()
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", str(mount)], capture_output=True
    )
    if done.returncode:
        pytest.skip(f"no right to mount a small file system: {done.stderr.decode().strip()}")
    yield mount
    subprocess.run(["umount", str(mount)], check=True)


def fill(directory: Path) -> tuple[BagWriter, int]:
    """Record until the disk refuses."""
    types = sample.store()
    bag = BagWriter(directory, flush_interval_s=0.02)
    for name in sample.TYPES:
        bag.add_topic(sample.topic(name))
    number = 0
    deadline = time.monotonic() + 60
    while bag.failure is None:
        assert time.monotonic() < deadline, "the disk never filled"
        block = sample.waveform(number, tuple(f"c{k}" for k in range(20)))
        bag.write(sample.WAVEFORM, block.stamp_ns, number, sample.waveform_cdr(types, block))
        number += 1
    bag.close()
    bag.close()
    return bag, number


def test_full_disk_stops_recording_with_a_valid_bag(small_disk: Path) -> None:
    bag, offered = fill(small_disk / NAME)
    assert "No space left" in str(bag.failure) and "recover" not in str(bag.failure)
    found = read_three_ways(small_disk / NAME)
    assert found.total() == bag.counts[sample.WAVEFORM] > 50
    assert bag.counts[sample.WAVEFORM] + bag.drops[sample.WAVEFORM] == offered
    assert not list((small_disk / NAME).glob("*.active"))
    assert not (small_disk / NAME / ".reserve").exists()


def test_full_disk_at_start_leaves_nothing_behind(small_disk: Path) -> None:
    filler = small_disk / "filler"
    with pytest.raises(OSError, match="No space"), filler.open("wb") as file:
        while True:
            file.write(bytes(4096))
            file.flush()
    with pytest.raises(OSError, match="No space"):
        BagWriter(small_disk / NAME)
    assert not (small_disk / NAME).exists()


def test_disk_eaten_by_others_even_the_reserve(
    small_disk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Somebody else fills the space the reserve gave back: the last chunks make room."""
    released = BagWriter._release_reserve

    def eaten(self: BagWriter) -> None:
        released(self)
        with (small_disk / "eater").open("wb") as file:
            while True:
                try:
                    os.write(file.fileno(), bytes(4096))
                except OSError:
                    return

    monkeypatch.setattr(BagWriter, "_release_reserve", eaten)
    bag, offered = fill(small_disk / NAME)
    (small_disk / "eater").unlink()
    found = read_three_ways(small_disk / NAME)
    assert 0 < found.total() == bag.counts[sample.WAVEFORM]
    assert bag.counts[sample.WAVEFORM] + bag.drops[sample.WAVEFORM] == offered


LIMITED = """
import resource, sys
from pathlib import Path
from tests.bag.test_faults import fill
from tests.bag import sample
from trackvib_ros.bag import writer
writer.CHUNK_BYTES = 50_000
for case in sys.argv[2:]:
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(case), resource.RLIM_INFINITY))
    bag, offered = fill(Path(sys.argv[1]) / case)
    print(case, offered, bag.counts[sample.WAVEFORM], bag.drops[sample.WAVEFORM], flush=True)
"""


def test_file_size_limits_stop_recording_with_a_valid_bag(tmp_path: Path) -> None:
    draw = random.Random(7)
    limits = [str(draw.randrange(300_000, 900_000)) for _ in range(LIMITS)]
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, str(tmp_path), *limits],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    for line in done.stdout.splitlines():
        name, offered, kept, dropped = line.split()
        assert int(kept) + int(dropped) == int(offered)
        assert read_three_ways(tmp_path / name).total() == int(kept) > 0
    assert len(done.stdout.splitlines()) == LIMITS


def test_locked_file_is_released_by_the_end_of_its_process(tmp_path: Path) -> None:
    file = McapFile(tmp_path / "a.mcap.active")
    file.close()
    shutil.move(tmp_path / "a.mcap.active", tmp_path / "b.mcap.active")
    assert recover(tmp_path).files[0].messages == 0
