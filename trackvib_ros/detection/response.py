"""Trains from slab, support layer or bridge alone: one common response to every wheelset.

Where single wheelsets cannot be seen, a channel still answers every wheelset in the same way, only
later: ``y(t) = sum_i r(t - t_i) + noise``, with the wheelset times ``t_i`` of a type at a speed and
an acceleration, and an unknown response ``r`` of limited length. For a trial motion ``r`` follows
by least squares; the marginal likelihood tells how well the channel repeats itself at the
wheelsets, and an ``r`` flexible enough for any motion pays for it there (its logarithmic
determinant). All is done on Fourier coefficients, whose normal equations are Toeplitz matrices.

Two things are observed in every channel: the low-passed waveform (load, bridge modes), and the
energy of a band, to which every wheelset adds its own (no coherence is needed, as at low speed,
where roughness outweighs the moving load). All observations share the motion and each has its own
``r``: influence lines at two places are not shifted copies of each other.

What is slower than the passing train is left out: a hump in time is not the pattern of a train.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from .catalogue import TrainType
from .events import Channel
from .evidence import PRIOR_UNKNOWN
from .features import SLOW
from .kinematics import PRIOR_ACCELERATION, Motion
from .record import Record
from .unlisted import ALTERNATIVES, CAR, CHOICES, EqualCars, starts

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

CONFIRM_EVIDENCE = 30.0
"""Least ln of the evidence for a train over a disturbance of the same spectrum and duration."""

CERTAIN_EVIDENCE = 100.0
"""Evidence that needs no more support: 57 disturbances of a minute each on a slab channel had up to
69, with all shipped types to choose from."""

CORRELATED = 2.5
"""Misfit is not white: its neighbouring coefficients go together, so that this many count as one.
Mean square of error over sigma of the speed on computed passages when counted as independent."""

_SYSTEMATIC = 0.05
"""Share of the evidence by which models of like trains differ because none is exact, in units of
one e-fold of belief: of 27 computed passages of a metro two had the nearest other metro, and five a
train of somewhat other proportions, more than a fifth better than itself."""

_MARGIN_S = 1.5  # on either side of the strong energy
_FADE_S = 0.3
_SLOWEST = 4.0  # periods in the strong interval: what is slower is its envelope
_SMOOTH_HZ = 2.0
_MISFITS = (
    0.5,
    0.25,
    0.12,
    0.06,
    0.03,
    0.015,
)  # parts of the spectrum that no response explains
_USUAL_MISFIT = 0.25
_REACHES, _RINGS = (40.0, 20.0, 10.0), (1.0, 0.5, 0.2)  # m before and after a wheelset; s
_COARSE, _MIDDLE, _FINE = 8.0, 4.0, 2.0  # m, shortest waves that are compared
_TOP_HZ = 80.0  # the waveform is low-passed at 100 Hz
_PASSED = 0.95  # of the time between first and last wheelset lies between 5 and 95 % of the energy
_PASSED_SPREAD = 0.15
_RANGE = (-0.35, 0.40)  # ln of speed about that of the passing time
_DECELERATION = 0.4  # of the speed, largest change over a passage
_LARGEST = 1.0  # m/s²
_NEIGHBOUR = 0.3  # cycles at the ends of a train between trial motions
_PLACED = 0.45
_PART = 6  # wheelsets, at least, whose amplitude is measured by itself
_SHRUNK, _WEAKEST, _HEAVIEST = 1.5, 0.65, 2.5
_SHORTEST_S = 0.3
_KEPT = 15.0  # evidence below the best at which a hypothesis is dropped
_BLUR = 0.4  # of the evidence, what a coarse grid and an unknown misfit may cost
_CLEAR = 20.0  # evidence of a motion without acceleration
_MOST = 10  # hypotheses that are followed
_PEAKS = 5  # of a type and orientation
_CARS = (30.0, 13.5)  # m, longest and shortest cars, at the lowest and the highest speed
_HALF = 0.12  # ln of speed, half the range of a train of equal cars: half of one car of four


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
    """

    name: str
    epoch: float
    time: Array
    values: Array
    quiet: Array
    duration: float
    limit: float


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
        self.share = n / size  # of the coefficients that are independent
        quiet = seen.quiet
        self.noise = np.zeros(self.f.size)
        if quiet.size > 64:
            own = np.abs(fft.rfft(quiet)) ** 2 * (n / quiet.size)
            own = smoothed(own, max(3, round(_SMOOTH_HZ * quiet.size * step)))
            self.noise = np.interp(self.f, fft.rfftfreq(quiet.size, step), own)
        self.excess = np.zeros(self.f.size)
        if self.usable:
            power = np.abs(self.y) ** 2
            power = smoothed(power, min(round(_SMOOTH_HZ * size * step), self.f.size // 3))
            self.excess = np.maximum(power - self.noise, 1e-3 * power + 1e-12 * power.max())

    @property
    def usable(self) -> bool:
        """Whether there is something to compare."""
        return self.f.size >= 8 and bool(np.any(self.y))


def comb(places: Array, f: Array, speed: Array, acceleration: Array) -> ComplexArray:
    """Fourier transform of the wheelset times about that of the middle of the train.

    Args:
        places: of the wheelsets behind the middle (m).
        f: frequencies (Hz), equal steps.
        speed, acceleration: as the middle passes (m/s, m/s²), shape (motions,).

    Returns:
        Shape (motions, frequencies).
    """
    v, a = speed[:, None], acceleration[:, None]
    root = np.sqrt(np.maximum(v * v + 2 * a * places, 0.01 * v * v))
    times = 2 * places / (v + root)
    if not f.size:
        return np.zeros((speed.size, 0), dtype=np.complex128)
    # frequency i + block j is a product of two phases: far fewer exponentials, and a matrix product
    block = max(1, round(float(np.sqrt(f.size))))
    blocks = -(-f.size // block)
    step = (f[-1] - f[0]) / max(f.size - 1, 1)
    inner = np.exp(-2j * np.pi * times[:, None, :] * (step * np.arange(block))[:, None])
    outer = np.exp(
        -2j * np.pi * times[:, None, :] * (f[0] + step * block * np.arange(blocks))[:, None]
    )
    return np.asarray((outer @ inner.swapaxes(1, 2)).reshape(speed.size, -1)[:, : f.size])


@dataclass(frozen=True)
class Model:
    """A spectrum with the support of its response and the part that this cannot explain.

    Attributes:
        before, after: support of the response about the passing of its wheelset (s).
        centre: of that passing for the middle of the train, after the epoch (s).
    """

    spectrum: Spectrum
    before: float
    after: float
    misfit: float = _USUAL_MISFIT
    centre: float = 0.0

    @property
    def knots(self) -> Array:
        """Times at which the response is free (s)."""
        step = 1 / (2.3 * self.spectrum.f[-1])
        return np.arange(-self.before, self.after + step, step)

    def _variance(self) -> Array:
        return self.spectrum.noise + self.misfit * self.spectrum.excess

    def _shape(self, wheelsets: int, knots: int) -> Array:
        return np.sqrt(self.spectrum.excess / (wheelsets * knots))

    def _normal(self, combs: ComplexArray, wheelsets: int, centres: Array) -> tuple[Array, Array]:
        s, t = self.spectrum, self.knots
        shape = self._shape(wheelsets, t.size)
        weight = 2 * s.share / self._variance()
        lags = np.cos(2 * np.pi * np.outer(s.f, t - t[0]))
        column = (np.abs(combs) ** 2 * (weight * shape**2)) @ lags
        knots = np.exp(2j * np.pi * np.outer(s.f, t))
        phase = knots[:, :, None] * np.exp(2j * np.pi * np.outer(s.f, centres))[:, None, :]
        right = np.real((np.conj(combs) * (weight * shape * s.y)) @ phase.reshape(s.f.size, -1))
        order = np.abs(np.subtract.outer(np.arange(t.size), np.arange(t.size)))
        return column[:, order] + np.eye(t.size), right.reshape(len(combs), t.size, centres.size)

    def evidence(self, combs: ComplexArray, wheelsets: int, centres: Array) -> Array:
        """ln of the marginal likelihood over that of a disturbance with the same spectrum.

        The response has a Gaussian prior with the spectrum of what is observed.

        Args:
            combs: :func:`comb` of every motion, shape (motions, frequencies).
            wheelsets: their number.
            centres: trial values of :attr:`centre`, shape (centres,).

        Returns:
            Shape (motions, centres).
        """
        s = self.spectrum
        normal, right = self._normal(combs, wheelsets, centres)
        factor = np.linalg.cholesky(normal)
        part = np.linalg.solve(factor, right)
        explained = np.sum(part * part, axis=1)
        cost = 2 * np.sum(np.log(np.diagonal(factor, axis1=1, axis2=2)), axis=1)
        own, rest = s.noise + s.excess, self._variance()
        power = np.abs(s.y) ** 2
        gain = s.share * float(np.sum(np.log(own / rest) + power / own - power / rest))
        return np.asarray(gain + 0.5 * explained - 0.5 * cost[:, None])

    def response(self, places: Array, speed: float, acceleration: float) -> ComplexArray:
        """Fourier transform of the most probable response, about the middle of the train."""
        s, t = self.spectrum, self.knots
        combs = comb(places, s.f, np.array([speed]), np.array([acceleration]))
        normal, right = self._normal(combs, places.size, np.array([self.centre]))
        knots = np.linalg.solve(normal[0], right[0, :, 0])
        series = np.exp(-2j * np.pi * np.outer(s.f, t + self.centre)) @ knots
        return np.asarray(self._shape(places.size, t.size) * series)

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


@dataclass(frozen=True)
class ResponseFit:
    """One type in one orientation, fitted to all observations.

    Attributes:
        models: one per observation.
        motion: its distance is that of the first wheelset past the reference channel.
        evidence: ln of the marginal likelihood over that of a disturbance.
    """

    train: TrainType
    reverse: bool
    speed: float
    acceleration: float
    evidence: float
    models: tuple[Model, ...] = ()
    covariance: Array | None = None

    @property
    def places(self) -> Array:
        """Distance of every wheelset behind the middle of the train (m)."""
        return self.train.oriented(self.reverse) - 0.5 * self.train.span

    @property
    def amplitudes(self) -> Array:
        """How strongly the parts of the train answer, 1 for the common response, front first."""
        places = self.places
        parts = int(np.clip(places.size // _PART, 3, 8))
        groups = np.array_split(places, parts)
        normal, right = np.zeros((parts, parts)), np.zeros(parts)
        for model in self.models:
            own, wanted = model.shares(groups, places, self.speed, self.acceleration)
            normal, right = normal + own, right + wanted
        normal[np.diag_indices(parts)] += 1e-9 * np.trace(normal)
        return np.asarray(np.linalg.solve(normal, right), dtype=np.float64)

    @property
    def alike(self) -> bool:
        """Whether all parts of the train answer alike, but for a heavier vehicle.

        A few blows that happen to lie like some wheelsets do not.
        """
        size = self.amplitudes
        usual = float(np.median(size))
        return bool(
            usual < _SHRUNK and size.min() > _WEAKEST * usual and size.max() < _HEAVIEST * usual
        )


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


def observations(
    record: Record, within: tuple[float, float], extent: tuple[float, float]
) -> list[Observation]:
    """The low-passed waveform and the energy of every band, in this order."""
    window = record.window
    step = window.step
    series = [("waveform", window.time - window.low_shift, window.low, _TOP_HZ)]
    for b, band in enumerate(window.bands):
        name = f"energy {band[0]:g}-{band[1]:g} Hz"
        series.append((name, window.time - window.shift[b], window.energy[:, b], 0.3 * band[1]))
    epoch = 0.5 * (extent[0] + extent[1])
    out = []
    for name, time, raw, limit in series:
        values = raw
        if not window.valid.all() and window.valid.any():
            values = np.interp(time, time[window.valid], raw[window.valid])
        near = (time > extent[0] - _MARGIN_S) & (time < extent[1] + _MARGIN_S)
        values, time = values.copy(), time - epoch
        quiet = values[window.time < within[0]]
        part = values[near]
        ends = max(4, round(0.1 / step))
        if part.size < 8 * ends:
            continue
        first, last = np.median(part[:ends]), np.median(part[-ends:])
        part = part - np.linspace(first, last, part.size)
        fade = min(round(_FADE_S / step), part.size // 8)
        ramp = 0.5 - 0.5 * np.cos(np.pi * (np.arange(fade) + 0.5) / fade)
        part[:fade] *= ramp
        part[-fade:] *= ramp[::-1]
        grid = time[near][0] + step * np.arange(part.size)
        quiet = quiet - quiet.mean() if quiet.size else quiet
        duration = extent[1] - extent[0]
        out.append(Observation(name, epoch, grid, part, quiet, duration, min(limit, 0.4 / step)))
    return out


class _Search:
    """Trial motions against some observations of one passage."""

    def __init__(self, seen: Sequence[Observation], limits: tuple[float, float]) -> None:
        self.seen = list(seen)
        self.limits = limits
        self.epoch = self.seen[0].epoch
        self.duration = min(s.duration for s in self.seen)

    def models(self, speed: float, wave: float, reach: float, ring: float) -> list[Model]:
        """Models for waves from ``wave`` (m) at about a speed, with one support."""
        room = 2 * reach / speed + ring
        return [
            Model(Spectrum(s, room, speed / wave), reach / speed, reach / speed + ring)
            for s in self.seen
        ]

    def combs(self, k: int, model: Model, places: Array, v: Array, a: Array) -> ComplexArray:
        """Of trial motions, stated at the common epoch, for observation ``k``."""
        return comb(places, model.spectrum.f, v + a * (self.seen[k].epoch - self.epoch), a)

    def coarse(
        self,
        train: TrainType,
        reverse: bool,
        bent: bool = True,
        spread: tuple[float, float] = _RANGE,
    ) -> list[ResponseFit]:
        """The best motions of a type on waves from :data:`_COARSE`."""
        expected = _PASSED * train.span / self.duration
        speeds = expected * np.exp(np.arange(*spread, _NEIGHBOUR * _COARSE / train.span))
        speeds = speeds[(speeds >= self.limits[0]) & (speeds <= self.limits[1])]
        if not speeds.size:
            return []
        bend = 4 * _COARSE / self.duration**2
        most = min(_LARGEST, _DECELERATION * expected / self.duration) if bent else 0.0
        bends = np.clip(
            np.arange(-np.ceil(most / bend), np.ceil(most / bend) + 1) * bend, -most, most
        )
        places = train.oriented(reverse) - 0.5 * train.span
        models = self.models(expected, _COARSE, _REACHES[0], _RINGS[0])
        if not all(model.spectrum.usable for model in models):
            return []
        spacing = max(0.5 * _REACHES[0] / expected, 0.02)
        far = np.ceil(0.15 * self.duration / spacing)
        centres = np.arange(-far, far + 1) * spacing
        prior = -0.5 * (np.log(speeds / expected) / _PASSED_SPREAD) ** 2
        found = []
        for a in bends:
            each = [
                m.evidence(
                    self.combs(k, m, places, speeds, np.full(speeds.size, a)), places.size, centres
                )
                for k, m in enumerate(models)
            ]
            total = prior - 0.5 * (a / PRIOR_ACCELERATION) ** 2
            total = total + sum(e.max(axis=1) for e in each)
            before, after = np.r_[-np.inf, total[:-1]], np.r_[total[1:], -np.inf]
            for i in np.flatnonzero((total >= before) & (total >= after)):
                placed = tuple(
                    replace(m, centre=float(centres[np.argmax(e[i])]))
                    for m, e in zip(models, each, strict=True)
                )
                v, score = float(speeds[i]), float(total[i])
                found.append(ResponseFit(train, reverse, v, float(a), score, placed))
        found.sort(key=lambda fit: -fit.evidence)
        apart: list[ResponseFit] = []
        for fit in found:
            near = 2 * _NEIGHBOUR * _COARSE / train.span
            if all(abs(fit.speed / other.speed - 1) > near for other in apart):
                apart.append(fit)
        return apart[:_PEAKS]

    def scan(self, oriented: Sequence[tuple[TrainType, bool]]) -> list[ResponseFit]:
        """:meth:`coarse` of all types; accelerations only of the likely ones, if any is."""
        fits = [fit for t, r in oriented for fit in self.coarse(t, r, bent=False)]
        top = max((fit.evidence for fit in fits), default=0.0)
        near = {
            (fit.train.name, fit.reverse)
            for fit in fits
            if top < _CLEAR or fit.evidence > (1 - _BLUR) * top - _KEPT
        }
        return [f for t, r in oriented if (t.name, r) in near for f in self.coarse(t, r)]

    def total(self, fit: ResponseFit, v: Array, a: Array) -> Array:
        """Evidence and prior of motions near a fit, shape (motions,)."""
        places = fit.places
        expected = _PASSED * fit.train.span / self.duration
        out = -0.5 * (a / PRIOR_ACCELERATION) ** 2
        out = out - 0.5 * (np.log(v / expected) / _PASSED_SPREAD) ** 2
        for k, m in enumerate(fit.models):
            combs = self.combs(k, m, places, v, a)
            out = out + m.evidence(combs, places.size, np.array([m.centre]))[:, 0]
        return out

    def climb(self, fit: ResponseFit, wave: float, steps: int) -> ResponseFit:
        """Newton steps to the top of a quadratic through nine motions about the last one."""
        dv = 0.12 * wave / fit.train.span
        grid = np.array([(i, j) for i in (-1.0, 0.0, 1.0) for j in (-1.0, 0.0, 1.0)])
        x, y = grid.T
        design = np.stack([np.ones(9), x, y, 0.5 * x * x, x * y, 0.5 * y * y], axis=1)
        v, a = fit.speed, fit.acceleration
        value, covariance = fit.evidence, None
        for _ in range(steps):
            scale = np.array([dv * v, min(wave * (v / fit.train.span) ** 2, 0.3)])
            values = self.total(fit, v + scale[0] * x, a + scale[1] * y)
            c = np.linalg.lstsq(design, values, rcond=None)[0]
            bend = -np.array([[c[3], c[4]], [c[4], c[5]]])
            if np.linalg.eigvalsh(bend)[0] > 0:
                move = np.linalg.solve(bend, c[1:3])
                move *= min(1.0, 1.5 / max(float(np.abs(move).max()), 1e-12))
                covariance = np.linalg.inv(bend) * np.outer(scale, scale)
            else:
                move, covariance = grid[int(np.argmax(values))], None
            v, a = v + scale[0] * move[0], a + scale[1] * move[1]
            value = float(c[0] + c[1:3] @ move - 0.5 * move @ bend @ move)
        v, a = float(v), float(a)
        return replace(fit, speed=v, acceleration=a, evidence=value, covariance=covariance)

    def adapted(self, fit: ResponseFit, wave: float, reference: float) -> ResponseFit:
        """The fit with models for finer waves, of the support and misfit with most evidence."""
        models = []
        for k, old in enumerate(fit.models):
            seen, reach = self.seen[k], old.before * reference
            best: tuple[float, Model] | None = None
            first = wave == _MIDDLE
            for r in _REACHES if first else (reach,):
                for ring in _RINGS if first else (old.after - old.before,):
                    spectrum = Spectrum(seen, 2 * r / reference + ring, reference / wave)
                    if not spectrum.usable:
                        continue
                    model = Model(spectrum, r / reference, r / reference + ring, old.misfit)
                    free = max(reach - r, 0.0) / reference
                    centres = old.centre + np.linspace(-free, free, 5 if free else 1)
                    combs = self._own(k, model, fit)
                    values = model.evidence(combs, fit.places.size, centres)[0]
                    i = int(np.argmax(values))
                    if best is None or values[i] > best[0]:
                        best = float(values[i]), replace(model, centre=float(centres[i]))
            # too few coefficients on finer waves: the coarser ones stay
            models.append(old if best is None else best[1])
        return self.weighted(replace(fit, models=tuple(models)))

    def beside(self, fit: ResponseFit, wave: float) -> ResponseFit:
        """The fit at the best of its neighbouring maxima, its variance that of all of them."""
        v: Array = fit.speed * (1 + 0.12 * wave / fit.train.span * np.arange(-8.0, 9.0))
        values = self.total(fit, v, np.full(v.size, fit.acceleration))
        weight = np.exp((values - values.max()) / CORRELATED)
        mean = float(weight @ v / weight.sum())
        variance = float(weight @ (v - mean) ** 2 / weight.sum()) / CORRELATED
        covariance = fit.covariance
        if covariance is not None:
            covariance = covariance + np.diag([max(variance - covariance[0, 0], 0.0), 0.0])
        best = int(np.argmax(values))
        return replace(
            fit, speed=float(v[best]), evidence=float(values[best]), covariance=covariance
        )

    def weighted(self, fit: ResponseFit) -> ResponseFit:
        """The fit with the misfits of most evidence."""
        models = []
        for k, model in enumerate(fit.models):
            combs, centre = self._own(k, model, fit), np.array([model.centre])
            trials = [replace(model, misfit=misfit) for misfit in _MISFITS]
            values = [m.evidence(combs, fit.places.size, centre)[0, 0] for m in trials]
            models.append(trials[int(np.argmax(values))])
        return replace(fit, models=tuple(models))

    def shared(self, fits: Sequence[ResponseFit]) -> list[ResponseFit]:
        """Every fit with the models of whichever fit suit it best, most probable first.

        What one of two like trains has found of a response, the other one must be allowed, too:
        types must not be told apart by how well a search went.
        """
        out = []
        for fit in fits:
            models = []
            for k, own in enumerate(fit.models):
                trials = {(m.before, m.after, m.misfit): m for m in (f.models[k] for f in fits)}
                starts = [own.centre, *(m.centre for m in trials.values())]
                centres = np.unique(np.round(starts, 4))
                best = -np.inf, own
                for trial in trials.values():
                    values = trial.evidence(self._own(k, trial, fit), fit.places.size, centres)[0]
                    i = int(np.argmax(values))
                    if values[i] > best[0]:
                        best = float(values[i]), replace(trial, centre=float(centres[i]))
                models.append(best[1])
            moved = self.climb(replace(fit, models=tuple(models)), _FINE, 2)
            told = self.beside(moved, _FINE)
            out.append(
                moved if told.covariance is None else replace(moved, covariance=told.covariance)
            )
        return sorted(out, key=lambda fit: -fit.evidence)

    def transferred(
        self, oriented: Sequence[tuple[TrainType, bool]], fits: Sequence[ResponseFit]
    ) -> list[ResponseFit]:
        """Every type in the passing time, and with the models, of the fit that suits it best."""
        found = []
        for train, reverse in oriented:
            best: ResponseFit | None = None
            for fit in fits:
                ratio = train.span / fit.train.span
                near = 1 + 0.12 * _FINE / train.span * np.arange(-4.0, 5.0, 2.0)
                v, a = ratio * fit.speed * near, np.full(near.size, ratio * fit.acceleration)
                if not self.limits[0] <= ratio * fit.speed <= self.limits[1]:
                    continue
                trial = replace(fit, train=train, reverse=reverse)
                values = self.total(trial, v, a)
                i = int(np.argmax(values))
                if best is None or values[i] > best.evidence:
                    v_best, a_best, value = float(v[i]), float(a[i]), float(values[i])
                    best = replace(trial, speed=v_best, acceleration=a_best, evidence=value)
            if best is not None:
                found.append(best)
        found.sort(key=lambda fit: -fit.evidence)
        return found[:_PEAKS]

    def unlisted(self) -> ResponseFit | None:
        """The train of equal cars that explains most; its speed is that of cars of 20 m."""
        sizes = [limit * CAR[0] / length for limit, length in zip(self.limits, _CARS, strict=True)]
        search = _Search(self.seen, (sizes[0], sizes[1]))
        found = []
        for cars in starts():
            near = search.coarse(cars.train, False, bent=False, spread=(-_HALF, _HALF))
            found += [(fit, cars) for fit in near[:1]]
        if not found:
            return None
        fit, cars = max(found, key=lambda pair: pair[0].evidence)
        fit = search.refined(search.coarse(cars.train, False, spread=(-_HALF, _HALF))[:2] or [fit])[
            0
        ]
        for trials in (EqualCars.numbers, EqualCars.proportions, EqualCars.numbers):
            v = fit.speed * (1 + 0.06 * _FINE / fit.train.span * np.arange(-2.0, 3.0, 2.0))
            a = np.full(v.size, fit.acceleration)
            values = []
            for trial in trials(cars):
                values.append(float(search.total(replace(fit, train=trial.train), v, a).max()))
            cars = trials(cars)[int(np.argmax(values))]
            fit = replace(fit, train=cars.train)
        return search.climb(search.weighted(search.climb(fit, _FINE, 2)), _FINE, 2)

    def _own(self, k: int, model: Model, fit: ResponseFit) -> ComplexArray:
        v, a = np.array([fit.speed]), np.array([fit.acceleration])
        return self.combs(k, model, fit.places, v, a)

    def refined(self, fits: Sequence[ResponseFit]) -> list[ResponseFit]:
        """The likely ones of coarse fits on finer and finer waves, most probable first."""
        for wave in (_MIDDLE, _FINE):
            best = max(fits, key=lambda fit: fit.evidence)
            kept = _KEPT + (_BLUR * abs(best.evidence) if wave == _MIDDLE else 0.0)
            near = [fit for fit in fits if fit.evidence > best.evidence - kept]
            leaders = {id(fit): fit for fit in sorted(near, key=lambda fit: fit.evidence)}
            first = {fit.train.name: id(fit) for fit in leaders.values()}
            near.sort(key=lambda fit: (first[fit.train.name] != id(fit), -fit.evidence))
            fits = []
            for fit in near[:_MOST]:
                moved = self.beside(self.adapted(fit, wave, best.speed), wave)
                moved = self.climb(self.weighted(self.climb(moved, wave, 2)), wave, 2)
                told = self.beside(moved, wave)
                fits.append(
                    moved if told.covariance is None else replace(moved, covariance=told.covariance)
                )
        return sorted(fits, key=lambda fit: -fit.evidence)


def _distinct(fits: Sequence[ResponseFit]) -> list[ResponseFit]:
    """Fits without those that a better one of the same type repeats."""
    kept: list[ResponseFit] = []
    for fit in fits:
        alike = [f for f in kept if f.train is fit.train and f.reverse == fit.reverse]
        near = 2 * _NEIGHBOUR * _COARSE / fit.train.span
        if all(abs(f.speed / fit.speed - 1) > near for f in alike):
            kept.append(fit)
    return kept


def tempered(evidence: float) -> float:
    """Difference of evidence that stands for a factor e between two trains."""
    return CORRELATED + _SYSTEMATIC * max(evidence, 0.0)


def _orientations(trains: Sequence[TrainType]) -> list[tuple[TrainType, bool]]:
    return [(t, r) for t in trains for r in ((False,) if t.symmetric else (False, True))]


@dataclass(frozen=True)
class ResponsePassage:
    """A train by its response: what can be told without seeing its wheelsets.

    Attributes:
        fits: types with their motions, most probable first.
        probabilities: of the fits.
        channels: names of the channels used, reference first.
        middle: time at which the middle of the train passes the reference (s), sigma.
        direction: +1, -1, or 0 if unknown.
        duration: between 5 and 95 % of the energy (s).
        spectral: speed by the bogie-passing spectrum (m/s), sigma; or None.
        unlisted: the train of equal cars that explains most, at the speed of cars of 20 m.
    """

    fits: tuple[ResponseFit, ...]
    probabilities: tuple[float, ...]
    channels: tuple[Channel, ...]
    middle: tuple[float, float]
    direction: int
    duration: float
    spectral: tuple[float, float] | None
    unlisted: ResponseFit | None = None

    @property
    def unknown(self) -> float:
        """Probability that the train is not in the catalogue.

        By what the best train of equal cars explains more than the best type, less what the choice
        of its proportions costs.
        """
        if self.unlisted is None or not self.fits:
            return 0.0 if self.fits else 1.0
        listed = self.fits[0].evidence
        gain = (self.unlisted.evidence - listed) / tempered(listed)
        odds = PRIOR_UNKNOWN / (1 - PRIOR_UNKNOWN) / ALTERNATIVES * np.exp(min(gain, 50.0))
        return float(odds / (1 + odds))

    @property
    def known(self) -> bool:
        """Whether a type of the catalogue explains the train as well as any other would."""
        return self.unknown < 0.5

    @property
    def best(self) -> ResponseFit:
        """The most probable fit; of the train of equal cars if the type is not known."""
        return self.fits[0] if self.known or self.unlisted is None else self.unlisted

    @property
    def confirmed(self) -> bool:
        """Whether this is a train.

        Blows, rain or a hum can have some evidence too, but no common response explains three
        quarters of their waveform or of their energy, unless the evidence is overwhelming.
        """
        best = self.best
        evidence = best.evidence - (0.0 if self.known else CORRELATED * float(np.log(CHOICES)))
        explained = min(model.misfit for model in best.models) <= _USUAL_MISFIT
        explained |= evidence > CERTAIN_EVIDENCE
        clear = evidence > CONFIRM_EVIDENCE and best.covariance is not None
        return clear and explained and best.alike

    @property
    def motion(self) -> Motion:
        """Of the first wheelset past the reference, with what correlated misfit adds."""
        best = self.best
        covariance = np.zeros((3, 3))
        if best.covariance is not None:
            covariance[1:, 1:] = CORRELATED * best.covariance
        covariance[0, 0] = (self.middle[1] * best.speed) ** 2
        if not self.known:
            covariance[1, 1] += (CAR[1] * best.speed) ** 2
        half = 0.5 * best.train.span
        return Motion(self.middle[0], half, best.speed, best.acceleration, covariance)

    @property
    def relative(self) -> float:
        """Relative sigma of the time that the train takes, whatever its size."""
        best = self.best
        own = CORRELATED * best.covariance[0, 0] if best.covariance is not None else 0.0
        variance = float(own) / best.speed**2
        if self.known:
            rate = best.speed / best.train.span
            pairs = zip(self.probabilities, self.fits, strict=True)
            variance += sum(p * (f.speed / f.train.span / rate - 1) ** 2 for p, f in pairs)
        return float(np.sqrt(variance))

    @property
    def by_duration(self) -> tuple[float, float]:
        """Speed by passing time and length (m/s), sigma."""
        speed = _PASSED * self.best.train.span / self.duration
        return speed, _PASSED_SPREAD * speed

    @property
    def speeds(self) -> list[tuple[float, float, float]]:
        """(probability, speed, sigma) of every fit, and of an unlisted train (m/s)."""
        listed = 1 - self.unknown
        parts = [
            (listed * p, fit.speed, float(np.sqrt(CORRELATED * fit.covariance[0, 0])))
            for p, fit in zip(self.probabilities, self.fits, strict=True)
            if fit.covariance is not None
        ]
        if self.unlisted is not None:
            parts.append((self.unknown, self.unlisted.speed, CAR[1] * self.unlisted.speed))
        return parts


def _placed(fit: ResponseFit, k: int) -> tuple[float, float]:
    """When the middle of the train passes a channel (s), sigma: where its response is strongest.

    A response begins before its wheelset and rings after it; computed passages have its centroid
    within 0.45 of its own width of the wheelset (rms).
    """
    model = fit.models[k]
    time = np.linspace(-model.before, model.after, 400)
    series = model.response(fit.places, fit.speed, fit.acceleration)
    at = np.exp(2j * np.pi * np.outer(time + model.centre, model.spectrum.f))
    weight = np.maximum(np.real(at @ series), 0) ** 2
    weight /= max(float(weight.sum()), 1e-300)
    centroid = float(weight @ time)
    width = float(np.sqrt(weight @ (time - centroid) ** 2))
    return model.spectrum.epoch + model.centre + centroid, _PLACED * width


def _spectral(fit: ResponseFit, k: int) -> tuple[float, float] | None:
    """Speed (m/s, sigma) by the lines of the spectrum alone (multiples of v over the car length).

    Maximum likelihood of exponentially distributed power about noise and lines (Whittle); ``None``
    where another speed, as one half, explains the lines better.
    """
    model = fit.models[k]
    s = model.spectrum
    low = s.f <= fit.speed / _COARSE
    if not low.any():
        return None
    v = fit.speed * np.exp(np.arange(-0.8, 0.8, 0.1 * _COARSE / fit.train.span))
    power = np.abs(s.y[low]) ** 2
    bend = np.full(v.size, fit.acceleration)
    lines = np.abs(comb(fit.places, s.f[low], v, bend)) ** 2 / fit.places.size
    mean = s.noise[low] + s.excess[low] * (model.misfit + lines) / (1 + model.misfit)
    score = -s.share * np.sum(np.log(mean) + power / mean, axis=1)
    i = int(np.argmax(score))
    if not 0 < i < v.size - 1:
        return None
    bend_here = 2 * score[i] - score[i - 1] - score[i + 1]
    step = float(v[i + 1] - v[i])
    shift = 0.5 * (score[i + 1] - score[i - 1]) / bend_here
    sigma = step * float(np.sqrt(CORRELATED / bend_here))
    found = float(v[i]) + shift * step
    return (found, sigma) if abs(found - fit.speed) < 4 * sigma + 0.01 * found else None


def find_response(
    records: Sequence[Record],
    within: tuple[float, float],
    trains: Sequence[TrainType],
    limits: tuple[float, float],
) -> ResponsePassage | None:
    """The train that explains the channels best; ``None`` without anything to explain.

    Args:
        records: channels of any layer; the first is the reference.
        within: the event (s).
        trains: candidate types.
        limits: lowest and highest speed (m/s).
    """
    seen: list[Observation] = []
    used: list[tuple[Channel, int]] = []
    oriented = _orientations(trains)
    for record in records:
        extent = strong_extent(record, within)
        if extent is None or extent[1] - extent[0] < _SHORTEST_S:
            continue
        series = observations(record, within, extent)
        if len(series) < 2:
            continue
        best, top = series[1], -np.inf
        for energy in series[1:]:
            alone = _Search([energy], limits)
            for train, reverse in oriented:
                for fit in alone.coarse(train, reverse, bent=False):
                    if fit.evidence > top:
                        best, top = energy, fit.evidence
        seen += [series[0], best]
        used.append((record.channel, len(seen) - 1))
    if not seen:
        return None
    search = _Search(seen, limits)
    coarse = search.scan(oriented)
    listed = search.refined(coarse) if any(fit.evidence > 0 for fit in coarse) else []
    other = search.unlisted()
    leaders = [*listed[:2], *([other] if other else [])]
    listed += search.transferred(oriented, leaders)
    together = search.shared([*listed, *([other] if other else [])])
    fits = [fit for fit in together if fit.train in trains]
    other = next((fit for fit in together if fit.train not in trains), None)
    if not together or together[0].evidence < 0:
        return None
    top = fits[0].evidence if fits else 0.0
    unit = tempered(top)
    likely = [fit for fit in _distinct(fits) if fit.evidence > top - _KEPT * unit / CORRELATED]
    weight = np.exp([(fit.evidence - top) / unit for fit in likely])
    channels = tuple(channel for channel, _ in used)
    told = ResponsePassage(
        tuple(likely),
        tuple(float(w) for w in weight / weight.sum()),
        channels,
        (0.0, 0.0),
        0,
        search.duration,
        None,
        other,
    )
    placed = [_placed(told.best, k) for _, k in used]
    return replace(
        told,
        middle=placed[0],
        direction=_direction(channels, placed, told.best.speed) if told.known else 0,
        spectral=_spectral(told.best, used[0][1]) if told.known else None,
    )


def _direction(
    channels: Sequence[Channel], placed: Sequence[tuple[float, float]], speed: float
) -> int:
    """+1 or -1 by the two outer slab channels if their delay is clear and agrees with the speed.

    Not by bridge channels: a span answers where it is soft, not where its sensor is.
    """
    slabs = [k for k, channel in enumerate(channels) if channel.layer != "bridge"]
    if len(slabs) < 2:
        return 0
    a = min(slabs, key=lambda k: channels[k].x)
    b = max(slabs, key=lambda k: channels[k].x)
    delay = placed[b][0] - placed[a][0]
    sigma = float(np.hypot(placed[a][1], placed[b][1]))
    expected = (channels[b].x - channels[a].x) / speed
    if abs(delay) < 4 * sigma or abs(abs(delay) - expected) > 3 * sigma:
        return 0
    return 1 if delay > 0 else -1
