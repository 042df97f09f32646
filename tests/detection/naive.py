"""A five-line detector: counts peaks of the rail acceleration. An example of a plug-in."""

import numpy as np
from scipy.signal import find_peaks

from trackvib_ros.detection import TrainEvent


class PeakCounter:
    def __init__(self, channels):
        self.rail = next(c.name for c in channels if c.layer == "rail")
        self.parts = []

    def process(self, block):
        if self.rail in block.channels:
            self.parts.append((block.time_ns, block.data[:, block.channels.index(self.rail)]))
        return []

    def finish(self):
        time, x = (np.concatenate(part) for part in zip(*self.parts, strict=True))
        envelope = np.convolve(np.abs(x), np.ones(200) / 200, "same")
        found, _ = find_peaks(envelope, height=0.3 * envelope.max(), distance=400)
        stamps = [int(time[i]) for i in found]
        make = lambda kind, t: TrainEvent(kind, t, 0.1, 0.5, "peaks", (self.rail,))  # noqa: E731
        events = [make("axle", t) for t in stamps]
        return [*events, make("arrival", stamps[0]), make("passage", stamps[0])]
