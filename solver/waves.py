"""Waves in beams and in a rail on fastenings: dispersion, mobility, direct field.

Time factor exp(+i omega t). A beam carries ``w`` (deflection) and ``theta`` (rotation),

    kGA (w' - theta)' + Z w = -f,          Z = m omega^2 - k' - i omega c'
    EI theta'' + kGA (w' - theta) + rho I omega^2 theta = 0,

so exp(s x) needs ``EI s^4 + (Z EI/kGA + rho I omega^2) s^2 + Z (rho I omega^2/kGA - 1) = 0``
(Timoshenko 1921; Euler-Bernoulli for kGA -> infinity and rho I = 0: EI s^4 = Z).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import InputError
from .scenario import Bed, Layer, Plate, Quantity, Track

Real = NDArray[np.float64]
Complex = NDArray[np.complex128]


def _pad_points(spacing: float, length: float) -> list[tuple[float, float]]:
    """Places (m) in a bay and weights of the points at which a pad of some length (m) acts."""
    middle = spacing / 2
    if length == 0:
        return [(middle, 1.0)]
    nodes, weights = np.polynomial.legendre.leggauss(4)
    return [
        (middle + length / 2 * float(node), float(weight) / 2)
        for node, weight in zip(nodes, weights, strict=True)
    ]


@dataclass(frozen=True, slots=True)
class WaveBeam:
    """An infinite uniform beam, on a uniform elastic support if that is given.

    Attributes:
        bending_stiffness: EI (N*m^2).
        mass_per_length: m (kg/m).
        shear_stiffness: kappa G A (N); infinite means Euler-Bernoulli.
        rotary_inertia: rho I (kg*m).
        support_stiffness: k' (N/m^2).
        support_damping: c' (N*s/m^2).
    """

    bending_stiffness: float
    mass_per_length: float
    shear_stiffness: float = math.inf
    rotary_inertia: float = 0.0
    support_stiffness: float = 0.0
    support_damping: float = 0.0

    def inertia_term(self, omega: ArrayLike) -> Complex:
        """Z = m omega^2 - k' - i omega c' (N/m^2), shape of ``omega`` (rad/s)."""
        w = np.asarray(omega, dtype=np.float64)
        return self.mass_per_length * w**2 - self.support_stiffness - 1j * w * self.support_damping

    def exponents(self, omega: ArrayLike) -> Complex:
        """Decaying exponents s (1/m): the field is a sum of exp(-s |x|).

        Returns:
            Shape ``(..., 2)``: first the travelling wave (s = i q + decay), then the near field.
        """
        w = np.asarray(omega, dtype=np.float64)
        z = self.inertia_term(w)
        rotary = self.rotary_inertia * w**2
        b = z * self.bending_stiffness / self.shear_stiffness + rotary
        c = z * (rotary / self.shear_stiffness - 1)
        root = np.sqrt(b * b - 4 * self.bending_stiffness * c)
        squares = np.stack((-b - root, -b + root), axis=-1) / (2 * self.bending_stiffness)
        s = np.sqrt(squares)
        flip = (s.real < 0) | ((np.abs(s.real) < 1e-12 * np.abs(s)) & (s.imag < 0))
        s = np.where(flip, -s, s)
        # Travelling first: the exponent with the larger phase per metre.
        order = np.argsort(-np.abs(s.imag) / np.abs(s), axis=-1, kind="stable")
        return np.take_along_axis(s, order, axis=-1)

    def wavenumber(self, omega: ArrayLike) -> Real:
        """Real wavenumber q of the travelling wave (rad/m), shape of ``omega`` (rad/s)."""
        return np.abs(self.exponents(omega)[..., 0].imag)

    def group_velocity(self, omega: ArrayLike) -> Real:
        """c_g = d omega / d q of the undamped beam (m/s), shape of ``omega`` (rad/s)."""
        w = np.asarray(omega, dtype=np.float64)
        bare = WaveBeam(
            self.bending_stiffness,
            self.mass_per_length,
            self.shear_stiffness,
            self.rotary_inertia,
            self.support_stiffness,
        )
        h = 1e-4
        return np.asarray(2 * h * w / (bare.wavenumber(w * (1 + h)) - bare.wavenumber(w * (1 - h))))

    def modal_density(self, omega: ArrayLike, length: float) -> Real:
        """n = L / (pi c_g), modes per rad/s (Lyon and DeJong 1995, one-dimensional systems)."""
        return length / (np.pi * self.group_velocity(omega))

    def transfer_receptance(self, omega: ArrayLike, distance: ArrayLike) -> Complex:
        """Displacement at ``distance`` (m) per point force (m/N), infinite beam.

        Residues of the Fourier integral over the wavenumber; at distance zero and for
        Euler-Bernoulli this is -(1 + i)/(4 EI q^3).
        """
        w, x = np.broadcast_arrays(
            np.asarray(omega, dtype=np.float64), np.asarray(distance, dtype=np.float64)
        )
        s = self.exponents(w)
        square = s**2
        numerator = (
            self.bending_stiffness * square / self.shear_stiffness
            - 1
            + (self.rotary_inertia * w**2 / self.shear_stiffness)[..., None]
        )
        gap = self.bending_stiffness * (square - square[..., ::-1])
        waves = numerator / gap * np.exp(-s * np.abs(x)[..., None]) / (2 * s)
        return np.asarray(waves.sum(axis=-1))

    def point_mobility(self, omega: ArrayLike) -> Complex:
        """Velocity per force at the driven point, Y = i omega alpha (m/(N*s))."""
        w = np.asarray(omega, dtype=np.float64)
        return 1j * w * self.transfer_receptance(w, 0.0)


def rail_beam(track: Track) -> WaveBeam:
    """Both rails as one free beam, theory as the track states it."""
    rail = track.rail
    modulus, inertia = rail.young_modulus, 2 * rail.second_moment
    if rail.theory == "euler_bernoulli":
        return WaveBeam(modulus * inertia, 2 * rail.mass_per_length)
    shear = modulus / (2 * (1 + rail.poisson_ratio))
    density = rail.mass_per_length / rail.area
    return WaveBeam(
        modulus * inertia,
        2 * rail.mass_per_length,
        rail.shear_coefficient * shear * 2 * rail.area,
        density * inertia,
    )


def plate_beam(plate: Plate, *beds: Bed) -> WaveBeam:
    """A concrete layer held by the beds that touch it, their far sides at rest."""
    return WaveBeam(
        plate.bending_stiffness,
        plate.mass_per_length,
        support_stiffness=sum(bed.stiffness * bed.width for bed in beds),
        support_damping=sum(bed.damping * bed.width for bed in beds),
    )


def rail_frequency(track: Track, wavenumber: float) -> float:
    """Frequency (Hz) at which the free rail has a wavenumber (rad/m), its first branch."""
    rail, q2 = rail_beam(track), wavenumber**2
    ei, m = rail.bending_stiffness, rail.mass_per_length
    if math.isinf(rail.shear_stiffness):
        return math.sqrt(ei / m) * q2 / (2 * math.pi)
    g, r = rail.shear_stiffness, rail.rotary_inertia
    # m r w^4 - (m EI q^2 + g m + g r q^2) w^2 + g EI q^4 = 0
    a, b, c = m * r, m * ei * q2 + g * m + g * r * q2, g * ei * q2 * q2
    return math.sqrt((b - math.sqrt(b * b - 4 * a * c)) / (2 * a)) / (2 * math.pi)


def pinned_pinned_frequency(track: Track) -> float:
    """First pinned-pinned frequency of the rail between two fastenings (Hz).

    The half wave pi/a of the free rail; exact for both beam theories, because a sine satisfies
    the pinned ends.
    """
    return rail_frequency(track, math.pi / track.fastening.spacing)


@dataclass(frozen=True, slots=True)
class BlochField:
    """A travelling Bloch wave at every frequency.

    Attributes:
        decay: energy decay along the track, power ~ exp(-decay x) (1/m), shape (F,).
        energy_velocity: power / (m' <v^2> + rho I <theta'^2>), means over a bay of transverse and
            rotational motion, twice the kinetic energy (m/s), shape (F,).
        transverse: m' <v^2> per m' <v^2> + rho I <theta'^2>, shape (F,).
        share: part of a load's power, mean over the bay, that this wave takes; the rest stays in
            the near field, shape (F,).
    """

    decay: Real
    energy_velocity: Real
    transverse: Real
    share: Real


@dataclass(frozen=True, slots=True)
class PeriodicRail:
    """An infinite rail on equal discrete supports: exact by Bloch waves (Floquet).

    The bay is [0, spacing) with its support at spacing / 2, spread over ``pad_length``.

    Attributes:
        beam: the free rail.
        spacing: distance of the supports (m).
        stiffness: stiffness of a support (N/m).
        damping: dashpot of a support (N*s/m).
        pad_length: length over which a support acts (m).
        foundation: beam under the supports, whose point receptance is in series, or None.
    """

    beam: WaveBeam
    spacing: float
    stiffness: float
    damping: float
    pad_length: float = 0.0
    foundation: WaveBeam | None = None

    def __post_init__(self) -> None:
        """Refuse a pad longer than the bay."""
        if self.pad_length >= self.spacing:
            raise InputError(
                f"track.fastening.pad_length = {self.pad_length} m must be less than "
                f"track.fastening.spacing = {self.spacing} m"
            )

    @classmethod
    def of_track(
        cls, track: Track, stiffness_factor: float = 1.0, damping_factor: float = 1.0
    ) -> PeriodicRail:
        """Both rails of a track on their fastenings, slab on mortar as foundation."""
        fastening = track.fastening
        return cls(
            rail_beam(track),
            fastening.spacing,
            2 * fastening.stiffness * stiffness_factor,
            2 * fastening.damping * damping_factor,
            fastening.pad_length,
            plate_beam(track.slab, track.mortar),
        )

    def support_stiffness(self, omega: ArrayLike) -> Complex:
        """Dynamic stiffness of a support, foundation in series (N/m)."""
        w = np.asarray(omega, dtype=np.float64)
        pad = np.asarray(self.stiffness + 1j * w * self.damping, dtype=np.complex128)
        if self.foundation is None:
            return pad
        return np.asarray(pad / (1 + pad * self.foundation.transfer_receptance(w, 0.0)))

    def _carry(self, omega: Real, length: float) -> Complex:
        """Transfer matrices of (w, theta, V, M) over a free length, shape (F, 4, 4)."""
        s = self.beam.exponents(omega)
        roots = np.concatenate((s, -s), axis=-1)
        z = self.beam.inertia_term(omega)[:, None]
        theta = roots + z / roots / self.beam.shear_stiffness
        shapes = np.stack(
            (
                np.ones_like(roots),
                theta,
                -z / roots,
                self.beam.bending_stiffness * roots * theta,
            ),
            axis=1,
        )
        moved = shapes * np.exp(roots * length)[:, None, :]
        return np.asarray(moved @ np.linalg.inv(shapes))

    def _to(self, omega: Real, x: float) -> Complex:
        """State at x in the bay from the state at the bay's start, shape (F, 4, 4)."""
        stiffness = self.support_stiffness(omega)
        total = np.broadcast_to(np.eye(4, dtype=np.complex128), (omega.size, 4, 4)).copy()
        place = 0.0
        for support, share in _pad_points(self.spacing, self.pad_length):
            if support > x:
                break
            total = self._carry(omega, support - place) @ total
            total[:, 2, :] += share * stiffness[:, None] * total[:, 0, :]
            place = support
        return np.asarray(self._carry(omega, x - place) @ total)

    def solve(self, omega: ArrayLike) -> BlochSolution:
        """The Bloch waves at frequencies (rad/s), ready for many loads and places.

        Raises:
            InputError: a frequency that is not positive.
        """
        return BlochSolution(self, np.atleast_1d(np.asarray(omega, dtype=np.float64)))

    def receptance(self, omega: ArrayLike, load: float, place: float) -> Complex:
        """See :meth:`BlochSolution.receptance`."""
        return self.solve(omega).receptance(load, place)

    def load_positions(self, count: int = 12) -> Real:
        """Equally weighted positions of a load over one bay (m), shape (count,)."""
        return (np.arange(count) + 0.5) * self.spacing / count

    def point_receptances(self, omega: ArrayLike, count: int = 12) -> Complex:
        """Driving-point receptances over one bay (m/N), shape (count, F)."""
        solution = self.solve(omega)
        return np.stack([solution.receptance(x, x) for x in self.load_positions(count)])

    def travelling(self, omega: ArrayLike) -> BlochField:
        """See :meth:`BlochSolution.travelling`."""
        return self.solve(omega).travelling()


class BlochSolution:
    """Bloch waves of a :class:`PeriodicRail` at given frequencies.

    Args:
        rail: the rail on its supports.
        omega: (F,) rad/s, positive.
    """

    def __init__(self, rail: PeriodicRail, omega: Real) -> None:
        if not np.all(omega > 0):
            raise InputError(f"omega = {omega.min():g} rad/s: must be positive")
        self.rail = rail
        self.omega = omega
        q = np.abs(rail.beam.exponents(omega)[:, 0])
        ei = rail.beam.bending_stiffness
        # scaling the state keeps the eigenproblem well conditioned
        self._scale = np.stack((np.ones_like(q), q, ei * q**3, ei * q**2), axis=-1)
        self._paths: dict[float, Complex] = {}
        period = self._to(rail.spacing) * self._scale[:, None, :] / self._scale[:, :, None]
        values, vectors = np.linalg.eig(period)
        # |mu| falls: left near, left travelling, right travelling, right near
        order = np.argsort(-np.abs(values), axis=-1)[:, [2, 3, 1, 0]]
        vectors = np.take_along_axis(vectors, order[:, None, :], axis=-1)
        self.values = np.take_along_axis(values, order, axis=-1)
        self.states = vectors * self._scale[:, :, None]
        self._amplitudes: dict[float, Complex] = {}

    def _to(self, x: float) -> Complex:
        x = round(x, 9)
        if x not in self._paths:
            self._paths[x] = self.rail._to(self.omega, x)
        return self._paths[x]

    def _excite(self, load: float) -> Complex:
        """Amplitudes (F, 4) of the four waves for a unit force at ``load`` in the bay."""
        load = round(load, 9)
        if load not in self._amplitudes:
            jump = np.zeros((self.omega.size, 4, 1), dtype=np.complex128)
            jump[:, 2, 0] = -1.0
            scaled = (self._to(load) @ self.states) / self._scale[:, :, None]
            scaled[:, :, 2:] *= -1
            solved = np.linalg.solve(scaled, jump / self._scale[:, :, None])
            self._amplitudes[load] = solved[:, :, 0]
        return self._amplitudes[load]

    def receptance(self, load: float, place: float) -> Complex:
        """Displacement at ``place`` per point force at ``load`` (m/N), shape (F,).

        Both in m from the start of one bay, whose support is at spacing / 2.
        """
        spacing = self.rail.spacing
        shift = math.floor(load / spacing) * spacing
        load, place = load - shift, place - shift
        bay = math.floor(place / spacing)
        inside = place - bay * spacing
        side = slice(0, 2) if place >= load else slice(2, 4)
        weights = (self._excite(load) * self.values**bay)[:, side, None]
        return np.asarray((self._to(inside)[:, :1] @ self.states[:, :, side] @ weights)[:, 0, 0])

    def support_receptances(self, load: float, bays: int) -> Complex:
        """Displacement of the rail at the supports of the bays -bays ... bays, (F, 2 bays + 1)."""
        middle = self.rail.spacing / 2
        number = np.arange(-bays, bays + 1)
        shape = (self._to(middle)[:, :1] @ self.states)[:, 0] * self._excite(load)
        first = 0 if middle >= load else 1
        out = np.empty((self.omega.size, len(number)), dtype=np.complex128)
        for right, side in ((True, slice(0, 2)), (False, slice(2, 4))):
            chosen = number >= first if right else number < first
            powers = self.values[:, side, None] ** number[chosen]
            out[:, chosen] = (shape[:, side, None] * powers).sum(axis=1)
        return out

    def travelling(self, second: bool = False) -> BlochField:
        """Decay, energy velocity and share of the Bloch wave that carries most of the power.

        Args:
            second: of the other right-going wave. Above sqrt(kGA/rho I) a Timoshenko beam has a
                second travelling wave; below, and in an Euler-Bernoulli beam, it is a near field.
        """
        rail, row = self.rail, np.arange(self.omega.size)
        carried, given = self._carried()
        chosen = np.argmax(carried, axis=0)
        if second:
            chosen = 1 - chosen
        wave = self.states[row, :, chosen]
        decay = -2 * np.log(np.abs(self.values[row, chosen])) / rail.spacing

        def square(place: float) -> Real:
            # Removing the mean decay leaves the periodic part of the wave.
            state = (self._to(place)[:, :2] @ wave[:, :, None])[:, :, 0]
            speed = np.abs(self.omega[:, None] * state) ** 2
            return np.asarray(speed * np.exp(decay * place)[:, None])

        mean = np.mean([square(float(place)) for place in rail.load_positions(24)], axis=0)
        transverse = rail.beam.mass_per_length * mean[:, 0]
        energy = transverse + rail.beam.rotary_inertia * mean[:, 1]
        # The rail itself loses nothing: the power falls in one step at the support in mid-bay.
        # With the smooth decay removed its mean over the bay is the factor sinh(h)/h.
        h = decay * rail.spacing / 2
        mean_power = self._power(wave) * np.sinh(h) / h
        share = np.clip(carried[chosen, row] / given, 0.0, 1.0)
        return BlochField(decay, mean_power / energy, transverse / energy, share)

    def _power(self, wave: Complex) -> Real:
        """Power (twice the mean) that passes the start of the bay towards +x, (F,)."""
        velocity = 1j * self.omega[:, None] * wave[:, :2]
        passed = wave[:, 2] * velocity[:, 0].conj() + wave[:, 3] * velocity[:, 1].conj()
        return np.asarray(-passed.real)

    def _carried(self) -> tuple[Real, Real]:
        """Power (2, F) that a load hands to the right-going waves, half of all it gives (F,)."""
        carried = np.zeros((2, self.omega.size))
        given = np.zeros(self.omega.size)
        for load in self.rail.load_positions(6):
            amplitude = np.abs(self._excite(float(load))) ** 2
            given += (1j * self.omega * self.receptance(float(load), float(load))).real / 2
            for j in (0, 1):
                # amplitudes refer to the bay's start; the support in mid-bay takes its part
                passed = np.abs(self.values[:, j]) ** 2 if load > self.rail.spacing / 2 else 1.0
                carried[j] += amplitude[:, j] * self._power(self.states[:, :, j]) * passed
        return carried, given


@dataclass(frozen=True, slots=True)
class Waves:
    """A field of decaying waves, sum of ``amplitude * exp(-exponent |x|)`` per unit force at 0.

    Attributes:
        amplitude, exponent: (F, K); the exponents in 1/m.
    """

    amplitude: Complex
    exponent: Complex

    def comb(self, offset: float, period: Complex, spacing: float) -> Complex:
        """sum over n of the field at n spacing + offset times period^-n, (F, N).

        Args:
            offset: m, less than the spacing either way.
            period: (N,) exp(i kappa spacing) of wavenumbers kappa.
        """
        total: Complex = np.zeros((len(self.exponent), len(period)), dtype=np.complex128)
        for j in range(self.exponent.shape[1]):
            s = self.exponent[:, j, None]
            pass_on = np.exp(-s * spacing)
            ahead, behind = pass_on / period, pass_on * period
            total += self.amplitude[:, j, None] * (
                np.exp(-s * abs(offset))
                + np.exp(-s * offset) * ahead / (1 - ahead)
                + np.exp(s * offset) * behind / (1 - behind)
            )
        return total


@dataclass(frozen=True, slots=True)
class LayeredTrack:
    """Infinite periodic track: rail, fastenings, slab, mortar, support layer, bed.

    Exact by a Floquet transform of the fastenings' forces over one Brillouin zone. Slab and
    layer are Euler-Bernoulli beams, the ground or girder below the bed is at rest.

    Attributes:
        rail: the free rail.
        spacing: of the fastenings (m), one in the middle of every bay [0, spacing).
        stiffness, damping: of a fastening (N/m, N*s/m), both rails.
        pad_length: length over which a fastening acts (m).
        slab, layer: the free plates.
        mortar, bed: what joins slab and layer, and layer and ground.
    """

    rail: WaveBeam
    spacing: float
    stiffness: float
    damping: float
    pad_length: float
    slab: WaveBeam
    layer: WaveBeam
    mortar: Bed
    bed: Bed

    @classmethod
    def of_track(
        cls,
        track: Track,
        bed: Bed,
        stiffness_factor: float = 1.0,
        damping_factor: float = 1.0,
        lifetime: float = math.inf,
    ) -> LayeredTrack:
        """A track on one of its beds.

        Args:
            track: its properties.
            bed: below the support layer.
            stiffness_factor, damping_factor: on its fastenings.
            lifetime: time (s) in which the energy of the free rail falls to 1/e.
        """
        fastening = track.fastening
        rail = rail_beam(track)
        return cls(
            replace(rail, support_damping=rail.mass_per_length / lifetime),
            fastening.spacing,
            2 * fastening.stiffness * stiffness_factor,
            2 * fastening.damping * damping_factor,
            fastening.pad_length,
            plate_beam(track.slab),
            plate_beam(track.support_layer),
            track.mortar,
            bed,
        )

    def rail_waves(self, omega: Real) -> Waves:
        """Deflection of the free rail per point force on it."""
        beam = self.rail
        s = beam.exponents(omega)
        square = s**2
        numerator = (
            beam.bending_stiffness * square / beam.shear_stiffness
            - 1
            + (beam.rotary_inertia * omega**2 / beam.shear_stiffness)[:, None]
        )
        gap = beam.bending_stiffness * (square - square[:, ::-1])
        return Waves(numerator / gap / (2 * s), s)

    def plate_waves(self, omega: Real) -> tuple[Waves, Waves]:
        """Deflection of slab and of support layer per point force on the slab.

        With D = EI kappa^4 + k - m omega^2 of either plate, k the springs that touch it, the slab
        moves by D_f/(D_s D_f - k_m^2), the layer by k_m/(D_s D_f - k_m^2); partial fractions in
        kappa^4, each with four roots.
        """
        mortar = self.mortar.width * (self.mortar.stiffness + 1j * omega * self.mortar.damping)
        bed = self.bed.width * (self.bed.stiffness + 1j * omega * self.bed.damping)
        ei_s, ei_f = self.slab.bending_stiffness, self.layer.bending_stiffness
        c_s = (mortar - self.slab.mass_per_length * omega**2) / ei_s
        c_f = (mortar + bed - self.layer.mass_per_length * omega**2) / ei_f
        coupling = mortar**2 / (ei_s * ei_f)
        root = np.sqrt(np.asarray((c_s - c_f) ** 2 + 4 * coupling, dtype=np.complex128))
        fourth = np.stack((-c_s - c_f - root, -c_s - c_f + root), axis=-1) / 2
        gap = fourth - fourth[:, ::-1]
        slab = (fourth + c_f[:, None]) / (ei_s * gap)
        layer = (mortar / (ei_s * ei_f))[:, None] / gap
        s = np.sqrt(np.sqrt(fourth))
        s = np.stack((s, 1j * s), axis=-1)
        s = np.where(s.real < 0, -s, s).reshape(len(omega), 4)
        single = np.asarray(-1 / (4 * s**3), dtype=np.complex128)
        return (
            Waves(single * np.repeat(slab, 2, axis=1), s),
            Waves(single * np.repeat(layer, 2, axis=1), s),
        )

    def solve(self, omega: Real, ring: int = 512) -> LayeredSolution:
        """The track at frequencies (rad/s), repeating after ``ring`` bays."""
        return LayeredSolution(self, np.asarray(omega, dtype=np.float64), ring)


class LayeredSolution:
    """Transfer functions of a :class:`LayeredTrack` at given frequencies.

    Args:
        track: the track.
        omega: (F,) rad/s.
        ring: bays after which the track repeats; must be long against the decay of its waves.
    """

    def __init__(self, track: LayeredTrack, omega: Real, ring: int) -> None:
        self.track, self.omega, self.ring = track, omega, ring
        self._period = np.exp(2j * np.pi * (np.arange(ring) + 0.5) / ring)
        self._rail = track.rail_waves(omega)
        self._slab, self._layer = track.plate_waves(omega)
        self._pads = _pad_points(track.spacing, track.pad_length)
        self._combs: dict[float, Complex] = {}
        pad = track.stiffness + 1j * omega * track.damping
        count = len(self._pads)
        self._joint = np.empty((len(omega), ring, count, count), dtype=np.complex128)
        for p, (at, share) in enumerate(self._pads):
            for q, (source, _) in enumerate(self._pads):
                self._joint[:, :, p, q] = self._of(self._rail, at - source)
                self._joint[:, :, p, q] += self._of(self._slab, at - source)
            self._joint[:, :, p, p] += (1 / (share * pad))[:, None]

    def _of(self, waves: Waves, offset: float) -> Complex:
        return waves.comb(offset, self._period, self.track.spacing)

    def _rail_comb(self, offset: float) -> Complex:
        offset = round(offset, 9)
        if offset not in self._combs:
            self._combs[offset] = self._of(self._rail, offset)
        return self._combs[offset]

    def transfer(
        self,
        layer: Layer,
        quantity: Quantity,
        place: float,
        loads: Real,
        bays: int,
    ) -> Complex:
        """What a sensor shows per point force on the rail, (F, 2 bays + 1, P).

        By reciprocity: the rail's field of a unit source at the sensor.

        Args:
            layer: rail, slab or support_layer.
            quantity: motion (m/N), strain (curvature, 1/(m*N)) or force of the fastening of the
                sensor's bay (N/N).
            place: of the sensor in its bay (m).
            loads: (P,) of the force in a bay (m); bays -bays ... bays from the sensor's.
        """
        own: Waves | None = None
        sign = 1.0
        if quantity == "fastening_force":
            driven = np.ones((*self._joint.shape[:3], 1), dtype=np.complex128)
        else:
            own = {"rail": self._rail, "slab": self._slab}.get(layer, self._layer)
            if quantity == "strain":
                factor = own.exponent**2
                if layer == "rail":
                    beam = self.track.rail
                    factor = factor + beam.inertia_term(self.omega)[:, None] / beam.shear_stiffness
                own = Waves(own.amplitude * factor, own.exponent)
            driven = np.stack([self._of(own, at - place) for at, _ in self._pads], axis=-1)
            driven = driven[..., None]
            sign = -1.0 if layer == "rail" else 1.0
        if len(self._pads) > 1:
            forces = np.linalg.solve(self._joint, driven)[..., 0]
        else:
            forces = driven[..., 0] / self._joint[..., 0]
        number = np.arange(-bays, bays + 1)
        phase = np.exp(1j * np.pi * number / self.ring)
        out = np.empty((len(self.omega), len(number), len(loads)), dtype=np.complex128)
        for i, load in enumerate(loads):
            field = np.zeros(self._joint.shape[:2], dtype=np.complex128)
            for p, (at, _) in enumerate(self._pads):
                field += sign * self._rail_comb(float(load) - at) * forces[..., p]
            if own is not None and layer == "rail":
                field += self._of(own, float(load) - place)
            out[:, :, i] = np.fft.ifft(field, axis=1)[:, number] * phase
        return out
