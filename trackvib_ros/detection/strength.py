"""Where a channel is strong."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .pattern import Trace
from .record import Record

Array = NDArray[np.float64]

STRONG, CORE = 1 / 16, 1 / 4
"""Of the strong energy: 12 and 6 dB below."""

CARRIED = 4.0
"""Strong energy before the first wheelset and behind the last (m): 0 to 3.4 m on computed rails."""


def smoothed(trace: Trace, width_s: float) -> Array:
    """Energy averaged over ``width_s`` about every bin."""
    return trace.mean(trace.time - width_s / 2, trace.time + width_s / 2)


def _measured(trace: Trace, width_s: float) -> Array:
    """Part of ``width_s`` about every bin that was measured."""
    return trace.coverage(trace.time - width_s / 2, trace.time + width_s / 2)


def strong(
    trace: Trace, bandwidth: float, within: tuple[float, float], below: float = STRONG
) -> NDArray[np.bool_]:
    """Bins whose 40 ms energy stands out of the noise and within 12 dB of the strong ones."""
    energy = smoothed(trace, 0.04)
    inside = (trace.time >= within[0]) & (trace.time <= within[1])
    if not inside.any():
        return inside
    top = float(np.percentile(energy[inside], 95))
    freedom = np.maximum(2 * bandwidth * 0.04 * _measured(trace, 0.04), 2.0)
    limit = np.maximum(trace.noise * (1 + 6 * np.sqrt(2 / freedom)), top * below)
    return np.asarray(inside & (energy > limit))


def strong_interval(
    trace: Trace, bandwidth: float, within: tuple[float, float], below: float = STRONG
) -> tuple[float, float] | None:
    """First and last strong energy (s)."""
    found = np.flatnonzero(strong(trace, bandwidth, within, below))
    if found.size < 2:
        return None
    return float(trace.time[found[0]]), float(trace.time[found[-1]])


def quiet_gaps(
    trace: Trace, bandwidth: float, interval: tuple[float, float], least_s: float
) -> list[tuple[float, float]]:
    """Stretches without strong energy, at least ``least_s`` long, inside an interval."""
    times = trace.time[strong(trace, bandwidth, interval)]
    if times.size < 2:
        return []
    gaps = np.diff(times)
    return [(float(times[i]), float(times[i + 1])) for i in np.flatnonzero(gaps > least_s)]


def excited(record: Record, within: tuple[float, float]) -> bool:
    """Whether a channel shows energy well above its floor in an interval, on enough valid bins."""
    inside = (record.window.time >= within[0]) & (record.window.time <= within[1])
    inside &= record.window.valid
    if inside.sum() < 50:
        return False
    strongest = np.percentile(record.window.energy[inside], 98, axis=0)
    return bool(np.max(strongest / record.floor) > 3.0)
