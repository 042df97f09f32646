"""Where a channel is strong."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .pattern import Trace
from .record import Record

Array = NDArray[np.float64]

_AVERAGE_S = 0.04
_LEAST_SHARE = 0.25  # of that time, measured

STRONG, CORE = 1 / 16, 1 / 4
"""Of the strong energy: 12 and 6 dB below."""

CARRIED = 4.0
"""Strong energy before the first wheelset and behind the last (m): 0 to 3.4 m on computed rails."""


def strong(
    trace: Trace, bandwidth: float, within: tuple[float, float], below: float = STRONG
) -> NDArray[np.bool_]:
    """Bins whose energy in 40 ms stands out of the noise and within 12 dB of the strong ones.

    The fewer of these 40 ms were measured, the more must it stand out.
    """
    start, stop = trace.time - _AVERAGE_S / 2, trace.time + _AVERAGE_S / 2
    energy = trace.shown(start, stop)
    inside = (trace.time >= within[0]) & (trace.time <= within[1])
    if not inside.any():
        return inside
    top = float(np.percentile(energy[inside], 95))
    share = trace.coverage(start, stop)
    freedom = np.maximum(2 * bandwidth * _AVERAGE_S * share, 2.0)
    limit = np.maximum(trace.noise * (1 + 6 * np.sqrt(2 / freedom)), top * below)
    return np.asarray(inside & (energy > limit) & (share > _LEAST_SHARE))


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


def struck(trace: Trace, limited: Trace, within: tuple[float, float]) -> bool:
    """Whether blows, that ``limited`` lacks, carry more than half of the energy above the noise."""
    inside = (trace.time >= within[0]) & (trace.time <= within[1])
    total, lasts = (float(np.sum(t.energy[inside] - t.noise)) for t in (trace, limited))
    return lasts < 0.5 * total


def excited(record: Record, within: tuple[float, float]) -> bool:
    """Whether a channel shows energy well above its floor in an interval, on enough valid bins."""
    inside = (record.window.time >= within[0]) & (record.window.time <= within[1])
    inside &= record.window.valid
    if inside.sum() < 50:
        return False
    strongest = np.percentile(record.window.energy[inside], 98, axis=0)
    return bool(np.max(strongest / record.floor) > 3.0)
