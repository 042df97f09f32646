"""From raw blocks to features: gap-safe conditioning, band energies at about 1 kHz, a bounded ring.

Everything here is a recursion over samples, so the result cannot depend on how a stream was cut
into blocks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from trackvib_ros.waveform import Waveform

Array = NDArray[np.float64]

BANDS: tuple[tuple[float, float], ...] = (
    (5.0, 150.0),
    (20.0, 400.0),
    (60.0, 800.0),
    (400.0, 1600.0),
)
"""Frequency bands (Hz) in which energy is measured; the best one is kept per passage. The lowest
holds the deflection under the wheel, the highest the pinned-pinned resonance of the rail (about
1 kHz), which stands out of white noise by 3 to 6 dB where the lower ones drown.

Their filters have linear phase (Bessel low-pass; delayed signal minus its moving mean as
high-pass): the slow pulse of a wheel at 40 km/h keeps its symmetry and its place.
"""

LOW_TOP = 100.0
"""Edge (Hz) of the low-passed waveform, a Bessel filter of second order."""

SLOW = (0.7, 10.0)
"""Frequency band (Hz) of the load itself, which channels on a bridge have besides: under a train of
60 km/h a gauge on a span of 20 m shows little above 1 Hz."""

FRAME_S = 0.01
"""Length of a decision frame (s), nearly: a whole number of bins."""

BLOW_S = 0.04
"""What lasts less (s) is a blow and no wheelset: four frames, one more than a blow of 2 ms touches
through filters of 10 ms. At 115 m/s a rail carries a wheelset, 1 dB/m, as far in 40 ms as 5 dB."""

_BIN_RATE = 1000.0
_INNER_RATE = 5000.0  # Hz, band filters run at this rate or up to twice it
_INNER_TOP = 1700.0  # Hz
_RECURSIVE = np.array([1.0, 0.0])  # keeps lfilter from convolving, whose rounding follows the block
_FILL_S = 0.02  # longer holes are marked invalid instead of interpolated
_BESIDE_S = 0.005  # of samples on either side of a short hole, whose means a line bridges
_LEAST_MEASURED = 0.3  # of a frame
_MEAN_S = 0.06  # before a long hole, half the memory of the lowest band's high-pass
_SETTLE_S = 0.05  # bins after a hole that the filters still remember
_BRIDGED_S = 0.015  # after a hole that is interpolated; exp(-2 pi 100 Hz t) is 1e-4
_MAX_GAP_S = 5.0  # longer gaps restart the stream


@dataclass(frozen=True)
class Window:
    """Features of one channel over a span of time.

    Attributes:
        time: centre of every bin, group delay of the filters removed (s after ``origin_ns``),
            shape (bins,); :attr:`shift` is per band.
        energy: mean square per band, shape (bins, bands).
        low: low-passed waveform, shape (bins,).
        peak: largest magnitude of the raw samples in the bin.
        flat: samples equal to the one before, per bin.
        valid: whether the bin holds measured samples only (short holes interpolated).
        holes: fraction of dropped samples per bin.
        step: bin length (s).
        shift: group delay per band (s), to be subtracted from ``time``.
        bands: frequency limits of the bands (Hz).
    """

    origin_ns: int
    time: Array
    energy: Array
    low: Array
    peak: Array
    flat: Array
    valid: NDArray[np.bool_]
    holes: Array
    step: float
    shift: Array
    low_shift: float
    bands: tuple[tuple[float, float], ...]

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Bins that nothing but measured samples made.

        Between two samples of a strong vibration a short hole is bridged by a slow wave that is not
        there. Where such holes leave less than half of what is valid, they count as measured.
        """
        after = round(_BRIDGED_S / self.step)
        lost = np.cumsum(np.concatenate([np.zeros(after + 1), self.holes > 0]))
        kept = self.valid & (lost[after + 1 :] == lost[: -after - 1])
        return np.asarray(kept if 2 * kept.sum() > self.valid.sum() else self.valid)


@dataclass(frozen=True)
class Frame:
    """About 10 ms of a group, per channel: see :class:`Window`.

    Attributes:
        energy: of what was measured, shape (channels, bands); NaN where that is too little.
        valid: mostly measured.
        still: not one sample differs from the one before.
        mean: of the raw samples.
    """

    energy: Array
    valid: NDArray[np.bool_]
    still: NDArray[np.bool_]
    mean: Array


def bands_for(rate: float, slow: bool = False) -> tuple[tuple[float, float], ...]:
    """The bands that a sampling rate (Hz) can show; with :data:`SLOW` last."""
    usable = [(low, min(high, 0.45 * rate)) for low, high in (*BANDS, *([SLOW] if slow else []))]
    kept = tuple(band for band in usable if band[1] >= 2 * band[0])
    return kept or ((0.02 * rate, 0.45 * rate),)


def _dc_delay(sos: Array, rate: float) -> float:
    impulse = np.zeros(int(0.5 * rate) + 8)
    impulse[0] = 1.0
    response = signal.sosfilt(sos, impulse)
    return float(np.sum(np.arange(response.size) * response) / np.sum(response) / rate)


def _freedom(power: Array, width: float, time: float) -> float:
    """Degrees of freedom of the energy of Gaussian noise over a time (s).

    2 T (∫S df)² / ∫S² df for a power spectrum S sampled every ``width`` Hz (Blackman & Tukey, The
    measurement of power spectra, 1958); 2 B T for a rectangular band of width B.
    """
    return float(2 * time * width * power.sum() ** 2 / np.sum(power**2))


def _runs(true: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Begin and end of every stretch of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], true.view(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _moving_high_pass(low: float, rate: float) -> Array:
    """Taps of "delayed minus moving mean": -3 dB near ``low`` (Hz), linear phase."""
    taps = 2 * max(1, round(0.3 * rate / low)) + 1
    out = np.full(taps, -1.0 / taps)
    out[taps // 2] += 1.0
    return out


class GroupStream:
    """Channels that share stamps and rate: raw samples in, features in a ring out.

    Attributes:
        step: length of a bin (s).
        bands: frequency limits (Hz), with :data:`SLOW` if asked for.
        shift: group delay per band (s).
        freedom: degrees of freedom of a bin's energy per band, white noise.
        end_ns: time after the newest sample.
    """

    def __init__(
        self, channels: tuple[str, ...], dt_ns: int, keep_s: float, slow: bool = False
    ) -> None:
        self.channels = channels
        self.dt_ns = dt_ns
        self.rate = 1e9 / dt_ns
        self._first = max(1, int(self.rate // _INNER_RATE))
        inner = self.rate / self._first
        self.decimation = self._first * max(1, int(inner // _BIN_RATE))
        self.step = self.decimation / self.rate
        self.frame_bins = max(1, round(FRAME_S / self.step))
        self.frame_s = self.frame_bins * self.step
        # every ``_first``-th sample of a bin is in its mean, from the first sample on
        self._centre_ns = dt_ns * (self.decimation - self._first) // 2
        self._to_end_ns = dt_ns * self.decimation - self._centre_ns
        self.bands = bands_for(self.rate, slow)
        top = min(_INNER_TOP, 0.45 * self.rate)
        self._front = signal.bessel(4, top, "low", norm="mag", fs=self.rate, output="sos")
        self._sos = [
            signal.bessel(3, min(high, 0.45 * inner), "low", norm="mag", fs=inner, output="sos")
            for _, high in self.bands
        ]
        self._fir = [_moving_high_pass(low, inner) for low, _ in self.bands]
        front = _dc_delay(self._front, self.rate)
        self.shift = np.array(
            [
                front + _dc_delay(sos, inner) + (len(fir) // 2) / inner
                for sos, fir in zip(self._sos, self._fir, strict=True)
            ]
        )
        f = np.arange(0.25, 0.5 * inner, 0.5)
        front_gain = signal.sosfreqz(self._front, f, fs=self.rate)[1]
        self.freedom = np.array(
            [
                _freedom(
                    np.abs(
                        front_gain
                        * signal.sosfreqz(sos, f, fs=inner)[1]
                        * signal.freqz(fir, 1, f, fs=inner)[1]
                    )
                    ** 2,
                    0.5,
                    self.step,
                )
                for sos, fir in zip(self._sos, self._fir, strict=True)
            ]
        )
        top = min(LOW_TOP, 0.4 * inner)
        low_sos = signal.bessel(2, top, "low", norm="mag", fs=inner, output="sos")
        self._sos.append(low_sos)
        self._fir.append(np.ones(1))
        self.low_shift = front + _dc_delay(low_sos, inner)
        self._capacity = int(keep_s / self.step)
        n = len(channels)
        columns = len(self.bands) + 6
        self._ring = np.zeros((2 * self._capacity, n, columns), dtype=np.float32)
        self._stamps = np.zeros(2 * self._capacity, dtype=np.int64)
        self._fill = 0
        self.dropped_bins = 0
        self.late_samples = 0
        self.missing_samples = 0
        self.restarts = 0
        self._pending: list[Array] = []
        self._pending_ns = 0
        self._pending_count = 0
        self.end_ns: int | None = None
        self._zi: list[Array] | None = None
        self._last = np.full(n, np.nan)
        self._held = np.zeros(n)
        self._past = np.full((max(1, int(_MEAN_S * self.rate)), n), np.nan)
        self._beside = max(1, round(_BESIDE_S * self.rate))
        self._delay = np.rint(self.shift / self.step).astype(np.int64)
        self._in_hole = np.zeros(n, dtype=bool)
        # the filters start on one sample, whose own departure from the mean must fade
        self._unsettled = np.full(n, int(_SETTLE_S * self.rate))

    def push(self, block: Waveform) -> None:
        """Append a block: overlaps are cut, gaps filled with NaN, long gaps restart the grid."""
        data = np.asarray(block.data, dtype=np.float64)
        stamp = block.stamp_ns
        if self.end_ns is not None:
            offset = (stamp - self.end_ns) / self.dt_ns
            if offset <= -0.5:
                cut = min(len(data), round(-offset))
                self.late_samples += cut
                data = data[cut:]
                stamp += cut * self.dt_ns
                if not len(data):
                    return
            elif offset >= 0.5:
                missing = round(offset)
                self.missing_samples += missing
                if missing / self.rate > _MAX_GAP_S:
                    self._restart()
                else:
                    hole = np.full((missing, data.shape[1]), np.nan)
                    data = np.concatenate([hole, data])
                    stamp -= missing * self.dt_ns
        if not self._pending_count:
            self._pending_ns = stamp
        else:
            # follow the stamps, so that a clock a little off its nominal rate does not pile up
            self._pending_ns = stamp - self._pending_count * self.dt_ns
        self._pending.append(data)
        self._pending_count += len(data)
        self.end_ns = stamp + len(data) * self.dt_ns

    def _restart(self) -> None:
        self._consume(self._pending_count, flush=True)
        self._pending, self._pending_count = [], 0
        self._zi = None
        self._past[:] = np.nan
        self._unsettled[:] = int(_SETTLE_S * self.rate)
        self.restarts += 1

    def advance(self, until_ns: int) -> None:
        """Turn pending samples before ``until_ns`` into features, whole bins only."""
        count = min(self._pending_count, (until_ns - self._pending_ns) // self.dt_ns)
        self._consume(int(count), flush=False)

    def flush(self) -> None:
        """End of stream: nothing more will fill a hole."""
        self._consume(self._pending_count, flush=True)

    def _consume(self, count: int, flush: bool) -> None:
        count -= count % self.decimation
        if count <= 0:
            return
        raw = np.concatenate(self._pending) if len(self._pending) > 1 else self._pending[0]
        # as far as a hole that starts before ``count`` can matter
        ahead = int(_FILL_S * self.rate) + self._beside + 2
        bad = ~np.isfinite(raw[: count + ahead])
        if bad.any() and not flush:
            count = self._resolved(bad, count)
            if count <= 0:
                self._pending = [raw]
                return
        x = raw[:count]
        unsettled = self._unsettled
        self._unsettled = np.maximum(unsettled - count, 0)
        if bad.any():
            x, holes, invalid = self._fill_holes(raw, bad, count)
        else:
            holes = np.zeros((count // self.decimation, x.shape[1]))
            invalid = holes > 0
            self._last = x[-1].copy()
            self._in_hole[:] = False
        self._past = np.concatenate([self._past, x[-len(self._past) :]])[-len(self._past) :]
        if (unsettled > 0).any():
            invalid |= np.arange(len(invalid))[:, None] * self.decimation < unsettled
        self._filter(x, holes, invalid)
        self._pending = [raw[count:]] if count < len(raw) else []
        self._pending_ns += count * self.dt_ns
        self._pending_count -= count

    def _resolved(self, bad: NDArray[np.bool_], count: int) -> int:
        """Samples that can be conditioned now: a short hole waits for what follows it."""
        limit = int(_FILL_S * self.rate)
        for column in bad.T:
            for first, last in _runs(column):
                if first >= count:
                    break
                after = column[last : last + self._beside]
                waits = last == column.size or (after.size < self._beside and not after.any())
                if waits and last - first <= limit:
                    count = first
        return count - count % self.decimation

    def _fill_holes(
        self, raw: Array, bad: NDArray[np.bool_], count: int
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        limit = int(_FILL_S * self.rate)
        x = raw[:count].copy()
        invalid = np.zeros((count, x.shape[1]), dtype=bool)
        for c in range(x.shape[1]):
            column = bad[:, c]
            carried, self._in_hole[c] = self._in_hole[c], False
            if not column[:count].any():
                self._last[c] = x[-1, c]
                continue
            for first, last in _runs(column):
                if first >= count:
                    break
                before = x[first - 1, c] if first else self._last[c]
                if np.isnan(before):
                    before = raw[last, c] if last < len(column) else 0.0
                stop = min(last, count)
                long = last - first > limit or last == len(column) or (carried and first == 0)
                if not long:
                    after = raw[last : last + self._beside, c]
                    after = after[: np.argmin(np.append(np.isfinite(after), False))]
                    known = self._before(x[:first, c], c)[-self._beside :]
                    start = float(known.mean()) if known.size else before
                    end = float(after.mean())
                    # from the middle of the samples before to that of those after
                    ahead = 0.5 * (known.size + 1)
                    length = last - first - 1 + ahead + 0.5 * (after.size + 1)
                    weight = (np.arange(stop - first) + ahead) / length
                    x[first:stop, c] = start + weight * (end - start)
                else:
                    if not (carried and first == 0):
                        known = self._before(x[:first, c], c)
                        # a last sample off the mean would step out of the filters
                        self._held[c] = float(known.mean()) if known.size else before
                    x[first:stop, c] = self._held[c]
                    settled = int(_SETTLE_S * self.rate)
                    invalid[first : stop + settled, c] = True
                    self._in_hole[c] = stop == count
                    self._unsettled[c] = max(self._unsettled[c], stop + settled - count)
            self._last[c] = x[-1, c]
        shape = (count // self.decimation, self.decimation, x.shape[1])
        holes = bad[:count].reshape(shape).mean(axis=1)
        return x, holes, np.asarray(invalid.reshape(shape).any(axis=1))

    def _before(self, x: Array, channel: int) -> Array:
        """Samples of a channel before a hole, as many as are kept."""
        known = np.concatenate([self._past[:, channel], x])[-len(self._past) :]
        return np.asarray(known[np.isfinite(known)])

    def _filter(self, x: Array, holes: Array, invalid: NDArray[np.bool_]) -> None:
        n, d = len(x) // self.decimation, self.decimation
        if self._zi is None:
            self._zi_front = signal.sosfilt_zi(self._front)[:, :, None] * x[0]
            self._zi = [signal.sosfilt_zi(sos)[:, :, None] * x[0] for sos in self._sos]
            self._zi_fir = [
                signal.lfilter_zi(fir, _RECURSIVE)[:, None] * x[0] if fir.size > 1 else np.empty(0)
                for fir in self._fir
            ]
            self._previous = np.full(x.shape[1], np.nan)
        shape = (n, d, x.shape[1])
        out = np.empty((n, x.shape[1], self._ring.shape[2]), dtype=np.float32)
        y, self._zi_front = signal.sosfilt(self._front, x, axis=0, zi=self._zi_front)
        inner = np.ascontiguousarray(y[:: self._first])
        inner_shape = (n, d // self._first, x.shape[1])
        b = len(self.bands)
        for k, (sos, fir) in enumerate(zip(self._sos, self._fir, strict=True)):
            y, self._zi[k] = signal.sosfilt(sos, inner, axis=0, zi=self._zi[k])
            if k < b:
                y, self._zi_fir[k] = signal.lfilter(fir, _RECURSIVE, y, axis=0, zi=self._zi_fir[k])
                np.square(y, out=y)
            out[:, :, k] = y.reshape(inner_shape).mean(axis=1)
        out[:, :, b + 1] = np.abs(x).reshape(shape).max(axis=1)
        same = np.empty(x.shape, dtype=np.float32)
        same[0] = x[0] == self._previous
        same[1:] = x[1:] == x[:-1]
        self._previous = x[-1].copy()
        out[:, :, b + 2] = same.reshape(shape).sum(axis=1)
        out[:, :, b + 3] = ~invalid
        out[:, :, b + 4] = holes
        out[:, :, b + 5] = x.reshape(shape).mean(axis=1)
        stamps = self._pending_ns + self.dt_ns * d * np.arange(n, dtype=np.int64) + self._centre_ns
        self._append(out, stamps)

    def _append(self, out: NDArray[np.float32], stamps: NDArray[np.int64]) -> None:
        size = 2 * self._capacity
        position = 0
        while position < len(out):
            if self._fill == size:
                self._ring[: self._capacity] = self._ring[self._capacity :]
                self._stamps[: self._capacity] = self._stamps[self._capacity :]
                self._fill = self._capacity
                self.dropped_bins += self._capacity
            take = min(len(out) - position, size - self._fill)
            self._ring[self._fill : self._fill + take] = out[position : position + take]
            self._stamps[self._fill : self._fill + take] = stamps[position : position + take]
            self._fill += take
            position += take

    @property
    def bins(self) -> int:
        """Bins made since the start of the stream."""
        return self.dropped_bins + self._fill

    def frame_end_ns(self, first_bin: int) -> int:
        """Time after a decision frame."""
        return (
            int(self._stamps[first_bin - self.dropped_bins + self.frame_bins - 1]) + self._to_end_ns
        )

    def frame(self, first_bin: int) -> Frame:
        """What one decision frame holds."""
        start = first_bin - self.dropped_bins
        part = self._ring[start : start + self.frame_bins]
        mean = part.mean(axis=0, dtype=np.float64)
        b = len(self.bands)
        return Frame(
            energy=self._without_holes(mean[:, :b], start, self.frame_bins),
            valid=mean[:, b + 3] > 0.7,
            still=part[:, :, b + 2].min(axis=0) >= self.decimation,
            mean=mean[:, b + 5],
        )

    def _without_holes(self, mean: Array, start: int, count: int) -> Array:
        """Mean energies of bins of the ring that holes have no share in, (channels, bands).

        NaN for a band of which too little was measured.

        Args:
            mean: that of all bins.
            start: first bin.
            count: number of bins.
        """
        b = len(self.bands)
        before = max(start - int(self._delay.max()), 0)
        holes = self._ring[before : start + count, :, b + 4]
        if not holes.any():
            return mean
        out = np.array(mean)
        for k, delay in enumerate(self._delay):
            # at the start of a stream there is less to look back on
            whole = np.zeros((count, len(out)), dtype=bool)
            first, last = (max(int(i - delay), 0) for i in (start, start + count))
            seen = self._ring[first:last, :, b + 4] == 0
            whole[count - len(seen) :] = seen
            measured = whole.sum(axis=0)
            part = self._ring[start : start + count, :, k].astype(np.float64)
            energy = np.where(whole, part, 0.0).sum(axis=0)
            enough = measured >= _LEAST_MEASURED * count
            out[:, k] = np.where(enough, energy / np.maximum(measured, 1), np.nan)
        return out

    def measured(self, channel: int, until_ns: int) -> Array:
        """Energies of the measured frames up to a time, shape (frames, bands).

        Frames are those of :meth:`frame`, as far as the ring still holds them.
        """
        count = int(np.searchsorted(self._stamps[: self._fill], until_ns)) // self.frame_bins
        part = self._ring[: count * self.frame_bins, channel]
        part = part.reshape(count, self.frame_bins, part.shape[1])
        b = len(self.bands)
        energy = part[:, :, :b].mean(axis=1, dtype=np.float64)
        moving = part[:, :, b + 2].min(axis=1) < self.decimation
        usable = (part[:, :, b + 3].mean(axis=1) > 0.7) & moving & (energy > 0).all(axis=1)
        return np.asarray(energy[usable])

    def fresh(
        self, first_bin: int, until_ns: int
    ) -> tuple[Array, NDArray[np.bool_], NDArray[np.int64]]:
        """Bins of a decision frame that is not complete yet, as far as they end by a time.

        Returns:
            Energies, shape (bins, channels, bands); whether measured (bins, channels); time after
            every bin (ns).
        """
        start = first_bin - self.dropped_bins
        stop = min(start + self.frame_bins, self._fill)
        ends = self._stamps[start:stop] + self._to_end_ns
        count = int(np.searchsorted(ends, until_ns, side="right"))
        part = self._ring[start : start + count]
        b = len(self.bands)
        return part[:, :, :b].astype(np.float64), part[:, :, b + 3] > 0.5, ends[:count]

    def resolved_ns(self, until_ns: int) -> int:
        """Time up to which :meth:`advance` to a time made all bins: a short hole waits."""
        made = self._pending_ns + self.decimation * self.dt_ns
        waits = self._pending_count >= self.decimation and made <= until_ns
        return self._pending_ns if waits else until_ns

    def window(self, channel: int, from_ns: int, to_ns: int) -> Window:
        """Features of one channel between two times, as far as the ring still holds them."""
        stamps = self._stamps[: self._fill]
        first, last = np.searchsorted(stamps, [from_ns, to_ns])
        part = self._ring[first:last, channel].astype(np.float64)
        b = len(self.bands)
        return Window(
            origin_ns=from_ns,
            time=np.asarray((stamps[first:last] - from_ns) * 1e-9, dtype=np.float64),
            energy=part[:, :b],
            low=part[:, b],
            peak=part[:, b + 1],
            flat=part[:, b + 2],
            valid=part[:, b + 3] > 0.5,
            holes=part[:, b + 4],
            step=self.step,
            shift=self.shift,
            low_shift=self.low_shift,
            bands=self.bands,
        )
