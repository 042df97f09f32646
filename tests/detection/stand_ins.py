"""Tables of what the detector makes of stand-ins for other people's records: the command line and
the runs that :mod:`field_like`, :mod:`field_mixed` and :mod:`strain_like` share.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

Result: TypeAlias = dict[str, Any]

SEEDS = {"tuning": 1_000_000, "figures": 2_000_000}
"""First seeds of the sets, which never meet: settings are chosen on one, figures told of the other."""

FAR = 3.0
"""Standard uncertainties beyond which an answer is dishonest."""


def arguments(doc: str | None, runs: int) -> argparse.ArgumentParser:
    """The command line: runs, set, where results go."""
    parser = argparse.ArgumentParser(description=doc)
    parser.add_argument("--runs", type=int, default=runs)
    parser.add_argument("--set", choices=list(SEEDS), default="figures")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--verbose", action="store_true", help="print every result")
    parser.add_argument("--workers", type=int, default=1)
    return parser


def run(
    doc: str | None,
    rows: Mapping[str, Any],
    job: Callable[[Any, int], Result],
    line: Callable[[str, Sequence[Result]], str],
    head: str,
    offset: int = 0,
) -> None:
    """Run the command line and print the table.

    Args:
        doc: shown as help.
        rows: by name, what ``job`` is given with a seed.
        job: of one recording.
        line: of the table, from the name and the results.
        head: of the table.
        offset: of the seeds.
    """
    parser = arguments(doc, 20)
    parser.add_argument("--only", nargs="*", default=[], help="rows whose name contains this")
    options = parser.parse_args()
    print(head + "\n" + "|---" * (head.count("|") - 1) + "|")
    raw = []
    with ProcessPoolExecutor(options.workers) as pool:
        for index, (name, given) in enumerate(rows.items()):
            if options.only and not any(word in name for word in options.only):
                continue
            base = SEEDS[options.set] + offset + 1000 * index
            seeds = range(base, base + options.runs)
            results = []
            for seed, result in zip(seeds, pool.map(job, [given] * len(seeds), seeds), strict=True):
                results.append(result)
                raw.append({"row": name, "seed": seed, **result})
                if options.verbose:
                    print(seed, result, flush=True)
            print(line(name, results), flush=True)
    if options.json:
        options.json.write_text(json.dumps(raw, indent=1, default=float), "utf-8")


def spread(results: Sequence[Result], key: str, scale: float) -> str:
    """Median and 95 % of magnitudes."""
    v = scale * np.abs([r[key] for r in results if r.get(key) is not None])
    return f"{np.median(v):.2f}/{np.percentile(v, 95):.2f}" if v.size else "-"


def ratios(results: Sequence[Result], key: str, sigma: str) -> str:
    """Error over stated sigma: rms, share inside the 95 % interval, number beyond :data:`FAR`."""
    v = np.array([r[key] / r[sigma] for r in results if r.get(key) is not None])
    if not v.size:
        return "-"
    inside = np.mean(np.abs(v) < 1.96)
    return f"{np.sqrt(np.mean(v**2)):.2f} {inside:.2f} {np.sum(np.abs(v) > FAR)}"
