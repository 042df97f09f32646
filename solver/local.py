"""The local set above the crossover: wheel forces, powers, energies and a random signal.

- Wheel force: F = -r/(alpha_w + 1/k_H + alpha_r) with the direct-field receptance alpha_r of the
  rail on its fastenings (mean over a bay), alpha_w = -1/(m_w omega^2), k_H the contact stiffness,
  tangential at the static load: the blocked-force and direct-forcing terms of Eqs. (5), (6), (11).
- Power into the rail: P = <F^2> Re Y per cell of frequency and wheel, half to either side.
- Energies: Eq. (12) in time over chains of one-bay segments of rail, slab and support layer.
- What a sensor shows of these energies: what it shows of the direct field of a wheel at the same
  distance, exact for the coupled periodic track, over the energy of the direct field there.
- Signal: noise of the cells whose mean square is the energies', a^2 = omega^2 v^2.

With complex modes as the global set the local set is orthogonal to it, so that Eq. (13), power
from the global motion, is zero; all power comes from the wheels.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.fft
import scipy.sparse as sp
import scipy.sparse.linalg
from numba import njit
from numpy.typing import NDArray

from .cache import cached
from .contact import wheelset_law
from .irregularity import Profile
from .scenario import Bed, Channel, Contact, Scenario, Track
from .sea import Chain, PowerBalance, bed_conductance, chain_balance
from .waves import (
    BlochSolution,
    Complex,
    LayeredTrack,
    PeriodicRail,
    Real,
    WaveBeam,
    plate_beam,
)

LOCAL_FORMAT = 1
"""Of the stored tables; higher after every change of what they hold."""

BANDS_PER_OCTAVE = 6

POINTS_PER_CELL = 12
"""Frequencies over which a cell's wave properties are averaged: every 6.5 Hz. The narrowest
feature, the foot of a pinned-pinned stop band, is some 30 Hz wide."""

BAND_MARGIN = 1.15
"""Highest local frequency per frequency limit: as far as the fe model keeps its modes."""

FRAME_TIME = 6.4e-3
"""Time (s) of one step of the power balance, about; the wheel moves half a metre at 300 km/h.
Frames of noise are twice as long, and a cell is one line of their spectrum, 78 Hz."""

TAIL = 5e-3
"""Part of the steady response to a wheel's power that may be moved to the last lag."""

LAGS = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64)
"""Frames that part the groups of past powers; a group acts from the wheel's place in its middle."""

LIFETIME = 0.05
"""Age (s) at which the direct field of a wheel is forgotten.

At the pinned-pinned frequencies above the first the rail's wave neither moves nor decays, and
without a limit of age the mean square over frequency diverges like a logarithm. Wheels that come
past scatter such a wave; this is not modelled, and 25 or 100 ms instead change the third octaves
that hold these frequencies, 2.5 and 4 kHz, by -3 or +2.4 dB 15 m from the wheel and by less than
0.5 dB beside it. Other bands do not depend on it.
"""

PLACES_PER_BAY = 4
"""Places of a wheel at which the response of the channels is tabled."""

RING = 512
"""Bays after which the periodic track of the direct field repeats: some 330 m."""

UNDAMPED_RING = 2048
"""The same above the rail's second cut-on, where a wave decays by 0.02 dB/m only."""


def band_edges(crossover: float, limit: float) -> Real:
    """Edges (Hz) of equal bands per octave from the crossover to the limit."""
    bands = max(1, round(BANDS_PER_OCTAVE * math.log2(limit / crossover)))
    return np.geomspace(crossover, limit, bands + 1)


def low_pass(profile: Profile, wavenumber: float) -> Profile:
    """The part of an irregularity below a wavenumber (rad/m), on a grid of ten per wave.

    The other part is ``profile`` less this one. A raised cosine of 6 % width parts them.
    """
    spectrum, k = _spectrum(profile)
    gain = np.clip((1.03 * wavenumber - k) / (0.06 * wavenumber), 0, 1)
    spectrum = spectrum * np.sin(0.5 * np.pi * gain) ** 2
    stride = max(1, int(2 * math.pi / wavenumber / 10 / profile.step))
    return _sampled(profile, spectrum, k, stride)


def with_tones(profile: Profile, tones: Sequence[tuple[float, float, float]]) -> Profile:
    """A profile plus waves, on a grid of at least ten points a wave.

    Args:
        profile: irregularity (m).
        tones: (wavenumber rad/m, amplitude m, phase rad) of amplitude * cos(wavenumber x + phase).
    """
    if not tones:
        return profile
    finest = 2 * math.pi / max(wavenumber for wavenumber, _, _ in tones) / 10
    parts = max(1, math.ceil(profile.step / finest))
    step = profile.step / parts
    x = profile.start + step * np.arange((len(profile.value) - 1) * parts + 1)
    value, slope = profile(x), np.gradient(profile(x), step)
    for wavenumber, amplitude, phase in tones:
        value = value + amplitude * np.cos(wavenumber * x + phase)
        slope = slope - amplitude * wavenumber * np.sin(wavenumber * x + phase)
    return Profile(profile.start, step, value, slope)


def _spectrum(profile: Profile) -> tuple[Complex, Real]:
    """Spectrum of the profile, continued smoothly to a period, and its wavenumbers (rad/m)."""
    n = len(profile.value)
    size = _full_size(profile)
    gap = size - n
    fade = 0.5 * (1 + np.cos(np.pi * (np.arange(gap) + 0.5) / gap))
    bridge = profile.value[-1] * fade + profile.value[0] * (1 - fade)
    values = np.concatenate((profile.value, bridge))
    k = 2 * np.pi * np.fft.rfftfreq(size, profile.step).astype(np.float64)
    return np.fft.rfft(values), k


def _sampled(profile: Profile, spectrum: Complex, k: Real, stride: int) -> Profile:
    size = _full_size(profile)
    value = np.fft.irfft(spectrum, size)[: len(profile.value) : stride]
    slope = np.fft.irfft(1j * k * spectrum, size)[: len(profile.value) : stride]
    return Profile(profile.start, profile.step * stride, value, slope)


def _full_size(profile: Profile) -> int:
    return int(scipy.fft.next_fast_len(2 * len(profile.value), real=True))


@dataclass(frozen=True, eq=False)
class Cells:
    """Narrow bands of the local set, the lines of a frame's spectrum.

    Attributes:
        line: (N,) number of each line. low, high: (N,) rad/s.
        band: (N,) band that holds the centre.
        omega: (F,) POINTS_PER_CELL frequencies in each cell (rad/s).
    """

    line: NDArray[np.intp]
    low: Real
    high: Real
    band: NDArray[np.intp]
    omega: Real

    @classmethod
    def between(cls, edges: Real, spacing: float) -> Cells:
        """Cells from the first edge to the last (Hz), ``spacing`` Hz wide."""
        first, last = round(edges[0] / spacing), round(edges[-1] / spacing)
        line = np.arange(first, last + 1)
        low = np.maximum((line - 0.5) * spacing, edges[0])
        high = np.minimum((line + 0.5) * spacing, edges[-1])
        line, low, high = (part[high - low > 1e-6 * spacing] for part in (line, low, high))
        inside = (np.arange(POINTS_PER_CELL) + 0.5) / POINTS_PER_CELL
        points = low[:, None] + (high - low)[:, None] * inside
        band = np.clip(np.searchsorted(edges, (low + high) / 2) - 1, 0, len(edges) - 2)
        two_pi = 2 * np.pi
        return cls(line, two_pi * low, two_pi * high, band, two_pi * points.ravel())

    @property
    def centre(self) -> Real:
        """(N,) rad/s."""
        return (self.low + self.high) / 2

    def mean(self, values: Real) -> Real:
        """Mean over the frequencies of each cell: (F, ...) to (N, ...)."""
        parted = values.reshape(len(self.line), POINTS_PER_CELL, *values.shape[1:])
        return np.asarray(parted.mean(axis=1))

    def smoothed(self, values: Complex, width: float) -> Complex:
        """Mean over ``width`` (rad/s) about every frequency, (..., F)."""
        total = np.concatenate((np.zeros_like(values[..., :1]), np.cumsum(values, axis=-1)), -1)
        count = len(self.omega)
        first = np.searchsorted(self.omega, self.omega - width / 2)
        after = np.searchsorted(self.omega, self.omega + width / 2)
        reach = np.minimum(np.arange(count) - first, after - 1 - np.arange(count))
        low, high = np.arange(count) - reach, np.arange(count) + reach + 1
        return np.asarray((total[..., high] - total[..., low]) / (high - low))


@dataclass(frozen=True, eq=False)
class Branch:
    """One of the rail's travelling waves, means over the frequencies of the cells.

    Attributes:
        mobility: (N,) part of the mean Re Y over a bay that it carries away, m/(N*s).
        decay: (N,) energy decay (1/m). velocity: (N,) of energy (m/s).
        transverse: (N,) part of its kinetic energy that is not rotation.
    """

    mobility: Real
    decay: Real
    velocity: Real
    transverse: Real


@dataclass(frozen=True, eq=False)
class RailWaves:
    """The rail's waves, for one state of the fastenings.

    Attributes:
        cells: of frequency.
        receptances: (X, F) driving-point receptances over a bay (m/N).
        main, second: the waves; the second one travels above sqrt(kGA/rho I) only.
        to_slab: (N,) part of the power into the rail that its fastenings hand to the slab.
    """

    cells: Cells
    receptances: Complex
    main: Branch
    second: Branch
    to_slab: Real

    @classmethod
    def of(cls, periodic: PeriodicRail, cells: Cells, slab: WaveBeam) -> RailWaves:
        """Waves of a rail on fastenings whose beam below is ``slab``."""
        omega = cells.omega
        solution = periodic.solve(omega)
        loads = periodic.load_positions(12)
        points = np.stack([solution.receptance(x, x) for x in loads])
        radiated = (1j * omega * points).real
        beam = periodic.beam
        travels = np.zeros(len(omega), dtype=bool)
        if beam.rotary_inertia > 0:
            travels = omega > math.sqrt(beam.shear_stiffness / beam.rotary_inertia)
        branches = []
        for second in (False, True):
            wave = solution.travelling(second)
            there = wave.energy_velocity > 0
            if second:
                there &= travels
            count = np.maximum(cells.mean(there.astype(np.float64)), 1e-300)
            taken, decay, velocity, transverse = (
                cells.mean(np.where(there, part, 0.0))
                for part in (
                    radiated.mean(axis=0) * wave.share,
                    wave.decay,
                    wave.energy_velocity,
                    wave.transverse,
                )
            )
            branches.append(
                Branch(
                    taken,
                    decay / count,
                    np.where(taken > 0, velocity / count, 1.0),
                    transverse / count,
                )
            )
        chosen = slice(1, None, 4)
        share = sum(
            _slab_share(solution, slab, float(x)) * part
            for x, part in zip(loads[chosen], radiated[chosen], strict=True)
        ) / radiated[chosen].sum(axis=0)
        return cls(cells, points, branches[0], branches[1], cells.mean(share))


def _slab_share(solution: BlochSolution, slab: WaveBeam, load: float) -> Real:
    """Power of all fastenings into the slab per power of a force on the rail, (F,)."""
    bays, omega, rail = 25, solution.omega, solution.rail
    forces = solution.support_receptances(load, bays) * rail.support_stiffness(omega)[:, None]
    distance = np.arange(2 * bays + 1) * rail.spacing
    absorbed = (1j * omega[:, None] * slab.transfer_receptance(omega[:, None], distance)).real
    number = np.arange(2 * bays + 1)
    between = absorbed[:, np.abs(number[:, None] - number)]
    taken = np.einsum("fi,fij,fj->f", forces.conj(), between, forces).real
    given = (1j * omega * solution.receptance(load, load)).real
    return np.asarray(np.clip(taken / given, 0.0, 0.9))


@dataclass(frozen=True, eq=False)
class LocalWheel:
    """Local force of one wheelset of a train, as a table over its place on the line.

    Attributes:
        force: F(x) (N). square: (n, N) mean square of the cells (N^2) at ``k step`` (m).
        step: m.
    """

    force: Profile
    square: Real
    step: float


def contact_stiffness(contact: Contact, radius: float, load: float) -> float:
    """Stiffness (N/m) of a wheelset's contact at its static load (N)."""
    linear, hertz = wheelset_law(contact, radius)
    if hertz == 0:
        return linear
    return float(1.5 * hertz ** (2 / 3) * load ** (1 / 3))


def local_wheel(
    profile: Profile,
    cells: Cells,
    receptances: Complex,
    edges: Real,
    spacing: float,
    speed: float,
    forward: bool,
    mass: float,
    stiffness: float,
    length: float,
) -> LocalWheel:
    """Force of a wheelset that runs over an irregularity at constant speed.

    A wheel stays spacing/speed in a bay and does not resolve the rail's receptance any finer than
    speed/spacing in frequency.

    Args:
        profile: irregularity (m), all wavelengths.
        cells: of frequency. receptances: (X, F) of the rail over a bay (m/N).
        edges: (B + 1,) of the bands (Hz).
        spacing: of the fastenings (m).
        speed: m/s. forward: towards increasing x.
        mass: of the wheelset (kg). stiffness: of its contact (N/m).
        length: of the line (m).
    """
    spectrum, k = _spectrum(profile)
    lower = 2 * np.pi * edges[0] / speed
    rest = np.cos(0.5 * np.pi * np.clip((1.03 * lower - k) / (0.06 * lower), 0, 1)) ** 2
    omega = k * speed
    series = cells.omega
    felt = cells.smoothed(receptances, 2 * np.pi * speed / spacing)
    gain = 1 / (felt + 1 / stiffness - 1 / (mass * series**2))
    rms = np.sqrt(np.mean(np.abs(gain) ** 2, axis=0))
    mean = gain.mean(axis=0)
    response = -np.interp(omega, series, rms) * np.exp(
        1j * np.interp(omega, series, np.unwrap(np.angle(mean)))
    )
    if not forward:
        response = response.conj()
    inside = rest * (omega <= 2 * np.pi * edges[-1])
    force = spectrum * inside * response
    stride = max(1, int(speed / edges[-1] / 8 / profile.step))
    table = _sampled(profile, force, k, stride)

    step = spacing / PLACES_PER_BAY
    grid = np.arange(math.ceil(length / step) + 1) * step
    x = profile.start + profile.step * np.arange(len(profile.value))
    kernel = np.exp(-0.5 * (k * spacing / 2) ** 2)
    size = _full_size(profile)
    total = np.concatenate(([0.0], np.cumsum(np.abs(force) ** 2)))
    power = total[np.searchsorted(omega, cells.high)] - total[np.searchsorted(omega, cells.low)]
    square = np.zeros((len(grid), len(cells.line)))
    for band, (low, high) in enumerate(itertools.pairwise(edges)):
        chosen = (omega >= 2 * np.pi * low) & (omega < 2 * np.pi * high)
        part = np.fft.irfft(np.where(chosen, force, 0), size)
        smooth = np.fft.irfft(np.fft.rfft(part**2) * kernel, size)
        own = cells.band == band
        share = power[own] / max(power[own].sum(), 1e-300)
        local = np.interp(grid, x, smooth[: len(x)])
        square[:, own] = np.maximum(local, 0.0)[:, None] * share
    return LocalWheel(table, square, step)


@dataclass(frozen=True, eq=False)
class LocalTables:
    """What a run needs of a line's local set.

    Attributes:
        receptances: (X, F) of the rail over a bay (m/N).
        response: (lags, P, N, C) mean square of the velocity (or rate of strain or force) of the
            heard channels per mean square force of a wheel at P places, by group of past frames.
        first: (lags,) lowest cell in which a group of past frames still counts.
    """

    receptances: Complex
    response: NDArray[np.float32]
    first: NDArray[np.intp]


class LocalLine:
    """Energies of the local set on a line, and what its channels show of them.

    Args:
        scenario: line, track, channels.
        crossover: lowest frequency of the local set (Hz).
        frame: time step of the power balance (s).

    Attributes:
        edges: (B + 1,) of the bands (Hz). cells: of frequency.
        segments: number of segments of each layer.
        places: (P,) places of a wheel (m).
        waves: of the rail on its usual fastenings.
    """

    def __init__(self, scenario: Scenario, crossover: float, frame: float) -> None:
        self.scenario, self.frame = scenario, frame
        self.edges, self.cells = local_cells(scenario, crossover, frame)
        self._segment, self.segments = _segments(scenario)
        self._centres: Real = np.linspace(0.5, self.segments - 0.5, self.segments) * self._segment
        self._states = _fastening_states(scenario, self._centres)
        self._common = max(set(self._states), key=self._states.count)
        slab = _slab_beam(scenario.track)
        self._waves = {
            state: RailWaves.of(PeriodicRail.of_track(scenario.track, *state), self.cells, slab)
            for state in sorted(set(self._states))
        }
        self.waves = self._waves[self._common]
        self._channels = [c for c in scenario.channel if is_heard(c)]
        self._mortar: dict[tuple[int, float], float] = {}
        step = scenario.track.fastening.spacing / PLACES_PER_BAY
        count = math.ceil(scenario.line.length / step)
        self.places: Real = np.linspace(0.0, count * step, count + 1)

    def tables(self) -> LocalTables:
        """What a run needs: energy of the line at every lag times what a channel shows of it."""
        groups, cells = len(LAGS) - 1, len(self.cells.line)
        shape = (groups, len(self.places), cells, len(self._channels))
        response = np.zeros(shape, dtype=np.float32)
        if self._channels:
            shown = self._shown()
            second = self.waves.second.mobility > 0
            for cell in range(cells):
                lags, steady = self._energy(cell, self.balance, self.waves.main)
                if second[cell]:
                    more, more_steady = self._energy(cell, self.second_balance, self.waves.second)
                    lags, steady = lags + more, steady + more_steady
                response[:, :, cell] = lags * (shown[:, cell] / np.maximum(steady, 1e-300))
        counts = np.any(response, axis=(1, 3))
        first = np.where(np.any(counts, axis=1), np.argmax(counts, axis=1), cells)
        return LocalTables(self.waves.receptances, response, first)

    def balance(self, cell: int, *, uniform: bool = False) -> PowerBalance:
        """The power balance of one cell: rail, slab, support layer, either direction.

        Args:
            cell: its number.
            uniform: fastenings alike everywhere, and ends that let energy out.
        """
        omega = float(self.cells.centre[cell])
        track = self.scenario.track
        mortar = track.mortar
        states = [self._common] * self.segments if uniform else self._states
        rail = np.array([self._waves[state].main.decay[cell] for state in states])
        speed = np.array([self._waves[state].main.velocity[cell] for state in states])
        on_bridge = np.zeros(self.segments, dtype=bool)
        for left, right in self.scenario.line.span_bounds:
            on_bridge |= (self._centres >= left) & (self._centres <= right)
        slab = _slab_beam(track)
        layers = {
            True: plate_beam(track.support_layer, mortar, track.bed_on_bridge),
            False: plate_beam(track.support_layer, mortar, track.bed_on_subgrade),
        }
        to_layer = {key: self._mortar_flow(cell, slab, beam) for key, beam in layers.items()}
        # what the rail's decay hands to the slab
        given = rail * np.array([self._waves[state].to_slab[cell] for state in states])
        chains = [Chain(speed, rail - given, self._segment)]
        links = [given / math.pi, np.where(on_bridge, to_layer[True], to_layer[False])]
        plate, decay = _speed_and_decay(slab, omega)
        chains.append(
            Chain(np.full(self.segments, plate), np.full(self.segments, decay), self._segment)
        )
        values = {key: _speed_and_decay(beam, omega) for key, beam in layers.items()}
        chains.append(
            Chain(
                np.where(on_bridge, values[True][0], values[False][0]),
                np.where(on_bridge, values[True][1], values[False][1]),
                self._segment,
            )
        )
        return chain_balance(omega, chains, links, open_ends=uniform)

    def second_balance(self, cell: int, *, uniform: bool = False) -> PowerBalance:
        """The power balance of the rail's second wave, which hardly moves the slab."""
        states = [self._common] * self.segments if uniform else self._states
        chain = Chain(
            np.array([self._waves[state].second.velocity[cell] for state in states]),
            np.array([self._waves[state].second.decay[cell] for state in states]),
            self._segment,
        )
        return chain_balance(float(self.cells.centre[cell]), [chain], [], open_ends=uniform)

    def _mortar_flow(self, cell: int, slab: WaveBeam, layer: WaveBeam) -> float:
        """Conductance from slab to support layer (1/m), in the middle of the cell's band."""
        band = int(self.cells.band[cell])
        key = band, layer.support_stiffness
        if key not in self._mortar:
            omega = 2 * math.pi * math.sqrt(self.edges[band] * self.edges[band + 1])
            mortar = self.scenario.track.mortar
            stiffness = mortar.width * complex(mortar.stiffness, omega * mortar.damping)
            self._mortar[key] = bed_conductance(omega, slab, layer, stiffness)
        return self._mortar[key]

    def _energy(
        self, cell: int, balance: Callable[..., PowerBalance], wave: Branch
    ) -> tuple[Real, Real]:
        """Energy of translation per metre at the channels per mean square force, J/(m*N^2).

        The balance is stepped by implicit Euler, which keeps energies positive and closes
        (E' - E)/frame = P - A E' exactly; z' = (1 + frame A)^-T z from the channel's row gives
        the weights of the powers of past frames.

        Returns:
            by lag (lags, X, C); steady on the uniform line without ends (X, C).
        """
        own, free = balance(cell), balance(cell, uniform=True)
        size = 2 * self.segments
        subsystem, weight = self.injection(wave.decay[cell])
        weight = weight * wave.mobility[cell] / 2
        rows = np.array([self._row(c, wave.decay[cell], len(own.loss)) for c in self._channels]).T
        rows[:size] *= wave.transverse[cell]
        unit = sp.eye_array(len(own.loss), format="csc")
        forward = sp.csc_array(free.matrix.T + unit / LIFETIME)
        steady = np.asarray(sp.linalg.splu(forward).solve(rows))[:size]
        backward = sp.csc_array(own.matrix.T)
        left = np.asarray(sp.linalg.splu(backward).solve(rows))[:size]
        enough = TAIL * np.abs(left).sum()
        step = sp.linalg.splu(sp.csc_array(unit + backward * self.frame))
        lags = np.zeros((len(LAGS) - 1, size, rows.shape[1]))
        state = rows
        for group, (begin, end) in enumerate(itertools.pairwise(LAGS)):
            for _ in range(begin, end):
                state = np.asarray(step.solve(state))
                lags[group] += state[:size] * self.frame
            left = left - lags[group]
            if np.abs(left).sum() < enough:
                break
        lags[group] += left

        def at_places(values: Real) -> Real:
            return np.asarray((values[..., subsystem, :] * weight[..., None]).sum(axis=-2))

        return at_places(lags), at_places(steady)

    def injection(self, decay: float) -> tuple[NDArray[np.intp], Real]:
        """Where a wheel at :attr:`places` feeds the chain of a wave: (X, 2), (X, 2).

        It feeds the next segment centre on either side with what reaches it; the mean over
        places of the weights is 1 to either side.

        Args:
            decay: of the wave (1/m).
        """
        count = self.segments
        place = self.places / self._segment - 0.5
        j = np.floor(place).astype(np.intp)
        loss = max(decay * self._segment, 1e-12)
        whole = loss / -np.expm1(-loss)
        # the ends reflect what would pass them
        right = np.where(j + 1 < count, j + 1, 2 * count - 1)
        left = np.where((j >= 0) & (j < count), count + j, np.where(j < 0, 0, 2 * count - 1))
        weight = whole * np.exp(-loss * np.stack((j + 1 - place, place - j), axis=-1))
        return np.stack((right, left), axis=-1), weight

    def _row(self, channel: Channel, decay: float, size: int) -> Real:
        """Energy per metre (J/m) at a channel per energy of every subsystem."""
        row = np.zeros(size)
        layer = {"rail": 0, "slab": 1, "support_layer": 2}[channel.layer]
        base = 2 * layer * self.segments
        if base >= size:
            return row
        x = self._sensor_x(channel)
        place = x / self._segment - 0.5
        j = min(max(math.floor(place), 0), self.segments - 2)
        s = min(max(place - j, 0.0), 1.0)
        if layer == 0:
            # each node speaks for the wave that passes it, carried to the channel
            loss = decay * self._segment
            right = 0.5 * np.exp([-loss * s, loss * (1 - s)])
            left = 0.5 * np.exp([loss * s, -loss * (1 - s)])
        else:
            right = left = np.array([1 - s, s])
        for direction, share in ((0, right), (1, left)):
            at = base + direction * self.segments + j
            row[at : at + 2] = share / self._segment
        return row

    def _sensor_x(self, channel: Channel) -> float:
        """Place (m) of a channel; of its fastening if it shows that one's force."""
        x = self.scenario.channel_x(channel)
        if channel.quantity != "fastening_force":
            return x
        spacing, first = self._bays()
        return first + (round((x - first) / spacing - 0.5) + 0.5) * spacing

    def _bays(self) -> tuple[float, float]:
        """Length of a bay and start of one of them (m); a fastening is in its middle."""
        fastening = self.scenario.track.fastening
        first = fastening.spacing / 2 if fastening.first_offset is None else fastening.first_offset
        return fastening.spacing, first - fastening.spacing / 2

    def _shown(self) -> Real:
        """Mean square of the channels per mean square force of a wheel, (X, N, C).

        Exact for the direct field on the infinite periodic track, mean over the frequencies of
        a cell, velocity kind.
        """
        spacing, first = self._bays()
        omega, cells = self.cells.omega, len(self.cells.line)
        out = np.empty((len(self.places), cells, len(self._channels)))
        inside = (np.arange(PLACES_PER_BAY) + 0.5) / PLACES_PER_BAY * spacing
        groups = [(RING, self.waves.second.mobility <= 0)]
        groups.append((UNDAMPED_RING, ~groups[0][1]))
        beds: dict[bool, Bed] = {True: self.scenario.track.bed_on_bridge}
        beds[False] = self.scenario.track.bed_on_subgrade
        on_bridge = [
            any(a <= self.scenario.channel_x(c) <= b for a, b in self.scenario.line.span_bounds)
            for c in self._channels
        ]
        at = np.floor((self.places - first) / spacing * PLACES_PER_BAY + 1e-9).astype(np.intp)
        for bridge in sorted(set(on_bridge)):
            track = LayeredTrack.of_track(
                self.scenario.track, beds[bridge], *self._common, LIFETIME
            )
            for ring, chosen in groups:
                some = np.repeat(chosen, POINTS_PER_CELL)
                if not some.any():
                    continue
                solution = track.solve(omega[some], ring)
                for c, channel in enumerate(self._channels):
                    if on_bridge[c] != bridge:
                        continue
                    x = self._sensor_x(channel)
                    bay = math.floor((x - first) / spacing)
                    number = at - bay * PLACES_PER_BAY
                    bays = min(int(np.abs(number).max()) // PLACES_PER_BAY + 1, ring // 2 - 1)
                    fields = solution.transfer(
                        channel.layer, channel.quantity, x - first - bay * spacing, inside, bays
                    )
                    square = np.abs(omega[some, None, None] * fields) ** 2
                    mean = square.reshape(chosen.sum(), POINTS_PER_CELL, -1).mean(axis=1)
                    number = np.clip(number + bays * PLACES_PER_BAY, 0, mean.shape[1] - 1)
                    out[:, chosen, c] = mean[:, number].T * self._factor(channel)[chosen] ** 2
        return out

    def _factor(self, channel: Channel) -> Real:
        """Curvature to strain; the stiffness of a fastening that is unlike the usual one: (N,)."""
        centre = self.cells.centre
        if channel.quantity == "strain":
            return np.full(len(centre), abs(channel.fibre))
        factor = {"fastening.stiffness": 1.0, "fastening.damping": 1.0}
        if channel.quantity == "fastening_force":
            row = self._sensor_x(channel)
            for change in self.scenario.track.variation:
                if change.parameter in factor and change.start <= row <= change.end:
                    factor[change.parameter] *= change.factor
        fastening = self.scenario.track.fastening

        def pad(stiffness: float, damping: float) -> Real:
            spring, dashpot = fastening.stiffness * stiffness, fastening.damping * damping
            return np.asarray(np.hypot(spring, centre * dashpot))

        return np.asarray(pad(*factor.values()) / pad(1.0, 1.0))


def local_cells(scenario: Scenario, crossover: float, frame: float) -> tuple[Real, Cells]:
    """Edges (Hz) of the local bands, and cells as wide as frames of 2 ``frame`` (s) part them."""
    nyquist = 0.5 / scenario.solution.step  # its line is no part of the spectrum
    highest = min(BAND_MARGIN * scenario.solution.frequency_limit, nyquist - 0.25 / frame)
    edges = band_edges(crossover, highest)
    return edges, Cells.between(edges, 0.5 / frame)


def local_tables(scenario: Scenario, crossover: float, frame: float) -> LocalTables:
    """Tables of a scenario's line, from the disk cache when it was prepared before."""
    part = scenario.model_dump(mode="json", include={"track", "line", "channel"})
    limit = scenario.solution.frequency_limit
    key = {**part, "local": [LOCAL_FORMAT, crossover, limit, frame]}
    return cached(key, LocalTables, lambda: LocalLine(scenario, crossover, frame).tables())


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _sum_squares(
    response: NDArray[np.float32],
    first: NDArray[np.intp],
    middle: NDArray[np.intp],
    kind: NDArray[np.intp],
    place: NDArray[np.intp],
    square: Real,
    total: Real,
) -> None:
    """total (M, N, C): response (lags, P, N, C) times the wheels' squares (K, P, N), summed.

    kind, place: (H + M, W) of the wheels in H past and M new frames, kind -1 for none; middle:
    (lags,) the past frame that speaks for a group.
    """
    past = kind.shape[0] - total.shape[0]
    for m in range(total.shape[0]):
        for lag in range(middle.size):
            row = past + m - middle[lag]
            for w in range(kind.shape[1]):
                if kind[row, w] < 0:
                    continue
                at = place[row, w]
                own = square[kind[row, w], at]
                table = response[lag, at]
                for n in range(first[lag], total.shape[1]):
                    for c in range(total.shape[2]):
                        total[m, n, c] += table[n, c] * own[n]


class LocalField:
    """Signals of the local set at the channels, frame by frame.

    Args:
        scenario: line, track, channels, seed.
        crossover: lowest frequency of the local set (Hz).
        derivatives: 0, 1, 2 for displacement, velocity, acceleration of the channels.

    Attributes:
        edges: (B + 1,) of the bands (Hz). cells: of frequency.
        hop: samples of a frame.
        heard: (C,) whether a channel has a local part.
        tables: of the line.
    """

    def __init__(self, scenario: Scenario, crossover: float, derivatives: tuple[int, ...]) -> None:
        solution = scenario.solution
        self.step: float = solution.step_ns * 1e-9
        self.hop = max(32, 2 ** round(math.log2(FRAME_TIME / self.step)))
        self.edges, self.cells = local_cells(scenario, crossover, self.frame)
        self.tables = local_tables(scenario, crossover, self.frame)
        self.heard = np.array([is_heard(channel) for channel in scenario.channel], dtype=bool)
        count = int(self.heard.sum())
        seeds = np.random.SeedSequence(solution.seed).spawn(count)
        self._random = [np.random.default_rng(seed) for seed in seeds]
        self._middles = np.array([(a + b - 1) // 2 for a, b in itertools.pairwise(LAGS)])
        # kind and place of the wheels in past frames, oldest first
        self._kind = np.full((int(self._middles[-1]), 0), -1, dtype=np.intp)
        self._place = np.zeros_like(self._kind)
        self._wheels: list[LocalWheel] = []
        self._squares = np.zeros((0, self.tables.response.shape[1], len(self.cells.line)))
        omega = self.cells.line * np.pi / self.frame
        self._factors: Complex = np.array([(1j * omega) ** (d - 1) for d in derivatives])
        self._window = np.sin(np.pi * (np.arange(2 * self.hop) + 0.5) / (2 * self.hop))
        self._overlap = np.zeros((self.hop, len(derivatives), count))
        self._quiet = LAGS[-1]

    @property
    def frame(self) -> float:
        """Time step of the power balance (s)."""
        return float(self.hop * self.step)

    def use(self, wheels: list[LocalWheel]) -> None:
        """Wheels that may be on the line from now on; others are forgotten."""
        number = {id(wheel): i for i, wheel in enumerate(wheels)}
        kept = np.array([number.get(id(wheel), -1) for wheel in self._wheels] + [-1], dtype=np.intp)
        self._kind = kept[self._kind]
        self._wheels = wheels
        self._squares = np.array([wheel.square for wheel in wheels]).reshape(
            len(wheels), *self._squares.shape[1:]
        )

    def mean_squares(self, kind: NDArray[np.intp], place: Real) -> Real:
        """Mean square velocity at the heard channels in the next frames, (M, N, C).

        Args:
            kind: (M, W) index into the wheels in use, -1 off the line. place: (M, W) m.
        """
        last = self.tables.response.shape[1] - 1
        step = self._wheels[0].step if self._wheels else 1.0
        at = np.clip(np.rint(place / step), 0, last).astype(np.intp)
        width = max(kind.shape[1], self._kind.shape[1])

        def joined(past: NDArray[np.intp], new: NDArray[np.intp]) -> NDArray[np.intp]:
            parts = np.full((len(past) + len(new), width), -1, dtype=np.intp)
            parts[: len(past), : past.shape[1]] = past
            parts[len(past) :, : new.shape[1]] = new
            return parts

        kinds, places = joined(self._kind, kind), joined(self._place, at)
        total = np.zeros((len(kind), len(self.cells.line), len(self._random)))
        tables = self.tables
        _sum_squares(
            tables.response, tables.first, self._middles, kinds, places, self._squares, total
        )
        # columns of trains that have left stay while the past tells of them
        used = np.any(kinds[len(kind) :] >= 0, axis=0)
        self._kind, self._place = kinds[len(kind) :, used], places[len(kind) :, used]
        return total

    def next_frames(self, kind: NDArray[np.intp], place: Real) -> Real:
        """Local channel signals of the next frames, (M * hop, D, C).

        Args:
            kind: (M, W) index into the wheels in use, -1 off the line, in the middle of frames.
            place: (M, W) m.
        """
        count, channels, derivatives = len(kind), len(self._random), len(self._factors)
        out = np.zeros((count + 1, self.hop, derivatives, channels))
        out[0] = self._overlap
        if not channels:
            return out[:-1].reshape(-1, derivatives, channels)
        sounding = []
        for number, present in enumerate(np.any(kind >= 0, axis=1).tolist()):
            self._quiet = 0 if present else self._quiet + 1
            if self._quiet <= LAGS[-1]:
                sounding.append(number)
        squares = self.mean_squares(kind, place)[sounding]
        if sounding:
            # irfft of N lines has the variance 2/N^2 sum <|X|^2>, and <|X|^2> = 2 level^2
            level = np.sqrt(squares).transpose(2, 0, 1) * self.hop  # (C, frames, N)
            lines = self.cells.line
            drawn = np.empty(level.shape, dtype=np.complex128)
            for c, random in enumerate(self._random):
                draw = random.standard_normal((len(sounding), 2, len(lines)))
                drawn[c] = level[c] * (draw[:, 0] + 1j * draw[:, 1])
            spectrum = np.zeros((*level.shape[:2], self.hop + 1), dtype=np.complex128)
            for d, factor in enumerate(self._factors):
                spectrum[:, :, lines[0] : lines[-1] + 1] = drawn * factor
                signal = scipy.fft.irfft(spectrum, 2 * self.hop, axis=2) * self._window
                signal = signal.transpose(1, 2, 0)
                out[sounding, :, d] += signal[:, : self.hop]
                out[np.array(sounding) + 1, :, d] += signal[:, self.hop :]
        self._overlap = out[-1].copy()
        return out[:-1].reshape(-1, derivatives, channels)


def _segments(scenario: Scenario) -> tuple[float, int]:
    """Length (m) and number of segments: about one bay each."""
    count = max(4, round(scenario.line.length / scenario.track.fastening.spacing))
    return scenario.line.length / count, count


def _fastening_states(scenario: Scenario, centres: Real) -> list[tuple[float, float]]:
    """Mean factors on fastening stiffness and damping in every segment."""
    states = []
    half = scenario.track.fastening.spacing / 2
    for x in centres:
        factors = {"fastening.stiffness": 1.0, "fastening.damping": 1.0}
        for change in scenario.track.variation:
            if change.parameter in factors:
                covered = min(change.end, x + half) - max(change.start, x - half)
                share = min(max(covered / (2 * half), 0.0), 1.0)
                factors[change.parameter] *= 1 + share * (change.factor - 1)
        states.append(
            (
                round(max(factors["fastening.stiffness"], 1e-3), 3),
                round(max(factors["fastening.damping"], 1e-3), 3),
            )
        )
    return states


def is_heard(channel: Channel) -> bool:
    """Whether a channel has a local part: not on the bridge, no bearing force."""
    if channel.quantity == "bearing_force" or channel.layer == "bridge":
        return False
    return channel.quantity != "fastening_force" or channel.layer in ("rail", "slab")


def _slab_beam(track: Track) -> WaveBeam:
    """Slab between mortar and fastenings, both held at rest at their far side."""
    base, fastening = plate_beam(track.slab, track.mortar), track.fastening
    return replace(
        base,
        support_stiffness=base.support_stiffness + 2 * fastening.stiffness / fastening.spacing,
        support_damping=base.support_damping + 2 * fastening.damping / fastening.spacing,
    )


def _speed_and_decay(beam: WaveBeam, omega: float) -> tuple[float, float]:
    return float(beam.group_velocity(omega)), 2 * float(beam.exponents(omega)[0].real)
