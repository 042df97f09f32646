"""A detector's figures held against targets, cell by cell, as Markdown."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binom, chi2

from trackvib_ros.detection import Catalogue
from trackvib_ros.evaluate import BagScore, Evaluation, PassageScore
from trackvib_ros.nuisances import Calm
from trackvib_ros.scores import STATED, calibration, f1, spread, standardised

ONE_RAIL = ("one rail", "one rail, family known", "one rail, type known")
CALIBRATED = (0.9, 1.1)
COVERED = (0.93, 0.97)
LEAST_FOR_SIGMA = 40
"""Fewer passages tell too little of an rms and of a part of 95 %: no verdict."""
CHANCE = 0.05
"""A miss is within chance if sigmas that are exactly right miss as far in so many trials."""
DISHONEST = 4.0
"""Errors beyond so many sigma are listed one by one."""

DEFINITIONS = """\
Passages are those of the solver; `plain` means one train at constant speed on sound wheels before
sound sensors. The signal-to-noise ratio is the rms of a sensor's clean samples from the first to
the last wheelset over the rms of the white noise in them (0 Hz to half the sampling rate). Errors
are absolute; speed is that at the middle of the train as it passes the reference sensor. An arrival
is *told* when its event comes out of the detector, fed with blocks of 20 ms. *Two rails* are two
sensors 20 m apart, *one rail* is the first of them alone; *type known* leaves the detector one
type, *family known* the types of one family. `n` counts passages (for extra trains recordings, for
wheelset times wheelsets, for stated intervals values, for disturbances minutes). A miss of a sigma
is *within chance* if of independent normal errors of exactly that sigma one set of `n` in twenty is
as far from an rms of 1 or from 95 %."""


@dataclass(frozen=True)
class Cell:
    """One figure and its target.

    Attributes:
        quantity: what is told.
        condition: of which passages.
        target: as text.
        reached: as text.
        number: of passages (or whatever is counted) behind it.
        passed: None if there is nothing to compare.
        misses: the cases that do not keep the target, with what was told.
        chance: whether the target may have been missed by the choice of passages alone.
    """

    quantity: str
    condition: str
    target: str
    reached: str
    number: int
    passed: bool | None
    misses: tuple[str, ...] = ()
    chance: bool = False

    @property
    def verdict(self) -> str:
        """The last column of the table."""
        if self.passed is None:
            return ""
        if self.passed:
            return "reached"
        return "**missed**, within chance" if self.chance else "**missed**"


def within_chance(rms: float, held: int, number: int) -> bool:
    """Whether ``number`` errors of exactly the stated sigma may look like this.

    The sum of squares is chi-square with ``number`` degrees of freedom, the count inside the 95 %
    interval binomial; neither may lie in a tail of :data:`CHANCE` / 4, so that both together leave
    :data:`CHANCE` (Bonferroni).

    Args:
        rms: of error over sigma, -.
        held: errors inside the stated 95 % interval, -.
        number: of independent errors, -.
    """
    square = number * rms**2
    tails = (
        chi2.cdf(square, number),
        chi2.sf(square, number),
        binom.cdf(held, number, 0.95),
        binom.sf(held - 1, number, 0.95),
    )
    return bool(min(tails) > CHANCE / 4)


def _snr(factors: dict[str, Any]) -> float:
    value = factors.get("snr_db")
    return 99.0 if value is None else float(value)


def plain(factors: dict[str, Any]) -> bool:
    """Whether a bag holds one train at constant speed on sound wheels before sound sensors."""
    return (
        factors.get("fault", "none") == "none"
        and not factors.get("flats")
        and not factors.get("acceleration")
        and not factors.get("gap")
    )


def views_for(factors: dict[str, Any]) -> list[str]:
    """The views in which the table needs a bag."""
    views = ["rails"]
    listed = factors.get("train") in {train.name for train in Catalogue.default()}
    if plain(factors) and _snr(factors) >= 10:
        views += ONE_RAIL if listed else ONE_RAIL[:1]
        if _snr(factors) >= 20:
            views += ["slab, type known", "bridge, type known"] if listed else []
            views += ["bridge"]
    return views


def _name(p: PassageScore) -> str:
    place = f" train {p.number}" if p.factors.get("gap") else ""
    return f"{Path(p.bag).name}{place}"


def _facts(p: PassageScore) -> str:
    f = p.factors
    facts = [f"{_snr(f):.0f} dB", str(f.get("scenario", ""))]
    facts += [f"{f['acceleration']} m/s²"] if f.get("acceleration") else []
    facts += [f"gap {f['gap']} s"] if f.get("gap") else []
    facts += [f"{f['flats']} flats"] if f.get("flats") else []
    facts += [str(f["fault"])] if f.get("fault", "none") != "none" else []
    told = f"told {p.found_type or 'nothing'}"
    return f"`{_name(p)}` ({', '.join(facts)}; {told})"


class Accuracy:
    """The table of one evaluation.

    Args:
        result: scores; views that are missing leave their cells empty.
        calm: what the detector said of disturbances, if that was tried.
    """

    def __init__(self, result: Evaluation, calm: Calm | None = None) -> None:
        self.result = result
        self.calm = calm
        self.cells: list[Cell] = []
        self._fill()

    def _bags(self, view: str, keep: Callable[[dict[str, Any]], bool]) -> list[BagScore]:
        return [b for b in self.result.bags if b.view == view and keep(b.factors)]

    def _passages(
        self,
        view: str,
        keep: Callable[[dict[str, Any]], bool] = lambda f: True,
        listed: bool | None = True,
        least_snr: float = 10,
    ) -> list[PassageScore]:
        bags = self._bags(view, lambda f: keep(f) and _snr(f) >= least_snr)
        known = {train.name for train in Catalogue.default()}
        return [
            p for b in bags for p in b.passages if listed is None or (p.train in known) == listed
        ]

    def _fill(self) -> None:
        self._events()
        self._times()
        self._speeds()
        self._wheelsets()
        self._kinds()
        self._gaps()
        self._nuisances()
        self._intervals()
        self._calibration()

    def _add(self, cell: Cell) -> None:
        if cell.number:
            self.cells.append(cell)

    def _error(
        self,
        quantity: str,
        condition: str,
        passages: Sequence[PassageScore],
        value: Callable[[PassageScore], float | None],
        limit: float | None,
        unit: str,
        median: float | None = None,
    ) -> None:
        """A cell of absolute errors with a limit on their 95 % (and on their median)."""
        known = [(p, v) for p in passages if (v := value(p)) is not None]
        if not passages:
            return
        target = "–" if limit is None else f"p95 {limit:g} {unit}"
        target += "" if median is None else f", p50 {median:g} {unit}"
        silent = len(passages) - len(known)
        if not known:
            cell = Cell(quantity, condition, target, "not told", len(passages), False)
            self._add(cell)
            return
        errors = np.array([abs(v) for _, v in known])
        half, most = float(np.percentile(errors, 50)), float(np.percentile(errors, 95))
        text = f"p50 {half:.3g}, p95 {most:.3g}, worst {errors.max():.3g} {unit}"
        text += f"; {silent} not told" if silent else ""
        passed = None
        misses: tuple[str, ...] = ()
        if limit is not None:
            passed = most <= limit and (median is None or half <= median)
            # what is not told fails as well, if it is more than one in twenty
            passed = passed and silent <= 0.05 * len(passages)
            worst = sorted(known, key=lambda item: -abs(item[1]))
            misses = tuple(f"{_facts(p)}: {v:+.3g} {unit}" for p, v in worst if abs(v) > limit)
        self._add(Cell(quantity, condition, target, text, len(passages), passed, misses))

    def _rate(
        self,
        quantity: str,
        condition: str,
        passages: Sequence[PassageScore],
        right: Callable[[PassageScore], bool],
        least: float,
        told: Callable[[PassageScore], str] = lambda p: "",
    ) -> None:
        """A cell of the part of passages that are right."""
        if not passages:
            return
        wrong = [p for p in passages if not right(p)]
        part = 1 - len(wrong) / len(passages)
        self._add(
            Cell(
                quantity,
                condition,
                f"≥ {100 * least:g} %" if least < 1 else "100 %",
                f"{100 * part:.2f} % ({len(wrong)} wrong)",
                len(passages),
                part >= least,
                tuple(f"{_facts(p)}: {told(p)}" for p in wrong),
            )
        )

    def _events(self) -> None:
        single = self._passages("rails", lambda f: not f.get("gap"), None, -99)
        self._rate(
            "trains detected",
            "single trains, all noise levels, faults and types",
            single,
            lambda p: p.detected,
            1.0,
            lambda p: f"{p.speed_kmh:.0f} km/h, missed",
        )
        bags = self._bags("rails", lambda f: True)
        extra = [b for b in bags if b.extra]
        self._add(
            Cell(
                "extra trains",
                "all recordings",
                "0",
                f"{sum(b.extra for b in bags)}",
                len(bags),
                not extra,
                tuple(f"`{Path(b.bag).name}`: {b.extra} extra" for b in extra),
            )
        )

    def _times(self) -> None:
        onsets: dict[str, Callable[[PassageScore], float | None]] = {
            "onset: stamp after the first wheelset": lambda p: p.onset_s,
            "onset: told after the first wheelset (20 ms blocks)": lambda p: p.declared_s,
        }
        single = self._passages("rails", lambda f: not f.get("gap"), None, -99)
        for condition, noisy in (("≥ 10 dB", False), ("0 dB", True)):
            everything = [p for p in single if (_snr(p.factors) < 10) == noisy]
            for quantity, get in onsets.items():
                late = [(p, 1e3 * v) for p in everything if (v := get(p)) is not None]
                if not late:
                    continue
                values = np.array([v for _, v in late])
                most = float(np.percentile(values, 95))
                self._add(
                    Cell(
                        quantity,
                        condition,
                        "p95 ≤ 30 ms",
                        f"p50 {np.median(values):.0f}, p95 {most:.0f}, "
                        f"latest {values.max():.0f} ms",
                        len(late),
                        most <= 30,
                        tuple(f"{_facts(p)}: {v:+.0f} ms" for p, v in late if v > 30),
                    )
                )
        main = self._passages("rails", lambda f: not f.get("gap"))
        self._error("arrival, refined", "two rails, ≥ 10 dB", main,
                    lambda p: _scaled(p.arrival_s, 1e3), 5, "ms")  # fmt: skip
        self._error("departure, refined", "two rails, ≥ 10 dB", main,
                    lambda p: _scaled(p.departure_s, 1e3), 8, "ms")  # fmt: skip
        self._error("final message after the last wheelset", "two rails, ≥ 10 dB",
                    self._passages("rails", listed=None),
                    lambda p: p.latency_s, 3, "s")  # fmt: skip

    def _speeds(self) -> None:
        def percent(p: PassageScore) -> float | None:
            return _scaled(p.speed_error, 100)

        passages = self._passages
        self._error(
            "speed, two rails 20 m apart",
            "plain, ≥ 10 dB",
            passages("rails", plain),
            percent,
            0.4,
            "%",
            0.12,
        )
        for name, keep in _HARD.items():
            self._error(
                "speed, two rails 20 m apart", name, passages("rails", keep), percent, 0.4, "%"
            )
        self._error(
            "speed, two rails 20 m apart", "plain, 0 dB",
            passages("rails", lambda f: plain(f) and _snr(f) < 10, True, -99), percent, None, "%"
        )  # fmt: skip
        early = (("the first bogies", 0, 1.8, 0.5), ("eight wheelsets", 1, 1.3, 0.22))
        for after, number, most, half in early:

            def told(p: PassageScore, number: int = number) -> float | None:
                return 100 * p.updates[number][0] if len(p.updates) > number else None

            name = f"provisional speed after {after}, two rails"
            clear, all_ = (passages("rails", plain, True, least) for least in (20, 10))
            self._error(name, "plain, ≥ 20 dB", clear, told, most, "%", half)
            self._error(name, "plain, ≥ 10 dB", all_, told, None, "%")
        for view, limit in zip(ONE_RAIL, (None, 0.9, 0.4), strict=True):
            name = "nothing known" if view == "one rail" else view.removeprefix("one rail, ")
            self._error(
                f"speed, one rail, {name}",
                "plain, ≥ 10 dB",
                passages(view, plain),
                percent,
                limit,
                "%",
            )
        for layer in ("bridge", "slab"):
            self._error(
                f"speed, {layer} alone, type known",
                "plain, ≥ 20 dB",
                passages(f"{layer}, type known", plain, True, 20),
                percent,
                0.3 if layer == "bridge" else None,
                "%",
            )
        sure = [p for p in passages("bridge", plain, True, 20) if p.found_type != "unknown"]
        self._error("speed, bridge alone, nothing known", "a type was named, plain, ≥ 20 dB",
                    sure, percent, None, "%")  # fmt: skip
        for view, limit in (("rails", 0.6), ("one rail", 2.0)):
            self._error(
                f"speed of a type absent from the catalogue, {view}",
                "≥ 10 dB",
                passages(view, listed=False),
                percent,
                limit,
                "%",
            )
        accelerated = passages("rails", _HARD["acceleration"])
        eight = [p for p in accelerated if p.train in ("CRH3", "locomotive_hauled")]
        for name, chosen in (("8 cars", eight), ("all types", accelerated)):
            self._error(
                "acceleration", f"±0.8 m/s², {name}, ≥ 10 dB", chosen,
                lambda p: p.acceleration_error, 0.2, "m/s²",
            )  # fmt: skip

    def _wheelsets(self) -> None:
        def told(p: PassageScore) -> str:
            return f"{p.axles_found} of {p.axles_true} wheelsets"

        for condition, low, high, least, least_f1 in (
            ("≥ 20 dB", 20.0, 999.0, 1.0, 0.995),
            ("0–10 dB", -99.0, 20.0, 0.98, 0.97),
        ):
            chosen = [p for p in self._passages("rails", least_snr=low) if p.detected]
            chosen = [p for p in chosen if _snr(p.factors) < high]
            self._rate(
                "wheelset count, type in the catalogue",
                condition,
                chosen,
                lambda p: p.axles_found == p.axles_true,
                least,
                told,
            )
            if chosen:
                precision, recall, both = f1(chosen)
                worst = [p for p in chosen if p.axles_right < 0.9 * p.axles_true]
                self._add(
                    Cell(
                        "wheelsets, F1",
                        condition,
                        f"≥ {least_f1}",
                        f"{both:.4f} (precision {precision:.4f}, recall {recall:.4f})",
                        len(chosen),
                        both >= least_f1,
                        tuple(f"{_facts(p)}: {p.axles_right} right" for p in worst),
                    )
                )
        absent = [p for p in self._passages("rails", listed=False) if p.detected]
        slow = [p for p in absent if p.speed_kmh <= 250]
        self._rate(
            "wheelset count, type absent from the catalogue",
            "≤ 250 km/h, ≥ 10 dB",
            slow,
            lambda p: p.axles_found == p.axles_true,
            0.85,
            lambda p: told(p) + ("" if p.confident else ", said not confident"),
        )
        self._rate(
            "wheelset count right or said to be not confident, type absent",
            "all speeds, ≥ 10 dB",
            absent,
            lambda p: p.axles_found == p.axles_true or not p.confident,
            0.85,
            told,
        )

    def _kinds(self) -> None:
        found = [p for p in self._passages("rails") if p.detected]
        self._rate(
            "family",
            "type in the catalogue, ≥ 10 dB",
            found,
            lambda p: p.found_family == p.family,
            0.98,
            lambda p: f"family {p.found_family or 'unknown'}",
        )
        named = [p for p in found if p.found_family]
        self._rate(
            "articulated against conventional",
            "a type was named, ≥ 10 dB",
            named,
            lambda p: ("articulated" in p.found_family) == ("articulated" in p.family),
            1.0,
            lambda p: f"family {p.found_family}",
        )
        absent = [p for p in self._passages("rails", listed=False) if p.detected]
        self._rate(
            "type absent from the catalogue called unknown",
            "two rails, ≥ 10 dB",
            absent,
            lambda p: p.found_type in ("unknown", ""),
            0.98,
        )
        for condition, listed in (("type in the catalogue", True), ("type absent", False)):
            self._rate(
                "family right or said to be unknown, bridge alone",
                f"{condition}, plain, ≥ 20 dB",
                [p for p in self._passages("bridge", plain, listed, 20) if p.detected],
                lambda p: p.found_type in ("unknown", "") or p.found_family == p.family,
                0.97,
                lambda p: f"family {p.found_family}",
            )
        both = [p for p in self._passages("rails", listed=None) if p.detected]
        self._rate(
            "direction",
            "two rails, ≥ 10 dB",
            both,
            lambda p: p.direction_right is True,
            1.0,
            lambda p: f"told {p.direction}",
        )
        one = [p for p in self._passages("one rail", listed=None) if p.detected]
        self._rate(
            "direction told as unknown",
            "one rail",
            one,
            lambda p: p.direction_right is None,
            1.0,
            lambda p: f"told {p.direction}",
        )

    def _gaps(self) -> None:
        bags = self._bags("rails", lambda f: bool(f.get("gap")))
        for condition, low, high, least in (
            ("gaps from 1.5 s", 1.5, 99.0, 1.0),
            ("gaps below 1.5 s", 0.0, 1.5, None),
        ):
            chosen = [b for b in bags if low <= b.factors["gap"] < high]
            bad = [b for b in chosen if b.extra or not all(p.detected for p in b.passages)]
            if chosen:
                self._add(
                    Cell(
                        "two trains, one after the other, told apart",
                        condition,
                        "all" if least else "–",
                        f"{len(chosen) - len(bad)} of {len(chosen)}",
                        len(chosen),
                        not bad if least else None,
                        tuple(
                            f"{_facts(b.passages[0])}: "
                            f"{sum(p.detected for p in b.passages)} trains, {b.extra} extra"
                            for b in bad
                        ),
                    )
                )

    def _nuisances(self) -> None:
        if self.calm is None:
            return
        events = sum(self.calm.events.values())
        self._add(
            Cell(
                "trains confirmed in disturbances",
                f"{self.calm.hours:.3g} h, {len(self.calm.events)} kinds, two rails",
                "0",
                f"{len(self.calm.trains)} (and {events} vibration events)",
                round(self.calm.hours * 60),
                not self.calm.trains,
                tuple(f"{kind}, seed {seed}" for kind, seed in self.calm.trains),
            )
        )

    def _calibration(self) -> None:
        sets = {
            "two rails, plain, ≥ 10 dB": self._passages("rails", plain),
            "two rails, all listed, ≥ 10 dB": self._passages("rails"),
            "one rail, plain, ≥ 10 dB": self._passages("one rail", plain),
            "two rails, absent types, ≥ 10 dB": self._passages("rails", listed=False),
            "one rail, absent types, ≥ 10 dB": self._passages("one rail", listed=False),
            "bridge, plain, ≥ 20 dB": self._passages("bridge", plain, None, 20),
        }
        for condition, passages in sets.items():
            found = [p for p in passages if p.detected]
            for quantity, row in calibration(found).items():
                number = int(row["number"])
                good, chance = None, False
                if number >= LEAST_FOR_SIGMA:
                    good = (
                        CALIBRATED[0] <= row["rms"] <= CALIBRATED[1]
                        and COVERED[0] <= row["within_95"] <= COVERED[1]
                    )
                    # the wheelsets of a train share its error: not independent
                    chance = quantity in STATED and within_chance(
                        row["rms"], round(number * row["within_95"]), number
                    )
                beyond = [
                    (p, r)
                    for p in (found if quantity in STATED else ())
                    if (r := max(STATED[quantity](p), key=abs, default=0.0)) and abs(r) > DISHONEST
                ]
                beyond.sort(key=lambda item: -abs(item[1]))
                self._add(
                    Cell(
                        f"error / sigma of {quantity}",
                        condition,
                        "rms 0.9–1.1, 95 % interval holds 93–97 %",
                        f"rms {row['rms']:.2f}, holds {100 * row['within_95']:.1f} %",
                        number,
                        good,
                        tuple(f"{_facts(p)}: {r:+.1f} sigma" for p, r in beyond),
                        chance,
                    )
                )

    def _intervals(self) -> None:
        """All stated 95 % intervals of a view together, but those of wheelset times."""
        for view, condition, least in (
            ("rails", "two rails, all passages, ≥ 10 dB", 10),
            ("one rail", "one rail, all passages, ≥ 10 dB", 10),
            ("bridge", "bridge, all passages, ≥ 20 dB", 20),
        ):
            found = [p for p in self._passages(view, listed=None, least_snr=least) if p.detected]
            ratios = np.concatenate(list(standardised(found).values()))
            if not ratios.size:
                continue
            part = float(np.mean(np.abs(ratios) < 1.96))
            self._add(
                Cell(
                    "stated 95 % intervals, all quantities",
                    condition,
                    "hold the truth 93–97 % of the time",
                    f"{100 * part:.2f} %; {np.sum(np.abs(ratios) > DISHONEST)} "
                    f"beyond {DISHONEST:g} sigma",
                    ratios.size,
                    COVERED[0] <= part <= COVERED[1],
                )
            )

    def _by_noise(self) -> list[str]:
        """Rows of plain passages of listed types, one per noise level."""
        lines = [
            "| SNR, dB | n | detected | count right | F1 | one rail, p50/p95 % "
            "| one rail, type known % | two rails % | arrival p50/p95 ms | departure p95 ms |",
            "|---|---|---|---|---|---|---|---|---|---|",
        ]

        def pair(values: Sequence[float | None], scale: float, digits: int) -> str:
            known = spread(values, scale)
            if not known:
                return "–"
            return f"{known['median']:.{digits}f} / {known['p95']:.{digits}f}"

        two = self._passages("rails", plain, True, -99)
        for snr in sorted({_snr(p.factors) for p in two}, reverse=True):
            rows = {
                view: [p for p in self._passages(view, plain, True, -99) if _snr(p.factors) == snr]
                for view in ("rails", "one rail", "one rail, type known")
            }
            found = [p for p in rows["rails"] if p.detected]
            departures = spread([p.departure_s for p in found], 1e3)
            counted = sum(p.axles_found == p.axles_true for p in found)
            cells = [
                "as given" if snr == 99 else f"{snr:g}",
                str(len(rows["rails"])),
                f"{len(found) / len(rows['rails']):.3f}",
                f"{counted / max(1, len(found)):.3f}",
                f"{f1(rows['rails'])[2]:.3f}",
                *(
                    pair([p.speed_error for p in rows[view]], 100, 3)
                    for view in ("one rail", "one rail, type known", "rails")
                ),
                pair([p.arrival_s for p in found], 1e3, 1),
                f"{departures['p95']:.1f}" if departures else "–",
            ]
            lines.append("| " + " | ".join(cells) + " |")
        return lines

    def markdown(self, title: str, list_misses: int = 8) -> str:
        """The table, then the cases behind every miss, at most ``list_misses`` a cell."""
        passages = [p for p in self.result.passages if p.view == "rails"]
        verdicts = [cell.passed for cell in self.cells if cell.passed is not None]
        lines = [
            f"# {title}",
            "",
            f"Detector `{self.result.detector}`: {len(passages)} passages in "
            f"{len(self._bags('rails', lambda f: True))} recordings; "
            f"{sum(verdicts)} of {len(verdicts)} targets reached, "
            f"{sum(cell.chance for cell in self.cells if not cell.passed)} more missed within "
            "chance.",
            "",
            DEFINITIONS,
            "",
            "| quantity | of | n | target | reached | |",
            "|---|---|---|---|---|---|",
        ]
        lines += [
            f"| {c.quantity} | {c.condition} | {c.number} | {c.target} | {c.reached} "
            f"| {c.verdict} |"
            for c in self.cells
        ]
        lines += ["", "## By noise level", "", *self._by_noise()]
        lines += ["", "## Cases beyond a target", ""]
        for cell in self.cells:
            if not cell.misses:
                continue
            lines.append(f"- **{cell.quantity}**, {cell.condition} ({cell.target}):")
            lines += [f"  - {miss}" for miss in cell.misses[:list_misses]]
            rest = len(cell.misses) - list_misses
            lines += [f"  - and {rest} more"] if rest > 0 else []
        problems = [b for b in self.result.bags if b.problem]
        if problems:
            lines += ["", "## Recordings that could not be scored", ""]
            lines += [f"- `{Path(b.bag).name}`, {b.view}: {b.problem}" for b in problems]
        return "\n".join(lines) + "\n"


def _scaled(value: float | None, factor: float) -> float | None:
    return None if value is None else factor * value


_HARD: dict[str, Callable[[dict[str, Any]], bool]] = {
    "acceleration": lambda f: bool(f.get("acceleration")),
    "flats": lambda f: bool(f.get("flats")),
    "clipping": lambda f: f.get("fault") == "clipping",
    "dropouts": lambda f: f.get("fault") == "dropouts",
    "two trains": lambda f: bool(f.get("gap")),
}
