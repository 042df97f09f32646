"""A small bag with three topics, made without ROS."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from trackvib_ros import pointcloud
from trackvib_ros.bag import BagWriter, Qos, Topic, message_definition, type_hash
from trackvib_ros.waveform import Waveform

START_NS = 1_000_000_000
BLOCK_NS = 20_000_000
DT_NS = 100_000
WAVEFORM, LATCHED, EMPTY = "/rail/waveform", "/scenario", "/never"
TYPES = {
    WAVEFORM: "sensor_msgs/msg/PointCloud2",
    LATCHED: "std_msgs/msg/String",
    EMPTY: "geometry_msgs/msg/AccelStamped",
}


def topic(name: str) -> Topic:
    qos = Qos(durability="transient_local" if name == LATCHED else "volatile")
    return Topic(name, TYPES[name], message_definition(TYPES[name]), type_hash(TYPES[name]), (qos,))


def store() -> Any:
    types = get_typestore(Stores.EMPTY)
    for name in TYPES.values():
        types.register(get_types_from_msg(message_definition(name), name))
    return types


def waveform(number: int, channels: tuple[str, ...] = ("rail_mid", "slab_mid")) -> Waveform:
    random = np.random.default_rng(number)
    data = random.normal(0, 30, (BLOCK_NS // DT_NS, len(channels))).astype(np.float32)
    return Waveform(START_NS + number * BLOCK_NS, DT_NS, channels, data, "rail")


def waveform_cdr(types: Any, block: Waveform) -> bytes:
    fields, step, data = pointcloud.encode(block)
    cloud = types.types["sensor_msgs/msg/PointCloud2"]
    field = types.types["sensor_msgs/msg/PointField"]
    header = types.types["std_msgs/msg/Header"]
    time = types.types["builtin_interfaces/msg/Time"]
    message = cloud(
        header=header(
            stamp=time(sec=block.stamp_ns // 10**9, nanosec=block.stamp_ns % 10**9),
            frame_id=block.frame_id,
        ),
        height=1,
        width=block.data.shape[0],
        fields=[field(f.name, f.offset, f.datatype, f.count) for f in fields],
        is_bigendian=False,
        point_step=step,
        row_step=len(data),
        data=np.frombuffer(data, np.uint8),
        is_dense=True,
    )
    return bytes(types.serialize_cdr(message, "sensor_msgs/msg/PointCloud2"))


def text_cdr(types: Any, text: str) -> bytes:
    message = types.types["std_msgs/msg/String"](data=text)
    return bytes(types.serialize_cdr(message, "std_msgs/msg/String"))


def write_sample(directory: Path, blocks: int = 100, **options: Any) -> Path:
    types = store()
    writer = BagWriter(
        directory, custom_data={"scenario": "speed = 83.3\n", "seed": "7"}, **options
    )
    for name in TYPES:
        writer.add_topic(topic(name))
    writer.write(LATCHED, START_NS, START_NS + 5, text_cdr(types, "speed = 83.3"))
    for number in range(blocks):
        block = waveform(number)
        assert writer.write(
            WAVEFORM, block.stamp_ns, block.stamp_ns + 11, waveform_cdr(types, block)
        )
    writer.close()
    assert writer.failure is None
    return directory
