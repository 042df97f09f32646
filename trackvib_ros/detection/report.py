"""From what was found to the events that are told."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from . import stated
from .blind import CONFIDENT, Blind
from .catalogue import Catalogue, TrainType
from .events import CONFIRMED, VIBRATION, Channel, Estimate, TrainEvent, Value
from .health import clipped
from .live import Partial
from .passage import CONFIRM_SCORE, KNOWN_SCORE, Hypothesis, Passage
from .record import Record
from .response import CONFIRM_EVIDENCE, ResponsePassage
from .summary import DIRECTION, Summary
from .unlisted import CAR

Array = NDArray[np.float64]

_UNITS = {1: "single", 2: "double"}
_MARGIN_S = 0.15  # of a record about the strong energy of a train that is wholly on it
_MARGIN = 0.5  # m, the same about its wheelsets if these are known
_ONSET_SIGMA = 0.02  # s, length of the short-term averages


def arrival(channel: Channel, stamp_ns: int, ratio: float) -> TrainEvent:
    """The event told at once: energy rose; whether it is a train is not known yet."""
    return TrainEvent(
        kind="arrival",
        stamp_ns=stamp_ns,
        sigma_s=_ONSET_SIGMA,
        confidence=float(np.clip(1 - 0.5 / ratio, 0.5, 0.95)),
        method="energy over noise floor",
        sensors=(channel.name,),
        values={"grade": VIBRATION, "reference_x": Estimate(channel.x, 0.0, "m")},
    )


def update(found: Partial, now_ns: int) -> TrainEvent:
    """A provisional speed while the train passes."""
    values: dict[str, Value] = {
        "speed": Estimate(found.speed, found.sigma, "m/s"),
        "direction": DIRECTION[found.direction],
        "passed": Estimate(found.distance, 2.0, "m"),
    }
    if found.types:
        values |= {
            "passed": Estimate(found.distance, found.distance * found.sigma / found.speed, "m"),
            "families": found.families,
            "types": found.types,
        }
    return TrainEvent(
        kind="update",
        stamp_ns=now_ns,
        sigma_s=0.0,
        confidence=float(np.clip(found.score, 0.0, 0.95)),
        method=found.method,
        sensors=found.sensors,
        values=values,
        quality=("provisional",),
    )


def truncated(
    catalogue: Catalogue, found: Partial, origin_ns: int, end_ns: int
) -> list[TrainEvent]:
    """Departure and summary of a train that lacks an end or both on record: no count, no type.

    Args:
        catalogue: for its version and its longest train.
        found: the part on record, with its first or its last wheelset if that is.
        origin_ns: what its times (s) are from: the start of the record if that lies in the train.
        end_ns: end of the record if that lies in the train.
    """
    longest = max(train.span for train in catalogue)
    # a train may have begun to pass as long before as the longest one takes, or go on as long
    unseen = max(longest - found.distance, 0.0) / found.speed
    unseen += max((edge[1] for edge in (found.start, found.end) if edge), default=0.0)
    arrival, departure = (origin_ns, unseen), (end_ns, unseen)
    flags, methods, ends = [], [found.method, found.method], {}
    if found.start is None:
        flags.append("truncated_start")
        methods[0] += "; stamped with the start of the record, arrival unknown"
    else:
        arrival = origin_ns + round(found.start[0] * 1e9), found.start[1]
        ends = {"arrival_ns": arrival[0], "arrival_sigma": arrival[1]}
    if found.end is None:
        flags.append("truncated_end")
        methods[1] += "; stamped with the end of the record, departure unknown"
    else:
        departure = origin_ns + round(found.end[0] * 1e9), found.end[1]
        ends |= {"departure_ns": departure[0], "departure_sigma": departure[1]}
    confidence = float(np.clip(found.score, 0.0, 0.95))
    place = Estimate(found.x, 0.0, "m")
    part = found.distance * found.sigma / found.speed
    shown: dict[str, Value] = {}
    if found.types:
        shown[f"types_of_the_{'end' if found.start is None else 'beginning'}"] = found.types
    return [
        TrainEvent(
            kind="departure",
            stamp_ns=departure[0],
            sigma_s=departure[1],
            confidence=confidence,
            method=methods[1],
            sensors=found.sensors,
            values={"grade": CONFIRMED, "reference_x": place},
            quality=tuple(flags),
        ),
        TrainEvent(
            kind="passage",
            stamp_ns=arrival[0],
            sigma_s=arrival[1],
            confidence=confidence,
            method=methods[0],
            sensors=found.sensors,
            values={
                "grade": CONFIRMED,
                "reference": found.sensors[0],
                "reference_x": place,
                **ends,
                "speed": Estimate(found.speed, found.sigma, "m/s"),
                "speed_at": "middle of the part on record at the reference point",
                "direction": DIRECTION[found.direction],
                "type": "unknown",
                **shown,
                "families": found.families,
                "cars": "unknown",
                "units": "unknown",
                "on_record": Estimate(found.distance, part, "m"),
                "score": round(float(found.score), 4),
                "catalogue": catalogue.version,
            },
            quality=tuple(flags),
        ),
    ]


def closing(
    catalogue: Catalogue,
    records: Sequence[Record],
    origin_ns: int,
    within: tuple[float, float],
    found: Sequence[Passage],
) -> list[TrainEvent]:
    """The events at the end of an event: per train its wheelsets, departure and summary."""
    events: list[TrainEvent] = []
    trains = [passage for passage in found if passage.confirmed]
    if not trains:
        score = max((p.score for p in found), default=0.0)
        return unclear(records, origin_ns + round((within[1] - 0.3) * 1e9), (), score)
    for passage in trains:
        quality = [*passage.quality, *_window_flags(records, passage)]
        if passage.blind is not None and _prefer_blind(passage, passage.blind):
            events += _unknown(catalogue, origin_ns, passage, passage.blind, quality)
        else:
            events += _train(catalogue, origin_ns, passage, quality)
    return events


def unclear(
    records: Sequence[Record], last_ns: int, flags: Sequence[str], score: float = 0.0
) -> list[TrainEvent]:
    """End of a vibration that no train explains, with the score of the best pattern."""
    return [
        TrainEvent(
            kind="departure",
            stamp_ns=last_ns,
            sigma_s=0.1,
            confidence=0.5,
            method="energy back at noise floor",
            sensors=tuple(r.channel.name for r in records),
            values={"grade": VIBRATION, "score": score},
            quality=(*flags, "low_score"),
        )
    ]


def _window_flags(records: Sequence[Record], passage: Passage) -> list[str]:
    """Flags from the samples: clipped, gaps, record shorter than the train."""
    flags = cut_off(records, passage)
    for record, start, stop in _passing(records, passage):
        window = record.window
        inside = (window.time >= start) & (window.time <= stop)
        if clipped(window, inside):
            flags.add("clipped")
        if np.mean(window.holes[inside]) > 0.002 or not window.valid[inside].all():
            flags.add("gaps")
    if passage.known and _overlapped(passage):
        flags.add("overlap")
    return sorted(flags)


def cut_off(records: Sequence[Record], passage: Passage) -> set[str]:
    """The ends of a train, ``truncated_start`` or ``truncated_end``, that a record hardly shows."""
    margin = _MARGIN_S
    if passage.known:
        best = passage.hypotheses[0]
        margin = _MARGIN / float(best.fit.motion.speed_at(best.mid_time))
    flags = set()
    for record, start, stop in _passing(records, passage):
        if start - record.window.time[0] < margin:
            flags.add("truncated_start")
        if record.window.time[-1] - stop < margin:
            flags.add("truncated_end")
    return flags


def _passing(records: Sequence[Record], passage: Passage) -> Iterator[tuple[Record, float, float]]:
    """The rail channels that show a train, from when to when (s)."""
    start, stop = passage.interval
    for record in records:
        if passage.known:
            best = passage.hypotheses[0]
            way = passage.direction * (record.channel.x - passage.traces[0].x)
            start, stop = (float(best.fit.motion.time_at(best.places[i] + way)) for i in (0, -1))
        time = record.window.time
        if record.channel.layer == "rail" and np.any((time >= start) & (time <= stop)):
            yield record, start, stop


def _overlapped(passage: Passage) -> bool:
    """Whether strong energy goes on beside a train of a known type, as that of another one does.

    What the rail carries is heard before the first wheelset as behind the last; what is heard on
    one side for longer than the longest gap of the train is no wheelset of it.
    """
    best = passage.hypotheses[0]
    strong = best.fit.motion.distance_at(np.array(passage.interval))
    ahead, behind = strong - best.places[[0, -1]]
    longest = float(np.max(np.diff(best.places)))
    return bool(abs(max(behind, 0.0) - max(-ahead, 0.0)) > longest)


def _prefer_blind(passage: Passage, blind: Blind) -> bool:
    """Whether pulses tell more of an unknown train than the nearest pattern of the catalogue."""
    if blind.travels or blind.cars:
        return True
    if not passage.hypotheses or passage.score < KNOWN_SCORE:
        return blind.direction != 0 or passage.score < CONFIRM_SCORE or blind.regular >= 0.9
    pattern = passage.hypotheses[0].places.size
    return blind.regular >= 0.9 and blind.direction != 0 and blind.times.size != pattern


def families(hypotheses: Sequence[Hypothesis]) -> tuple[tuple[str, float], ...]:
    """Families with their summed probabilities, most probable first."""
    total: dict[str, float] = {}
    for h in hypotheses:
        total[h.train.family] = total.get(h.train.family, 0.0) + h.probability
    return tuple(
        (name, round(p, 4)) for name, p in sorted(total.items(), key=lambda i: -i[1]) if p > 1e-3
    )


def _train(
    catalogue: Catalogue,
    origin_ns: int,
    passage: Passage,
    quality: Sequence[str],
) -> list[TrainEvent]:
    best = passage.hypotheses[0]
    fit, train = best.fit, best.train
    motion = fit.motion
    names = tuple(trace.name for trace in passage.traces)
    method = "axle pattern" if len(names) == 1 else "axle pattern and delay, joint regression"
    places = best.places

    def stamp(time: float) -> int:
        return origin_ns + round(time * 1e9)

    axle_times, axle_sigmas = stated.wheelsets(passage)
    events: list[TrainEvent] = []
    reference = passage.traces[0]
    confidences = []
    for i in range(places.size):
        seen = bool(fit.used[0, i])
        time = float(axle_times[i])
        clear = 1 / (1 + np.exp(-3 * (float(fit.contrast[0, i]) - 0.5)))
        confidence = best.score * (clear if seen else 0.3)
        confidences.append(confidence)
        events.append(
            TrainEvent(
                kind="axle",
                stamp_ns=stamp(time),
                sigma_s=float(axle_sigmas[i]),
                confidence=float(np.clip(confidence, 0.01, 0.99)),
                method="pulse shift by maximum likelihood" if seen else "predicted by the motion",
                sensors=(reference.name,),
                values={"number": i + 1, "position": Estimate(float(places[i]), 0.05, "m")},
            )
        )
    known = passage.known
    found = stated.speed(passage)
    speed, sigma = found.value, found.sigma
    first, last = stated.ends(passage, speed)
    if not known:
        # its wheelsets are those of the nearest type
        quality = [*quality, "unknown_type", "axle_count_not_confident"]
    passing_sigma = 2**0.5 * fit.scale / speed
    summary = Summary(
        sensors=names,
        x=reference.x,
        arrival=first,
        departure=last,
        passing_sigma=passing_sigma,
        speed=(speed, sigma),
        interval=found.interval,
        acceleration=(motion.acceleration, motion.acceleration_sigma),
        direction=passage.direction,
        method=method,
        confidence=float(np.clip(best.score, 0.0, 0.99)),
        quality=tuple(quality),
    )
    values: dict[str, Value] = {
        "axle_count": int(places.size),
        "type_probability": round(best.probability, 4),
        "families": families(passage.hypotheses),
        "unknown_probability": round(passage.unknown, 4),
        "types": tuple(
            (h.train.name, round(h.probability, 4))
            for h in passage.hypotheses
            if h.probability > 1e-3
        ),
        "score": round(best.score, 4),
        "speed_template": Estimate(*found.template, "m/s"),
    }
    if known:
        values["speed_of"] = found.types
        duration = summary.duration
        values |= _identity(train, best.reverse) | {
            "train_length": Estimate(train.length, train.length * found.template_sigma, "m"),
            "speed_passing_time": Estimate(
                train.span / duration, train.span / duration**2 * passing_sigma, "m/s"
            ),
        }
    else:
        passed = np.where(fit.used[0], fit.time[0], motion.time_at(places))
        gaps = np.diff(motion.distance_at(passed))
        length = train.length - train.span + float(gaps.sum())
        values |= {
            "reversed": "unknown" if train.symmetric else ("yes" if best.reverse else "no"),
            "train_length": Estimate(length, float(np.hypot(length * sigma / speed, 1.0)), "m"),
            **_spacings(gaps, float(np.hypot(0.2, 2.5 * sigma / speed))),
        }
    if passage.delay is not None:
        values["speed_delay"] = Estimate(*passage.delay, "m/s")
    if passage.baseline is not None:
        correction, uncertainty, learned = passage.baseline
        values["baseline_correction"] = Estimate(correction, uncertainty, "m")
        values["baseline_passages"] = learned
    return [*events, *summary.events(origin_ns, catalogue.version, values)]


def _identity(train: TrainType, reverse: bool) -> dict[str, Value]:
    """What a named type says of a train."""
    return {
        "type": train.name,
        "reversed": "unknown" if train.symmetric else ("yes" if reverse else "no"),
        "cars": train.cars,
        "units": _UNITS.get(train.units, str(train.units)),
    }


def _spacings(gaps: Array, sigma: float) -> dict[str, Value]:
    """Distances between the wheelsets of an unknown train (m)."""
    return {
        "axle_spacings": tuple(round(float(gap), 2) for gap in gaps),
        "axle_spacing_sigma": round(sigma, 3),
    }


def response(
    catalogue: Catalogue, records: Sequence[Record], origin_ns: int, passage: ResponsePassage
) -> list[TrainEvent]:
    """Departure and summary of a train on channels that do not show its wheelsets.

    Without axle events: times of single wheelsets would be those of the type, not of a measurement.
    """
    best, motion = passage.best, passage.motion
    train = best.train
    speed, sigma, half = passage.speed
    size = speed / best.speed  # lengths scale alike
    first, last = (float(motion.time_at(place)) for place in (0.0, train.span))
    # the passing time is known better than speed and length, which scale alike
    edge = float(np.hypot(passage.middle[1], 0.5 * train.span / best.speed * passage.relative))
    listed: dict[str, float] = {}
    for p, fit in zip(passage.probabilities, passage.fits, strict=True):
        listed[fit.train.name] = listed.get(fit.train.name, 0.0) + p * (1 - passage.unknown)
    bend = float(np.hypot(motion.acceleration_sigma, sigma / speed * motion.acceleration))
    names = tuple(channel.name for channel in passage.channels)
    quality = ["axles_not_visible", "speed_scales_with_type"]
    if not passage.known:
        quality.append("unknown_type")
    for record in records:
        inside = (record.window.time >= first) & (record.window.time <= last)
        if record.channel.name in names and inside.any():
            if clipped(record.window, inside):
                quality.append("clipped")
            if not record.window.valid[inside].all():
                quality.append("gaps")

    def ranked(table: dict[str, float]) -> tuple[tuple[str, float], ...]:
        pairs = sorted(table.items(), key=lambda item: -item[1])
        return tuple((name, round(p, 4)) for name, p in pairs if p > 1e-3)

    values: dict[str, Value] = {
        "unknown_probability": round(passage.unknown, 4),
        "train_length": Estimate(size * train.length, train.length * sigma / best.speed, "m"),
        "evidence": round(best.evidence, 1),
        "types": ranked(listed),
        "families": ranked(passage.families),
    }
    if passage.known:
        values |= _identity(train, best.reverse) | {
            "axle_count": train.axles.size,
            "axle_count_of": "the type",
            "type_probability": round(listed[train.name], 4),
            "speed_passing_time": Estimate(*passage.by_duration, "m/s"),
        }
    elif not passage.listed:
        cars = best.speed / CAR[0]
        values["car_rate"] = Estimate(cars, cars * passage.relative, "Hz")
    if passage.spectral is not None:
        values["speed_spectrum"] = Estimate(*passage.spectral, "m/s")
    summary = Summary(
        sensors=names,
        x=passage.channels[0].x,
        arrival=(first, edge),
        departure=(last, edge),
        passing_sigma=(last - first) * passage.relative,
        speed=(speed, sigma),
        interval=(speed - half, speed + half),
        acceleration=(size * motion.acceleration, bend),
        direction=passage.direction,
        method="one common response per wheelset, least squares",
        confidence=float(np.clip(1 - CONFIRM_EVIDENCE / (2 * best.evidence), 0.0, 0.99)),
        quality=tuple(dict.fromkeys(quality)),
    )
    return list(summary.events(origin_ns, catalogue.version, values))


def _unknown(
    catalogue: Catalogue,
    origin_ns: int,
    passage: Passage,
    blind: Blind,
    quality: Sequence[str],
) -> list[TrainEvent]:
    """A train that no type explains: what was seen, and no more."""
    quality = (*quality, "unknown_type")
    if blind.regular < CONFIDENT:
        quality = (*quality, "axle_count_not_confident")
    speed, sigma = blind.speed
    times = blind.times
    time_sigma = blind.time_sigma
    axles = [
        TrainEvent(
            kind="axle",
            stamp_ns=origin_ns + round(float(time) * 1e9),
            sigma_s=float(sigma_s),
            confidence=0.9 * blind.regular,
            method=blind.axle_method,
            sensors=blind.sensors[:1],
            values={"number": number},
        )
        for number, (time, sigma_s) in enumerate(zip(times, time_sigma, strict=True), 1)
    ]
    summary = Summary(
        sensors=blind.sensors,
        x=blind.x,
        arrival=(float(times[0]), float(time_sigma[0])),
        departure=(float(times[-1]), float(time_sigma[-1])),
        passing_sigma=float(np.hypot(*time_sigma[[0, -1]])),
        speed=blind.speed,
        interval=blind.interval,
        acceleration=(blind.motion.acceleration, blind.motion.acceleration_sigma),
        direction=blind.direction,
        method=blind.method,
        confidence=float(np.clip(max(blind.correlation, passage.score), 0.0, 0.95)),
        quality=tuple(quality),
        grade=CONFIRMED if passage.confirmed else VIBRATION,
    )
    span = float(blind.spacings.sum())
    values: dict[str, Value] = {
        "axle_count": int(times.size),
        "axle_count_confidence": round(blind.regular, 3),
        "families": families(passage.hypotheses),
        "train_length": Estimate(span, float(np.hypot(span * sigma / speed, 0.5)), "m"),
        **_spacings(blind.spacings, float(np.hypot(blind.spacing_sigma, 2.5 * sigma / speed))),
        "score": round(passage.score, 4),
        "correlation": round(blind.correlation, 4),
    }
    return [*axles, *summary.events(origin_ns, catalogue.version, values)]
