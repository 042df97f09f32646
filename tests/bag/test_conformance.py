"""What this project writes, read by three independent readers, one of them JavaScript."""

from __future__ import annotations

import base64
from pathlib import Path

from tests.bag import sample
from tests.bag.conformance import NpmReader, check_bag, npm
from trackvib_ros.bag import recover

__all__ = ["npm"]


def test_three_readers_agree_on_every_value(bag: Path, npm: NpmReader) -> None:
    rows = check_bag(bag, npm)
    blocks = [row["value"] for row in rows if row["topic"] == sample.WAVEFORM]
    assert len(blocks) == 100
    for number, value in enumerate(blocks):
        wanted = sample.waveform(number)
        stamp = value["header"]["stamp"]
        assert stamp["sec"] * 10**9 + stamp["nanosec"] == wanted.stamp_ns
        assert base64.b64decode(value["data"]) == sample.pointcloud.encode(wanted)[2]


def test_split_and_recovered_bags_too(tmp_path: Path, npm: NpmReader) -> None:
    split = sample.write_sample(tmp_path / "split", blocks=40, split_ns=250_000_000)
    assert len(check_bag(split, npm)) == 41
    last = max(split.glob("*.mcap"))
    torn = last.with_name(last.name + ".active")
    last.rename(torn)
    torn.write_bytes(torn.read_bytes()[:-200])
    recover(split)
    assert len(check_bag(split, npm)) == 41
