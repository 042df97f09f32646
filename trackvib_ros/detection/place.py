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
from scipy.special import expit

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
_BAND = 0.5  # rad/m, of one level of noise
_LINES = 2.0  # shape of the distribution of its variance; heavy tails, with a mean
_LEVEL_ROUNDS = 8
_FINE_STEP = 0.05  # m, for the shortest of these waves
# rad/m; a wheel does not follow waves shorter than 0.2 m at speed
_GROUPS = ((1.0, 5.0), (5.0, 10.0), (10.0, 15.0), (15.0, 20.0), (20.0, 25.0), (25.0, 30.0))
_PULSE = np.arange(-2.0, 2.01, 1.0)  # m about a wheelset; as dense as the width of a group asks for
_ROUNDS = 2
_IN_DOUBT = 1.0  # rad, standard deviation of a phase that is within half a turn at three
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


def _against_distance(
    wave: Wave, motion: Motion, length: float, step: float
) -> tuple[Array, float] | None:
    """Mean value per cell of distance from ``-_TAPER`` on, tapered, and the measured fraction."""
    count = int(np.ceil((length + 2 * _TAPER) / step))
    edges: Array = -_TAPER + step * np.arange(count + 1, dtype=np.float64)
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
    ramp = np.minimum(1.0, (np.arange(count) + 0.5) * step / _TAPER)
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


@dataclass
class _Group:
    """Neighbouring wavenumbers of a channel.

    Attributes:
        first, step: wavenumbers (rad/m).
        seen: transform of the waveform there.
        share: independent wavenumbers per wavenumber.
        at: places of the wheelsets (m).
        shown: part of every wheelset that was measured.
        log: likelihood of the pulse against noise.
    """

    first: float
    step: float
    seen: Any
    share: float
    at: Array
    shown: Array
    log: float = 0.0

    def __post_init__(self) -> None:
        bands = max(1, round(self.seen.size * self.step / _BAND))
        self._band = np.arange(self.seen.size) * bands // self.seen.size
        self._alone, self._weight = self._noise(self.seen)

    def explained(self, change: Array) -> tuple[Array, Array]:
        """What the waveform says of a change (m): normal matrix and right-hand side.

        The pulse that fits best sets the weights and the likelihood.
        """
        along = 2 * (self.at - self.at[0]) / (self.at[-1] - self.at[0]) - 1
        bend = np.stack([np.ones_like(along), along, 0.5 * along**2])
        ahead = self.at - self.at[0] + change @ bend[1:]
        k, phases = _phases(self.first, self.step, self.seen.size, ahead)
        comb, *slopes = (self.shown * bend) @ phases
        pulse = np.exp(-1j * np.outer(_PULSE, k))
        taps = pulse * comb
        left, pulled = self._reduced(taps, self.seen[None])
        level, self._weight = self._noise(left[0])
        # what a free pulse costs (Schwarz, Annals of Statistics 6, 1978): noise has none
        self.log = level - self._alone - _PULSE.size * float(np.log(2 * self.share * k.size))
        slope = (pulled[0] @ pulse) * -1j * k * np.array(slopes)
        slope, _ = self._reduced(taps, slope)
        # the second derivative of the likelihood: the weight less by how it falls with the rest
        bent = self._weight * (
            1 - self._weight * np.abs(left[0]) ** 2 / (2 * self.share * (_LINES + 1))
        )
        normal = np.real((slope * bent).conj() @ slope.T)
        return normal, np.real((slope * self._weight).conj() @ left[0])

    def _noise(self, rest: Any) -> tuple[float, Array]:
        """Log likelihood of what would be noise, and the weight of every wavenumber.

        Noise has a level in every band and lines (a rail's resonance, every fastening that a wheel
        passes): a normal distribution whose variance is inverse gamma distributed about the level.
        """
        power = np.abs(rest) ** 2
        count = np.bincount(self._band)
        least = _LEAST * float(np.mean(np.abs(self.seen) ** 2)) + 1e-300
        level = np.bincount(self._band, power) / count + least
        for _ in range(_LEVEL_ROUNDS):
            own = level[self._band]
            weight = (_LINES + 1) / (_LINES * own + power)
            level = level * np.bincount(self._band, weight * power) / count + least
        own = level[self._band]
        log = -np.log(own) - (_LINES + 1) * np.log1p(power / (_LINES * own))
        return self.share * float(log.sum()), 2 * self.share * (_LINES + 1) / (_LINES * own + power)

    def _reduced(self, taps: Any, rows: Any) -> tuple[Any, Any]:
        """Rows less what of them pulses explain, and these pulses."""
        weighted = taps.conj() * self._weight
        normal = weighted @ taps.T
        normal += 1e-9 * np.trace(normal).real * np.eye(len(taps))
        shape = np.linalg.solve(normal, weighted @ rows.T).T
        return rows - shape @ taps, shape


def _phases(first: float, step: float, count: int, at: Array) -> tuple[Array, Any]:
    """Equidistant wavenumbers (rad/m) and exp(-i k at), shape (places, wavenumbers)."""
    fine = int(np.sqrt(count)) + 1
    coarse = np.exp(-1j * np.multiply.outer(at, first + step * fine * np.arange(fine)))
    phases = (
        coarse[:, :, None] * np.exp(-1j * np.multiply.outer(at, step * np.arange(fine)))[:, None]
    )
    k = np.asarray(first + step * np.arange(count), dtype=np.float64)
    return k, phases.reshape(at.size, -1)[:, :count]


def agreement(waves: Sequence[Wave], motion: Motion, places: Sequence[Array]) -> Agreement:
    """Whether the distances between the wheelsets of a train are right.

    A sensor hears every wheelset on the same rail: what the roughness there makes one do comes
    again with the next, not the deflection alone. Clipping spares the phase of such waves, for zero
    crossings stay where they are. In every group of bands of wavenumbers a pulse within 2 m of its
    wheelset is fitted by least squares, weighted by the noise it leaves, whose level is unknown in
    every band, for a bridge answers to some. A group shows a pulse or only noise, with even odds.
    The change of the motion follows from the long waves to shorter ones (Newton), as far as their
    phase is not in doubt. Coupling, foundation, layer and a place of the channel that is off are
    in the pulse; wheelsets that pass in a hole of the record have less of one.

    Args:
        waves: per channel.
        motion: of the train.
        places: of its wheelsets (m), per channel, as for :func:`likelihood`.
    """
    stages: list[list[_Group]] = [[] for _ in _GROUPS]
    for wave, at in zip(waves, places, strict=True):
        found = spectrum(wave, motion, at, _GROUPS[-1][1], _FINE_STEP)
        if found is None:
            continue
        k, seen, independent = found
        step = float(k[1] - k[0])
        shown = _shown(wave, motion, at)
        for stage, (low, high) in zip(stages, _GROUPS, strict=True):
            part = slice(*(int(i) for i in np.searchsorted(k, [low, high])))
            if (part.stop - part.start) * step > 0.5 * (high - low):
                share = independent / k.size
                stage.append(_Group(float(k[part.start]), step, seen[part], share, at, shown))
    change, normal, right = np.zeros(2), np.diag([_CHANGE**-2] * 2), np.zeros(2)
    asked: list[_Group] = []
    for stage, (_, high) in zip(stages, _GROUPS, strict=True):
        ends = np.array([[1.0, 0.5], [-1.0, 0.5]])
        doubt = high * float(np.sqrt(np.max(np.sum(ends @ np.linalg.inv(normal) * ends, axis=1))))
        if asked and doubt > _IN_DOUBT:
            break
        before = normal, right
        for _ in range(_ROUNDS if stage else 0):
            normal, right = before
            for group in stage:
                more, pull = group.explained(change)
                normal = normal + expit(group.log) * more
                right = right + expit(group.log) * (pull + more @ change)
            more_change = np.linalg.solve(normal, right) - change
            change = change + np.clip(more_change, -1 / high, 1 / high)
        asked += stage
    for group in asked:
        group.explained(change)
    log = sum(float(np.logaddexp(0.0, group.log)) - float(np.log(2)) for group in asked)
    return Agreement(log, change, np.linalg.inv(normal))


def _mid_speed(motion: Motion, places: Array) -> float:
    return float(motion.speed_at(motion.time_at(0.5 * (places[0] + places[-1]))))


def spectrum(
    wave: Wave, motion: Motion, places: Array, top: float | None = None, step: float = _STEP
) -> tuple[Array, Any, float] | None:
    """Wavenumbers (rad/m) about those of the deflection, the transform of the waveform there with
    distances from the first wheelset on, and how many of them are independent.

    Args:
        wave, motion, places: as for :func:`likelihood`.
        top: largest wavenumber (rad/m) instead of that of a deflection.
        step: cell of distance (m).
    """
    start, length = float(places[0]), float(places[-1] - places[0])
    if not (np.isfinite(length) and length > 0 and _mid_speed(motion, places) > 0):
        return None
    found = _against_distance(wave, _from(motion, start), length, step)
    if found is None:
        return None
    cells, measured = found
    size = fft.next_fast_len(4 * cells.size // 3, real=True)
    k = 2 * np.pi * fft.rfftfreq(size, step)
    spacing = float(np.median(np.diff(wave.time)))
    top = min(top or _WAVENUMBERS[1], 2 * np.pi / (_SAMPLES * spacing * _mid_speed(motion, places)))
    use = (k >= _WAVENUMBERS[0]) & (k <= top)
    if use.sum() < 8:
        return None
    k = k[use]
    origin = -_TAPER + 0.5 * step
    seen = fft.rfft(cells, size)[use] * np.exp(-1j * k * origin)
    if not np.any(seen):
        return None
    return k, seen, cells.size * step * (k[-1] - k[0]) / (2 * np.pi) * measured


def _shown(wave: Wave, motion: Motion, places: Array) -> Array:
    """Measured part of the metre on either side of every wheelset."""
    total = np.concatenate([[0.0], np.cumsum(wave.valid)])
    ends = np.searchsorted(wave.time, motion.time_at(np.stack([places - 1.0, places + 1.0])))
    return np.asarray((total[ends[1]] - total[ends[0]]) / np.maximum(ends[1] - ends[0], 1))


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
