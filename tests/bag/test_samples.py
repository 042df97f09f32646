"""Every sample bag: contents, truth, live events, the detector's result today, three readers."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from solver import load_scenario, load_scenario_text
from tests.bag.conformance import NpmReader, check_bag, npm
from trackvib_ros.bag import BagReader
from trackvib_ros.detection import Channel, Estimate, TrainDetector, TrainEvent
from trackvib_ros.report import PassageReport, match
from trackvib_ros.waveform import Waveform

__all__ = ["npm"]

BAGS = Path(__file__).parents[2] / "bags"
NAMES = ("demo", "metro", "double", "succession", "noise")
MAX_BYTES = 10_000_000
SPEED_TOLERANCE = 0.005
"""The largest standard uncertainty that the detector states for these recordings is 0.4 % (noise)."""


@pytest.fixture(params=NAMES)
def bag(request: pytest.FixtureRequest) -> Path:
    return BAGS / str(request.param)


def blocks(reader: BagReader) -> list[tuple[int, Waveform]]:
    """All waveform blocks with their log times, in the order of the bag."""
    found = []
    for topic in [name for name in reader.topics if name.endswith("/waveform")]:
        times = [message.log_time_ns for message in reader.messages((topic,))]
        found += list(zip(times, reader.waveforms(topic), strict=True))
    return sorted(found, key=lambda entry: entry[0])


def test_set_is_small_and_complete() -> None:
    assert {path.name for path in BAGS.iterdir() if (path / "metadata.yaml").is_file()} == set(
        NAMES
    )
    total = sum(path.stat().st_size for name in NAMES for path in (BAGS / name).iterdir())
    assert total <= MAX_BYTES


def test_intact_and_self_describing(bag: Path) -> None:
    reader = BagReader(bag)
    assert reader.recovery is None and reader.verify() == []
    source = bag.with_suffix(".toml")
    wanted = load_scenario(str(source) if source.exists() else bag.name)
    stored = load_scenario_text(reader.custom_data["scenario"])
    assert stored == wanted, "the bag alone reproduces itself, and the file beside it too"
    assert f"irregularity.seed = {wanted.irregularity.seed}" in reader.custom_data["seed"]
    assert reader.custom_data["trackvib_version"]
    (latched,) = reader.messages(("/scenario",))
    assert reader.decode(latched).data == reader.custom_data["scenario"]


def test_waveforms_are_gapless(bag: Path) -> None:
    reader = BagReader(bag)
    wanted = {
        sensor.channel: sensor
        for sensor in load_scenario_text(reader.custom_data["scenario"]).sensor
    }
    seen: set[str] = set()
    for topic in [name for name in reader.topics if name.endswith("/waveform")]:
        waves = list(reader.waveforms(topic))
        assert all(one.end_ns == following.stamp_ns for one, following in pairwise(waves))
        for column, name in enumerate(waves[0].channels):
            samples = np.concatenate([wave.data[:, column] for wave in waves])
            assert waves[0].dt_ns * wanted[name].rate == 10**9
            assert np.nanmax(np.abs(samples)) <= wanted[name].range
            missing = np.isnan(samples).mean()
            if wanted[name].dropout_rate:
                assert missing < 3 * wanted[name].dropout_rate * wanted[name].dropout_duration
            else:
                assert missing == 0.0
            seen.add(name)
    assert seen == set(wanted)


def test_truth_is_that_of_the_scenario(bag: Path) -> None:
    scenario = load_scenario_text(BagReader(bag).custom_data["scenario"])
    truths = PassageReport(bag).truths
    assert len(truths) == len(scenario.train)
    for truth, train in zip(truths, scenario.train, strict=True):
        assert (truth.train_type, truth.direction) == (train.preset, train.direction)
        assert truth.axle_count == len(train.axle_positions)
        assert truth.speed_m_s["rail_a"] == pytest.approx(train.speed, rel=1e-7)


def check_events(bag: Path, events: list[TrainEvent]) -> None:
    report = PassageReport(bag)
    matches = match(report.truths, events)
    kinds = [event.kind for event in events]
    assert kinds.count("passage") == kinds.count("arrival") == len(matches), "no train too many"
    for found in matches:
        assert found.event is not None, f"train {found.truth.train} missed"
        values = found.event.values
        assert values["direction"] == found.truth.direction
        assert values["axle_count"] == found.truth.axle_count
        speed = values["speed"]
        assert isinstance(speed, Estimate)
        true = found.truth.speed_m_s["rail_a"]
        assert speed.value == pytest.approx(true, rel=SPEED_TOLERANCE)


def test_events_recorded_live(bag: Path) -> None:
    check_events(bag, PassageReport(bag).events)


def test_detector_of_today(bag: Path) -> None:
    reader = BagReader(bag)
    scenario = load_scenario_text(reader.custom_data["scenario"])
    by_name = {channel.name: channel for channel in scenario.channel}
    detector = TrainDetector(
        [
            Channel(s.channel, scenario.channel_x(by_name[s.channel]), by_name[s.channel].layer)  # type: ignore[arg-type]
            for s in scenario.sensor
        ]
    )
    events: list[TrainEvent] = []
    for _, block in blocks(reader):
        events += detector.process(block)
    check_events(bag, events + detector.finish())


def test_three_independent_readers_agree(bag: Path, npm: NpmReader) -> None:
    rows = check_bag(bag, npm)
    assert len(rows) == BagReader(bag).message_count > 1000
