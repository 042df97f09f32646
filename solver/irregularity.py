"""Irregularity of the running surface r(x), positive down, and out-of-round wheels.

Spectra are one-sided, S(k) in m^2/(rad/m) over the wavenumber k in rad/m:

- ``sato``: S = A/k^3 (Sato, QR of RTRI 18(3), 1977), 0.005-0.25 m.
- ``tbt3352``: Chinese ballastless track, vertical, S(f) = a/f^b piecewise over f in 1/m and S in
  mm^2/(1/m) (TB/T 3352-2014), 2-200 m.
- ``german_low``: low disturbance, S = A c^2/((k^2 + r^2)(k^2 + c^2)) with A = 4.032e-7 m rad,
  c = 0.8246 rad/m, r = 0.0206 rad/m, 1-80 m.
- ``iso3095``: limit spectrum of ISO 3095:2013 in third octaves of wavelength, as tabulated in
  Directive (EU) 2015/996, Table G-1; 0.00315-0.4 m.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicSpline

from .errors import InputError
from .scenario import Defect, Irregularity

Array = NDArray[np.float64]

PERIOD = 1024.0
"""Least length (m) after which the realisation of a spectrum repeats itself."""

POINTS_PER_WAVE = 10
"""Samples of the stored profile per shortest wavelength; cubic Hermite error below 5e-4 of it."""

WAVELENGTHS = {
    "sato": (0.005, 0.25),
    "tbt3352": (2.0, 200.0),
    "german_low": (1.0, 80.0),
    "iso3095": (0.00315, 0.4),
}
"""Shortest and longest wavelength (m) of each spectrum."""

_TBT3352 = (
    (0.0, 1.0544e-5, 3.3891),
    (0.0187, 3.5588e-3, 1.9271),
    (0.0474, 1.9784e-2, 1.3643),
    (0.1533, 3.9488e-4, 3.4516),
)
# dB re 1 um, third octaves from 0.4 m downwards
_ISO3095_LEVEL = (
    *(17.1, 15.0, 13.0, 11.0, 9.0, 7.0, 4.9, 2.9, 0.9, -1.1, -3.2),
    *(-5.0, -5.6, -6.2, -6.8, -7.4, -8.0, -8.6, -9.2, -9.8, -10.4, -11.0),
)


def spectrum(irregularity: Irregularity, wavenumber: ArrayLike) -> Array:
    """One-sided power spectral density S(k) (m^2/(rad/m)) at wavenumbers (rad/m)."""
    k: Array = np.asarray(wavenumber, dtype=np.float64)
    name = irregularity.spectrum
    if name == "sato":
        return np.asarray(irregularity.roughness_coefficient / k**3)
    if name == "german_low":
        cut, slow = 0.8246**2, 0.0206**2
        return np.asarray(4.032e-7 * cut / ((k**2 + slow) * (k**2 + cut)))
    if name == "tbt3352":
        f = k / (2 * math.pi)
        edges, factors, powers = (np.array(column) for column in zip(*_TBT3352, strict=True))
        piece = np.searchsorted(edges, f, side="right") - 1
        return np.asarray(factors[piece] * f ** -powers[piece] * 1e-6 / (2 * math.pi))
    if name == "iso3095":
        centres = 0.4 * 10 ** (-0.1 * np.arange(len(_ISO3095_LEVEL)))
        level = np.interp(np.log(2 * math.pi / k), np.log(centres[::-1]), _ISO3095_LEVEL[::-1])
        bandwidth = k * (10**0.05 - 10**-0.05)
        return np.asarray(1e-12 * 10 ** (level / 10) / bandwidth)
    raise ValueError("the irregularity has no spectrum")


def wavelengths(irregularity: Irregularity) -> tuple[float, float] | None:
    """Shortest and longest wavelength (m) that the irregularity contains; None if it has none."""
    if irregularity.spectrum is not None:
        shortest, longest = WAVELENGTHS[irregularity.spectrum]
        shortest = irregularity.wavelength_min or shortest
        longest = irregularity.wavelength_max or longest
        if shortest >= longest:
            raise InputError(
                f"irregularity: wavelengths from {shortest:g} m to {longest:g} m leave nothing of "
                f'spectrum "{irregularity.spectrum}": set wavelength_min below wavelength_max'
            )
        return shortest, longest
    if irregularity.components is not None and irregularity.components.wavenumber:
        k = irregularity.components.wavenumber
        return 2 * math.pi / max(k), 2 * math.pi / min(k)
    return None


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _hermite(x: Array, start: float, step: float, value: Array, slope: Array, out: Array) -> None:
    last = value.size - 2
    for i in range(x.size):
        place = (x[i] - start) / step
        cell = min(max(math.floor(place), 0), last)
        t = min(max(place - cell, 0.0), 1.0)
        s = 1.0 - t
        out[i] = s * s * ((1.0 + 2.0 * t) * value[cell] + t * step * slope[cell]) + t * t * (
            (3.0 - 2.0 * t) * value[cell + 1] - s * step * slope[cell + 1]
        )


@dataclass(frozen=True, slots=True)
class Profile:
    """r(x) and r'(x) sampled on an even grid, between them cubic; constant outside.

    Attributes:
        start: x of the first point (m).
        step: distance of the points (m).
        value: (n,) m, positive down.
        slope: (n,) m/m.
    """

    start: float
    step: float
    value: Array
    slope: Array

    def __call__(self, x: ArrayLike) -> Array:
        """r (m) at ``x`` (m), same shape."""
        points = np.ascontiguousarray(x, dtype=np.float64)
        out = np.empty(points.size)
        _hermite(points.ravel(), self.start, self.step, self.value, self.slope, out)
        return out.reshape(points.shape)


def _realisation(
    irregularity: Irregularity, x: Array, step: float, length: float
) -> tuple[Array, Array]:
    """Random-phase sum of cosines by FFT: amplitude sqrt(2 S dk) each, phases from the seed.

    The components are multiples of 2 pi / period and anchored at x = 0, so that the profile does
    not depend on how much of it is asked for.
    """
    bounds = wavelengths(irregularity)
    assert bounds is not None
    points = 2 ** math.ceil(math.log2(max(PERIOD, 2 * length, 2 * bounds[1]) / step))
    period = points * step
    dk = 2 * math.pi / period
    first = max(1, math.ceil(2 * math.pi / bounds[1] / dk - 1e-9))
    last = math.floor(2 * math.pi / bounds[0] / dk + 1e-9)
    k = dk * np.arange(first, last + 1)
    random = np.random.default_rng(irregularity.seed)
    phases = random.uniform(0, 2 * math.pi, k.size)
    modulus = np.sqrt(2 * spectrum(irregularity, k) * dk)
    amplitude = np.zeros(points // 2 + 1, dtype=np.complex128)
    amplitude[first : last + 1] = 0.5 * points * modulus * np.exp(1j * phases)
    where = np.round(x / step).astype(np.intp) % points
    value = np.fft.irfft(amplitude, points)[where]
    amplitude[first : last + 1] *= 1j * k
    return value, np.fft.irfft(amplitude, points)[where]


def _file_profile(path: str, x: Array, length: float) -> tuple[Array, Array]:
    try:
        table = np.loadtxt(Path(path), ndmin=2)
    except OSError as error:
        raise InputError(f"irregularity.profile = {path!r}: cannot be read: {error}") from None
    except ValueError as error:
        raise InputError(
            f"irregularity.profile = {path!r}: must hold two columns of numbers, x [m] and r [m]: "
            f"{error}"
        ) from None
    if table.shape[1] != 2 or table.shape[0] < 2:
        raise InputError(
            f"irregularity.profile = {path!r}: has {table.shape[0]} rows and {table.shape[1]} "
            "columns; two columns, x [m] and r [m], and at least two rows are needed"
        )
    if not np.isfinite(table).all():
        row = int(np.flatnonzero(~np.isfinite(table).all(axis=1))[0]) + 1
        raise InputError(f"irregularity.profile = {path!r}: row {row} is not finite")
    if not (np.diff(table[:, 0]) > 0).all():
        row = int(np.flatnonzero(np.diff(table[:, 0]) <= 0)[0]) + 2
        raise InputError(
            f"irregularity.profile = {path!r}: x must increase, but row {row} has x = "
            f"{table[row - 1, 0]:g} m after {table[row - 2, 0]:g} m"
        )
    if table[0, 0] > 0 or table[-1, 0] < length:
        raise InputError(
            f"irregularity.profile = {path!r}: covers x = {table[0, 0]:g} to {table[-1, 0]:g} m, "
            f"but the line runs from 0 to {length:g} m: the profile must cover it"
        )
    curve = CubicSpline(table[:, 0], table[:, 1])
    inside = (x >= table[0, 0]) & (x <= table[-1, 0])
    clipped = np.clip(x, table[0, 0], table[-1, 0])
    return curve(clipped), np.where(inside, curve(clipped, 1), 0.0)


def _defect(defect: Defect, x: Array) -> tuple[Array, Array]:
    """Depth and slope of a defect: dip d/2 (1 + cos(2 pi s/L)), joint d (1 - 2|s|/L)."""
    s = x - defect.x
    inside = np.abs(s) <= defect.length / 2
    if defect.shape == "joint":
        value = defect.depth * (1 - 2 * np.abs(s) / defect.length)
        slope = -2 * defect.depth / defect.length * np.sign(s)
    else:
        wave = defect.wavelength or defect.length
        if defect.wavelength is not None:
            waves = defect.length / wave
            if waves < 0.5 or abs(waves - round(waves)) > 1e-6:
                raise InputError(
                    f"irregularity.defect: corrugation of length {defect.length:g} m and "
                    f"wavelength {wave:g} m: the length must be a whole number of wavelengths"
                )
        k = 2 * math.pi / wave
        start = s + defect.length / 2
        value = 0.5 * defect.depth * (1 - np.cos(k * start))
        slope = 0.5 * defect.depth * k * np.sin(k * start)
    return np.where(inside, value, 0.0), np.where(inside, slope, 0.0)


def _grid_step(irregularity: Irregularity) -> float:
    steps = [0.05]
    bounds = wavelengths(irregularity)
    if bounds is not None:
        steps.append(bounds[0] / POINTS_PER_WAVE)
    if irregularity.profile is not None:
        steps.append(1e-3)
    for defect in irregularity.defect:
        steps.append((defect.wavelength or defect.length) / 40)
    # a power of two, so that the realisation of a spectrum depends on few things
    return float(2.0 ** math.floor(math.log2(min(steps))))


def build_profile(irregularity: Irregularity, start: float, end: float, length: float) -> Profile:
    """The irregularity sampled from ``start`` to ``end`` (m) on a line of ``length`` (m).

    Raises:
        InputError: the profile file is missing or wrong, or wavelengths leave nothing.
    """
    step = _grid_step(irregularity)
    first, last = math.floor(start / step) - 1, math.ceil(end / step) + 1
    if last - first > 50_000_000:
        raise InputError(
            f"irregularity: {(end - start):g} m in steps of {step:g} m are {last - first} points; "
            "at most 50 million: raise irregularity.wavelength_min or shorten the line"
        )
    x: Array = step * np.arange(first, last + 1, dtype=np.float64)
    value, slope = np.zeros(x.size), np.zeros(x.size)
    if irregularity.spectrum is not None:
        value, slope = _realisation(irregularity, x, step, length)
    elif irregularity.profile is not None:
        value, slope = _file_profile(irregularity.profile, x, length)
    elif irregularity.components is not None:
        parts = irregularity.components
        for k, a, phi in zip(parts.wavenumber, parts.amplitude, parts.phase, strict=True):
            value += a * np.cos(k * x + phi)
            slope -= a * k * np.sin(k * x + phi)
    for defect in irregularity.defect:
        depth, rise = _defect(defect, x)
        value += depth
        slope += rise
    return Profile(float(x[0]), step, value, slope)


def wheel_defect(
    travelled: Array, radius: float, flat_length: float, order: int, amplitude: float
) -> Array:
    """Lowering (m) of a wheelset by a flat and a polygon, over the distance it has rolled (m).

    Flat: d(s) = L^2/(16 R) (1 - cos(2 pi s/L)) for 0 <= s <= L once per revolution; polygon:
    amplitude * cos(order * angle). Both act like an irregularity of the rail, positive down.
    """
    circumference = 2 * math.pi * radius
    s = np.mod(travelled, circumference)
    lowering = amplitude * np.cos(order * s / radius)
    if flat_length > 0:
        depth = flat_length**2 / (16 * radius)
        shape = depth * (1 - np.cos(2 * math.pi * s / flat_length))
        lowering += np.where(s < flat_length, shape, 0.0)
    return lowering
