"""The model of a channel that answers every wheelset alike: its spectra, its evidence.

What is slower than the passing train is left out: a hump in time is not the pattern of a train.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.linalg import lapack

from .features import SLOW
from .record import Record

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

USUAL_MISFIT = 0.25
"""Part of the spectrum that no response explains, where it is not fitted."""

OCTAVES = 4
"""Down from the shortest waves, each with a misfit of its own; the last is all that is longer."""

_MARGIN_S = 1.5  # on either side of the strong energy
_FADE_S = 0.3
_SLOWEST = 4.0  # periods in the strong interval: what is slower is its envelope
_SMOOTH_HZ = 2.0
_DAMPED = 0.1  # of critical: what is damped more does not outlast its wheelset by long
_MODES = 2
_RINGING = 0.2  # share of the free vibration, of a mode that is told apart from others
_RINGING_HZ = 40.0
_RUNG_S = 2.0
_PLACES = 200  # over the support of a response
_TOP_HZ = 80.0  # the waveform is low-passed at 100 Hz


def smoothed(values: Array, width: int) -> Array:
    """Mean over ``width`` neighbours, mirrored at the ends."""
    half = min(width // 2, values.size - 1)
    total = np.concatenate([[0.0], np.cumsum(np.pad(values, half, mode="reflect"))])
    return np.asarray((total[2 * half + 1 :] - total[: -2 * half - 1]) / (2 * half + 1))


@dataclass(frozen=True)
class Observation:
    """One series of a channel about the middle of its strong energy, fading to zero at the ends.

    Attributes:
        time: of the samples after ``epoch`` (s), equal steps.
        quiet: samples before the event.
        duration: between 5 and 95 % of the energy (s).
        limit: highest frequency it holds (Hz).
        filtered: coefficients by which ``values``, but not ``quiet``, were filtered.
        rings: how late (s) the energy of free vibration is that was not filtered out.
    """

    name: str
    epoch: float
    time: Array
    values: Array
    quiet: Array
    duration: float
    limit: float
    filtered: tuple[float, ...] = (1.0,)
    rings: float = 0.0


class Spectrum:
    """Fourier coefficients of an observation between the slowest wave and ``top`` (Hz).

    Args:
        room: longest response (s); the series is periodic and must not wrap around.
    """

    def __init__(self, seen: Observation, room: float, top: float) -> None:
        self.epoch = seen.epoch
        n, step = seen.values.size, float(seen.time[1] - seen.time[0])
        size = int(fft.next_fast_len(n + int(room / step), real=True))
        f = fft.rfftfreq(size, step)
        wanted = (f >= _SLOWEST / seen.duration) & (f <= min(top, seen.limit))
        self.f: Array = f[wanted]
        self.y: ComplexArray = fft.rfft(seen.values, size)[wanted] * np.exp(
            -2j * np.pi * self.f * seen.time[0]
        )
        octave = np.floor(np.log2(min(top, seen.limit) / np.maximum(self.f, 1e-9)))
        self.octave = np.clip(octave, 0, OCTAVES - 1).astype(int)
        self.share = n / size  # of the coefficients that are independent
        delays = np.arange(len(seen.filtered)) * step
        phases = np.exp(-2j * np.pi * np.outer(self.f, delays))
        self.gain = np.abs(phases @ np.array(seen.filtered)) ** 2
        quiet = seen.quiet
        self.noise = np.zeros(self.f.size)
        if quiet.size > 64:
            own = np.abs(fft.rfft(quiet)) ** 2 * (n / quiet.size)
            own = smoothed(own, max(3, round(_SMOOTH_HZ * quiet.size * step)))
            self.noise = np.interp(self.f, fft.rfftfreq(quiet.size, step), own)
            self.noise *= self.gain
        self.excess = np.zeros(self.f.size)
        if self.usable:
            power = np.abs(self.y) ** 2
            width = min(round(_SMOOTH_HZ * size * step), self.f.size // 3)
            power, noise = smoothed(power, width), smoothed(self.noise, width)
            self.excess = np.maximum(power - noise, 1e-3 * power + 1e-12 * power.max())

    @property
    def usable(self) -> bool:
        """Whether there is something to compare."""
        return self.f.size >= 8 and bool(np.any(self.y))


def signs(wheelsets: int) -> Array:
    """Contrasts between the four wheelsets of a car, shape (4, wheelsets).

    All alike, front against rear of a bogie, leading against trailing bogie, and their product:
    vehicles pitch on their springs, and of two close wheelsets one rolls where the other has bent
    the track.
    """
    front = 1.0 - 2.0 * (np.arange(wheelsets) % 2)
    leading = 1.0 - 2.0 * (np.arange(wheelsets) // 2 % 2)
    return np.stack([np.ones(wheelsets), front, leading, front * leading])


def comb(
    places: Array, f: Array, speed: Array, acceleration: Array, weights: Array | None = None
) -> ComplexArray:
    """Fourier transform of the wheelset times about that of the middle of the train.

    Args:
        places: of the wheelsets behind the middle (m).
        f: frequencies (Hz), equal steps.
        speed, acceleration: as the middle passes (m/s, m/s²), shape (motions,).
        weights: of the wheelsets, shape (patterns, wheelsets); all 1 without.

    Returns:
        Shape (motions, frequencies), with weights (motions, patterns, frequencies).
    """
    v, a = speed[:, None], acceleration[:, None]
    root = np.sqrt(np.maximum(v * v + 2 * a * places, 0.01 * v * v))
    times = 2 * places / (v + root)
    patterns = () if weights is None else (len(weights),)
    if not f.size:
        return np.zeros((speed.size, *patterns, 0), dtype=np.complex128)
    # frequency i + block j is a product of two phases: far fewer exponentials, and a matrix product
    block = max(1, round(float(np.sqrt(f.size))))
    blocks = -(-f.size // block)
    step = (f[-1] - f[0]) / max(f.size - 1, 1)
    inner = np.exp(-2j * np.pi * times[:, None, :] * (step * np.arange(block))[:, None])
    outer = np.exp(
        -2j * np.pi * times[:, None, :] * (f[0] + step * block * np.arange(blocks))[:, None]
    )
    if weights is not None:
        outer, inner = outer[:, None] * weights[:, None, :], inner[:, None]
    product = (outer @ inner.swapaxes(-1, -2)).reshape(speed.size, *patterns, -1)
    return np.asarray(product[..., : f.size])


@dataclass(frozen=True)
class Model:
    """A spectrum with the support of its response and the part that this cannot explain.

    Attributes:
        before, after: support of the response about the passing of its wheelset (s).
        misfit: part of the spectrum that no response explains, of every octave.
        centre: of that passing for the middle of the train, after the epoch (s).
        deviation: power, over that of the common response, of what the wheelsets of a car differ
            by (:func:`signs`), of every octave; none if they answer alike.
    """

    spectrum: Spectrum
    before: float
    after: float
    misfit: tuple[float, ...] = (USUAL_MISFIT,) * OCTAVES
    centre: float = 0.0
    deviation: tuple[float, ...] = ()

    def comb(
        self, places: Array, speed: Array, acceleration: Array, loads: Sequence[float] = ()
    ) -> ComplexArray:
        """:func:`comb` with all that the model needs, and with the loads of the wheelsets."""
        weights = signs(places.size) if self.deviation else None
        if loads:
            weights = np.array(loads) * (np.ones((1, places.size)) if weights is None else weights)
        return comb(places, self.spectrum.f, speed, acceleration, weights)

    @property
    def knots(self) -> Array:
        """Times at which the response is free (s)."""
        step = 1 / (2.3 * self.spectrum.f[-1])
        return np.arange(-self.before, self.after + step, step)

    @property
    def unexplained(self) -> float:
        """Part of what was recorded that no response explains."""
        s = self.spectrum
        power = s.excess / s.gain
        return float(np.array(self.misfit)[s.octave] @ power / power.sum())

    def _variance(self) -> Array:
        s = self.spectrum
        return np.asarray(s.noise + np.array(self.misfit)[s.octave] * s.excess)

    def _shape(self, wheelsets: int, knots: int) -> Array:
        return np.sqrt(self.spectrum.excess / (wheelsets * knots))

    @cached_property
    def _waves(self) -> ComplexArray:
        t = self.knots
        return np.asarray(np.exp(2j * np.pi * np.outer(self.spectrum.f, t - t[0])))

    def _normal(self, combs: ComplexArray, wheelsets: int, centres: Array) -> tuple[Array, Array]:
        s, t = self.spectrum, self.knots
        combs = combs.reshape(len(combs), -1, s.f.size)
        motions, patterns = combs.shape[:2]
        shape = self._shape(wheelsets, t.size)
        weight = 2 * s.share / self._variance()
        size = np.ones((patterns, s.f.size))
        if patterns > 1:
            size[1:] = np.sqrt(np.array(self.deviation)[s.octave])
        scaled = combs * size
        blocks = np.empty((motions, patterns, t.size, patterns, t.size))
        for i in range(patterns):
            for j in range(i, patterns):
                cross = np.conj(scaled[:, i]) * scaled[:, j] * (weight * shape**2)
                even, odd = cross.real @ self._waves.real, cross.imag @ self._waves.imag
                # of lags from the longest positive to the longest negative one: Toeplitz
                lags = np.concatenate([(even - odd)[:, ::-1], (even + odd)[:, 1:]], axis=1)
                block = np.lib.stride_tricks.sliding_window_view(lags, t.size, axis=1)[:, ::-1]
                blocks[:, i, :, j] = block
                blocks[:, j, :, i] = block.swapaxes(1, 2)
        normal: Array = blocks.reshape(motions, patterns * t.size, patterns * t.size)
        normal[:, range(patterns * t.size), range(patterns * t.size)] += 1.0
        start = np.exp(2j * np.pi * np.outer(centres + t[0], s.f))
        seen = np.conj(scaled)[:, :, None] * (weight * shape * s.y * start)
        right = np.real(seen @ self._waves).swapaxes(2, 3)
        return normal, right.reshape(motions, -1, centres.size)

    def evidence(self, combs: ComplexArray, wheelsets: int, centres: Array) -> Array:
        """ln of the marginal likelihood over that of a disturbance with the same spectrum.

        The response has a Gaussian prior with the spectrum of what is observed.

        Args:
            combs: :meth:`comb` of every motion.
            wheelsets: their number.
            centres: trial values of :attr:`centre`, shape (centres,).

        Returns:
            Shape (motions, centres).
        """
        s = self.spectrum
        normal, right = self._normal(combs, wheelsets, centres)
        factor = np.linalg.cholesky(normal)
        parts = [
            lapack.dtrtrs(low.T, each, lower=0, trans=1)[0]
            for low, each in zip(factor, right, strict=True)
        ]
        explained = np.array([np.sum(part * part, axis=0) for part in parts])
        cost = 2 * np.sum(np.log(np.diagonal(factor, axis1=1, axis2=2)), axis=1)
        own, rest = s.noise + s.excess, self._variance()
        power = np.abs(s.y) ** 2
        gain = s.share * float(np.sum(np.log(own / rest) + power / own - power / rest))
        return np.asarray(gain + 0.5 * explained - 0.5 * cost[:, None])

    def response(self, places: Array, speed: float, acceleration: float) -> ComplexArray:
        """Fourier transform of the most probable response, about the middle of the train."""
        s, t = self.spectrum, self.knots
        combs = self.comb(places, np.array([speed]), np.array([acceleration]))
        normal, right = self._normal(combs, places.size, np.array([self.centre]))
        knots = np.linalg.solve(normal[0], right[0, :, 0])[: t.size]
        series = np.exp(-2j * np.pi * np.outer(s.f, t + self.centre)) @ knots
        return np.asarray(self._shape(places.size, t.size) * series)

    def centroids(
        self, combs: ComplexArray, wheelsets: int, centres: Array, signed: bool
    ) -> tuple[Array, Array]:
        """Centroid of the square of the most probable response, after the epoch, and its width (s).

        Args:
            combs: :meth:`comb` of one motion.
            wheelsets: their number.
            centres: trial values of :attr:`centre`, shape (centres,).
            signed: whether it may be negative, as an energy may not.

        Returns:
            Both of shape (centres,).
        """
        s, t = self.spectrum, self.knots
        normal, right = self._normal(combs, wheelsets, centres)
        knots = np.linalg.solve(normal[0], right[0])[: t.size]
        time = np.linspace(-self.before, self.after, _PLACES)
        waves = np.exp(2j * np.pi * np.outer(time, s.f)) * self._shape(wheelsets, t.size)
        series = np.real(waves @ (np.exp(-2j * np.pi * np.outer(s.f, t)) @ knots))
        energy = series**2 if signed else np.maximum(series, 0) ** 2
        energy /= np.maximum(energy.sum(axis=0), 1e-300)
        centroid = time @ energy
        width = np.sqrt(np.maximum(time**2 @ energy - centroid**2, 0.0))
        return np.asarray(centres + centroid), np.asarray(width)

    def information(
        self, places: Array, speed: float, acceleration: float, loads: Sequence[float]
    ) -> tuple[Array, Array]:
        """Normal matrix and right side of a Gauss-Newton step, the response solved for.

        For the loads of all wheelsets, the speed and the acceleration of the middle; one response
        for all wheelsets.
        """
        s, t, weight = self.spectrum, self.knots, 2 * self.spectrum.share / self._variance()

        def late(v: float, a: float) -> Array:
            root = np.sqrt(np.maximum(v * v + 2 * a * places, 0.01 * v * v))
            return np.asarray(2 * places / (v + root))

        times, small = late(speed, acceleration), 1e-5 * speed
        per_speed = (late(speed + small, acceleration) - times) / small
        per_acceleration = (late(speed, acceleration + 1e-5) - times) / 1e-5
        size = np.array(loads)
        each = np.exp(-2j * np.pi * np.outer(s.f, times + self.centre))
        waves = self._shape(size.size, t.size)[:, None] * np.exp(-2j * np.pi * np.outer(s.f, t))
        own = (each @ size)[:, None] * waves
        weighted = np.conj(own) * weight[:, None]
        normal = np.real(weighted.T @ own) + np.eye(t.size)
        knots = np.linalg.solve(normal, np.real(weighted.T @ s.y))
        each *= (waves @ knots)[:, None]
        late_all = -2j * np.pi * s.f[:, None] * (each * size)
        steps = np.stack([late_all @ per_speed, late_all @ per_acceleration], axis=1)
        columns = np.concatenate([each, steps], axis=1)
        left = s.y - each @ size
        cross = np.real(weighted.T @ columns)
        weighted = np.conj(columns) * weight[:, None]
        gain = np.real(weighted.T @ left)
        return np.real(weighted.T @ columns) - cross.T @ np.linalg.solve(normal, cross), gain

    def shares(
        self, groups: Sequence[Array], places: Array, speed: float, acceleration: float
    ) -> tuple[Array, Array]:
        """Normal matrix and right side for an amplitude per group of wheelsets.

        All groups have the response that is common to the train.
        """
        s, v, a = self.spectrum, np.array([speed]), np.array([acceleration])
        common = self.response(places, speed, acceleration)
        parts = np.concatenate([comb(group, s.f, v, a) for group in groups]) * common
        weighted = np.conj(parts) * (2 * s.share / self._variance())
        return np.real(weighted @ parts.T), np.real(weighted @ s.y)


def strong_extent(record: Record, within: tuple[float, float]) -> tuple[float, float] | None:
    """Times (s) of 5 and 95 % of the energy above the floor, in the band where they are closest.

    What rings on lengthens it, in some bands more than in others. The load itself, slower than 5
    Hz, counts where nothing else shows.
    """
    window = record.window
    found: list[tuple[float, float, float]] = []
    for b in sorted(range(len(window.bands)), key=lambda b: window.bands[b] == SLOW):
        if window.bands[b] == SLOW and found:
            break
        time = window.time - window.shift[b]
        inside = (time > within[0]) & (time < within[1]) & window.valid
        energy = np.maximum(window.energy[inside, b] - record.floor[b], 0)
        total = np.cumsum(energy)
        if not inside.any() or total[-1] <= 0:
            continue
        start, stop = np.interp((0.05, 0.95), total / total[-1], time[inside])
        found.append((float(stop - start), float(start), float(stop)))
    return min(found)[1:] if found else None


def ringing(time: Array, values: Array, since: float) -> tuple[float, ...]:
    """Coefficients of the filter that ends the free vibration of the strongest modes.

    A mode rings on for seconds after a wheelset, far longer than a response can be that shall tell
    wheelsets apart. ``x(k) - 2 rho cos(theta) x(k-1) + rho² x(k-2)`` is zero while it rings freely
    and local while it is driven: what is left of the response is as short as the driving force.
    The poles are those of the free vibration after the train (ESPRIT: Roy & Kailath, IEEE Trans.
    Acoust. Speech Signal Process. 37, 1989, 984-995).

    Args:
        time, values: of the series (s), equal steps.
        since: end of the strong energy (s).
    """
    step = float(time[1] - time[0])
    width = max(1, int(1 / (4 * _RINGING_HZ * step)))
    free = values[time > since + _FADE_S]
    count = min(free.size // width, round(_RUNG_S / (width * step)))
    if count * width * step < 1.0:
        return (1.0,)
    free = free[: count * width].reshape(count, width).mean(axis=1)
    free = free - free.mean()
    lagged = np.lib.stride_tricks.sliding_window_view(free, count // 3)
    space = np.linalg.eigh(lagged.T @ lagged)[1][:, -2 * _MODES :]
    roots = np.linalg.eigvals(np.linalg.lstsq(space[:-1], space[1:], rcond=None)[0])
    poles = np.log(roots[roots.imag > 0]) / (width * step)
    kept = (poles.real < 0) & (-poles.real < _DAMPED * np.abs(poles))
    poles = poles[kept & (poles.imag < 2 * np.pi * _RINGING_HZ)]
    decays = np.exp(np.outer(np.arange(count) * width * step, np.r_[poles, poles.conj()]))
    size = np.abs(np.linalg.lstsq(decays, free.astype(complex), rcond=None)[0]) ** 2
    share = 2 * size * np.sum(np.abs(decays) ** 2, axis=0) / max(float(free @ free), 1e-300)
    taps = np.ones(1)
    for pole in poles[share[: poles.size] > _RINGING]:
        root = np.exp(pole * step)
        taps = np.convolve(taps, [1.0, -2 * root.real, abs(root) ** 2])
    return tuple(float(tap) for tap in taps)


def late_by(taps: Sequence[float], step: float, low: float) -> float:
    """Centroid (s) of the energy of free vibration, ``1 / (2 zeta omega)``, above ``low`` (Hz).

    Args:
        taps: of :func:`ringing`, of samples ``step`` (s) apart.
    """
    poles = np.log(np.roots(taps).astype(complex)) / step
    decays = -poles.real[np.abs(poles.imag) >= 2 * np.pi * low]
    return float(np.max(0.5 / decays)) if decays.size else 0.0


def observations(
    record: Record, within: tuple[float, float], extent: tuple[float, float]
) -> list[Observation]:
    """The low-passed waveform and the energy of every band, in this order."""
    window = record.window
    step = window.step
    series = [("waveform", window.time - window.low_shift, window.low, _TOP_HZ, 0.0)]
    modes: tuple[float, ...] = (1.0,)
    for b, band in enumerate(window.bands):
        name = f"energy {band[0]:g}-{band[1]:g} Hz"
        energy = window.time - window.shift[b], window.energy[:, b]
        series.append((name, *energy, 0.3 * band[1], band[0]))
    epoch = 0.5 * (extent[0] + extent[1])
    out = []
    for name, time, raw, limit, low in series:
        values = raw
        if not window.valid.all() and window.valid.any():
            values = np.interp(time, time[window.valid], raw[window.valid])
        near = (time > extent[0] - _MARGIN_S) & (time < extent[1] + _MARGIN_S)
        quiet = values[window.time < within[0]]
        taps = ringing(time, values, extent[1]) if name == "waveform" else (1.0,)
        modes = taps if name == "waveform" else modes
        time = time - epoch
        part = values[near]
        ends = max(4, round(0.1 / step))
        if part.size < 8 * ends:
            continue
        first, last = np.median(part[:ends]), np.median(part[-ends:])
        part = np.convolve(part - np.linspace(first, last, part.size), taps)[: part.size]
        fade = min(round(_FADE_S / step), part.size // 8)
        ramp = 0.5 - 0.5 * np.cos(np.pi * (np.arange(fade) + 0.5) / fade)
        part[:fade] *= ramp
        part[-fade:] *= ramp[::-1]
        grid = time[near][0] + step * np.arange(part.size)
        quiet = quiet - quiet.mean() if quiet.size else quiet
        duration = extent[1] - extent[0]
        top = min(limit, 0.4 / step)
        rings = late_by(modes, step, low) if name != "waveform" else 0.0
        out.append(Observation(name, epoch, grid, part, quiet, duration, top, taps, rings))
    return out
