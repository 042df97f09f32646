"""Passing time of every wheelset, and the motion that explains them all.

About each predicted passage the energy is compared with the mean pulse of the record itself. The
shift maximises the likelihood of Gaussian noise with that envelope (energy is then gamma
distributed): L = -sum(ln m + e/m), m = amplitude * pulse(u - shift) + floor. No shape is assumed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from .kinematics import POSITION_SIGMA, Fit, Motion, regress
from .pattern import Trace

Array = NDArray[np.float64]

_HALF = 1.25  # m either side of a wheelset that belongs to it
_PARTNER = 3.5  # m, nearer is the same bogie
_STEP = 0.1  # m
_CELL = 0.2  # m, averaging of the energy
_ROUNDS = 5
_FREE_POSITION = 0.3  # m, of a channel while only spacings are compared
_COVERED = 0.6  # part of a wheelset's window that must have been measured


@dataclass(frozen=True)
class AxleFit:
    """Wheelsets of one train at one or several rail channels.

    Arrays have shape (channels, wheelsets): time (s), residual (m, channel offset
    removed), contrast (ln of the energy at
    the wheelset over that beside it), observed.
    """

    motion: Motion
    scale: float
    time: Array
    residual: Array
    contrast: Array
    observed: NDArray[np.bool_]
    offset: Array
    anchor_sigma: Array

    @property
    def used(self) -> NDArray[np.bool_]:
        """Wheelsets that agree with the motion within four standard deviations."""
        return self.observed & (np.abs(self.residual) < 4 * self.scale)


def _neighbours(axles: Array) -> NDArray[np.int64]:
    """Class of every wheelset: has a near one before (1), behind (2), both (3), none (0)."""
    gaps = np.diff(axles)
    before = np.concatenate([[False], gaps < _PARTNER])
    behind = np.concatenate([gaps < _PARTNER, [False]])
    return np.asarray(before + 2 * behind, dtype=np.int64)


def _windows(trace: Trace, motion: Motion, places: Array, half: float) -> tuple[Array, Array]:
    """Energies about each place, shape (places, cells), and the measured fraction per place."""
    u = np.arange(-half, half + _STEP / 2, _STEP)
    centre = motion.time_at(places)[:, None]
    speed = np.maximum(motion.speed_at(centre), 0.5)
    start = centre + (u - _CELL / 2) / speed
    stop = centre + (u + _CELL / 2) / speed
    energy = trace.mean(start, stop)
    covered = trace.coverage(start[:, 0], stop[:, -1])
    return energy, covered


def _pulse(energy: Array, floor: float, classes: NDArray[np.int64], symmetric: bool) -> Array:
    """Mean pulse per class on the grid of the energies, shape (4, cells), mean 1.

    The plain mean gives the finest spacing of wheelsets but no place: it takes up an error
    common to all of them. ``symmetric``: the pulse of a leading wheelset is the mirror
    image of a trailing
    one's, which fixes the place.
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
    if symmetric:
        before, behind = out[1].copy(), out[2].copy()
        out[0], out[3] = 0.5 * (out[0] + out[0, ::-1]), 0.5 * (out[3] + out[3, ::-1])
        if (classes == 1).any() and (classes == 2).any():
            out[1] = 0.5 * (before + behind[::-1])
            out[2] = out[1, ::-1]
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


def _anchor(offset: Array, classes: NDArray[np.int64]) -> tuple[float, float]:
    """Place of the plain pulses against the symmetric ones (m), and its standard deviation.

    Leading and trailing wheelsets have pulses of their own; where these are not mirror images of
    each other, the places they give differ, and tell how little the symmetry is worth.
    """
    places, sigmas = [], []
    for c in np.unique(classes):
        members = offset[classes == c]
        if members.size >= 3:
            places.append(float(np.median(members)))
            sigmas.append(1.86 * np.median(np.abs(members - places[-1])) / np.sqrt(members.size))
    if not places:
        return float(np.median(offset)), 0.3
    spread = max(places) - min(places)
    return float(np.mean(places)), float(np.hypot(np.mean(sigmas), spread))


def fit_axles(
    traces: Sequence[Trace],
    places: Sequence[Array],
    start: Motion,
) -> AxleFit:
    """Times of the wheelsets of a train at every rail channel, and its motion.

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
    anchor = np.zeros(len(traces))
    anchor_sigma = np.zeros(len(traces))
    for round_ in range(_ROUNDS):
        last = round_ == _ROUNDS - 1
        for k, trace in enumerate(traces):
            energy, covered = _windows(trace, motion, places[k], half)
            if round_ == 0:
                shift = _first_shift(energy, reach)
            else:
                near = min(reach, 0.6)
                pulse = _pulse(energy, trace.noise, classes, symmetric=False)
                shift = _best_shift(energy, pulse[classes], trace.noise, near)
                if last:
                    pulse = _pulse(energy, trace.noise, classes, symmetric=True)
                    centred = _best_shift(energy, pulse[classes], trace.noise, near)
                    anchor[k], anchor_sigma[k] = _anchor(centred - shift, classes)
            centre = motion.time_at(places[k])
            speed = np.maximum(motion.speed_at(centre), 0.5)
            time[k] = centre + (shift + anchor[k]) / speed
            middle = energy.shape[1] // 2
            at = energy[:, middle - 4 : middle + 5].mean(axis=1)
            beside = np.minimum(energy[:, :6].mean(axis=1), energy[:, -6:].mean(axis=1))
            contrast[k] = np.log(np.maximum(at, trace.noise) / np.maximum(beside, trace.noise))
            observed[k] = covered > _COVERED
        flat_time = time[observed]
        flat_place = np.stack(list(places))[observed]
        if flat_time.size < 4:
            break
        channel = np.nonzero(observed)[0]
        sigma = float(np.hypot(POSITION_SIGMA, anchor_sigma.max())) if last else _FREE_POSITION
        fit = regress(flat_time, flat_place, channel, motion.epoch, position_sigma=sigma)
        motion = fit.motion
        if motion.speed < 1.0:
            break
    residual = np.zeros(shape)
    if fit is not None:
        residual[observed] = fit.residual
    return AxleFit(
        motion=motion,
        scale=fit.scale if fit is not None else float("inf"),
        time=time,
        residual=residual,
        contrast=contrast,
        observed=observed,
        offset=fit.offset if fit is not None else np.zeros(len(traces)),
        anchor_sigma=anchor_sigma,
    )
