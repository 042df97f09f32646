"""From what was found to the events that are told."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .catalogue import Catalogue
from .events import CONFIRMED, VIBRATION, Channel, Estimate, TrainEvent, Value
from .passage import CONFIRM_SCORE, KNOWN_SCORE, Hypothesis, Passage, Record

_DIRECTION = {1: "forward", -1: "backward", 0: "unknown"}
_UNITS = {1: "single", 2: "double"}
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
    trains = [passage for passage in found if passage.score >= CONFIRM_SCORE]
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
        events += _train(catalogue, records, origin_ns, passage, flags)
    return events


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
    records: Sequence[Record],
    origin_ns: int,
    passage: Passage,
    flags: Sequence[str],
) -> list[TrainEvent]:
    best = passage.hypotheses[0]
    fit, train = best.fit, best.train
    motion = fit.motion
    names = tuple(trace.name for trace in passage.traces)
    method = "axle pattern" if len(names) == 1 else "axle pattern and delay, joint regression"
    quality = [*flags, *passage.quality]
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
                sigma_s=float(axle_sigma[i]),
                confidence=float(np.clip(confidence, 0.01, 0.99)),
                method="pulse shift by maximum likelihood" if seen else "predicted by the motion",
                sensors=(reference.name,),
                values={"number": i + 1, "position": Estimate(float(places[i]), 0.05, "m")},
            )
        )
    first, last = float(motion.time_at(places[0])), float(motion.time_at(places[-1]))
    speed, own, sigma = mixture(passage.hypotheses)
    known = best.score >= KNOWN_SCORE
    passing_sigma = float(
        np.hypot(motion.time_sigma(first), motion.time_sigma(last))
    )
    values: dict[str, Value] = {
        "grade": CONFIRMED,
        "reference": reference.name,
        "reference_x": Estimate(reference.x, 0.0, "m"),
        "arrival_ns": stamp(first),
        "arrival_sigma": motion.time_sigma(first),
        "departure_ns": stamp(last),
        "departure_sigma": motion.time_sigma(last),
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
            sigma_s=motion.time_sigma(last),
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
            sigma_s=motion.time_sigma(first),
            confidence=confidence,
            method=method,
            sensors=names,
            values=values,
            quality=tuple(quality),
        )
    )
    return events
