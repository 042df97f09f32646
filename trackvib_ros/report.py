"""Detected beside true, from a bag alone: comparison, table, figure. No ROS."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from solver import InputError
from trackvib_ros import topics
from trackvib_ros.bag import BagReader
from trackvib_ros.detection import Estimate, TrainEvent
from trackvib_ros.truth import PassageTruth
from trackvib_ros.waveform import Waveform

MATCH_NS = 1_000_000_000
"""A detected passage belongs to a true one if their arrivals are this close (ns)."""

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Row:
    """One quantity: as text detected, true and the error."""

    quantity: str
    detected: str
    truth: str
    error: str


@dataclass(frozen=True, slots=True)
class Match:
    """A true passage and what was detected of it (None: missed)."""

    truth: PassageTruth
    event: TrainEvent | None

    @property
    def rows(self) -> list[Row]:
        """Comparison, quantity by quantity, at the detector's reference channel."""
        truth, event = self.truth, self.event
        if event is None:
            return [Row("passage", "missed", f"{truth.train_type}, {truth.direction}", "missed")]
        channel = reference_channel(event, truth)
        times = truth.axle_times_ns[channel]
        rows = [
            _time_row(f"arrival at {channel}", event, "arrival", times[0]),
            _time_row(f"departure from {channel}", event, "departure", times[-1]),
        ]
        speed, true_speed = event.values.get("speed"), truth.speed_m_s[channel]
        if isinstance(speed, Estimate):
            rows.append(
                Row(
                    "speed",
                    f"{3.6 * speed.value:.3f} ± {3.6 * speed.sigma:.3f} km/h",
                    f"{3.6 * true_speed:.3f} km/h",
                    f"{100 * (speed.value / true_speed - 1):+.4f} %",
                )
            )
        for quantity, key, true in (
            ("direction", "direction", truth.direction),
            ("wheelsets", "axle_count", truth.axle_count),
            ("train type", "type", truth.train_type),
        ):
            found = event.values.get(key)
            if quantity == "wheelsets" and isinstance(found, int):
                error = f"{found - int(true):+d}"
            else:
                error = "equal" if str(found) == str(true) else "different"
            rows.append(Row(quantity, str(found), str(true), error))
        return rows


def _time_row(quantity: str, event: TrainEvent, key: str, true_ns: int) -> Row:
    found, sigma = event.values.get(f"{key}_ns"), event.values.get(f"{key}_sigma")
    if not isinstance(found, (str, int)) or not isinstance(sigma, (str, int, float)):
        return Row(quantity, "not stated", f"{true_ns * 1e-9:.6f} s", "not stated")
    found_ns = int(found)
    return Row(
        quantity,
        f"{found_ns * 1e-9:.6f} ± {float(sigma):.6f} s",
        f"{true_ns * 1e-9:.6f} s",
        f"{(found_ns - true_ns) * 1e-6:+.3f} ms",
    )


def reference_channel(event: TrainEvent, truth: PassageTruth) -> str:
    """The channel at which the event states its times.

    Raises:
        InputError: the event names none that the truth knows.
    """
    name = event.values.get("reference")
    if not isinstance(name, str) or name not in truth.axle_times_ns:
        raise InputError(f"the passage refers to channel {name!r}, which the truth does not know")
    return name


def match(truths: Sequence[PassageTruth], events: Sequence[TrainEvent]) -> list[Match]:
    """Pair true passages with detected ones, nearest in time, each used once."""
    passages = [event for event in events if event.kind == "passage"]
    matches = []
    for truth in sorted(truths, key=lambda passage: passage.enter_ns):
        near = [
            (abs(event.stamp_ns - truth.axle_times_ns[reference_channel(event, truth)][0]), i)
            for i, event in enumerate(passages)
        ]
        distance, index = min(near, default=(MATCH_NS, -1))
        event = passages.pop(index) if distance < MATCH_NS else None
        matches.append(Match(truth, event))
    return matches


class PassageReport:
    """What a bag says about the passages in it.

    Args:
        bag: bag directory or file.

    Attributes:
        events: everything the detector said, by time.
        truths: the true passages; empty in a recording of the real world.
        matches: both, paired.
        extra: passages detected where there was none.

    Raises:
        InputError: no bag, or it holds no events topic.
    """

    def __init__(self, bag: Path) -> None:
        self._reader = BagReader(bag)
        self.events: list[TrainEvent] = []
        self.truths: list[PassageTruth] = []
        for values in self._key_values(topics.TRAIN_EVENTS):
            self.events.append(TrainEvent.from_dict(values))
        for values in self._key_values(topics.TRUE_PASSAGES):
            self.truths.append(PassageTruth.from_dict(values))
        self.events.sort(key=lambda event: event.stamp_ns)
        self.matches = match(self.truths, self.events)
        matched = [m.event for m in self.matches]
        self.extra = [e for e in self.events if e.kind == "passage" and e not in matched]

    @property
    def detected(self) -> bool:
        """True if every true passage was detected and there was at least one."""
        return bool(self.matches) and all(m.event is not None for m in self.matches)

    def _names(self, suffix: str) -> list[str]:
        end = "/" + suffix.lstrip("/")
        return [name for name in self._reader.topics if name.endswith(end)]

    def _key_values(self, topic: str) -> Iterator[dict[str, str]]:
        names = self._names(topic)
        for message in self._reader.messages(names) if names else ():
            for status in self._reader.decode(message).status:
                yield {pair.key: pair.value for pair in status.values}

    def _trace(self, channel: str) -> tuple[Array, Array]:
        for name in self._names("waveform"):
            blocks = [b for b in self._reader.waveforms(name) if channel in b.channels]
            if blocks:
                return _joined(blocks, channel)
        return np.empty(0), np.empty(0)

    def _wheel_force(self) -> tuple[str, Array, Array]:
        for name in self._names(topics.TRUE_WHEEL_FORCE):
            blocks = list(self._reader.waveforms(name))
            if blocks:
                first = blocks[0].channels[0]
                return (first, *_joined([b for b in blocks if first in b.channels], first))
        return "", np.empty(0), np.empty(0)

    def _channels(self) -> dict[str, str]:
        layers: dict[str, str] = {}
        names = self._names(topics.CHANNELS)
        for message in self._reader.messages(names) if names else ():
            for status in self._reader.decode(message).status:
                for pair in status.values:
                    if pair.key == "layer":
                        layers[status.name] = pair.value
        return layers

    def tables(self) -> list[Table]:
        """One table *detected vs truth* per true passage."""
        tables = []
        for found in self.matches:
            table = Table(title=f"train {found.truth.train}: detected vs truth", title_style="bold")
            for column in ("quantity", "detected (± 1 sigma)", "truth", "error"):
                table.add_column(column, justify="left" if column == "quantity" else "right")
            for row in found.rows:
                table.add_row(row.quantity, row.detected, row.truth, row.error)
            tables.append(table)
        return tables

    def figure(self, path: Path) -> None:
        """Draw rail and bridge acceleration, a wheel force and the events as PNG.

        Raises:
            InputError: the file exists.
        """
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        if path.exists():
            raise InputError(f"{path} exists: name another file")
        layers = self._channels()
        by_layer = {layer: name for name, layer in reversed(layers.items())}
        shown = [by_layer[layer] for layer in ("rail", "slab", "bridge") if layer in by_layer]
        figure = Figure(figsize=(11, 2.3 * (len(shown) + 1) + 0.6), layout="constrained")
        FigureCanvasAgg(figure)
        axes = np.atleast_1d(figure.subplots(len(shown) + 1, 1, sharex=True)).tolist()
        for axis, channel in zip(axes, shown, strict=False):
            _envelope(axis, *self._trace(channel), color="#30506e")
            axis.set_ylabel(f"{channel}\nm/s²")
        name, time, force = self._wheel_force()
        _envelope(axes[-1], time, force / 1e3, color="#7a4a1e")
        axes[-1].set_ylabel(f"{name.replace('_', ' ')}\nkN")
        axes[-1].set_xlabel("simulated time, s")
        for axis in axes:
            axis.grid(alpha=0.25)
            axis.margins(x=0.01)
            self._mark(axis)
        confirmed = [event for event in self.events if event.kind == "passage"]
        title = "; ".join(
            f"{e.values.get('type')}, {e.values.get('axle_count')} wheelsets, "
            f"{e.values.get('speed')}, {e.values.get('direction')}"
            for e in confirmed
        )
        figure.suptitle(f"detected: {title or 'no train'}", fontsize=10)
        axes[0].legend(loc="upper right", fontsize=8)
        figure.savefig(path, dpi=130, format="png")

    def _mark(self, axis: object) -> None:
        colours = {"arrival": "#1a7f37", "departure": "#b3261e", "axle": "#f0a030"}
        told: set[str] = set()
        for event in self.events:
            if event.kind in colours:
                style = {"lw": 0.6, "alpha": 0.7} if event.kind == "axle" else {"lw": 1.6}
                axis.axvline(  # type: ignore[attr-defined]
                    event.stamp_ns * 1e-9,
                    color=colours[event.kind],
                    label=None if event.kind in told else f"detected {event.kind}",
                    zorder=0 if event.kind == "axle" else 3,
                    **style,
                )
                told.add(event.kind)


def _joined(blocks: Sequence[Waveform], channel: str) -> tuple[Array, Array]:
    time = np.concatenate([block.time_ns for block in blocks]) * 1e-9
    data = np.concatenate([block.data[:, block.channels.index(channel)] for block in blocks])
    return time, data.astype(np.float64)


def _envelope(axis: object, time: Array, data: Array, color: str, bins: int = 3000) -> None:
    """Draw the range of the samples in each of many short intervals: no peak is lost."""
    keep = np.isfinite(data)
    time, data = time[keep], data[keep]
    if time.size == 0:
        return
    starts = np.arange(0, time.size, max(1, time.size // bins))
    low, high = np.minimum.reduceat(data, starts), np.maximum.reduceat(data, starts)
    axis.fill_between(time[starts], low, high, color=color, lw=0.5)  # type: ignore[attr-defined]
