"""The table of a waveform block, there and back."""

from __future__ import annotations

from array import array
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from solver import InputError
from trackvib_ros.pointcloud import FLOAT32, MAX_DT_NS, PointField, decode, encode
from trackvib_ros.waveform import Waveform


def block(dt_ns: int = 100_000, samples: int = 5) -> Waveform:
    data = np.arange(2 * samples, dtype=np.float32).reshape(samples, 2)
    return Waveform(123_456_789_012, dt_ns, ("rail_a", "rail_b"), data, "rail")


@given(
    dt_ns=st.integers(1_000, MAX_DT_NS), samples=st.integers(2, 2000), stamp=st.integers(0, 2**62)
)
def test_interval_and_samples_come_back_exactly(dt_ns: int, samples: int, stamp: int) -> None:
    wanted = replace(block(dt_ns, samples), stamp_ns=stamp)
    wanted.data[samples // 2, 1] = np.nan
    fields, step, data = encode(wanted)
    assert (step, len(data)) == (12, 12 * samples)
    for raw in (data, bytearray(data), array("B", data), np.frombuffer(data, np.uint8)):
        found = decode(stamp, fields, step, raw, "rail")
        assert (found.stamp_ns, found.dt_ns, found.channels) == (stamp, dt_ns, wanted.channels)
        np.testing.assert_array_equal(found.data, wanted.data)


def test_fields_may_come_in_any_order_with_padding() -> None:
    rows = np.zeros((3, 5), "<f4")
    rows[:, 4] = [0.0, 0.001, 0.002]
    rows[:, 1] = [7.0, 8.0, 9.0]
    found = decode(5, (PointField("axle", 4), PointField("t", 16)), 20, rows.tobytes())
    assert found.channels == ("axle",) and found.dt_ns == 1_000_000
    assert found.data[:, 0].tolist() == [7.0, 8.0, 9.0]


def table(times: list[float]) -> bytes:
    return np.array([[t, 1.0] for t in times], "<f4").tobytes()


@pytest.mark.parametrize(
    ("fields", "step", "data", "words"),
    [
        ((PointField("a", 0),), 4, bytes(8), "needs 't'"),
        ((PointField("t", 0), PointField("t", 4)), 8, table([0, 1e-3]), "differently named"),
        ((PointField("t", 0), PointField("a", 4, FLOAT32 + 1)), 8, table([0, 1e-3]), "FLOAT32"),
        ((PointField("t", 0), PointField("a", 8)), 8, table([0, 1e-3]), "'a'"),
        ((PointField("t", 0), PointField("a", 4)), 8, table([0, 1e-3])[:-1], "two whole rows"),
        ((PointField("t", 0), PointField("a", 4)), 8, table([0]), "two whole rows"),
        ((PointField("t", 0), PointField("a", 4)), 0, b"", "FLOAT32"),
        ((PointField("t", 0), PointField("a", 4)), 8, table([0, 1e-3, 3e-3]), "equally spaced"),
        ((PointField("t", 0), PointField("a", 4)), 8, table([1e-3, 0]), "equally spaced"),
        ((PointField("t", 0), PointField("a", 4)), 8, table([0, float("nan")]), "equally spaced"),
    ],
)
def test_other_tables_are_refused(
    fields: tuple[PointField, ...], step: int, data: bytes, words: str
) -> None:
    with pytest.raises(InputError, match=words):
        decode(0, fields, step, data)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (block(samples=1), "at least 2"),
        (block(dt_ns=MAX_DT_NS + 1), "125 Hz"),
        (replace(block(), channels=("t", "a")), "other than"),
        (replace(block(), channels=("a",)), "do not name 2 columns"),
    ],
)
def test_blocks_that_would_not_come_back_are_refused(wrong: Waveform, words: str) -> None:
    with pytest.raises(InputError, match=words):
        encode(wrong)
