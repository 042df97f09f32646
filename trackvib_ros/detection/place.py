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
from scipy.special import expit, logsumexp

from .kinematics import Motion

Array = NDArray[np.float64]

REACH = 2.5
"""How far from its expected place (m) the deflection is looked for: energies are timed within
1.1 m, their axis of symmetry is sought within 1 m, a coupling leads by a third."""

_STEP = 0.1  # m
_WAVENUMBERS = (1.0, 5.0)  # rad/m: shorter waves are roughness, longer ones the bridge and the cars
# rad/m, k0 = (foundation / bending stiffness)^(1/4), on ballastless track, equally likely
_STIFFNESS = (1.2, 1.35, 1.5, 1.7, 1.9)
STIFFNESS = (0.9, 1.4, 2.2)
"""Of pulses that any even one, of a clipped channel, too, is made of (rad/m)."""
_TOP_CLIPPED = 7.0  # rad/m: clipping flattens a pulse, what of it is left is above
_TAPER = 8.0  # m beyond the outer wheelsets
_COUPLINGS = np.arange(0.0, 3.01, 0.5)  # Hz, edges of the AC coupling of accelerometers
_SHIFTS = np.arange(-REACH, REACH + 0.01, 0.02)
_SAMPLES = 2.5  # per wavelength at least
_BAND = 0.5  # rad/m, of one level of noise
_LINES = 2.0  # shape of the distribution of its variance; heavy tails, with a mean
_LEVEL_ROUNDS = 4
_FINE_STEP = 0.05  # m, for the shortest of these waves
# rad/m; a wheel does not follow waves shorter than 0.2 m at speed
_GROUPS = ((1.0, 5.0), (5.0, 10.0), (10.0, 15.0), (15.0, 20.0), (20.0, 25.0), (25.0, 30.0))
_PULSE = np.arange(-2.0, 2.01, 1.0)  # m about a wheelset; as dense as the width of a group asks for
_ROUNDS = 2
_COMPLETIONS = 4  # of holes; each leaves of the error what is missing, a fifth
_IN_DOUBT = 1.0  # rad, standard deviation of a phase that is within half a turn at three
_CHANGE = 0.3  # m, within which the motion is known already, whatever its covariance
_CLASS_SIGMA = 0.005  # m, in every group; on computed passages at 40 dB 0.001 to 0.008
_LEAST = 1e-6  # of the energy that a perfect fit leaves

DEFLECTION_SIGMA = 0.003
"""What remains in doubt of a place found in this way (m), beside noise and the unknown coupling:
rms difference of two channels, over 2**0.5, on 60 computed passages at 40 dB, 43 to 380 km/h."""

LAG_SIGMA = 0.005
"""What damped pads make the deflections of all channels lag by (m, rms on the same passages)."""

ALIKE = 0.1
"""Gaps between wheelsets that differ by less (m) are the same."""

FAR = 12.0
"""Distance (m) at which a neighbour does not matter."""

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


@dataclass
class _Course:
    """Waveform of a channel against distance, in cells from ``_TAPER`` before a train on.

    Attributes:
        cell: mean value of every cell, tapered towards both ends.
        known: cells without a hole of the record.
        step: length of a cell (m).
        measured: fraction of the samples.
        size: of the transform.
        low: number of the first wavenumber in use.
        k: wavenumbers in use (rad/m).
    """

    cell: Array
    known: NDArray[np.bool_]
    step: float
    measured: float
    size: int
    low: int
    k: Array

    def __post_init__(self) -> None:
        self._origin = np.exp(1j * self.k * (_TAPER - 0.5 * self.step))
        self._holes = np.flatnonzero(~self.known)

    @property
    def whole(self) -> bool:
        """Whether nothing is missing."""
        return self._holes.size == 0

    def seen(self, model: Any = None) -> Any:
        """Transform at ``k``; holes hold what pulses do, and what they leave on either side.

        With missing data so completed, the least squares of all data lead to those of the measured
        ones (Dempster, Laird & Rubin, J. Royal Statistical Society B 39, 1977).

        The first pulses, of holes that hold none, are as much too small as is missing.

        Args:
            model: transform of the pulses, by ``k``; none at first.
        """
        full = self.cell
        if not self.whole:
            full = full.copy()
            pulses = np.zeros(full.size)
            if model is not None:
                table = np.zeros(self.size // 2 + 1, dtype=np.complex128)
                table[self.low : self.low + self.k.size] = model / self._origin
                pulses = fft.irfft(table, self.size)[: full.size]
            at = np.flatnonzero(self.known)
            between = np.interp(self._holes, at, full[at] - pulses[at])
            full[self._holes] = pulses[self._holes] + between
        part = fft.rfft(full, self.size)[self.low : self.low + self.k.size]
        return part * self._origin


def _course(
    wave: Wave, motion: Motion, places: Array, top: float | None, step: float
) -> _Course | None:
    """Waveform of a channel against distance from the first wheelset on, if there is any."""
    start, length = float(places[0]), float(places[-1] - places[0])
    speed = _mid_speed(motion, places)
    if not (np.isfinite(length) and length > 0 and speed > 0):
        return None
    motion = _from(motion, start)
    count = int(np.ceil((length + 2 * _TAPER) / step))
    edges: Array = -_TAPER + step * np.arange(count + 1, dtype=np.float64)
    times = motion.time_at(edges)
    first, last = np.searchsorted(wave.time, [times[0], times[-1]])
    first, last = max(int(first) - 1, 0), int(last) + 1
    valid = wave.valid[first:last]
    if valid.sum() < 16:
        return None
    time, measured = wave.time[first:last], np.flatnonzero(valid)
    value = np.interp(np.arange(valid.size), measured, wave.value[first:last][measured])
    total = np.concatenate([[0.0], np.cumsum(0.5 * (value[1:] + value[:-1]) * np.diff(time))])
    # mean over the cell's time: to first order that over its distance
    cell = np.diff(np.interp(times, time, total)) / np.maximum(np.diff(times), 1e-9)
    lost = np.concatenate([[0.0], np.cumsum(~valid)])
    ends = np.searchsorted(time, times)
    known = lost[np.minimum(ends[1:] + 1, valid.size)] == lost[np.maximum(ends[:-1] - 1, 0)]
    if not known.any():
        return None
    ramp = np.minimum(1.0, (np.arange(count) + 0.5) * step / _TAPER)
    taper = np.sin(0.5 * np.pi * ramp) ** 2
    taper *= taper[::-1]
    size = fft.next_fast_len(4 * count // 3, real=True)
    k = 2 * np.pi * fft.rfftfreq(size, step)
    spacing = float(np.median(np.diff(wave.time)))
    top = min(top or _WAVENUMBERS[1], 2 * np.pi / (_SAMPLES * spacing * speed))
    low, high = (int(i) for i in np.searchsorted(k, [_WAVENUMBERS[0], top]))
    if high - low < 8:
        return None
    cell = (cell - np.sum(cell * taper) / taper.sum()) * taper
    if not np.any(cell):
        return None
    return _Course(cell, known, step, float(valid.mean()), size, low, k[low:high])


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
    found = spectrum(wave, motion, places, _TOP_CLIPPED if wave.clipped else None)
    if found is None:
        return flat
    k, seen, independent = found
    energy = float(np.sum(np.abs(seen) ** 2))
    comb = np.exp(-1j * np.outer(k, places - places[0])).sum(axis=1)
    stiffness = np.array(STIFFNESS if wave.clipped else _STIFFNESS)
    pulses = comb * k**2 / (1 + (k / stiffness[:, None]) ** 4)
    frequency = k * _mid_speed(motion, places) / (2 * np.pi)
    turned = seen[:, None] * np.exp(1j * np.outer(k, _SHIFTS))
    for row, edge in zip(flat, _COUPLINGS, strict=True):
        lead = 1j * frequency / (1j * frequency + edge)
        template = pulses * (lead / np.maximum(np.abs(lead), 1e-12))
        projection = np.real(template.conj() @ turned)
        normal = np.real(template.conj() @ template.T)
        if wave.clipped:
            normal += 1e-9 * np.trace(normal) * np.eye(len(normal))
            explained = np.sum(projection * np.linalg.solve(normal, projection), axis=0)[None]
        else:
            explained = projection**2 / np.diag(normal)[:, None]
        log = -independent * np.log(np.maximum(1 - explained / energy, _LEAST))
        row[:] = logsumexp(log, axis=0) - np.log(len(log))
    return flat


@dataclass(frozen=True)
class Agreement:
    """How well one pulse, whatever its shape, repeated by every wheelset explains the waveforms.

    Attributes:
        log: likelihood (ln) against noise with all pulses and changes weighed, negative if noise
            explains the waveforms as well; 0 if no channel shows anything of the train.
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
        course: waveform of the channel.
        part: of its wavenumbers.
        at: places of the wheelsets (m).
        bend: of these places, by the change of the motion and by the effects of classes.
        seen: transform of the waveform there.
        log: likelihood of the pulse against noise.
        pulses: what is expected of the pulses there.
    """

    course: _Course
    part: slice
    at: Array
    bend: Array
    seen: Any
    log: float = 0.0

    def __post_init__(self) -> None:
        k = self.course.k[self.part]
        self._first, self._step = float(k[0]), float(k[1] - k[0])
        bands = max(1, round(k.size * self._step / _BAND))
        self._band = np.arange(k.size) * bands // k.size
        self._share = _independent(self.course) / self.course.k.size
        self._alone, self._weight = self._noise(self.seen)
        self.pulses = np.zeros_like(self.seen)

    def explained(self, change: Array) -> tuple[Array, Array]:
        """What the waveform says of a change (m): normal matrix and right-hand side.

        The pulse that fits best sets the weights and the likelihood.
        """
        ahead = self.at - self.at[0] + change @ self.bend[1:3]
        k, phases = _phases(self._first, self._step, self.seen.size, ahead)
        comb, slopes = np.split(self.bend @ phases, [1])
        pulse = np.exp(-1j * np.outer(_PULSE, k))
        taps = pulse * comb
        left, shape = self._reduced(taps, self.seen[None])
        begun = bool(np.any(self.pulses))
        if not (begun and self.course.whole):
            _, self._weight = self._noise(left[0])
        turned = (shape[0] @ pulse) * -1j * k
        left, _ = self._reduced(taps, np.concatenate([self.seen[None], turned * slopes]))
        rows, own = left[:3], left[3:]
        weighted = own.conj() * self._weight
        known = np.real(weighted @ own.T) + np.eye(len(own))
        effects = np.linalg.solve(known, np.real(weighted @ rows.T)).T
        rows = rows - effects @ own
        # the second derivative of the likelihood: the weight less by how it falls with the rest
        bent = self._weight * (
            1 - self._weight * np.abs(rows[0]) ** 2 / (2 * self._share * (_LINES + 1))
        )
        normal = np.real((rows[1:] * bent).conj() @ rows[1:].T) + effects[1:] @ effects[1:].T
        right = np.real((rows[1:] * self._weight).conj() @ rows[0]) + effects[1:] @ effects[0]
        level, self._weight = self._noise(rows[0])
        # what a free pulse costs (Schwarz, Annals of Statistics 6, 1978): noise has none
        cost = _PULSE.size * float(np.log(2 * self._share * k.size))
        doubt = float(effects[0] @ effects[0] + np.linalg.slogdet(known)[1])
        self.log = level - self._alone - cost - 0.5 * doubt
        self.pulses = (self.seen - rows[0]) / (1.0 if begun else self.course.measured)
        return normal, right

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
        weight = 2 * self._share * (_LINES + 1) / (_LINES * own + power)
        return self._share * float(log.sum()), weight

    def _reduced(self, taps: Any, rows: Any) -> tuple[Any, Any]:
        """Rows less what of them pulses explain, and these pulses."""
        weighted = taps.conj() * self._weight
        normal = weighted @ taps.T
        normal += 1e-9 * np.trace(normal).real * np.eye(len(taps))
        shape = np.linalg.solve(normal, weighted @ rows.T).T
        return rows - shape @ taps, shape


def _bends(places: Array) -> Array:
    """How places move: all alike, with the change of the motion, by effects of variance one."""
    along = 2 * (places - places[0]) / (places[-1] - places[0]) - 1
    alike = classes(places)
    member = np.arange(int(alike.max()) + 1)[:, None] == alike
    # what all wheelsets have in common is in the pulse
    own = _CLASS_SIGMA * (member - member.mean(axis=1, keepdims=True))
    return np.stack([np.ones_like(along), along, 0.5 * along**2, *own])


def classes(places: Array) -> NDArray[np.int64]:
    """Number of every wheelset's class: same distances to both neighbours, far ones alike."""
    gaps = np.minimum(np.diff(places, prepend=places[0] - 99.0, append=places[-1] + 99.0), FAR)
    order = np.argsort(gaps)
    # rounding would part gaps at its limits, equal but for their last digit
    alike = np.empty(gaps.size, dtype=np.int64)
    alike[order] = np.cumsum(np.diff(gaps[order], prepend=gaps[order[0]]) > ALIKE)
    pairs = np.stack([alike[:-1], alike[1:]], axis=1)
    return np.asarray(np.unique(pairs, axis=0, return_inverse=True)[1].ravel(), dtype=np.int64)


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
    The pulses of wheelsets with other neighbours lie elsewhere, in every group by an unknown few
    millimetres. The change of the motion, known as far as its covariance says, follows from the
    long waves to shorter ones (Newton), as far as their phase is not in doubt; what is unknown is
    integrated over (Laplace). Coupling, foundation, layer and a place of the channel that is off
    are in the pulse; wheelsets that pass in a hole of the record have less of one.

    Args:
        waves: per channel.
        motion: of the train.
        places: of its wheelsets (m), per channel, as for :func:`likelihood`.
    """
    courses: list[tuple[_Course, Array]] = []
    for wave, at in zip(waves, places, strict=True):
        course = _course(wave, motion, at, _GROUPS[-1][1], _FINE_STEP)
        if course is not None:
            courses.append((course, at))
    bends = [_bends(at) for _, at in courses]
    model = [np.zeros(course.k.size, dtype=np.complex128) for course, _ in courses]
    seen = [course.seen() for course, _ in courses]
    if not courses:
        return Agreement(0.0, np.zeros(2), np.diag([_CHANGE**2] * 2))
    prior = _known(motion, places[0])
    change, normal, right = np.zeros(2), prior, np.zeros(2)
    asked: list[_Group] = []
    for low, high in _GROUPS:
        ends = np.array([[1.0, 0.5], [-1.0, 0.5]])
        doubt = high * float(np.sqrt(np.max(np.sum(ends @ np.linalg.inv(normal) * ends, axis=1))))
        if asked and doubt > _IN_DOUBT:
            break
        stage: list[tuple[int, _Group]] = []
        for i, (course, at) in enumerate(courses):
            part = slice(*(int(j) for j in np.searchsorted(course.k, [low, high])))
            if (part.stop - part.start) * (course.k[1] - course.k[0]) > 0.5 * (high - low):
                stage.append((i, _Group(course, part, at, bends[i], seen[i][part])))
        before = normal, right
        whole = all(group.course.whole for _, group in stage)
        for _ in range((_ROUNDS if whole else _COMPLETIONS) if stage else 0):
            normal, right = before
            for _, group in stage:
                more, pull = group.explained(change)
                normal = normal + expit(group.log) * more
                right = right + expit(group.log) * (pull + more @ change)
            more_change = np.linalg.solve(normal, right) - change
            change = change + np.clip(more_change, -1 / high, 1 / high)
            for i, group in stage:
                if not group.course.whole:
                    model[i][group.part] = group.pulses
                    seen[i] = group.course.seen(model[i])
                    group.seen = seen[i][group.part]
        asked += [group for _, group in stage]
    for group in asked:
        group.explained(change)
    log = sum(float(np.logaddexp(0.0, group.log)) - float(np.log(2)) for group in asked)
    log -= 0.5 * float(change @ prior @ change)
    log -= 0.5 * float(np.linalg.slogdet(normal)[1] - np.linalg.slogdet(prior)[1])
    return Agreement(log, change, np.asarray(np.linalg.inv(normal), dtype=np.float64))


def _known(motion: Motion, places: Array) -> Array:
    """Inverse covariance (1/m²) of the change of a motion, before the waveforms are asked."""
    middle, half = 0.5 * (places[0] + places[-1]), 0.5 * (places[-1] - places[0])
    at = motion.moved(float(motion.time_at(middle)))
    duration = half / at.speed
    growth = np.array([[0.0, duration, 0.0], [0.0, 0.0, duration**2]])
    known = growth @ at.covariance @ growth.T + DEFLECTION_SIGMA**2 * np.eye(2)
    return np.asarray(np.linalg.inv(known) + np.eye(2) / _CHANGE**2, dtype=np.float64)


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
    course = _course(wave, motion, places, top, step)
    if course is None:
        return None
    seen = course.seen()
    independent = _independent(course)
    if not course.whole:
        k, at = course.k, places - places[0]
        _, phases = _phases(float(k[0]), float(k[1] - k[0]), k.size, at)
        taps = np.exp(-1j * np.outer(_PULSE, k)) * phases.sum(axis=0)
        normal = np.real(taps.conj() @ taps.T)
        normal += 1e-9 * np.trace(normal) * np.eye(len(taps))
        for share in (course.measured, *[1.0] * (_COMPLETIONS - 1)):
            shape = np.linalg.solve(normal, np.real(taps.conj() @ seen))
            seen = course.seen(shape @ taps / share)
    return course.k, seen, independent


def _independent(course: _Course) -> float:
    """Number of independent wavenumbers."""
    length = course.cell.size * course.step
    return float(length * (course.k[-1] - course.k[0]) / (2 * np.pi) * course.measured)


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
    """Shift of every channel (m), and their covariance (m²).

    The edge of the AC coupling is taken as the same at all channels: what it leaves in doubt, and
    the lag of the pads, is common to them and no part of their differences.

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
    mean = np.array([part @ _SHIFTS for part in parts])
    variance = np.array([part @ _SHIFTS**2 for part in parts]) - mean**2
    shift = mean @ weight
    own = np.diag(np.maximum(variance @ weight, 0.0) + DEFLECTION_SIGMA**2)
    common = (mean * weight) @ mean.T - np.outer(shift, shift) + LAG_SIGMA**2
    return shift, own + common
