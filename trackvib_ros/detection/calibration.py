"""What passages teach about a site: where the rail channels are against each other.

The effective place of channel c is x_c + delta_c, delta a priori independent and N(0, sigma²). A
passage whose wheelset pattern tells the type without the distance between the channels measures
delta_c - delta_r; the estimate is a Kalman filter whose state drifts slowly (Maybeck, Stochastic
Models, Estimation and Control, 1979, ch. 5).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from solver import InputError

Array = NDArray[np.float64]

POSITION_SIGMA = 0.02
"""Standard uncertainty (m) of the stated position of a channel: measured along the rail by tape."""

_MEMORY = 300.0  # passages after which what was learned has faded to what was stated
_GATE = 4.0  # standard deviations: more is another train than was thought, or a moved sensor


@dataclass(frozen=True)
class Measured:
    """Effective minus stated places of channels, less that of the first (m); covariance (m²)."""

    channels: tuple[str, ...]
    offset: Array
    covariance: Array


@dataclass(frozen=True)
class Calibration:
    """Where rail channels are, with what was learned of it.

    Attributes:
        channels: names of the rail channels.
        offset: effective minus stated position (m), shape (channels,); only differences of two
            channels can be observed.
        covariance: of the offsets (m²), shape (channels, channels).
        stated: standard uncertainty of the stated positions (m).
        passages: that were learned from.
    """

    channels: tuple[str, ...]
    offset: Array
    covariance: Array
    stated: float
    passages: int = 0

    @classmethod
    def untaught(cls, channels: Sequence[str], stated: float = POSITION_SIGMA) -> Calibration:
        """The positions as stated, with a standard uncertainty (m)."""
        n = len(channels)
        return cls(tuple(channels), np.zeros(n), stated**2 * np.eye(n), stated)

    def relative(self, names: Sequence[str]) -> tuple[Array, Array]:
        """Offsets of channels from that of the first of them (m), and their covariance (m²)."""
        rows = self._differences(names)
        return rows @ self.offset, rows @ self.covariance @ rows.T

    def learned(self, found: Measured) -> Calibration:
        """What a passage adds; nothing if it contradicts by more than four standard deviations."""
        rows = self._differences(found.channels)[1:]
        prior = self.covariance + 2 * self.stated**2 / _MEMORY * np.eye(len(self.channels))
        surprise = found.offset[1:] - rows @ self.offset
        expected = rows @ prior @ rows.T + found.covariance[1:, 1:]
        if np.any(np.abs(surprise) > _GATE * np.sqrt(np.diag(expected))):
            return self
        gain = prior @ rows.T @ np.linalg.inv(expected)
        covariance = prior - gain @ rows @ prior
        return Calibration(
            self.channels,
            self.offset + gain @ surprise,
            0.5 * (covariance + covariance.T),
            self.stated,
            self.passages + 1,
        )

    def _differences(self, names: Sequence[str]) -> Array:
        """Rows that take channels relative to the first."""
        index = [self.channels.index(name) for name in names]
        rows = np.zeros((len(index), len(self.channels)))
        rows[np.arange(len(index)), index] += 1.0
        rows[:, index[0]] -= 1.0
        return rows

    def to_json(self) -> str:
        """Text to keep it in; :meth:`from_json` reverses it."""
        return json.dumps(
            {
                "channels": self.channels,
                "offset_m": self.offset.tolist(),
                "covariance_m2": self.covariance.tolist(),
                "stated_m": self.stated,
                "passages": self.passages,
            }
        )

    @classmethod
    def from_json(cls, text: str) -> Calibration:
        """The calibration written by :meth:`to_json`.

        Raises:
            InputError: a field is missing or of the wrong shape.
        """
        try:
            table: Mapping[str, Any] = json.loads(text)
            names = tuple(str(name) for name in table["channels"])
            offset = np.array(table["offset_m"], dtype=np.float64)
            covariance = np.array(table["covariance_m2"], dtype=np.float64)
            stated, passages = float(table["stated_m"]), int(table["passages"])
        except (ValueError, KeyError, TypeError) as failure:
            raise InputError(f"calibration: {failure}; give what to_json wrote") from None
        n = len(names)
        if offset.shape != (n,) or covariance.shape != (n, n):
            raise InputError(
                f"calibration: offset_m {offset.shape} and covariance_m2 {covariance.shape} must "
                f"be ({n},) and ({n}, {n}), one per channel"
            )
        if not (np.isfinite(offset).all() and np.linalg.eigvalsh(covariance).min() >= -1e-12):
            raise InputError("calibration: covariance_m2 must be finite and not negative (m²)")
        return cls(names, offset, covariance, stated, passages)
