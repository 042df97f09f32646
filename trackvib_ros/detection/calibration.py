"""What passages teach about a site: where the rail channels are against each other, and how long
the bowl is that a wheel presses into the rail.

The effective place of channel c is x_c + delta_c, delta a priori independent and N(0, sigma²). A
passage whose wheelset pattern tells the type without the distance between the channels measures
delta_c - delta_r; the estimate is a Kalman filter whose state drifts slowly (Maybeck, Stochastic
Models, Estimation and Control, 1979, ch. 5).
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from solver import InputError

from .bowl import SHAPE_SIGMA, WAVENUMBER, WAVENUMBER_SPREAD
from .events import POSITION_SIGMA, Channel
from .evidence import PRIOR_MOVED

Array = NDArray[np.float64]

SCHEMA = "trackvib-calibration-3"
"""Name and version of the text that :meth:`Calibration.to_json` writes."""

_MEMORY = 300.0  # passages after which what was learned has faded to what was stated
_SAME_PLACE = 1e-6  # m
_GATE = 4.0  # standard deviations: more is another train than was thought, or a moved sensor
_FAR = 1.0  # m, by how much a channel is elsewhere, or an accident puts it
_ELSEWHERE = float(np.log(19.0))  # ln of odds of 95 %, at which it is


@dataclass(frozen=True)
class Measured:
    """Effective minus stated places of channels, less that of the first (m); covariance (m²)."""

    channels: tuple[str, ...]
    offset: Array
    covariance: Array


@dataclass(frozen=True)
class Doubt:
    """Where the channels are if what contradicts all that was learned is right: offsets (m) and
    their covariance (m²) as in :class:`Calibration`, and ln of the odds of it."""

    offset: Array
    covariance: Array
    log_odds: float


@dataclass(frozen=True)
class Calibration:
    """Where rail channels are, with what was learned of it.

    Attributes:
        channels: names of the channels.
        positions: of them as stated (m), shape (channels,).
        offset: effective minus stated position (m), shape (channels,); only differences of two
            channels can be observed.
        covariance: of the offsets (m²), shape (channels, channels).
        stated: standard uncertainty of the stated positions (m), shape (channels,).
        passages: that were learned from.
        bowl: ln of the wavenumber k0 (rad/m) of the rail's deflection at every channel
            (:mod:`bowl`), shape (channels,).
        bowl_variance: of it, shape (channels,).
        doubt: what passages that contradict it say, since the last one that did not.
    """

    channels: tuple[str, ...]
    positions: Array
    offset: Array
    covariance: Array
    stated: Array
    passages: int
    bowl: Array
    bowl_variance: Array
    doubt: Doubt | None = None

    @classmethod
    def untaught(cls, channels: Sequence[Channel], stated: float = POSITION_SIGMA) -> Calibration:
        """The positions as stated; ``stated`` is the sigma (m) of those that come without one."""
        n = len(channels)
        sigma = np.array(
            [stated if c.position_sigma is None else c.position_sigma for c in channels]
        )
        return cls(
            channels=tuple(channel.name for channel in channels),
            positions=np.array([channel.x for channel in channels]),
            offset=np.zeros(n),
            covariance=np.diag(sigma**2),
            stated=sigma,
            passages=0,
            bowl=np.full(n, np.log(WAVENUMBER)),
            bowl_variance=np.full(n, WAVENUMBER_SPREAD**2),
        )

    def check(self, channels: Sequence[Channel]) -> None:
        """Whether it was learned with these channels.

        Raises:
            InputError: with others, or they had other positions.
        """
        names = [channel.name for channel in channels]
        if set(self.channels) != set(names):
            raise InputError(
                f"calibration is of channels {', '.join(self.channels)}, the detector has "
                f"{', '.join(names)}; give one that was learned with these"
            )
        for channel in channels:
            learned = float(self.positions[self.channels.index(channel.name)])
            if abs(learned - channel.x) > _SAME_PLACE:
                raise InputError(
                    f"calibration was learned with {channel.name} at x = {learned} m, the detector "
                    f"has it at {channel.x} m; learn anew, or give the position as it was"
                )

    def wavenumber(self, name: str) -> tuple[float, float]:
        """Wavenumber of the deflection at a channel (rad/m), and its relative sigma."""
        k = self.channels.index(name)
        return float(np.exp(self.bowl[k])), float(self.bowl_variance[k] ** 0.5)

    def learned_bowl(self, name: str, wavenumber: float, sigma: float) -> Calibration:
        """What a train of known speed adds, by the wavenumber (rad/m, relative sigma) it shows.

        Nothing if that contradicts by more than four standard deviations.
        """
        k = self.channels.index(name)
        prior = float(self.bowl_variance[k]) + 2 * WAVENUMBER_SPREAD**2 / _MEMORY
        prior = min(prior, WAVENUMBER_SPREAD**2)
        noise = sigma**2 + SHAPE_SIGMA**2
        surprise = float(np.log(wavenumber) - self.bowl[k])
        if abs(surprise) > _GATE * np.sqrt(prior + noise):
            return self
        bowl, variance = self.bowl.copy(), self.bowl_variance.copy()
        bowl[k] += surprise * prior / (prior + noise)
        variance[k] = prior * noise / (prior + noise)
        return replace(self, bowl=bowl, bowl_variance=variance)

    def relative(self, names: Sequence[str]) -> tuple[Array, Array]:
        """Offsets of channels from that of the first of them (m), and their covariance (m²)."""
        rows = self._differences(names)
        return rows @ self.offset, rows @ self.covariance @ rows.T

    def learned(self, found: Measured) -> Calibration:
        """What a passage adds.

        One that contradicts by more than four standard deviations is an accident, another train
        than was thought, or channels are elsewhere by a metre or so (prior
        :data:`evidence.PRIOR_MOVED`). Accidents scatter as far, those of a sensor that was moved
        agree: once this is 95 % likely, what they say is what was learned.
        """
        prior = self.covariance + self._drift
        surprise, expected = self._surprise(found, self.offset, prior)
        if not np.any(np.abs(surprise) > _GATE * np.sqrt(np.diag(expected))):
            offset, covariance = self._updated(found, self.offset, prior)
            return self._with(offset, covariance, None)
        far = prior + _FAR**2 * np.eye(len(prior))
        if self.doubt is None:
            doubt = Doubt(*self._updated(found, self.offset, far), float(np.log(PRIOR_MOVED)))
            return replace(self, doubt=doubt)
        elsewhere = self.doubt.offset, self.doubt.covariance + self._drift
        log_odds = self.doubt.log_odds + _log_density(*self._surprise(found, *elsewhere))
        log_odds -= _log_density(*self._surprise(found, self.offset, far))
        offset, covariance = self._updated(found, *elsewhere)
        if log_odds > _ELSEWHERE:
            return self._with(offset, covariance, None)
        return replace(self, doubt=Doubt(offset, covariance, log_odds))

    @property
    def _drift(self) -> Array:
        """Covariance by which places may have changed from one passage to the next (m²)."""
        return np.asarray(np.diag(2 * self.stated**2 / _MEMORY))

    def _with(self, offset: Array, covariance: Array, doubt: Doubt | None) -> Calibration:
        return replace(
            self, offset=offset, covariance=covariance, passages=self.passages + 1, doubt=doubt
        )

    def _surprise(self, found: Measured, offset: Array, prior: Array) -> tuple[Array, Array]:
        """What a passage says beyond offsets (m), and the covariance expected of it (m²)."""
        rows = self._differences(found.channels)[1:]
        return (
            found.offset[1:] - rows @ offset,
            rows @ prior @ rows.T + found.covariance[1:, 1:],
        )

    def _updated(self, found: Measured, offset: Array, prior: Array) -> tuple[Array, Array]:
        """Offsets (m) with what a passage says, and their covariance (m²)."""
        rows = self._differences(found.channels)[1:]
        surprise, expected = self._surprise(found, offset, prior)
        gain = prior @ rows.T @ np.linalg.inv(expected)
        covariance = prior - gain @ rows @ prior
        return offset + gain @ surprise, 0.5 * (covariance + covariance.T)

    def _differences(self, names: Sequence[str]) -> Array:
        """Rows that take channels relative to the first."""
        index = [self.channels.index(name) for name in names]
        rows = np.zeros((len(index), len(self.channels)))
        rows[np.arange(len(index)), index] += 1.0
        rows[:, index[0]] -= 1.0
        return rows

    def save(self, path: Path) -> None:
        """Write a file that :meth:`load` reads, at once or not at all.

        Raises:
            InputError: something is there that is no calibration, or it cannot be written.
        """
        if path.exists():
            Calibration.load(path)
        part = path.with_name(f".{path.name}.{os.getpid()}.part")
        try:
            part.write_text(self.to_json() + "\n", "utf-8")
            part.replace(path)
        except OSError as failure:
            part.unlink(missing_ok=True)
            raise InputError(f"calibration {path} cannot be written: {failure.strerror}") from None

    @classmethod
    def load(cls, path: Path) -> Calibration:
        """The calibration in a file.

        Raises:
            InputError: it cannot be read, or is none.
        """
        try:
            return cls.from_json(path.read_text("utf-8"))
        except (OSError, UnicodeDecodeError) as failure:
            reason = getattr(failure, "strerror", None) or "it is no text"
            raise InputError(f"calibration {path} cannot be read: {reason}") from None
        except InputError as failure:
            raise InputError(f"{path} is not used or overwritten: {failure}") from None

    def to_json(self) -> str:
        """Text to keep it in; :meth:`from_json` reverses it."""
        return json.dumps(
            {
                "schema": SCHEMA,
                "channels": self.channels,
                "positions_m": self.positions.tolist(),
                "offset_m": self.offset.tolist(),
                "covariance_m2": self.covariance.tolist(),
                "stated_m": self.stated.tolist(),
                "passages": self.passages,
                "ln_bowl_wavenumber": self.bowl.tolist(),
                "ln_bowl_variance": self.bowl_variance.tolist(),
                "doubt": self.doubt
                and {
                    "offset_m": self.doubt.offset.tolist(),
                    "covariance_m2": self.doubt.covariance.tolist(),
                    "ln_odds": self.doubt.log_odds,
                },
            }
        )

    @classmethod
    def from_json(cls, text: str) -> Calibration:
        """The calibration written by :meth:`to_json`.

        Raises:
            InputError: another schema, or a field is missing or of the wrong shape.
        """
        try:
            table: Mapping[str, Any] = json.loads(text)
            schema = table["schema"]
            if schema != SCHEMA:
                raise InputError(
                    f"calibration: schema is {schema!r}, this version reads {SCHEMA!r}"
                )
            names = tuple(str(name) for name in table["channels"])
            positions = np.array(table["positions_m"], dtype=np.float64)
            offset = np.array(table["offset_m"], dtype=np.float64)
            covariance = np.array(table["covariance_m2"], dtype=np.float64)
            bowl = np.array(table["ln_bowl_wavenumber"], dtype=np.float64)
            variance = np.array(table["ln_bowl_variance"], dtype=np.float64)
            stated = np.array(table["stated_m"], dtype=np.float64)
            passages = int(table["passages"])
            doubt = _doubt(table.get("doubt"))
        except (ValueError, KeyError, TypeError) as failure:
            raise InputError(f"calibration: {failure}; give what to_json wrote") from None
        n = len(names)
        if positions.shape != (n,) or not np.isfinite(positions).all():
            raise InputError(f"calibration: positions_m must be {n} finite numbers (m)")
        _check_places("", offset, covariance, n)
        if doubt is not None:
            _check_places("doubt: ", doubt.offset, doubt.covariance, n)
        if stated.shape != (n,) or not (np.isfinite(stated).all() and np.all(stated > 0)):
            raise InputError(f"calibration: stated_m must be {n} positive numbers (m)")
        if bowl.shape != (n,) or variance.shape != (n,):
            raise InputError(
                f"calibration: ln_bowl_wavenumber {bowl.shape} and ln_bowl_variance "
                f"{variance.shape} must be ({n},), one per channel"
            )
        if not (np.isfinite(bowl).all() and np.isfinite(variance).all() and np.all(variance > 0)):
            raise InputError("calibration: ln_bowl_variance must be finite and positive (-)")
        return cls(names, positions, offset, covariance, stated, passages, bowl, variance, doubt)


def _doubt(table: Mapping[str, Any] | None) -> Doubt | None:
    if table is None:
        return None
    offset, covariance = (
        np.array(table[name], dtype=np.float64) for name in ("offset_m", "covariance_m2")
    )
    return Doubt(offset, covariance, float(table["ln_odds"]))


def _check_places(whose: str, offset: Array, covariance: Array, n: int) -> None:
    """Check offsets (m) of n channels and their covariance (m²)."""
    if offset.shape != (n,) or covariance.shape != (n, n):
        raise InputError(
            f"calibration: {whose}offset_m {offset.shape} and covariance_m2 {covariance.shape} "
            f"must be ({n},) and ({n}, {n}), one per channel"
        )
    if not (np.isfinite(covariance).all() and np.isfinite(offset).all()) or (
        n and np.linalg.eigvalsh(covariance).min() < -1e-12
    ):
        raise InputError(f"calibration: {whose}covariance_m2 must be finite and not negative (m²)")


def _log_density(surprise: Array, covariance: Array) -> float:
    """ln of a Gaussian density, but for a constant."""
    misfit = float(surprise @ np.linalg.solve(covariance, surprise))
    return -0.5 * (misfit + float(np.linalg.slogdet(covariance)[1]))
