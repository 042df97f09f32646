"""Recordings as a stranger hands them over: everything of :mod:`field_like` at once, at random.

``python -m tests.detection.field_mixed`` draws recordings, each with some of the disturbances, one
or two sensors, any rate and distance, a record that may begin inside a train or hold two, and a
catalogue that may be long or lack the train, and holds what the detector says against the targets
for real records. Every share has its 95 % interval (Wilson, J. Am. Stat. Assoc. 22, 1927, 209).
"""

from __future__ import annotations

import json
import time
import traceback
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import numpy as np

from trackvib_ros.detection import CONFIRMED, Catalogue, TrainEvent, detect

from .field_like import SHAPES, TRAINS, StandIn, catalogue, stand_in
from .stand_ins import FAR, SEEDS, arguments

OFFSET = 10_000_000  # of the seeds, from those of one disturbance each
OFTEN = {
    "echo": 0.12, "joint": 0.15, "sleepers": 0.25, "corrugation": 0.1, "round": 0.15, "flats": 0.1,
    "hum": 0.25, "resonant": 0.25, "coupled": 0.4, "clipped": 0.04, "saturated": 0.05, "bits": 0.15,
    "gains": 0.3, "reversed": 0.25, "offset": 0.25, "missing": 0.05, "drops": 0.06, "loggers": 0.05,
    "moved": 0.25, "jitter": 0.15, "paced": 0.15, "turnout": 0.1, "sleeper": 0.15, "charge": 0.1,
}  # fmt: skip
"""Probabilities of disturbances, in the order of the measuring chain but for the last three."""


def many() -> Catalogue:
    """The trains, the shipped catalogue, and multiple units of other lengths: over thirty types."""
    types = {name: axles.tolist() for name, axles in TRAINS.items()}
    types |= {t.name: list(t.axle_positions) for t in Catalogue.default()}
    for cars in (4, 6, 10, 12):
        for length, centres, base in ((26.4, 19.0, 2.5), (23.0, 16.0, 2.4), (20.0, 13.8, 2.1)):
            axles = [
                i * length + bogie + side
                for i in range(cars)
                for bogie in (0.0, centres)
                for side in (0.0, base)
            ]
            types[f"{cars} cars of {length} m"] = axles
    return Catalogue.from_axles(types)


def draw(seed: int) -> tuple[StandIn, str, str]:
    """A recording, the catalogue it is read with, and the disturbances it has."""
    random = np.random.default_rng([seed, 7])
    rails = int(random.integers(1, 3))
    chosen = [name for name, share in OFTEN.items() if random.random() < share]
    if rails == 1:
        chosen = [name for name in chosen if name not in ("moved", "loggers")]
    shape = str(random.choice([*SHAPES, "inside"], p=[0.35, 0.15, 0.15, 0.15, 0.1, 0.1]))
    options: dict[str, Any] = {"rails": rails, "disturbance": "+".join(chosen or ["none"])}
    if shape == "inside":
        options |= {"cut": random.uniform(0.05, 0.6)}
    else:
        options |= {"shape": shape}
    options["rate"] = float(round(10 ** random.uniform(np.log10(200), np.log10(20_000))))
    far = 200.0 if random.random() < 0.2 else 40.0
    options["baseline"] = (3.0, far)
    if shape != "inside" and random.random() < 0.08:
        options["follow"] = random.uniform(2.0, 10.0)
    known = str(random.choice(["own", "many", "without", "default"], p=[0.4, 0.35, 0.15, 0.1]))
    s = stand_in(seed, **options)
    return s, known, f"{shape}, {options['disturbance']}"


def judge(seed: int) -> dict[str, Any]:
    """What the detector makes of a recording, against the truth."""
    s, known, what = draw(seed)
    types = {
        "own": catalogue,
        "many": many,
        "without": lambda: catalogue(s.train),
        "default": Catalogue.default,
    }[known]()
    began = time.process_time()
    out: dict[str, Any] = {
        "seed": seed,
        "what": what,
        "rails": len(s.channels),
        "known": known,
        "rate": round(s.rate),
        "seconds": round(len(s.samples) / s.rate, 1),
        "apart": s.channels[-1].x,
    }
    zero = 0.0 if s.clock is None else float(s.clock[0])
    try:
        told = detect(
            s.rate if s.clock is None else s.clock, s.samples, s.stated or s.channels, types
        )
    except Exception:
        return out | {"error": traceback.format_exc(), "trains": []}
    out["cpu"] = round(time.process_time() - began, 2)
    told = [e for e in told if e.kind in ("arrival", "passage")]
    passages = [e for e in told if e.kind == "passage" and e.values["grade"] == CONFIRMED]
    trains = [s, *s.others]
    taken: set[int] = set()
    out["trains"] = []
    for t in trains:
        own = [
            (i, e) for i, e in enumerate(passages) if i not in taken and _overlap(t, e, zero) > 0.3
        ]
        best = max(own, key=lambda p: _overlap(t, p[1], zero), default=None)
        if best:
            taken.add(best[0])
        first = min(float(t.axle_times(c.x)[0]) for c in t.channels)
        last = max(float(t.axle_times(c.x)[-1]) for c in t.channels)
        starts = [e.stamp_ns * 1e-9 - zero for e in told if e.kind == "arrival"]
        near = [a for a in starts if first - 8 < a < last]
        row = {
            "train": t.train,
            "truth_kmh": round(3.6 * t.mid_speed(0.0), 1),
            "wheelsets": int(t.axles.size),
            "truncated": t.truncated,
            "onset": min(near) - max(first, 0.0) if near else None,
        }
        if best:
            row |= _compare(t, best[1], zero)
        out["trains"].append(row)
    out["extra"] = len(passages) - len(taken)
    return out


def _overlap(t: StandIn, e: TrainEvent, zero: float) -> float:
    first = min(float(t.axle_times(c.x)[0]) for c in t.channels)
    last = max(float(t.axle_times(c.x)[-1]) for c in t.channels)
    begin, end = e.stamp_ns * 1e-9 - zero, last
    if "departure_ns" in e.values:  # else the record ends before
        end = e.values["departure_ns"] * 1e-9 - zero
    return (min(last, end) - max(first, begin)) / max(end - begin, 1e-3)


def _compare(t: StandIn, e: TrainEvent, zero: float) -> dict[str, Any]:
    v = e.values
    channel = next(c for c in t.channels if c.name == v["reference"])
    times = t.axle_times(channel.x)
    speed, truth = v["speed"], t.mid_speed(channel.x)
    way = {"forward": 1, "backward": -1, "unknown": 0}[v["direction"]]
    row = {
        "passage": True,
        "type": v["type"],
        "family": v["families"][0][0] if v["families"] else "",
        "method": e.method,
        "flags": list(e.quality),
        "speed": speed.value / truth - 1,
        "sigma": speed.sigma / truth,
        "direction": way * t.direction,
        "score": v["score"],
    }
    if "departure_ns" in v:
        row |= {
            "departure": v["departure_ns"] * 1e-9 - zero - times[-1],
            "departure_sigma": v["departure_sigma"],
        }
    if "axle_count" in v:
        row |= {
            "count": v["axle_count"] - times.size,
            "sure": "axle_count_not_confident" not in e.quality,
            "arrival": v["arrival_ns"] * 1e-9 - zero - times[0],
            "arrival_sigma": v["arrival_sigma"],
        }
    if "acceleration" in v:
        row |= {
            "acceleration": v["acceleration"].value - t.acceleration,
            "acceleration_sigma": v["acceleration"].sigma,
        }
    return row


def wilson(good: int, of: int) -> str:
    """A share with its 95 % interval, in percent."""
    if not of:
        return "-"
    z, p = 1.96, good / of
    centre = (p + z * z / (2 * of)) / (1 + z * z / of)
    half = z / (1 + z * z / of) * np.sqrt(p * (1 - p) / of + z * z / (4 * of * of))
    low, high = 100 * max(centre - half, 0), 100 * min(centre + half, 1)
    return f"{good}/{of} = {100 * p:.1f} % ({low:.1f}-{high:.1f})"


def table(results: list[dict[str, Any]]) -> str:
    """Targets of the design for real records, and what was reached."""
    rows = [(r, t) for r in results for t in r["trains"]]
    told = [(r, t) for r, t in rows if t.get("passage")]
    whole = [(r, t) for r, t in told if not t["truncated"] and "count" in t]
    listed = [(r, t) for r, t in told if r["known"] in ("own", "many") and not t["truncated"]]
    lines = [
        f"recordings {len(results)}, errors {sum('error' in r for r in results)}, "
        f"CPU {sum(r.get('cpu', 0) for r in results):.0f} s",
        f"events: {wilson(sum(t['onset'] is not None for _, t in rows), len(rows))}",
        f"trains told: {wilson(len(told), len(rows))}",
        f"extra: {wilson(sum(r.get('extra', 0) for r in results), len(rows))}",
    ]
    late = [t["onset"] for _, t in rows if t["onset"] is not None and not t["truncated"]]
    lines.append(f"onset within 100 ms: {wilson(sum(x <= 0.1 for x in late), len(late))}")
    for name, limit in (("arrival", 0.02), ("departure", 0.03)):
        off = [abs(t[name]) for _, t in whole]
        lines.append(
            f"{name} within {1e3 * limit:.0f} ms: {wilson(sum(x <= limit for x in off), len(off))}"
            f", p50/p95 {1e3 * np.median(off):.1f}/{1e3 * np.percentile(off, 95):.1f} ms"
        )
    for rails, limit in ((2, 0.01), (1, 0.015)):
        for kind in ("own", "many", "without", "default"):
            some = [t for r, t in told if r["rails"] == rails and r["known"] == kind]
            if not some:
                continue
            off = [abs(t["speed"]) for t in some]
            ratio = [t["speed"] / t["sigma"] for t in some]
            lines.append(
                f"speed, {rails} rails, catalogue {kind}: within {100 * limit} % "
                f"{wilson(sum(x <= limit for x in off), len(off))}, p50/p95 "
                f"{100 * np.median(off):.2f}/{100 * np.percentile(off, 95):.2f} %, within 2 sigma "
                f"{wilson(sum(abs(x) < 1.96 for x in ratio), len(ratio))}, beyond {FAR:.0f} sigma and "
                f"limit {sum(abs(x) > FAR and y > limit for x, y in zip(ratio, off, strict=True))}"
            )
    sure = [t for _, t in listed if t["type"] != "unknown"]
    lines.append(f"count, type named: {wilson(sum(t['count'] == 0 for t in sure), len(sure))}")
    lines.append(f"type: {wilson(sum(t['type'] == t['train'] for t in sure), len(sure))}")
    blind = [t for _, t in whole if t["type"] == "unknown" and t["sure"]]
    unsure = sum(t["type"] == "unknown" and not t["sure"] for _, t in whole)
    lines.append(
        f"count, type unknown, confident: {wilson(sum(t['count'] == 0 for t in blind), len(blind))}"
        f"; not confident {unsure}"
    )
    absent = [t for r, t in told if r["known"] in ("without", "default") and not t["truncated"]]
    lines.append(
        f"absent type called unknown: "
        f"{wilson(sum(t['type'] == 'unknown' for t in absent), len(absent))}"
    )
    lines.append(
        f"listed type called unknown: "
        f"{wilson(sum(t['type'] == 'unknown' for _, t in listed), len(listed))}"
    )
    two = [t for r, t in told if r["rails"] == 2 and t["direction"]]
    lines.append(f"direction: {wilson(sum(t['direction'] > 0 for t in two), len(two))}")
    return "\n".join(lines)


def main() -> None:
    """Draw, judge, print."""
    parser = arguments(__doc__, 200)
    parser.add_argument("--first", type=int, default=0)
    options = parser.parse_args()
    first = OFFSET + SEEDS[options.set] + options.first
    results = []
    with ProcessPoolExecutor(options.workers) as pool:
        for result in pool.map(judge, range(first, first + options.runs)):
            results.append(result)
            if options.verbose:
                print(result, flush=True)
            if options.json:
                options.json.write_text(json.dumps(results, indent=1, default=float), "utf-8")
    print(table(results))


if __name__ == "__main__":
    main()
