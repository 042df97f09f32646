"""How an event goes on: when wheelsets were last near, and what quiet time ends it."""

from __future__ import annotations

from bisect import insort
from dataclasses import dataclass, field

from .events import Channel

_TYPICAL = 0.75  # quantile of the levels of an event: wheelsets, not what blows add to them
_FADED = 1 / 100  # of the typical level of an event: what is left is no train
_STRONG = 1 / 4  # of the typical level: a wheelset is near
_CREEP = 1.023  # by which the least level is forgotten a frame, 10 dB/s
_RISEN = 1.6  # over the least level: another wheelset comes, 2 dB
_HANG_LEAST_S, _HANG_FACTOR, _HANG_MORE_S = 1.0, 2.0, 0.5
_HANG_LEARNT_NS = 1_000_000_000
_LAYER_ORDER = ("rail", "slab", "support_layer", "bridge")


@dataclass
class Occupancy:
    """One event since its onset; its dictionaries have the place of a channel as key.

    Attributes:
        channels: all channels of the detector.
        start_ns: onset.
        last_ns: when a wheelset was last near.
        pause_ns: longest time between two of these so far.
        strong_ns: when the level was last strong.
        lull_ns: the longest stretch between two of these so far, its start and its end.
    """

    channels: tuple[Channel, ...]
    start_ns: int
    last_ns: dict[int, int] = field(default_factory=dict)
    pause_ns: dict[int, int] = field(default_factory=dict)
    strong_ns: dict[int, int] = field(default_factory=dict)
    lull_ns: dict[int, tuple[int, int]] = field(default_factory=dict)
    _levels: dict[int, list[float]] = field(default_factory=dict)
    _least: dict[int, float] = field(default_factory=dict)

    def follow(self, channel: int, level: float, now_ns: int) -> bool:
        """Note when a wheelset was last near: strong energy, or energy that rises again.

        What only fades is a train that leaves: a rail carries it on, 1 dB/m weaker.

        Returns:
            Whether the level is strong.
        """
        levels = self._levels.setdefault(channel, [])
        insort(levels, level)
        typical = levels[int(_TYPICAL * len(levels))]
        least = self._least[channel] = min(level, _CREEP * self._least.get(channel, level))
        strong = level > _STRONG * typical
        if strong:
            lull = self.strong_ns.get(channel, now_ns), now_ns
            longest = self.lull_ns.get(channel, lull)
            self.lull_ns[channel] = max(longest, lull, key=lambda span: span[1] - span[0])
            self.strong_ns[channel] = now_ns
        near = strong or level > max(_FADED * typical, _RISEN * least)
        if near or _FADED * typical < 1:
            if channel in self.last_ns:
                pause = now_ns - self.last_ns[channel]
                self.pause_ns[channel] = max(pause, self.pause_ns.get(channel, 0))
            self.last_ns[channel] = now_ns
        return strong

    def strong(self) -> dict[int, int]:
        """When each rail channel was last strong (ns)."""
        return {c: t for c, t in self.strong_ns.items() if self.channels[c].layer == "rail"}

    def quiet(self, now_ns: int) -> dict[int, tuple[int, int | None]]:
        """Where each rail channel was without strong energy for longest, from when to when (ns).

        ``None`` for the end of a stretch that still lasts.
        """
        spans: dict[int, tuple[int, int | None]] = {}
        for c, latest in self.strong().items():
            start, end = self.lull_ns[c]
            spans[c] = (start, end) if end - start > now_ns - latest else (latest, None)
        return spans

    def last(self) -> int:
        """Last activity of the layer nearest to the wheels (ns): a bridge rings on for seconds."""
        for layer in _LAYER_ORDER:
            times = [t for c, t in self.last_ns.items() if self.channels[c].layer == layer]
            if times:
                return max(times)
        return self.start_ns

    def hang_ns(self, longest_s: float) -> int:
        """Quiet time that ends it: a multiple of the longest pause that it had so far (ns).

        Args:
            longest_s: quiet time that ends any event (s).
        """
        pauses = [t for c, t in self.pause_ns.items() if self.channels[c].layer == "rail"]
        if not pauses or self.last() - self.start_ns < _HANG_LEARNT_NS:
            return round(longest_s * 1e9)
        hang = _HANG_FACTOR * max(pauses) * 1e-9 + _HANG_MORE_S
        return round(1e9 * min(max(hang, _HANG_LEAST_S), longest_s))
