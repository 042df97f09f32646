"""The line: rail, slab, support layer and bridge assembled to M, C and K (Eq. 2).

Every layer is a field on its own mesh along x; :meth:`Field.rows` gives the sparse rows that
map the coordinates to its deflection, and every matrix is a sum of ``rows.T @ weights @ rows``:
beams and beds by Gauss quadrature, fastenings at their x. Channels are rows too.

Both rails and both pads of a row are lumped here and nowhere else: beam and fastening properties
of one rail are doubled. Displacement is positive down, forces compress positive.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
import scipy.sparse as sp

from .beam import Array, BeamSection, Element, beam_element
from .errors import SolverError
from .scenario import Channel, Layer, Scenario, Track

RAILS = 2
LAYERS: tuple[Layer, ...] = ("rail", "slab", "support_layer", "bridge")

# Resolution, chosen by measurement on crts2 at 5 kHz against a basis refined until it stood still
# (response per force on the rail): the rail is within 0.7 % away from the load and 2.9 % under it,
# the slab within 2 % up to 4 kHz outside its nulls. A support layer that is resolved to 2 kHz and
# a bridge to 700 Hz change rail and slab by less than 0.1 % up to 5 kHz, although not themselves.
SLAB_ELEMENT = 4.0
BAY_EXTRA = 6
SINE_MARGIN = 1.5
SINE_EXTRA = 4
LAYER_LIMIT: Mapping[Layer, float] = {"support_layer": 2000.0, "bridge": 700.0}


def beam_sections(track: Track) -> dict[Layer, BeamSection]:
    """Sections of the four layers of the whole track (both rails)."""
    rail = track.rail
    shear_modulus = rail.young_modulus / (2 * (1 + rail.poisson_ratio))
    timoshenko = rail.theory == "timoshenko"
    mass = RAILS * rail.mass_per_length
    return {
        "rail": BeamSection(
            RAILS * rail.young_modulus * rail.second_moment,
            mass,
            RAILS * rail.shear_coefficient * shear_modulus * rail.area if timoshenko else None,
            mass * rail.second_moment / rail.area if timoshenko else 0.0,
        ),
        "slab": BeamSection(track.slab.bending_stiffness, track.slab.mass_per_length),
        "support_layer": BeamSection(
            track.support_layer.bending_stiffness, track.support_layer.mass_per_length
        ),
        "bridge": BeamSection(track.bridge.bending_stiffness, track.bridge.mass_per_length),
    }


@dataclass(frozen=True, eq=False, slots=True)
class Field:
    """Deflection of one layer on its mesh.

    Attributes:
        left: (E,) left ends of the elements (m), increasing; elements do not overlap.
        elements: the E elements.
        dofs: per element, the coordinate of each of its functions; -1 where a support holds it.
        size: number N of coordinates of the whole structure.
    """

    left: Array
    elements: tuple[Element, ...]
    dofs: tuple[np.ndarray, ...]
    size: int

    @property
    def right(self) -> Array:
        """(E,) right ends of the elements (m)."""
        return np.asarray(self.left + np.array([element.length for element in self.elements]))

    def rows(self, x: Array, derivative: int = 0) -> sp.csr_array:
        """Rows of the deflection's derivative at ``x`` (m): (len(x), N).

        A row is zero where the layer is not. At a node the element on the right is taken.
        """
        return self._rows(x, "deflection", derivative)

    def rotation_rows(self, x: Array, derivative: int = 0) -> sp.csr_array:
        """Rows of the section's rotation (rad) and its derivatives at ``x`` (m): (len(x), N)."""
        return self._rows(x, "rotation", derivative)

    def _rows(
        self, x: Array, what: Literal["deflection", "rotation"], derivative: int
    ) -> sp.csr_array:
        x = np.atleast_1d(np.asarray(x, float))
        if not len(self.elements):
            return sp.csr_array((len(x), self.size))
        index = np.clip(np.searchsorted(self.left, x, side="right") - 1, 0, None)
        local = x - self.left[index]
        lengths = self.right - self.left
        inside = (local > -1e-9) & (local < lengths[index] + 1e-9)
        groups: dict[int, list[int]] = {}
        for number in np.unique(index[inside]):
            groups.setdefault(id(self.elements[number]), []).append(int(number))
        rows, columns, values = [], [], []
        for numbers in groups.values():
            element = self.elements[numbers[0]]
            chosen = np.flatnonzero(inside & np.isin(index, numbers))
            at = np.clip(local[chosen], 0.0, element.length)
            shapes = getattr(element, what)(at, derivative)
            table = np.zeros((len(self.elements), element.functions), np.int64)
            for number in numbers:
                table[number] = self.dofs[number]
            rows.append(np.repeat(chosen, element.functions))
            columns.append(table[index[chosen]].ravel())
            values.append(shapes.ravel())
        if not rows:
            return sp.csr_array((len(x), self.size))
        row, column, value = (np.concatenate(part) for part in (rows, columns, values))
        free = column >= 0
        return sp.csr_array((value[free], (row[free], column[free])), shape=(len(x), self.size))


@dataclass(frozen=True, eq=False, slots=True)
class Probe:
    """A channel that is not plain motion: ``d @ q + v @ q' + a @ q''``.

    Attributes:
        displacement_rows, velocity_rows, acceleration_rows: (1, N).
    """

    displacement_rows: sp.csr_array
    velocity_rows: sp.csr_array
    acceleration_rows: sp.csr_array


@dataclass(frozen=True, eq=False)
class Structure:
    """M, C and K of a line, supports eliminated, and what reads them.

    Attributes:
        scenario: what it was assembled from.
        mass, damping, stiffness: (N, N) symmetric, in kg, N*s/m, N/m.
        fields: the field of each layer (without ``bridge`` when there is no span).
        dofs: number of coordinates of each layer.
        fastenings: (R,) positions of the fastening rows (m).
        valid_band: highest frequency (Hz) up to which each layer's mesh resolves its own
            bending waves, at most the frequency limit.
        supports: force of every bearing, numbered 2 * span + end from 0.
        cuts: where slab and support layer are severed (m).
        bounds: left and right end of the rail (m) that the coordinates describe.
        probes: of every channel, where the coordinates describe a part only.
    """

    scenario: Scenario
    mass: sp.csr_array
    damping: sp.csr_array
    stiffness: sp.csr_array
    fields: Mapping[Layer, Field]
    dofs: Mapping[Layer, int]
    fastenings: Array
    valid_band: Mapping[Layer, float]
    supports: Mapping[int, Probe]
    cuts: tuple[float, ...]
    bounds: tuple[float, float]
    probes: Mapping[str, Probe] | None = None

    @property
    def size(self) -> int:
        """Number N of coordinates."""
        return int(self.mass.shape[0])

    @property
    def length(self) -> float:
        """Length of the line (m)."""
        return self.scenario.line.length

    def rows(self, layer: Layer, x: Array | float, derivative: int = 0) -> sp.csr_array:
        """Rows of a layer's deflection (or its x-derivative) at ``x`` (m): (len(x), N)."""
        return self.fields[layer].rows(np.atleast_1d(np.asarray(x, float)), derivative)

    def rail_rows(self, x: Array | float) -> sp.csr_array:
        """Rows of the rail's deflection at ``x`` (m): (len(x), N)."""
        return self.rows("rail", x)

    def missing_rail_compliance(self, x: Array) -> Array:
        """Static point compliance of the rail at ``x`` (m) that no coordinate carries (m/N)."""
        field, section = self.fields["rail"], beam_sections(self.scenario.track)["rail"]
        index = np.clip(np.searchsorted(field.left, x, side="right") - 1, 0, None)
        value = np.empty(len(x))
        for number in np.unique(index):
            chosen, element = index == number, field.elements[number]
            at = np.clip(x[chosen] - field.left[number], 0, element.length)
            value[chosen] = element.missing_compliance(at, section)
        return value

    def missing_rail_deflection(self, x: Array, load: float) -> Array:
        """Static deflection of the rail at ``x`` per force at ``load`` that no coordinate carries.

        (len(x),) m/N; zero outside the element of the load.
        """
        field, section = self.fields["rail"], beam_sections(self.scenario.track)["rail"]
        number = int(np.clip(np.searchsorted(field.left, load, side="right") - 1, 0, None))
        element, left = field.elements[number], float(field.left[number])
        value = np.zeros(len(x))
        inside = (x >= left) & (x <= left + element.length)
        value[inside] = element.missing_deflection(x[inside] - left, load - left, section)
        return value

    def probe(self, channel: Channel) -> Probe:
        """Rows of a channel: motion, strain, fastening force (whole row), bearing force.

        Strain is positive in tension, ``-fibre * rotation'``; forces are positive in compression.
        """
        if self.probes is not None:
            return self.probes[channel.name]
        x = self.scenario.channel_x(channel)
        none = sp.csr_array((1, self.size))
        if channel.quantity == "motion":
            return Probe(self._at(channel.layer, x, channel.span), none, none)
        if channel.quantity == "strain":
            field = self.fields[channel.layer]
            return Probe(
                -channel.fibre * field.rotation_rows(np.array([x]), derivative=1), none, none
            )
        if channel.quantity == "fastening_force":
            if not len(self.fastenings):
                raise SolverError(
                    f'channel "{channel.name}": fastening rows = 0 on the line; at least 1 needed'
                )
            nearest = float(self.fastenings[np.argmin(np.abs(self.fastenings - x))])
            rows, stiffness, damping = _fastening_rows(
                self.scenario, self.fields, nearest, self.cuts
            )
            weights = np.ones((1, rows.shape[0]))
            return Probe(
                sp.csr_array((weights * stiffness) @ rows),
                sp.csr_array((weights * damping) @ rows),
                none,
            )
        if not self.supports:
            raise SolverError(f'channel "{channel.name}": spans = 0 on the line; at least 1 needed')
        bounds = self.scenario.line.span_bounds
        spans = range(len(bounds)) if channel.span is None else [channel.span - 1]
        ends = [(abs(bounds[s][e] - x), 2 * s + e) for s in spans for e in (0, 1)]
        return self.supports[min(ends)[1]]

    def part(self, number: int) -> Structure:
        """Segment ``number`` of a severed line: its own coordinates and the joints to others.

        Rows of places elsewhere are zero.
        """
        inside: dict[Layer, np.ndarray] = {}
        bounds = (0.0, self.length)
        for layer, beam in self.fields.items():
            cuts = self.cuts
            if layer == "rail":
                cuts = tuple(rail_cut(self.scenario, x) for x in cuts)
                bounds = [0.0, *cuts][number], [*cuts, self.length][number]
            segment = np.searchsorted(cuts, (beam.left + beam.right) / 2)
            inside[layer] = np.flatnonzero(segment == number)
        tables = [self.fields[layer].dofs[i] for layer, chosen in inside.items() for i in chosen]
        kept = np.unique(np.concatenate(tables))
        kept = kept[kept >= 0]
        position = np.full(self.size + 1, -1)
        position[kept] = np.arange(len(kept))

        def restrict(probe: Probe) -> Probe:
            parts = (probe.displacement_rows, probe.velocity_rows, probe.acceleration_rows)
            return Probe(*(sp.csr_array(rows[:, kept]) for rows in parts))

        fields = {
            layer: Field(
                self.fields[layer].left[chosen],
                tuple(self.fields[layer].elements[i] for i in chosen),
                tuple(position[self.fields[layer].dofs[i]] for i in chosen),
                len(kept),
            )
            for layer, chosen in inside.items()
        }
        return replace(
            self,
            mass=sp.csr_array(self.mass[kept][:, kept]),
            damping=sp.csr_array(self.damping[kept][:, kept]),
            stiffness=sp.csr_array(self.stiffness[kept][:, kept]),
            fields=fields,
            fastenings=self.fastenings[
                (self.fastenings > bounds[0]) & (self.fastenings < bounds[1])
            ],
            supports={key: restrict(probe) for key, probe in self.supports.items()},
            cuts=self.cuts[max(number - 1, 0) : number + 1],
            bounds=bounds,
            probes={c.name: restrict(self.probe(c)) for c in self.scenario.channel},
        )

    def joint_rows(self) -> sp.csr_array:
        """Rows of deflection and rotation of the beams that end at cuts of this part: (J, N).

        Rail, slab and support layer at the left cut, then at the right one.
        """
        numbers = []
        for cut in self.cuts:
            for layer in LAYERS[:3]:
                beam = self.fields[layer]
                x = rail_cut(self.scenario, cut) if layer == "rail" else cut
                if abs(beam.left[0] - x) < 1e-6:
                    numbers += list(beam.dofs[0][:2])
                else:
                    numbers += list(beam.dofs[-1][2:4])
        size = len(numbers)
        return sp.csr_array((np.ones(size), (range(size), numbers)), shape=(size, self.size))

    def channel_band(self, channel: Channel) -> float:
        """Valid band of a channel (Hz): what its layer and the rail that feeds it resolve."""
        return min(self.valid_band["rail"], self.valid_band[channel.layer])

    def _at(self, layer: Layer, x: float, span: int | None) -> sp.csr_array:
        # the end of a span shares its x with the next span: stay on the span that was named
        if layer == "bridge" and span is not None:
            left, right = self.scenario.line.span_bounds[span - 1]
            x = min(max(x, left), right - 1e-9 * (right - left))
        return self.rows(layer, x)


def assemble(scenario: Scenario, cuts: Sequence[float] = ()) -> Structure:
    """Assemble the line of a scenario.

    Args:
        cuts: places (m) where slab and support layer are severed, and the rail in the same bay;
            on a bridge they must be bearings. Nodes of both sides have their own coordinates
            there, and nothing joins them (:mod:`segments` does).

    Raises:
        SolverError: the basis of an element is not independent in double precision.
    """
    track = scenario.track
    sections = beam_sections(track)
    fastenings = _fastening_positions(scenario)
    meshes = {layer: _nodes(scenario, layer, fastenings, cuts) for layer in LAYERS}
    orders = {layer: _orders(scenario, layer, meshes[layer], sections[layer]) for layer in LAYERS}
    fields, dofs, size, held = _number(scenario, meshes, orders, sections)

    full: dict[str, sp.csr_array] = {
        name: sp.csr_array((size, size)) for name in ("mass", "damping", "stiffness")
    }
    for layer, field in fields.items():
        mass, stiffness = beam_matrices(field, sections[layer])
        full["mass"] += mass
        full["stiffness"] += stiffness
        if layer == "bridge":
            full["damping"] += _rayleigh(scenario, field, sections[layer], mass, stiffness)
    for rows, stiff, damp in _beds(scenario, fields):
        full["stiffness"] += _gram(rows, stiff)
        full["damping"] += _gram(rows, damp)
    for x in fastenings:
        rows, stiff, damp = _fastening_rows(scenario, fields, float(x), cuts)
        full["stiffness"] += _gram(rows, stiff)
        full["damping"] += _gram(rows, damp)
    bearing = track.bridge.bearing_stiffness

    free = np.setdiff1d(np.arange(size), held)
    supports: dict[int, Probe] = {}
    if "bridge" in fields:
        for number, dof in enumerate(_bridge_ends(fields["bridge"])):
            if bearing is None:
                # reaction of a rigid bearing: the held row of K q + C q' + M q''
                matrices = (full["stiffness"], full["damping"], full["mass"])
                rows_at = [sp.csr_array(m[[dof], :][:, free]) * -1.0 for m in matrices]
                supports[number] = Probe(*rows_at)
            else:
                unit = sp.csr_array(([1.0], ([0], [dof])), shape=(1, size))
                full["stiffness"] += bearing * (unit.T @ unit)
                none = sp.csr_array((1, len(free)))
                supports[number] = Probe(sp.csr_array(bearing * unit[:, free]), none, none)

    position = np.full(size, -1)
    position[free] = np.arange(len(free))
    fields = {
        layer: Field(
            field.left,
            field.elements,
            tuple(np.where(d >= 0, position[d], -1) for d in field.dofs),
            len(free),
        )
        for layer, field in fields.items()
    }
    reduced = {name: sp.csr_array(matrix[free][:, free]) for name, matrix in full.items()}
    return Structure(
        scenario,
        reduced["mass"],
        reduced["damping"],
        reduced["stiffness"],
        fields,
        {layer: int(np.isin(dofs[layer], free).sum()) for layer in fields},
        fastenings,
        {
            layer: _valid_band(scenario, layer, meshes[layer], orders[layer], sections[layer])
            for layer in fields
        },
        supports,
        tuple(cuts),
        (0.0, scenario.line.length),
    )


def _gram(rows: sp.csr_array, weights: Array) -> sp.csr_array:
    return sp.csr_array(rows.T @ sp.diags_array(weights) @ rows)


def _fastening_positions(scenario: Scenario) -> Array:
    fastening = scenario.track.fastening
    first = fastening.spacing / 2 if fastening.first_offset is None else fastening.first_offset
    count = math.floor((scenario.line.length - first) / fastening.spacing + 1e-9) + 1
    return np.asarray(first + fastening.spacing * np.arange(max(count, 0)), np.float64)


def _factor(track: Track, parameter: str, x: Array) -> Array:
    factor = np.ones_like(x)
    for variation in track.variation:
        if variation.parameter == parameter:
            factor = np.where(
                (x >= variation.start) & (x <= variation.end), factor * variation.factor, factor
            )
    return factor


def _spread(bounds: list[float], longest: float) -> list[float]:
    """Nodes from first to last bound, none further apart than ``longest``."""
    nodes = [bounds[0]]
    for a, b in pairwise(bounds):
        if b - a > 1e-9:
            nodes += list(np.linspace(a, b, math.ceil((b - a) / longest - 1e-9) + 1)[1:])
    return nodes


def _nodes(
    scenario: Scenario, layer: Layer, fastenings: Array, cuts: Sequence[float]
) -> list[Array]:
    """Node positions of a layer (m), one array per connected part."""
    if layer == "bridge":
        return [np.array(bounds) for bounds in scenario.line.span_bounds]
    if layer == "rail":
        cuts = [rail_cut(scenario, x) for x in cuts]
    nodes = _stops(scenario, layer, fastenings, cuts)
    bounds = [nodes[0], *cuts, nodes[-1]]
    return [np.array([a, *nodes[(nodes > a) & (nodes < b)], b]) for a, b in pairwise(bounds)]


def rail_cut(scenario: Scenario, x: float) -> float:
    """Where the rail is severed (m) when slab and layer are at ``x``: half-way along that bay."""
    fastening = scenario.track.fastening
    first = fastening.spacing / 2 if fastening.first_offset is None else fastening.first_offset
    return first + fastening.spacing * (math.floor((x - first) / fastening.spacing) + 0.5)


def _stops(scenario: Scenario, layer: Layer, fastenings: Array, cuts: Sequence[float]) -> Array:
    """Node positions of a layer that runs through (m)."""
    line, track = scenario.line, scenario.track
    ends = [0.0, line.length]
    stops = sorted({*ends, *cuts, *(x for bounds in line.span_bounds for x in bounds)})
    if scenario.solution.sines is not None:
        return np.array(stops)
    if layer == "rail" and track.rail.theory == "timoshenko":
        # the shear force jumps at a fastening, so the slope of the rail does too
        inner = fastenings[
            (fastenings > 1e-3 * track.fastening.spacing)
            & (fastenings < line.length - 1e-3 * track.fastening.spacing)
        ]
        return np.array(sorted([*ends, *inner, *cuts]))
    jumps = {
        x
        for variation in track.variation
        for x in (variation.start, variation.end)
        if 0 < x < line.length and not variation.parameter.startswith("fastening")
    }
    stops = sorted({*stops, *jumps})
    kept = [stops[0]]
    for stop in stops[1:-1]:
        if stop in cuts and stop - kept[-1] <= 0.2:
            kept.pop()
        if stop in cuts or (stop - kept[-1] > 0.2 and stops[-1] - stop > 0.2):
            kept.append(stop)
    return np.array(_spread([*kept, stops[-1]], SLAB_ELEMENT))


def _orders(
    scenario: Scenario, layer: Layer, meshes: list[Array], section: BeamSection
) -> list[list[int]]:
    """Hierarchical functions of every element."""
    solution = scenario.solution
    if solution.sines is not None:
        return [[solution.sines[LAYERS.index(layer)]] * (len(nodes) - 1) for nodes in meshes]
    wavenumber = section.wavenumber(_layer_limit(scenario, layer))
    if section.shear_stiffness is not None:
        return [
            [math.ceil(wavenumber * h / np.pi) + BAY_EXTRA for h in np.diff(nodes)]
            for nodes in meshes
        ]
    return [
        [math.ceil(SINE_MARGIN * wavenumber * h / np.pi) + SINE_EXTRA for h in np.diff(nodes)]
        for nodes in meshes
    ]


def _layer_limit(scenario: Scenario, layer: Layer) -> float:
    """Frequency (Hz) up to which a layer is resolved."""
    return min(scenario.solution.frequency_limit, LAYER_LIMIT.get(layer, math.inf))


def _valid_band(
    scenario: Scenario,
    layer: Layer,
    meshes: list[Array],
    orders: list[list[int]],
    section: BeamSection,
) -> float:
    """Frequency whose bending half-wave equals the shortest sine of the coarsest element."""
    limit = _layer_limit(scenario, layer)
    for nodes, order in zip(meshes, orders, strict=True):
        for h, n in zip(np.diff(nodes), order, strict=True):
            limit = min(limit, section.frequency(max(n, 1) * math.pi / float(h)))
    return limit


def beam_field(nodes: Array, orders: list[int], section: BeamSection, start: int = 0) -> Field:
    """Continuous beam over ``nodes`` (m) with ``orders`` hierarchical functions per element.

    Coordinates are numbered from ``start`` element by element, so that matrices are banded.
    """
    elements: list[Element] = []
    tables: list[np.ndarray] = []
    end = start
    size = start + 2
    for h, n in zip(np.diff(nodes), orders, strict=True):
        # rounding makes equal lengths share one element
        elements.append(beam_element(round(float(h), 9), section, n))
        begin, end = end, size + n
        tables.append(np.r_[begin, begin + 1, end, end + 1, np.arange(size, size + n)])
        size = end + 2
    return Field(np.array(nodes[:-1], float), tuple(elements), tuple(tables), size)


def _number(
    scenario: Scenario,
    meshes: Mapping[Layer, list[Array]],
    orders: Mapping[Layer, list[list[int]]],
    sections: Mapping[Layer, BeamSection],
) -> tuple[dict[Layer, Field], dict[Layer, np.ndarray], int, np.ndarray]:
    """Number the coordinates layer by layer; returns fields, dofs, their count and the held."""
    size, held = 0, []
    parts: dict[Layer, tuple[list[float], list[Element], list[np.ndarray]]] = {}
    dofs: dict[Layer, np.ndarray] = {}
    for layer in LAYERS:
        left: list[float] = []
        elements: list[Element] = []
        tables: list[np.ndarray] = []
        start = size
        for nodes, order in zip(meshes[layer], orders[layer], strict=True):
            chain = beam_field(nodes, order, sections[layer], size)
            first, last = int(chain.dofs[0][0]), int(chain.dofs[-1][2])
            if layer == "bridge":
                if scenario.track.bridge.bearing_stiffness is None:
                    held += [first, last]
            elif scenario.line.ends == "pinned":
                held += [first] if nodes[0] == 0 else []
                held += [last] if nodes[-1] == scenario.line.length else []
            left += list(chain.left)
            elements += chain.elements
            tables += chain.dofs
            size = chain.size
        if elements:
            parts[layer] = (left, elements, tables)
            dofs[layer] = np.arange(start, size)
    fields = {
        layer: Field(np.array(left), tuple(elements), tuple(tables), size)
        for layer, (left, elements, tables) in parts.items()
    }
    return fields, dofs, size, np.array(held, int)


def _bridge_ends(field: Field) -> list[int]:
    return [int(table[end]) for table in field.dofs for end in (0, 2)]


def _gauss(breaks: Array, wavenumber: float) -> tuple[Array, Array]:
    """Points and weights that integrate products of waves up to ``wavenumber`` (rad/m)."""
    breaks = np.array(_spread(list(np.unique(np.round(breaks, 9))), 1.0))
    lengths = np.diff(breaks)
    # a Gauss rule resolves exp(i k x) on [-h/2, h/2] to round-off with k h / 2 + ~ 12 points
    count = math.ceil(wavenumber * lengths.max() / 2) + 12
    points, weights = np.polynomial.legendre.leggauss(count)
    x = breaks[:-1, None] + lengths[:, None] * (points + 1) / 2
    return x.ravel(), (lengths[:, None] * weights / 2).ravel()


def _finest(field: Field) -> float:
    """Largest wavenumber of the products of two of the field's functions (rad/m)."""
    return max(2 * np.pi * (e.functions - 2) / e.length for e in field.elements)


def beam_matrices(field: Field, section: BeamSection) -> tuple[sp.csr_array, sp.csr_array]:
    """Mass and stiffness of a free beam by Gauss quadrature: two (N, N) matrices."""
    breaks = np.concatenate([field.left, field.right])
    x, weight = _gauss(breaks, _finest(field))
    deflection = field.rows(x)
    mass = _gram(deflection, weight * section.mass_per_length)
    stiffness = _gram(field.rotation_rows(x, 1), weight * section.bending_stiffness)
    if section.shear_stiffness is not None:
        rotation = field.rotation_rows(x)
        shear = sp.csr_array(field.rows(x, 1) - rotation)
        stiffness += _gram(shear, weight * section.shear_stiffness)
        mass += _gram(rotation, weight * section.rotary_inertia)
    return mass, stiffness


def _rayleigh(
    scenario: Scenario,
    field: Field,
    section: BeamSection,
    mass: sp.csr_array,
    stiffness: sp.csr_array,
) -> sp.csr_array:
    """C = alpha M + beta K, ratio zeta at f1 and f2 = 4 f1 of each bare simply supported span."""
    zeta = scenario.track.bridge.damping_ratio
    alpha, beta = np.zeros(field.size), np.zeros(field.size)
    for element, table in zip(field.elements, field.dofs, strict=True):
        first = 2 * np.pi * section.frequency(np.pi / element.length)
        alpha[table] = 2 * zeta * first * 4 * first / (5 * first)
        beta[table] = 2 * zeta / (5 * first)
    return sp.csr_array(sp.diags_array(alpha) @ mass + sp.diags_array(beta) @ stiffness)


def _beds(
    scenario: Scenario, fields: Mapping[Layer, Field]
) -> list[tuple[sp.csr_array, Array, Array]]:
    """Mortar and bed: rows of their compression, stiffness and damping weights."""
    track, line = scenario.track, scenario.line
    breaks = np.concatenate(
        [np.r_[field.left, field.right] for layer, field in fields.items() if layer != "rail"]
        + [[v.start, v.end] for v in track.variation]
    )
    finest = max(_finest(fields["slab"]), _finest(fields["support_layer"]))
    x, weight = _gauss(np.clip(breaks, 0.0, line.length), finest)
    slab, layer = fields["slab"].rows(x), fields["support_layer"].rows(x)
    lower = fields["bridge"].rows(x) if "bridge" in fields else sp.csr_array(layer.shape)
    on_bridge = np.zeros(len(x), bool)
    for a, b in line.span_bounds:
        on_bridge |= (x >= a) & (x <= b)

    def bed(stiffness: str) -> Array:
        over, under = track.bed_on_bridge, track.bed_on_subgrade
        value = np.where(
            on_bridge,
            getattr(over, stiffness) * over.width,
            getattr(under, stiffness) * under.width,
        )
        return np.asarray(value * weight * _factor(track, f"bed.{stiffness}", x))

    mortar = track.mortar
    return [
        (
            sp.csr_array(slab - layer),
            mortar.stiffness * mortar.width * weight * _factor(track, "mortar.stiffness", x),
            mortar.damping * mortar.width * weight * _factor(track, "mortar.damping", x),
        ),
        (sp.csr_array(layer - lower), bed("stiffness"), bed("damping")),
    ]


def _fastening_rows(
    scenario: Scenario, fields: Mapping[Layer, Field], x: float, cuts: Sequence[float] = ()
) -> tuple[sp.csr_array, Array, Array]:
    """Compression rows of the fastening row at ``x`` with their stiffness and damping."""
    track = scenario.track
    pad = track.fastening.pad_length
    if pad > 0:
        points, weights = np.polynomial.legendre.leggauss(8)
        at = np.concatenate([x - pad / 4 + points * pad / 4, x + pad / 4 + points * pad / 4])
        share = np.concatenate([weights, weights]) / 4
        inside = (at >= 0) & (at <= scenario.line.length)
        at, share = at[inside], share[inside]
    else:
        at, share = np.array([x]), np.ones(1)
    # a pad that reaches over a cut bears on the slab of its own side
    side = sum(x > rail_cut(scenario, cut) for cut in cuts)
    over = np.clip(at, [-np.inf, *cuts][side], [*cuts, np.inf][side] - 1e-6)
    rows = sp.csr_array(fields["rail"].rows(at) - fields["slab"].rows(over))
    row = np.array([x])
    stiffness = track.fastening.stiffness * _factor(track, "fastening.stiffness", row)
    damping = track.fastening.damping * _factor(track, "fastening.damping", row)
    return rows, RAILS * share * stiffness, RAILS * share * damping
