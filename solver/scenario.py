"""What a run computes, stated once: track, line, trains, irregularity, channels, solution.

A :class:`Scenario` is immutable and validated; every number has a unit, shown in its schema and
in every refusal. Coordinates: ``x`` in m from the left end of the line, forward; displacement
positive down.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from .errors import InputError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

GRAVITY = 9.81
"""Acceleration of free fall (m/s²)."""

Layer = Literal["rail", "slab", "support_layer", "bridge"]
Quantity = Literal["motion", "strain", "fastening_force", "bearing_force"]


def _quantity(unit: str, meaning: str, **rules: Any) -> Any:
    return Field(description=f"{meaning} [{unit}]", json_schema_extra={"unit": unit}, **rules)


def _speed(value: object) -> object:
    if isinstance(value, str):
        number, _, unit = value.strip().partition(" ")
        factor = {"km/h": 1 / 3.6, "m/s": 1.0}.get(unit.strip())
        try:
            if factor is not None:
                return float(number) * factor
        except ValueError:
            pass
        raise ValueError('a speed is a number in m/s, or a text such as "300 km/h"')
    return value


Speed = Annotated[float, BeforeValidator(_speed)]


class Section(BaseModel):
    """Base of all scenario tables: frozen, no unknown entries, finite numbers only."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, validate_default=True, strict=False
    )


class Rail(Section):
    """One rail; the model lumps two."""

    young_modulus: float = _quantity("Pa", "Young's modulus E", gt=0)
    second_moment: float = _quantity("m^4", "second moment of area I of one rail", gt=0)
    area: float = _quantity("m^2", "cross-section A of one rail", gt=0)
    mass_per_length: float = _quantity("kg/m", "mass per length of one rail", gt=0)
    poisson_ratio: float = _quantity("-", "Poisson's ratio, G = E/(2(1+nu))", ge=0, lt=0.5)
    shear_coefficient: float = _quantity("-", "Timoshenko shear coefficient kappa", gt=0, le=1)
    theory: Literal["timoshenko", "euler_bernoulli"] = Field(description="beam theory of the rail")


class Fastening(Section):
    """One rail fastening (pad); the model lumps the two of a row."""

    stiffness: float = _quantity("N/m", "stiffness of one pad", gt=0)
    damping: float = _quantity("N*s/m", "viscous damping of one pad", ge=0)
    spacing: float = _quantity("m", "distance a between rows", gt=0.2, le=3)
    first_offset: float | None = _quantity(
        "m",
        "first row from the left end of the line; unset means half a spacing",
        ge=0,
        default=None,
    )
    pad_length: float = _quantity(
        "m", "length along the rail over which a pad acts; 0 is a point spring", ge=0, le=0.4
    )


class Plate(Section):
    """A concrete layer as a beam of rectangular section."""

    young_modulus: float = _quantity("Pa", "Young's modulus E", gt=0)
    width: float = _quantity("m", "width b", gt=0)
    thickness: float = _quantity("m", "thickness h", gt=0)
    density: float = _quantity("kg/m^3", "density", gt=0)

    @property
    def bending_stiffness(self) -> float:
        """EI = E b h^3 / 12 (N*m^2)."""
        return self.young_modulus * self.width * self.thickness**3 / 12

    @property
    def mass_per_length(self) -> float:
        """Mass per length (kg/m)."""
        return self.density * self.width * self.thickness


class Bed(Section):
    """A distributed elastic layer."""

    stiffness: float = _quantity("N/m^3", "stiffness per area", gt=0)
    damping: float = _quantity("N*s/m^3", "viscous damping per area", ge=0)
    width: float = _quantity("m", "loaded width", gt=0)


class Bridge(Section):
    """One span of the bridge, simply supported."""

    bending_stiffness: float = _quantity("N*m^2", "EI of the girder", gt=0)
    mass_per_length: float = _quantity("kg/m", "mass per length of the girder", gt=0)
    damping_ratio: float = _quantity(
        "-", "modal damping ratio at the first and second bending frequency (Rayleigh)", ge=0, lt=1
    )
    bearing_stiffness: float | None = _quantity(
        "N/m",
        "vertical stiffness of the bearings at one end; unset means rigid",
        gt=0,
        default=None,
    )


class Variation(Section):
    """A track property that differs on part of the line (transition, hanging fastening ...)."""

    parameter: Literal[
        "fastening.stiffness",
        "fastening.damping",
        "mortar.stiffness",
        "mortar.damping",
        "bed.stiffness",
        "bed.damping",
    ] = Field(description="property that is multiplied")
    start: float = _quantity("m", "from x")
    end: float = _quantity("m", "to x")
    factor: float = _quantity("-", "factor on the property", ge=0)

    @model_validator(mode="after")
    def _ordered(self) -> Variation:
        if self.end <= self.start:
            raise ValueError(f"end = {self.end} m must be greater than start = {self.start} m")
        return self


class Track(Section):
    """The four layers and what lies between them."""

    rail: Rail
    fastening: Fastening
    slab: Plate
    mortar: Bed
    support_layer: Plate
    bed_on_bridge: Bed
    bed_on_subgrade: Bed
    bridge: Bridge
    variation: tuple[Variation, ...] = ()


class Line(Section):
    """Approaches and spans, from left to right."""

    approach_left: float = _quantity("m", "track on subgrade before the first span", ge=0, le=2000)
    approach_right: float = _quantity("m", "track on subgrade after the last span", ge=0, le=2000)
    spans: tuple[Annotated[float, Field(gt=1, le=200)], ...] = _quantity(
        "m", "lengths of the bridge spans; empty means no bridge", max_length=200
    )
    ends: Literal["pinned", "free"] = Field(
        default="pinned",
        description="vertical support of rail, slab and support layer at both ends of the line",
    )

    @property
    def length(self) -> float:
        """Length of the modelled track (m)."""
        return self.approach_left + sum(self.spans) + self.approach_right

    @property
    def span_bounds(self) -> tuple[tuple[float, float], ...]:
        """Left and right bearing of every span (m)."""
        bounds, left = [], self.approach_left
        for span in self.spans:
            bounds.append((left, left + span))
            left += span
        return tuple(bounds)

    @model_validator(mode="after")
    def _some_length(self) -> Line:
        if self.length < 5:
            raise ValueError(
                f"the line is {self.length:g} m long: approaches and spans must add up to >= 5 m"
            )
        return self


class WheelElement(Section):
    """The paper's moving wheel element: a quarter car in series on one wheelset."""

    kind: Literal["wheel_element"]
    body_mass: float = _quantity("kg", "mass of the car body; a quarter is carried", gt=0)
    bogie_mass: float = _quantity("kg", "mass of a bogie; a half is carried", gt=0)
    wheelset_mass: float = _quantity("kg", "mass of the wheelset", gt=0)
    primary_stiffness: float = _quantity("N/m", "primary suspension per wheelset", gt=0)
    primary_damping: float = _quantity("N*s/m", "primary suspension per wheelset", ge=0)
    secondary_stiffness: float = _quantity(
        "N/m", "secondary suspension per bogie; half is carried", gt=0
    )
    secondary_damping: float = _quantity(
        "N*s/m", "secondary suspension per bogie; half is carried", ge=0
    )
    wheel_radius: float = _quantity("m", "wheel radius", gt=0.1, lt=1)
    length: float = _quantity("m", "length over buffers", gt=0)


class Car(Section):
    """A car on two bogies with two wheelsets each: 10 degrees of freedom."""

    kind: Literal["car"]
    body_mass: float = _quantity("kg", "mass of the car body", gt=0)
    body_inertia: float = _quantity("kg*m^2", "pitch inertia of the car body", gt=0)
    bogie_mass: float = _quantity("kg", "mass of one bogie", gt=0)
    bogie_inertia: float = _quantity("kg*m^2", "pitch inertia of one bogie", gt=0)
    wheelset_mass: float = _quantity("kg", "mass of one wheelset", gt=0)
    primary_stiffness: float = _quantity("N/m", "primary suspension per wheelset", gt=0)
    primary_damping: float = _quantity("N*s/m", "primary suspension per wheelset", ge=0)
    secondary_stiffness: float = _quantity("N/m", "secondary suspension per body end", gt=0)
    secondary_damping: float = _quantity("N*s/m", "secondary suspension per body end", ge=0)
    wheelbase: float = _quantity("m", "distance of the wheelsets of a bogie", gt=0.5, lt=10)
    bogie_centres: float = _quantity("m", "distance of the bogie centres", gt=1, lt=50)
    length: float = _quantity("m", "length over couplers", gt=1, lt=60)
    front_overhang: float | None = _quantity(
        "m",
        "front coupler to first bogie centre; unset: both overhangs are equal",
        ge=0,
        default=None,
    )
    shared_rear_bogie: bool = Field(
        default=False,
        description="the rear bogie also carries the front of the next car (Jacobs bogie)",
    )
    wheel_radius: float = _quantity("m", "wheel radius", gt=0.1, lt=1)

    @model_validator(mode="after")
    def _fits(self) -> Car:
        if self.bogie_centres > self.length:
            raise ValueError(
                f"bogie_centres = {self.bogie_centres} m must not exceed length = {self.length} m"
            )
        return self


Vehicle = Annotated[WheelElement | Car, Field(discriminator="kind")]


class Flat(Section):
    """A wheel flat: both wheels of the wheelset follow d(x) = L^2/(16 R) (1 - cos(2 pi x/L))."""

    wheelset: int = _quantity("-", "wheelset, 1 is the first of the train", ge=1)
    length: float = _quantity("m", "length of the flat", gt=0, le=0.15)


class Polygon(Section):
    """Periodic out-of-roundness of a wheelset."""

    wheelset: int = _quantity("-", "wheelset, 1 is the first of the train", ge=1)
    order: int = _quantity("-", "waves per revolution", ge=1, le=60)
    amplitude: float = _quantity("m", "amplitude of the radius", gt=0, le=2e-3)


class SpeedPoint(Section):
    """One corner of a piecewise linear speed profile."""

    time: float = _quantity("s", "time", ge=0)
    speed: Speed = _quantity("m/s", "speed", gt=0, le=200)


class Train(Section):
    """One train of the run."""

    preset: str | None = Field(default=None, description="train preset this was expanded from")
    vehicles: tuple[Vehicle, ...] = Field(min_length=1, max_length=64)
    speed: Speed = _quantity("m/s", 'constant speed; "300 km/h" is understood too', gt=0, le=200)
    speed_profile: tuple[SpeedPoint, ...] = Field(
        default=(), description="piecewise linear speed over time; replaces the constant speed"
    )
    direction: Literal["forward", "backward"] = Field(
        default="forward", description="forward runs towards increasing x"
    )
    start: float = _quantity("m", "position of the first wheelset at start_time")
    start_time: float = _quantity("s", "time at which the first wheelset is at start", default=0.0)
    flat: tuple[Flat, ...] = ()
    polygon: tuple[Polygon, ...] = ()

    @field_validator("speed_profile")
    @classmethod
    def _increasing(cls, points: tuple[SpeedPoint, ...]) -> tuple[SpeedPoint, ...]:
        times = [point.time for point in points]
        if times != sorted(set(times)):
            raise ValueError("times of a speed profile must increase")
        if times and times[0] != 0:
            raise ValueError("a speed profile starts at time = 0 s")
        return points

    @model_validator(mode="after")
    def _consistent(self) -> Train:
        for car, follower in zip(self.vehicles, (*self.vehicles[1:], None), strict=True):
            if isinstance(car, Car) and car.shared_rear_bogie and not isinstance(follower, Car):
                raise ValueError("a car with shared_rear_bogie must be followed by a car")
        wheelsets = len(self.axle_positions)
        for number in [flat.wheelset for flat in self.flat] + [p.wheelset for p in self.polygon]:
            if number > wheelsets:
                raise ValueError(f"wheelset = {number} has a defect, but the train has {wheelsets}")
        return self

    @property
    def axle_positions(self) -> tuple[float, ...]:
        """Distance of every wheelset behind the first one (m), front first."""
        axles: list[float] = []
        front, shared = 0.0, False
        for vehicle in self.vehicles:
            if isinstance(vehicle, WheelElement):
                axles.append(front + vehicle.length / 2)
                shared = False
            else:
                overhang = vehicle.front_overhang
                if overhang is None:
                    overhang = (vehicle.length - vehicle.bogie_centres) / 2
                half = vehicle.wheelbase / 2
                first = front + overhang
                bogies = (first, first + vehicle.bogie_centres)
                for centre in bogies[1:] if shared else bogies:
                    axles += [centre - half, centre + half]
                shared = vehicle.shared_rear_bogie
            front += vehicle.length
        return tuple(axle - axles[0] for axle in axles)

    @property
    def length(self) -> float:
        """Length over couplers (m)."""
        return sum(vehicle.length for vehicle in self.vehicles)

    @property
    def mass(self) -> float:
        """Mass of the whole train (kg)."""
        total, shared = 0.0, False
        for vehicle in self.vehicles:
            if isinstance(vehicle, WheelElement):
                total += vehicle.body_mass / 4 + vehicle.bogie_mass / 2 + vehicle.wheelset_mass
                shared = False
            else:
                bogies = 1 if shared else 2
                total += vehicle.body_mass
                total += bogies * (vehicle.bogie_mass + 2 * vehicle.wheelset_mass)
                shared = vehicle.shared_rear_bogie
        return total


class Contact(Section):
    """Wheel-rail contact, the same for all wheels."""

    law: Literal["linear", "hertz"] = Field(
        default="linear",
        description="linear: bilateral spring; hertz: p = (delta/G)^1.5, unilateral",
    )
    stiffness: float = _quantity("N/m", "linear contact stiffness per wheel", gt=0, default=1.325e9)


class Components(Section):
    """r(x) = sum of amplitude * cos(wavenumber * x + phase), positive down."""

    wavenumber: tuple[Annotated[float, Field(gt=0)], ...] = _quantity("rad/m", "wavenumbers k")
    amplitude: tuple[float, ...] = _quantity("m", "amplitudes a")
    phase: tuple[float, ...] = _quantity("rad", "phases phi")

    @model_validator(mode="after")
    def _same_length(self) -> Components:
        lengths = {len(self.wavenumber), len(self.amplitude), len(self.phase)}
        if len(lengths) != 1:
            raise ValueError(
                "wavenumber, amplitude and phase must be lists of the same length, not "
                f"{len(self.wavenumber)}, {len(self.amplitude)} and {len(self.phase)}"
            )
        return self


class Defect(Section):
    """A deterministic defect of the running surface, at any place of the line."""

    shape: Literal["dip", "joint", "corrugation"] = Field(
        description="dip: (1-cos) of given length; joint: V of two straights; corrugation: sine"
    )
    x: float = _quantity("m", "centre of the defect")
    length: float = _quantity("m", "length of the defect", gt=0)
    depth: float = _quantity("m", "depth below the running surface", gt=0, le=0.05)
    wavelength: float | None = _quantity("m", "wavelength of a corrugation", gt=0, default=None)

    @model_validator(mode="after")
    def _wavelength(self) -> Defect:
        if (self.shape == "corrugation") != (self.wavelength is not None):
            raise ValueError("wavelength belongs to a corrugation, and only to one")
        return self


class Irregularity(Section):
    """Vertical irregularity r(x) of the running surface, positive down; one of four kinds."""

    spectrum: Literal["sato", "tbt3352", "german_low", "iso3095"] | None = None
    roughness_coefficient: float = _quantity(
        "m^2*(rad/m)^2", "A of the Sato spectrum S(k) = A/k^3", gt=0, default=4.15e-8
    )
    wavelength_min: float | None = _quantity(
        "m", "shortest wavelength of the realisation", gt=0, default=None
    )
    wavelength_max: float | None = _quantity(
        "m", "longest wavelength of the realisation", gt=0, default=None
    )
    seed: int = _quantity("-", "seed of the phases", ge=0, default=1)
    profile: str | None = Field(
        default=None,
        description="text file of two columns, x [m] and r [m]; relative to the scenario file",
    )
    components: Components | None = None
    defect: tuple[Defect, ...] = ()

    @model_validator(mode="after")
    def _one_kind(self) -> Irregularity:
        kinds = ("spectrum", "profile", "components")
        given = [kind for kind in kinds if getattr(self, kind) is not None]
        if len(given) > 1:
            raise ValueError(f"state one of {', '.join(kinds)}, not {' and '.join(given)}")
        shortest, longest = self.wavelength_min, self.wavelength_max
        if shortest and longest and shortest >= longest:
            raise ValueError(
                f"wavelength_min = {shortest} m must be less than wavelength_max = {longest} m"
            )
        return self


class Channel(Section):
    """One place where the solver reports motion, strain or a force."""

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$", max_length=40)
    quantity: Quantity = Field(
        default="motion",
        description=(
            "motion: displacement, velocity, acceleration; strain: bending strain at a fibre; "
            "fastening_force: row nearest to x; bearing_force: end of the span nearest to x"
        ),
    )
    layer: Layer = Field(description="layer of the track")
    span: int | None = _quantity(
        "-", "span number from 1; x is then from its left bearing", ge=1, default=None
    )
    x: float = _quantity("m", "position along the line, or from the left bearing of span", ge=0)
    fibre: float = _quantity("m", "distance of the fibre below the neutral axis", default=0.0)


class Sensor(Section):
    """Datasheet of a virtual accelerometer mounted at a channel."""

    channel: str = Field(description="channel that is measured")
    preset: str | None = Field(default=None, description="sensor preset this was expanded from")
    rate: int = _quantity("Hz", "sampling rate", gt=0)
    bandwidth: float = _quantity("Hz", "-3 dB edge of the anti-alias filter", gt=0)
    range: float = _quantity("m/s^2", "full scale; clipped at +/- range", gt=0)
    noise_density: float = _quantity("m/s^2/sqrt(Hz)", "white noise, one-sided", ge=0)
    bias: float = _quantity("m/s^2", "constant offset", default=0.0)
    bits: int = _quantity("-", "resolution of the converter over +/- range", ge=8, le=32)
    coupling: Literal["AC", "DC"] = Field(description="AC: high-pass; DC: +1 g at rest")
    high_pass: float = _quantity("Hz", "-3 dB edge of AC coupling", gt=0, default=0.5)
    timing_jitter: float = _quantity("s", "rms of the sampling instants", ge=0, default=0.0)
    dropout_rate: float = _quantity("1/s", "mean number of drop-outs per second", ge=0, default=0.0)
    dropout_duration: float = _quantity("s", "mean length of a drop-out", gt=0, default=0.01)
    seed: int = _quantity("-", "seed of noise, jitter and drop-outs", ge=0, default=1)


Sines = Annotated[int, Field(ge=0, le=1000)]


class Solution(Section):
    """How the run is computed."""

    model: Literal["fe", "hybrid"] = Field(
        default="fe",
        description="fe: everything deterministic; hybrid: FE below, SEA above the crossover",
    )
    integrator: Literal["exponential", "newmark"] = Field(
        default="exponential",
        description="exponential: exact stepping of complex modes; newmark: full matrices",
    )
    end_time: float | None = _quantity(
        "s",
        "end of the run; unset: the last train has left and the line has calmed down",
        gt=0,
        default=None,
    )
    step: float = _quantity("s", "time step, a whole number of ns", gt=0, le=1e-2, default=2.5e-5)
    frequency_limit: float = _quantity(
        "Hz", "highest frequency of the model", ge=20, le=20000, default=5000.0
    )
    crossover: float | None = _quantity(
        "Hz",
        "hybrid: frequency f_g between global and local set; unset: chosen",
        gt=0,
        default=None,
    )
    sines: tuple[Sines, Sines, Sines, Sines] | None = Field(
        default=None,
        description="hierarchical functions per element of rail, slab, support layer, bridge; "
        "unset: chosen from the frequency limit; only with an Euler-Bernoulli rail",
    )
    seed: int = _quantity("-", "hybrid: seed of the local response", ge=0, default=1)

    @property
    def step_ns(self) -> int:
        """Time step (ns)."""
        return round(self.step * 1e9)

    @field_validator("step")
    @classmethod
    def _whole_ns(cls, step: float) -> float:
        nanoseconds = step * 1e9
        if round(nanoseconds) < 1 or not math.isclose(
            nanoseconds, round(nanoseconds), rel_tol=1e-9
        ):
            raise ValueError("the step must be a whole number of nanoseconds")
        return step


class Scenario(Section):
    """Everything a run needs; the same scenario and seeds give the same numbers."""

    name: str = Field(default="unnamed", max_length=80)
    description: str = ""
    track_preset: str = Field(description="track preset the parameters were expanded from")
    track: Track
    line: Line
    train: tuple[Train, ...] = Field(default=(), max_length=10000)
    contact: Contact = Contact()
    irregularity: Irregularity = Irregularity()
    channel: tuple[Channel, ...] = Field(default=(), max_length=200)
    sensor: tuple[Sensor, ...] = Field(default=(), max_length=200)
    solution: Solution = Solution()

    @model_validator(mode="after")
    def _consistent(self) -> Scenario:
        length, spans = self.line.length, self.line.span_bounds
        offset = self.track.fastening.first_offset
        if offset is not None and offset > length:
            raise ValueError(
                f"track.fastening.first_offset = {offset} m lies beyond the line of {length:g} m"
            )
        if self.solution.sines is not None and self.track.rail.theory == "timoshenko":
            raise ValueError(
                f"solution.sines = {list(self.solution.sines)} with track.rail.theory = "
                '"timoshenko": such a rail has a kink at every fastening, which sines over whole '
                "spans do not have, however many: leave solution.sines unset (the rail is then "
                'cut at the fastenings), or set track.rail.theory = "euler_bernoulli"'
            )
        names = [channel.name for channel in self.channel]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f'channel name "{name}" is used twice: names must differ')
        for channel in self.channel:
            if channel.span is not None and channel.span > len(spans):
                raise ValueError(
                    f'channel "{channel.name}": span = {channel.span}, but the line has '
                    f"{len(spans)} span(s)"
                )
            x = self.channel_x(channel)
            if x > length + 1e-9:
                raise ValueError(
                    f'channel "{channel.name}": x = {x:g} m lies beyond the line of {length:g} m'
                )
            if channel.layer == "bridge" and not any(a <= x <= b for a, b in spans):
                raise ValueError(
                    f'channel "{channel.name}": x = {x:g} m is not on a span: {list(spans)} m'
                )
        for sensor in self.sensor:
            if sensor.channel not in names:
                raise ValueError(
                    f'sensor on channel "{sensor.channel}": no such channel; there are {names}'
                )
            if 1_000_000_000 % (self.solution.step_ns * sensor.rate):
                raise ValueError(
                    f'sensor on "{sensor.channel}": the solver rate '
                    f"{1e9 / self.solution.step_ns:g} Hz is not a whole multiple of its rate "
                    f"{sensor.rate} Hz: change sensor.rate or solution.step"
                )
            if sensor.bandwidth >= sensor.rate / 2:
                raise ValueError(
                    f'sensor on "{sensor.channel}": bandwidth = {sensor.bandwidth:g} Hz must be '
                    f"below half the rate {sensor.rate} Hz"
                )
        return self

    def channel_x(self, channel: Channel) -> float:
        """Position of a channel along the line (m)."""
        if channel.span is None:
            return channel.x
        return self.line.span_bounds[channel.span - 1][0] + channel.x

    def to_toml(self) -> str:
        """The complete scenario as TOML text; :func:`load_scenario_text` reads it back."""
        return _to_toml(self.model_dump(mode="json", exclude_none=True))


def _preset_table(file: str) -> dict[str, Any]:
    text = resources.files("solver.presets").joinpath(file).read_text(encoding="utf-8")
    table: dict[str, Any] = tomllib.loads(text)
    return table


def preset_names() -> dict[str, list[str]]:
    """Names of all presets by kind: ``track``, ``vehicle``, ``train``, ``sensor``, ``scenario``."""
    return {
        "track": sorted(_preset_table("tracks.toml")),
        "vehicle": sorted(_preset_table("trains.toml")["vehicle"]),
        "train": sorted(_preset_table("trains.toml")["train"]),
        "sensor": sorted(_preset_table("sensors.toml")),
        "scenario": sorted(
            path.name.removeprefix("scenario_").removesuffix(".toml")
            for path in resources.files("solver.presets").iterdir()
            if path.name.startswith("scenario_")
        ),
    }


def _pick(table: Mapping[str, Any], name: object, what: str) -> Any:
    if not isinstance(name, str) or name not in table:
        raise InputError(f"{what} = {name!r}: no such preset; there are {', '.join(sorted(table))}")
    return table[name]


def _merge(base: Mapping[str, Any], change: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in change.items():
        if isinstance(value, Mapping) and isinstance(merged.get(key), Mapping):
            merged[key] = _merge(merged[key], value)
        else:
            merged[key] = value
    return merged


def _expand_vehicles(entries: object, where: str) -> list[Any]:
    vehicles = _preset_table("trains.toml")["vehicle"]
    if not isinstance(entries, Sequence) or isinstance(entries, str):
        raise InputError(f"{where}.vehicles: must be a list of vehicle tables")
    expanded: list[Any] = []
    for index, entry in enumerate(entries):
        here = f"{where}.vehicles[{index}]"
        if not isinstance(entry, Mapping):
            raise InputError(f"{here} = {entry!r}: must be a table such as {{ preset = ... }}")
        table = dict(entry)
        count = table.pop("count", 1)
        if not isinstance(count, int) or isinstance(count, bool) or not 1 <= count <= 64:
            raise InputError(f"{here}.count = {count!r}: must be a whole number from 1 to 64")
        if "preset" in table:
            table = _merge(_pick(vehicles, table.pop("preset"), f"{here}.preset"), table)
        expanded += [table] * count
    return expanded


def _expand(raw: Mapping[str, Any]) -> dict[str, Any]:
    table = dict(raw)
    tracks = _preset_table("tracks.toml")
    name = table.setdefault("track_preset", "crts2")
    table["track"] = _merge(_pick(tracks, name, "track_preset"), table.get("track", {}))
    if isinstance(table.get("train"), Sequence) and not isinstance(table["train"], str):
        trains = []
        for index, entry in enumerate(table["train"]):
            where = f"train[{index}]"
            if not isinstance(entry, Mapping):
                raise InputError(f"{where} = {entry!r}: must be a table")
            train = dict(entry)
            if "preset" in train and "vehicles" not in train:
                train = _merge(
                    _pick(
                        _preset_table("trains.toml")["train"], train["preset"], f"{where}.preset"
                    ),
                    train,
                )
            if "vehicles" in train:
                train["vehicles"] = _expand_vehicles(train["vehicles"], where)
            trains.append(train)
        table["train"] = trains
    if isinstance(table.get("sensor"), Sequence) and not isinstance(table["sensor"], str):
        sensors = []
        for index, entry in enumerate(table["sensor"]):
            if isinstance(entry, Mapping) and "preset" in entry:
                base = _pick(
                    _preset_table("sensors.toml"), entry["preset"], f"sensor[{index}].preset"
                )
                entry = _merge(base, entry)
            sensors.append(entry)
        table["sensor"] = sensors
    return table


def _unit_at(path: Sequence[str | int]) -> str:
    model: Any = Scenario
    unit = ""
    for key in path:
        if isinstance(key, int):
            continue
        field = getattr(model, "model_fields", {}).get(key)
        if field is None:
            if key in ("car", "wheel_element"):
                model = Car if key == "car" else WheelElement
                continue
            return ""
        extra = field.json_schema_extra
        unit = str(extra["unit"]) if isinstance(extra, dict) and "unit" in extra else ""
        model = _inner_model(field.annotation)
    return unit


def _inner_model(annotation: Any) -> Any:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for argument in getattr(annotation, "__args__", ()):
        found = _inner_model(argument)
        if found is not None:
            return found
    return None


def _known_entries(path: Sequence[str | int]) -> str:
    model: Any = Scenario
    for key in path[:-1]:
        if isinstance(key, int):
            continue
        if key in ("car", "wheel_element"):
            model = Car if key == "car" else WheelElement
            continue
        field = getattr(model, "model_fields", {}).get(key)
        model = _inner_model(field.annotation) if field is not None else None
    return ", ".join(getattr(model, "model_fields", {}))


def _explain(error: ValidationError, source: str) -> InputError:
    lines = []
    for item in error.errors(include_url=False):
        path = [key for key in item["loc"] if key not in ("car", "wheel_element")]
        where = ".".join(f"[{key}]" if isinstance(key, int) else str(key) for key in path)
        where = where.replace(".[", "[") or "scenario"
        unit = _unit_at(item["loc"])
        if item["type"] == "extra_forbidden":
            rule = f"unknown entry; known here: {_known_entries(item['loc'])}"
        elif item["type"] == "missing":
            lines.append(f"{where}: missing; it must be given" + (f" in {unit}" if unit else ""))
            continue
        else:
            rule = item["msg"].removeprefix("Value error, ")
            rule = rule[0].lower() + rule[1:]
        value = item["input"]
        shown = "" if isinstance(value, (Mapping, BaseModel)) else f" = {value!r}"
        if len(shown) > 100 and isinstance(value, (list, tuple)):
            shown = f" of {len(value)} entries"
        if shown and unit not in ("", "-"):
            shown += f" {unit}"
        lines.append(f"{where}{shown}: {rule}")
    return InputError(f"{source}: " + "; ".join(lines))


def build_scenario(table: Mapping[str, Any], source: str = "scenario") -> Scenario:
    """Validate a table of raw entries, presets expanded.

    Raises:
        InputError: names each wrong entry with value, unit and rule.
    """
    try:
        return Scenario.model_validate(_expand(table))
    except ValidationError as error:
        raise _explain(error, source) from None


def load_scenario_text(text: str, source: str = "scenario") -> Scenario:
    """Scenario from TOML text; raises :class:`InputError`."""
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{source}: not valid TOML: {error}") from None
    return build_scenario(table, source)


def load_scenario(source: str | Path) -> Scenario:
    """Scenario from a TOML file, or a scenario preset by its bare name.

    A relative ``irregularity.profile`` is resolved against the file's folder.

    Raises:
        InputError: no such file or preset, not TOML, or wrong entries.
    """
    path = Path(source)
    if path.suffix != ".toml":
        names = preset_names()["scenario"]
        if str(source) in names:
            return build_scenario(_preset_table(f"scenario_{source}.toml"), f"preset {source}")
        raise InputError(
            f"scenario {str(source)!r}: neither a .toml file nor a preset; presets: "
            f"{', '.join(names)}"
        )
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"scenario {path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise InputError(f"scenario {path}: is not UTF-8 text: {error.reason}") from None
    scenario = load_scenario_text(text, str(path))
    profile = scenario.irregularity.profile
    if profile is not None and not Path(profile).is_absolute():
        absolute = str((path.parent / profile).resolve())
        irregularity = scenario.irregularity.model_copy(update={"profile": absolute})
        scenario = scenario.model_copy(update={"irregularity": irregularity})
    return scenario


def preset_text(name: str) -> str:
    """TOML text of a preset of any kind, as shipped.

    Raises:
        InputError: no such preset.
    """
    kinds = preset_names()
    if name in kinds["scenario"]:
        file = resources.files("solver.presets").joinpath(f"scenario_{name}.toml")
        return file.read_text(encoding="utf-8")
    tables = {
        "track": _preset_table("tracks.toml"),
        "vehicle": _preset_table("trains.toml")["vehicle"],
        "train": _preset_table("trains.toml")["train"],
        "sensor": _preset_table("sensors.toml"),
    }
    for kind, table in tables.items():
        if name in table:
            return f"# {kind} preset {name}\n" + _to_toml(table[name])
    known = "; ".join(f"{kind}: {', '.join(names)}" for kind, names in kinds.items())
    raise InputError(f"preset {name!r}: no such preset; there are {known}")


def train_preset(name: str, speed: float = 83.33, start: float = 0.0) -> Train:
    """A train preset as a validated :class:`Train` at ``speed`` (m/s) and ``start`` (m).

    Raises:
        InputError: no such preset.
    """
    table = _pick(_preset_table("trains.toml")["train"], name, "train preset")
    vehicles = _expand_vehicles(table["vehicles"], f"train preset {name}")
    return Train.model_validate(
        {**table, "vehicles": vehicles, "preset": name, "speed": speed, "start": start}
    )


def _toml_value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, (int, float)):
        return repr(value)
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{k} = {_toml_value(v)}" for k, v in value.items()) + " }"
    return "[" + ", ".join(_toml_value(item) for item in value) + "]"


def _to_toml(table: Mapping[str, Any], path: str = "") -> str:
    def is_tables(value: Any) -> bool:
        return (
            isinstance(value, Sequence)
            and not isinstance(value, str)
            and bool(value)
            and all(isinstance(item, Mapping) for item in value)
        )

    lines, nested = [], []
    for key, value in table.items():
        name = f"{path}.{key}" if path else key
        if isinstance(value, Mapping):
            nested.append(f"\n[{name}]\n" + _to_toml(value, name))
        elif is_tables(value):
            nested += [f"\n[[{name}]]\n" + _to_toml(item, name) for item in value]
        else:
            lines.append(f"{key} = {_toml_value(value)}\n")
    return "".join(lines) + "".join(nested)


def scenario_schema() -> dict[str, Any]:
    """JSON schema of a fully expanded scenario, with units."""
    return Scenario.model_json_schema()
