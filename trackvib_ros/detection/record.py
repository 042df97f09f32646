"""One channel in an event: its features, its noise, its energy traces."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .events import Channel
from .features import Window
from .health import clipped
from .pattern import Trace
from .place import Wave

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Record:
    """What is known of one channel in an event: features and noise floor per band."""

    channel: Channel
    window: Window
    floor: Array

    def between(self, start: float, stop: float) -> Record:
        """The part between two times (s)."""
        window = self.window
        part = slice(*(int(i) for i in np.searchsorted(window.time, [start, stop])))
        names = ("time", "energy", "low", "peak", "flat", "valid", "holes")
        kept = {name: getattr(window, name)[part] for name in names}
        return replace(self, window=replace(window, **kept))

    def wave(self, within: tuple[float, float] | None = None) -> Wave:
        """The waveform below 100 Hz; whether it was clipped is asked of an interval (s)."""
        window = self.window
        time = window.time
        cut = within is not None and clipped(window, (time >= within[0]) & (time <= within[1]))
        return Wave(time - window.low_shift, window.low, window.measured, cut)

    def traces(self, within: tuple[float, float], limited: bool = False) -> list[Trace]:
        """One trace per band, quiet outside an interval (s); levels ``limited`` on request."""
        window = self.window
        return [
            Trace(
                self.channel.name,
                self.channel.x,
                window.time - window.shift[b],
                window.energy[:, b],
                window.measured,
                float(self.floor[b]),
                window.step,
                (within[0] - 0.3, within[1] + 0.3),
                limited,
            )
            for b in range(len(window.bands))
        ]
