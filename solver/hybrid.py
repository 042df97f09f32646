"""Hybrid FE-SEA run: complex modes below the crossover, statistical energy above it.

Global set: the line's complex modes up to f_g, stepped with a step longer by f_limit/f_g, wheels
on the irregularity below f_g; the modes above f_g act on the contact by their static compliance.
Local set: :mod:`solver.local`. Both add up at the rate that was asked for.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .errors import InputError
from .irregularity import Profile, build_profile
from .line import LAYER_LIMIT, assemble
from .local import (
    LocalField,
    LocalWheel,
    contact_stiffness,
    local_wheel,
    low_pass,
    with_tones,
)
from .modal import ModalRun
from .motion import TrainMotion
from .newmark import NewmarkRun
from .scenario import Polygon, Scenario, Train
from .segments import line_run
from .traffic import Running, Traffic
from .waves import Real, pinned_pinned_frequency, rail_frequency

MARGIN = 1.15
"""Least crossover per pinned-pinned frequency: that resonance is deterministic."""

LEAST_MARGIN = 1.1

GLOBAL_MARGIN = 1.25
"""Frequency limit of the global set's modes per crossover: without the modes just above f_g the
wheel force in the last third octave below it is 1 dB too large."""

NEWMARK_PHASE = 0.346
"""omega h at the crossover: Newmark's average acceleration lengthens periods there by 1 %."""

SAMPLES = 5.9
"""Steps of the global set per period of the crossover, at least. Forces then differ from ``fe`` by
2 % of their rms about the mean, by 5 % in the last third octave below the crossover."""

SPEED_RANGE = 2 ** (1 / 6)
"""Largest ratio of the speeds of a train on the line: a sixth octave."""

KEPT_TABLES = 32
"""Kinds of wheelsets whose local forces stay tabled, for further trains of that speed."""

AHEAD = 0.1
"""Time (s) computed at once by both sets, so that short blocks cost no more than long ones."""

HALF_TAPS = 4
"""Samples of the global set on either side that make a sample in between.

The global set ends at 1.15 f_g, its images start at 1/step - 1.15 f_g; with almost 6 samples
per period of f_g a Kaiser window of beta 8 leaves -80 dB of them.
"""


def crossover_frequency(scenario: Scenario) -> float:
    """f_g (Hz): as stated, or the first third-octave edge above 1.15 pinned-pinned frequencies.

    With ``solution.sines`` given it is what these resolve on the rail, as in the paper, even where
    the pinned-pinned resonance then is left to the local set.

    Raises:
        InputError: the pinned-pinned resonance would be local, or nothing would be.
    """
    solution = scenario.solution
    pinned = pinned_pinned_frequency(scenario.track)
    chosen = solution.crossover
    if chosen is None and solution.sines is not None:
        line = scenario.line
        longest = max(line.approach_left, *line.spans, line.approach_right)
        chosen = rail_frequency(scenario.track, solution.sines[0] * math.pi / longest)
    elif chosen is None:
        chosen = 10 ** (math.ceil(10 * math.log10(MARGIN * pinned) - 0.5) / 10 + 0.05)
    elif chosen < LEAST_MARGIN * pinned:
        raise InputError(
            f"solution.crossover = {chosen:g} Hz: must be at least {LEAST_MARGIN * pinned:.0f} Hz, "
            f"{LEAST_MARGIN} times the pinned-pinned frequency of the rail, {pinned:.0f} Hz: that "
            "resonance is deterministic and must stay global"
        )
    if chosen * 1.12 > solution.frequency_limit:
        raise InputError(
            f"solution.crossover = {chosen:.0f} Hz leaves no local band below "
            f"solution.frequency_limit = {solution.frequency_limit:g} Hz: at least a sixth octave "
            'is needed; raise frequency_limit, or set solution.model = "fe"'
        )
    return float(chosen)


Tone = tuple[float, float, float]
"""Wavenumber (rad/m), amplitude (m) and phase (rad) of amplitude * cos(wavenumber x + phase)."""

WheelKey = tuple[tuple[float, bool, float, float], tuple[Tone, ...]]
"""Speed, direction, mass and contact stiffness of a wheelset; its polygons."""


class GlobalTraffic(Traffic):
    """Trains on the irregularity below the crossover."""

    def __init__(self, scenario: Scenario, crossover: float) -> None:
        self._crossover = crossover
        self._parts: dict[float, Profile] = {}
        self._speeds: dict[int, float] = {}
        super().__init__(scenario)

    @property
    def full_profile(self) -> Profile:
        """The whole irregularity, from well before to well after the line."""
        if self._profile is None:
            self._parts.clear()
            self._profile = build_profile(
                self.scenario.irregularity, -self._reach, self.length + self._reach, self.length
            )
        return self._profile

    def speed(self, train: int) -> float:
        """Speed (m/s) of a train on the line.

        Raises:
            InputError: it changes too much there.
        """
        if train not in self._speeds:
            self._speeds[train] = line_speed(self.motions[train], self.length)
        return self._speeds[train]

    def forget(self, trains: Sequence[int]) -> None:
        """Drop trains, and what only they needed."""
        super().forget(trains)
        self._speeds = {k: v for k, v in self._speeds.items() if k in self.motions}
        speeds = set(self._speeds.values())
        self._parts = {k: v for k, v in self._parts.items() if k in speeds}

    def low_profile(self, speed: float) -> Profile:
        """The irregularity below the crossover at a speed (m/s), kept for later."""
        profile = self.full_profile
        if speed not in self._parts:
            self._parts[speed] = low_pass(profile, 2 * np.pi * self._crossover / speed)
        return self._parts[speed]

    def roughness(self, units: Sequence[Running], position: Real, time: Real) -> Real:
        """(n, A) m, as :meth:`Traffic.roughness` but without what is local."""
        whole = self.full_profile
        column = 0
        values = np.empty_like(position)
        for train, group in itertools.groupby(units, key=lambda running: running.train):
            members = list(group)
            speed = self.speed(train)
            count = sum(len(running.unit.wheelsets) for running in members)
            own = slice(column, column + count)
            self._profile = self.low_profile(speed)
            try:
                values[:, own] = super().roughness(members, position[:, own], time)
            finally:
                self._profile = whole
            column += count
        return values

    def add(self, train: Train, now: int = 0) -> int:
        """See :meth:`Traffic.add`; polygons above the crossover are left out."""
        high = high_polygons(train, self._crossover, self.scenario.line.length)
        low = tuple(polygon for polygon in train.polygon if polygon not in high)
        return super().add(train.model_copy(update={"polygon": low}), now)


def polygon_frequency(train: Train, polygon: Polygon, length: float) -> float:
    """Frequency (Hz) at which a polygon shakes its wheelset on a line of ``length`` (m)."""
    radius = _radii(train)[polygon.wheelset - 1]
    return polygon.order * line_speed(TrainMotion(train), length) / (2 * math.pi * radius)


def high_polygons(train: Train, crossover: float, length: float) -> list[Polygon]:
    """Polygons of a train above the crossover (Hz)."""
    return [p for p in train.polygon if polygon_frequency(train, p, length) > crossover]


def line_speed(motion: TrainMotion, length: float) -> float:
    """Geometric mean of the speeds (m/s) between the first axle's entry and the last one's exit.

    Raises:
        InputError: the largest is more than a sixth octave above the smallest.
    """
    times = np.concatenate((motion.axle_times(0.0), motion.axle_times(length)))
    speeds = motion.speed(np.linspace(times.min(), times.max(), 200))
    low, high = float(speeds.min()), float(speeds.max())
    if high > SPEED_RANGE * low:
        raise InputError(
            f"train.speed_profile: from {low:g} to {high:g} m/s on the line; the hybrid's local "
            f'band takes a ratio of {SPEED_RANGE:.3g} at most: set solution.model = "fe"'
        )
    return math.sqrt(low * high)


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _interpolate(coarse: Real, filters: Real, first: int, out: Real) -> None:
    """out[i] at fine sample first + i; coarse[0] is HALF_TAPS - 1 coarse samples earlier."""
    ratio, taps = filters.shape
    for i in range(out.shape[0]):
        phase = (first + i) % ratio
        at = (first + i) // ratio - first // ratio
        if phase == 0:
            out[i] = coarse[at + taps // 2 - 1]
            continue
        row = out[i]
        row[:] = 0.0
        for t in range(taps):
            weight, source = filters[phase, t], coarse[at + t]
            for c in range(row.size):
                row[c] += weight * source[c]
        for c in range(row.size):
            if np.isnan(row[c]):
                # a wheelset that comes or goes: straight between the two neighbours
                a, b = coarse[at + taps // 2 - 1, c], coarse[at + taps // 2, c]
                if np.isnan(a):
                    a = b
                if np.isnan(b):
                    b = a
                row[c] = a + (b - a) * phase / ratio


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _add_local(
    force: Real,
    position: Real,
    columns: NDArray[np.intp],
    length: float,
    start: float,
    step: float,
    value: Real,
    slope: Real,
) -> None:
    """Add the table of a local force to the columns of its wheelsets; NaN off the line."""
    last = value.size - 2
    for i in range(position.shape[0]):
        for c in columns:
            x = position[i, c]
            if not 0.0 <= x <= length:
                force[i, c] = np.nan
                continue
            place = (x - start) / step
            cell = min(max(int(place), 0), last)
            t = place - cell
            s = 1.0 - t
            left = (1.0 + 2.0 * t) * value[cell] + t * step * slope[cell]
            right = (3.0 - 2.0 * t) * value[cell + 1] - s * step * slope[cell + 1]
            force[i, c] += s * s * left + t * t * right


def interpolation_filters(ratio: int) -> Real:
    """(ratio, 2 HALF_TAPS) weights of the neighbouring samples for every place between two."""
    place = np.arange(ratio)[:, None] / ratio
    distance = np.arange(-HALF_TAPS + 1, HALF_TAPS + 1)[None, :] - place
    window = np.i0(8.0 * np.sqrt(np.maximum(1 - (distance / HALF_TAPS) ** 2, 0))) / np.i0(8.0)
    filters = np.sinc(distance) * window
    return np.asarray(filters / filters.sum(axis=1, keepdims=True))


class HybridRun:
    """A hybrid run, with the interface of :class:`ModalRun`.

    Args:
        scenario: what to run.
        traffic: its trains at the step asked for.
        derivatives: 0, 1, 2 for displacement, velocity, acceleration of the channels.
        balance: balance the energy of the global set, see :class:`Simulation`.

    Raises:
        InputError: see :func:`crossover_frequency`; a wheel flat: an impact is not a stationary
            force; a polygon above the frequency limit.

    Attributes:
        crossover: f_g (Hz).
        ratio: steps of the output per step of the global set.
        field: the local set.
    """

    def __init__(
        self,
        scenario: Scenario,
        traffic: Traffic,
        derivatives: tuple[int, ...],
        *,
        balance: bool = False,
    ) -> None:
        self.scenario = scenario
        self.crossover = crossover_frequency(scenario)
        solution = scenario.solution
        newmark = solution.integrator == "newmark"
        if newmark:
            self.ratio = max(1, int(NEWMARK_PHASE / (2 * np.pi * self.crossover) / solution.step))
        else:
            self.ratio = max(1, int(1 / (SAMPLES * self.crossover * solution.step)))
        coarse = solution.model_copy(
            update={
                "model": "fe",
                "step": solution.step * self.ratio,
                "frequency_limit": GLOBAL_MARGIN * self.crossover,
            }
        )
        self._coarse_scenario = scenario.model_copy(update={"solution": coarse})
        for train in scenario.train:
            self.check(train)
        self._fine = traffic
        self._traffic = GlobalTraffic(self._coarse_scenario, self.crossover)
        self._run: ModalRun | NewmarkRun
        if newmark:
            self._run = NewmarkRun(assemble(self._coarse_scenario), self._traffic, derivatives)
        else:
            self._run = line_run(self._coarse_scenario, self._traffic, derivatives, balance=balance)
        self.field = LocalField(scenario, self.crossover, derivatives)
        self._filters = interpolation_filters(self.ratio)
        self._channels = len(scenario.channel)
        self._derivatives = derivatives
        self._coarse_done = 0
        self._next = 0
        self._buffer_force = np.zeros((0, len(traffic.wheelset_train)))
        self._buffer_signal = np.zeros((0, len(derivatives) * self._channels))
        self._local = np.zeros((0, len(derivatives), int(self.field.heard.sum())))
        self._local_first = 0
        self._wheels: dict[WheelKey, LocalWheel] = {}
        self._tables: list[LocalWheel] = []
        self._kinds = np.zeros(0, dtype=np.intp)
        self._describe_wheels()

    @property
    def lost_contacts(self) -> int:
        """Number of times a wheelset lifted off under the forces of the global set."""
        return self._run.lost_contacts

    @property
    def equilibrium_residual(self) -> float:
        """Of the global set."""
        return self._run.equilibrium_residual

    @property
    def energy_residual(self) -> float | None:
        """Of the global set."""
        return self._run.energy_residual

    @property
    def channel_band(self) -> Real:
        """(C,) valid band of every channel (Hz)."""
        limit = self.scenario.solution.frequency_limit
        layers = [channel.layer for channel in self.scenario.channel]
        local = [min(limit, LAYER_LIMIT.get(layer, math.inf)) for layer in layers]
        return np.where(self.field.heard, local, self._run.channel_band)

    @property
    def states(self) -> int:
        """Number of modes or coordinates of the global set."""
        return self._run.states

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on what limits the result."""
        pinned = pinned_pinned_frequency(self.scenario.track)
        warning = (
            f"the stated solution.sines reach {self.crossover:.0f} Hz on the rail, so that its "
            f"pinned-pinned resonance at {pinned:.0f} Hz is random instead of deterministic",
        )
        return (
            *(warning if self.crossover < pinned else ()),
            f"above {self.crossover:.0f} Hz motion is random with the energy of the power balance; "
            "single samples there are one of many possible outcomes",
            f"the global set is stepped at {self.ratio} steps of the output",
        )

    def arrange(self, trains: Sequence[int], departed: Sequence[int] = ()) -> None:
        """Give columns to these trains, some of which may be new, and forget the departed."""
        for index, motion in self._fine.motions.items():
            if index not in self._traffic.motions:
                self._traffic.add(motion.train, self._run.next_sample)
        source = self._fine.arrange(trains)
        self._fine.forget(departed)
        self._run.arrange(trains, departed)
        self._buffer_force = self._fine.rearranged(self._buffer_force, source)
        self._describe_wheels()

    def check(self, train: Train) -> None:
        """Refuse a train that the hybrid cannot run.

        Raises:
            InputError: see :class:`HybridRun`.
        """
        motion = TrainMotion(train)
        line_speed(motion, self.scenario.line.length)
        if train.flat:
            raise InputError(
                f"train.flat on wheelset {train.flat[0].wheelset}: the impact of a flat is no "
                'stationary random force, which the hybrid needs: set solution.model = "fe"'
            )
        limit = self.scenario.solution.frequency_limit
        for polygon in train.polygon:
            frequency = polygon_frequency(train, polygon, self.scenario.line.length)
            if frequency > limit:
                raise InputError(
                    f"train.polygon of order {polygon.order} on wheelset {polygon.wheelset}: "
                    f"{frequency:.0f} Hz lies above solution.frequency_limit = {limit:g} Hz: lower "
                    "the order or the speed"
                )

    def _describe_wheels(self) -> None:
        """Local force tables: one per speed, direction, mass, contact stiffness and polygons."""
        profile = self._traffic.full_profile
        columns: list[WheelKey] = []
        for running in self._traffic.running:
            if running.train not in self._traffic.arranged:
                continue
            motion = self._traffic.motions[running.train]
            speed = self._traffic.speed(running.train)
            self._traffic.low_profile(speed)
            loads = running.unit.static_loads
            for axle, index in enumerate(running.unit.wheelsets):
                stiffness = contact_stiffness(
                    self.scenario.contact,
                    float(running.unit.wheel_radius[axle]),
                    round(float(loads[axle]), 3),
                )
                mass = float(running.unit.mass[index, index])
                tones = self._tones(running.train, running.axles.start + axle)
                columns.append(((speed, motion.sign > 0, mass, stiffness), tones))
        unused = [key for key in self._wheels if key not in columns]
        for key in unused[: max(0, len(self._wheels) - KEPT_TABLES)]:
            del self._wheels[key]
        for key in columns:
            if key not in self._wheels:
                self._wheels[key] = local_wheel(
                    with_tones(profile, key[1]),
                    self.field.cells,
                    self.field.tables.receptances,
                    self.field.edges,
                    self.scenario.track.fastening.spacing,
                    *key[0],
                    self._traffic.length,
                )
        order = list(self._wheels)
        self._tables = [self._wheels[key] for key in order]
        self._kinds = np.array([order.index(key) for key in columns], dtype=np.intp)
        self.field.use(self._tables)

    def _tones(self, index: int, axle: int) -> tuple[Tone, ...]:
        """Polygons of a wheelset above the crossover, as waves of the rail it runs on."""
        motion = self._fine.motions[index]
        train, tones = motion.train, []
        for polygon in high_polygons(train, self.crossover, self.scenario.line.length):
            if polygon.wheelset == axle + 1:
                wavenumber = polygon.order / _radii(train)[axle]
                rolled = float(motion.offsets[axle]) - motion.sign * train.start
                phase = motion.sign * wavenumber * rolled
                tones.append((wavenumber, polygon.amplitude, phase))
        return tuple(tones)

    @property
    def next_sample(self) -> int:
        """First sample that neither set has computed yet."""
        return max(self._run.next_sample * self.ratio, self._local_first + len(self._local))

    def advance(self, samples: int) -> tuple[Real, Real, Real, Real]:
        """The next samples: time (n,), position (n, W), force (n, W), channel outputs (n, O).

        Raises:
            SolverError: the global set diverged.
        """
        sample, self._next = self._next, self._next + samples
        time: Real = (sample + np.arange(samples, dtype=np.float64)) * self._fine.step
        position = self._fine.position(time)
        self._reach(sample // self.ratio, (sample + samples - 1) // self.ratio + HALF_TAPS)
        force = np.empty((samples, position.shape[1]))
        signal = np.empty((samples, self._buffer_signal.shape[1]))
        _interpolate(self._buffer_force, self._filters, sample, force)
        _interpolate(self._buffer_signal, self._filters, sample, signal)
        for kind, table in enumerate(self._tables):
            _add_local(
                force,
                position,
                np.flatnonzero(self._kinds == kind),
                self._traffic.length,
                table.force.start,
                table.force.step,
                table.force.value,
                table.force.slope,
            )
        local = self._local_signal(sample, samples)
        heard = np.flatnonzero(self.field.heard)
        for d in range(len(self._derivatives)):
            signal[:, d * self._channels + heard] += local[:, d]
        return time, position, force, signal

    def _reach(self, first: int, last: int) -> None:
        """Coarse samples first - HALF_TAPS + 1 ... last in the buffers."""
        need = last + 1 - self._coarse_done
        if need > 0:
            need = max(need, math.ceil(AHEAD / self._traffic.step))
            _, _, force, signal = self._run.advance(need)
            if self._coarse_done == 0:
                lead = HALF_TAPS - 1
                self._buffer_force = np.repeat(force[:1], lead, axis=0)
                self._buffer_signal = np.repeat(signal[:1], lead, axis=0)
            self._buffer_force = np.concatenate([self._buffer_force, force])
            self._buffer_signal = np.concatenate([self._buffer_signal, signal])
            self._coarse_done += need
        # the buffers end with coarse sample _coarse_done - 1
        begin = first - HALF_TAPS + 1
        drop = begin - (self._coarse_done - len(self._buffer_force))
        self._buffer_force = self._buffer_force[drop:]
        self._buffer_signal = self._buffer_signal[drop:]

    def _local_signal(self, sample: int, count: int) -> Real:
        hop = self.field.hop
        have = self._local_first + len(self._local)
        if have < sample + count:
            missing = -(-max(sample + count - have, int(AHEAD / self.field.step)) // hop)
            middle = (have + (np.arange(missing) + 0.5) * hop) * self.field.step
            places = self._traffic.position(middle)
            on_line = (places >= 0) & (places <= self._traffic.length)
            kinds = np.where(on_line, self._kinds, -1)
            self._local = np.concatenate([self._local, self.field.next_frames(kinds, places)])
        out = self._local[sample - self._local_first : sample - self._local_first + count]
        self._local = self._local[sample - self._local_first + count :]
        self._local_first = sample + count
        return out


def _radii(train: Train) -> list[float]:
    from .vehicle import build_units

    return [float(radius) for unit in build_units(train) for radius in unit.wheel_radius]
