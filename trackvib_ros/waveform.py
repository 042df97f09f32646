"""The one signal type between sensor, topics, bags and detector."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Waveform:
    """A block of equally spaced samples of one channel group.

    Attributes:
        stamp_ns: time of the first sample (ns, simulation or measurement time).
        dt_ns: constant sampling interval (ns).
        channels: channel names, one per column of ``data``.
        data: samples x channels, acceleration in m/s², positive up; NaN marks a dropped sample.
        frame_id: coordinate frame of the group.
    """

    stamp_ns: int
    dt_ns: int
    channels: tuple[str, ...]
    data: NDArray[np.float32]
    frame_id: str = ""

    @property
    def time_ns(self) -> NDArray[np.int64]:
        """Time of every sample (ns), shape (samples,)."""
        return self.stamp_ns + self.dt_ns * np.arange(self.data.shape[0], dtype=np.int64)

    @property
    def end_ns(self) -> int:
        """Time of the first sample after the block (ns): the stamp a gapless successor has."""
        return self.stamp_ns + self.dt_ns * int(self.data.shape[0])
