"""Recording from and replaying to real DDS, across processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")
import rclpy
from geometry_msgs.msg import AccelStamped
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String

from solver import InputError
from tests.bag import sample
from tests.ros.harness import own_domain
from trackvib_ros.bag import BagReader, BagWriter
from trackvib_ros.cli import main
from trackvib_ros.outbox import RCLError
from trackvib_ros.recorder import Recorder

pytestmark = pytest.mark.ros

DEADLINE_S = 60.0
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
STREAM = QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE)
BEST_EFFORT = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)


@pytest.fixture
def domain(monkeypatch: pytest.MonkeyPatch) -> int:
    return own_domain(monkeypatch, offset=6)


@pytest.fixture
def node(domain: int) -> Iterator[Node]:
    rclpy.init(args=[])
    node = rclpy.create_node("tester", start_parameter_services=False)
    yield node
    node.destroy_node()
    rclpy.try_shutdown()


def until(
    condition: Callable[[], Any],
    what: str,
    work: Callable[[], Any] | None = None,
    *,
    deadline_s: float = DEADLINE_S,
) -> None:
    end = time.monotonic() + deadline_s
    while not condition():
        assert time.monotonic() < end, f"{what} did not happen within {deadline_s} s"
        if work is not None:
            work()
        time.sleep(0.002)


Command = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def command() -> Iterator[Command]:
    """Starts ``trackvib`` processes; none outlives its test."""
    started: list[subprocess.Popen[str]] = []

    def start(*arguments: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-c", "from trackvib_ros.cli import main; main()", *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        started.append(process)
        return process

    yield start
    for process in started:
        if process.poll() is None:
            process.kill()
            process.wait()


def ended(process: subprocess.Popen[str]) -> tuple[int, str]:
    output, _ = process.communicate(timeout=DEADLINE_S)
    return process.returncode, output


def acceleration(number: int) -> AccelStamped:
    message = AccelStamped()
    message.header.stamp.nanosec = number
    message.header.frame_id = f"sensor {number}"
    message.accel.linear.z = number * 0.5
    return message


def test_record_command_takes_every_topic_also_late_ones(
    node: Node, tmp_path: Path, command: Command
) -> None:
    bag = tmp_path / "run"
    stream = node.create_publisher(AccelStamped, "site/acceleration", STREAM)
    state = node.create_publisher(String, "site/scenario", LATCHED)
    state.publish(String(data='title = "test"\n[roughness]\nseed = 11\n'))
    process = command("record", "-o", str(bag), "--custom-data", "operator=me")
    until(lambda: stream.get_subscription_count() == 1, "subscription of the recorder")
    until(lambda: state.get_subscription_count() == 1, "subscription of the recorder")
    for number in range(500):
        stream.publish(acceleration(number))
    late = node.create_publisher(String, "/late", BEST_EFFORT)
    until(lambda: late.get_subscription_count() == 1, "subscription to the late topic")
    for number in range(20):
        late.publish(String(data=f"late {number}"))
        time.sleep(0.001)
    assert stream.wait_for_all_acked()
    until(
        lambda: BagReader(bag).topics.get("/late") and BagReader(bag).topics["/late"].count == 20,
        "recording of the late topic",
    )
    process.send_signal(signal.SIGINT)
    status, output = ended(process)
    assert status == 0, output
    assert "lost" in output and "were lost" not in output

    reader = BagReader(bag)
    assert reader.recovery is None and reader.verify() == []
    values = [reader.decode(m) for m in reader.messages(("/site/acceleration",))]
    assert [(v.header.stamp.nanosec, v.header.frame_id, v.accel.linear.z) for v in values] == [
        (number, f"sensor {number}", number * 0.5) for number in range(500)
    ]
    assert [reader.decode(m).data for m in reader.messages(("/late",))] == [
        f"late {number}" for number in range(20)
    ]
    topics = reader.topics
    assert topics["/site/scenario"].topic.qos[0].durability == "transient_local"
    assert topics["/late"].topic.qos[0].reliability == "best_effort"
    assert topics["/site/acceleration"].topic.qos[0].reliability == "reliable"
    assert reader.custom_data["operator"] == "me"
    assert reader.custom_data["seed"] == "roughness.seed = 11"
    assert reader.custom_data["scenario"].startswith('title = "test"')
    assert all(m.log_time_ns >= m.publish_time_ns for m in reader.messages())


def test_simulated_time_of_the_log(node: Node, tmp_path: Path) -> None:
    state = node.create_publisher(String, "/scenario", LATCHED)
    stream = node.create_publisher(AccelStamped, "/acceleration", STREAM)
    clock = node.create_publisher(Clock, "/clock", 10)
    state.publish(String(data="x"))
    recorder = Recorder(node, tmp_path / "sim", use_sim_time=True)
    wanted = {"/scenario", "/acceleration", "/clock"}
    until(lambda: wanted <= set(recorder.topics), "discovery", recorder.poll)
    until(
        lambda: all(p.get_subscription_count() == 1 for p in (state, stream, clock)),
        "subscriptions of the recorder",
    )
    assert state.wait_for_all_acked()
    stream.publish(acceleration(0))
    assert stream.wait_for_all_acked()
    for step in range(1, 51):
        # Wait for the first message, so that the order of arrival is the order of publication.
        message = Clock()
        message.clock.nanosec = step * 1_000_000
        clock.publish(message)
        until(lambda s=step: recorder.counts.get("/clock") == s, "clock", recorder.poll)
        stream.publish(acceleration(step))
        until(lambda s=step: recorder.counts.get("/acceleration") == s + 1, "data", recorder.poll)
    recorder.close()
    assert recorder.failure is None and recorder.drops == {}
    reader = BagReader(tmp_path / "sim")
    times = {name: [m.log_time_ns for m in reader.messages((name,))] for name in wanted}
    assert times["/scenario"] == [1_000_000], "kept until the clock began"
    assert times["/clock"] == [step * 1_000_000 for step in range(1, 51)]
    assert times["/acceleration"] == [1_000_000, *times["/clock"]]
    assert all(m.publish_time_ns > 10**18 for m in reader.messages())


def test_recording_from_its_own_thread_beside_a_busy_executor(node: Node, tmp_path: Path) -> None:
    recorder = Recorder(node, tmp_path / "threaded", exclude=("/parameter_events", "/rosout"))
    recorder.start()
    executor = rclpy.executors.SingleThreadedExecutor()
    executor.add_node(node)
    calls = []
    node.create_timer(0.01, lambda: calls.append(time.sleep(0.05)))
    stream = node.create_publisher(AccelStamped, "/acceleration", STREAM)
    until(
        lambda: stream.get_subscription_count() == 1,
        "subscription",
        lambda: executor.spin_once(timeout_sec=0.01),
    )
    for number in range(2000):
        stream.publish(acceleration(number))
        if number % 100 == 0:
            executor.spin_once(timeout_sec=0.0)
    until(lambda: recorder.counts.get("/acceleration") == 2000, "recording")
    recorder.close()
    recorder.close()
    assert recorder.topics == () and recorder.drops == {} and calls
    reader = BagReader(tmp_path / "threaded")
    assert list(reader.topics) == ["/acceleration"]
    stamps = [reader.decode(m).header.stamp.nanosec for m in reader.messages()]
    assert stamps == list(range(2000))


def test_losses_are_counted_and_several_publishers_are_none(node: Node, tmp_path: Path) -> None:
    """A recorder that does not poll loses messages once the middleware is full, and says so."""
    recorder = Recorder(node, tmp_path / "slow", topics=["/acceleration", "/shared"])
    lossy = node.create_publisher(AccelStamped, "/acceleration", 10)
    shared = [node.create_publisher(String, "/shared", STREAM) for _ in range(2)]
    publishers = [lossy, *shared]
    until(lambda: all(p.get_subscription_count() == 1 for p in publishers), "match", recorder.poll)
    for number in range(7000):
        lossy.publish(acceleration(number))
    for number in range(50):
        shared[number % 3 // 2].publish(String(data=f"{number}"))
    until(lambda: recorder.counts.get("/shared") == 50, "shared topic", recorder.poll)
    sent = [7000]

    def one_more() -> None:
        lossy.publish(acceleration(sent[0]))
        sent[0] += 1
        recorder.poll()
        time.sleep(0.1)

    until(lambda: recorder.drops, "a number that shows what is missing", one_more)

    def complete() -> bool:
        recorder.poll()
        return recorder.counts["/acceleration"] + recorder.drops["/acceleration"] == sent[0]

    until(complete, "all messages received or counted as lost")
    recorder.close()
    assert set(recorder.drops) == {"/acceleration"}


def test_existing_directory_is_refused_with_status_2(
    domain: int, tmp_path: Path, command: Command
) -> None:
    (tmp_path / "there").mkdir()
    status, output = ended(command("record", "-o", str(tmp_path / "there")))
    assert status == 2
    assert "not overwritten" in output and "-o" in output and "Traceback" not in output
    assert list((tmp_path / "there").iterdir()) == []


def test_full_disk_stops_recording_while_the_process_goes_on(
    node: Node, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The kernel refuses every write beyond a size, as a full disk does."""
    real = os.pwrite

    def refused(descriptor: int, data: bytes, offset: int) -> int:
        if offset + len(data) > 2_000_000:
            raise OSError(28, "No space left on device")
        return real(descriptor, data, offset)

    recorder = Recorder(node, tmp_path / "full", flush_interval_s=0.02)
    recorder.start()
    monkeypatch.setattr(os, "pwrite", refused)
    stream = node.create_publisher(String, "/noise", STREAM)
    until(lambda: stream.get_subscription_count() == 1, "subscription")
    while recorder.failure is None:
        with suppress(RCLError):  # while the recorder is behind
            stream.publish(String(data=os.urandom(2000).hex()))
    assert "No space left" in recorder.failure
    until(lambda: stream.get_subscription_count() == 0, "end of the subscription")
    monkeypatch.undo()
    recorder.close()
    reader = BagReader(tmp_path / "full")
    assert reader.recovery is None and reader.verify() == []
    kept = sum(1 for _ in reader.messages(("/noise",)))
    assert kept == recorder.counts["/noise"] > 0


def replayed(
    command: Command, node: Node, bag: Path, *arguments: str, topic: str = sample.WAVEFORM
) -> list[tuple[bytes, int]]:
    """Bytes and arrival times of one replayed topic."""
    received: list[tuple[bytes, int]] = []
    from sensor_msgs.msg import PointCloud2

    subscription = node.create_subscription(PointCloud2, topic, print, STREAM, raw=True)
    process = command("replay", str(bag), "--wait-for", topic, *arguments)

    def take() -> None:
        with subscription.handle:
            while (
                taken := subscription.handle.take_message(subscription.msg_type, True)
            ) is not None:
                received.append((taken[0], taken[1]["source_timestamp"]))

    until(lambda: process.poll() is not None, "end of the replay", take)
    take()
    status, output = ended(process)
    assert status == 0, output
    node.destroy_subscription(subscription)
    return received


def unpadded(received: list[tuple[bytes, int]], wanted: list[bytes]) -> list[bytes]:
    """Without the up to three bytes by which DDS fills a message to a multiple of four."""
    assert all(
        0 <= len(data) - len(original) < 4
        for (data, _), original in zip(received, wanted, strict=True)
    )
    return [data[: len(original)] for (data, _), original in zip(received, wanted, strict=True)]


def stored(bag: Path, topic: str = sample.WAVEFORM) -> list[bytes]:
    return [message.data for message in BagReader(bag).messages((topic,))]


def test_replay_at_full_speed_loses_nothing(node: Node, tmp_path: Path, command: Command) -> None:
    bag = sample.write_sample(tmp_path / "long", blocks=3000)
    received = replayed(command, node, bag, "--rate", "max", "--topics", sample.WAVEFORM)
    assert unpadded(received, stored(bag)) == stored(bag)


def test_replay_keeps_the_rhythm_and_renames(node: Node, tmp_path: Path, command: Command) -> None:
    bag = sample.write_sample(tmp_path / "short", blocks=60)
    received = replayed(
        command,
        node,
        bag,
        *("--rate", "2", "--remap", f"{sample.WAVEFORM}:=/elsewhere"),
        *("--start-offset", "0.2", "--playback-duration", "0.8"),
        topic="/elsewhere",
    )
    assert unpadded(received, stored(bag)[10:50]) == stored(bag)[10:50]
    # Never early: the pace is bounded below by the log times, above only by the machine.
    sent = [stamp for _, stamp in received]
    assert sent[-1] - sent[0] >= 39 * sample.BLOCK_NS / 2 - 5_000_000


def test_replay_offers_the_stored_qos_and_latched_state(
    node: Node, tmp_path: Path, command: Command
) -> None:
    bag = sample.write_sample(tmp_path / "state", blocks=100)
    texts: list[str] = []
    node.create_subscription(String, sample.LATCHED, lambda m: texts.append(m.data), LATCHED)
    process = command("replay", str(bag), "--start-offset", "1.5", "--clock")
    clocks: list[int] = []
    node.create_subscription(
        Clock, "/clock", lambda m: clocks.append(m.clock.sec * 10**9 + m.clock.nanosec), BEST_EFFORT
    )
    offered = []

    def look() -> None:
        rclpy.spin_once(node, timeout_sec=0.01)
        found = node.get_publishers_info_by_topic(sample.LATCHED)
        if found and not offered:
            offered.append(found[0].qos_profile.durability)

    until(lambda: process.poll() is not None, "end of the replay", look)
    status, output = ended(process)
    assert status == 0, output
    assert texts == ["speed = 83.3"], "the state before the offset, once"
    assert offered == [DurabilityPolicy.TRANSIENT_LOCAL]
    start = sample.START_NS + 1_500_000_000
    end = sample.START_NS + 99 * sample.BLOCK_NS
    assert clocks == sorted(clocks) and len(clocks) > 5
    assert start <= clocks[0] and clocks[-1] <= end


def test_replay_pauses_resumes_and_loops(node: Node, tmp_path: Path, command: Command) -> None:
    from std_srvs.srv import Trigger

    bag = sample.write_sample(tmp_path / "loop", blocks=10)
    received: list[Any] = []
    from sensor_msgs.msg import PointCloud2

    node.create_subscription(PointCloud2, sample.WAVEFORM, received.append, STREAM)
    process = command("replay", str(bag), "--pause", "--loop", "--rate", "10")
    clients = {
        name: node.create_client(Trigger, f"/trackvib_replay/{name}")
        for name in ("pause", "resume")
    }

    def spin() -> None:
        rclpy.spin_once(node, timeout_sec=0.01)

    def call(name: str) -> None:
        until(clients[name].service_is_ready, f"service {name}", spin)
        # An answer can be lost while the two are still discovering each other: ask again.
        asked: list[tuple[float, Any]] = []

        def ask() -> None:
            if not asked or time.monotonic() > asked[-1][0] + 2.0:
                asked.append((time.monotonic(), clients[name].call_async(Trigger.Request())))
            spin()

        until(lambda: any(future.done() for _, future in asked), f"answer of {name}", ask)

    until(clients["resume"].service_is_ready, "service", spin)
    until(lambda: node.count_publishers(sample.WAVEFORM) == 1, "publisher", spin)
    assert received == []
    call("resume")
    until(lambda: len(received) >= 25, "two and a half rounds", spin)
    call("pause")
    process.send_signal(signal.SIGTERM)
    status, output = ended(process)
    assert status == 0, output
    stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in received[:20]]
    once = [sample.waveform(number).stamp_ns for number in range(10)]
    assert stamps == once + once


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("replay", "nowhere"), ("nowhere", "does not exist")),
        (("replay", "BAG", "--rate", "-1"), ("--rate -1", "greater than 0")),
        (("replay", "BAG", "--topics", "/no"), ("/no", "is not in", sample.WAVEFORM)),
        (("replay", "BAG", "--remap", "/a/b"), ("--remap /a/b", ":=")),
        (("record", "-o", "new", "-b", "0"), ("--max-bag-size 0 MB", "greater than 0")),
    ],
)
def test_wrong_arguments_are_told(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    words: tuple[str, ...],
) -> None:
    monkeypatch.chdir(tmp_path)
    bag = sample.write_sample(tmp_path / "bag", blocks=3)
    filled = [str(bag) if argument == "BAG" else argument for argument in arguments]
    monkeypatch.setattr("sys.argv", ["trackvib", *filled])
    with pytest.raises(SystemExit) as ending:
        main()
    assert ending.value.code == 2
    flat = " ".join(capsys.readouterr().err.split())
    for word in words:
        assert word in flat
    assert not Path("new").exists()


def test_other_definitions_are_not_published(node: Node, tmp_path: Path) -> None:
    from dataclasses import replace

    from trackvib_ros.replay import Player, ReplayOptions

    writer = BagWriter(tmp_path / "other")
    writer.add_topic(replace(sample.topic(sample.LATCHED), type_hash="RIHS01_" + "0" * 64))
    writer.write(sample.LATCHED, 1, 1, sample.text_cdr(sample.store(), "x"))
    writer.close()
    with pytest.raises(InputError, match="another definition of std_msgs/msg/String"):
        Player(node, BagReader(tmp_path / "other"), ReplayOptions())
