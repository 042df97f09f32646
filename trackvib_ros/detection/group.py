"""Channels that are sampled together: their stream of features, their trigger, their onset test."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from trackvib_ros.waveform import Waveform

from .events import Channel
from .features import SLOW, GroupStream
from .onset import WARM_UP, Onset, Trigger, margins, quietest
from .record import Record

Array = NDArray[np.float64]

LEAST_BINS = 50  # of a record that tells anything


class Group:
    """One block group.

    Args:
        block: its first block, of no matter what length.
        index: place of each of its channels in the detector.
        keep_s: features are kept for so long (s).
        sharing: channels of the detector that share its rate of false arrivals.
        slow: whether the load itself is heard, below 5 Hz.

    Attributes:
        next_bin: first bin of the next decision frame.
        calm_s: for how long it has been much quieter than when its noise floor was learned (s).
        watching: whether an onset is looked for.
        late: whether it sends what others have not been kept waiting for.
    """

    def __init__(
        self, block: Waveform, index: list[int], keep_s: float, sharing: int, slow: bool = False
    ) -> None:
        self.stream = GroupStream(block.channels, block.dt_ns, keep_s, slow)
        self.index = index
        self.next_bin = 0
        self.calm_s = 0.0
        self.trigger = self._trigger()
        self.onset = Onset(len(index), len(self.stream.bands), self.stream.step, sharing)
        self.watching = True
        self.late = False

    def _trigger(self) -> Trigger:
        stream = self.stream
        return Trigger(
            len(self.index), stream.bands, stream.frame_s, stream.frame_bins * stream.freedom
        )

    def louder_before(self, factor: float) -> bool:
        """Whether the recent level is lower than the first noise floor by a factor."""
        recent = self.trigger.recent
        fell = (recent > 0) & (self.trigger.first_floor > factor * recent)
        return bool(np.any(fell & ~self._slow))

    def quietest(self, until_ns: int) -> Array:
        """Noise floors by the quietest stretch up to a time, (channels, bands)."""
        stream = self.stream
        rows = (stream.measured(row, until_ns) for row in range(len(self.index)))
        found = np.stack([quietest(row, stream.bands, stream.frame_s) for row in rows])
        # its filter remembers nearly a second: at first it shows how the record begins
        return np.where(self._slow, np.fmax(found, self.trigger.first_floor), found)

    @property
    def _slow(self) -> NDArray[np.bool_]:
        """Which bands lie below all others: that of the load."""
        return np.array([band == SLOW for band in self.stream.bands])

    def begin_again(self, floor: Array) -> None:
        """Take the frames from the first one on, with noise floors (channels, bands)."""
        self.next_bin = 0
        self.trigger = self._trigger()
        self.trigger.start_from(floor)
        self.onset.restart()
        self.watching = True

    def relearn(self) -> None:
        """Learn the noise floors anew: what seemed an event is the new noise."""
        for row in range(len(self.index)):
            self.trigger.relearn(row)

    def rises(self, until_ns: int) -> tuple[Array | None, list[tuple[int, int, int]]]:
        """The onset test in the next decision frame, as far as it goes.

        Returns:
            Statistic; time after the bin in which it crosses its threshold, channel of the group
            and alternative.
        """
        ready = self.trigger.seen >= WARM_UP
        if not self.watching or not ready.any():
            return None, []
        energy, valid, ends = self.stream.fresh(self.next_bin, until_ns)
        if not len(ends):
            return None, []
        valid = valid & ready
        with np.errstate(invalid="ignore"):
            floor = self.trigger.floor * margins(self.stream.bands)
            ratio = np.where(valid[..., None], energy / floor, 0.0)
        statistic = self.onset.look(ratio, valid, self.stream.freedom * self.trigger.whiteness)
        over = statistic.mean(axis=2) > self.onset.threshold
        found = []
        for local in np.flatnonzero(over.any(axis=0)):
            at = int(np.argmax(over[:, local]))
            found.append((int(ends[at]), int(local), int(np.argmax(statistic[at, local]))))
        return statistic, found

    def records(self, channels: tuple[Channel, ...], from_ns: int, to_ns: int) -> list[Record]:
        """What its channels show in an interval of time, those that show anything.

        Args:
            channels: all channels of the detector.
            from_ns: start (ns).
            to_ns: end (ns).
        """
        out = []
        for local, channel in enumerate(self.index):
            window = self.stream.window(local, from_ns, to_ns)
            floor = self.trigger.floor[local]
            if window.time.size > LEAST_BINS and np.isfinite(floor).all():
                out.append(Record(channels[channel], window, floor.copy()))
        return out
