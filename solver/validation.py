"""Measured evidence for the hybrid: ensembles of local modes, and hybrid against fe."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .scenario import load_scenario
from .statistics import (
    Partition,
    Response,
    partition,
    respond,
    respond_statistically,
    spacings,
)
from .waves import Real, rail_beam

THIRD_OCTAVES = np.array([630.0, 800, 1000, 1250, 1600, 2000, 2500, 3150, 4000, 5000])
"""Nominal centres (Hz) of the bands of the ensemble study."""


def decibel(a: ArrayLike, b: ArrayLike) -> Real:
    """10 lg(a/b), both quantities squares."""
    return np.asarray(10 * np.log10(np.asarray(a) / np.asarray(b)))


class FreeRail:
    """A free rail of 9.75 m on 15 fastenings, Eq. (1) with 60 sines, 8 of them global.

    The first local mode is at 488 Hz, the last at 20 kHz. Loads: on the rail's end, where all
    sines vanish (only the global set is driven), and inside the span.
    """

    length = 9.75
    sines = 60
    global_sines = 8
    places = (0.0, 4.1)

    def __init__(self) -> None:
        track = load_scenario("demo").track
        beam = rail_beam(track)
        self.mass_per_length = beam.mass_per_length
        nodes, weights = np.polynomial.legendre.leggauss(200)
        x, w = self.length / 2 * (nodes + 1), self.length / 2 * weights
        value, curvature = self.shapes(x), self.shapes(x, curvature=True)
        self.mass: Real = beam.mass_per_length * (value.T * w) @ value
        stiffness = beam.bending_stiffness * (curvature.T * w) @ curvature
        fastenings = self.shapes((np.arange(15) + 0.5) * track.fastening.spacing)
        self.stiffness: Real = stiffness + 2 * track.fastening.stiffness * fastenings.T @ fastenings
        self.is_global: NDArray[np.bool_] = np.arange(4 + self.sines) < 4 + self.global_sines

    def shapes(self, x: ArrayLike, curvature: bool = False) -> Real:
        """Functions of Eq. (1), or their second derivatives, at ``x`` (m): (len(x), 64)."""
        place = np.atleast_1d(np.asarray(x, dtype=np.float64))
        s, n = place / self.length, np.arange(1, self.sines + 1) * math.pi / self.length
        if curvature:
            hermite = np.array(
                [
                    (-6 + 12 * s) / self.length**2,
                    (-4 + 6 * s) / self.length,
                    (6 - 12 * s) / self.length**2,
                    (-2 + 6 * s) / self.length,
                ]
            )
            return np.hstack((hermite.T, -(n**2) * np.sin(np.outer(place, n))))
        hermite = np.array(
            [
                1 - 3 * s**2 + 2 * s**3,
                self.length * (s - 2 * s**2 + s**3),
                3 * s**2 - 2 * s**3,
                self.length * (s**3 - s**2),
            ]
        )
        return np.hstack((hermite.T, np.sin(np.outer(place, n))))

    def split(self, extra_mass: tuple[Real, Real] | None = None) -> tuple[Partition, Real, Real]:
        """Partition and the rows of both places; ``extra_mass``: positions (m), masses (kg)."""
        mass = self.mass
        if extra_mass is not None:
            rows = self.shapes(extra_mass[0])
            mass = mass + (rows.T * extra_mass[1]) @ rows
        part = partition(mass, self.stiffness, self.is_global)
        rows = self.shapes(np.array(self.places))
        return part, *part.load(rows[:, self.is_global], rows[:, ~self.is_global])


@dataclass(frozen=True, slots=True)
class BandError:
    """Statistical forms against an ensemble in one third octave, both load places.

    Attributes:
        frequency: centre (Hz).
        overlap: modal overlap n eta omega (-).
        error: {form: (3, 2)} dB of |w|^2, power, energy, against the ensemble mean.
        scatter: (3, 2) dB, standard deviation of one member's band level.
    """

    frequency: float
    overlap: float
    error: dict[Literal["paper", "repaired"], Real]
    scatter: Real


def _rows(response: Response) -> Real:
    return np.array([response.square, response.power, response.energy])


def ensemble_study(
    loss: float,
    samples: int = 500,
    disorder: Literal["modes", "masses"] = "modes",
    seed: int = 0,
    bands: ArrayLike = THIRD_OCTAVES,
) -> list[BandError]:
    """Monte-Carlo means of :class:`FreeRail` against both statistical forms, per third octave.

    Args:
        loss: hysteretic loss factor (-).
        samples: members of the ensemble.
        disorder: modes: every local natural frequency moves by up to one mean spacing either
            way; masses: 12 masses at random places add 15 % of the rail's mass, which moves natural
        frequencies about 2 kHz by one mean spacing.
        seed: of the ensemble.
        bands: centres (Hz).
    """
    rail, random = FreeRail(), np.random.default_rng(seed)
    part, rows_g, rows_p = rail.split()
    count = len(part.omega)
    ends = (2 * part.omega[0] - part.omega[1], 2 * part.omega[-1] - part.omega[-2])
    extended = np.concatenate(([ends[0]], part.omega, [ends[1]]))
    members: list[tuple[Partition, Real, Real, Real]] = []
    for _ in range(samples):
        if disorder == "modes":
            moved = np.arange(count) + random.uniform(-1, 1, count)
            omega_k = np.interp(moved, np.arange(-1, count + 1), extended)
            members.append((part, rows_g, rows_p, omega_k))
        else:
            masses = np.full(12, 0.15 * rail.mass_per_length * rail.length / 12)
            other = rail.split((random.uniform(0, rail.length, 12), masses))
            members.append((*other, other[0].omega))
    theory = part, rows_g, rows_p
    if disorder == "masses":
        # the mean structure: the extra mass smeared over the rail
        added = rail.mass * 0.15
        smeared = partition(rail.mass + added, rail.stiffness, rail.is_global)
        rows = rail.shapes(np.array(rail.places))
        theory = smeared, *smeared.load(rows[:, rail.is_global], rows[:, ~rail.is_global])
    result = []
    for centre in np.asarray(bands, dtype=np.float64):
        omegas = 2 * np.pi * centre * 2 ** (np.linspace(-1, 1, 5) / 6 * 0.8)
        levels = np.zeros((samples, 3, 2))
        forms: dict[Literal["paper", "repaired"], Real] = {}
        for omega in omegas:
            for i, (p, g, f, omega_k) in enumerate(members):
                levels[i] += _rows(respond(p, g, f, loss, float(omega), omega_k))
        for form in ("paper", "repaired"):
            total = np.sum(
                [_rows(respond_statistically(*theory, loss, float(w), form)) for w in omegas],
                axis=0,
            )
            forms[form] = decibel(total, levels.mean(axis=0))
        near = 2 * np.pi * centre
        gap = float(np.interp(near, theory[0].omega, spacings(theory[0].omega)))
        result.append(
            BandError(float(centre), loss * near / gap, forms, decibel(levels, 1.0).std(axis=0))
        )
    return result
