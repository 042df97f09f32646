"""Writing and reading back, checked by the project's reader, mcap and rosbags."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader

from solver import InputError
from tests.bag import sample
from trackvib_ros.bag import BagReader, BagWriter, message_definition, type_hash


def test_messages_come_back_as_written(bag: Path) -> None:
    reader = BagReader(bag)
    messages = list(reader.messages())
    assert not reader.damage and reader.recovery is None
    assert len(messages) == reader.message_count == 101
    assert [m.log_time_ns for m in messages] == sorted(m.log_time_ns for m in messages)
    types = sample.store()
    waves = [m for m in messages if m.topic == sample.WAVEFORM]
    for number, message in enumerate(waves):
        block = sample.waveform(number)
        assert message.log_time_ns == block.stamp_ns
        assert message.publish_time_ns == block.stamp_ns + 11
        assert message.data == sample.waveform_cdr(types, block)
    latched = next(m for m in messages if m.topic == sample.LATCHED)
    assert reader.decode(latched).data == "speed = 83.3"


def test_waveforms_are_decoded_exactly(bag: Path) -> None:
    for number, block in enumerate(BagReader(bag).waveforms(sample.WAVEFORM)):
        wanted = sample.waveform(number)
        assert (block.stamp_ns, block.dt_ns) == (wanted.stamp_ns, wanted.dt_ns)
        assert (block.channels, block.frame_id) == (wanted.channels, wanted.frame_id)
        np.testing.assert_array_equal(block.data, wanted.data)
    assert number == 99


def test_topics_metadata_and_custom_data(bag: Path) -> None:
    reader = BagReader(bag)
    assert {name: info.count for name, info in reader.topics.items()} == {
        sample.WAVEFORM: 100,
        sample.LATCHED: 1,
        sample.EMPTY: 0,
    }
    assert reader.topics[sample.LATCHED].topic.qos[0].durability == "transient_local"
    assert reader.custom_data["scenario"] == "speed = 83.3\n"
    assert reader.custom_data["seed"] == "7"
    single = BagReader(reader.files[0])
    assert single.custom_data == reader.custom_data
    assert single.message_count == 101


def test_existing_directory_is_refused(bag: Path) -> None:
    before = sorted(p.name for p in bag.iterdir())
    with pytest.raises(InputError, match=r"not overwritten.*-o"):
        BagWriter(bag)
    assert sorted(p.name for p in bag.iterdir()) == before


def test_two_independent_readers_agree(bag: Path) -> None:
    own = list(BagReader(bag).messages())
    with (bag / "passage_0.mcap").open("rb") as file:
        theirs = [
            (channel.topic, schema.name, message.log_time, message.publish_time, message.data)
            for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages()
        ]
    assert sorted(map(tuple, own)) == sorted(theirs)
    with Reader(bag) as other:
        assert other.message_count == len(own)
        raw = [(c.topic, c.msgtype, t, bytes(d)) for c, t, d in other.messages()]
    assert sorted((m.topic, m.type, m.log_time_ns, m.data) for m in own) == sorted(raw)


def test_split_by_time_and_size(tmp_path: Path) -> None:
    by_time = BagReader(sample.write_sample(tmp_path / "t", split_ns=500_000_000))
    assert len(by_time.files) == 4
    assert [f.name for f in by_time.files] == [f"t_{n}.mcap" for n in range(4)]
    assert by_time.message_count == 101
    whole = BagReader(sample.write_sample(tmp_path / "w"))
    assert list(by_time.messages()) == list(whole.messages())
    spans = [
        (f["starting_time"]["nanoseconds_since_epoch"], f["duration"]["nanoseconds"])
        for f in by_time.metadata["files"]
    ]
    assert all(duration < 500_000_000 for _, duration in spans)
    with Reader(tmp_path / "t") as other:
        assert sum(1 for _ in other.messages()) == 101


def test_time_and_topic_filters(bag: Path) -> None:
    reader = BagReader(bag)
    start = sample.START_NS + 10 * sample.BLOCK_NS
    chosen = list(
        reader.messages((sample.WAVEFORM,), start_ns=start, end_ns=start + 5 * sample.BLOCK_NS)
    )
    assert [m.log_time_ns for m in chosen] == [start + k * sample.BLOCK_NS for k in range(5)]
    with pytest.raises(InputError, match="/nowhere is not in"):
        list(reader.messages(("/nowhere",)))


def test_definition_joins_dependencies_once() -> None:
    text = message_definition("sensor_msgs/msg/PointCloud2")
    names = [line[5:] for line in text.splitlines() if line.startswith("MSG: ")]
    assert names == [
        "sensor_msgs/PointField",
        "std_msgs/Header",
        "builtin_interfaces/Time",
    ]
    assert type_hash("std_msgs/msg/String").startswith("RIHS01_")
    with pytest.raises(InputError, match="install the package"):
        message_definition("nowhere_msgs/msg/Nothing")
