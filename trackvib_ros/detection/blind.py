"""Without a catalogue: speed from two channels, wheelsets as peaks, spacings as a result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from . import travel
from .bowl import WAVENUMBER, corner
from .calibration import Calibration
from .delay import FIRST_SIGMA, KNOWN_START
from .kinematics import Motion
from .place import STIFFNESS, Wave, agreement, likelihood, locate
from .record import Record
from .single import HUMP, HUMP_FINE, SAME_GAP, Shown, alone, bogies, log_energy
from .strength import strong_interval
from .travel import Pair, Travel
from .wheelsets import Wheelsets, find, heights

Array = NDArray[np.float64]

CONFIDENT = 0.8
"""Least probability of a number of wheelsets that is told without reserve."""


_WAY = 0.95  # probability of a delay that tells the direction
_PULSE_CELLS = 60  # of :data:`travel.CELL`
_EXPLAINED = 0.9  # of a signal's variance, at which no other is needed
_BOTH = 1 / 3  # least height of a wheelset's pulse at one channel over that at the other, usual 1
_PARTNER = 3.6  # m, the other wheelset of a bogie, or of the next one
_PAIRED = 0.7  # share of the wheelsets that have one, when wheelsets and not bogies are seen
_LEAST_BOGIES, _LEAST_WHEELSETS = 3, 4  # a delay fits any two coincidences
_LEAST_WORTH = 25.0  # e^25 outweighs the speeds and pulses tried, as for two channels
_LIKELY = 0.5  # a number of wheelsets in one channel that is likelier right than wrong
_AMONG = (2.0, 60.0)  # Hz, in which those of a type are compared with others
_ELSEWHERE = 0.6  # m, half the least distance of two wheelsets
_BOGIE = 2  # wheelsets
_PULSE_SIGMA_S = 0.0004  # energy is measured in bins of about 1 ms
_SHOWN = 0.9  # of the two metres about a wheelset, to be measured
_SHAPE = 0.012  # m, of wheelsets against each other, by the shape of their pulse: computed at 40 dB
_GROWTH = 0.0009  # m, of a deflection's place from the middle of a train to its end: rms at 40 dB
_BENDS = 4  # most corrections of the acceleration, until one is less than its sigma
_PLACE = 0.15  # m, of all pulses against their wheelsets, before their deflection is added


@dataclass(frozen=True)
class Blind:
    """A train described without its type.

    Attributes:
        motion: motion past the reference point.
        speed: at mid-train (m/s), with standard deviation.
        times: wheelsets at the reference channel (s).
        time_sigma: their standard deviations (s).
        regular: 0 to 1, probability that the number of wheelsets is right; with less than
            :data:`CONFIDENT` the count is not to be trusted.
        direction: +1, -1, or 0 unknown.
        correlation: of the energies of two channels; 0 with one channel.
        travels: whether this is a train: two channels show the same wheelsets one after the other,
            or one shows bogies of one wheelbase, or cars of one kind.
        method: how the speed was obtained.
        axle_method: how the wheelsets were.
        spacing_sigma: of the distance between successive wheelsets (m), the speed apart.
        interval: of 95 % of the speed at mid-train (m/s), if it is not symmetric.
        cars: the longer over the shorter distance of successive bogies if one channel shows cars
            of one kind; 0 otherwise. That tells more of a train than the nearest type's pattern.
        sensors: channels used, the reference first.
        x: position of the reference (m).
        baseline: stated distance of the second channel from the reference (m).
    """

    sensors: tuple[str, ...]
    x: float
    motion: Motion
    speed: tuple[float, float]
    times: Array
    time_sigma: Array
    regular: float
    direction: int
    correlation: float
    travels: bool
    method: str
    axle_method: str = "energy peak"
    spacing_sigma: float = 0.3
    baseline: float = np.inf
    interval: tuple[float, float] | None = None
    cars: float = 0.0

    @property
    def spacings(self) -> Array:
        """Distances between successive wheelsets (m)."""
        return np.asarray(np.diff(self.motion.distance_at(self.times)))

    def contradicts(self, places: Array, motion: Motion, wave: Wave) -> bool:
        """Whether a bogie or more of this train is not where a type has one, or it has other cars.

        This must be a train without the type, and the deflection must show it. Of wheelsets that
        only one of the two has, those of this train must explain more of the deflection than their
        places and loads cost (two unknowns each, Bayesian information), or those of the type less
        than their loads do: else they were missed, or found by chance. What a hole of the record
        hides is not missing, and a deflection that clipping cut off tells neither.

        Args:
            places: of the type's wheelsets, in order (m).
            motion: of the type past the reference point.
            wave: low-passed waveform of the channel.
        """
        if wave.clipped or not (self.travels or self.cars):
            return False
        other = bogies(places)
        if self.cars and other.cars and abs(np.log(self.cars / other.ratio)) > SAME_GAP:
            return True
        every = motion.distance_at(self.times)
        apart = np.abs(every[:, None] - places[None, :])
        own = every[apart.min(axis=1) > _ELSEWHERE]
        own = own[_measured(wave, motion, own) >= _SHOWN]
        listed = apart.min(axis=0) <= _ELSEWHERE
        listed |= _measured(wave, motion, places) < _SHOWN
        more, fewer = own.size, int(np.sum(~listed))
        both = np.sort(np.append(places, own))
        first, last = motion.time_at(both[[0, -1]])
        cost = 0.5 * float(np.log(both.size))

        def gain(at: Array) -> float:
            if not at.size:
                return 0.0
            span, guess = (float(first), float(last)), WAVENUMBER * motion.speed
            fine = corner(wave, motion.time_at(at), guess, _AMONG, refits=0, span=span)
            return -np.inf if fine is None else fine.gain

        if max(more, fewer) < _BOGIE or gain(every) < 2 * cost * every.size:
            return False
        if more >= _BOGIE and gain(both) - gain(places) > 2 * cost * more:
            return True
        return fewer >= _BOGIE and gain(places) - gain(places[listed]) < cost * fewer


def _measured(wave: Wave, motion: Motion, places: Array) -> Array:
    """Measured part of the metre on either side of every wheelset."""
    total = np.concatenate([[0.0], np.cumsum(wave.valid)])
    first, last = np.searchsorted(wave.time, motion.time_at(np.stack([places - 1, places + 1])))
    return np.asarray((total[last] - total[first]) / np.maximum(last - first, 1))


def describe(
    records: Sequence[Record],
    within: tuple[float, float],
    interval: tuple[float, float],
    limits: tuple[float, float],
    limited: bool = False,
) -> Blind | None:
    """What two rail channels tell of a train that no catalogue type explains.

    Args:
        records: rail channels, two or more.
        within: the event (s).
        interval: first and last strong energy (s).
        limits: speeds (m/s).
        limited: whether the blows of flats hide its wheelsets.
    """
    ordered = sorted(records, key=lambda r: r.channel.x)
    blind = _two_channels(ordered[0], ordered[-1], within, limits, limited)
    return blind and _wary(blind, interval)


def at_site(blind: Blind, site: Calibration) -> Blind:
    """With what is known of the distance between the two channels, learned or doubted."""
    if len(blind.sensors) < 2:
        return blind
    offset, covariance = site.relative(blind.sensors)
    factor = 1 + float(offset[1]) / blind.baseline
    relative = float(covariance[1, 1]) ** 0.5 / blind.baseline
    motion, (speed, sigma) = blind.motion, blind.speed
    scaled = factor**2 * motion.covariance
    scaled[1, 1] += (relative * motion.speed) ** 2
    return replace(
        blind,
        motion=Motion(
            motion.epoch,
            factor * motion.distance,
            factor * motion.speed,
            factor * motion.acceleration,
            scaled,
        ),
        speed=(factor * speed, float(np.hypot(factor * sigma, relative * speed))),
    )


def _wary(blind: Blind, interval: tuple[float, float]) -> Blind:
    """With the doubt that wheelsets before the first or after the last one were missed.

    Strong energy that no wheelset explains is one that was missed, if it lasts for longer than the
    longest gap of the train. Where the number of wheelsets is in doubt, that which the rail carries
    is one too, one beyond the strong energy may be none, and a whole gap may be missing. What may
    go on for longer beyond its wheelsets than they last is no train.
    """
    longest = float(np.max(np.diff(blind.times)))
    sure = blind.regular >= CONFIDENT
    doubt = 0.0 if sure else float((1 - blind.regular) ** 0.5) * longest
    sigma = blind.time_sigma.copy()
    for k, missed in (
        (0, float(blind.times[0]) - interval[0]),
        (-1, interval[1] - float(blind.times[-1])),
    ):
        off = abs(missed) if not sure or missed > longest else 0.0
        sigma[k] = np.sqrt(sigma[k] ** 2 + off**2 + doubt**2)
    located = float(np.max(sigma)) < float(blind.times[-1] - blind.times[0])
    return replace(blind, time_sigma=sigma, travels=blind.travels and located)


def _signals(pair: Pair, found: Travel) -> list[tuple[Array, Array, Array]]:
    """Waveforms, then log-energies per band, of both channels over distance; the first guess of a
    wheelset's pulse in them, or what it is a mixture of."""
    edges = pair.edges(found.motion, found.direction)
    lag = np.arange(-_PULSE_CELLS, _PULSE_CELLS + 1) * travel.CELL
    curve = 0.5**0.5 * np.outer(STIFFNESS, np.abs(lag))
    bending = np.exp(-curve) * (np.cos(curve) - np.sin(curve))
    waves = [wave.cells(e) for wave, e in zip(pair.waves, edges, strict=True)]
    first, second, family = (
        travel.band_pass(x, travel.FINE, travel.BROAD) for x in (*waves, bending)
    )
    out: list[tuple[Array, Array, Array]] = [(first, second, family)]
    hump = travel.band_pass(np.exp(-0.5 * (lag / HUMP) ** 2), HUMP_FINE, travel.BROAD)
    for two in zip(*pair.traces, strict=True):
        first, second = (
            travel.band_pass(log_energy(t, e), HUMP_FINE, travel.BROAD)
            for t, e in zip(two, edges, strict=True)
        )
        out.append((first, second, hump))
    return out


def _two_channels(
    a: Record,
    b: Record,
    within: tuple[float, float],
    limits: tuple[float, float],
    limited: bool,
) -> Blind | None:
    pair = Pair(
        (travel.deflection(a.window, within), travel.deflection(b.window, within)),
        (a.traces(within, limited), b.traces(within, limited)),
        b.channel.x - a.channel.x,
        within,
    )
    found = travel.search(pair, limits)
    if found is None or not found.clear:
        return None
    best: tuple[Wheelsets, Array, Array] | None = None
    for first, second, pulse in _signals(pair, found):
        sign = 1.0 if first @ second >= 0 else -1.0
        mean, half = 0.5 * (first + sign * second), 0.5 * (first - sign * second)
        wheelsets = find(mean, half, pulse)
        if wheelsets is not None and (best is None or wheelsets.explained > best[0].explained):
            best = (wheelsets, first, sign * second)
        if best is not None and best[0].explained > _EXPLAINED:
            break
    if best is None:
        return None
    wheelsets, first, second = best
    levels = np.stack([heights(first, wheelsets), heights(second, wheelsets)])
    usual = np.median(levels, axis=1, keepdims=True)
    if np.all(usual > 0):  # noise may let less of all of them be seen at one channel
        levels = levels / usual
    both = levels.min(axis=0) > _BOTH * np.abs(levels).max(axis=0)
    start = float(pair.axis(found.motion, found.direction)[0]) + 0.5 * travel.CELL
    motion, places, place_sigma = _placed(a, b, found, start + wheelsets.place)
    sure = 1.0
    if not _in_order(pair, a.window.bands[found.band], found):
        covariance = motion.covariance.copy()
        covariance[1, 1] += found.doubt**2
        motion, sure = replace(motion, covariance=covariance), found.sure
    times = motion.time_at(places)
    motion = _bent(a, b, motion, found.direction, places)
    places = motion.distance_at(times)
    middle = float(motion.time_at(0.5 * float(places[0] + places[-1])))
    speed = float(motion.speed_at(middle))
    near = np.diff(wheelsets.place) < _PARTNER
    paired = np.append(near, False) | np.append(False, near)
    return Blind(
        sensors=(a.channel.name, b.channel.name),
        x=a.channel.x,
        motion=motion,
        speed=(speed, motion.speed_sigma(middle)),
        times=times,
        time_sigma=np.sqrt(wheelsets.sigma**2 + place_sigma**2 + _SHAPE**2)
        / motion.speed_at(times),
        # bogies further apart than wheelsets are: one pulse for both wheelsets of a bogie
        regular=min(wheelsets.certainty, sure, 1.0 if paired.mean() > _PAIRED else 0.5),
        direction=found.direction if sure > _WAY else 0,
        correlation=found.correlation[1],
        travels=_is_train(wheelsets.place[both], paired[both]),
        method="delay between two rail channels",
        axle_method="pulses common to two rail channels",
        spacing_sigma=float(np.hypot(2**0.5 * np.median(wheelsets.sigma), 2 * _SHAPE)),
        baseline=b.channel.x - a.channel.x,
    )


def _in_order(pair: Pair, band: tuple[float, float], found: Travel) -> bool:
    """Whether a train reaches both channels on record, one after the other as a motion says."""
    starts = []
    for traces in pair.traces:
        trace = traces[found.band]
        strong = strong_interval(trace, band[1] - band[0], pair.within)
        if strong is None or strong[0] < max(pair.within[0], float(trace.time[0])) + KNOWN_START:
            return False
        starts.append(strong[0])
    late = starts[1] - starts[0] - found.direction * pair.baseline / found.motion.speed
    return abs(late) * found.motion.speed < 2 * FIRST_SIGMA


def _placed(a: Record, b: Record, found: Travel, places: Array) -> tuple[Motion, Array, float]:
    """Motion, places of the wheelsets at the first channel and their common sigma (m), by the
    deflection that all wheelsets carry, added in phase at either channel."""
    baseline = b.channel.x - a.channel.x
    motion, way = found.motion, found.direction
    tables = [
        likelihood(
            r.wave(),
            motion,
            places + ahead,
        )
        for r, ahead in ((a, 0.0), (b, way * baseline))
    ]
    shift, place = locate(tables, np.full(2, _PLACE))
    relative = float(place[0, 0] + place[1, 1] - 2 * place[0, 1]) ** 0.5 / baseline
    if relative * motion.speed < motion.covariance[1, 1] ** 0.5:
        factor = baseline / (baseline + way * float(shift[1] - shift[0]))
        covariance = motion.covariance.copy()
        covariance[1, 1] = (relative * motion.speed) ** 2
        motion = Motion(
            motion.epoch,
            0.0,
            motion.speed * factor,
            motion.acceleration * factor,
            covariance,
        )
        return motion, (places + shift[0]) * factor, float(place[0, 0]) ** 0.5
    return motion, places + shift[0], float(place[0, 0]) ** 0.5


def _bent(a: Record, b: Record, motion: Motion, direction: int, places: Array) -> Motion:
    """With the acceleration by how the way between two channels seems to grow along the train.

    A wheelset that runs d beyond its place at the second channel, and not at the first, is slower
    by d / baseline than was thought.

    Args:
        a, b: the channels.
        motion: of the train.
        direction: +1 or -1.
        places: of its wheelsets at the first channel (m).
    """
    way = direction * (b.channel.x - a.channel.x)
    times = motion.time_at(places)
    middle = float(motion.time_at(0.5 * float(places[0] + places[-1])))
    found = motion.moved(middle)
    for _ in range(_BENDS):
        free = replace(found, covariance=np.eye(3))
        at = found.distance_at(times)
        first, second = (
            agreement([r.wave()], free, [at + ahead]) for r, ahead in ((a, 0.0), (b, way))
        )
        # per metre of growth from the middle of the train to its end
        rate = -2 * found.speed**2 / (way * float(at[-1] - at[0]))
        grown = first.covariance[0, 0] + second.covariance[0, 0] + 2 * _GROWTH**2
        sigma = abs(rate) * float(grown) ** 0.5
        # of the delay as a whole, twice the errors are stated
        if sigma > 0.5 * motion.acceleration_sigma:
            return motion
        more = rate * float(second.change[0] - first.change[0])
        found = replace(found, acceleration=found.acceleration + more)
        if abs(more) < sigma:
            break
    covariance = found.covariance.copy()
    covariance[2], covariance[:, 2], covariance[2, 2] = 0.0, 0.0, sigma**2
    return replace(found, covariance=covariance)


def _is_train(places: Array, paired: NDArray[np.bool_]) -> bool:
    """Whether pulses that both channels show are a train: three bogies or more, as any two
    disturbances have a delay that fits; in pairs, or many. The ends of two cars have two bogies:
    what goes on at such gaps is a flat wheel that strikes the rail at every turn."""
    ends = np.flatnonzero(np.diff(places) > _PARTNER) + 1
    groups = np.diff(np.concatenate([[0], ends, [places.size]]))
    many = paired.sum() >= _LEAST_WHEELSETS or places.size >= 2 * _LEAST_WHEELSETS
    usual = float(np.median(groups)) <= 2 * _BOGIE
    return groups.size >= _LEAST_BOGIES and usual and bool(many)


def describe_alone(shown: Shown) -> Blind | None:
    """What one rail channel tells of a train that no catalogue type explains."""
    found = alone(shown)
    if found is None:
        return None
    speed, sigma, span = found.speed
    places = found.motion.distance_at(found.times)
    gaps = np.diff(places)
    paired = np.append(gaps < _PARTNER, False) | np.append(False, gaps < _PARTNER)
    deflected = found.corner is not None
    # what clipping leaves of a deflection has another width
    seen = deflected and not shown.wave.clipped and found.times.size >= 2 * _LEAST_WHEELSETS
    # three wheelsets in every bogie are rather two, and what rings on
    whole = deflected and paired.mean() > _PAIRED and found.bogies.each <= _BOGIE
    blind = Blind(
        sensors=(shown.record.channel.name,),
        x=shown.record.channel.x,
        motion=found.motion,
        speed=(speed, sigma),
        times=found.times,
        time_sigma=np.hypot(found.time_sigma, 0.0 if deflected else _PULSE_SIGMA_S),
        regular=found.certainty if whole else min(found.certainty, 0.5),
        direction=0,
        correlation=0.0,
        travels=seen
        and found.worth > _LEAST_WORTH
        and (found.bogies.cars or (found.bogies.clear and found.certainty > _LIKELY)),
        cars=found.bogies.ratio if seen and found.worth > 0 and found.bogies.cars else 0.0,
        method=found.method,
        axle_method="deflection of the rail" if deflected else "energy peak",
        interval=span,
    )
    return _wary(blind, shown.interval)
