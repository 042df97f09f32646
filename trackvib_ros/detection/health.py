"""What is wrong with a sensor: told once when it begins and once when it is over."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .events import Channel, Estimate, TrainEvent, Value
from .features import Window

Array = NDArray[np.float64]

_DEAD_S = 3.0
_DROPPED_SHARE = 0.5  # of the last seconds
_WINDOW_S = 3.0
_DRIFT_FAST_S, _DRIFT_SLOW_S = 2.0, 120.0
_DRIFT_SIGMAS = 20.0
_SAME = 1e-4  # relative; beyond rounding, below the steps of 12 bits
_PILED = 0.005  # of the bins: fewer change no result
_LEAST_LEVELS = 50.0  # of quantisation up to the largest: else neighbours share a value anyway


def clipped(window: Window, inside: NDArray[np.bool_]) -> bool:
    """Whether samples pile up at one largest magnitude.

    Of the bins whose peak is within a tenth of the largest, two in five have that very value; a
    falling density leaves one in a thousand there, a sine that returns to the same samples one in
    three. Cars alike repeat their peaks too, but these are few.
    """
    peak = window.peak[inside]
    top = float(peak.max(initial=0.0))
    steps = np.diff(np.unique(peak))
    if not steps.size or top < _LEAST_LEVELS * float(steps.min()):
        return False
    extreme = int(np.sum(peak > (1 - _SAME) * top))
    # what stands still altogether is dead, not clipped
    enough = max(5.0, _PILED * peak.size) <= extreme < 0.5 * peak.size
    return enough and extreme > 0.4 * int(np.sum(peak > 0.9 * top))


class HealthBook:
    """States of all channels; every change is an event.

    States: ``dead`` (the value stands still), ``dropped_out`` (most samples missing), ``drifting``
    (the mean leaves its place), ``late`` (comes when the others no longer wait for it), and from
    passages ``clipped``, ``unsynchronised``, ``moved`` (not where it is said to be), ``swapped``
    and ``insensitive`` (a train passed unnoticed).
    """

    def __init__(self, channels: Sequence[Channel]) -> None:
        self._channels = tuple(channels)
        count = len(self._channels)
        self._states: list[set[str]] = [set() for _ in range(count)]
        self._still = np.zeros(count)
        self._missing = np.zeros(count)
        self._fast = np.full(count, np.nan)
        self._slow = np.full(count, np.nan)
        self._age = np.zeros(count)

    def states(self, channel: int) -> frozenset[str]:
        """Present states of a channel."""
        return frozenset(self._states[channel])

    def step(
        self,
        now_ns: int,
        frame_s: float,
        index: Sequence[int],
        mean: Array,
        noise: Array,
        still: NDArray[np.bool_],
        valid: NDArray[np.bool_],
        in_event: bool,
    ) -> list[TrainEvent]:
        """One frame of a group: mean and noise (standard deviation), standing still, measured."""
        events: list[TrainEvent] = []
        i = np.asarray(index)
        self._still[i] = np.where(still & valid, self._still[i] + frame_s, 0.0)
        weight = frame_s / _WINDOW_S
        self._missing[i] += weight * (~valid - self._missing[i])
        good = valid & ~still
        fresh = np.isnan(self._fast[i]) & good
        self._fast[i] = np.where(fresh, mean, self._fast[i])
        self._slow[i] = np.where(fresh, mean, self._slow[i])
        if not in_event:
            step = np.where(good, mean - self._fast[i], 0.0)
            self._fast[i] += frame_s / _DRIFT_FAST_S * step
            self._age[i] += frame_s
            # the slow mean starts as a plain average, so that its first frame does not weigh on
            share = np.minimum(1.0, frame_s / np.minimum(self._age[i], _DRIFT_SLOW_S))
            self._slow[i] += share * np.where(good, mean - self._slow[i], 0.0)
            away = np.abs(self._fast[i] - self._slow[i])
            drifting = (away > _DRIFT_SIGMAS * noise) & (self._age[i] > 5 * _DRIFT_FAST_S)
            for k, c in enumerate(i):
                if drifting[k] != ("drifting" in self._states[c]) and (
                    drifting[k] or away[k] < 0.5 * _DRIFT_SIGMAS * noise[k]
                ):
                    value = Estimate(float(self._fast[c] - self._slow[c]), float(noise[k]), "unit")
                    events += self._set(now_ns, c, "drifting", bool(drifting[k]), {"offset": value})
        for c in i[(self._still[i] > _DEAD_S) != self._has(i, "dead")]:
            events += self._set(now_ns, int(c), "dead", bool(self._still[c] > _DEAD_S))
        dropped = self._missing[i] > np.where(self._has(i, "dropped_out"), 0.1, _DROPPED_SHARE)
        for c, state in zip(i, dropped, strict=True):
            if bool(state) != ("dropped_out" in self._states[c]):
                share = Estimate(float(self._missing[c]), 0.01, "1")
                events += self._set(now_ns, int(c), "dropped_out", bool(state), {"missing": share})
        return events

    def _has(self, index: NDArray[np.int64], state: str) -> NDArray[np.bool_]:
        return np.array([state in self._states[c] for c in index])

    def tell(
        self, now_ns: int, name: str, state: str, present: bool, values: dict[str, Value]
    ) -> list[TrainEvent]:
        """A state that others have seen, as in a passage."""
        index = [c.name for c in self._channels].index(name)
        if present == (state in self._states[index]):
            return []
        return self._set(now_ns, index, state, present, values)

    def _set(
        self,
        now_ns: int,
        channel: int,
        state: str,
        present: bool,
        values: dict[str, Value] | None = None,
    ) -> list[TrainEvent]:
        (self._states[channel].add if present else self._states[channel].discard)(state)
        name = self._channels[channel].name
        return [
            TrainEvent(
                kind="health",
                stamp_ns=now_ns,
                sigma_s=_WINDOW_S,
                confidence=0.95,
                method="watching the samples"
                if state in ("dead", "dropped_out", "drifting", "late")
                else "comparing channels in a passage",
                sensors=(name,),
                values={"state": state, "present": "yes" if present else "no", **(values or {})},
                quality=(state,) if present else (),
            )
        ]
