"""A train that no type explains, on one rail channel: wheelsets first, then their scale.

On an axis of time without a scale the wheelsets are found for a few trial speeds, in the deflection
of the rail or in its energies. What they are apart in metres follows from lengths that are known
beforehand: the bowl of the deflection (:mod:`bowl`), and those of vehicles (:mod:`rolling`), the
wheelbase, the bogie centres, what is between two vehicles, and the wheelbase of a locomotive. Their
product over a grid of speeds is the posterior of the speed.

How well can that be known? A train of free places and loads gives the product k0 v (:mod:`bowl`)
and the three lengths in seconds. By k0 alone ln v has a sigma of 13.6 % (pads 13 %, shape 4 %); the
wheelbase alone, 2.5 m with a spread of 0.25 m, makes that 8 %. The ratios of the three lengths tell
the kind of vehicle and so its size: with a vehicle that none in the table is, an error of 4 %
(median) and 10 % (rms, most of it wagons taken for coaches of another size or the reverse), 3 % and
8 % with one of the table; on a site where listed trains have taught k0 to 1 % it is 3.4 %. An error
of 2 % at 95 % is out of reach of one rail without a length that is known.

The spacing of fastenings would be one, but at a fixed point their passing is hardly a line: a
wheelset is near the sensor for some three bays, and roughness in these comes again with every
wheelset. In 54 computed passages at 40 dB the pulse common to all wheelsets has, at 1.06 waves per
bay, a hump of 7 dB with a Timoshenko rail, none with an Euler-Bernoulli one. Waves of 0.3 to 0.45 m
repeat from train to train (coherence 0.9 and 0.2): with the whole pulse of the site taken from
other trains its width told the speed to 1.5 % (median; one in ten beyond 3.6 %) and 3.5 % (9 %) at
40 dB, to 5 % (beyond 20 %) and 16 % at 10 dB. Most of it is above the 100 Hz that are kept, and is
not used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from . import rolling, travel
from .bowl import SHAPE_SIGMA, WAVENUMBER, WAVENUMBER_SPREAD, Corner, corner, low_pass, waves
from .kinematics import PRIOR_ACCELERATION, Motion
from .pattern import Trace
from .place import Wave
from .record import Record
from .wheelsets import Wheelsets, find

Array = NDArray[np.float64]

WHEELBASES = ((0.7, 2.5), (0.3, 1.82))
"""Commonest wheelbases (share, m): of coaches and multiple units, of freight wagons."""

PLACE_SIGMA = 0.03
"""Standard deviation of the place of a wheelset's bowl (m), roughness apart from noise."""

_MERGED = 0.35
"""The same by energies (m): those of a bogie's two wheelsets run into one another, which moves both
towards its middle, by 0.2 to 0.35 m with wheelbases of 2.7 m (computed passages at 10 dB)."""

_BOWL_SIGMA = 0.012
"""The same where place and load were found together (m): what wheelsets with other neighbours
differ by (:mod:`evidence`)."""

HUMP, HUMP_FINE = 0.5, 0.2
"""Of the log-energy at a wheelset (m), and its smoothing."""

SAME_GAP = 0.06
"""Of a gap or its ln, between bogies of one build, or cars of one kind."""

_SPEEDS = 60  # of the grid on which the spectrum of the deflection is looked at
_TRIALS = 6  # speeds at which wheelsets are looked for
_APART = 1.2  # ratio of different trials
_LEVELS = (0.3, 0.5, 0.7, 1.0)
_ROUGHNESS = (1e-3, 1e-2, 0.1, 1.0, 10.0)  # of the bowl's highest density
_BOGIE = 1.4  # wheelbases, beyond which the next wheelset is of another bogie
_BESIDE = 10.0  # wheelbases, to the nearer bogie beside: a hammer is not as quick as it rings on
_BASES = (1.4, 3.6)  # m, wheelbases that exist, 1.75 to 3, by a bowl that is good to a fifth
_LEAST_REPEATS = 3  # of two distances of bogies, that are chance or two ends else
_LEAST_CARS = 5  # such repeats; of gaps at random six in a thousand are alike in both
_MOST = 0.5  # of a train
_LEAST_BOGIES = 5  # double blows of a hammer may make four
_EVEN = 0.15  # of the wheelbase, robust scatter about it; of gaps of any length it is half
_LEAST_WHEELSETS = 4
_LEAST_QUIET = 100  # samples that tell the noise
_LONGEST = 800.0  # m of train
_SURE = 0.9  # probability of a number of wheelsets ...
_ALL = 0.95  # ... and part of what is no noise that they explain, at which no other trial is needed
_PAIRED = 0.7
_AGREE = 1.15  # of speeds that need not both be tried
_SETTLED = 1.25  # of a trial against its wheelbase, of the pulses it was looked at with
_MOST_TRIALS = 12
_LIKE = 4  # residuals
_BEYOND_DOUBT = 25.0  # ln of odds, as for two channels
_GRID = np.linspace(-0.6, 0.6, 1201)  # ln of speed over the first guess


@dataclass(frozen=True)
class Bogies:
    """How wheelsets stand in bogies of two or three of one wheelbase, if they do.

    Attributes:
        base: the wheelbase (s); 0 without bogies.
        share: of the wheelsets that stand in them.
        scatter: of the gaps in bogies about it (s), robust standard deviation.
        each: wheelsets of most of them.
        centres: from bogie to bogie (s), the longer and the shorter of two successive distances
            that repeat most; ``None`` if none do.
        regular: part of all such distances that are those, if they are enough to be no chance.
        locomotive: gap of pairs of wheelsets that stand further apart (s); 0 without any.
    """

    base: float = 0.0
    share: float = 0.0
    scatter: float = 0.0
    each: float = 2.0
    centres: tuple[float, float] | None = None
    regular: float = 0.0
    locomotive: float = 0.0

    @property
    def cars(self) -> bool:
        """Whether most of them are those of cars of one kind, five and more in all."""
        return self.share > _PAIRED and self.regular > _MOST

    @property
    def ratio(self) -> float:
        """The longer over the shorter distance from bogie to bogie; 0 if none repeat."""
        return 0.0 if self.centres is None else self.centres[0] / self.centres[1]

    @property
    def clear(self) -> bool:
        """Whether most wheelsets do, at one gap."""
        return self.share > _PAIRED and self.scatter < _EVEN * self.base

    def speeds(self) -> list[float]:
        """Speeds (m/s) that make it a wheelbase that trains have, likeliest first."""
        return [base / self.base for _, base in WHEELBASES] if self.clear else []


@dataclass(frozen=True)
class Shown:
    """What one rail channel shows of an event.

    Attributes:
        record: of the channel.
        within: the event (s).
        interval: first and last strong energy (s).
        limits: speeds (m/s).
        guess: of the speed, by the nearest catalogue type (m/s); ``None`` without.
        band: whose energies show most.
        bowl: wavenumber k0 of the rail's deflection (rad/m), relative standard deviation.
    """

    record: Record
    within: tuple[float, float]
    interval: tuple[float, float]
    limits: tuple[float, float]
    guess: float | None
    band: int
    bowl: tuple[float, float] = (WAVENUMBER, WAVENUMBER_SPREAD)

    @cached_property
    def wave(self) -> Wave:
        """The waveform below 100 Hz."""
        return self.record.wave(self.within)

    @property
    def quiet(self) -> float:
        """Variance of the waveform before the event; 0 where that is not on record."""
        before = self.wave.valid & (self.wave.time < self.within[0])
        return float(np.var(self.wave.value[before])) if before.sum() > _LEAST_QUIET else 0.0

    @property
    def top(self) -> float:
        """Highest speed of a train that is not longer than trains are (m/s)."""
        return min(self.limits[1], _LONGEST / max(self.interval[1] - self.interval[0], 0.1))

    def axis(self, speed: float) -> Array:
        """Edges (s) of cells of distance over all the train at a speed (m/s)."""
        half = 8.0 / speed
        n = int((self.interval[1] - self.interval[0] + 2 * half) * speed / travel.CELL)
        return np.asarray(self.interval[0] - half + travel.CELL / speed * np.arange(n + 1))


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
        worth: ln of odds that the deflection shows these wheelsets and not only noise.
        bogies: how the wheelsets stand.
        method: what the scale is from.
    """

    times: Array
    time_sigma: Array
    speed: tuple[float, float, tuple[float, float]]
    motion: Motion
    certainty: float
    contrast: float
    corner: Corner | None
    worth: float
    bogies: Bogies
    method: str


def _trials(shown: Shown) -> Array:
    """Speeds (m/s) at which the spectrum of the deflection is likely (Whittle), likeliest first."""
    wave, interval = shown.wave, shown.interval
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
    noise = shown.quiet * gain / float(low_pass(np.linspace(0, 0.5 / step, 500), step).mean())
    speeds = np.geomspace(shown.limits[0], shown.top, _SPEEDS)
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


def _seen(signal: Array, noise: Array | None, pulse: Array) -> Wheelsets | None:
    output = np.convolve(signal, pulse[::-1], "same")
    sign = 1.0 if np.quantile(output, 0.98) > -np.quantile(output, 0.02) else -1.0
    return find(sign * signal, noise, pulse)


@dataclass(frozen=True)
class _Trial:
    """Wheelsets found at one trial speed (m/s), in the deflection or in energies.

    Attributes:
        times: of the wheelsets (s).
        placed: whether they are where the deflection has pulses.
    """

    speed: float
    found: Wheelsets
    times: Array
    placed: bool
    bogies: Bogies

    @property
    def likely(self) -> float:
        """The speed (m/s) that the wheelbase means, or at which they were found without any."""
        return next(iter(self.bogies.speeds()), self.speed)

    def worth(self, shown: Shown, slowest: float) -> float:
        """ln of odds that its wheelsets are there, by the waves of a train of a speed (m/s)."""
        fine = explained(shown, self.times, self.likely, slowest)
        return -np.inf if fine is None else fine.worth(self.placed)


def explained(shown: Shown, times: Array, speed: float, slowest: float) -> Corner | None:
    """What wheelsets (s) explain of the deflection at about a speed (m/s).

    All of the event is asked for the waves of a train of the speed ``slowest`` (m/s); at one of
    these speeds several sets of wheelsets can be compared.
    """
    guess = WAVENUMBER * speed
    return corner(shown.wave, times, guess, waves(slowest), refits=0, span=shown.interval)


def _likeliest(shown: Shown, trials: Sequence[_Trial]) -> tuple[_Trial, float]:
    """The trial whose wheelsets explain the bowls best, and what its wheelsets are worth.

    Roughness shakes a rail in waves shorter than its bowl, again at every wheelset; pulses in step
    with these explain more of a waveform than its wheelsets do, as those of a faster train. So all
    are compared by the waves of the slowest one that has bogies and bowls: wheelsets of a faster
    train explain these as well, and shorter ones may be roughness.
    """
    own = alone = [trial.worth(shown, trial.likely) for trial in trials]
    bowls = [t for t, worth in zip(trials, own, strict=True) if t.bogies.clear and worth > 0]
    if len(bowls) > 1:
        slowest = min(trial.likely for trial in bowls)
        own = [trial.worth(shown, slowest) for trial in trials]

    def rank(k: int) -> tuple[int, float]:
        # wheelsets in bogies that the deflection shows, whose number is likely or that are those of
        # cars of one kind, before others
        stand = trials[k].bogies
        sure = trials[k].found.certainty > 0.5 or stand.cars
        return 2 * (stand.clear and alone[k] > 0) + sure, own[k]

    best = max(range(len(trials)), key=rank)
    return trials[best], alone[best]


def _deflected(shown: Shown, speeds: Sequence[float]) -> tuple[list[_Trial], bool]:
    """Wheelsets by the bowls of the deflection; whether these show a train beyond doubt.

    What is found at one speed tells the next: by its bowl, and by the wheelbase of its bogies.
    """
    out: list[_Trial] = []
    tried: list[float] = []
    seen = False
    queue = list(speeds)
    while queue and len(tried) < _MOST_TRIALS:
        speed = queue.pop(0)
        inside = shown.limits[0] <= speed <= shown.top
        if not inside or any(abs(np.log(speed / v)) < np.log(_AGREE) for v in tried):
            continue
        tried.append(speed)
        trial, possible = _pulses(shown, speed)
        if trial is None:
            continue
        out.append(trial)
        good = trial.found.certainty > _SURE and trial.found.explained > _ALL * possible
        settled = any(abs(np.log(speed / v)) < np.log(_SETTLED) for v in trial.bogies.speeds())
        fine = explained(shown, trial.times, trial.likely, trial.likely)
        worth = -np.inf if fine is None else fine.worth(placed=True)
        if good and settled and worth > 0:
            return out, True
        seen |= trial.bogies.clear and trial.bogies.cars and worth > _BEYOND_DOUBT
        by_bowl = [] if fine is None else [fine.value / shown.bowl[0]]
        queue = trial.bogies.speeds() + by_bowl + queue
    return out, seen


def _pulses(shown: Shown, speed: float) -> tuple[_Trial | None, float]:
    """Wheelsets by their bowls at a speed (m/s), and how much of the waveform is no noise."""
    window, start = shown.record.window, float(shown.wave.time[0])
    edges = shown.axis(speed)
    quiet = np.arange(start, shown.within[0], travel.CELL / speed)
    series = travel.deflection(window, shown.within)
    cells = travel.band_pass(series.cells(edges), travel.FINE, travel.BROAD)
    noise, possible = None, 1.0
    if quiet.size > _LEAST_QUIET:
        calm = travel.deflection(window, (start, shown.within[0]))
        noise = travel.band_pass(calm.cells(quiet), travel.FINE, travel.BROAD)
        possible -= min(float(np.var(noise) / max(np.var(cells), 1e-300)), 0.5)
    found = _seen(cells, noise, _pulse())
    if found is None or found.place.size < _LEAST_WHEELSETS:
        return None, possible
    times = edges[0] + (found.place + 0.5 * travel.CELL) / speed
    return _Trial(speed, found, times, True, bogies(times)), possible


def _energetic(shown: Shown, speeds: Sequence[float]) -> list[_Trial]:
    """Wheelsets in the log-energies of a band, at all speeds but if one shows cars beyond doubt."""
    lag = np.arange(-60, 61) * travel.CELL
    hump = travel.band_pass(np.exp(-0.5 * (lag / HUMP) ** 2), HUMP_FINE, travel.BROAD)
    record, within = shown.record, shown.within
    before = (float(record.window.time[0]), within[0])
    trace, calm = record.traces(within)[shown.band], record.traces(before)[shown.band]
    out: list[_Trial] = []
    for k, speed in enumerate(speeds):
        if any(abs(np.log(speed / v)) < np.log(_AGREE) for v in speeds[:k]):
            continue
        edges, quiet = shown.axis(speed), np.arange(*before, travel.CELL / speed)
        cells = travel.band_pass(log_energy(trace, edges), HUMP_FINE, travel.BROAD)
        noise = None
        if quiet.size > _LEAST_QUIET:
            noise = travel.band_pass(log_energy(calm, quiet), HUMP_FINE, travel.BROAD)
        found = find(cells, noise, hump)
        if found is not None and found.place.size >= _LEAST_WHEELSETS:
            times = edges[0] + (found.place + 0.5 * travel.CELL) / speed
            out.append(_Trial(speed, found, times, False, bogies(times)))
            if out[-1].bogies.cars and found.certainty > _SURE:
                break
    return out


def log_energy(trace: Trace, edges: Array) -> Array:
    """ln of the mean energy of every cell, not below the noise."""
    return np.asarray(np.log(np.maximum(trace.mean(edges[:-1], edges[1:]), trace.noise)))


def bogies(times: Array) -> Bogies:
    """The bogies of wheelsets (s), whatever their speed: two or three at one gap, others further.

    Of all gaps that repeat, the one that leaves the fewest wheelsets alone or in longer rows, and
    of these that which repeats most.
    """
    gaps = np.diff(times)
    near = np.abs(np.log(gaps[:, None] / gaps[None, :])) < SAME_GAP
    best = Bogies()
    for k in np.argsort(-near.sum(axis=1), kind="stable"):
        base = float(np.median(gaps[near[k]]))
        # what rings on has more than three, and never ends
        ends = 1 + np.flatnonzero(gaps > _BOGIE * base)
        apart = np.concatenate([[np.inf], gaps[ends - 1], [np.inf]])
        beside = np.minimum(apart[:-1], apart[1:]) < _BESIDE * base
        groups = [g for g, near_one in zip(np.split(times, ends), beside, strict=True) if near_one]
        sizes = [group.size for group in groups if group.size in (2, 3)]
        share = sum(sizes) / times.size if len(sizes) >= _LEAST_BOGIES else 0.0
        if share > best.share:
            inner = np.concatenate([np.diff(g) for g in groups if g.size in (2, 3)])
            scatter = 1.4826 * float(np.median(np.abs(inner - base)))
            best = Bogies(base, share, scatter, float(np.median(sizes)))
    return replace(best, **_between(times, best.base)) if best.base else best


def _middles(times: Array, base: float) -> Array:
    """Middles of the bogies of a wheelbase (s), two or three wheelsets each."""
    groups = np.split(times, 1 + np.flatnonzero(np.diff(times) > _BOGIE * base))
    return np.array([group.mean() for group in groups if group.size in (2, 3)])


def _between(times: Array, base: float) -> dict[str, Any]:
    """What repeats between bogies of a wheelbase (s), and the gap of pairs that are no bogies."""
    gaps = np.diff(times)
    ways = np.diff(_middles(times, base))
    two = np.sort(np.stack([ways[1:], ways[:-1]], axis=1), axis=1)[:, ::-1]
    out: dict[str, Any] = {}
    if len(two):
        near = np.all(np.abs(np.log(two[:, None] / two)) < SAME_GAP, axis=2)
        most = int(np.argmax(near.sum(axis=1)))
        repeats = int(near[most].sum())
        if repeats >= _LEAST_REPEATS:
            longer, shorter = np.median(two[near[most]], axis=0)
            out["centres"] = (float(longer), float(shorter))
        if repeats >= _LEAST_CARS:
            out["regular"] = repeats / len(two)
    beside = np.concatenate([[np.inf], gaps, [np.inf]])
    pair = (gaps > _BOGIE * base) & (2 * gaps < np.minimum(beside[:-2], beside[2:]))
    if pair.any():
        out["locomotive"] = float(np.median(gaps[pair]))
    return out


def _posterior(
    guess: float,
    stand: Bogies,
    bowl: tuple[float, float] | None,
    limits: tuple[float, float],
    rough: float = PLACE_SIGMA,
) -> tuple[float, float, tuple[float, float]]:
    """Speed (m/s), its standard deviation and 95 % interval.

    Args:
        guess: about which it is looked for (m/s).
        stand: how the wheelsets stand in bogies.
        bowl: speed by the bowl (m/s), relative standard deviation.
        limits: of speeds (m/s).
        rough: standard deviation of the places of wheelsets (m); those of a bogie err alike, or
            against each other, and leave its centre where it is.
    """
    speed = float(np.clip(guess, *limits)) * np.exp(_GRID)
    log = np.where((speed >= limits[0]) & (speed <= limits[1]), 0.0, -np.inf)
    if stand.clear or stand.centres is not None:
        length = speed[:, None] * np.array([stand.base, *(stand.centres or ())])
        # those of one build are seen with one error
        measured = np.full(length.shape, 2**0.5 * PLACE_SIGMA)
        measured[:, 0] = np.hypot(2**0.5 * rough, stand.scatter * speed)
        log += rolling.log_prior(length, measured / length)
    if stand.locomotive:
        log += rolling.log_locomotive(speed * stand.locomotive)
    if bowl is not None:
        log -= 0.5 * (np.log(speed / bowl[0]) / bowl[1]) ** 2
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    mean = float(weight @ speed)
    sigma = float(np.sqrt(weight @ (speed - mean) ** 2))
    total = np.cumsum(weight)
    low, high = (float(np.interp(q, total, speed)) for q in (0.025, 0.975))
    return mean, sigma, (low, high)


def alone(shown: Shown) -> Single | None:
    """What one rail channel tells of a train that no catalogue type explains."""
    if shown.top < shown.limits[0] * _APART:
        return None
    speeds = [] if shown.guess is None else [shown.guess]
    speeds += [float(v) for v in _trials(shown)]
    speeds = [v for v in speeds if v <= shown.top]
    trials, seen = _deflected(shown, speeds)
    if not seen:
        trials += _energetic(shown, speeds)
    if not trials:
        return None
    best, worth = _likeliest(shown, trials)
    fine = _bowl(shown, best)
    limits = (shown.limits[0], shown.top)
    if fine is not None:
        nominal = fine.value / shown.bowl[0]
        spread = float(np.sqrt(shown.bowl[1] ** 2 + fine.sigma**2 + SHAPE_SIGMA**2))
        stand = bogies(fine.times)
        if not _BASES[0] < stand.base * nominal < _BASES[1]:
            stand = Bogies()
        # a bogie of one broad pulse explains little less than its two wheelsets do
        placed = np.all(fine.time_sigma > 0) and fine.worth(placed=True) > _BEYOND_DOUBT
        rough = PLACE_SIGMA if best.placed or placed else _MERGED
        if rough == _MERGED:  # bowls about wrong places are as wide as these are wrong
            spread = float(np.hypot(spread, 0.5 * shown.bowl[0] * _MERGED))
        speed = _posterior(nominal, stand, (nominal, spread), limits, rough)
        method = "wheelbase and bowl of the deflection"
    elif best.bogies.clear:
        stand = best.bogies
        rough = PLACE_SIGMA if best.placed else _MERGED
        speed = _posterior(stand.speeds()[0], stand, None, limits, rough)
        method = "typical wheelbase"
    else:
        return None
    place = float(np.median(best.found.sigma)) * speed[0] / best.speed
    times = best.times if fine is None else fine.times
    return _result(times, place, rough, speed, best.found, fine, worth, stand, method)


def _bowl(shown: Shown, best: _Trial) -> Corner | None:
    """The corner of the deflection by the wheelsets of a trial; ``None`` if they do not show it.

    Waves shorter than the bowl, of roughness and sleepers, have a corner of their own: it is looked
    for about the speeds that the wheelbase allows, the nearest to what is known of the site kept.
    """
    spread = float(np.hypot(shown.bowl[1], SHAPE_SIGMA))
    found: list[tuple[float, Corner]] = []
    for (share, _), speed in zip(
        WHEELBASES if best.bogies.clear else ((1.0, 0.0),),
        best.bogies.speeds() or [best.speed],
        strict=True,
    ):
        fine = _refined(shown.wave, best.times, WAVENUMBER * speed)
        if fine is not None:
            off = float(np.log(fine.value / (shown.bowl[0] * speed))) / spread
            found.append((float(np.log(share)) - 0.5 * off**2, fine))
    return max(found, key=lambda pair: pair[0])[1] if found else None


def _refined(wave: Wave, times: Array, first: float) -> Corner | None:
    """The corner about a first guess (rad/s), with places and loads of all wheelsets, or with the
    loads alone at the places that were found."""
    for refits in (1, 0):
        trial = corner(wave, times, first, refits=refits)
        trial = trial and corner(wave, trial.times, trial.value, refits=refits)
        if trial is not None and trial.worth(placed=refits > 0) > 0:
            return trial
    return None


def accelerated(times: Array, sigma: float, stand: Bogies, speed: float) -> tuple[float, float]:
    """Acceleration (m/s²) at mid-train, and its standard deviation, by cars of one kind.

    A distance that repeats takes less and less time. With the place s_k of bogie k behind the
    first of its row, n and m of the longer and shorter distances, its time is

        t_k = t_0 + n T_1 + m T_2 - a / (2 v) (t_k - t_m)²,

    about the middle t_m of the train: least squares of t_0 of every row, T_1, T_2 and a, with the
    prior of trains that accelerate.

    Args:
        times: of the wheelsets (s).
        sigma: of these, usual standard deviation (s).
        stand: their bogies.
        speed: at mid-train (m/s).
    """
    if stand.centres is None:
        return 0.0, PRIOR_ACCELERATION
    at = _middles(times, stand.base)
    kinds = np.array(stand.centres)
    alike = np.abs(np.log(np.diff(at)[:, None] / kinds)) < SAME_GAP
    if np.log(stand.ratio) < SAME_GAP:
        alike = alike.any(axis=1, keepdims=True)
    row = np.append(0, np.cumsum(~alike.any(axis=1)))
    passed = np.concatenate([np.zeros((1, alike.shape[1])), np.cumsum(alike, axis=0)])
    away = at - 0.5 * (times[0] + times[-1])
    matrix = np.column_stack([-(away**2) / (2 * speed), passed, row[:, None] == np.unique(row)])
    # pulled towards the prior, in units of the sigma of a bogie's middle
    usual = sigma / 2**0.5
    pull = np.zeros((1, matrix.shape[1]))
    pull[0, 0] = usual / PRIOR_ACCELERATION
    both = np.concatenate([matrix, pull])
    normal = np.linalg.pinv(both.T @ both)
    fit = normal @ matrix.T @ at
    rest = at - matrix @ fit
    free = max(at.size - int(np.linalg.matrix_rank(matrix)), 0)
    # few of them tell their own scatter badly: the sigma counts like four more
    variance = (float(rest @ rest) + _LIKE * usual**2) / (free + _LIKE)
    return float(fit[0]), float(min(np.sqrt(variance * normal[0, 0]), PRIOR_ACCELERATION))


def _result(
    times: Array,
    place: float,
    rough: float,
    speed: tuple[float, float, tuple[float, float]],
    found: Wheelsets,
    fine: Corner | None,
    worth: float,
    stand: Bogies,
    method: str,
) -> Single:
    middle = 0.5 * float(times[0] + times[-1])
    mean, sigma, _ = speed
    if fine is not None and np.all(fine.time_sigma > 0) and rough < _MERGED:
        spread = np.hypot(fine.time_sigma, _BOWL_SIGMA / mean)
    else:
        spread = np.full(times.size, float(np.hypot(place, rough)) / mean)
    rate, rate_sigma = accelerated(times, float(np.median(spread)), stand, mean)
    covariance = np.diag([place**2, sigma**2, rate_sigma**2 + (rate * sigma / mean) ** 2])
    away = middle - float(times[0])
    motion = Motion(middle, mean * away - 0.5 * rate * away**2, mean, rate, covariance)
    return Single(
        times=times,
        time_sigma=spread,
        speed=speed,
        motion=motion,
        certainty=found.certainty,
        contrast=found.contrast,
        corner=fine,
        worth=worth,
        bogies=stand,
        method=method,
    )
