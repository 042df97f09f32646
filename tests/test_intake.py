"""The intake over several topics: restarts, leftovers, silence."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy")
from sensor_msgs.msg import PointCloud2

from solver import InputError
from tests.detection.synthetic import CATALOGUE, RAILS, Passage, blocks, record
from trackvib_ros import messages as m
from trackvib_ros.detection import Calibration, Channel
from trackvib_ros.intake import Intake
from trackvib_ros.waveform import Waveform

pytestmark = pytest.mark.ros
CHANNELS = {"a/waveform": [Channel("a", 0.0, "rail")], "b/waveform": [Channel("b", 9.0, "bridge")]}
BLOCK_NS = 20_000_000


def block(name: str, k: int) -> PointCloud2:
    data = np.full((20, 1), 0.01, np.float32)
    return m.waveform_message(Waveform(k * BLOCK_NS, 1_000_000, (name,), data, name))


def feed(intake: Intake, name: str, numbers: range) -> None:
    for k in numbers:
        intake.take(f"{name}/waveform", block(name, k))


def test_one_restart_for_all_topics_and_nothing_of_the_new_run_is_lost() -> None:
    intake = Intake(CHANNELS)
    feed(intake, "a", range(1000, 1100))
    feed(intake, "b", range(1000, 1090))
    feed(intake, "a", range(0, 10))  # the sensor was reset
    assert intake.restarts == 1
    assert intake.blocks["a/waveform"] == 110
    feed(intake, "b", range(1090, 1100))  # still on their way from the old run
    assert intake.blocks["b/waveform"] == 90
    assert intake.refused["b/waveform: of an earlier run"] == 10
    feed(intake, "b", range(0, 10))
    assert intake.restarts == 1
    assert intake.blocks["b/waveform"] == 100
    assert not intake.gaps


def test_one_topic_that_was_silent_comes_back_among_the_others() -> None:
    intake = Intake(CHANNELS)
    feed(intake, "a", range(0, 100))
    feed(intake, "b", range(0, 100))
    feed(intake, "a", range(100, 3300))
    feed(intake, "b", range(3300, 3310))  # silent for 64 s: longer than a gap
    assert intake.restarts == 1
    feed(intake, "a", range(3300, 3310))
    assert intake.blocks["a/waveform"] == 3310
    assert intake.blocks["b/waveform"] == 110


def test_a_single_odd_stamp_is_dropped_and_a_short_silence_is_a_gap() -> None:
    intake = Intake(CHANNELS)
    feed(intake, "a", range(0, 50))
    for odd in (10, 10**6, 11, 10**7):
        feed(intake, "a", range(odd, odd + 1))
    feed(intake, "a", range(50, 60))
    assert intake.restarts == 0
    assert intake.refused == {"a/waveform: in the past": 2, "a/waveform: far in the future": 2}
    feed(intake, "a", range(110, 120))
    assert intake.gaps == {"a/waveform": 1}
    assert intake.missing_ns == {"a/waveform": 50 * BLOCK_NS}
    warning, figures = intake.state(["b/waveform"])
    assert warning is not None
    assert "no publisher on b/waveform" in warning and "1.000 s missing" in warning
    assert figures["refused"] == 4


def test_jitter_of_the_stamps_is_neither_gap_nor_past() -> None:
    intake = Intake(CHANNELS)
    for k in range(100):
        message = block("a", k)
        message.header.stamp = m.to_stamp(10**9 + k * BLOCK_NS + (k * 7919) % 400_000)
        intake.take("a/waveform", message)
    assert intake.blocks["a/waveform"] == 100
    assert not intake.refused and not intake.gaps


def test_what_passages_teach_outlives_the_process(tmp_path: Path) -> None:
    file = tmp_path / "site.json"
    rails = {"rail/waveform": list(RAILS)}
    train = record([Passage(CATALOGUE["metro"].axles, 45.0)], RAILS, 30, 0, kind="pulse")
    intake = Intake(rails, file)
    for data in blocks(train, 0.5):
        intake.take("rail/waveform", m.waveform_message(replace(data, frame_id="rail")))
    learned = Calibration.load(file)  # kept as soon as the train is told
    intake.finish()
    assert learned.passages == 1
    # neither the end of the stream nor of the process forgets it
    assert intake.detector.calibration.to_json() == learned.to_json()
    assert Intake(rails, file).detector.calibration.to_json() == learned.to_json()
    moved = {"rail/waveform": [RAILS[0], replace(RAILS[1], x=RAILS[1].x + 0.5)]}
    with pytest.raises(InputError, match=r"learned with .* at x = 20.0 m"):
        Intake(moved, file)
    with pytest.raises(InputError, match="no directory"):
        Intake(rails, tmp_path / "nowhere" / "site.json")
    assert Calibration.load(file).to_json() == learned.to_json()


def test_a_file_that_cannot_be_written_is_told_and_events_are_not_lost(tmp_path: Path) -> None:
    file = tmp_path / "here" / "site.json"
    file.parent.mkdir()
    intake = Intake({"rail/waveform": list(RAILS)}, file)
    file.parent.rmdir()
    train = record([Passage(CATALOGUE["metro"].axles, 45.0)], RAILS, 30, 0, kind="pulse")
    events = []
    for data in blocks(train, 0.5):
        events += intake.take("rail/waveform", m.waveform_message(replace(data, frame_id="rail")))
    events += intake.finish()
    assert [e.values["type"] for e in events if e.kind == "passage"] == ["metro"]
    warning, _ = intake.state([])
    assert warning is not None
    assert "cannot be written" in warning
