"""Sensor and detector as separate processes: any order of start and end, accidents, neighbours."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
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
    place = ("--namespace", "north")
    sensor = processes.command("sensor", "--scenario", SCENARIO, "--headway", "1", *place)
    detector = processes.command("detect", *place)

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


def test_namespaces_and_domains_keep_sites_apart(
    graph: Graph, processes: Processes, tmp_path: Path
) -> None:
    """Two namespaces of one domain, and one of these names in another domain, at once."""
    own = int(os.environ["ROS_DOMAIN_ID"])
    neighbour = Graph(own + 70)
    sites = {
        (graph, own, "north"): 200,
        (graph, own, "south"): 120,
        (neighbour, own + 70, "north"): 160,
    }
    try:
        heard, clocks = {}, {}
        for site, speed in sites.items():
            tester, domain, name = site
            scenario = tmp_path / f"{speed}.toml"
            scenario.write_text(
                QUICK.read_text(encoding="utf-8").replace("200 km/h", f"{speed} km/h")
            )
            heard[site] = tester.listen(m.TRAIN_EVENTS, f"/{name}/{m.TRAIN_EVENTS.name}")
            clocks[site] = tester.listen(m.CLOCK, f"/{name}/clock")
            place = {"namespace": name, "ROS_DOMAIN_ID": str(domain)}
            recorded = {"record_directory": tmp_path / "bag"} if name == "south" else {}
            detector = processes.node("detector", use_sim_time=True, **recorded, **place)
            processes.node(
                "sensor", scenario=scenario, real_time_factor=0.0, await_detectors=1, **place
            )
            if recorded:
                recording = detector

        def all_heard() -> bool:
            neighbour.once()
            return all(passages(events) for events in heard.values())

        graph.until(all_heard, "a passage at every site")
        for site, speed in sites.items():
            (passage,) = passages(heard[site])
            # loose: whose train it is matters here, how well it is measured does not
            assert passage.values["speed"].value * 3.6 == pytest.approx(speed, rel=0.1)
            times = [m.from_stamp(message.clock) for message in clocks[site]]
            assert times == sorted(times)
        for tester, names in ((graph, ("north", "south")), (neighbour, ("north",))):
            wanted = [(node, f"/{name}") for name in names for node in ("detector", "sensor")]
            found = tester.tester.get_node_names_and_namespaces()
            assert sorted(found) == sorted([*wanted, ("tester", "/")])
            assert "/clock" not in dict(tester.tester.get_topic_names_and_types())
        recording.send_signal(signal.SIGINT)
        assert ended(recording) == (0, "")
        bag = BagReader(tmp_path / "bag")
        assert "/south/clock" in bag.topics
        assert bag.end_ns < 60_000_000_000  # logged in the simulated time of the site
    finally:
        neighbour.close()
