"""Nodes under test: as processes, or within the test, with deadlines instead of sleeps."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import Trigger

from trackvib_ros.environment import complete
from trackvib_ros.process import Stop

DEADLINE_S = 120.0
QUICK = Path(__file__).with_name("quick.toml")
FIRST_DOMAIN = 11


class NeverStop(Stop):
    """Leaves the signals of the test runner alone."""

    def __init__(self) -> None:
        self._signal = None


def own_domain(monkeypatch: pytest.MonkeyPatch, offset: int = 0) -> int:
    worker = os.environ.get("PYTEST_XDIST_WORKER", "gw0")
    number = FIRST_DOMAIN + 10 * offset + int(worker.removeprefix("gw")) % 10
    monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
    monkeypatch.setenv("ROS_PYTHON_CHECK_FIELDS", "1")
    monkeypatch.delenv("FASTRTPS_DEFAULT_PROFILES_FILE", raising=False)
    settings: dict[str, str] = {}
    complete(settings)
    for name in ("ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTRTPS_DEFAULT_PROFILES_FILE"):
        monkeypatch.setenv(name, settings[name])
    return number


class Graph:
    """ROS inside the test: nodes that are spun, and told to work, while something is awaited.

    Args:
        domain: of the tester; that of the environment if not given.
    """

    def __init__(self, domain: int | None = None) -> None:
        self._context = None if domain is None else Context()
        rclpy.init(
            args=[],
            context=self._context,
            domain_id=domain,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        self.executor = SingleThreadedExecutor(context=self._context)
        self.workers: list[Any] = []
        self.nodes: list[Node] = []
        self.tester = self.add(
            rclpy.create_node("tester", context=self._context, start_parameter_services=False)
        )

    def add(self, node: Node) -> Any:
        self.executor.add_node(node)
        self.nodes.append(node)
        if hasattr(node, "work"):
            self.workers.append(node)
        return node

    def once(self) -> None:
        if not self.workers:
            self.executor.spin_once(timeout_sec=0.05)
            return
        for worker in self.workers:
            worker.work()
        for _ in range(5):
            self.executor.spin_once(timeout_sec=0)
        self.executor.spin_once(timeout_sec=0.001)

    def until(self, condition: Callable[[], Any], what: str) -> None:
        end = time.monotonic() + DEADLINE_S
        while not condition():
            assert time.monotonic() < end, f"{what} did not happen within {DEADLINE_S} s"
            self.once()

    def call(self, kind: type, name: str, request: Any) -> Any:
        client = self.tester.create_client(kind, name)
        self.until(client.service_is_ready, f"service {name}")
        future = client.call_async(request)
        self.until(future.done, f"answer of {name}")
        self.tester.destroy_client(client)
        return future.result()

    def trigger(self, name: str) -> Any:
        return self.call(Trigger, name, Trigger.Request())

    def listen(self, topic: Any, name: str | None = None) -> list[Any]:
        heard: list[Any] = []
        self.tester.create_subscription(topic.type, name or topic.name, heard.append, topic.qos)
        return heard

    def close(self) -> None:
        self.executor.shutdown()
        for node in self.nodes:
            node.destroy_node()
        rclpy.try_shutdown(context=self._context)


def graph_of_test() -> Iterator[Graph]:
    graph = Graph()
    yield graph
    graph.close()


class Processes:
    """Starts processes; none outlives the test."""

    def __init__(self) -> None:
        self._started: list[subprocess.Popen[str]] = []

    def start(
        self, *arguments: str, program: str = sys.executable, **environment: str
    ) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [program, *arguments],
            env={**os.environ, **environment},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        self._started.append(process)
        return process

    def command(self, *arguments: str, **environment: str) -> subprocess.Popen[str]:
        code = "from trackvib_ros.cli import main; main()"
        return self.start("-c", code, *arguments, **environment)

    def executable(self, path: Path, *arguments: str) -> subprocess.Popen[str]:
        """A script that finds this Python as ``python3`` on the PATH."""
        search = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        return self.start(*arguments, program=str(path), PATH=search)

    def node(
        self, name: str, *, namespace: str = "", ROS_DOMAIN_ID: str = "", **parameters: object
    ) -> subprocess.Popen[str]:
        arguments = ["-m", "trackvib_ros.start", name, "--ros-args", "-p", "autostart:=true"]
        if namespace:
            arguments += ["-r", f"__ns:=/{namespace}", "-r", "/clock:=clock"]
        for key, setting in parameters.items():
            text = str(setting).lower() if isinstance(setting, bool) else str(setting)
            arguments += ["-p", f"{key}:={text}"]
        domain = ROS_DOMAIN_ID or os.environ["ROS_DOMAIN_ID"]
        return self.start(*arguments, ROS_DOMAIN_ID=domain)

    def close(self) -> None:
        for process in self._started:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            if process.stdout is not None and not process.stdout.closed:
                output, _ = process.communicate()
                print(process.args[1:4], process.returncode, output)  # pytest shows it on failure


def processes_of_test() -> Iterator[Processes]:
    processes = Processes()
    yield processes
    processes.close()


def ended(process: subprocess.Popen[str]) -> tuple[int, str]:
    output, _ = process.communicate(timeout=DEADLINE_S)
    return process.returncode, output


def descendants(session: int) -> list[int]:
    """Processes whose environment carries the marker of a test (its process group is their own)."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                text = (entry / "environ").read_bytes()
            except OSError:
                continue
            if f"TRACKVIB_TEST_MARK={session}".encode() in text.split(b"\0"):
                found.append(int(entry.name))
    return found
