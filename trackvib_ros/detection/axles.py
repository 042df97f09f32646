"""Passing time of every wheelset, and the motion that explains them all.

About each predicted passage the energy is compared with the mean pulse of the record itself. The
shift maximises the likelihood of Gaussian noise with that envelope (energy is then gamma
distributed): L = -sum(ln m + e/m), m = amplitude * pulse(u - shift) + floor. No shape is assumed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from .coherent import wheelsets
from .kinematics import PULSE_PLACE_SIGMA, Fit, Motion, regress
from .pattern import Trace
from .place import CLIPPED_SIGMA, Wave, likelihood, locate

Array = NDArray[np.float64]

_HALF = 1.25  # m either side of a wheelset that belongs to it
_PARTNER = 3.5  # m, nearer is the same bogie
_STEP = 0.1  # m
_CELL = 0.2  # m, averaging of the energy
_ROUNDS = 5
_FREE_POSITION = 0.3  # m, of a channel while only spacings are compared
_MIRROR = 4.0  # m either side of an axis of symmetry that are compared: the whole bogie is in it
_MIRROR_SIGMAS = 8.0  # largest minus least of some thirty noisy cells is 4 to 5 sigma
_MIRROR_RISE = 0.7  # ln, 3 dB: flatter levels have no axis
_PLACE_LOW = 0.07  # m, scale of the error of the axis in the lowest band (half within 0.05 m, ...
_PLACE_HIGH = 0.21  # m, ... one in twenty beyond 0.35 m) and in higher ones (0.17 m, 0.9 m)
_CLOSE = 0.15  # m, scatter of energies below which deflections are not asked for
_COVERED = 0.6  # part of a wheelset's window that must have been measured


@dataclass(frozen=True)
class AxleFit:
    """Wheelsets of one train at one or several rail channels.

    Arrays have shape (channels, wheelsets): time (s), residual (m, channel offset
    removed), contrast (ln of the energy at
    the wheelset over that beside it), observed. ``place`` is the covariance (m²) of where the
    pulses of every channel tell the wheelsets to be; their spacing is known far better.
    ``in_phase`` is the ln of the likelihood that their deflections are there, if these placed them.
    """

    motion: Motion
    scale: float
    time: Array
    residual: Array
    contrast: Array
    observed: NDArray[np.bool_]
    offset: Array
    place: Array
    in_phase: float = 0.0

    @property
    def used(self) -> NDArray[np.bool_]:
        """Wheelsets that agree with the motion within four standard deviations."""
        return self.observed & (np.abs(self.residual) < 4 * self.scale)

    def apart(self, a: int, b: int) -> float:
        """Variance (m²) of the distance between two channels by their pulses."""
        return float(self.place[a, a] + self.place[b, b] - 2 * self.place[a, b])


def _neighbours(axles: Array) -> NDArray[np.int64]:
    """Class of every wheelset: has a near one before (1), behind (2), both (3), none (0)."""
    gaps = np.diff(axles)
    before = np.concatenate([[False], gaps < _PARTNER])
    behind = np.concatenate([gaps < _PARTNER, [False]])
    return np.asarray(before + 2 * behind, dtype=np.int64)


def _windows(trace: Trace, centre: Array, speed: Array, half: float) -> tuple[Array, Array]:
    """Energies about each time, shape (wheelsets, cells), and the measured fraction of each."""
    u = np.arange(-half, half + _STEP / 2, _STEP)
    start = centre[:, None] + (u - _CELL / 2) / speed[:, None]
    stop = centre[:, None] + (u + _CELL / 2) / speed[:, None]
    energy = trace.mean(start, stop)
    covered = trace.coverage(start[:, 0], stop[:, -1])
    return energy, covered


def _pulse(energy: Array, floor: float, classes: NDArray[np.int64]) -> Array:
    """Mean pulse per class on the grid of the energies, shape (4, cells), mean 1.

    It gives the finest spacing of wheelsets but no place: it takes up an error common to all.
    """
    cells = energy.shape[1]
    scaled = energy / np.maximum(energy.mean(axis=1, keepdims=True), floor)
    out = np.ones((4, cells))
    for c in range(4):
        members = classes == c
        if not members.any():
            continue
        shape = np.mean(scaled[members] if members.sum() >= 3 else scaled, axis=0)
        smooth = np.convolve(np.pad(shape, 2, "edge"), [0.1, 0.2, 0.4, 0.2, 0.1], "valid")
        out[c] = smooth / smooth.mean()
    return out


def _best_shift(energy: Array, pulse: Array, floor: float, reach: float) -> Array:
    """Shift (m) of every row against its pulse by maximum likelihood, parabola at the top."""
    cells = energy.shape[1]
    steps = round(reach / _STEP)
    shifts = np.arange(-steps, steps + 1)
    inner = np.arange(steps, cells - steps)
    e = energy[:, inner]
    cost = np.empty((len(energy), shifts.size))
    for k, shift in enumerate(shifts):
        m = pulse[:, inner - shift]
        amplitude = np.maximum(np.mean(e / m, axis=1, keepdims=True), floor)
        model = amplitude * m + floor
        cost[:, k] = np.mean(np.log(model) + e / model, axis=1)
    top = np.argmin(cost, axis=1)
    rows = np.arange(len(energy))
    middle = np.clip(top, 1, shifts.size - 2)
    left, here, right = cost[rows, middle - 1], cost[rows, middle], cost[rows, middle + 1]
    bend = left - 2 * here + right
    fraction = np.where(bend > 0, 0.5 * (left - right) / np.maximum(bend, 1e-12), 0.0)
    fine = shifts[middle] + np.clip(fraction, -1, 1)
    edge = (top == 0) | (top == shifts.size - 1)
    return np.asarray(np.where(edge, shifts[top], fine) * _STEP)


def _first_shift(energy: Array, reach: float) -> Array:
    """Shift (m) of the strongest place near every centre, the energy smoothed over 0.7 m."""
    width = 7
    smooth = signal.convolve(energy, np.ones((1, width)) / width, mode="same")
    cells = energy.shape[1]
    middle = cells // 2
    steps = round(reach / _STEP)
    part = smooth[:, middle - steps : middle + steps + 1]
    return np.asarray((np.argmax(part, axis=1) - steps) * _STEP)


def _centre(
    trace: Trace, motion: Motion, places: Array, classes: NDArray[np.int64], reach: float
) -> tuple[float, float] | None:
    """Where the pulses lie against the wheelsets (m), and how far their level rises (ln).

    A train is the same from both ends: the mean level about leading wheelsets is the mirror image
    of that about trailing ones. The place is the axis of the best mirror symmetry. ``None``
    without a pair.
    """
    centre = motion.time_at(places)
    speed = np.maximum(motion.speed_at(centre), 0.5)
    energy, covered = _windows(trace, centre, speed, _MIRROR + reach)
    energy = np.log(np.maximum(energy, 0.3 * trace.noise))
    pulses: dict[int, Array] = {}
    noise: dict[int, float] = {}
    for c in range(4):
        members = (classes == c) & (covered > _COVERED)
        if members.sum() >= 2:
            pulses[c] = np.mean(energy[members], axis=0)
            scatter = float(np.mean(np.std(energy[members], axis=0)))
            noise[c] = scatter / float(np.sqrt(members.sum()))
    twin = {0: 0, 1: 2, 2: 1, 3: 3}
    pairs = [(c, float((classes == c).sum())) for c in pulses if twin[c] in pulses]
    if not pairs:
        return None
    middle, width, steps = energy.shape[1] // 2, round(_MIRROR / _STEP), round(reach / _STEP)
    cost = np.zeros(2 * steps + 1)
    rise = 0.0
    for c, weight in pairs:
        height = float(np.ptp(pulses[c][middle - width : middle + width + 1]))
        rise = max(rise, height if height > _MIRROR_SIGMAS * noise[c] else 0.0)
        for k in range(-steps, steps + 1):
            part = slice(middle + k - width, middle + k + width + 1)
            x, y = pulses[c][part], pulses[twin[c]][part][::-1]
            x, y = x - x.mean(), y - y.mean()
            cost[k + steps] += weight * float(
                np.sum((x - y) ** 2) / (np.sum(x * x) + np.sum(y * y) + 1e-12)
            )
    top = int(np.argmin(cost))
    fraction = 0.0
    if 0 < top < 2 * steps:
        left, here, right = cost[top - 1 : top + 2]
        bend = left - 2 * here + right
        fraction = 0.5 * (left - right) / bend if bend > 0 else 0.0
    return float((top - steps + fraction) * _STEP), rise


def _by_deflection(
    waves: Sequence[Wave],
    places: Sequence[Array],
    start: Motion,
    observed: NDArray[np.bool_],
    scatter: float,
) -> tuple[Array, Motion, float] | None:
    """Times of the wheelsets (s) by their deflection, if they scatter less than this (m)."""
    found = wheelsets(waves, places, start)
    if found is None:
        return None
    shift = found.shift.copy()
    classes = _neighbours(places[0])
    for c in np.unique(classes):
        # as with energies: what leading and trailing wheelsets differ by is not the train's
        own = shift[:, classes == c]
        own -= np.median(own, axis=1, keepdims=True) - np.median(shift, axis=1, keepdims=True)
        shift[:, classes == c] = own
    due = found.motion.time_at(np.stack(list(places)))
    time = due + shift / np.maximum(found.motion.speed_at(due), 0.5)
    fit = regress(
        time[observed],
        np.stack(list(places))[observed],
        np.nonzero(observed)[0],
        found.motion.epoch,
        position_sigma=_FREE_POSITION,
    )
    if fit.scale >= scatter or fit.motion.speed < 1.0:
        return None
    return time, fit.motion, found.gain


def _position(place: Array) -> float:
    """How far a channel may be from its place (m): free where deflections told it, to be judged
    with the distances between the channels."""
    placed = float(np.max(np.diag(place))) < PULSE_PLACE_SIGMA**2
    return _FREE_POSITION if placed else PULSE_PLACE_SIGMA


def refit(fit: AxleFit, places: Sequence[Array]) -> AxleFit:
    """The wheelset times of one type under another of the same number of wheelsets.

    Args:
        fit: to the first type.
        places: per trace, as for :func:`fit_axles`.
    """
    seen = fit.observed
    again = regress(
        fit.time[seen],
        np.stack(list(places))[seen],
        np.nonzero(seen)[0],
        fit.motion.epoch,
        position_sigma=_position(fit.place),
    )
    residual = np.zeros(seen.shape)
    residual[seen] = again.residual
    return replace(
        fit, motion=again.motion, scale=again.scale, residual=residual, offset=again.offset
    )


@dataclass(frozen=True)
class Timed:
    """Wheelsets of one type by the energy of their pulses.

    Arrays have shape (channels, wheelsets): time (s), contrast and observed as in :class:`AxleFit`.

    Attributes:
        start: rough motion, good to about 1 m everywhere.
        fit: the motion by these times; ``None`` if they are of no train.
        places: per channel, distance (m) at which each wheelset passes it.
        reach: how far from its place a wheelset was looked for (m).
    """

    start: Motion
    fit: Fit | None
    time: Array
    contrast: Array
    observed: NDArray[np.bool_]
    places: tuple[Array, ...]
    reach: float

    @property
    def close(self) -> bool:
        """Whether the wheelsets are where the type has them: deflections need not be asked."""
        return self.fit is not None and self.fit.scale <= _CLOSE


def timed(traces: Sequence[Trace], places: Sequence[Array], start: Motion) -> Timed:
    """Times of the wheelsets of a train at every rail channel, by their energy.

    Args:
        traces: rail channels.
        places: per trace, distance s (m) at which each wheelset passes it.
        start: rough motion, good to about 1 m everywhere.
    """
    motion = start
    count = places[0].size
    gaps = np.diff(places[0])
    nearest = np.minimum(np.concatenate([[np.inf], gaps]), np.concatenate([gaps, [np.inf]]))
    reach = float(np.clip(0.45 * np.min(nearest, initial=3.0), 0.4, 1.1))
    half = _HALF + 0.6
    classes = _neighbours(places[0])
    fit: Fit | None = None
    shape = (len(traces), count)
    time, contrast = np.zeros(shape), np.zeros(shape)
    observed = np.zeros(shape, dtype=bool)
    shift = np.zeros(shape)  # of every wheelset from where the motion expects it (m)
    for round_ in range(_ROUNDS):
        for k, trace in enumerate(traces):
            expected = motion.time_at(places[k])
            speed = np.maximum(motion.speed_at(expected), 0.5)
            # every window stands at its own wheelset: about the places of a wrong type the mean
            # pulse would grow two humps and hide that the type is wrong
            energy, covered = _windows(trace, expected + shift[k] / speed, speed, half)
            if round_ == 0:
                shift[k] = _first_shift(energy, reach)
            else:
                near = min(reach, 0.6)
                pulse = _pulse(energy, trace.noise, classes)
                more = _best_shift(energy, pulse[classes], trace.noise, near)
                shift[k] = np.clip(shift[k] + more, -reach, reach)
            # leading and trailing wheelsets have pulses of their own, whose places relative to the
            # wheelset differ by decimetres: their wheelbase is taken from the type, not measured
            for c in np.unique(classes):
                shift[k, classes == c] -= np.median(shift[k, classes == c])
            time[k] = expected + shift[k] / speed
            middle = energy.shape[1] // 2
            at = energy[:, middle - 4 : middle + 5].mean(axis=1)
            beside = np.minimum(energy[:, :6].mean(axis=1), energy[:, -6:].mean(axis=1))
            contrast[k] = np.log(np.maximum(at, trace.noise) / np.maximum(beside, trace.noise))
            observed[k] = covered > _COVERED
        if observed.sum() < 4:
            fit = None
            break
        flat_time = time[observed]
        flat_place = np.stack(list(places))[observed]
        channel = np.nonzero(observed)[0]
        fit = regress(flat_time, flat_place, channel, motion.epoch, position_sigma=_FREE_POSITION)
        moved = [fit.motion.time_at(places[k]) for k in range(len(traces))]
        speeds = [np.maximum(fit.motion.speed_at(t), 0.5) for t in moved]
        for k in range(len(traces)):
            shift[k] = np.clip((time[k] - moved[k]) * speeds[k], -reach, reach)
        motion = fit.motion
        if motion.speed < 1.0:
            fit = None
            break
    return Timed(start, fit, time, contrast, observed, tuple(places), reach)


def fit_axles(
    traces: Sequence[Trace],
    found: Timed,
    anchors: Sequence[Trace],
    waves: Sequence[Wave],
    deflected: bool,
) -> AxleFit:
    """Times of the wheelsets of a train where their deflection shows them, and its motion.

    Args:
        traces: rail channels.
        found: wheelsets by their energy.
        anchors: the same channels in their lowest band, where the rail bends under the wheel.
        waves: their low-passed waveforms.
        deflected: whether energies tell of no type where its wheelsets are. The times of types are
            compared: a type that energies refuse must not be timed by what others are not.
    """
    fit, places = found.fit, found.places
    motion = found.start if fit is None else fit.motion
    time, observed = found.time.copy(), found.observed
    classes = _neighbours(places[0])
    place = np.diag(np.full(len(traces), np.inf))
    residual = np.zeros(observed.shape)
    bent, in_phase = None, 0.0
    if fit is not None and deflected:
        bent = _by_deflection(waves, places, found.start, observed, fit.scale)
        if bent is not None:
            time, motion, in_phase = bent
    if fit is not None:
        scales = np.full(len(traces), _PLACE_HIGH)
        due = motion.time_at(np.stack(list(places)))
        pace = np.maximum(motion.speed_at(due), 0.5)
        tables = []
        for k, trace in enumerate(anchors):
            centre = None
            if bent is None:
                centre = _centre(trace, motion, places[k], classes, 1.0)
                if centre is None or centre[1] < _MIRROR_RISE:
                    centre = _centre(traces[k], motion, places[k], classes, found.reach)
                else:
                    scales[k] = _PLACE_LOW
            if centre is not None:
                time[k] += centre[0] / pace[k]
            seen = observed[k] if observed[k].any() else slice(None)
            late = float(np.median(((time[k] - due[k]) * pace[k])[seen]))
            tables.append(likelihood(waves[k], motion, places[k] + late))
        more, place = locate(tables, scales)
        place += np.diag([CLIPPED_SIGMA**2 if wave.clipped else 0.0 for wave in waves])
        time += more[:, None] / pace
        fit = regress(
            time[observed],
            np.stack(list(places))[observed],
            np.nonzero(observed)[0],
            motion.epoch,
            position_sigma=_position(place),
        )
        residual[observed] = fit.residual
    return AxleFit(
        motion=motion if fit is None else fit.motion,
        scale=fit.scale if fit is not None else float("inf"),
        time=time,
        residual=residual,
        contrast=found.contrast,
        observed=observed,
        offset=fit.offset if fit is not None else np.zeros(len(traces)),
        place=place,
        in_phase=in_phase,
    )
