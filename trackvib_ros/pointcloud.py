"""A waveform as the bytes of a ``sensor_msgs/PointCloud2`` table, without ROS.

One row per sample: field ``t`` (seconds after the stamp), then one field per channel in m/s², all
FLOAT32 and little-endian. The node and the bag reader share these two functions.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from solver import InputError
from trackvib_ros.waveform import Waveform

FLOAT32 = 7
"""``sensor_msgs/PointField.FLOAT32``."""

TIME_FIELD = "t"
MAX_DT_NS = 8_000_000
"""Longest interval that FLOAT32 times carry to the nanosecond: dt * 2**-24 < 0.5 ns (ns)."""
_TIME_TOLERANCE = 1e-6
"""Largest deviation of a row from the constant interval (of that interval)."""


@dataclass(frozen=True, slots=True)
class PointField:
    """One column of the table, with the members of ``sensor_msgs/PointField``."""

    name: str
    offset: int
    datatype: int = FLOAT32
    count: int = 1


class PointFieldLike(Protocol):
    """A column as rclpy or a bag's typestore presents it."""

    @property
    def name(self) -> str:
        """Column name."""

    @property
    def offset(self) -> int:
        """Bytes from the start of the row."""

    @property
    def datatype(self) -> int:
        """Code of ``sensor_msgs/PointField``."""


def encode(waveform: Waveform) -> tuple[tuple[PointField, ...], int, bytes]:
    """Return ``(fields, point_step, data)``; ``point_step`` is the bytes of one row.

    Raises:
        InputError: the block has fewer than two samples (its interval would be lost), the interval
            is too long, or a channel is called ``t``.
    """
    samples, channels = waveform.data.shape
    if samples < 2:
        raise InputError(
            f"waveform block at stamp {waveform.stamp_ns} ns has {samples} sample(s): a block "
            "needs at least 2 to carry its sampling interval; publish longer blocks"
        )
    if not 0 < waveform.dt_ns <= MAX_DT_NS:
        raise InputError(
            f"waveform block has dt_ns = {waveform.dt_ns} ns: must be greater than 0 and at most "
            f"{MAX_DT_NS} ns (125 Hz), or its FLOAT32 times do not tell it exactly"
        )
    if channels != len(waveform.channels) or TIME_FIELD in waveform.channels:
        raise InputError(
            f"channels {waveform.channels} do not name {channels} columns other than "
            f"'{TIME_FIELD}': give each column one name"
        )
    table = np.empty((samples, 1 + channels), dtype="<f4")
    table[:, 0] = np.arange(samples) * (waveform.dt_ns * 1e-9)
    table[:, 1:] = waveform.data
    names = (TIME_FIELD, *waveform.channels)
    fields = tuple(PointField(name, 4 * column) for column, name in enumerate(names))
    return fields, 4 * len(names), table.tobytes()


def decode(
    stamp_ns: int,
    fields: Sequence[PointFieldLike],
    point_step: int,
    data: bytes | bytearray | memoryview | array[int] | NDArray[np.uint8],
    frame_id: str = "",
) -> Waveform:
    """Return the block of a table that :func:`encode` or any driver following it has made.

    The interval is the mean of the ``t`` column rounded to whole nanoseconds: rounding the last
    time to FLOAT32 changes it by at most dt * 2**-24.

    Raises:
        InputError: field ``t`` is missing, a field is not FLOAT32, fewer than two rows, a broken
            row, or rows that are not equally spaced.
    """
    by_name = {field.name: field for field in fields}
    if TIME_FIELD not in by_name or len(by_name) != len(fields):
        raise InputError(
            f"point cloud has fields {[field.name for field in fields]}: a waveform block needs "
            f"'{TIME_FIELD}' (s after the stamp) and one differently named field per channel"
        )
    for field in fields:
        if field.datatype != FLOAT32 or field.offset + 4 > point_step:
            raise InputError(
                f"field '{field.name}' has datatype {field.datatype} at byte {field.offset} of "
                f"{point_step}: a waveform block holds FLOAT32 (datatype {FLOAT32}) only"
            )
    raw = np.frombuffer(data, np.uint8)
    if point_step <= 0 or raw.size % point_step or raw.size < 2 * point_step:
        raise InputError(
            f"point cloud data of {raw.size} bytes with point_step {point_step} bytes: "
            "a waveform block has at least two whole rows"
        )
    table = raw.view(
        np.dtype(
            {
                "names": [field.name for field in fields],
                "formats": ["<f4"] * len(fields),
                "offsets": [field.offset for field in fields],
                "itemsize": point_step,
            }
        )
    )
    seconds = table[TIME_FIELD].astype(np.float64)
    mean_ns = (seconds[-1] - seconds[0]) * 1e9 / (seconds.size - 1)
    dt_ns = round(mean_ns) if np.isfinite(mean_ns) else 0
    deviation = np.abs(seconds - np.arange(seconds.size) * (dt_ns * 1e-9))
    allowed = max(_TIME_TOLERANCE * dt_ns * 1e-9, 2.0**-23 * abs(seconds[-1]))
    if dt_ns <= 0 or not np.all(deviation <= allowed):
        raise InputError(
            f"field '{TIME_FIELD}' of the block at {stamp_ns} ns is not equally spaced from 0 s "
            f"(mean interval {dt_ns} ns, largest deviation {float(np.max(deviation)):.3g} s)"
        )
    channels = tuple(field.name for field in fields if field.name != TIME_FIELD)
    columns = np.empty((seconds.size, len(channels)), dtype=np.float32)
    for column, name in enumerate(channels):
        columns[:, column] = table[name]
    return Waveform(stamp_ns, dt_ns, channels, columns, frame_id)
