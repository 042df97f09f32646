"""Bridge strains as they come from elsewhere: stand-ins with known truth, made without solver.

``python -m tests.detection.strain_like`` prints what the detector makes of them, one line per
condition. Seeds of ``--set tuning`` and ``--set figures`` never meet.

A gauge answers every wheelset by its influence line times the load, in closed form: a simple span
(triangle), one of two continuous spans (with the lobe of the other, three-moment equation), a
member near the track (a few metres), a gauge near a support (both signs). The first mode of the
span rings on top, hit by every wheelset that comes onto the bridge and leaves it. Loads differ by
vehicle and by wheelset. Gauges of one bridge have different lines, signs, gains and noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from tests.detection.field_like import SHAPES, TRAINS, catalogue
from tests.detection.stand_ins import ratios, run, spread
from trackvib_ros.detection import CONFIRMED, Catalogue, Channel, Estimate, detect

Array = NDArray[np.float64]
RATES = (50.0, 100.0, 200.0, 256.0, 600.0, 1200.0, 2000.0, 5000.0)
_TOP = {"ICE": 300, "TGV": 320, "ETR": 280, "Re4": 200, "cla": 140, "fre": 110}


@dataclass
class Strain:
    """A record of strain gauges.

    Attributes:
        rate: samples per second.
        samples: (samples, channels), in an unknown unit.
        axles: of the train behind its first wheelset (m).
        speed: at the first wheelset (m/s).
        start: first wheelset at x = 0 (s).
        x: places of the gauges (m).
        reach: how far before and behind each gauge its influence line goes (m).
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
    reach: tuple[tuple[float, float], ...]

    def axle_times(self, x: float) -> Array:
        s = self.direction * x + self.axles
        root = np.sqrt(np.maximum(self.speed**2 + 2 * self.acceleration * s, 1.0))
        return np.asarray(self.start + 2 * s / (self.speed + root))

    def mid_speed(self, x: float) -> float:
        s = self.direction * x + 0.5 * self.axles[-1]
        return float(np.sqrt(self.speed**2 + 2 * self.acceleration * s))


def loads(random: np.random.Generator, name: str, axles: Array) -> Array:
    """Wheelset loads (t): heavy locomotives, vehicles that are alike or loaded and empty."""
    out = np.full(axles.size, random.uniform(11, 17))
    vehicle = np.zeros(axles.size, dtype=int)
    vehicle[1:] = np.cumsum(np.diff(axles) > 3.5) // 2
    if name.startswith(("ICE1", "ICE2", "ETR", "TGV_R")):
        out[:4] = random.uniform(17, 20)
        if not name.startswith("ICE2"):
            out[-4:] = out[0]
    elif name.startswith("TGV_double"):
        half = axles.size // 2
        out[[*range(4), *range(half - 4, half + 4), *range(2 * half - 4, 2 * half)]] = 17.0
    elif name.startswith(("Re4", "fre")):
        if name.startswith("fre"):
            kinds = np.array([5.5, 22.0]) if random.random() < 0.5 else np.array([20.0, 22.0])
            out = kinds[random.integers(0, 2, vehicle.max() + 1)][vehicle]
        out[:4] = 21.0
    each = 1 + 0.06 * random.standard_normal(vehicle.max() + 1)
    return np.asarray(out * each[vehicle] * (1 + 0.03 * random.standard_normal(axles.size)))


def _line(
    random: np.random.Generator, kind: str, span: float, at: float
) -> tuple[Callable[[Array], Array], tuple[float, float]]:
    """Influence line over the place of a load from the gauge (m), and how far it reaches.

    Args:
        span: of the bridge (m).
        at: place of the gauge from the beginning of the span (m).
    """
    if kind == "local":
        width = random.uniform(1.5, 4.0)

        def local(x: Array) -> Array:
            q = np.abs(x) / width
            return np.asarray(np.exp(-q) * (np.cos(q) - 0.6 * np.sin(q)))

        return local, (3 * width, 3 * width)

    def moment(x: Array) -> Array:
        """Of a simple span at the gauge, over that at mid-span."""
        s = np.clip(x + at, 0, span)
        return np.asarray(4 / span * (np.minimum(s, at) - s * at / span))

    if kind == "span":
        return moment, (at, span - at)
    if kind == "support":
        return (lambda x: moment(x) * np.sign(x) * np.abs(x / span) ** 0.3), (at, span - at)

    def two(x: Array) -> Array:
        """Two equal spans: moment over the middle support by the three-moment equation."""
        here, there = np.clip((x + at) / span, 0, 1), np.clip(2 - (x + at) / span, 0, 1)
        over = (here - here**3 + there - there**3) / 4 * (at / span)
        return np.asarray(moment(x) - 4 * over)

    return two, (at, 2 * span - at)


def strain(
    seed: int,
    shape: str = "roomy",
    rate: float | None = None,
    gauges: int | None = None,
    snr_db: float | None = None,
    train: str | None = None,
    kind: str | None = None,
    hum: bool | None = None,
    drift: bool | None = None,
    equal: bool = False,
    speed: float | None = None,
    span: float | None = None,
) -> Strain:
    """One passage with everything about it drawn at random, but for what is given.

    Args:
        seed: of the random numbers.
        shape: of :data:`tests.detection.field_like.SHAPES`.
        rate: samples per second.
        gauges: number of channels.
        snr_db: over the whole band between first and last wheelset.
        train: of :data:`tests.detection.field_like.TRAINS`.
        kind: of influence line: ``span``, ``two``, ``local`` or ``support``.
        hum: whether the mains are heard, 2 to 20 % of the peak.
        drift: whether the record drifts, by up to half of its peak.
        equal: whether all wheelsets weigh the same.
        speed: km/h.
        span: of the bridge (m).
    """
    random = np.random.default_rng(seed)
    name = str(random.choice(list(TRAINS)))
    name = train or name
    axles = TRAINS[name]
    weight = loads(random, name, axles)
    if random.random() < 0.5:
        axles, weight = axles[-1] - axles[::-1], weight[::-1]
    v = random.uniform(40, _TOP[name[:3]]) / 3.6
    v = v if speed is None else speed / 3.6
    acceleration = random.normal(0, 0.1)
    acceleration = float(np.clip(acceleration, -0.15 * v**2 / axles[-1], 0.5))
    direction = int(random.choice([-1, 1]))
    fs = float(random.choice(RATES))
    fs = fs if rate is None else rate
    snr = random.uniform(15, 45) if snr_db is None else snr_db
    count = int(random.integers(1, 5)) if gauges is None else gauges
    length = random.uniform(8, 40) if span is None else span
    if equal:
        weight = np.ones(axles.size)
    humming = random.random() < 0.5 if hum is None else hum
    drifting = random.random() < 0.5 if drift is None else drift
    kinds = [kind or str(random.choice(["span", "two", "local", "support"])) for _ in range(count)]
    places = np.sort(random.uniform(0.2, 0.8, count)) * length
    channels = tuple(Channel(f"g{k}", float(round(x, 1)), "bridge") for k, x in enumerate(places))
    lines = [_line(random, k, length, x) for k, x in zip(kinds, places, strict=True)]
    low, high, low_end, high_end = SHAPES[shape]
    s = Strain(fs, channels, np.zeros((0, count)), name, axles, v, 0.0, acceleration, direction,
               tuple((r if direction > 0 else (r[1], r[0])) for _, r in lines))  # fmt: skip
    first = min(s.axle_times(c.x)[0] for c in channels)
    s.start = random.uniform(low, high) - first
    last = max(float(s.axle_times(c.x)[-1]) for c in channels)
    s.samples = np.zeros((int((last + random.uniform(low_end, high_end)) * fs), count))
    time = np.arange(len(s.samples)) / fs
    t = time - s.start
    # stops where it would turn
    distance = v * t + 0.5 * acceleration * t * t
    frequency, damping = 90 * length**-0.9 * random.uniform(0.8, 1.25), random.uniform(0.01, 0.04)
    ring = random.uniform(0.02, 0.2)
    gains = 10 ** random.uniform(-1, 1, count) * random.choice([-1, 1], count)
    extra = np.zeros(len(time))
    step = 1 / fs
    for offset, load in zip(axles, weight, strict=True):
        where = direction * (distance - offset)
        inside = (where > 0) & (where < length)
        extra += load * np.where(inside, np.sin(np.pi * np.clip(where / length, 0, 1)), 0.0)
        for c, (line, _) in enumerate(lines):
            s.samples[:, c] += gains[c] * load * line(where - channels[c].x)
    w = 2 * np.pi * min(frequency, 0.3 * fs)
    top, bottom = signal.cont2discrete(([w * w], [1, 2 * damping * w, w * w]), step)[:2]
    answer = signal.lfilter(np.ravel(top), bottom, extra) - extra
    answer *= ring * np.max(np.abs(extra)) / max(np.max(np.abs(answer)), 1e-12)
    for c, x in enumerate(places):
        s.samples[:, c] += gains[c] * np.sin(np.pi * x / length) * answer
    inside = (time > s.start) & (time < last)
    level = np.sqrt(np.mean(s.samples[inside] ** 2, axis=0))
    peak = np.max(np.abs(s.samples), axis=0)
    noise = level * 10 ** (-snr / 20)
    s.samples += noise * random.standard_normal(s.samples.shape)
    slow = signal.lfilter([0.02], [1, -0.98], random.standard_normal(s.samples.shape), axis=0)
    s.samples += noise * slow
    if humming:
        own = peak * 10 ** random.uniform(-1.7, -0.7)
        for order, share in ((1, 1.0), (3, 0.3)):
            wave = np.sin(2 * np.pi * order * 50.0 * time + random.uniform(0, 6))
            s.samples += own * share * wave[:, None]
    if drifting:
        bend = random.uniform(-0.5, 0.5, count)
        s.samples += peak * bend * (time / time[-1])[:, None] ** random.uniform(0.5, 2)
    s.samples += peak * random.uniform(-20, 20, count)
    return s


def judge(s: Strain, known: Catalogue | None = None) -> dict[str, Any]:
    """What the detector makes of a stand-in, against the truth."""
    events = detect(s.rate, s.samples, s.channels, known or catalogue())
    told = [e for e in events if e.kind == "passage" and e.values["grade"] == CONFIRMED]
    arrivals = [e.stamp_ns * 1e-9 for e in events if e.kind == "arrival"]
    result: dict[str, Any] = {
        "train": s.train,
        "kmh": round(3.6 * s.mid_speed(0.0)),
        "rate": round(s.rate),
        "gauges": len(s.channels),
        "reach": [round(sum(r)) for r in s.reach],
        "events": len(arrivals),
        "passages": len(told),
        "onset": min(arrivals) - float(s.axle_times(s.channels[0].x)[0]) if arrivals else None,
    }
    if not told:
        return result
    event = told[0]
    v = event.values
    place = v["reference_x"]
    assert isinstance(place, Estimate)
    times = s.axle_times(place.value)
    result |= {"flags": list(event.quality), "type": v["type"], "families": v.get("families")}
    if "speed" in v:
        speed = v["speed"]
        assert isinstance(speed, Estimate)
        result["speed"] = speed.value / s.mid_speed(place.value) - 1
        result["sigma"] = speed.sigma / s.mid_speed(place.value)
    for name, stamp, sigma, true in (
        ("arrival", "arrival_ns", "arrival_sigma", times[0]),
        ("departure", "departure_ns", "departure_sigma", times[-1]),
    ):
        if stamp in v:
            result[name] = float(v[stamp]) * 1e-9 - float(true)  # type: ignore[arg-type]
            result[f"{name}_sigma"] = v[sigma]
    return result


_KNOWN = ("type", "full", "absent")


def _job(given: tuple[dict[str, Any], str], seed: int) -> dict[str, Any]:
    options, known = given
    s = strain(seed, **options)
    types = catalogue(s.train if known == "absent" else "")
    if known == "type":
        types = replace(types, types=(types[s.train],))
    return judge(s, types)


def rows() -> dict[str, tuple[dict[str, Any], str]]:
    """Conditions of the table, and what the detector knows."""
    table: dict[str, tuple[dict[str, Any], str]] = {}
    for known in _KNOWN:
        table[f"anything, {known}"] = ({}, known)
    for gauges in (1, 4):
        table[f"{gauges} gauges, full"] = ({"gauges": gauges}, "full")
    for kind in ("span", "two", "local", "support"):
        table[f"{kind}, full"] = ({"kind": kind}, "full")
    for shape in SHAPES:
        table[f"shape {shape}, full"] = ({"shape": shape}, "full")
    for rate in RATES:
        table[f"{rate:.0f} Hz, full"] = ({"rate": rate}, "full")
    table["equal loads, full"] = ({"equal": True}, "full")
    table["slow, full"] = ({"speed": 40.0}, "full")
    return table


def line(name: str, results: Sequence[dict[str, Any]]) -> str:
    """One row of the table."""
    one = [r for r in results if r["passages"]]
    named = [r for r in one if r["type"] != "unknown"]
    return (
        f"| {name} | {len(results)} | {sum(r['events'] > 0 for r in results)} | {len(one)} "
        f"| {sum(max(0, r['passages'] - 1) for r in one)} "
        f"| {sum(r['type'] == r['train'] for r in named)}/{len(named)} "
        f"| {sum('speed' in r for r in one)} "
        f"| {spread(one, 'speed', 100)} | {ratios(one, 'speed', 'sigma')} "
        f"| {spread(one, 'arrival', 1e3)} | {ratios(one, 'arrival', 'arrival_sigma')} "
        f"| {spread(one, 'departure', 1e3)} |"
    )


HEAD = (
    "| condition | n | event | train | extra | type right/named | speed told | speed p50/p95 % "
    "| rms, inside 95 %, beyond 3 | arrival ms | rms, inside, beyond | departure ms |"
)


def main() -> None:
    """Run and print the table."""
    # 500 000 apart from the rail records
    run(__doc__, rows(), _job, line, HEAD, 500_000)


if __name__ == "__main__":
    main()
