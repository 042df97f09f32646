"""Rail accelerations as they come from elsewhere: stand-ins with known truth, made without solver.

``python -m tests.detection.field_like`` prints what the detector makes of them, one line per
disturbance. Seeds of ``--set tuning`` and ``--set figures`` never meet.

A wheelset carries noise along the track: each has its own noise, level (4 dB standard deviation)
and spectrum-shaping rail, near field of half a metre, and a part that runs ahead and behind through
the rail and fades by 0.3 to 1.5 dB/m (track decay rates of EN 15461 reach from about 0.3 to 10
dB/m). Below 60 Hz the quasi-static deflection under the wheel adds its acceleration.
Disturbances: see :data:`DISTURBANCES` and :data:`SHAPES`.

Geometries are public figures: length over couplers, distance of bogie centres and wheelbase of ICE
1 and 3, TGV Reseau and Duplex, Re 460 with EW IV, class 642 and 425 railcars, TRAXX with Eanos,
Sgns and two-axle wagons as in the type sheets and encyclopaedia articles of these vehicles, rounded
to decimetres; ETR 500 and Talgo from EN 1991-2, annex on train types.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from tests.detection.stand_ins import ratios, run, spread
from trackvib_ros.detection import CONFIRMED, Catalogue, Channel, detect

Array = NDArray[np.float64]
RATES = (600.0, 1000.0, 2048.0, 5000.0, 10_000.0, 51_200.0 / 3)
BASELINE = (4.0, 40.0)  # m between two rail sensors


def _bogies(*cars: tuple[float, float, float]) -> Array:
    """Wheelsets (m) of cars on own bogies: length over couplers, bogie centres, wheelbase (m)."""
    front, axles = 0.0, []
    for length, centres, base in cars:
        for bogie in (-centres / 2, centres / 2):
            axles += [front + length / 2 + bogie + side * base / 2 for side in (-1, 1)]
        front += length
    return np.array(axles) - axles[0]


def _articulated(power: tuple[float, float, float], ends: float, cars: int, pitch: float) -> Array:
    """Power cars at both ends, cars on shared bogies between them.

    Args:
        power: of a power car, as for cars on own bogies.
        ends: from the inner bogie of a power car to the first bogie behind it (m).
        cars: number between the power cars.
        pitch: distance of shared bogies (m).
    """
    centres, base = power[1], power[2]
    places = [0.0, centres]
    places += [centres + ends + pitch * i for i in range(cars + 1)]
    places += [places[-1] + ends, places[-1] + ends + centres]
    return np.array([p + side for p in places for side in (0.0, base)])


def _jacobs(first: float, inner: tuple[float, ...], base: float, shared: float) -> Array:
    """Railcar: motor bogies at the ends, shared ones between, at distances (m)."""
    places = np.cumsum([0.0, first, *inner, first])
    bases = [base, *[shared] * (len(places) - 2), base]
    axles = np.array([p + s * b / 2 for p, b in zip(places, bases, strict=True) for s in (-1, 1)])
    return axles - axles[0]


def _twice(axles: Array, length: float) -> Array:
    return np.concatenate([axles, axles + length])


_ICE1 = (20.56, 11.46, 3.0)
_COACH = (26.4, 19.0, 2.5)
_TRAXX = (18.9, 10.4, 2.6)
_EANOS = (15.74, 10.5, 1.8)
_SGNS = (19.74, 14.2, 1.8)
_RESEAU = _articulated((22.15, 14.0, 3.0), 6.3, 8, 18.7)
_R425 = _jacobs(14.7, (15.5, 15.5), 2.2, 2.7)
_DESIRO = _jacobs(16.0, (), 1.9, 2.65)

TRAINS: dict[str, Array] = {
    "ICE1": _bogies(_ICE1, *[_COACH] * 12, _ICE1),
    "ICE2": _bogies(_ICE1, *[_COACH] * 7),
    "ICE3": _bogies((25.84, 17.375, 2.5), *[(24.775, 17.375, 2.5)] * 6, (25.84, 17.375, 2.5)),
    "TGV_Reseau": _RESEAU,
    "TGV_double": _twice(_RESEAU, 200.19),
    "ETR500": _bogies((20.25, 12.0, 3.0), *[(26.1, 19.0, 3.0)] * 10, (20.25, 12.0, 3.0)),
    "Re460_EWIV": _bogies((18.5, 11.0, 2.8), *[(26.4, 19.0, 2.5)] * 9),
    "class_642": _DESIRO,
    "class_425": _R425,
    "class_425_double": _twice(_R425, 67.5),
    "freight_coal": _bogies(_TRAXX, *[_EANOS] * 24),
    "freight_boxes": _bogies(_TRAXX, *[_SGNS] * 18),
}
"""Wheelsets behind the first (m)."""

_TOP = {"ICE": 300, "TGV": 300, "ETR": 280, "Re4": 200, "cla": 140, "fre": 120}


@dataclass
class StandIn:
    """A record under construction.

    Attributes:
        rate: samples per second.
        channels: with their positions.
        samples: (samples, channels).
        axles: of the train behind its first wheelset (m).
        speed: at the first wheelset (m/s).
        start: first wheelset at x = 0 (s).
        acceleration: m/s².
        direction: +1 or -1.
        truncated: whether wheelsets passed before the record.
        clock: times of the samples as told (s); the rate alone if ``None``.
        stated: channels as told to the detector.
        others: later trains in the same record.
    """

    rate: float
    channels: tuple[Channel, ...]
    samples: Array
    train: str
    axles: Array
    speed: float
    start: float
    acceleration: float
    direction: int
    random: np.random.Generator
    truncated: bool = False
    marks: dict[str, Any] = field(default_factory=dict)
    clock: Array | None = None
    stated: tuple[Channel, ...] = ()
    others: list[StandIn] = field(default_factory=list)

    @property
    def time(self) -> Array:
        return np.arange(len(self.samples)) / self.rate

    def distance(self, time: Array) -> Array:
        t = time - self.start
        return self.speed * t + 0.5 * self.acceleration * t * t

    def velocity(self, time: Array) -> Array:
        return self.speed + self.acceleration * (time - self.start)

    def axle_times(self, x: float) -> Array:
        s = self.direction * x + self.axles
        root = np.sqrt(np.maximum(self.speed**2 + 2 * self.acceleration * s, 1.0))
        return np.asarray(self.start + 2 * s / (self.speed + root))

    def mid_speed(self, x: float) -> float:
        s = self.direction * x + 0.5 * self.axles[-1]
        return float(np.sqrt(self.speed**2 + 2 * self.acceleration * s))

    def part(self, channel: int, offset: float, reach: float) -> tuple[slice, Array]:
        """Samples while a wheelset is within reach (m) of a channel, and where it is (m)."""
        time = self.start + self._time(self.direction * self.channels[channel].x + offset)
        span = reach / max(self.speed, 5.0) * 1.3
        first = max(0, int((time - span) * self.rate))
        last = min(len(self.samples), int((time + span) * self.rate))
        part = slice(first, max(first, last))
        t = np.arange(part.start, part.stop) / self.rate
        return part, self.distance(t) - self.direction * self.channels[channel].x - offset

    def _time(self, s: float) -> float:
        root = np.sqrt(max(self.speed**2 + 2 * self.acceleration * s, 1.0))
        return float(2 * s / (self.speed + root))


def _shaped(random: np.random.Generator, n: int, sos: Array) -> Array:
    return np.asarray(signal.sosfilt(sos, random.standard_normal(n + 200))[200:])


def _rail(random: np.random.Generator, rate: float) -> Array:
    """A band of the rail's vibration: its limits differ from site to site."""
    top = min(10 ** random.uniform(2.4, 3.4), 0.42 * rate)
    low = min(10 ** random.uniform(1.2, 2.0), 0.4 * top)
    sos = signal.butter(2, [low, top], "bandpass", fs=rate, output="sos")
    return np.asarray(sos)


def train_signal(s: StandIn, wheel_db: float = 4.0) -> None:
    """Add the bursts of every wheelset, about 1 at the wheels."""
    random, decay = s.random, s.random.uniform(0.3, 1.5)
    skirt, width = 10 ** random.uniform(-1.2, -0.4), random.uniform(0.3, 0.7)
    shape = _rail(random, s.rate)
    static = 10 ** random.uniform(-2.0, -0.3) * (s.speed / 60) ** 2
    gains = 10 ** (np.clip(random.normal(0, wheel_db, s.axles.size), -2 * wheel_db, 9) / 20)
    for c in range(len(s.channels)):
        for offset, gain in zip(s.axles, gains, strict=True):
            part, xi = s.part(c, offset, 60.0)
            if xi.size < 8:
                continue
            far = 10 ** (-decay * np.abs(xi) / 20)
            envelope = np.exp(-0.5 * (xi / width) ** 2) + skirt * far
            burst = _shaped(random, xi.size, shape)
            q = np.abs(xi)
            bend = np.exp(-q) * (np.cos(q) - np.sin(q))
            own = gain * 10 ** (random.normal(0, 1) / 20)
            s.samples[part, c] += own * envelope * burst / _RMS + static * bend


_RMS = 0.5


def _echo(s: StandIn) -> None:
    """A crossing at a fixed distance: every wheelset hits it, too."""
    random, at = s.random, s.random.choice([-1, 1]) * s.random.uniform(2.0, 12.0)
    decay, strength = random.uniform(0.3, 1.0), 10 ** random.uniform(-0.2, 0.4)
    shape = _rail(random, s.rate)
    for c in range(len(s.channels)):
        for offset in s.axles:
            part, xi = s.part(c, offset + at, 4.0)
            if xi.size < 8:
                continue
            reach = 10 ** (-decay * abs(at) / 20)
            hit = np.where(xi > 0, np.exp(-xi / 0.4), np.exp(xi / 0.05))
            s.samples[part, c] += strength * reach * hit * _shaped(random, xi.size, shape) / _RMS


def _sleepers(s: StandIn) -> None:
    """Sleeper-passing tone, loud near the wheels."""
    pitch, strength = 0.6, 10 ** s.random.uniform(-0.8, 0.0)
    _tone(s, lambda xi: 2 * np.pi * xi / pitch, strength, 3.0)


def _corrugation(s: StandIn) -> None:
    length, strength = s.random.uniform(0.03, 0.12), 10 ** s.random.uniform(-0.5, 0.5)
    _tone(s, lambda xi: 2 * np.pi * xi / length, strength, 4.0)


def _round(s: StandIn) -> None:
    """Out-of-round wheels: a quarter of the wheelsets hit the rail once or thrice a turn."""
    turn, order = np.pi * s.random.uniform(0.76, 0.92), s.random.choice([1, 3])
    for c in range(len(s.channels)):
        for offset in s.axles[s.random.random(s.axles.size) < 0.25]:
            part, xi = s.part(c, offset, 40.0)
            phase = (order * xi / turn + s.random.random()) % 1.0
            hit = np.exp(-phase * turn / order / 0.15) * 10 ** (-0.6 * np.abs(xi) / 20)
            s.samples[part, c] += hit * s.random.standard_normal(xi.size)


def _tone(s: StandIn, phase: Callable[[Array], Array], strength: float, reach: float) -> None:
    for c in range(len(s.channels)):
        for offset in s.axles:
            part, xi = s.part(c, offset, 4 * reach)
            wave = np.sin(phase(xi + offset)) * np.exp(-np.abs(xi) / reach)
            s.samples[part, c] += strength * wave


def _noise(s: StandIn, snr_db: float) -> None:
    """White noise and a tenth of it rising towards low frequencies."""
    times = s.axle_times(s.channels[0].x)
    inside = (s.time >= times[0]) & (s.time <= times[-1])
    level = float(np.sqrt(np.mean(s.samples[inside] ** 2))) * 10 ** (-snr_db / 20)
    s.samples += level * s.random.standard_normal(s.samples.shape)
    slow = signal.lfilter([0.03], [1, -0.97], s.random.standard_normal(s.samples.shape), axis=0)
    s.samples += level * slow
    s.marks["noise"] = level


def _hum(s: StandIn) -> None:
    """Mains: as strong as the noise or up to ten times."""
    level = s.marks["noise"] * 10 ** s.random.uniform(0, 1)
    base = s.random.choice([50.0, 50 / 3])
    for order, share in ((1, 1.0), (3, 0.3), (5, 0.1)):
        if order * base < 0.45 * s.rate:
            wave = np.sin(2 * np.pi * order * base * s.time + s.random.uniform(0, 6))
            s.samples += level * share * wave[:, None]


def _offset(s: StandIn) -> None:
    """An offset of a hundred peaks and a drift of ten over the record."""
    peak = float(np.max(np.abs(s.samples)))
    bend = np.cumsum(s.random.standard_normal(len(s.samples)))
    bend = bend / max(np.ptp(bend), 1e-9)
    smooth = signal.lfilter(*_slow(s.rate), bend)
    s.samples += peak * (100.0 + 10.0 * smooth)[:, None]


def _slow(rate: float) -> tuple[list[float], list[float]]:
    a = float(np.exp(-2 * np.pi * 0.2 / rate))
    return [1 - a], [1, -a]


def _counts(s: StandIn) -> None:
    """Whole counts of a 24-bit converter about a large offset."""
    peak = float(np.max(np.abs(s.samples)))
    s.samples[:] = np.round(s.samples / peak * 2**22 + 1_000_000)


def _coarse(s: StandIn) -> None:
    """Peaks of fifty counts: the noise is less than one."""
    peak = float(np.max(np.abs(s.samples)))
    s.samples[:] = np.round(s.samples / peak * 50)


def _saturated(s: StandIn) -> None:
    """int16, gain too high: clipped at a fifth of the peak."""
    peak = float(np.max(np.abs(s.samples)))
    s.samples[:] = np.clip(np.round(s.samples / (0.2 * peak) * 32767), -32768, 32767)


def _clipped(s: StandIn) -> None:
    limit = 0.05 * float(np.max(np.abs(s.samples)))
    s.samples[:] = np.clip(s.samples, -limit, limit)


def _gains(s: StandIn) -> None:
    s.samples *= 10 ** s.random.uniform(-2, 2, s.samples.shape[1])


def _tiny(s: StandIn) -> None:
    s.samples *= 1e-9


def _huge(s: StandIn) -> None:
    s.samples *= 1e9


def _missing(s: StandIn) -> None:
    s.samples[s.random.random(len(s.samples)) < 0.05] = np.nan


def _drops(s: StandIn) -> None:
    """Stretches of 20 ms to 0.3 s lost, a tenth of the record or less."""
    share, at = s.random.uniform(0.01, 0.1), 0.0
    while at < len(s.samples):
        length = s.random.uniform(0.02, 0.3) * s.rate
        at += s.random.exponential(length / share)
        s.samples[int(at) : int(at + length)] = np.nan


def _flats(s: StandIn) -> None:
    """One to four wheels hit the rail once a turn, up to twice as strong as a wheelset."""
    turn = np.pi * s.random.uniform(0.76, 0.92)
    shape, count = _rail(s.random, s.rate), int(s.random.integers(1, 5))
    for offset in s.random.choice(s.axles, count):
        phase, strength = s.random.random(), 10 ** s.random.uniform(-0.3, 0.3)
        for c in range(len(s.channels)):
            part, xi = s.part(c, offset, 40.0)
            after = np.mod(xi / turn + phase, 1.0) * turn
            hit = np.exp(-after / 0.15) * 10 ** (-0.6 * np.abs(xi) / 20)
            s.samples[part, c] += strength * hit * _shaped(s.random, xi.size, shape) / _RMS


def _joint(s: StandIn) -> None:
    """Rail joints every 15 to 36 m: what hits them is heard up to the next one."""
    pitch, first = s.random.uniform(15, 36), s.random.uniform(-36, 36)
    shape, strength = _rail(s.random, s.rate), 10 ** s.random.uniform(-0.5, 0.2)
    for c, channel in enumerate(s.channels):
        for at in first + pitch * np.arange(-3, 8) - s.direction * channel.x:
            for offset in s.axles if abs(at) < 20 else ():
                part, xi = s.part(c, offset + at, 3.0)
                hit = np.where(xi > 0, np.exp(-xi / 0.4), np.exp(xi / 0.05))
                reach = strength * 10 ** (-0.6 * abs(at) / 20)
                s.samples[part, c] += reach * hit * _shaped(s.random, xi.size, shape) / _RMS


def _coupled(s: StandIn) -> None:
    """Amplifier of a piezoelectric sensor: nothing below 0.5 to 5 Hz, undershoot after a pulse."""
    corner = 10 ** s.random.uniform(-0.3, 0.7)
    sos = signal.butter(1, corner, "high", fs=s.rate, output="sos")
    s.samples[:] = signal.sosfilt(sos, s.samples, axis=0)


def _resonant(s: StandIn) -> None:
    """The sensor, or what it is glued to, rings: 10 to 30 times as loud at its resonance."""
    for c in range(len(s.channels)):
        f = min(10 ** s.random.uniform(1.8, 3.3), 0.4 * s.rate)
        zeta = 1 / (2 * s.random.uniform(10, 30))
        w = 2 * np.pi * f
        b, a = signal.bilinear([w * w], [1, 2 * zeta * w, w * w], s.rate)
        s.samples[:, c] = signal.lfilter(b, a, s.samples[:, c])


def _reversed(s: StandIn) -> None:
    """A sensor upside down."""
    s.samples[:, int(s.random.integers(len(s.channels)))] *= -1


def _bits(s: StandIn) -> None:
    """A converter of 6 to 12 bits, full scale one to four times the peak."""
    step = float(np.max(np.abs(s.samples))) * 2.0 ** s.random.uniform(-11, -3)
    s.samples[:] = np.round(s.samples / step)


def _jitter(s: StandIn) -> None:
    """Stamps a third of a step off, in ms with three digits."""
    clock = s.time + np.clip(s.random.normal(0, 0.15, len(s.samples)), -0.45, 0.45) / s.rate
    s.clock = np.round(clock, 6)


def _paced(s: StandIn) -> None:
    """A clock that runs 1e-4 fast, and a record that starts at the seconds of an epoch."""
    s.clock = 1_700_000_000.0 + s.time * (1 + s.random.uniform(-1e-4, 1e-4))


def _moved(s: StandIn) -> None:
    """Sensors that are 0.1 to 1 m (standard deviation) from where they are said to be."""
    off = s.random.normal(0, 10 ** s.random.uniform(-1, 0), len(s.channels))
    s.stated = tuple(
        Channel(c.name, float(np.round(c.x + o, 2)), c.layer)
        for c, o in zip(s.channels, off, strict=True)
    )


def _loggers(s: StandIn) -> None:
    """Two loggers whose clocks are 10 ms to 1 s apart."""
    shift = int(10 ** s.random.uniform(-2, 0) * s.random.choice([-1, 1]) * s.rate)
    s.samples[:, -1] = np.roll(s.samples[:, -1], shift)
    s.marks["clock"] = shift / s.rate


def _turnout(s: StandIn) -> None:
    """Crossings and joints of a turnout within 25 m: each wheelset strikes every one of them.

    Crossing noses make peaks of several times those of plain track and last some ms (Milosevic et
    al., Sensors 20, 2020, 4176: 100 g and more beside 20 g).
    """
    random, shape = s.random, _rail(s.random, s.rate)
    for at, strength in zip(
        random.uniform(-25, 25, 3), 10 ** random.uniform(0, 0.7, 3), strict=True
    ):
        for c, channel in enumerate(s.channels):
            fade = 10 ** (-0.4 * abs(at - channel.x) / 20)
            for offset in s.axles:
                part, xi = s.part(c, offset + at - s.direction * channel.x, 3.0)
                own = strength * fade * 10 ** (random.normal(0, 4) / 20)
                hit = np.where(xi > 0, np.exp(-xi / 0.25), np.exp(xi / 0.02))
                s.samples[part, c] += own * hit * _shaped(random, xi.size, shape) / _RMS


def _charge(s: StandIn) -> None:
    """A charge amplifier set to structure-borne sound: second order, nothing below 5 to 20 Hz."""
    sos = signal.butter(2, 10 ** s.random.uniform(0.7, 1.3), "high", fs=s.rate, output="sos")
    s.samples[:] = signal.sosfilt(sos, s.samples, axis=0)


def _sleeper(s: StandIn) -> None:
    """A sensor on a sleeper: pads pass no more than 150 to 500 Hz, the ballast bends for metres.

    Resonance of a sleeper on its ballast under pads at 100 to 500 Hz (Thompson, Railway Noise and
    Vibration, 2009, ch. 3); deflection with the characteristic length of 0.9 to 1.4 m of soft
    ballasted track (Esveld, Modern Railway Track, 2001, ch. 5: L = 0.6 to 1.2 m and more).
    """
    top = min(10 ** s.random.uniform(2.2, 2.7), 0.42 * s.rate)
    low = signal.butter(2, top, "low", fs=s.rate, output="sos")
    s.samples[:] = signal.sosfilt(low, s.samples, axis=0)
    length, level = s.random.uniform(0.9, 1.4), 10 ** s.random.uniform(-0.7, 0.2)
    for c in range(len(s.channels)):
        for offset in s.axles:
            part, xi = s.part(c, offset, 10.0)
            q = np.abs(xi) / length
            bend = np.exp(-q) * (np.cos(q) - np.sin(q))
            s.samples[part, c] += level * (s.speed / 60) ** 2 * bend


def _none(_: StandIn) -> None:
    return


DISTURBANCES: dict[str, tuple[Callable[[StandIn], None], Callable[[StandIn], None]]] = {
    "none": (_none, _none),
    "echo": (_echo, _none),
    "sleepers": (_sleepers, _none),
    "corrugation": (_corrugation, _none),
    "round": (_round, _none),
    "hum": (_none, _hum),
    "offset": (_none, _offset),
    "counts": (_none, _counts),
    "coarse": (_none, _coarse),
    "saturated": (_none, _saturated),
    "clipped": (_none, _clipped),
    "gains": (_none, _gains),
    "tiny": (_none, _tiny),
    "huge": (_none, _huge),
    "missing": (_none, _missing),
    "drops": (_none, _drops),
    "flats": (_flats, _none),
    "joint": (_joint, _none),
    "coupled": (_none, _coupled),
    "resonant": (_resonant, _none),
    "reversed": (_none, _reversed),
    "bits": (_none, _bits),
    "jitter": (_none, _jitter),
    "paced": (_none, _paced),
    "moved": (_none, _moved),
    "loggers": (_none, _loggers),
    "turnout": (_turnout, _none),
    "charge": (_none, _charge),
    "sleeper": (_sleeper, _none),
}
"""What is added with the train, and what is done to the record after the noise."""

SHAPES = {
    "roomy": (3.0, 5.0, 3.0, 5.0),
    "second": (0.6, 1.2, 0.6, 1.2),
    "tight": (0.2, 0.2, 0.2, 0.2),
    "early": (0.1, 1.0, 3.0, 4.0),
    "late": (3.0, 4.0, 0.05, 0.5),
}
"""Seconds before the first wheelset and after the last, least and most."""


def stand_in(
    seed: int,
    disturbance: str = "none",
    shape: str = "roomy",
    rate: float | None = None,
    rails: int = 2,
    snr_db: float | None = None,
    train: str | None = None,
    cut: float = 0.0,
    baseline: tuple[float, float] = BASELINE,
    follow: float | None = None,
) -> StandIn:
    """One passage with everything about it drawn at random, but for what is given.

    Args:
        seed: of the random numbers.
        disturbance: of :data:`DISTURBANCES`; several with ``+``.
        shape: of :data:`SHAPES`.
        rate: samples per second.
        rails: 1 or 2 channels.
        snr_db: over the whole band between first and last wheelset.
        train: of :data:`TRAINS`.
        cut: share of the train that passed before the record began.
        baseline: limits of the distance between two sensors (m).
        follow: seconds after which another train passes.
    """
    random = np.random.default_rng(seed)
    name, axles, speed, acceleration, direction = _run(random, train)
    rate = float(random.choice(RATES)) if rate is None else rate
    snr = random.uniform(12, 40) if snr_db is None else snr_db
    channels = [Channel("a", 0.0, "rail")]
    if rails == 2:
        channels.append(Channel("b", float(round(random.uniform(*baseline), 2)), "rail"))
    low, high, low_end, high_end = SHAPES[shape]
    empty = np.zeros((0, rails))
    s = StandIn(rate, tuple(channels), empty, name, axles, speed, 0.0, acceleration, direction,
                random)  # fmt: skip
    times = np.stack([s.axle_times(c.x) for c in channels])
    s.start = random.uniform(low, high) - float(times.min())
    if cut:
        s.start -= low + cut * float(np.ptp(times[0]))
        s.truncated = True
    end = s.start + float(times.max())
    if follow is not None:
        other = StandIn(rate, tuple(channels), empty, *_run(random)[:3], 0.0, 0.0,
                        int(random.choice([-1, 1])), random)  # fmt: skip
        times = np.stack([other.axle_times(c.x) for c in channels])
        other.start = end + follow - float(times.min())
        end = other.start + float(times.max())
        s.others.append(other)
    end += random.uniform(low_end, high_end)
    s.samples = np.zeros((int(end * rate), rails))
    train_signal(s)
    for other in s.others:
        other.samples = s.samples
        train_signal(other)
    named = [DISTURBANCES[one] for one in disturbance.split("+")]
    for added, _ in named:
        added(s)
    _noise(s, snr)
    for _, done in named:
        done(s)
    return s


def _run(
    random: np.random.Generator, train: str | None = None
) -> tuple[str, Array, float, float, int]:
    """Name, wheelsets, speed, acceleration and direction of a train."""
    name = str(random.choice(list(TRAINS)))
    name = train or name
    axles = TRAINS[name]
    if random.random() < 0.5:
        axles = axles[-1] - axles[::-1]
    speed = random.uniform(40, _TOP[name[:3]]) / 3.6
    acceleration = random.normal(0, 0.15)
    acceleration = float(np.clip(acceleration, -0.15 * speed**2 / axles[-1], 0.6))
    return name, axles, speed, acceleration, int(random.choice([-1, 1]))


def catalogue(but: str = "") -> Catalogue:
    """All trains as a caller gives them, without one of them if named."""
    return Catalogue.from_axles({n: a.tolist() for n, a in TRAINS.items() if n != but})


def judge(s: StandIn, known: Catalogue | None = None) -> dict[str, Any]:
    """What the detector makes of a stand-in, against the truth."""
    clock = s.rate if s.clock is None else s.clock
    zero = 0.0 if s.clock is None else float(s.clock[0])
    events = detect(clock, s.samples, s.stated or s.channels, known or catalogue())
    told = [e for e in events if e.kind == "passage" and e.values["grade"] == CONFIRMED]
    arrivals = [e.stamp_ns * 1e-9 - zero for e in events if e.kind == "arrival"]
    first = min(float(s.axle_times(c.x)[0]) for c in s.channels)
    result: dict[str, Any] = {
        "train": s.train,
        "kmh": round(3.6 * s.mid_speed(0.0)),
        "rate": round(s.rate),
        "events": len(arrivals),
        "passages": len(told),
        "onset": min(arrivals) - first if arrivals else None,
    }
    if not told:
        return result
    event = told[0]
    v = event.values
    x = next(c.x for c in s.channels if c.name == v["reference"])
    times = s.axle_times(x)
    speed = v["speed"]
    result |= {
        "flags": list(event.quality),
        "type": v["type"],
        "score": v["score"],
        "speed": speed.value / s.mid_speed(x) - 1,
        "sigma": speed.sigma / s.mid_speed(x),
        "direction": {"forward": 1, "backward": -1, "unknown": 0}[v["direction"]] * s.direction,
    }
    if "departure_ns" in v:
        result["departure"] = v["departure_ns"] * 1e-9 - zero - times[-1]
    if "axle_count" in v:
        result |= {
            "count": v["axle_count"] - times.size,
            "arrival": v["arrival_ns"] * 1e-9 - zero - times[0],
        }
    return result


def _job(options: dict[str, Any], seed: int) -> dict[str, Any]:
    return judge(stand_in(seed, **options))


def rows() -> dict[str, dict[str, Any]]:
    """Conditions of the table."""
    table: dict[str, dict[str, Any]] = {d: {"disturbance": d} for d in DISTURBANCES}
    table |= {f"{d}, one rail": {"disturbance": d, "rails": 1} for d in DISTURBANCES}
    for shape in SHAPES:
        table[f"shape {shape}"] = {"shape": shape}
        table[f"shape {shape}, one rail"] = {"shape": shape, "rails": 1}
    table |= {f"begins inside, {c:.0%}": {"cut": c, "rails": 1} for c in (0.1, 0.4)}
    table |= {f"{r:.0f} Hz": {"rate": r} for r in (200.0, *RATES, 50_000.0)}
    return table


def line(name: str, results: Sequence[dict[str, Any]]) -> str:
    """One row of the table."""
    one = [r for r in results if r["passages"]]
    known = [r for r in one if r["type"] != "unknown" and "count" in r]
    onset = [1e3 * r["onset"] for r in results if r["onset"] is not None]
    return (
        f"| {name} | {len(results)} | {sum(r['events'] > 0 for r in results)} | {len(one)} "
        f"| {sum(max(0, r['passages'] - 1) for r in one)} "
        f"| {sum(r['type'] == r['train'] for r in known)}/{len(known)} "
        f"| {sum(r['count'] == 0 for r in known)} | {spread(one, 'speed', 100)} "
        f"| {spread(one, 'arrival', 1e3)} | {spread(one, 'departure', 1e3)} "
        f"| {max(onset, default=np.nan):.0f} | {ratios(one, 'speed', 'sigma')} |"
    )


HEAD = (
    "| condition | n | event | train | extra | type right/told | count right | speed p50/p95 % "
    "| arrival ms | departure ms | latest onset ms | error/sigma rms, inside 95 %, beyond 3 |"
)


def main() -> None:
    """Run and print the table."""
    run(__doc__, rows(), _job, line, HEAD)


if __name__ == "__main__":
    main()
