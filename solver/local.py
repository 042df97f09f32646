"""The local set above the crossover: wheel forces, powers, energies and a random signal.

- Wheel force: F = -r/(alpha_w + 1/k_H + alpha_r) with the direct-field receptance alpha_r of the
  rail on its fastenings (mean over a bay), alpha_w = -1/(m_w omega^2), k_H the contact stiffness,
  tangential at the static load: the blocked-force and direct-forcing terms of Eqs. (5), (6), (11).
- Power into the rail: P = <F^2> Re Y per band and wheel, half to either side.
- Energies: Eq. (12) in time over chains of one-bay segments of rail, slab and support layer.
- Signal: noise of the band whose mean square is the energy's, v^2 = E/M, a^2 = omega^2 v^2.

With complex modes as the global set the local set is orthogonal to it, so that Eq. (13), power
from the global motion, is zero; all power comes from the wheels.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np
import scipy.fft
import scipy.sparse as sp
import scipy.sparse.linalg
from numpy.typing import NDArray

from .contact import wheelset_law
from .irregularity import Profile
from .scenario import Channel, Contact, Scenario, Track
from .sea import Chain, PowerBalance, bed_conductance, chain_balance
from .waves import BlochSolution, Complex, PeriodicRail, Real, WaveBeam, plate_beam

BANDS_PER_OCTAVE = 6

POINTS_PER_BAND = 60
"""Frequencies per band over which wave properties are averaged: every 10 Hz at 5 kHz."""

DECAY_CLASS = 1.25
"""Frequencies of a band whose decays differ by more than this factor keep separate balances.

Near the higher pinned-pinned frequencies the rail's decay falls and its motion gathers in
mid-bay: one mean decay for such a band errs by up to 8 dB at 10 m.
"""

BAND_MARGIN = 1.15
"""Highest local frequency per frequency limit: as far as the fe model keeps its modes."""

REFERENCE_DISTANCE = 5.0
"""Distance (m) at which the mean decay of a band is exact."""

FRAME_TIME = 6.4e-3
"""Time (s) of one step of the power balance, about; the wheel moves half a metre at 300 km/h."""

TAIL = 5e-3
"""Part of the steady response to a wheel's power that may be moved to the last lag."""

MOST_LAGS = 8

GRID = 0.2
"""Distance (m) of the points at which the power of a wheel is tabled."""

NEAR_BAYS = 2.5
"""Bays on either side of a wheel where the rail's exact direct field replaces the far field."""


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
    """Groups of frequencies that share one power balance.

    Attributes:
        omega: (F,) all frequencies (rad/s), POINTS_PER_BAND in each band.
        of: (F,) cell of each. band: (N,) band of each cell.
        centre: (N,) mean frequency of each cell (rad/s).
    """

    omega: Real
    of: NDArray[np.intp]
    band: NDArray[np.intp]
    centre: Real

    @classmethod
    def split(cls, edges: Real, decay: Real) -> Cells:
        """Part every band by decay.

        Args:
            edges: (B + 1,) Hz. decay: (F,) 1/m at :func:`band_frequencies`.
        """
        omega = band_frequencies(edges)
        cell = np.empty(omega.size, dtype=np.intp)
        band: list[int] = []
        for b, part in enumerate(np.split(np.arange(omega.size), len(edges) - 1)):
            step = np.floor(
                np.log(decay[part] / np.median(decay[part])) / math.log(DECAY_CLASS) + 0.5
            )
            for value in np.unique(step):
                cell[part[step == value]] = len(band)
                band.append(b)
        count = np.bincount(cell)
        return cls(omega, cell, np.array(band, dtype=np.intp), np.bincount(cell, omega) / count)

    def sum(self, values: Real) -> Real:
        """Sum over the frequencies of each cell, (F,) to (N,)."""
        return np.bincount(self.of, values, len(self.band)).astype(np.float64)

    def band_mean(self, values: Real) -> Real:
        """Mean over the band of each cell, (F,) to (N,)."""
        return np.asarray(values.reshape(-1, POINTS_PER_BAND).mean(axis=1)[self.band])


def band_frequencies(edges: Real) -> Real:
    """Angular frequencies (rad/s) over which wave properties are averaged, (F,)."""
    inside = (np.arange(POINTS_PER_BAND) + 0.5) / POINTS_PER_BAND
    ratio = (edges[1:] / edges[:-1])[:, None]
    return np.asarray((2 * np.pi * edges[:-1, None] * ratio**inside).ravel())


@dataclass(frozen=True, eq=False)
class RailWaves:
    """The rail's waves, for one state of the fastenings.

    Means over a cell are those of a wheel's power: weights Re Y/|alpha_r + 1/k_H|^2, so that a
    sharp resonance between the fastenings counts as it radiates.

    Attributes:
        solution: Bloch waves at the frequencies of the cells.
        cells: groups of frequencies.
        receptances: (X, F) driving-point receptances over a bay (m/N).
        weights: (F,) of travelling energy, sum 1 in each cell.
        share: (F,) part of a wheel's power that travels away.
        decay: (N,) energy decay (1/m). velocity: (N,) energy velocity (m/s).
        to_slab: (N,) part of the power into the rail that its fastenings hand to the slab.
    """

    solution: BlochSolution
    cells: Cells
    receptances: Complex
    weights: Real
    share: Real
    decay: Real
    velocity: Real
    to_slab: Real

    @classmethod
    def of(
        cls,
        periodic: PeriodicRail,
        edges: Real,
        stiffness: float,
        slab: WaveBeam,
        cells: Cells | None = None,
    ) -> RailWaves:
        """Waves of a rail in bands of the given edges (Hz).

        Args:
            periodic: the rail.
            edges: (B + 1,) Hz.
            stiffness: of the contact of a wheelset (N/m), for the weights.
            slab: beam below the fastenings.
            cells: groups of frequencies; unset: made from this rail's decay.
        """
        omega = band_frequencies(edges)
        solution = periodic.solve(omega)
        waves = solution.travelling()
        cells = cells or Cells.split(edges, waves.decay)
        loads = periodic.load_positions(12)
        points = np.stack([solution.receptance(x, x) for x in loads])
        radiated = (1j * omega * points).real / np.abs(points + 1 / stiffness) ** 2
        power = radiated.mean(axis=0) * waves.share
        energy = power / waves.energy_velocity
        weights = energy / cells.sum(energy)[cells.of]
        left = cells.sum(weights * np.exp(-waves.decay * REFERENCE_DISTANCE))
        chosen = slice(1, None, 4)
        share = sum(
            _slab_share(solution, slab, float(x)) * part
            for x, part in zip(loads[chosen], radiated[chosen], strict=True)
        ) / radiated[chosen].sum(axis=0)
        return cls(
            solution,
            cells,
            points,
            weights,
            waves.share,
            -np.log(left) / REFERENCE_DISTANCE,
            cells.sum(power) / cells.sum(energy),
            cells.sum(power * share) / cells.sum(power),
        )

    @property
    def periodic(self) -> PeriodicRail:
        """The rail on its fastenings."""
        return self.solution.rail


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
        force: F(x) (N). square: (N, n) mean square of the cells' bands (N^2), at ``grid``.
        grid: (n,) m.
        power: (N, n) W, power into the rail per cell, <F^2> Re Y.
    """

    force: Profile
    grid: Real
    square: Real
    power: Real


def contact_stiffness(contact: Contact, radius: float, load: float) -> float:
    """Stiffness (N/m) of a wheelset's contact at its static load (N)."""
    linear, hertz = wheelset_law(contact, radius)
    if hertz == 0:
        return linear
    return float(1.5 * hertz ** (2 / 3) * load ** (1 / 3))


def local_wheel(
    profile: Profile,
    waves: RailWaves,
    edges: Real,
    speed: float,
    forward: bool,
    mass: float,
    stiffness: float,
    length: float,
) -> LocalWheel:
    """Force and power of a wheelset that runs over an irregularity at constant speed.

    Args:
        profile: irregularity (m), all wavelengths.
        waves: of the rail.
        edges: (B + 1,) of the bands (Hz).
        speed: m/s. forward: towards increasing x.
        mass: of the wheelset (kg). stiffness: of its contact (N/m).
        length: of the line (m).
    """
    spectrum, k = _spectrum(profile)
    lower = 2 * np.pi * edges[0] / speed
    rest = np.cos(0.5 * np.pi * np.clip((1.03 * lower - k) / (0.06 * lower), 0, 1)) ** 2
    omega = k * speed
    cells = waves.cells
    series = cells.omega
    gain = 1 / (waves.receptances + 1 / stiffness - 1 / (mass * series**2))
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

    weight = np.abs(gain) ** 2
    radiated = (weight * (1j * series * waves.receptances).real).mean(axis=0)
    conductance = (
        cells.sum(radiated * waves.share) / POINTS_PER_BAND / cells.band_mean(weight.mean(axis=0))
    )

    window = waves.periodic.spacing * 2
    grid = np.arange(0.0, length + GRID, GRID)
    square = np.empty((len(edges) - 1, len(grid)))
    x = profile.start + profile.step * np.arange(len(profile.value))
    kernel = np.exp(-0.5 * (k * window / 4) ** 2)
    size = _full_size(profile)
    for band, (low, high) in enumerate(itertools.pairwise(edges)):
        chosen = (omega >= 2 * np.pi * low) & (omega < 2 * np.pi * high)
        part = np.fft.irfft(np.where(chosen, force, 0), size)
        smooth = np.fft.irfft(np.fft.rfft(part**2) * kernel, size)
        square[band] = np.interp(grid, x, smooth[: len(x)])
    square = np.maximum(square, 0.0)[cells.band]
    return LocalWheel(table, grid, square, square * conductance[:, None])


class LocalField:
    """Energies and signals of the local set on a line, listened to at the channels.

    Args:
        scenario: line, track, channels, seed.
        crossover: lowest frequency of the local set (Hz).
        derivatives: 0, 1, 2 for displacement, velocity, acceleration of the channels.

    Attributes:
        edges: (B + 1,) of the bands (Hz).
        hop: samples per step of the power balance.
        waves: of the rail.
        heard: (C,) whether a channel has a local part.
        segments: number of segments of each layer.
    """

    def __init__(self, scenario: Scenario, crossover: float, derivatives: tuple[int, ...]) -> None:
        solution = scenario.solution
        self.scenario = scenario
        self.step: float = solution.step_ns * 1e-9
        self.edges = band_edges(crossover, BAND_MARGIN * solution.frequency_limit)
        self.hop = max(32, 2 ** round(math.log2(FRAME_TIME / self.step)))
        self.derivatives = derivatives
        self._segment, self.segments = _segments(scenario)
        self._centres = ((np.arange(self.segments) + 0.5) * self._segment).astype(np.float64)
        self._states = _fastening_states(scenario, self._centres)
        common = max(set(self._states), key=self._states.count)
        self.waves = self._solve(common, None)
        self._waves = {common: self.waves}
        for state in sorted(set(self._states) - {common}):
            self._waves[state] = self._solve(state, self.waves.cells)
        self._decay = np.array([self._waves[state].decay for state in self._states])  # (S, N)
        self._speed = np.array([self._waves[state].velocity for state in self._states])
        self.heard = np.array([_is_heard(channel) for channel in scenario.channel], dtype=bool)
        channels = [c for c in scenario.channel if _is_heard(c)]
        self._mortar: dict[tuple[int, float], float] = {}
        self._near = [self._near_field(c) for c in channels]
        self._kernels = self._listen(channels)  # (lags, 2S, N, C)
        self._scale = np.array([self._factor(c) for c in channels]).reshape(len(channels), -1)
        seeds = np.random.SeedSequence(solution.seed).spawn(len(channels))
        self._random = [np.random.default_rng(seed) for seed in seeds]
        self._past: deque[tuple[NDArray[np.intp], Real]] = deque(maxlen=MOST_LAGS)
        frequency = np.fft.rfftfreq(2 * self.hop, self.step).astype(np.float64)
        self._spread = _bin_shares(self.waves, frequency)  # (N, bins)
        self._omega = 2 * np.pi * np.maximum(frequency, 1.0)
        self._window = np.sin(np.pi * (np.arange(2 * self.hop) + 0.5) / (2 * self.hop))
        self._overlap = np.zeros((self.hop, len(derivatives), len(channels)))
        self._quiet = 0

    def _solve(self, state: tuple[float, float], cells: Cells | None) -> RailWaves:
        return RailWaves.of(
            PeriodicRail.of_track(self.scenario.track, *state),
            self.edges,
            2 * self.scenario.contact.stiffness,
            _slab_beam(self.scenario.track),
            cells,
        )

    @property
    def frame(self) -> float:
        """Time step of the power balance (s)."""
        return float(self.hop * self.step)

    def balance(self, cell: int) -> PowerBalance:
        """The power balance of one cell: rail, slab, support layer, either direction."""
        omega = float(self.waves.cells.centre[cell])
        track = self.scenario.track
        mortar = track.mortar
        chains = [Chain(self._speed[:, cell], self._decay[:, cell], self._segment)]
        links = []
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
        share = np.array([self._waves[state].to_slab[cell] for state in self._states])
        given = self._decay[:, cell] * share
        chains[0] = replace(chains[0], decay=self._decay[:, cell] - given)
        links.append(given / math.pi)
        links.append(np.where(on_bridge, to_layer[True], to_layer[False]))
        speed, decay = _speed_and_decay(slab, omega)
        chains.append(
            Chain(np.full(self.segments, speed), np.full(self.segments, decay), self._segment)
        )
        values = {key: _speed_and_decay(beam, omega) for key, beam in layers.items()}
        chains.append(
            Chain(
                np.where(on_bridge, values[True][0], values[False][0]),
                np.where(on_bridge, values[True][1], values[False][1]),
                self._segment,
            )
        )
        return chain_balance(omega, chains, links)

    def _mortar_flow(self, cell: int, slab: WaveBeam, layer: WaveBeam) -> float:
        """Conductance from slab to support layer (1/m), in the middle of the cell's band."""
        band = int(self.waves.cells.band[cell])
        key = band, layer.support_stiffness
        if key not in self._mortar:
            omega = 2 * math.pi * math.sqrt(self.edges[band] * self.edges[band + 1])
            mortar = self.scenario.track.mortar
            stiffness = mortar.width * complex(mortar.stiffness, omega * mortar.damping)
            self._mortar[key] = bed_conductance(omega, slab, layer, stiffness)
        return self._mortar[key]

    def _listen(self, channels: list[Channel]) -> Real:
        """Mean square velocity at the channels per power into the rail's segments, by lag.

        The balance is stepped by implicit Euler, which keeps energies positive and closes
        (E' - E)/frame = P - A E' exactly; z' = (1 + frame A)^-T z from the channel's row gives
        the weights of the powers of past frames. Shape (lags, 2S, N, C).
        """
        cells, size = len(self.waves.decay), 2 * self.segments
        kernels = np.zeros((MOST_LAGS, size, cells, len(channels)))
        if not channels:
            return kernels
        patterns = [self._pattern(c) if c.layer == "rail" else np.ones(cells) for c in channels]
        for cell in range(cells):
            balance = self.balance(cell)
            backward = sp.csc_array(balance.matrix.T)
            rows = np.array([self._row(c, cell, len(balance.loss)) for c in channels])
            rows *= np.array([pattern[cell] for pattern in patterns])[:, None]
            left = np.asarray(sp.linalg.splu(backward).solve(rows.T.copy()))
            enough = TAIL * np.abs(left[:size]).sum()
            unit = sp.eye_array(len(balance.loss), format="csc")
            step = sp.linalg.splu(sp.csc_array(unit + backward * self.frame))
            state = rows.T.copy()
            for lag in range(MOST_LAGS):
                state = np.asarray(step.solve(state))
                weights = state * self.frame
                left = left - weights
                kernels[lag, :, cell] = weights[:size]
                if np.abs(left[:size]).sum() < enough:
                    break
            kernels[lag, :, cell] += left[:size]
        return kernels

    def _row(self, channel: Channel, cell: int, size: int) -> Real:
        """Mean square velocity (m^2/s^2) at a channel per energy of every subsystem."""
        row = np.zeros(size)
        layer = {"rail": 0, "slab": 1, "support_layer": 2}[channel.layer]
        x = self.scenario.channel_x(channel)
        place = x / self._segment - 0.5
        j = min(max(math.floor(place), 0), self.segments - 2)
        s = min(max(place - j, 0.0), 1.0)
        track = self.scenario.track
        mass = (
            2 * track.rail.mass_per_length,
            track.slab.mass_per_length,
            track.support_layer.mass_per_length,
        )[layer]
        base = 2 * layer * self.segments
        if layer == 0:
            # each node speaks for the wave that passes it, carried to the channel
            loss = float(self._decay[j, cell]) * self._segment
            right = 0.5 * np.exp([-loss * s, loss * (1 - s)])
            left = 0.5 * np.exp([loss * s, -loss * (1 - s)])
        else:
            right = left = np.array([1 - s, s])
        for direction, share in ((0, right), (1, left)):
            at = base + direction * self.segments + j
            row[at : at + 2] = share / (mass * self._segment)
        return row

    def _place_in_bay(self, x: float) -> float:
        fastening = self.scenario.track.fastening
        first = fastening.spacing / 2 if fastening.first_offset is None else fastening.first_offset
        return float((x - first + fastening.spacing / 2) % fastening.spacing)

    def _nearest_row(self, x: float) -> float:
        fastening = self.scenario.track.fastening
        first = fastening.spacing / 2 if fastening.first_offset is None else fastening.first_offset
        return first + round((x - first) / fastening.spacing) * fastening.spacing

    def _pattern(self, channel: Channel) -> Real:
        """Mean square at the channel's place in the bay relative to the bay's mean, (N,)."""
        x = self.scenario.channel_x(channel)
        if channel.quantity == "fastening_force":
            x = self._nearest_row(x)
        waves = self.waves
        field = waves.solution.travelling([self._place_in_bay(x)])
        chosen = field.strain_pattern if channel.quantity == "strain" else field.pattern
        return waves.cells.sum(chosen[:, 0] * waves.weights)

    def _near_field(self, channel: Channel) -> tuple[Real, Real] | None:
        """Exact direct field less the travelling wave, per <F^2> of a wheel near the channel.

        Returns:
            positions (m) of the wheel, mean square velocity per square force there (N, n).
        """
        if channel.layer != "rail" or channel.quantity != "motion":
            return None
        waves, periodic = self.waves, self.waves.periodic
        cells, solution, omega = waves.cells, waves.solution, waves.cells.omega
        soft = 1 / (2 * self.scenario.contact.stiffness)
        x = self.scenario.channel_x(channel)
        place = self._place_in_bay(x)
        offset = np.arange(-NEAR_BAYS * 8, NEAR_BAYS * 8 + 1) / 8 * periodic.spacing
        gain = 1 / np.abs(waves.receptances + soft) ** 2
        mean_gain = cells.band_mean(gain.mean(axis=0)) * POINTS_PER_BAND
        exact = np.empty((len(cells.band), len(offset)))
        for i, d in enumerate(offset):
            at = solution.receptance(place + d, place + d)
            speed = np.abs(omega * solution.receptance(place + d, place)) ** 2
            exact[:, i] = cells.sum(speed / np.abs(at + soft) ** 2) / mean_gain
        power = ((1j * omega * waves.receptances).real * gain).mean(axis=0) * waves.share
        power = cells.sum(power) / mean_gain
        far = power / (2 * periodic.beam.mass_per_length * waves.velocity) * self._pattern(channel)
        near = exact - far[:, None] * np.exp(-waves.decay[:, None] * np.abs(offset))
        # leave the far field smoothly
        fade = np.clip((NEAR_BAYS - np.abs(offset) / periodic.spacing) / 0.5, 0, 1)
        return x + offset, near * fade

    def _factor(self, channel: Channel) -> Real:
        """What a channel shows per velocity at its place, (N,); a spectrum of displacement kind."""
        omega = self.waves.cells.centre
        track = self.scenario.track
        if channel.quantity == "strain":
            if channel.layer == "rail":
                return abs(channel.fibre) * omega  # the pattern is curvature per velocity
            plate = track.slab if channel.layer == "slab" else track.support_layer
            return abs(channel.fibre) * plate_beam(plate).wavenumber(omega) ** 2
        if channel.quantity == "fastening_force":
            row = self._nearest_row(self.scenario.channel_x(channel))
            pad = 2 * track.fastening.stiffness + 2j * omega * track.fastening.damping
            for change in track.variation:
                if change.start <= row <= change.end:
                    if change.parameter == "fastening.stiffness":
                        pad = pad.real * change.factor + 1j * pad.imag
                    elif change.parameter == "fastening.damping":
                        pad = pad.real + 1j * pad.imag * change.factor
            return np.asarray(np.abs(pad))
        return np.ones(len(omega))

    def powers(self, wheels: list[LocalWheel], places: Real) -> tuple[NDArray[np.intp], Real]:
        """Power of wheels on the line into the rail's travelling segments.

        A wheel feeds the next segment centre on either side with what reaches it; the mean over
        places is the whole power.

        Returns:
            subsystems (2 wheels,), powers (2 wheels, N) W.
        """
        count = self.segments
        subsystems = np.empty(2 * len(wheels), dtype=np.intp)
        power = np.empty((2 * len(wheels), len(self.waves.decay)))
        for i, (wheel, x) in enumerate(zip(wheels, places, strict=True)):
            put = wheel.power[:, min(round(x / GRID), len(wheel.grid) - 1)] / 2
            place = x / self._segment - 0.5
            j = math.floor(place)
            loss = self._decay[min(max(j, 0), count - 1)] * self._segment
            whole = put * loss / -np.expm1(-loss)
            # the ends reflect what would pass them
            subsystems[2 * i] = j + 1 if j + 1 < count else 2 * count - 1
            subsystems[2 * i + 1] = count + j if j >= 0 else 0
            power[2 * i] = whole * np.exp(-loss * (j + 1 - place))
            power[2 * i + 1] = whole * np.exp(-loss * (place - j))
        return subsystems, power

    def next_frame(self, wheels: list[LocalWheel], places: Real) -> Real:
        """Local channel signals of the next ``hop`` samples, (hop, D, C).

        Args:
            wheels: those on the line, places: (m) in the middle of the frame.
        """
        channels = len(self._random)
        if not channels:
            return np.zeros((self.hop, len(self.derivatives), 0))
        if wheels:
            self._quiet = 0
        elif self._quiet > MOST_LAGS:
            tail, self._overlap = self._overlap, np.zeros_like(self._overlap)
            return tail
        else:
            self._quiet += 1
        self._past.appendleft(self.powers(wheels, places))
        square = np.zeros((channels, len(self.waves.decay)))
        for kernel, (subsystems, power) in zip(self._kernels, self._past, strict=False):
            square += np.einsum("knc,kn->cn", kernel[subsystems], power)
        for c, near in enumerate(self._near):
            if near is None:
                continue
            positions, table = near
            for wheel, x in zip(wheels, places, strict=True):
                if positions[0] <= x <= positions[-1]:
                    column = round((x - positions[0]) / (positions[1] - positions[0]))
                    force = wheel.square[:, min(round(x / GRID), len(wheel.grid) - 1)]
                    square[c] += table[:, column] * force
        square = np.maximum(square, 0.0) * self._scale**2
        # irfft of N bins has the variance 2/N^2 sum <|X|^2>, and <|X|^2> = 2 level^2
        level = np.sqrt(square @ self._spread) * self.hop
        spectrum = np.empty(level.shape, dtype=np.complex128)
        for c, random in enumerate(self._random):
            draw = random.standard_normal((2, level.shape[1]))
            spectrum[c] = level[c] * (draw[0] + 1j * draw[1])
        out: Real = self._overlap.copy()
        for d, derivative in enumerate(self.derivatives):
            shaped = spectrum * (1j * self._omega) ** (derivative - 1)
            signal = np.fft.irfft(shaped, 2 * self.hop, axis=1).T * self._window[:, None]
            out[:, d] += signal[: self.hop]
            self._overlap[:, d] = signal[self.hop :]
        return out


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


def _is_heard(channel: Channel) -> bool:
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


def _bin_shares(waves: RailWaves, frequency: Real) -> Real:
    """Share of every cell's mean square that falls into every bin of a spectrum, (N, bins)."""
    cells = waves.cells
    bins = np.round(cells.omega / (2 * np.pi) / (frequency[1] - frequency[0])).astype(np.intp)
    shares = np.zeros((len(cells.band), len(frequency)))
    np.add.at(shares, (cells.of, np.minimum(bins, len(frequency) - 1)), waves.weights)
    return shares
