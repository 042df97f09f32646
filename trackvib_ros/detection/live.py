"""A first speed while the train is still passing, from two rail channels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .blind import envelope_delay
from .kinematics import POSITION_SIGMA
from .passage import Record, excited, strong_interval, traces_of

LEAST_CORRELATION = 0.6
AXLE_SPACING = 6.2
"""Track per wheelset of a train on bogies (m), to count how many have passed."""
_PULSE = 0.25  # m, place of one pulse


@dataclass(frozen=True)
class Provisional:
    """Speed (m/s, sigma) and direction after ``distance`` (m) of the train has passed."""

    speed: float
    sigma: float
    direction: int
    correlation: float
    distance: float
    sensors: tuple[str, str]


def provisional(
    records: Sequence[Record], within: tuple[float, float], limits: tuple[float, float]
) -> Provisional | None:
    """Speed by the delay between the outer two rail channels; ``None`` while it is not clear."""
    rails = sorted(
        (r for r in records if r.channel.layer == "rail" and excited(r, within)),
        key=lambda r: r.channel.x,
    )
    if len(rails) < 2 or rails[-1].channel.x - rails[0].channel.x < 2.0:
        return None
    a, b = rails[0], rails[-1]
    best: Provisional | None = None
    for band, (low, high) in enumerate(a.window.bands[: len(b.window.bands)]):
        first, second = traces_of(a, within)[band], traces_of(b, within)[band]
        found = envelope_delay(first, second, within, limits)
        if found is None or found[1] < LEAST_CORRELATION:
            continue
        delay, correlation = found
        baseline = b.channel.x - a.channel.x
        speed = baseline / abs(delay)
        # what both channels have seen of the train
        later = second if delay > 0 else first
        interval = strong_interval(later, high - low, within)
        if interval is None:
            continue
        distance = speed * (within[1] - interval[0])
        wheelsets = max(1.0, distance / AXLE_SPACING)
        sigma = speed * np.sqrt(2 * (POSITION_SIGMA**2 + _PULSE**2 / wheelsets)) / baseline
        if best is None or correlation > best.correlation:
            best = Provisional(
                speed,
                float(sigma),
                1 if delay > 0 else -1,
                correlation,
                distance,
                (a.channel.name, b.channel.name),
            )
    return best
