"""The detector's figures on noise-carried bursts: ``python -m tests.detection.benchmark``.

A second opinion beside the solver's passages (``trackvib dataset accuracy`` and
``trackvib evaluate --targets``): signals that no wheel of the solver ever made.
Columns as in the design notes. Seeds of ``--set tuning`` and ``--set figures`` never meet: settings
were chosen on the first, figures are told from the second.
"""

from __future__ import annotations

import argparse
import json
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tests.detection.synthetic import (
    CATALOGUE,
    RAILS,
    Passage,
    record,
)
from trackvib_ros.detection import CONFIRMED, Catalogue, detect

RATE = 2000
SEEDS = {"tuning": 1_000_000, "figures": 2_000_000}
TYPES = ("CRH3", "CRH3x2", "metro", "locomotive_hauled", "articulated", "CRH1", "ICE1", "CRH5")


@dataclass
class Row:
    """A condition and the errors of its runs."""

    name: str
    runs: int = 0
    confirmed: int = 0
    extra: int = 0
    count: int = 0
    family: int = 0
    direction: int = 0
    one: list[float] = field(default_factory=list)
    known: list[float] = field(default_factory=list)
    two: list[float] = field(default_factory=list)
    ratio_one: list[float] = field(default_factory=list)
    ratio: list[float] = field(default_factory=list)
    acceleration: list[float] = field(default_factory=list)
    onset: list[float] = field(default_factory=list)
    arrival: list[float] = field(default_factory=list)
    departure: list[float] = field(default_factory=list)
    paired: int = 0
    told: int = 0
    true: int = 0


def conditions() -> dict[str, dict]:
    """Rows of the table."""
    rows = {f"{snr} dB": {"snr": snr} for snr in (40, 20, 10, 0)}
    rows["pulse 40 dB"] = {"snr": 40, "kind": "pulse"}
    rows["pulse 10 dB"] = {"snr": 10, "kind": "pulse"}
    rows["+-0.8 m/s2, 20 dB"] = {"snr": 20, "acceleration": 0.8}
    rows["10 % missing, 20 dB"] = {"snr": 20, "missing": 0.1}
    rows["clipped at 20 %, 20 dB"] = {"snr": 20, "clip": 0.2}
    rows["type absent, 20 dB"] = {"snr": 20, "absent": True}
    return rows


def run(job: tuple[str, dict, int]) -> tuple[str, list[dict]]:
    """One passage, analysed with both channels, with one, and with one and its type known."""
    name, condition, seed = job
    rng = np.random.default_rng(seed)
    train = CATALOGUE[TYPES[rng.integers(len(TYPES))] if "absent" not in condition else "CRH1"]
    speed = rng.uniform(60, 380) / 3.6
    a = rng.uniform(-1, 1) * condition.get("acceleration", 0.0)
    a = max(a, -0.3 * speed**2 / train.span)  # it must not stop on the way
    truth = Passage(train.axles, speed, acceleration=a, direction=int(rng.choice([-1, 1])))
    signals = record(
        [truth],
        RAILS,
        condition["snr"],
        seed=seed,
        kind=condition.get("kind", "burst"),
        rates={"rail": RATE},
    )
    x = np.stack([signals[c.name][1] for c in RAILS], axis=1)
    if "missing" in condition:
        x[rng.random(x.shape) < condition["missing"]] = np.nan
    if "clip" in condition:
        limit = condition["clip"] * np.max(np.abs(x))
        x = np.clip(x, -limit, limit)
    catalogue = CATALOGUE
    if "absent" in condition:
        catalogue = Catalogue(tuple(t for t in CATALOGUE if t.name != train.name))
    out = []
    trials = (
        ("two", RAILS, x, catalogue),
        ("one", RAILS[:1], x[:, 0], catalogue),
        ("known", RAILS[:1], x[:, 0], Catalogue((train,))),
    )
    for trial, channels, data, known in trials:
        if trial == "known" and "absent" in condition:
            continue
        events = detect(RATE, data, channels, known)
        found = [e for e in events if e.kind == "passage" and e.values["grade"] == CONFIRMED]
        result: dict = {"trial": trial, "found": len(found)}
        times = truth.axle_times(0.0)
        arrivals = [e.stamp_ns * 1e-9 for e in events if e.kind == "arrival"]
        if found:
            e = min(found, key=lambda event: abs(event.stamp_ns * 1e-9 - times[0]))
            v = e.values
            axles = np.array([q.stamp_ns for q in events if q.kind == "axle"]) * 1e-9
            near = np.abs(axles[:, None] - times[None, :]).min(axis=0)
            limit = 0.25 * float(np.min(np.diff(times)))
            true_speed = truth.mid_speed()
            result |= {
                "speed": v["speed"].value / true_speed - 1,
                "sigma": v["speed"].sigma / true_speed,
                "acceleration": v["acceleration"].value - a,
                "count": v["axle_count"] == times.size,
                "family": v["type"] != "unknown" and CATALOGUE[v["type"]].family == train.family,
                "direction": v["direction"] == ("forward" if truth.direction > 0 else "backward"),
                "arrival": e.stamp_ns * 1e-9 - times[0],
                "departure": v["departure_ns"] * 1e-9 - times[-1],
                "paired": int((near < limit).sum()),
                "told": int(axles.size),
                "true": int(times.size),
                "onset": min(arrivals) - min(times[0], truth.axle_times(20.0)[0]),
                "seed": seed,
                "train": train.name,
                "kmh": 3.6 * true_speed,
                "type": v["type"],
            }
        out.append(result)
    return name, out


def _p(values: list[float], scale: float) -> str:
    if not values:
        return "-"
    v = np.abs(values) * scale
    return f"{np.percentile(v, 50):.2f}/{np.percentile(v, 95):.2f}"


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--set", choices=list(SEEDS), default="figures")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    base = SEEDS[options.set]
    jobs = [
        (name, condition, base + 1000 * k + i)
        for k, (name, condition) in enumerate(conditions().items())
        for i in range(options.runs)
    ]
    rows = {name: Row(name) for name in conditions()}
    raw = []
    with ProcessPoolExecutor(options.workers) as pool:
        for name, results in pool.map(run, jobs, chunksize=2):
            row = rows[name]
            for r in results:
                raw.append({"row": name, **r})
                if r["trial"] == "two":
                    row.runs += 1
                    row.confirmed += r["found"] >= 1
                    row.extra += max(0, r["found"] - 1)
                if not r["found"]:
                    continue
                getattr(row, r["trial"]).append(r["speed"])
                if r["trial"] == "two":
                    row.count += r["count"]
                    row.family += r["family"]
                    row.direction += r["direction"]
                    row.ratio.append(r["speed"] / r["sigma"])
                    row.acceleration.append(r["acceleration"])
                    row.onset.append(r["onset"])
                    row.arrival.append(r["arrival"])
                    row.departure.append(r["departure"])
                    row.paired += r["paired"]
                    row.told += r["told"]
                    row.true += r["true"]
                elif r["trial"] == "one":
                    row.ratio_one.append(r["speed"] / r["sigma"])
    print(
        "| condition | detected/extra | count exact | F1 | family | direction | 1 sensor p50/p95 % "
        "| 1 sensor, type known % | 2 sensors % | acceleration p50/p95 | onset latest ms "
        "| arrival p50/p95 ms | departure ms | error/sigma 1, 2 sensors | in 95 % |"
    )
    print("|" + "---|" * 15)
    for row in rows.values():
        f1 = 2 * row.paired / max(1, row.told + row.true)
        n = max(1, row.confirmed)
        rms = [
            float(np.sqrt(np.mean(np.square(r)))) if r else 0 for r in (row.ratio_one, row.ratio)
        ]
        inside = np.mean(np.abs(row.ratio) < 1.96) if row.ratio else 0
        print(
            f"| {row.name} | {row.confirmed / row.runs:.3g}/{row.extra} | {row.count / n:.3g} "
            f"| {f1:.3f} | {row.family / n:.3g} | {row.direction / n:.3g} | {_p(row.one, 100)} "
            f"| {_p(row.known, 100)} | {_p(row.two, 100)} | {_p(row.acceleration, 1)} "
            f"| {1e3 * max(row.onset, default=0):.0f} | {_p(row.arrival, 1e3)} "
            f"| {_p(row.departure, 1e3)} | {rms[0]:.2f}, {rms[1]:.2f} | {inside:.3g} |"
        )
    if options.json:
        options.json.write_text(json.dumps(raw, indent=1, default=float), "utf-8")


if __name__ == "__main__":
    main()
