"""Times of single wheelsets by the deflection under them, where their energy tells nothing.

A wheel flat strikes the rail once a turn, tens of metres away and far louder than any wheelset; the
deflection that the wheelsets carry along hardly notices. With the pulses of :mod:`place`,

    A(k) = G(k) sum of exp(-i k (d_j + u_j)) + noise,   G a sum of k² / (1 + (k / k0)^4),

the motion is sought on a grid about its start by the matched filter: the sum of the filtered
waveform at all wheelsets is largest where they are. About that motion the model is linear in the
deviations u_j of the wheelsets, which follow with their standard deviation by least squares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from .kinematics import MAX_ACCELERATION, Motion
from .place import Wave, spectrum

Array = NDArray[np.float64]

_PULSES = (0.9, 1.4, 2.2)  # rad/m, k0 of stiff to soft foundations; clipping flattens pulses, too
_END = 0.15  # m, step of the grid at the ends of a train: a tenth of the shortest wave
_SPEED_REACH = 0.01  # relative, two steps of the finest scan of energies
_PLACE_REACH = 1.5  # m
_BEND_REACH = 3.0  # m, half of it off at the ends and in the middle
_FINE = 0.05  # m, of the filtered waveform
_TRIALS = 10.0  # ln of the number of independent cells of the grid, some 30 x 20 x 10 and the types


@dataclass(frozen=True)
class Wheelsets:
    """Wheelsets by their deflection.

    Attributes:
        motion: that adds their deflections best in phase.
        shift: of every wheelset beyond its place (m), shape (channels, wheelsets).
        sigma: of a shift, per channel (m).
        gain: ln of the likelihood that the deflection of a train is there at all.
    """

    motion: Motion
    shift: Array
    sigma: Array
    gain: float


def wheelsets(waves: Sequence[Wave], places: Sequence[Array], start: Motion) -> Wheelsets | None:
    """Wheelsets of a train by their deflection, if that stands out of the noise at all.

    Args:
        waves: low-passed waveforms of the channels.
        places: per channel, distance (m) at which each wheelset passes it.
        start: motion, good to about 1.5 m everywhere.
    """
    motion, gain = _in_phase(waves, places, start)
    if gain < _TRIALS:
        return None
    shifts, sigmas = [], []
    for wave, own in zip(waves, places, strict=True):
        found = _deviations(wave, motion, own)
        if found is None:
            return None
        shifts.append(found[0])
        sigmas.append(found[1])
    return Wheelsets(motion, np.array(shifts), np.array(sigmas), gain)


def _in_phase(
    waves: Sequence[Wave], places: Sequence[Array], start: Motion
) -> tuple[Motion, float]:
    """The motion near a start that adds the deflections of all wheelsets best; ln likelihood."""
    half = 0.5 * (places[0][-1] - places[0][0])
    middle = float(start.time_at(places[0][0] + half))
    speed = float(start.speed_at(middle))
    duration = 2 * half / speed
    tilts = _grid(_SPEED_REACH * half)
    most = 0.125 * MAX_ACCELERATION * duration**2
    bends = _grid(min(_BEND_REACH, most))
    along = np.stack([(own - places[0][0] - half) / max(half, 1.0) for own in places])
    # a wheelset is ahead of the start by place + tilt * along + bend * (along² - 1/2)
    tilted = tilts[:, None, None] * along + bends[:, None, None, None] * (along**2 - 0.5)
    offsets = np.arange(-_PLACE_REACH, _PLACE_REACH + 1e-9, 0.1)
    total = np.zeros((bends.size, tilts.size, offsets.size))
    for k, (wave, own) in enumerate(zip(waves, places, strict=True)):
        found = spectrum(wave, start, own)
        if found is None:
            continue
        wavenumber, seen, independent = found
        pulse = wavenumber**2 / (1 + (wavenumber / _PULSES[1]) ** 4)
        comb = np.exp(-1j * np.outer(wavenumber, own - own[0])).sum(axis=1)
        norm = float(np.sum(np.abs(comb * pulse) ** 2)) * float(np.sum(np.abs(seen) ** 2))
        reach = _PLACE_REACH + float(np.abs(tilted).max())
        filtered = _filtered(wavenumber, seen * pulse, own, reach)
        ahead = own - own[0] + tilted[:, :, k, :]
        for j, offset in enumerate(offsets):
            cells = np.rint((ahead + offset + reach) / _FINE).astype(np.int64)
            projection = filtered[cells].sum(axis=-1)
            share = np.minimum(projection**2 / norm, 0.999)
            total[:, :, j] -= independent * np.log1p(-share)
    best = np.unravel_index(int(np.argmax(total)), total.shape)
    bend, tilt, offset = bends[best[0]], tilts[best[1]], offsets[best[2]]
    # what lies ahead by that much is passed later: s(t) is smaller by it
    at = start.moved(middle)
    moved = Motion(
        middle,
        at.distance - offset + 0.5 * bend,
        at.speed * (1 - tilt / max(half, 1.0)),
        at.acceleration - 2 * bend * (speed / max(half, 1.0)) ** 2,
        at.covariance,
    )
    return moved, float(total[best])


def _filtered(
    wavenumber: Array, product: NDArray[np.complex128], own: Array, reach: float
) -> Array:
    """Matched filter output every :data:`_FINE` m from ``reach`` before the first wheelset on.

    Zero beyond the length of the transform, which holds all of the waveform.
    """
    count = int(np.ceil((own[-1] - own[0] + 2 * reach) / _FINE)) + 2
    step = wavenumber[1] - wavenumber[0]
    size = round(2 * np.pi / (step * _FINE))
    table = np.zeros(size, dtype=np.complex128)
    first = round(float(wavenumber[0] / step))
    table[first : first + wavenumber.size] = product * np.exp(-1j * wavenumber * reach)
    # exp(+i k s) at s = n _FINE - reach, on the grid of the transform
    output = np.real(fft.ifft(table) * size)[:count]
    return np.pad(output, (0, count - output.size))


def _grid(reach: float) -> Array:
    count = max(int(np.ceil(reach / _END)), 0)
    return np.asarray(_END * np.arange(-count, count + 1), dtype=np.float64)


def _deviations(wave: Wave, motion: Motion, own: Array) -> tuple[Array, float] | None:
    """Deviation of every wheelset (m) and its standard deviation, by linear least squares."""
    found = spectrum(wave, motion, own)
    if found is None:
        return None
    wavenumber, seen, independent = found
    single = np.exp(-1j * np.outer(wavenumber, own - own[0]))
    comb = single.sum(axis=1)
    shapes = np.stack([wavenumber**2 / (1 + (wavenumber / k0) ** 4) for k0 in _PULSES], axis=1)
    best: tuple[float, Array, Array] | None = None
    for shift in np.arange(-0.6, 0.61, 0.05):
        turned = shapes * np.exp(-1j * wavenumber * shift)[:, None]
        amplitude, left = _least_squares(turned * comb[:, None], seen)
        if best is None or left < best[0]:
            best = left, turned, amplitude
    assert best is not None
    _, turned, amplitude = best
    pulse = turned @ amplitude
    slopes = -1j * wavenumber[:, None] * pulse[:, None] * single
    design = np.concatenate([turned * comb[:, None], slopes], axis=1)
    stacked = np.concatenate([design.real, design.imag])
    target = np.concatenate([seen.real, seen.imag])
    # the shift of all is in the pulse already: its direction is left to the slopes
    size = np.linalg.norm(stacked, axis=0)
    normal = (stacked / size).T @ (stacked / size)
    freedom = 2 * independent - design.shape[1]
    if freedom < own.size:
        return None
    inverse = np.linalg.pinv(normal, rcond=1e-8, hermitian=True)
    solved = inverse @ ((stacked / size).T @ target) / size
    rest = target - stacked @ solved
    # bins are closer than independent ones
    variance = float(rest @ rest) / target.size * 2 * independent / freedom
    scale = target.size / (2 * independent)
    spread = scale * variance * np.diag(inverse)[len(_PULSES) :] / size[len(_PULSES) :] ** 2
    return solved[len(_PULSES) :], float(np.sqrt(np.mean(spread)))


def _least_squares(
    design: NDArray[np.complex128], seen: NDArray[np.complex128]
) -> tuple[Array, float]:
    normal = np.real(design.conj().T @ design)
    normal += 1e-9 * np.trace(normal) * np.eye(len(normal))
    right = np.real(design.conj().T @ seen)
    solved = np.linalg.solve(normal, right)
    return solved, -float(right @ solved)
