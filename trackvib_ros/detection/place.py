"""Where the wheelsets of a train are, by the deflection of the rail that each carries along.

Below about 100 Hz the acceleration under a train is the sum of one even pulse per wheelset, v² w''
of a beam on an elastic foundation (Fryba, Vibration of Solids and Structures under Moving Loads,
1999, ch. 13), and of what roughness and noise add. Against distance s its transform is

    A(k) = a C(k) T(k) H(k) exp(-i k s0) + noise,   C(k) = sum of exp(-i k d) over the wheelsets,
    T(k) = k² / (1 + (k / k0)^4),   H = i f / (i f + fc),  f = k v / 2 pi,

with the wheelsets s0 beyond their expected places, an amplitude a of either sign, and the unknown
edge fc of the sensor's AC coupling, whose phase lead is worth a decimetre at 60 km/h. (Its level is
left out: an unknown foundation hides it.) All wheelsets are added in phase: noise, and roughness
that differs from wheelset to wheelset, average out. With the amplitude and the level of white noise
eliminated, the log likelihood of (s0, fc) is -n ln(1 - projection² / energy), n independent
wavenumbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from .kinematics import Motion

Array = NDArray[np.float64]

_STEP = 0.1  # m
_WAVENUMBERS = (1.0, 5.0)  # rad/m: shorter waves are roughness, longer ones the bridge and the cars
_STIFFNESS = (1.4,)  # rad/m, k0 = (foundation / bending stiffness)^(1/4); 1.2 to 1.9 on ballastless
# clipping flattens a pulse: any even one made of three, and what of it is left above
_STIFFNESS_CLIPPED, _TOP_CLIPPED = (0.9, 1.4, 2.2), 7.0
_TAPER = 8.0  # m beyond the outer wheelsets
_COUPLINGS = np.arange(0.0, 3.01, 0.5)  # Hz, edges of the AC coupling of accelerometers
_REACH = 1.3  # m
_SHIFTS = np.arange(-_REACH, _REACH + 0.01, 0.02)
_SAMPLES = 2.5  # per wavelength at least
_PULSE = np.arange(-2.0, 2.01, 0.5)  # m about a wheelset; as dense as the shortest wave asks for
_BANDS, _ROUNDS = 8, 5
_CHANGE = 0.3  # m, within which the motion is known already
_LEAST = 1e-6  # of the energy that a perfect fit leaves

DEFLECTION_SIGMA = 0.003
"""What remains in doubt of a place found in this way (m), beside noise and the unknown coupling:
rms difference of two channels, over 2**0.5, on 60 computed passages at 40 dB, 43 to 380 km/h. What
damped pads make all deflections lag by (rms 0.005 m there) is hardly told from the lead of the
coupling, and is in its posterior."""

CLIPPED_SIGMA = 0.2
"""The same of a clipped channel (m): of 66 that were computed and cut at a fifth of their peak half
are within 0.056 m, four in five within 0.14 m, nine in ten within 0.20 m; a few are a metre off."""


@dataclass(frozen=True)
class Wave:
    """Low-passed waveform of a channel: time (s, delay of the filter removed), value, measured.

    ``clipped`` says that the samples were, which bends the deflection too.
    """

    time: Array
    value: Array
    valid: NDArray[np.bool_]
    clipped: bool = False


def _against_distance(wave: Wave, motion: Motion, length: float) -> tuple[Array, float] | None:
    """Mean value per cell of distance from ``-_TAPER`` on, tapered, and the measured fraction."""
    count = int(np.ceil((length + 2 * _TAPER) / _STEP))
    edges: Array = -_TAPER + _STEP * np.arange(count + 1, dtype=np.float64)
    times = motion.time_at(edges)
    first, last = np.searchsorted(wave.time, [times[0], times[-1]])
    first, last = max(int(first) - 1, 0), int(last) + 1
    valid = wave.valid[first:last]
    if valid.sum() < 16:
        return None
    time, known = wave.time[first:last], np.flatnonzero(valid)
    value = np.interp(np.arange(valid.size), known, wave.value[first:last][known])
    total = np.concatenate([[0.0], np.cumsum(0.5 * (value[1:] + value[:-1]) * np.diff(time))])
    # mean over the cell's time: to first order that over its distance
    cell = np.diff(np.interp(times, time, total)) / np.maximum(np.diff(times), 1e-9)
    ramp = np.minimum(1.0, (np.arange(count) + 0.5) * _STEP / _TAPER)
    taper = np.sin(0.5 * np.pi * ramp) ** 2
    taper *= taper[::-1]
    return (cell - np.sum(cell * taper) / taper.sum()) * taper, float(valid.mean())


def likelihood(wave: Wave, motion: Motion, places: Array) -> Array:
    """Log likelihood of where the wheelsets are, shape (couplings, shifts).

    Args:
        wave: of the channel.
        motion: of the train, such that wheelset i is expected where the distance is ``places[i]``.
        places: of the wheelsets (m).

    Returns:
        Zero everywhere if the channel shows nothing of the train.
    """
    flat = np.zeros((_COUPLINGS.size, _SHIFTS.size))
    stiffness, top = (_STIFFNESS_CLIPPED, _TOP_CLIPPED) if wave.clipped else (_STIFFNESS, None)
    found = spectrum(wave, motion, places, top)
    if found is None:
        return flat
    k, seen, independent = found
    energy = float(np.sum(np.abs(seen) ** 2))
    comb = np.exp(-1j * np.outer(k, places - places[0])).sum(axis=1)
    pulses = comb * k**2 / (1 + (k / np.array(stiffness)[:, None]) ** 4)
    frequency = k * _mid_speed(motion, places) / (2 * np.pi)
    turned = seen[:, None] * np.exp(1j * np.outer(k, _SHIFTS))
    for row, edge in zip(flat, _COUPLINGS, strict=True):
        lead = 1j * frequency / (1j * frequency + edge)
        template = pulses * (lead / np.maximum(np.abs(lead), 1e-12))
        normal = np.real(template.conj() @ template.T)
        normal += 1e-9 * np.trace(normal) * np.eye(len(normal))
        projection = np.real(template.conj() @ turned)
        explained = np.sum(projection * np.linalg.solve(normal, projection), axis=0)
        row[:] = -independent * np.log(np.maximum(1 - explained / energy, _LEAST))
    return flat


@dataclass(frozen=True)
class Agreement:
    """How well one pulse, whatever its shape, repeated by every wheelset explains the waveforms.

    Attributes:
        log: likelihood (ln) against noise with all pulses weighed, negative if noise explains the
            waveforms as well; 0 if no channel shows anything of the train.
        change: what the wheelsets lie beyond their expected places (m): the part that grows by one
            from the middle of the train to its end, and half the part that grows with its square.
        covariance: of the change (m²).
    """

    log: float
    change: Array
    covariance: Array


def agreement(waves: Sequence[Wave], motion: Motion, places: Sequence[Array]) -> Agreement:
    """Whether the distances between the wheelsets of a train are right.

    Noise has an unknown level in every band of wavenumbers, for a bridge answers to some. The
    pulse, real and within 2 m of its wheelset, and a change of the motion are fitted by least
    squares weighted accordingly (Gauss-Newton): with the part q of a band's energy that is left of
    n independent wavenumbers the likelihood is the product of q^-n. Coupling, foundation, layer
    and a place of the channel that is off by less are in the pulse.

    Args:
        waves: per channel.
        motion: of the train.
        places: of its wheelsets (m), per channel, as for :func:`likelihood`.
    """
    spectra = [
        (found, at)
        for w, at in zip(waves, places, strict=True)
        if (found := spectrum(w, motion, at))
    ]
    change, covariance, log = np.zeros(2), np.diag([_CHANGE**2] * 2), 0.0
    if not spectra:
        return Agreement(log, change, covariance)
    weights = [np.ones(k.size) for (k, _, _), _ in spectra]
    for round_ in range(_ROUNDS):
        information, right = np.diag([_CHANGE**-2] * 2), -change / _CHANGE**2
        # what a free pulse costs (Schwarz, Annals of Statistics 6, 1978): noise has none
        log = -0.5 * _PULSE.size * sum(float(np.log(2 * n)) for (_, _, n), _ in spectra)
        for c, ((k, seen, independent), at) in enumerate(spectra):
            along = 2 * (at - at[0]) / (at[-1] - at[0]) - 1
            bend = np.stack([along, 0.5 * along**2])
            phases = np.exp(-1j * np.outer(k, at - at[0] + change @ bend))
            pulse = np.exp(-1j * np.outer(_PULSE, k))
            taps = pulse * phases.sum(axis=1)
            weight = weights[c]
            normal = np.real((taps.conj() * weight) @ taps.T)
            normal += 1e-9 * np.trace(normal) * np.eye(_PULSE.size)
            shape = np.linalg.solve(normal, np.real((taps.conj() * weight) @ seen))
            rest = seen - shape @ taps
            for band in np.array_split(np.arange(k.size), _BANDS):
                energy = max(float(np.sum(np.abs(seen[band]) ** 2)), 1e-300)
                left = max(float(np.sum(np.abs(rest[band]) ** 2)), _LEAST * energy)
                count = independent * band.size / k.size
                log += count * float(np.log(energy / left))
                weight[band] = 2 * count / left
            slope = (shape @ pulse) * -1j * k * (bend @ phases.T)
            cross = np.real((taps.conj() * weight) @ slope.T)
            normal = np.real((taps.conj() * weight) @ taps.T)
            normal += 1e-9 * np.trace(normal) * np.eye(_PULSE.size)
            pulled = np.linalg.solve(
                normal, np.column_stack([cross, np.real((taps.conj() * weight) @ rest)])
            )
            information += np.real((slope.conj() * weight) @ slope.T) - cross.T @ pulled[:, :2]
            right += np.real((slope.conj() * weight) @ rest) - cross.T @ pulled[:, 2]
        covariance = np.linalg.inv(information)
        if round_ < _ROUNDS - 1:
            change = change + np.clip(covariance @ right, -_CHANGE, _CHANGE)
    return Agreement(log, change, covariance)


def _mid_speed(motion: Motion, places: Array) -> float:
    return float(motion.speed_at(motion.time_at(0.5 * (places[0] + places[-1]))))


def spectrum(
    wave: Wave, motion: Motion, places: Array, top: float | None = None
) -> tuple[Array, Any, float] | None:
    """Wavenumbers (rad/m) about those of the deflection, the transform of the waveform there with
    distances from the first wheelset on, and how many of them are independent.

    Args:
        wave, motion, places: as for :func:`likelihood`.
        top: largest wavenumber (rad/m) instead of that of a deflection.
    """
    start, length = float(places[0]), float(places[-1] - places[0])
    if not (np.isfinite(length) and length > 0 and _mid_speed(motion, places) > 0):
        return None
    found = _against_distance(wave, _from(motion, start), length)
    if found is None:
        return None
    cells, measured = found
    size = fft.next_fast_len(4 * cells.size // 3, real=True)
    k = 2 * np.pi * fft.rfftfreq(size, _STEP)
    spacing = float(np.median(np.diff(wave.time)))
    top = min(top or _WAVENUMBERS[1], 2 * np.pi / (_SAMPLES * spacing * _mid_speed(motion, places)))
    use = (k >= _WAVENUMBERS[0]) & (k <= top)
    if use.sum() < 8:
        return None
    k = k[use]
    origin = -_TAPER + 0.5 * _STEP
    seen = fft.rfft(cells, size)[use] * np.exp(-1j * k * origin)
    if not np.any(seen):
        return None
    return k, seen, cells.size * _STEP * (k[-1] - k[0]) / (2 * np.pi) * measured


def _from(motion: Motion, start: float) -> Motion:
    """The same motion with distances counted from ``start`` (m)."""
    return Motion(
        motion.epoch,
        motion.distance - start,
        motion.speed,
        motion.acceleration,
        motion.covariance,
    )


def locate(tables: Sequence[Array], scales: Array) -> tuple[Array, Array]:
    """Shift of every channel (m) and its standard deviation.

    The edge of the AC coupling is taken as the same at all channels.

    Args:
        tables: :func:`likelihood` per channel.
        scales: per channel, of the prior about the expected place (m), a Student distribution of
            two degrees of freedom.
    """
    joint = np.zeros(_COUPLINGS.size)
    parts = []
    for table, scale in zip(tables, scales, strict=True):
        log = table - 1.5 * np.log1p(0.5 * (_SHIFTS / scale) ** 2)
        top = float(log.max())
        density = np.exp(log - top)
        joint += np.log(density.sum(axis=1) + 1e-300)
        parts.append(density / (density.sum(axis=1, keepdims=True) + 1e-300))
    weight = np.exp(joint - joint.max())
    weight /= weight.sum()
    densities = np.array([weight @ part for part in parts])
    shift = densities @ _SHIFTS
    variance = densities @ _SHIFTS**2 - shift**2
    return shift, np.sqrt(np.maximum(variance, 0.0) + DEFLECTION_SIGMA**2)
