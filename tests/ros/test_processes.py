"""Sensor and detector as separate processes: any order of start and end, accidents, neighbours."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")

from tests.ros.harness import (
    QUICK,
    Graph,
    Processes,
    ended,
    graph_of_test,
    own_domain,
    processes_of_test,
)
from tests.ros.test_nodes import figures, warning
from trackvib_ros import messages as m
from trackvib_ros.bag import BagReader

pytestmark = pytest.mark.ros
processes = pytest.fixture(processes_of_test)
SCENARIO = str(QUICK)


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> Iterator[Graph]:
    own_domain(monkeypatch, offset=2)
    yield from graph_of_test()


def passages(heard: list[Any]) -> list[Any]:
    return [e for message in heard for e in m.read_events(message) if e.kind == "passage"]


def test_order_of_start_does_not_matter_and_both_end_on_signals(
    graph: Graph, processes: Processes
) -> None:
    events = graph.listen(m.TRAIN_EVENTS)
    rail = graph.listen(m.waveform_topic("rail"))
    diagnostics = graph.listen(m.DIAGNOSTICS)
    # the sensor comes first and waits for a detector on all waveforms
    sensor = processes.node("sensor", scenario=SCENARIO, real_time_factor=0.0, await_detectors=1)
    graph.until(lambda: figures(diagnostics, "sensor: simulation"), "the sensor")
    assert rail == []
    detector = processes.node("detector", use_sim_time=True)
    graph.until(lambda: passages(events), "the passage")
    # the detector is started anew while the sensor goes on
    detector.send_signal(signal.SIGTERM)
    assert ended(detector) == (0, "")
    detector = processes.node("detector", use_sim_time=True)
    graph.until(
        lambda: (
            "waiting" not in warning(diagnostics, "detector: input")
            and figures(diagnostics, "detector: input").get("blocks rail/waveform", "0") == "0"
        ),
        "the second detector",
    )
    assert graph.trigger("sensor/trigger_passage").success
    graph.until(lambda: len(passages(events)) >= 2, "the second passage")
    # the sensor is killed without a word: the detector lives on and says so
    sensor.kill()
    graph.until(
        lambda: "no publisher on" in warning(diagnostics, "detector: input"), "the complaint"
    )
    detector.send_signal(signal.SIGINT)
    assert ended(detector) == (0, "")


def test_killed_detector_is_missed_by_the_sensor_which_goes_on(
    graph: Graph, processes: Processes
) -> None:
    diagnostics = graph.listen(m.DIAGNOSTICS)
    sensor = processes.command("sensor", "--scenario", SCENARIO, "--headway", "1")
    detector = processes.command("detect")

    def blocks() -> int:
        return int(figures(diagnostics, "detector: input").get("blocks rail/waveform", "0"))

    graph.until(lambda: blocks() > 10, "waveforms at the detector")
    graph.until(
        lambda: (
            figures(diagnostics, "sensor: publishing").get("subscriptions rail/waveform") == "1"
        ),
        "subscription",
    )
    detector.send_signal(signal.SIGKILL)
    graph.until(
        lambda: "subscriptions lost on rail/waveform" in warning(diagnostics, "sensor: publishing"),
        "the sensor's complaint",
    )

    def time() -> float:
        return float(figures(diagnostics, "sensor: simulation")["time_s"])

    before = time()
    graph.until(lambda: time() > before + 0.5, "further simulated time")
    sensor.send_signal(signal.SIGINT)
    status, text = ended(sensor)
    assert status == 0, text


def test_domains_keep_two_sites_apart(
    graph: Graph, processes: Processes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same names in two ROS domains on one machine, at once."""
    own = int(os.environ["ROS_DOMAIN_ID"])
    foreign = own + 70
    other = tmp_path / "other.toml"
    other.write_text(QUICK.read_text(encoding="utf-8").replace("200 km/h", "120 km/h"))
    neighbour = Graph(foreign)
    try:
        heard = [site.listen(m.TRAIN_EVENTS) for site in (graph, neighbour)]
        clocks = [site.listen(m.CLOCK) for site in (graph, neighbour)]
        for domain, scenario in ((own, SCENARIO), (foreign, str(other))):
            monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
            processes.node("detector", use_sim_time=True)
            processes.node("sensor", scenario=scenario, real_time_factor=0.0, await_detectors=1)

        def both_heard() -> bool:
            neighbour.once()
            return all(passages(events) for events in heard)

        graph.until(both_heard, "a passage in both domains")
        for site, events, clock, speed in zip(
            (graph, neighbour), heard, clocks, (200, 120), strict=True
        ):
            (passage,) = passages(events)
            # loose: whose train it is matters here, how well it is measured does not
            assert passage.values["speed"].value * 3.6 == pytest.approx(speed, rel=0.1)
            names = [name for name, _ in site.tester.get_node_names_and_namespaces()]
            assert sorted(names) == ["detector", "sensor", "tester"]
            assert site.tester.count_publishers("/clock") == 1
            times = [m.from_stamp(message.clock) for message in clock]
            assert times == sorted(times)
    finally:
        neighbour.close()


def test_namespaces_keep_two_sites_apart(
    graph: Graph, processes: Processes, tmp_path: Path
) -> None:
    other = tmp_path / "other.toml"
    other.write_text(QUICK.read_text(encoding="utf-8").replace("200 km/h", "120 km/h"))
    heard: dict[str, list[Any]] = {}
    clocks: dict[str, list[Any]] = {}
    detectors: dict[str, Any] = {}
    for site, scenario in (("north", SCENARIO), ("south", str(other))):
        heard[site] = graph.listen(m.TRAIN_EVENTS, f"/{site}/{m.TRAIN_EVENTS.name}")
        clocks[site] = graph.listen(m.CLOCK, f"/{site}/clock")
        processes.command("sensor", "-s", scenario, "-n", site, "--real-time-factor", "2")
        detectors[site] = processes.command("detect", "-n", site, "-o", str(tmp_path / site))
    found: Callable[[str], list[Any]] = lambda site: passages(heard[site])  # noqa: E731
    graph.until(lambda: found("north") and found("south"), "a passage at both sites")
    speeds = {site: found(site)[0].values["speed"].value * 3.6 for site in heard}
    # loose: whose train it is matters here, how well it is measured does not
    assert speeds["north"] == pytest.approx(200, rel=0.1)
    assert speeds["south"] == pytest.approx(120, rel=0.1)
    assert len(found("north")) == len(found("south")) == 1
    for site in heard:
        times = [m.from_stamp(message.clock) for message in clocks[site]]
        assert times == sorted(times)
        detectors[site].send_signal(signal.SIGINT)
        assert ended(detectors[site]) == (0, "")
        bag = BagReader(tmp_path / site)
        assert f"/{site}/clock" in bag.topics
        assert bag.end_ns < 60_000_000_000  # logged in the simulated time of the site
    assert "/clock" not in dict(graph.tester.get_topic_names_and_types())
