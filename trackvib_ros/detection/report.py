"""From what was found to the events that are told."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .blind import Blind
from .catalogue import Catalogue
from .events import CONFIRMED, VIBRATION, Channel, Estimate, TrainEvent, Value
from .health import clipped
from .kinematics import POSITION_SIGMA
from .live import Provisional
from .passage import CONFIRM_SCORE, Hypothesis, Passage, Record

Array = NDArray[np.float64]

_DIRECTION = {1: "forward", -1: "backward", 0: "unknown"}
_UNITS = {1: "single", 2: "double"}
_UNKNOWN_SCALE = 0.02  # relative error of the speed when the nearest type stands for an unknown one
_PULSE_SIGMA_S, _PULSE_SIGMA_M = 0.0015, POSITION_SIGMA  # centre of a pulse against its wheelset
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


def update(found: Provisional, now_ns: int) -> TrainEvent:
    """A provisional speed while the train passes."""
    return TrainEvent(
        kind="update",
        stamp_ns=now_ns,
        sigma_s=0.0,
        confidence=float(np.clip(found.correlation, 0.0, 0.95)),
        method="delay of the envelope between two rail channels",
        sensors=found.sensors,
        values={
            "speed": Estimate(found.speed, found.sigma, "m/s"),
            "direction": _DIRECTION[found.direction],
            "passed": Estimate(found.distance, 2.0, "m"),
        },
        quality=("provisional",),
    )


def closing(
    catalogue: Catalogue,
    records: Sequence[Record],
    origin_ns: int,
    within: tuple[float, float],
    found: Sequence[Passage],
    flags: Sequence[str],
) -> list[TrainEvent]:
    """The events at the end of an event: per train its wheelsets, departure and summary."""
    events: list[TrainEvent] = []
    trains = [passage for passage in found if passage.confirmed]
    if not trains:
        names = tuple(r.channel.name for r in records)
        return [
            TrainEvent(
                kind="departure",
                stamp_ns=origin_ns + round((within[1] - 0.3) * 1e9),
                sigma_s=0.1,
                confidence=0.5,
                method="energy back at noise floor",
                sensors=names,
                values={
                    "grade": VIBRATION,
                    "score": max((p.score for p in found), default=0.0),
                },
                quality=(*flags, "low_score"),
            )
        ]
    for passage in trains:
        quality = [*flags, *passage.quality, *_window_flags(records, passage)]
        use_blind = passage.blind is not None and (
            passage.contradicted or passage.score < CONFIRM_SCORE or passage.blind.direction != 0
        )
        if not passage.known and use_blind:
            assert passage.blind is not None
            events += _unknown(catalogue, origin_ns, passage, passage.blind, quality)
        else:
            events += _train(catalogue, origin_ns, passage, quality)
    return events


def _window_flags(records: Sequence[Record], passage: Passage) -> list[str]:
    """Flags from the samples: clipped, gaps, record shorter than the train."""
    flags = set()
    start, stop = passage.interval
    for record in records:
        window = record.window
        inside = (window.time >= start) & (window.time <= stop)
        if record.channel.layer != "rail" or not inside.any():
            continue
        if clipped(window, inside):
            flags.add("clipped")
        if np.mean(window.holes[inside]) > 0.002 or not window.valid[inside].all():
            flags.add("gaps")
        if start - window.time[0] < 0.15:
            flags.add("truncated_start")
        if window.time[-1] - stop < 0.15:
            flags.add("truncated_end")
    return sorted(flags)


def mixture(hypotheses: Sequence[Hypothesis]) -> tuple[float, float, float]:
    """Speed of the best hypothesis at mid-train, its own sigma, and sigma with the ambiguity."""
    best = hypotheses[0]
    speed = float(best.fit.motion.speed_at(best.mid_time))
    own = best.fit.motion.speed_sigma(best.mid_time)
    variance = 0.0
    for h in hypotheses:
        other = float(h.fit.motion.speed_at(best.mid_time))
        sigma = h.fit.motion.speed_sigma(best.mid_time)
        variance += h.probability * ((other - speed) ** 2 + sigma**2)
    return speed, own, float(np.sqrt(variance))


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

    axle_sigma = fit.scale / np.maximum(motion.speed_at(motion.time_at(places)), 0.5)
    events: list[TrainEvent] = []
    reference = passage.traces[0]
    confidences = []
    for i in range(places.size):
        seen = bool(fit.used[0, i])
        time = float(fit.time[0, i]) if seen else float(motion.time_at(places[i]))
        clear = 1 / (1 + np.exp(-3 * (float(fit.contrast[0, i]) - 0.5)))
        confidence = best.score * (clear if seen else 0.3)
        confidences.append(confidence)
        events.append(
            TrainEvent(
                kind="axle",
                stamp_ns=stamp(time),
                sigma_s=float(np.hypot(axle_sigma[i], _PULSE_SIGMA_S)),
                confidence=float(np.clip(confidence, 0.01, 0.99)),
                method="pulse shift by maximum likelihood" if seen else "predicted by the motion",
                sensors=(reference.name,),
                values={"number": i + 1, "position": Estimate(float(places[i]), 0.05, "m")},
            )
        )
    first, last = float(motion.time_at(places[0])), float(motion.time_at(places[-1]))
    speed, own, sigma = mixture(passage.hypotheses)
    known = passage.known
    if not known:
        sigma = max(sigma, _UNKNOWN_SCALE * speed)
        quality = [*quality, "unknown_type"]
    passing_sigma = float(np.hypot(motion.time_sigma(first), motion.time_sigma(last)))
    systematic = float(np.hypot(_PULSE_SIGMA_S, _PULSE_SIGMA_M / speed))
    first_sigma = float(np.hypot(motion.time_sigma(first), systematic))
    last_sigma = float(np.hypot(motion.time_sigma(last), systematic))
    values: dict[str, Value] = {
        "grade": CONFIRMED,
        "reference": reference.name,
        "reference_x": Estimate(reference.x, 0.0, "m"),
        "arrival_ns": stamp(first),
        "arrival_sigma": first_sigma,
        "departure_ns": stamp(last),
        "departure_sigma": last_sigma,
        "passing_time": Estimate(last - first, passing_sigma, "s"),
        "speed": Estimate(speed, sigma, "m/s"),
        "speed_at": "middle of the train at the reference point",
        "acceleration": Estimate(motion.acceleration, motion.acceleration_sigma, "m/s^2"),
        "direction": _DIRECTION[passage.direction],
        "axle_count": int(places.size),
        "type": train.name if known else "unknown",
        "type_probability": round(best.probability, 4),
        "families": families(passage.hypotheses),
        "types": tuple(
            (h.train.name, round(h.probability, 4))
            for h in passage.hypotheses
            if h.probability > 1e-3
        ),
        "reversed": "unknown" if train.symmetric else ("yes" if best.reverse else "no"),
        "cars": train.cars if known else "unknown",
        "units": _UNITS.get(train.units, str(train.units)) if known else "unknown",
        "train_length": Estimate(train.length, train.length * sigma / speed, "m"),
        "score": round(best.score, 4),
        "speed_template": Estimate(speed, own, "m/s"),
        "speed_passing_time": Estimate(
            train.span / (last - first), train.span / (last - first) ** 2 * passing_sigma, "m/s"
        ),
        "catalogue": catalogue.version,
    }
    if passage.delay is not None:
        values["speed_delay"] = Estimate(*passage.delay, "m/s")
    confidence = float(np.clip(best.score, 0.0, 0.99))
    events.append(
        TrainEvent(
            kind="departure",
            stamp_ns=stamp(last),
            sigma_s=last_sigma,
            confidence=confidence,
            method=method,
            sensors=names,
            values={"grade": CONFIRMED, "reference_x": Estimate(reference.x, 0.0, "m")},
            quality=tuple(quality),
        )
    )
    events.append(
        TrainEvent(
            kind="passage",
            stamp_ns=stamp(first),
            sigma_s=first_sigma,
            confidence=confidence,
            method=method,
            sensors=names,
            values=values,
            quality=tuple(quality),
        )
    )
    return events


def _unknown(
    catalogue: Catalogue,
    origin_ns: int,
    passage: Passage,
    blind: Blind,
    quality: Sequence[str],
) -> list[TrainEvent]:
    """A train that no type explains: what was seen, and no more."""
    quality = (*quality, "unknown_type")
    if blind.regular < 0.8:
        quality = (*quality, "axle_count_not_confident")
    speed, sigma = blind.speed
    times = blind.times
    grade = CONFIRMED if passage.confirmed else VIBRATION
    confidence = float(np.clip(max(blind.correlation, passage.score), 0.0, 0.95))

    def stamp(time: float) -> int:
        return origin_ns + round(time * 1e9)

    time_sigma = float(np.hypot(0.3 / speed, _PULSE_SIGMA_S))
    events = [
        TrainEvent(
            kind="axle",
            stamp_ns=stamp(float(time)),
            sigma_s=time_sigma,
            confidence=0.9 * blind.regular,
            method="energy peak",
            sensors=blind.sensors[:1],
            values={"number": number},
        )
        for number, time in enumerate(times, 1)
    ]
    spacings = blind.spacings
    span = float(spacings.sum())
    duration = float(times[-1] - times[0])
    acceleration = Estimate(blind.motion.acceleration, blind.motion.acceleration_sigma, "m/s^2")
    values: dict[str, Value] = {
        "grade": grade,
        "reference": blind.sensors[0],
        "reference_x": Estimate(blind.x, 0.0, "m"),
        "arrival_ns": stamp(float(times[0])),
        "arrival_sigma": time_sigma,
        "departure_ns": stamp(float(times[-1])),
        "departure_sigma": time_sigma,
        "passing_time": Estimate(duration, 2**0.5 * time_sigma, "s"),
        "speed": Estimate(speed, sigma, "m/s"),
        "speed_at": "middle of the train at the reference point",
        "acceleration": acceleration,
        "direction": _DIRECTION[blind.direction],
        "axle_count": int(times.size),
        "axle_count_confidence": round(blind.regular, 3),
        "type": "unknown",
        "families": families(passage.hypotheses),
        "cars": "unknown",
        "units": "unknown",
        "train_length": Estimate(span, float(np.hypot(span * sigma / speed, 0.5)), "m"),
        "axle_spacings": tuple(round(float(gap), 2) for gap in spacings),
        "axle_spacing_sigma": round(float(np.hypot(0.3, 2.5 * sigma / speed)), 3),
        "score": round(passage.score, 4),
        "correlation": round(blind.correlation, 4),
        "catalogue": catalogue.version,
    }
    for kind, time in (("departure", times[-1]), ("passage", times[0])):
        events.append(
            TrainEvent(
                kind=kind,  # type: ignore[arg-type]
                stamp_ns=stamp(float(time)),
                sigma_s=time_sigma,
                confidence=confidence,
                method=blind.method,
                sensors=blind.sensors,
                values=values
                if kind == "passage"
                else {"grade": grade, "reference_x": Estimate(blind.x, 0.0, "m")},
                quality=tuple(quality),
            )
        )
    return events
