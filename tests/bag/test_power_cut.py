"""Power cuts: the disk as it is at a random moment, without what the page cache still holds.

A file system in an image file is copied while a recorder writes to it, and the copy is mounted:
its journal is replayed as after a power cut. Needs the right to mount.
"""

from __future__ import annotations

import os
import random
import shutil
import subprocess
import threading
import time
from pathlib import Path

import pytest

from tests.bag import sample
from trackvib_ros.bag import BagReader, BagWriter

pytestmark = pytest.mark.slow

CUTS = 8


def mount(image: Path, place: Path) -> None:
    place.mkdir(exist_ok=True)
    done = subprocess.run(["mount", "-o", "loop", image, place], capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"no right to mount an image: {done.stderr.strip()}")


@pytest.mark.parametrize(("rate_hz", "size"), [(20, 200), (1800, 4600)])
def test_nothing_older_than_a_second_is_lost(tmp_path: Path, rate_hz: int, size: int) -> None:
    if shutil.which("mkfs.ext4") is None:
        pytest.skip("mkfs.ext4 is not installed")
    image, disk = tmp_path / "disk.img", tmp_path / "disk"
    with image.open("wb") as file:
        file.truncate(64 << 20)
    subprocess.run(["mkfs.ext4", "-q", image], check=True)
    mount(image, disk)
    sent: list[float] = []
    ended = threading.Event()
    types, filler = sample.store(), os.urandom(size // 2).hex()
    draw = random.Random(rate_hz)
    cuts: list[tuple[Path, float]] = []
    try:
        writer = BagWriter(disk / "bag")
        writer.add_topic(sample.topic(sample.LATCHED))

        def record() -> None:
            begin = time.monotonic()
            while not ended.is_set():
                number = len(sent)
                sent.append(time.monotonic())
                writer.write(sample.LATCHED, number, 0, sample.text_cdr(types, filler))
                time.sleep(max(0.0, begin + len(sent) / rate_hz - time.monotonic()))

        source = threading.Thread(target=record)
        source.start()
        for number in range(CUTS):
            time.sleep(draw.uniform(0.1, 0.7))
            cuts.append((tmp_path / f"cut_{number}.img", time.monotonic()))
            shutil.copyfile(image, cuts[-1][0])
        ended.set()
        source.join()
        writer.close()
    finally:
        subprocess.run(["umount", disk], check=True)
    for copy, at in cuts:
        mount(copy, disk)
        try:
            found = [message.log_time_ns for message in BagReader(disk / "bag").messages()]
            assert found == list(range(len(found))), "a prefix, without holes"
            assert len(found) >= sum(stamp < at - 1.0 for stamp in sent)
        finally:
            subprocess.run(["umount", disk], check=True)
