"""A train that no type explains, on one rail channel: wheelsets first, then their scale.

On an axis of time without a scale the wheelsets are found for a few trial speeds, in the deflection
of the rail or in its energies. What they are apart in metres follows from three independent lengths
that are known beforehand: the bowl of the deflection (:mod:`bowl`), the wheelbase of bogies, and
the length of cars. Their product over a grid of speeds is the posterior of the speed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from . import travel
from .bowl import SHAPE_SIGMA, WAVENUMBER, WAVENUMBER_SPREAD, Corner, corner, low_pass
from .kinematics import PRIOR_ACCELERATION, Motion
from .pattern import Trace
from .place import Wave
from .record import Record
from .wheelsets import Wheelsets, find

Array = NDArray[np.float64]

WHEELBASES = ((0.7, 2.5, 0.25), (0.3, 1.82, 0.06))
"""Prior of the commonest wheelbase of a train (share, mean, standard deviation, m): coaches and
multiple units 2.2 to 3.0 m; bogies of freight wagons 1.75 to 1.85 m."""

PLACE_SIGMA = 0.03
"""Standard deviation of the place of a wheelset's bowl (m), roughness apart from noise."""

HUMP, HUMP_FINE = 0.5, 0.2
"""Of the log-energy at a wheelset (m), and its smoothing."""

_SPEEDS = 60  # of the grid on which the spectrum of the deflection is looked at
_TRIALS = 6  # speeds at which wheelsets are looked for
_APART = 1.2  # ratio of different trials
_LEVELS = (0.3, 0.5, 0.7, 1.0)
_ROUGHNESS = (1e-3, 1e-2, 0.1, 1.0, 10.0)  # of the bowl's highest density
_AMONG = (2.0, 60.0)  # Hz, in which trials are compared
_PARTNER = 3.6  # m, wheelsets of one bogie, of any train at the typical bowl
_SAME_GAP = 0.06  # of a wheelbase, between bogies of one build
_LEAST_BASE = 1.4  # m
_BASES = (1.5, 3.6)  # m, wheelbases that exist, by a scale that is good to a fifth
_BOGIE = 1.4  # wheelbases, beyond which the next wheelset is of another bogie
_LEAST_BOGIES = 3
_LEAST_WHEELSETS = 4
_LEAST_QUIET = 100  # samples that tell the noise
_ENERGETIC = 1  # speeds at which energies are looked at
_LONGEST = 800.0  # m of train
_SURE = 0.9  # probability of a number of wheelsets ...
_ALL = 0.95  # ... and part of what is no noise that they explain, at which no other trial is needed
_PAIRED = 0.7
_AGREE = 1.15  # of successive trials, at which the scale is settled
_GRID = np.linspace(-0.6, 0.6, 1201)  # ln of speed over the first guess


@dataclass(frozen=True)
class Single:
    """Wheelsets in one channel and the speed.

    Attributes:
        times: of the wheelsets (s), with standard deviations.
        speed: at mid-train (m/s), standard deviation, 95 % interval.
        motion: past the channel, distance 0 at the first wheelset.
        certainty: probability that their number is right.
        contrast: typical pulse over the noise of its estimate.
        corner: of the deflection; ``None`` if it was not seen.
        paired: part of the wheelsets in bogies of two or three.
        method: what the scale is from.
    """

    times: Array
    time_sigma: Array
    speed: tuple[float, float, tuple[float, float]]
    motion: Motion
    certainty: float
    contrast: float
    corner: Corner | None
    paired: float
    method: str


def _trials(wave: Wave, interval: tuple[float, float], quiet: float, limits: Array) -> Array:
    """Speeds (m/s) at which the spectrum of the deflection is likely (Whittle), likeliest first."""
    first, last = np.searchsorted(wave.time, [interval[0] - 0.1, interval[1] + 0.1])
    value = wave.value[first:last] * wave.valid[first:last]
    if value.size < 64:
        return np.zeros(0)
    step = float(np.median(np.diff(wave.time)))
    n = value.size
    ramp = np.minimum(1.0, 10 * np.minimum(np.arange(n), np.arange(n)[::-1]) / n)
    power = np.abs(fft.rfft((value - value.mean()) * ramp)) ** 2 / float(ramp @ ramp)
    f = fft.rfftfreq(n, step)
    use = (f > 1.5) & (f < min(100.0, 0.4 / step))
    f, power = f[use], power[use]
    gain = low_pass(f, step)
    noise = quiet * gain / float(low_pass(np.linspace(0, 0.5 / step, 500), step).mean())
    speeds = np.geomspace(limits[0], limits[1], _SPEEDS)
    x = f[:, None] * 2 * np.pi / (speeds * WAVENUMBER)
    bowl = gain[:, None] * x**4 / (1 + x**4) ** 2
    strength = power.sum() / bowl.sum(axis=0)
    best = np.full(speeds.size, -np.inf)
    for level in _LEVELS:
        for rough in _ROUGHNESS:
            # the forces of roughness grow with frequency
            density = level * strength * (bowl + 0.25 * rough * gain[:, None] * np.minimum(x, 1.0))
            density += noise[:, None]
            best = np.maximum(best, -np.sum(np.log(density) + power[:, None] / density, axis=0))
    out: list[float] = []
    for k in np.argsort(-best):
        if all(abs(np.log(speeds[k] / v)) > np.log(_APART) for v in out):
            out.append(float(speeds[k]))
        if len(out) == _TRIALS:
            break
    return np.array(out)


def _pulse() -> Array:
    lag = np.arange(-60, 61) * travel.CELL
    curve = WAVENUMBER / 2**0.5 * np.abs(lag)
    bending = np.exp(-curve) * (np.cos(curve) - np.sin(curve))
    return travel.band_pass(bending, travel.FINE, travel.BROAD)


def _axis(interval: tuple[float, float], speed: float) -> Array:
    half = 8.0 / speed
    n = int((interval[1] - interval[0] + 2 * half) * speed / travel.CELL)
    return np.asarray(interval[0] - half + travel.CELL / speed * np.arange(n + 1))


def _seen(signal: Array, noise: Array | None, pulse: Array) -> Wheelsets | None:
    output = np.convolve(signal, pulse[::-1], "same")
    sign = 1.0 if np.quantile(output, 0.98) > -np.quantile(output, 0.02) else -1.0
    return find(sign * signal, noise, pulse)


@dataclass(frozen=True)
class _Trial:
    """Wheelsets found at one trial speed (m/s), in the deflection or in energies."""

    speed: float
    found: Wheelsets
    times: Array
    corner: Corner | None
    gain: float
    base: tuple[float, float, float]

    @property
    def rank(self) -> tuple[int, float]:
        """Wheelsets in bogies, whose number is likely, before others; then what they explain."""
        return 2 * (self.base[2] > _PAIRED) + (self.found.certainty > 0.5), self.gain


def _weighed(
    wave: Wave, speed: float, found: Wheelsets, times: Array, wavenumber: float, unknowns: int
) -> _Trial:
    """A trial with what its wheelsets, of so many unknowns each, explain of the deflection."""
    fine = corner(wave, times, WAVENUMBER * speed, _AMONG, refits=0)
    if fine is None:
        return _Trial(speed, found, times, None, -np.inf, _wheelbase(times, speed))
    gain = fine.worth(unknowns)
    base = _wheelbase(times, fine.value / wavenumber if gain > 0 else speed)
    return _Trial(speed, found, times, fine, gain, base)


def _deflected(
    wave: Wave,
    record: Record,
    within: tuple[float, float],
    interval: tuple[float, float],
    speeds: Sequence[float],
    limits: tuple[float, float],
    wavenumber: float,
) -> tuple[list[_Trial], bool]:
    """Wheelsets by the bowls of the deflection; whether the last of them are beyond doubt."""
    series = travel.deflection(record.window, within)
    start = float(wave.time[0])
    calm = travel.deflection(record.window, (start, within[0]))
    out: list[_Trial] = []
    tried: list[float] = []
    for speed in speeds:
        trial = speed
        for _ in range(2):
            inside = limits[0] <= trial <= limits[1]
            if not inside or any(abs(np.log(trial / v)) < np.log(_AGREE) for v in tried):
                break
            tried.append(trial)
            edges = _axis(interval, trial)
            quiet = np.arange(start, within[0], travel.CELL / trial)
            cells = travel.band_pass(series.cells(edges), travel.FINE, travel.BROAD)
            noise, possible = None, 1.0
            if quiet.size > _LEAST_QUIET:
                noise = travel.band_pass(calm.cells(quiet), travel.FINE, travel.BROAD)
                possible -= min(float(np.var(noise) / max(np.var(cells), 1e-300)), 0.5)
            found = _seen(cells, noise, _pulse())
            if found is None or found.place.size < _LEAST_WHEELSETS:
                break
            times = edges[0] + (found.place + 0.5 * travel.CELL) / trial
            out.append(_weighed(wave, trial, found, times, wavenumber, 2))
            if out[-1].corner is None:
                break
            good = found.certainty > _SURE and found.explained > _ALL * possible
            if good and out[-1].base[2] > _PAIRED and out[-1].gain > 0:
                return out, True
            trial = out[-1].corner.value / wavenumber
    return out, False


def _energetic(
    wave: Wave,
    record: Record,
    within: tuple[float, float],
    interval: tuple[float, float],
    speeds: Sequence[float],
    wavenumber: float,
    band: int,
) -> list[_Trial]:
    """Wheelsets in the log-energies of a band."""
    lag = np.arange(-60, 61) * travel.CELL
    hump = travel.band_pass(np.exp(-0.5 * (lag / HUMP) ** 2), HUMP_FINE, travel.BROAD)
    before = (float(record.window.time[0]), within[0])
    trace, calm = record.traces(within)[band], record.traces(before)[band]
    out: list[_Trial] = []
    for speed in speeds:
        edges, quiet = _axis(interval, speed), np.arange(*before, travel.CELL / speed)
        cells = travel.band_pass(log_energy(trace, edges), HUMP_FINE, travel.BROAD)
        noise = None
        if quiet.size > _LEAST_QUIET:
            noise = travel.band_pass(log_energy(calm, quiet), HUMP_FINE, travel.BROAD)
        found = find(cells, noise, hump)
        if found is not None and found.place.size >= _LEAST_WHEELSETS:
            times = edges[0] + (found.place + 0.5 * travel.CELL) / speed
            out.append(_weighed(wave, speed, found, times, wavenumber, 1))
    return out


def log_energy(trace: Trace, edges: Array) -> Array:
    """ln of the mean energy of every cell, not below the noise."""
    return np.asarray(np.log(np.maximum(trace.mean(edges[:-1], edges[1:]), trace.noise)))


def _wheelbase(times: Array, speed: float) -> tuple[float, float, float]:
    """Commonest gap within bogies (s), its sigma, and the part of the wheelsets in bogies."""
    gaps = np.diff(times)
    short = gaps[(gaps * speed > _LEAST_BASE) & (gaps * speed < _PARTNER)]
    if not short.size:
        return 0.0, 0.0, 0.0
    near = np.abs(np.log(short[:, None] / short[None, :])) < _SAME_GAP
    members = short[near[int(np.argmax(near.sum(axis=1)))]]
    base = float(np.median(members))
    if not _BASES[0] < base * speed < _BASES[1]:
        return 0.0, 0.0, 0.0
    # bogies are groups of two or three: what rings on has more, and never ends
    groups = np.split(np.arange(times.size), 1 + np.flatnonzero(gaps > _BOGIE * base))
    bogies = [group.size for group in groups if group.size in (2, 3)]
    share = sum(bogies) / times.size if len(bogies) >= _LEAST_BOGIES else 0.0
    return base, 2**0.5 * PLACE_SIGMA / speed, share


def _posterior(
    guess: float,
    base: tuple[float, float, float],
    bowl: tuple[float, float] | None,
    limits: tuple[float, float],
) -> tuple[float, float, tuple[float, float]]:
    """Speed (m/s), its standard deviation and 95 % interval.

    Args:
        guess: about which it is looked for (m/s).
        base: what :func:`_wheelbase` gives.
        bowl: speed by the bowl (m/s), relative standard deviation.
        limits: of speeds (m/s).
    """
    speed = float(np.clip(guess, *limits)) * np.exp(_GRID)
    log = np.where((speed >= limits[0]) & (speed <= limits[1]), 0.0, -np.inf)
    if base[0] > 0:
        length = speed * base[0]
        density = np.zeros(speed.size)
        for share, mean, sigma in WHEELBASES:
            spread = np.hypot(sigma, base[1] * speed)
            density += share / spread * np.exp(-0.5 * ((length - mean) / spread) ** 2)
        log += np.log(density + 1e-12)
    if bowl is not None:
        log -= 0.5 * (np.log(speed / bowl[0]) / bowl[1]) ** 2
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    mean = float(weight @ speed)
    sigma = float(np.sqrt(weight @ (speed - mean) ** 2))
    total = np.cumsum(weight)
    low, high = (float(np.interp(q, total, speed)) for q in (0.025, 0.975))
    return mean, sigma, (low, high)


def alone(
    record: Record,
    within: tuple[float, float],
    interval: tuple[float, float],
    limits: tuple[float, float],
    guess: float | None,
    band: int,
    bowl: tuple[float, float] = (WAVENUMBER, WAVENUMBER_SPREAD),
) -> Single | None:
    """What one rail channel tells of a train that no catalogue type explains.

    Args:
        record: of the channel.
        within: the event (s).
        interval: first and last strong energy (s).
        limits: speeds (m/s).
        guess: of the speed, by the nearest type (m/s).
        band: whose energies show most.
        bowl: wavenumber k0 of the site (rad/m), relative standard deviation.
    """
    window = record.window
    wave = Wave(window.time - window.low_shift, window.low, window.valid)
    before = wave.valid & (wave.time < within[0])
    quiet = float(np.var(wave.value[before])) if before.sum() > _LEAST_QUIET else 0.0
    top = min(limits[1], _LONGEST / max(interval[1] - interval[0], 0.1))
    if top < limits[0] * _APART:
        return None
    speeds = [] if guess is None else [guess]
    speeds += [float(v) for v in _trials(wave, interval, quiet, np.array([limits[0], top]))]
    speeds = [v for v in speeds if v <= top]
    trials, sure = _deflected(wave, record, within, interval, speeds, (limits[0], top), bowl[0])
    if not sure:
        trials += _energetic(wave, record, within, interval, speeds[:_ENERGETIC], bowl[0], band)
    if not trials:
        return None
    best = max(trials, key=lambda trial: trial.rank)
    times, fine = best.times, None
    if best.corner is not None:
        first = WAVENUMBER * best.speed
        for unknowns in (
            2,
            1,
        ):  # places and loads, or the loads alone at the places that were found
            trial = corner(wave, times, first, refits=unknowns - 1)
            trial = trial and corner(wave, trial.times, trial.value, refits=unknowns - 1)
            if trial is not None and trial.worth(unknowns) > 0:
                fine = trial
                break
    if fine is not None:
        times, nominal = fine.times, fine.value / bowl[0]
        spread = float(np.sqrt(bowl[1] ** 2 + fine.sigma**2 + SHAPE_SIGMA**2))
        base = _wheelbase(times, nominal)
        speed = _posterior(nominal, base, (nominal, spread), limits)
        method = "wheelbase and bowl of the deflection"
    elif best.base[2] > _PAIRED:
        base = best.base
        speed = _posterior(WHEELBASES[0][1] / base[0], base, None, limits)
        method = "typical wheelbase"
    else:
        return None
    place = float(np.median(best.found.sigma)) * speed[0] / best.speed
    return _result(times, place, speed, best.found, fine, base[2], method)


def _result(
    times: Array,
    place: float,
    speed: tuple[float, float, tuple[float, float]],
    found: Wheelsets,
    fine: Corner | None,
    paired: float,
    method: str,
) -> Single:
    middle = 0.5 * float(times[0] + times[-1])
    mean, sigma, _ = speed
    covariance = np.diag([place**2, sigma**2, PRIOR_ACCELERATION**2])
    motion = Motion(middle, mean * (middle - float(times[0])), mean, 0.0, covariance)
    return Single(
        times=times,
        time_sigma=np.full(times.size, float(np.hypot(place, PLACE_SIGMA)) / mean),
        speed=speed,
        motion=motion,
        certainty=found.certainty,
        contrast=found.contrast,
        corner=fine,
        paired=paired,
        method=method,
    )
