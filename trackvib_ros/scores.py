"""Figures from scored passages: summary, confusion, tables, JSON, plots."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter
from rich.table import Table

from solver import InputError
from trackvib_ros.evaluate import BagScore, Evaluation, PassageScore

Array = NDArray[np.float64]


def spread(values: Sequence[float | None], scale: float = 1.0) -> dict[str, float]:
    """Median, 95 % and largest magnitude of the known values; empty without any."""
    known = np.abs(np.array([v for v in values if v is not None], dtype=np.float64)) * scale
    if not known.size:
        return {}
    return {
        "median": float(np.median(known)),
        "p95": float(np.percentile(known, 95)),
        "worst": float(known.max()),
    }


def _ratio(error: float | None, sigma: float | None) -> list[float]:
    return [error / sigma] if error is not None and sigma else []


STATED: dict[str, Callable[[PassageScore], list[float]]] = {
    "speed": lambda p: _ratio(p.speed_error, p.speed_sigma),
    "acceleration": lambda p: _ratio(p.acceleration_error, p.acceleration_sigma),
    "arrival": lambda p: _ratio(p.arrival_s, p.arrival_sigma_s),
    "departure": lambda p: _ratio(p.departure_s, p.departure_sigma_s),
    "provisional speed": lambda p: [r for update in p.updates for r in _ratio(*update)],
}
"""Error over stated sigma of every value of a passage that has both, by quantity."""


def standardised(found: Sequence[PassageScore]) -> dict[str, Array]:
    """Error over stated sigma of all passages, by quantity, of any length."""
    return {
        name: np.array([r for p in found for r in of(p)], dtype=np.float64)
        for name, of in STATED.items()
    }


def calibration(found: Sequence[PassageScore]) -> dict[str, dict[str, float]]:
    """Per quantity: rms of error over sigma, part within the stated 95 % interval, number."""
    table = {
        name: {
            "rms": float(np.sqrt(np.mean(r**2))),
            "within_95": float(np.mean(np.abs(r) < 1.96)),
            "number": float(r.size),
        }
        for name, r in standardised(found).items()
        if r.size
    }
    scored = sum(p.axle_scored for p in found)
    if scored:
        table["axle times"] = {
            "rms": float(np.sqrt(sum(p.axle_square for p in found) / scored)),
            "within_95": sum(p.axle_inside for p in found) / scored,
            "number": float(scored),
        }
    return table


def f1(passages: Sequence[PassageScore]) -> tuple[float, float, float]:
    """Precision, recall and F1 of the wheelsets of all true passages."""
    right = sum(p.axles_right for p in passages)
    precision = right / max(1, sum(p.axles_told for p in passages))
    recall = right / max(1, sum(p.axles_true for p in passages))
    return precision, recall, 2 * precision * recall / max(precision + recall, 1e-12)


def _part(values: Sequence[bool | None]) -> float | None:
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else None


def summary(result: Evaluation) -> dict[str, Any]:
    """The figures, by name; errors are absolute unless said, parts from 0 to 1."""
    passages = result.passages
    found = [p for p in passages if p.detected]
    hours = sum(bag.duration_s for bag in result.bags) / 3600
    precision, recall, both = f1(passages)
    onsets = [p.onset_s for p in found if p.onset_s is not None]
    declared = [p.declared_s for p in found if p.declared_s is not None]
    return {
        "bags": len(result.bags),
        "bags_failed": sum(bool(bag.problem) for bag in result.bags),
        "hours": hours,
        "passages": len(passages),
        "detected": len(found) / max(1, len(passages)),
        "extra_passages": sum(bag.extra for bag in result.bags),
        "false_alarms_per_hour": sum(bag.alarms for bag in result.bags) / max(hours, 1e-9),
        "onset_after_first_axle_ms": {"latest": max(onsets) * 1e3} if onsets else {},
        "onset_declared_after_first_axle_ms": {"latest": max(declared) * 1e3} if declared else {},
        "arrival_error_ms": spread([p.arrival_s for p in found], 1e3),
        "departure_error_ms": spread([p.departure_s for p in found], 1e3),
        "latency_s": spread([p.latency_s for p in found]),
        "speed_error_percent": spread([p.speed_error for p in found], 100.0),
        "provisional_speed_error_percent": spread([e for p in found for e, _ in p.updates], 100.0),
        "acceleration_error_m_s2": spread([p.acceleration_error for p in found]),
        "calibration": calibration(found),
        "axle_count_right": _part([p.axles_found == p.axles_true for p in found]),
        "axle_precision": precision,
        "axle_recall": recall,
        "axle_f1": both,
        "direction_right": _part([p.direction_right for p in found]),
        "type_right": _part([p.type_right for p in found]),
        "family_right": _part([p.found_family == p.family for p in found if p.listed]),
        "cpu_per_second": sum(bag.cpu_s for bag in result.bags) / max(hours * 3600, 1e-9),
    }


def confusion(result: Evaluation) -> dict[str, dict[str, int]]:
    """How often each true type was told as which; ``missed`` if not detected."""
    table: dict[str, Counter[str]] = {}
    for p in result.passages:
        told = (p.found_type or "no type") if p.detected else "missed"
        table.setdefault(p.train, Counter())[told] += 1
    return {train: dict(counts) for train, counts in sorted(table.items())}


def views_of(result: Evaluation) -> list[str]:
    """Views in the order in which they occur."""
    return list(dict.fromkeys(bag.view for bag in result.bags))


def grouped(result: Evaluation, factor: str) -> dict[str, Evaluation]:
    """The evaluation cut by a factor of the bags' metadata, a passage's ``train`` or ``view``.

    Raises:
        InputError: no bag has the factor.
    """
    parts: dict[str, Evaluation] = {}
    known: set[str] = {"view"}
    for bag in result.bags:
        factors = {**bag.factors, "view": bag.view}
        known |= set(factors)
        if factor in factors:
            key = str(factors[factor])
            parts.setdefault(key, Evaluation(result.detector, [])).bags.append(bag)
    if not parts:
        raise InputError(f"--by {factor}: no bag has it; there are {', '.join(sorted(known))}")

    def order(key: str) -> tuple[int, float, str]:
        try:
            return (0, float(key), key)
        except ValueError:
            return (1, 0.0, key)

    return {key: parts[key] for key in sorted(parts, key=order)}


@dataclass(frozen=True)
class ScoreFile:
    """What ``trackvib evaluate --json`` writes.

    Attributes:
        detector: ``module:factory``.
        summary: figures over all bags, by view.
        confusion: told types by true type, by view.
        bags: every bag and view with its passages.
    """

    detector: str
    summary: dict[str, dict[str, Any]]
    confusion: dict[str, dict[str, dict[str, int]]]
    bags: list[BagScore]


def to_json(result: Evaluation) -> str:
    """Everything, passage by passage; :func:`json_schema` describes it."""
    by_view = grouped(result, "view")
    content = ScoreFile(
        result.detector,
        {view: summary(part) for view, part in by_view.items()},
        {view: confusion(part) for view, part in by_view.items()},
        result.bags,
    )
    return json.dumps(asdict(content), indent=1)


def json_schema() -> dict[str, Any]:
    """JSON schema of the file of ``--json``."""
    return TypeAdapter(ScoreFile).json_schema()


def from_json(paths: Sequence[Path]) -> Evaluation:
    """The evaluation in files of :func:`to_json`, of different bags or views.

    Raises:
        InputError: a file cannot be read or is none, or they are of different detectors.
    """
    parts = []
    for path in paths:
        try:
            parts.append(TypeAdapter(ScoreFile).validate_json(path.read_text("utf-8")))
        except (OSError, UnicodeDecodeError, ValueError) as failure:
            raise InputError(f"scores {path}: cannot be read: {failure}") from None
    detectors = sorted({part.detector for part in parts})
    if len(detectors) != 1:
        raise InputError(f"scores of one detector belong together, not of {', '.join(detectors)}")
    bags = [bag for part in parts for bag in part.bags]
    names = [(bag.bag, bag.view) for bag in bags]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"bag {twice[0]}, view {twice[1]!r}, is in these files twice")
    return Evaluation(detectors[0], bags)


def tables(result: Evaluation, by: Sequence[str] = ()) -> list[Table]:
    """Summary and confusion per view, and one table per factor, for a terminal."""

    def text(value: Any) -> str:
        if value is None or value == {}:
            return "-"
        if isinstance(value, dict):
            return ", ".join(f"{name} {number:.3g}" for name, number in value.items())
        return f"{value:.4g}" if isinstance(value, float) else str(value)

    shown = []
    for view, part in grouped(result, "view").items():
        title = f"{result.detector}: {len(part.passages)} passages, view: {view}"
        table = Table(title=title, title_style="bold")
        table.add_column("figure")
        table.add_column("value", justify="right")
        for name, value in summary(part).items():
            if name == "calibration":
                for quantity, row in value.items():
                    table.add_row(
                        f"{quantity}: error / sigma",
                        f"rms {row['rms']:.3g}, within 95 %: {100 * row['within_95']:.1f} %",
                    )
            else:
                table.add_row(name.replace("_", " "), text(value))
        types = Table(title="told types by true type", title_style="bold")
        types.add_column("true")
        types.add_column("told")
        for train, counts in confusion(part).items():
            told = sorted(counts.items(), key=lambda item: -item[1])
            types.add_row(train, ", ".join(f"{name} {count}" for name, count in told))
        shown += [table, types]
    for factor in by:
        table = Table(title=f"by {factor}", title_style="bold")
        columns = (
            factor,
            "passages",
            "detected",
            "extra",
            "count right",
            "type right",
            "speed p50 / p95 %",
            "arrival p95 ms",
            "speed error / sigma",
        )
        for column in columns:
            table.add_column(column, justify="left" if column == factor else "right")
        for key, part in grouped(result, factor).items():
            s = summary(part)
            speed, arrival = s["speed_error_percent"], s["arrival_error_ms"]
            table.add_row(
                key,
                str(s["passages"]),
                text(s["detected"]),
                str(s["extra_passages"]),
                text(s["axle_count_right"]),
                text(s["type_right"]),
                f"{speed['median']:.3f} / {speed['p95']:.3f}" if speed else "-",
                text(arrival.get("p95")),
                text(s["calibration"].get("speed", {}).get("rms")),
            )
        shown.append(table)
    return shown


def figure(result: Evaluation, path: Path) -> None:
    """Errors with stated uncertainties, latency, calibration and confusion, as PNG.

    Raises:
        InputError: the file exists.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if path.exists():
        raise InputError(f"{path} exists: name another file")
    picture = Figure(figsize=(13, 10), layout="constrained")
    FigureCanvasAgg(picture)
    axes = picture.subplots(3, 2)
    found = [p for p in result.passages if p.detected]
    for train in sorted({p.train for p in found}):
        own = [p for p in found if p.train == train and p.speed_error is not None]
        axes[0, 0].errorbar(
            [p.speed_kmh for p in own],
            [100 * (p.speed_error or 0) for p in own],
            [196 * (p.speed_sigma or 0) for p in own],
            fmt="o",
            markersize=3,
            elinewidth=0.7,
            label=train,
        )
        axes[0, 1].plot(
            [p.speed_kmh for p in own], [1e3 * (p.arrival_s or 0) for p in own], "o", ms=3
        )
    axes[0, 0].set(xlabel="speed (km/h)", ylabel="speed error (%), bars 95 %")
    axes[0, 1].set(xlabel="speed (km/h)", ylabel="arrival error (ms)")
    if found:
        axes[0, 0].legend(fontsize="small")
    _quantiles(axes[1, 0], found)
    _coverage(axes[1, 1], found)
    latency = [p.latency_s for p in found if p.latency_s is not None]
    declared = [p.declared_s for p in found if p.declared_s is not None]
    if latency:
        axes[2, 0].hist(latency, 30, alpha=0.7, label="passage told after last wheelset")
    if declared:
        axes[2, 0].hist(declared, 30, alpha=0.7, label="arrival told after first wheelset")
    axes[2, 0].set(xlabel="latency (s)", ylabel="passages")
    if latency or declared:
        axes[2, 0].legend(fontsize="small")
    _confusion_map(axes[2, 1], confusion(result))
    for axis in axes.ravel()[:5]:
        axis.grid(alpha=0.25)
    picture.savefig(path, dpi=120, format="png")


def _quantiles(axis: Any, found: Sequence[PassageScore]) -> None:
    """Error over stated sigma against the quantiles of the normal distribution."""
    from scipy.stats import norm

    for name, r in standardised(found).items():
        if r.size > 3:
            expected = norm.ppf((np.arange(r.size) + 0.5) / r.size)
            axis.plot(expected, np.clip(np.sort(r), -6, 6), ".", ms=4, label=name)
    axis.plot([-3, 3], [-3, 3], "k", lw=0.8)
    axis.set(xlabel="normal quantile", ylabel="error / stated sigma (clipped at 6)")
    if axis.get_legend_handles_labels()[0]:
        axis.legend(fontsize="small")


def _coverage(axis: Any, found: Sequence[PassageScore]) -> None:
    """Part of the errors within the stated interval of every confidence."""
    from scipy.stats import norm

    level = np.linspace(0.02, 0.98, 49)
    for name, r in standardised(found).items():
        if r.size > 3:
            inside = [float(np.mean(np.abs(r) < norm.ppf(0.5 + p / 2))) for p in level]
            axis.plot(level, inside, label=name)
    axis.plot([0, 1], [0, 1], "k", lw=0.8)
    axis.set(xlabel="stated confidence", ylabel="part within", xlim=(0, 1), ylim=(0, 1))


def _confusion_map(axis: Any, table: dict[str, dict[str, int]]) -> None:
    told = sorted({name for counts in table.values() for name in counts})
    if not told:
        return
    counts = np.array([[row.get(name, 0) for name in told] for row in table.values()])
    share = counts / counts.sum(axis=1, keepdims=True)
    axis.imshow(share, vmin=0, vmax=1, cmap="Blues", aspect="auto")
    axis.set_xticks(range(len(told)), told, rotation=40, ha="right", fontsize=7)
    axis.set_yticks(range(len(table)), list(table), fontsize=7)
    for (i, j), count in np.ndenumerate(counts):
        if count:
            axis.text(j, i, str(count), ha="center", va="center", fontsize=7)
    axis.set(xlabel="told", ylabel="true")
