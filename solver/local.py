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
from dataclasses import dataclass, replace

import numpy as np
import scipy.fft
import scipy.sparse as sp
import scipy.sparse.linalg

from .contact import wheelset_law
from .irregularity import Profile
from .scenario import Channel, Contact, Scenario, Track
from .sea import Chain, PowerBalance, bed_conductance, chain_balance, fastening_conductance
from .waves import Complex, PeriodicRail, Real, WaveBeam, plate_beam

BANDS_PER_OCTAVE = 12
"""Resolution of the power balance; the rail's decay changes within a third octave."""

POINTS_PER_BAND = 3
"""Frequencies per band over which wave properties are averaged."""

FRAME_TIME = 6.4e-3
"""Time (s) of one step of the power balance, about; the wheel moves half a metre at 300 km/h."""

TAIL = 1e-3
"""Part of the steady response to a wheel's power that may be moved to the last lag."""

MOST_LAGS = 200

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
    return np.fft.rfft(values), 2 * np.pi * np.fft.rfftfreq(size, profile.step)


def _sampled(profile: Profile, spectrum: Complex, k: Real, stride: int) -> Profile:
    size = _full_size(profile)
    value = np.fft.irfft(spectrum, size)[: len(profile.value) : stride]
    slope = np.fft.irfft(1j * k * spectrum, size)[: len(profile.value) : stride]
    return Profile(profile.start, profile.step * stride, value, slope)


def _full_size(profile: Profile) -> int:
    return int(scipy.fft.next_fast_len(2 * len(profile.value), real=True))


@dataclass(frozen=True, eq=False)
class RailWaves:
    """The rail's waves in every band, for one state of the fastenings.

    Attributes:
        omega: (B, Q) frequencies of the averages (rad/s).
        receptances: (X, B, Q) driving-point receptances over a bay (m/N).
        decay: (B,) energy decay (1/m). velocity: (B,) energy velocity (m/s).
        periodic: the rail on its fastenings.
    """

    omega: Real
    receptances: Complex
    decay: Real
    velocity: Real
    periodic: PeriodicRail

    @classmethod
    def of(cls, periodic: PeriodicRail, edges: Real) -> RailWaves:
        """Waves of a rail in bands of the given edges (Hz)."""
        inside = (np.arange(POINTS_PER_BAND) + 0.5) / POINTS_PER_BAND
        omega = 2 * np.pi * edges[:-1, None] * (edges[1:] / edges[:-1])[:, None] ** inside
        flat = omega.ravel()
        points = periodic.point_receptances(flat).reshape(-1, *omega.shape)
        waves = periodic.travelling(flat)
        return cls(
            omega,
            points,
            waves.decay.reshape(omega.shape).mean(axis=1),
            waves.energy_velocity.reshape(omega.shape).mean(axis=1),
            periodic,
        )


@dataclass(frozen=True, eq=False)
class LocalWheel:
    """Local force of one wheelset of a train, as a table over its place on the line.

    Attributes:
        force: F(x) (N). square: (B, n) mean square per band (N^2), at ``grid``.
        grid: (n,) m.
        power: (B, n) W, power into the rail per band, <F^2> Re Y.
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
    return 1.5 * hertz ** (2 / 3) * load ** (1 / 3)


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
    series = waves.omega.ravel()
    compliance = waves.receptances.reshape(len(waves.receptances), -1)
    compliance = compliance + 1 / stiffness - 1 / (mass * series**2)
    gain = 1 / compliance
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

    shape = (len(compliance), *waves.omega.shape)
    weight = np.abs(gain.reshape(shape)) ** 2
    absorbed = (1j * waves.omega * waves.receptances).real
    conductance = (weight * absorbed).mean(axis=(0, 2)) / weight.mean(axis=(0, 2))

    window = waves.periodic.spacing * 2
    grid = np.arange(0.0, length + 0.2, 0.2)
    square = np.empty((len(edges) - 1, len(grid)))
    x = profile.start + profile.step * np.arange(len(profile.value))
    kernel = np.exp(-0.5 * (k * window / 4) ** 2)
    size = _full_size(profile)
    for band, (low, high) in enumerate(itertools.pairwise(edges)):
        chosen = (omega >= 2 * np.pi * low) & (omega < 2 * np.pi * high)
        part = np.fft.irfft(np.where(chosen, force, 0), size)
        smooth = np.fft.irfft(np.fft.rfft(part**2) * kernel, size)
        square[band] = np.interp(grid, x, smooth[: len(x)])
    square = np.maximum(square, 0.0)
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
        self.step = solution.step_ns * 1e-9
        self.edges = band_edges(crossover, solution.frequency_limit)
        self.hop = max(32, 2 ** round(math.log2(FRAME_TIME / self.step)))
        self.derivatives = derivatives
        self._segment, self.segments = _segments(scenario)
        self._centres = (np.arange(self.segments) + 0.5) * self._segment
        self._states = _fastening_states(scenario, self._centres)
        self._waves = {
            state: RailWaves.of(PeriodicRail.of_track(scenario.track, *state), self.edges)
            for state in sorted(set(self._states))
        }
        common = max(set(self._states), key=self._states.count)
        self.waves = self._waves[common]
        self._decay = np.array([self._waves[state].decay for state in self._states])  # (S, B)
        self._speed = np.array([self._waves[state].velocity for state in self._states])
        self.heard = np.array([_is_heard(channel) for channel in scenario.channel], dtype=bool)
        channels = [c for c in scenario.channel if _is_heard(c)]
        self._near = [self._near_field(c) for c in channels]
        self._kernels = self._listen(channels)  # (B, lags, C, 2S)
        self._scale = np.array([self._factor(c) for c in channels]).reshape(len(channels), -1)
        seeds = np.random.SeedSequence(solution.seed).spawn(len(channels))
        self._random = [np.random.default_rng(seed) for seed in seeds]
        self._past = np.zeros((self._kernels.shape[1], len(self.edges) - 1, 2 * self.segments))
        frequency = np.fft.rfftfreq(2 * self.hop, self.step)
        self._spread = _bin_shares(self.edges, frequency)  # (B, F)
        self._omega = 2 * np.pi * np.maximum(frequency, 1.0)
        self._window = np.sin(np.pi * (np.arange(2 * self.hop) + 0.5) / (2 * self.hop))
        self._overlap = np.zeros((self.hop, len(derivatives), len(channels)))
        self._quiet = 0

    @property
    def frame(self) -> float:
        """Time step of the power balance (s)."""
        return self.hop * self.step

    def balance(self, band: int) -> PowerBalance:
        """The power balance of one band: rail, slab, support layer, either direction."""
        edges = self.edges
        omega = 2 * math.pi * math.sqrt(edges[band] * edges[band + 1])
        track = self.scenario.track
        mortar = track.mortar
        chains = [Chain(self._speed[:, band], self._decay[:, band], self._segment)]
        links = []
        on_bridge = np.zeros(self.segments, dtype=bool)
        for left, right in self.scenario.line.span_bounds:
            on_bridge |= (self._centres >= left) & (self._centres <= right)
        slab, layers = _slab_beam(track), {}
        for bridge, bed in ((True, track.bed_on_bridge), (False, track.bed_on_subgrade)):
            layers[bridge] = plate_beam(track.support_layer, mortar, bed)
        stiffness = mortar.width * complex(mortar.stiffness, omega * mortar.damping)
        to_layer = {
            key: bed_conductance(omega, slab, beam, stiffness) for key, beam in layers.items()
        }
        to_slab = {
            state: _pad_conductance(omega, waves.periodic, slab)
            for state, waves in self._waves.items()
        }
        links.append(np.array([to_slab[state] for state in self._states]))
        links.append(np.array([to_layer[bool(key)] for key in on_bridge]))
        for beams in ([slab] * self.segments, [layers[bool(key)] for key in on_bridge]):
            distinct = {id(b): _speed_and_decay(b, omega) for b in beams}
            values = np.array([distinct[id(b)] for b in beams])
            chains.append(Chain(values[:, 0], values[:, 1], self._segment))
        # the rail's decay holds what it gives to the slab: pi n-per-length conductance
        given = math.pi * links[0]
        chains[0] = replace(chains[0], decay=np.maximum(chains[0].decay - given, 1e-9))
        return chain_balance(omega, chains, links)

    def _listen(self, channels: list[Channel]) -> Real:
        """Mean square velocity at the channels per power into the rail's segments, by lag.

        z' = -A^T z from z(0) = row of the channel; its integrals over the frames are the weights
        of the powers of past frames.
        """
        bands, size = len(self.edges) - 1, 2 * self.segments
        if not channels:
            return np.zeros((bands, 1, 0, size))
        found, longest = [], 1
        for band in range(bands):
            balance = self.balance(band)
            matrix = sp.csc_array(balance.matrix)
            rows = np.array([self._row(c, band, len(balance.loss)) for c in channels])
            steady = sp.linalg.splu(matrix).solve(rows.T.copy(), trans="T").T
            back = sp.csr_array(matrix.T) * -1.0
            lags, state, left = [], rows.T, steady
            while len(lags) < MOST_LAGS:
                state = sp.linalg.expm_multiply(back * self.frame, state)
                rest = sp.linalg.splu(matrix).solve(state.copy(), trans="T").T
                lags.append((left - rest)[:, :size])
                left = rest
                if np.abs(left[:, :size]).sum() < TAIL * np.abs(steady[:, :size]).sum():
                    break
            lags[-1] = lags[-1] + left[:, :size]
            found.append(np.array(lags))
            longest = max(longest, len(lags))
        kernels = np.zeros((bands, longest, len(channels), size))
        for band, lags in enumerate(found):
            kernels[band, : len(lags)] = lags
        return kernels

    def _row(self, channel: Channel, band: int, size: int) -> Real:
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
            loss = float(self._decay[j, band]) * self._segment
            right = 0.5 * np.exp([-loss * s, loss * (1 - s)])
            left = 0.5 * np.exp([loss * s, -loss * (1 - s)])
        else:
            right = left = np.array([1 - s, s])
        for direction, share in ((0, right), (1, left)):
            at = base + direction * self.segments + j
            row[at : at + 2] = share / (mass * self._segment)
        if channel.layer == "rail":
            row *= self._pattern(channel)[band]
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
        """Mean square at the channel's place in the bay relative to the bay's mean, (B,)."""
        x = self.scenario.channel_x(channel)
        if channel.quantity == "fastening_force":
            x = self._nearest_row(x)
        waves = self.waves
        field = waves.periodic.travelling(waves.omega.ravel(), [self._place_in_bay(x)])
        chosen = field.strain_pattern if channel.quantity == "strain" else field.pattern
        return np.asarray(chosen.reshape(waves.omega.shape).mean(axis=1))

    def _near_field(self, channel: Channel) -> tuple[Real, Real] | None:
        """Exact direct field less the travelling wave, per <F^2> of a wheel near the channel.

        Returns:
            positions (m) of the wheel, mean square velocity per square force there (B, n).
        """
        if channel.layer != "rail" or channel.quantity != "motion":
            return None
        periodic, omega = self.waves.periodic, self.waves.omega
        x = self.scenario.channel_x(channel)
        place = self._place_in_bay(x)
        offset = np.arange(-NEAR_BAYS * 8, NEAR_BAYS * 8 + 1) / 8 * periodic.spacing
        flat = omega.ravel()
        exact = np.array(
            [np.abs(flat * periodic.receptance(flat, place + d, place)) ** 2 for d in offset]
        )
        absorbed = (1j * omega * self.waves.receptances).real.mean(axis=0)
        pattern = self._pattern(channel)
        far = absorbed.mean(axis=1) / (2 * periodic.beam.mass_per_length * self.waves.velocity)
        far = far * pattern
        wave = far[:, None] * np.exp(-self.waves.decay[:, None] * np.abs(offset))
        near = exact.T.reshape(*omega.shape, len(offset)).mean(axis=1) - wave
        # leave the far field smoothly
        fade = np.clip((NEAR_BAYS - np.abs(offset) / periodic.spacing) / 0.5, 0, 1)
        return x + offset, near * fade

    def _factor(self, channel: Channel) -> Real:
        """What a channel shows per velocity at its place, (B,); a spectrum of displacement kind."""
        omega = 2 * np.pi * np.sqrt(self.edges[:-1] * self.edges[1:])
        track = self.scenario.track
        if channel.quantity == "strain":
            if channel.layer == "rail":
                return np.full(len(omega), abs(channel.fibre))
            plate = track.slab if channel.layer == "slab" else track.support_layer
            return abs(channel.fibre) * plate_beam(plate).wavenumber(omega) ** 2
        if channel.quantity == "fastening_force":
            pad = 2 * track.fastening.stiffness + 2j * omega * track.fastening.damping
            return np.abs(pad)
        return np.ones(len(omega))

    def powers(self, wheels: list[LocalWheel], places: Real) -> Real:
        """Power into the rail's right and left travelling segments, (B, 2S) W.

        A wheel feeds the next segment centre on either side with what reaches it; the mean over
        places is the whole power.
        """
        bands, count = len(self.edges) - 1, self.segments
        power = np.zeros((bands, 2 * count))
        for wheel, x in zip(wheels, places, strict=True):
            if not 0 <= x <= self.scenario.line.length:
                continue
            column = round(x / 0.2)
            put = wheel.power[:, min(column, len(wheel.grid) - 1)] / 2
            place = x / self._segment - 0.5
            j = math.floor(place)
            loss = self._decay[min(max(j, 0), count - 1)] * self._segment
            whole = loss / -np.expm1(-loss)
            right, left = j + 1, count + j
            if right >= count:  # reflected by the end before it meets a centre
                right = 2 * count - 1
            if j < 0:
                left = 0
            power[:, right] += put * whole * np.exp(-loss * (j + 1 - place))
            power[:, left] += put * whole * np.exp(-loss * (place - j))
        return power

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
        elif self._quiet > len(self._past):
            out, self._overlap = self._overlap, np.zeros_like(self._overlap)
            return out
        else:
            self._quiet += 1
        self._past = np.roll(self._past, 1, axis=0)
        self._past[0] = self.powers(wheels, places)
        square = np.einsum("blcs,lbs->cb", self._kernels, self._past, optimize=True)
        for c, near in enumerate(self._near):
            if near is None:
                continue
            positions, table = near
            for wheel, x in zip(wheels, places, strict=True):
                if positions[0] <= x <= positions[-1]:
                    column = round((x - positions[0]) / (positions[1] - positions[0]))
                    force = wheel.square[:, min(round(x / 0.2), len(wheel.grid) - 1)]
                    square[c] += table[:, column] * force
        square = np.maximum(square, 0.0) * self._scale**2
        # irfft of N bins has the variance 2/N^2 sum <|X|^2>, and <|X|^2> = 2 level^2
        level = np.sqrt(square @ self._spread) * self.hop
        spectrum = np.empty(level.shape, dtype=np.complex128)
        for c, random in enumerate(self._random):
            draw = random.standard_normal((2, level.shape[1]))
            spectrum[c] = level[c] * (draw[0] + 1j * draw[1])
        out = self._overlap.copy()
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


def _pad_conductance(omega: float, rail: PeriodicRail, slab: WaveBeam) -> float:
    smeared = replace(rail.beam, support_damping=rail.damping / rail.spacing)
    pad = complex(rail.stiffness, omega * rail.damping)
    return fastening_conductance(omega, smeared, slab, 1j * omega / pad, rail.spacing)


def _speed_and_decay(beam: WaveBeam, omega: float) -> tuple[float, float]:
    return float(beam.group_velocity(omega)), 2 * float(beam.exponents(omega)[0].real)


def _bin_shares(edges: Real, frequency: Real) -> Real:
    """Share of every band's mean square that falls into every bin of a spectrum, (B, F)."""
    half = (frequency[1] - frequency[0]) / 2
    low = np.maximum(edges[:-1, None], frequency - half)
    high = np.minimum(edges[1:, None], frequency + half)
    overlap = np.maximum(high - low, 0.0)
    return np.asarray(overlap / overlap.sum(axis=1, keepdims=True))
