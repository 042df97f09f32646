"""Wheel-rail contact of a wheelset: both wheels on both rails, one vertical plane.

``linear``: F = 2 k delta, bilateral. ``hertz``: F = 2 (delta/G)^1.5 for delta > 0, else 0, with
G = 3.86e-8 R^-0.115 m/N^(2/3) per wheel of radius R (Zhai's constant for a worn profile).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .scenario import Contact

Array = NDArray[np.float64]

TOLERANCE = 1e-12
"""Relative change of sqrt(delta) at which the Hertzian solution is accepted."""


def hertz_constant(wheel_radius: float) -> float:
    """G (m/N^(2/3)) of one wheel of the given radius (m)."""
    return float(3.86e-8 * wheel_radius**-0.115)


def wheelset_law(contact: Contact, wheel_radius: float) -> tuple[float, float]:
    """Linear stiffness (N/m) and Hertz factor 2/G^1.5 (N/m^1.5) of a wheelset; one of them is 0."""
    if contact.law == "linear":
        return 2.0 * contact.stiffness, 0.0
    return 0.0, 2.0 / hertz_constant(wheel_radius) ** 1.5


@njit(cache=True, inline="always", error_model="numpy")  # type: ignore[untyped-decorator]
def force_of(compression: float, linear: float, hertz: float) -> float:
    """Wheelset force (N) at a compression (m)."""
    if hertz == 0.0:
        return linear * compression
    if compression <= 0.0:
        return 0.0
    return hertz * compression * math.sqrt(compression)


@njit(cache=True, inline="always", error_model="numpy")  # type: ignore[untyped-decorator]
def solve_contact(gap: float, compliance: float, linear: float, hertz: float) -> float:
    """Force F (N) with F = law(gap - compliance * F).

    Args:
        gap: compression (m) that the wheelset would have if the contact force were zero now.
        compliance: displacement (m/N) of wheelset and rail together per force within the step.
        linear: stiffness of the linear law (N/m).
        hertz: factor of the Hertzian law (N/m^1.5), 0 for the linear law.

    With delta = y^2 the Hertzian law is the cubic y^2 + compliance hertz y^3 = gap, increasing and
    convex for y > 0, so that Newton from y = sqrt(gap) descends monotonically to the root.
    """
    if hertz == 0.0:
        return linear * gap / (1.0 + compliance * linear)
    if gap <= 0.0:
        return 0.0
    cubic = compliance * hertz
    y = math.sqrt(gap)
    for _ in range(50):
        change = (y * y * (1.0 + cubic * y) - gap) / (y * (2.0 + 3.0 * cubic * y))
        y -= change
        if abs(change) <= TOLERANCE * y:
            break
    return hertz * y * y * y


def compression_of(force: Array, linear: Array, hertz: Array) -> Array:
    """Compression (m) under compressive wheelset forces (N); the inverse of :func:`force_of`."""
    safe = np.where(hertz > 0, hertz, 1.0)
    return np.where(hertz > 0, (force / safe) ** (2 / 3), force / np.where(linear > 0, linear, 1.0))
