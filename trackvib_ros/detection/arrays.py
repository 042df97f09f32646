"""The detector on plain arrays, of any unit and with times as files have them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from solver import InputError
from trackvib_ros.waveform import Waveform

from .catalogue import Catalogue
from .detector import DetectorConfig, TrainDetector
from .events import Channel, TrainEvent
from .hum import without_hum

Array = NDArray[np.float64]

_LATE_S = 1.0  # a sample this far behind is not late: the clock was set back
_DENSE = 64  # samples over which the pace of a clock is taken
_JITTER = 3.0  # times the median deviation of a step, which rounding of the times reaches


def detect(
    time_or_rate: float | ArrayLike,
    samples: ArrayLike,
    channels: Sequence[Channel] | Channel,
    catalogue: Catalogue | None = None,
    config: DetectorConfig | None = None,
) -> list[TrainEvent]:
    """Events in plain arrays, in the unit they come in (no result depends on it).

    Args:
        time_or_rate: sampling rate (Hz), or the time of every sample (s, or ``datetime64``; equal
            steps, perhaps rounded; jumps are gaps). Samples that came less than a second late are
            put in order of time.
        samples: shape (samples,) or (samples, channels); NaN where missing.
        channels: one per column.
        catalogue: train types; the shipped one by default. ``Catalogue.from_axles`` makes one.
        config: settings; :attr:`DetectorConfig.position_sigma` if positions are not by tape.

    Raises:
        InputError: shapes disagree, numbers are none, or the times go back.
    """
    sensors = (channels,) if isinstance(channels, Channel) else tuple(channels)
    for channel in sensors:
        if not isinstance(channel, Channel):
            raise InputError(
                f"channels has {channel!r}; give one Channel(name, x in m, layer) per column"
            )
    if catalogue is not None and not isinstance(catalogue, Catalogue):
        raise InputError(
            f"catalogue is a {type(catalogue).__name__}; make a Catalogue: "
            'Catalogue.from_axles({"name": [positions in m]}) or Catalogue.load(path)'
        )
    detector = TrainDetector(sensors, catalogue, config)
    data = _numbers("samples", samples)
    data = data[:, None] if data.ndim == 1 else data
    if data.ndim != 2 or data.shape[1] != len(sensors):
        turned = data.ndim == 2 and data.shape[0] == len(sensors)
        raise InputError(
            f"samples of shape {data.shape} must be (samples, {len(sensors)}), one column per "
            f"channel{'; transpose them' if turned else ''}"
        )
    names = tuple(channel.name for channel in sensors)
    clock = _seconds(time_or_rate)
    if clock.ndim == 0:
        if not 50 <= float(clock) <= 1e6:
            raise InputError(f"rate = {float(clock)} Hz must lie from 50 Hz to 1 MHz")
        pieces = [(0, len(data))]
        dt_ns, start_ns = round(1e9 / float(clock)), np.zeros(1, dtype=np.int64)
    else:
        if clock.shape != (len(data),) or len(data) < 2:
            raise InputError(
                f"time of shape {clock.shape} must be ({len(data)},), one per sample and two or "
                "more; for a rate give one number (Hz)"
            )
        clock, data = _in_order(clock, data)
        dt_ns, pieces, start_ns = _grid(clock)
    data = _in_range(data)
    events: list[TrainEvent] = []
    for (first, last), stamp in zip(pieces, start_ns, strict=True):
        part = _without_hum(data[first:last], 1e9 / dt_ns)
        block = Waveform(int(stamp), dt_ns, names, part.astype(np.float32))
        events += detector.process(block)
    return _corrected(events + detector.finish())


def _numbers(name: str, values: ArrayLike) -> Array:
    if isinstance(values, np.ma.MaskedArray):
        values = np.ma.filled(values.astype(np.float64), np.nan)
    try:
        array = np.asarray(values)
    except ValueError:
        raise InputError(
            f"{name} must be one rectangular array; if channels differ in length or rate, fill the "
            "shorter ones with NaN, or give each to a TrainDetector in blocks of its own rate"
        ) from None
    if array.dtype.kind not in "fiubO":
        raise InputError(f"{name} of type {array.dtype} must be real numbers")
    try:
        return array.astype(np.float64)
    except (TypeError, ValueError) as failure:
        raise InputError(f"{name} must be real numbers: {failure}") from None


def _seconds(time_or_rate: float | ArrayLike) -> Array:
    """The rate (Hz), or times in s, of dates since 1970."""
    array = np.asarray(time_or_rate)
    if array.dtype.kind not in "mM":
        return _numbers("time_or_rate", array)
    known = np.where(np.isnat(array), np.nan, array.astype(f"{array.dtype.kind}8[ns]").view("i8"))
    return np.asarray(1e-9 * known)


def _in_order(clock: Array, data: Array) -> tuple[Array, Array]:
    """Times (s) and samples in order of time, if only some came late on their way.

    Raises:
        InputError: times are not finite, out of range, or go back by a second and more.
    """
    wrong = np.flatnonzero(~(np.abs(clock) < 9e9))
    if wrong.size:
        raise InputError(
            f"time[{wrong[0]}] = {clock[wrong[0]]} must be finite and within 9e9 s of 0 (it is in "
            f"s, not ms or ns); {wrong.size} of {clock.size} are not: leave those samples out"
        )
    back = np.maximum.accumulate(clock) - clock
    worst = int(np.argmax(back))
    if not back[worst]:
        return clock, data
    order = np.argsort(clock, kind="stable")
    ordered = clock[order]
    span = min(_DENSE, len(clock) - 1)
    pace, as_came = (t[span:] - t[:-span] for t in (ordered, clock))
    # samples in their order are nowhere denser than elsewhere; a clock set back fills a time twice
    if back[worst] >= _LATE_S or pace.min() < 0.75 * float(np.median(as_came)):
        raise InputError(
            f"time must increase from sample to sample (s); sample {worst} is {back[worst]:.6g} s "
            "before an earlier one: if the clock was set back, give the parts one by one"
        )
    return ordered, data[order]


def _in_range(data: Array) -> Array:
    """Samples about 0 and of order 1, per channel by a power of two: they become single precision.

    No result depends on the unit, nor on an offset.
    """
    data = np.where(np.isfinite(data), data, np.nan)
    for column in data.T:
        known = np.isfinite(column)
        if known.any():
            column[:] = _to_one(column, known)
            column -= np.median(column[known])
            column[:] = _to_one(column, known)
    return data


def _without_hum(data: Array, rate: float) -> Array:
    """Samples of a piece without mains hum, NaN where they were."""
    out: Array = np.array(data)
    for column in out.T:
        known = np.flatnonzero(np.isfinite(column))
        if known.size > 0.5 * column.size:
            whole = np.interp(np.arange(column.size), known, column[known])
            column[known] += (without_hum(whole, rate) - whole)[known]
    return out


def _to_one(column: Array, known: NDArray[np.bool_]) -> Array:
    return np.asarray(np.ldexp(column, -int(np.frexp(np.max(np.abs(column[known])))[1])))


def _grid(clock: Array) -> tuple[int, list[tuple[int, int]], NDArray[np.int64]]:
    """Step (ns) of the times of samples (s), pieces without a gap, and their stamps (ns).

    Times may be rounded, jitter, or be those of blocks of samples: the step is the mean over
    pieces, and a gap is what is longer than the samples with the time before it take.
    """
    span = min(_DENSE, len(clock) - 1)
    typical = float(np.median(clock[span:] - clock[:-span])) / span
    if typical <= 0 or clock[-1] <= clock[0]:
        raise InputError(
            f"time must increase, but is the same for {span} samples and more, too coarse for "
            "their rate (seconds of an epoch in single precision?); give the rate (Hz), or times "
            "(s) of a finer clock in double precision"
        )
    starts = np.flatnonzero(np.diff(clock, prepend=-np.inf) > 0)
    steps, counts = np.diff(clock[starts]), np.diff(starts)
    off = np.abs(steps - typical * counts)
    # where times repeat, samples are known to as many as share one
    least = 0.5 + (float(np.median(counts)) if starts.size < clock.size else 0.0)
    gap = off > least * typical + _JITTER * float(np.median(off))
    mean = float(np.sum(steps[~gap]) / np.sum(counts[~gap])) if not gap.all() else typical
    if not 50 <= 1 / mean <= 1e6:
        raise InputError(
            f"time has steps of {mean:.6g}, a rate of {1 / mean:.6g} Hz; it must be in s, at 50 Hz "
            "to 1 MHz"
        )
    cuts = [0, *(int(c) for c in starts[1:][gap]), len(clock)]
    pieces = list(pairwise(cuts))
    stamps = np.round(clock[[first for first, _ in pieces]] * 1e9).astype(np.int64)
    return max(1, round(1e9 * mean)), pieces, stamps


def _corrected(events: Sequence[TrainEvent]) -> list[TrainEvent]:
    """Events without those that a later look at the beginning of the record has replaced."""
    out: list[TrainEvent] = []
    for event in events:
        if event.kind == "arrival" and any(
            e.kind == "arrival" and e.stamp_ns >= event.stamp_ns for e in out
        ):
            out = [e for e in out if e.kind == "health"]
        out.append(event)
    return out
