"""Recording load, measured: ``python tests/bench_recording.py [writers|middleware|detector]``.

The stream is 1800 messages of 4.6 kB per second (8.3 MB/s), vibration as a 16-bit converter gives
it: 18 sensor groups at 100 blocks per second. ``writers`` compares the CPU time of the bag writer
with the writers of ``mcap`` and ``rosbags`` on it; ``middleware`` records it from a publisher in
another process, in multiples of the rate, then as fast as it is taken; ``detector`` shows what
recording adds to the detector's process.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

TOPICS, RATE_HZ, SAMPLES, CHANNELS = 18, 100, 160, 6
SECONDS = 8.0
CONSOLE = Console()


def payloads() -> list[bytes]:
    """One second of all topics: tables of ``t`` and six channels, quantised to 16 bits.

    All differ, so that nothing repeats within a chunk.
    """
    random = np.random.default_rng(1)
    blocks = []
    for _ in range(RATE_HZ * TOPICS):
        table = np.empty((SAMPLES, 1 + CHANNELS), np.float32)
        table[:, 0] = np.arange(SAMPLES) * 62.5e-6
        signal = random.normal(0.0, 20.0, (SAMPLES, CHANNELS))
        table[:, 1:] = np.round(signal / 0.15) * 0.15
        blocks.append(table.tobytes())
    return blocks


def cloud_bytes() -> list[bytes]:
    """The payloads as serialized ``sensor_msgs/PointCloud2``."""
    from rclpy.serialization import serialize_message

    return [bytes(serialize_message(cloud(block))) for block in payloads()]


def cloud(block: bytes) -> object:
    """A ``sensor_msgs/PointCloud2`` around a payload."""
    from array import array

    from sensor_msgs.msg import PointCloud2, PointField

    message = PointCloud2(height=1, width=SAMPLES, point_step=4 * (1 + CHANNELS))
    message.fields = [
        PointField(name=f"c{k}", offset=4 * k, datatype=7, count=1) for k in range(1 + CHANNELS)
    ]
    message.row_step = len(block)
    message.data = array("B", block)
    return message


def bench_writers() -> None:
    """CPU of each writer for the stream, in percent of one core at real time."""
    from mcap.writer import CompressionType, Writer
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
    from rosbags.rosbag2 import Writer as RosbagsWriter
    from rosbags.typesys import Stores, get_typestore

    from trackvib_ros.bag import BagWriter, Topic, message_definition, type_hash

    blocks = cloud_bytes()
    kind = "sensor_msgs/msg/PointCloud2"
    names = [f"/group_{k}/waveform" for k in range(TOPICS)]
    count = int(SECONDS) * RATE_HZ

    def trackvib(directory: Path) -> None:
        writer = BagWriter(directory)
        for name in names:
            writer.add_topic(Topic(name, kind, message_definition(kind), type_hash(kind)))
        for k in range(count):
            while writer.room < 1 << 20:
                time.sleep(0.001)
            for n, name in enumerate(names):
                writer.write(name, k * 10**7, k * 10**7, blocks[k % RATE_HZ * TOPICS + n])
        writer.close()
        assert not writer.drops

    def mcap(directory: Path) -> None:
        directory.mkdir()
        with (directory / "a.mcap").open("wb") as file:
            writer = Writer(file, compression=CompressionType.ZSTD)
            writer.start("ros2")
            schema = writer.register_schema(kind, "ros2msg", message_definition(kind).encode())
            channels = [writer.register_channel(name, "cdr", schema) for name in names]
            for k in range(count):
                for n, channel in enumerate(channels):
                    block = blocks[k % RATE_HZ * TOPICS + n]
                    writer.add_message(channel, k * 10**7, block, k * 10**7)
            writer.finish()

    def rosbags(directory: Path) -> None:
        store = get_typestore(Stores.ROS2_JAZZY)
        writer = RosbagsWriter(directory, version=9, storage_plugin=StoragePlugin.MCAP)
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        with writer:
            connections = [writer.add_connection(name, kind, typestore=store) for name in names]
            for k in range(count):
                for n, connection in enumerate(connections):
                    writer.write(connection, k * 10**7, blocks[k % RATE_HZ * TOPICS + n])

    table = Table("writer, zstd", "CPU at real time (% of a core)", "MB on disk", "MB/s flat out")
    for function in (trackvib, mcap, rosbags):
        table.add_row(function.__name__, *measured(function, blocks))
    CONSOLE.print(table)


def measured(function: Callable[[Path], None], blocks: list[bytes]) -> tuple[str, str, str]:
    """CPU share, size and speed of one writer; the best of three."""
    scratch = Path(tempfile.mkdtemp())
    best, wall = float("inf"), float("inf")
    size = 0
    for run in range(3):
        cpu, began = time.process_time(), time.perf_counter()
        function(scratch / f"{run}")
        best = min(best, time.process_time() - cpu)
        wall = min(wall, time.perf_counter() - began)
        size = sum(path.stat().st_size for path in (scratch / f"{run}").iterdir())
    shutil.rmtree(scratch)
    total = int(SECONDS) * sum(map(len, blocks))
    return (f"{100 * best / SECONDS:.1f}", f"{size / 1e6:.1f}", f"{total / wall / 1e6:.0f}")


PUBLISHER = """
import sys, time
import rclpy
from rclpy.qos import HistoryPolicy, QoSProfile
from sensor_msgs.msg import PointCloud2
from tests.bench_recording import RATE_HZ, TOPICS, cloud, payloads
factor, seconds = float(sys.argv[1]), float(sys.argv[2])
rclpy.init()
node = rclpy.create_node("source")
qos = QoSProfile(depth=1000) if factor else QoSProfile(history=HistoryPolicy.KEEP_ALL)
clouds = [cloud(block) for block in payloads()]
publishers = [node.create_publisher(PointCloud2, f"g{k}/waveform", qos) for k in range(TOPICS)]
while any(p.get_subscription_count() == 0 for p in publishers):
    time.sleep(0.01)
time.sleep(1.0)
begin = time.perf_counter()
count = late = 0
while time.perf_counter() - begin < seconds:
    for n, publisher in enumerate(publishers):
        while True:
            try:
                publisher.publish(clouds[count % RATE_HZ * TOPICS + n])
                break
            except Exception:
                pass
    count += 1
    if factor:
        due = begin + count / (RATE_HZ * factor)
        late = max(late, time.perf_counter() - due)
        time.sleep(max(0.0, due - time.perf_counter()))
wall = time.perf_counter() - begin
for publisher in publishers:
    publisher.wait_for_all_acked()
print(count * TOPICS, wall, late, flush=True)
time.sleep(1.0)
"""


def bench_middleware() -> None:
    """Record from another process at multiples of the rate, and as fast as it is taken."""
    import rclpy

    from trackvib_ros.recorder import Recorder

    os.environ["ROS_DOMAIN_ID"] = "59"
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    table = Table("publisher", "messages/s", "MB/s", "sent", "lost", "recorder's CPU (%)")
    size = len(cloud_bytes()[0])
    for factor in (1.0, 2.0, 3.0, 4.0, 0.0):
        scratch = Path(tempfile.mkdtemp())
        rclpy.init(args=[])
        node = rclpy.create_node("recorder")
        recorder = Recorder(node, scratch / "bag")
        process = subprocess.Popen(
            [sys.executable, "-c", PUBLISHER, str(factor), str(SECONDS)],
            stdout=subprocess.PIPE,
            text=True,
        )
        begun = 0.0
        while process.poll() is None:
            if recorder.poll() and not begun:
                begun = time.process_time()
            time.sleep(0.005)
        recorder.close()
        used = time.process_time() - begun
        assert process.stdout is not None
        sent_text, wall_text, _ = process.stdout.read().split()
        sent, wall = int(sent_text), float(wall_text)
        kept = sum(n for topic, n in recorder.counts.items() if topic.endswith("/waveform"))
        assert sent - kept == sum(recorder.drops.values()), "every loss is counted"
        table.add_row(
            f"{factor:g} x real time" if factor else "unlimited history, flat out",
            f"{sent / wall:.0f}",
            f"{sent * size / wall / 1e6:.1f}",
            str(sent),
            str(sent - kept),
            f"{100 * used / wall:.0f}",
        )
        node.destroy_node()
        rclpy.try_shutdown()
        shutil.rmtree(scratch)
    CONSOLE.print(table)


def bench_detector() -> None:
    """CPU time of the detector's process on a replay of the demo bag, with and without a bag."""
    os.environ["ROS_DOMAIN_ID"] = "58"
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    bag = Path(__file__).parents[1] / "bags" / "demo"
    trackvib = [sys.executable, "-c", "from trackvib_ros.cli import main; main()"]
    waits = [part for g in ("rail", "slab", "bridge") for part in ("--wait-for", f"/{g}/waveform")]
    table = Table("detector", "CPU of its process (s), best of three")
    for recording in (False, True):
        best = float("inf")
        for _ in range(3):
            scratch = Path(tempfile.mkdtemp())
            options = ["--record", str(scratch / "bag")] if recording else []
            detector = subprocess.Popen([*trackvib, "detect", *options])
            subprocess.run([*trackvib, "replay", str(bag), "--rate", "4", *waits], check=True)
            detector.send_signal(signal.SIGINT)
            _, status, usage = os.wait4(detector.pid, 0)
            assert status == 0
            best = min(best, usage.ru_utime + usage.ru_stime)
            shutil.rmtree(scratch)
        table.add_row("recording" if recording else "alone", f"{best:.2f}")
    CONSOLE.print(table)


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))
    os.environ["PYTHONPATH"] = str(Path(__file__).parents[1])
    wanted = sys.argv[1:] or ["writers", "middleware", "detector"]
    if "writers" in wanted:
        bench_writers()
    if "middleware" in wanted:
        bench_middleware()
    if "detector" in wanted:
        bench_detector()
