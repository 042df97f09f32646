"""How fast something runs over one rail channel, by the bowl that a wheel presses into the rail.

A rail on a foundation of stiffness k (N/m²) bends under a wheel over a length that does not depend
on the train. Against time, the acceleration of wheelset i is a pulse of the transform

    T(f) = (f/f0)² / (1 + (f/f0)^4),   f0 = k0 v / 2 pi,   k0 = (k / EI)^(1/4)

(Fryba, Vibration of Solids and Structures under Moving Loads, 1999, ch. 13), so its width tells the
speed as well as the wavenumber k0 of the site is known: from physics to a tenth, from earlier
passages to some per cent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, optimize

from .features import LOW_TOP
from .place import Wave

Array = NDArray[np.float64]

WAVENUMBER = 1.8
"""Typical k0 (rad/m): pads of 45 kN/mm every 0.65 m under a rail of 60 kg/m."""

WAVENUMBER_SPREAD = 0.13
"""Relative standard deviation of k0: pads of 20 to 100 kN/mm, equally likely in their logarithm,
give 0.12 by the fourth root; rails of 50 to 60 kg/m and the slab under the pads the rest."""

SHAPE_SIGMA = 0.04
"""Relative standard deviation of the corner of one site between trains, the wheelsets' places being
found with it: the foundation is discrete and damped, and neighbours in a bogie share their bowls
(computed passages of all types at 40 dB; 0.02 at the true places)."""

_LOADS = 0.3  # relative, spread of the loads of a train: locomotives 21 t, coaches 12 t
_STRENGTHS = np.geomspace(1e-4, 1e6, 61)  # of the mean pulse over the noise, squared
_BAND = (0.4, 2.6)  # of the corner, where the bowl lies; shorter waves are roughness
_TAPER = 8.0  # m beyond the outer wheelsets
_PAD_S = 0.3  # s, the same where bands are compared
_RIDGE = 1e-3
_LN_REACH = 0.3  # of the corner about its first guess, prior of the search
_COUPLING = 1.0  # Hz^(1/2), root of the edge of the AC coupling: 1 Hz, a spread from 0 to 4
_SHIFT = 0.2  # m, standard deviation of the pulses' common place
_STARTS = (-0.2, 0.05, 0.3)
_STEPS = np.array([0.02, 0.15, 0.3])
_LEAST_LEFT = 1e-9
_MOST_STEP = 0.3  # rad of the corner, 0.17 m


@dataclass(frozen=True)
class Corner:
    """Corner of the pulses of a train, 2 pi f0 = k0 v (rad/s).

    Attributes:
        value: its estimate.
        sigma: relative standard deviation, noise and roughness of this passage only.
        explained: part of the low-passed waveform that the pulses explain.
        gain: ln of the likelihood ratio of the pulses, with any loads, to white noise.
        odds: the same with loads as those of a train, their prior integrated out.
        data: independent values that were explained.
        times: of the wheelsets (s), and their standard deviations.
    """

    value: float
    sigma: float
    explained: float
    gain: float
    odds: float
    data: float
    times: Array
    time_sigma: Array

    def worth(self, placed: bool) -> float:
        """ln of the odds that these wheelsets are here and not only noise.

        Places that were found in the same waveform cost half ln n of n data each (Bayesian
        information).
        """
        cost = 0.5 * self.times.size * float(np.log(max(self.data, 1.0)))
        return self.odds - (cost if placed else 0.0)


def waves(speed: float) -> tuple[float, float]:
    """Frequencies (Hz) in which the bowl of a train of a speed (m/s) lies on a typical rail."""
    corner = WAVENUMBER * speed / (2 * np.pi)
    return _BAND[0] * corner, _BAND[1] * corner


def low_pass(f: Array, step: float) -> Array:
    """Power gain at f (Hz) of the low-pass of a waveform in steps of ``step`` (s)."""
    w = (1.3616541 * f / min(LOW_TOP, 0.4 / step)) ** 2  # -3 dB at 1
    return np.asarray(9 / (9 + 3 * w + w * w))


def corner(
    wave: Wave,
    times: Array,
    guess: float,
    band: tuple[float, float] | None = None,
    refits: int = 2,
    span: tuple[float, float] | None = None,
) -> Corner | None:
    """The corner by maximum likelihood, every wheelset with a load of its own.

    Args:
        wave: low-passed waveform of the channel.
        times: of the wheelsets (s).
        guess: of the corner (rad/s).
        band: frequencies that are explained (Hz), as far as they are on record; those of the guess
            by default.
        refits: how often the times are improved.
        span: of the waveform that is explained, but for margins (s); that of the wheelsets by
            default.

    Returns:
        ``None`` if the waveform does not hold the wheelsets.
    """
    pad = _TAPER * WAVENUMBER / guess if band is None else _PAD_S
    begin, end = span or (float(times[0]), float(times[-1]))
    start, stop = begin - pad, end + pad
    first, last = np.searchsorted(wave.time, [start, stop])
    time, valid = wave.time[first:last], wave.valid[first:last]
    if valid.sum() < 16:
        return None
    known = np.flatnonzero(valid)
    value = np.interp(np.arange(valid.size), known, wave.value[first:last][known])
    ramp = np.clip(np.minimum(time - start, stop - time) / pad, 0.0, 1.0)
    taper = np.sin(0.5 * np.pi * ramp) ** 2
    value = (value - np.sum(value * taper) / taper.sum()) * taper
    step = float(np.median(np.diff(time)))
    size = int(fft.next_fast_len(4 * time.size // 3, real=True))
    f = fft.rfftfreq(size, step)
    seen = fft.rfft(value, size) * np.exp(-2j * np.pi * f * (time[0] - times[0]))
    low, high = band or waves(guess / WAVENUMBER)
    high = min(high, LOW_TOP, 0.4 / step)
    use = (f > low) & (f < high)
    if use.sum() < 8:
        return None
    f, seen = f[use], seen[use]
    energy = float(np.sum(np.abs(seen) ** 2))
    if energy <= 0:
        return None
    independent = (stop - start) * (f[-1] - f[0]) * float(valid.mean())
    y = np.concatenate([seen.real, seen.imag])
    gain = np.sqrt(low_pass(f, step))

    def pulses(p: Array, turned: NDArray[np.complex128]) -> NDArray[np.complex128]:
        x = 2 * np.pi * f / (guess * np.exp(p[0]))
        pulse = gain * x**2 / (1 + x**4) * np.exp(-2j * np.pi * f * p[2] / guess)
        columns = (pulse * 1j * f / (1j * f + p[1] ** 2))[:, None]
        return np.asarray(columns / np.sqrt(np.sum(np.abs(columns) ** 2)) * turned)

    def turn(at: Array) -> NDArray[np.complex128]:
        return np.asarray(np.exp(-2j * np.pi * np.outer(f, at - times[0])))

    def real(z: NDArray[np.complex128]) -> Array:
        return np.concatenate([z.real, z.imag])

    def loads(columns: Array) -> Array:
        normal = columns.T @ columns + _RIDGE * np.eye(columns.shape[1])
        return np.asarray(np.linalg.solve(normal, columns.T @ y))

    def explained(p: Array, turned: NDArray[np.complex128]) -> float:
        columns = real(pulses(p, turned))
        return float(y @ columns @ loads(columns)) / energy

    def cost(p: Array, turned: NDArray[np.complex128]) -> float:
        prior = (p[0] / _LN_REACH) ** 2 + (p[1] / _COUPLING - 1) ** 2
        prior += (p[2] / (_SHIFT * WAVENUMBER)) ** 2
        left = max(1 - explained(p, turned), _LEAST_LEFT)
        return float(independent * np.log(left) + 0.5 * prior)

    def search(
        turned: NDArray[np.complex128], starts: Sequence[tuple[float, float, float]]
    ) -> Array:
        best = None
        for a, b, c in starts:
            simplex = np.array([[a, b, c], [a + 0.1, b, c], [a, b + 0.5, c], [a, b, c + 0.18]])
            found = optimize.minimize(
                cost,
                simplex[0],
                args=(turned,),
                method="Nelder-Mead",
                options={
                    "initial_simplex": simplex,
                    "xatol": 4e-3,
                    "fatol": 0.02,
                    "maxfev": 90 if refits else 45,
                },
            )
            if best is None or found.fun < best.fun:
                best = found
        assert best is not None
        return np.asarray(best.x, dtype=np.float64)

    at, sigma = times, np.zeros(times.size)
    turned = turn(at)
    top = search(turned, [(x, 1.0, 0.0) for x in (_STARTS if refits else (0.0,))])
    for _ in range(refits):
        columns = pulses(top, turned)
        q = loads(real(columns))
        slope = real(-2j * np.pi * f[:, None] * columns) * q
        rest = y - real(columns) @ q
        normal = slope.T @ slope
        # wheelsets that carry nothing stay where they are
        normal += 1e-3 * float(np.median(np.diag(normal))) * np.eye(times.size)
        step_s = np.linalg.solve(normal, slope.T @ rest)
        most = _MOST_STEP / guess
        at = at + np.clip(step_s - np.median(step_s), -most, most)
        # what is left is noise of the waves that tell places; the lines are denser than independent
        weight = np.sum(slope**2, axis=1)
        variance = float(weight @ rest**2) / float(weight.sum()) * y.size
        variance /= max(2 * independent - 2 * times.size - 3, 1.0)
        # loads are found with the places: those of neighbours are confused with a shift
        both = np.concatenate([slope / np.sqrt(np.diag(normal)), real(columns)], axis=1)
        joint = both.T @ both + 1e-3 * np.eye(both.shape[1])
        spread_s = np.diag(np.linalg.inv(joint))[: times.size] / np.diag(normal)
        sigma = np.sqrt(np.maximum(variance * spread_s, 0.0))
        turned = turn(at)
        top = search(turned, [(top[0], top[1], top[2])])
    steps = np.diag(_STEPS)
    hessian = np.array(
        [
            [
                cost(top + a + b, turned)
                - cost(top + a - b, turned)
                - cost(top - a + b, turned)
                + cost(top - a - b, turned)
                for b in steps
            ]
            for a in steps
        ]
    ) / (4 * np.outer(_STEPS, _STEPS))
    spread = float(np.linalg.pinv(hessian)[0, 0])
    share = explained(top, turned)
    scale = float(np.sqrt(2 * independent / y.size))
    odds = _odds(scale * real(pulses(top, turned)), scale * y, 2 * independent)
    return Corner(
        value=guess * float(np.exp(top[0])),
        sigma=float(np.sqrt(spread)) if spread > 0 else _LN_REACH,
        explained=share,
        gain=-independent * float(np.log(max(1 - share, _LEAST_LEFT))),
        odds=odds,
        data=2 * independent,
        times=at + float(top[2]) / guess,
        time_sigma=sigma,
    )


def _odds(columns: Array, y: Array, data: float) -> float:
    """ln of the evidence of loads of one mean and their spread against white noise.

    With y = X q + noise and q of covariance g (1 1' + spread² I) it is, up to the level of noise
    that fits best, -n/2 ln(y' C^-1 y / y' y) - 1/2 ln det C, C = I + X cov(q) X' (Rasmussen &
    Williams, Gaussian Processes for Machine Learning, 2006, eq. 2.30); g is that which fits best.
    """
    n = columns.shape[1]
    root = _LOADS * np.eye(n) + (np.sqrt(_LOADS**2 + n) - _LOADS) / n * np.ones((n, n))
    x = columns @ root
    values, vectors = np.linalg.eigh(x.T @ x)
    values = np.maximum(values, 0.0)
    along = (vectors.T @ (x.T @ y)) ** 2
    g = _STRENGTHS[:, None]
    left = 1 - np.sum(g * along / (1 + g * values), axis=1) / float(y @ y)
    log = -0.5 * data * np.log(np.maximum(left, _LEAST_LEFT))
    return float(np.max(log - 0.5 * np.sum(np.log1p(g * values), axis=1)))
