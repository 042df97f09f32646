"""What goes into the detector and what comes out: channels, estimates, events."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

import numpy as np

from solver import InputError

Layer: TypeAlias = Literal["rail", "slab", "support_layer", "bridge"]
LAYERS: tuple[Layer, ...] = ("rail", "slab", "support_layer", "bridge")
EventKind: TypeAlias = Literal["arrival", "update", "axle", "departure", "passage", "health"]
EVENT_KINDS: tuple[EventKind, ...] = (
    "arrival",
    "update",
    "axle",
    "departure",
    "passage",
    "health",
)

VIBRATION = "vibration event"
CONFIRMED = "train confirmed"

POSITION_SIGMA = 0.02
"""Standard uncertainty (m) of the stated position of a channel: measured along the rail by tape."""
POSITION_SIGMA_RANGE = (1e-4, 5.0)
"""What a position's standard uncertainty may be (m)."""


def check_position_sigma(sigma: float, whose: str = "") -> None:
    """Check the standard uncertainty of a position (m).

    Raises:
        InputError: not a number in :data:`POSITION_SIGMA_RANGE`.
    """
    low, high = POSITION_SIGMA_RANGE
    number = isinstance(sigma, (int, float, np.number)) and not isinstance(sigma, bool)
    if not number or not low <= sigma <= high:
        raise InputError(f"{whose}position_sigma = {sigma!r} m must lie from {low} to {high} m")


@dataclass(frozen=True)
class Channel:
    """One accelerometer.

    Attributes:
        name: name of the channel, as in :attr:`Waveform.channels`.
        x: position along the track (m), positive forward.
        layer: what it is mounted on.
        position_sigma: standard uncertainty of ``x`` (m); as the detector's settings say if
            ``None``.
    """

    name: str
    x: float
    layer: Layer = "rail"
    position_sigma: float | None = None

    def __post_init__(self) -> None:
        """Check name, layer and position."""
        if not isinstance(self.name, str) or not self.name:
            raise InputError(f"channel name = {self.name!r} must be a text")
        if self.layer not in LAYERS:
            raise InputError(
                f"channel {self.name!r}: layer = {self.layer!r} is not one of {', '.join(LAYERS)}"
            )
        number = isinstance(self.x, (int, float, np.number)) and not isinstance(self.x, bool)
        if not number or not abs(self.x) < 1e9:
            raise InputError(f"channel {self.name!r}: x = {self.x!r} must be a finite position (m)")
        if self.position_sigma is not None:
            check_position_sigma(self.position_sigma, f"channel {self.name!r}: ")


@dataclass(frozen=True)
class Estimate:
    """A number with its standard uncertainty (1 sigma) and unit."""

    value: float
    sigma: float
    unit: str

    def __str__(self) -> str:
        """Return value, sigma and unit as text."""
        return f"{self.value:.6g} ± {self.sigma:.2g} {self.unit}"


Value: TypeAlias = "Estimate | str | int | float | tuple[Any, ...]"

_RESERVED = ("kind", "stamp_ns", "sigma_s", "confidence", "method", "sensors", "quality")


def _encode(value: object) -> str:
    if isinstance(value, str):
        try:
            json.loads(value)
        except ValueError:
            return value
        return json.dumps(value)
    return json.dumps(value)


def _tuples(value: Any) -> Any:
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value


def _decode(text: str) -> Any:
    try:
        return _tuples(json.loads(text))
    except ValueError:
        return text


@dataclass(frozen=True)
class TrainEvent:
    """One statement of the detector.

    Attributes:
        kind: ``arrival`` at once, ``update`` while the train passes, then, about two seconds after
            the last axle, ``departure``, one ``axle`` each and the ``passage`` summary; ``health``
            about a sensor.
        stamp_ns: time that the event is about (ns, the clock of the samples).
        sigma_s: standard uncertainty of the stamp (s).
        confidence: 0 to 1.
        method: how the values were obtained.
        sensors: names of the channels used.
        values: results by name; every measured number is an :class:`Estimate`.
        quality: flags such as ``clipped``, ``gaps``, ``truncated_start``, ``low_score``.
    """

    kind: EventKind
    stamp_ns: int
    sigma_s: float
    confidence: float
    method: str
    sensors: tuple[str, ...]
    values: Mapping[str, Value] = field(default_factory=dict)
    quality: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, str]:
        """Flat text pairs, for key/value messages and JSON; :meth:`from_dict` reverses it."""
        pairs = {name: _encode(getattr(self, name)) for name in _RESERVED}
        for name, value in self.values.items():
            if isinstance(value, Estimate):
                pairs[f"{name}.value"] = _encode(value.value)
                pairs[f"{name}.sigma"] = _encode(value.sigma)
                pairs[f"{name}.unit"] = value.unit
            else:
                pairs[name] = _encode(value)
        return pairs

    @classmethod
    def from_dict(cls, pairs: Mapping[str, str]) -> TrainEvent:
        """The event written by :meth:`to_dict`.

        Raises:
            InputError: a field is missing or is no event of this detector.
        """
        missing = [name for name in _RESERVED if name not in pairs]
        if missing:
            raise InputError(f"not a train event: missing {', '.join(missing)}")
        kind = pairs["kind"]
        if kind not in EVENT_KINDS:
            raise InputError(f"kind = {kind!r} is not one of {', '.join(EVENT_KINDS)}")
        values: dict[str, Value] = {}
        for name, text in pairs.items():
            stem, _, part = name.rpartition(".")
            if name in _RESERVED or (part in ("sigma", "unit") and f"{stem}.value" in pairs):
                continue
            if part == "value":
                values[stem] = Estimate(
                    float(_decode(text)),
                    float(_decode(pairs[f"{stem}.sigma"])),
                    pairs[f"{stem}.unit"],
                )
            else:
                values[name] = _decode(text)
        return cls(
            kind=kind,
            stamp_ns=int(_decode(pairs["stamp_ns"])),
            sigma_s=float(_decode(pairs["sigma_s"])),
            confidence=float(_decode(pairs["confidence"])),
            method=pairs["method"],
            sensors=_decode(pairs["sensors"]),
            values=values,
            quality=_decode(pairs["quality"]),
        )
