"""What is told of every train, however it was found: its departure and its summary."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from .events import CONFIRMED, Estimate, TrainEvent, Value

DIRECTION = {1: "forward", -1: "backward", 0: "unknown"}
"""Names of the directions."""


@dataclass(frozen=True)
class Summary:
    """A train at its reference channel.

    Attributes:
        sensors: channels used, reference first.
        x: of the reference (m).
        arrival: when its first wheelset passed (s after the origin), sigma.
        departure: the same of its last wheelset.
        passing_sigma: of the time between the two (s).
        speed: at the middle of the train (m/s), sigma.
        interval: that holds the speed with 95 % (m/s), if it was derived.
        acceleration: (m/s²), sigma.
        direction: +1, -1, or 0 if unknown.
        method: how all this was found.
        confidence: that it is a train, 0 to 1.
        quality: flags.
        grade: whether it is confirmed.
    """

    sensors: tuple[str, ...]
    x: float
    arrival: tuple[float, float]
    departure: tuple[float, float]
    passing_sigma: float
    speed: tuple[float, float]
    interval: tuple[float, float] | None
    acceleration: tuple[float, float]
    direction: int
    method: str
    confidence: float
    quality: tuple[str, ...]
    grade: str = CONFIRMED

    @property
    def duration(self) -> float:
        """Passing time (s)."""
        return self.departure[0] - self.arrival[0]

    def events(
        self, origin_ns: int, catalogue: str, more: Mapping[str, Value]
    ) -> tuple[TrainEvent, TrainEvent]:
        """Departure and summary, which calls the type unknown unless ``more`` names it.

        Args:
            origin_ns: what times are after.
            catalogue: its version.
            more: what else is known.
        """
        first, last = (origin_ns + round(t * 1e9) for t in (self.arrival[0], self.departure[0]))
        place: dict[str, Value] = {
            "grade": self.grade,
            "reference_x": Estimate(self.x, 0.0, "m"),
        }
        values: dict[str, Value] = {
            **place,
            "reference": self.sensors[0],
            "arrival_ns": first,
            "arrival_sigma": self.arrival[1],
            "departure_ns": last,
            "departure_sigma": self.departure[1],
            "passing_time": Estimate(self.duration, self.passing_sigma, "s"),
            "speed": Estimate(*self.speed, "m/s"),
            "speed_at": "middle of the train at the reference point",
            "acceleration": Estimate(*self.acceleration, "m/s^2"),
            "direction": DIRECTION[self.direction],
            "type": "unknown",
            "cars": "unknown",
            "units": "unknown",
            "catalogue": catalogue,
        }
        if self.interval is not None:
            values["speed_interval"] = tuple(round(v, 6) for v in self.interval)
        told = self.confidence, self.method, self.sensors
        return (
            TrainEvent("departure", last, self.departure[1], *told, place, self.quality),
            TrainEvent("passage", first, self.arrival[1], *told, {**values, **more}, self.quality),
        )
