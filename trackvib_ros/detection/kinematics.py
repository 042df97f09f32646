"""The motion of a train past the sensors, and its robust regression from axle times.

s(t) = s0 + v t + a t²/2 is the distance that the first wheelset has run past the reference point,
t from a chosen epoch. Wheelset i (d_i behind the first) passes a sensor at x when
s(t) = direction (x - x_ref) + d_i.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MAX_ACCELERATION = 1.2
"""Largest magnitude considered (m/s²)."""

PRIOR_ACCELERATION = 0.6
"""Prior standard deviation of the acceleration (m/s²): short records cannot show it."""


@dataclass(frozen=True)
class Motion:
    """State at ``epoch`` (s): distance (m), speed (m/s), acceleration (m/s²), with covariance."""

    epoch: float
    distance: float
    speed: float
    acceleration: float
    covariance: Array

    def time_at(self, s: Array | float) -> Array:
        """Time (s) at which the distance ``s`` (m) is reached; the earlier root."""
        rest = np.asarray(s, dtype=np.float64) - self.distance
        root = np.sqrt(np.maximum(self.speed**2 + 2 * self.acceleration * rest, 1e-6))
        return np.asarray(self.epoch + 2 * rest / (self.speed + root))

    def distance_at(self, time: Array | float) -> Array:
        """Distance (m) at a time (s)."""
        t = np.asarray(time, dtype=np.float64) - self.epoch
        return np.asarray(self.distance + self.speed * t + 0.5 * self.acceleration * t * t)

    def speed_at(self, time: Array | float) -> Array:
        """Speed (m/s) at a time (s)."""
        return np.asarray(self.speed + self.acceleration * (np.asarray(time) - self.epoch))

    def speed_sigma(self, time: float) -> float:
        """Standard uncertainty of the speed (m/s) at a time (s)."""
        row = np.array([0.0, 1.0, time - self.epoch])
        return float(np.sqrt(row @ self.covariance @ row))

    def time_sigma(self, time: float) -> float:
        """Standard uncertainty (s) of the time at which the place reached at ``time`` is passed."""
        t = time - self.epoch
        row = np.array([1.0, t, 0.5 * t * t])
        speed = max(float(self.speed_at(time)), 0.1)
        return float(np.sqrt(row @ self.covariance @ row)) / speed

    @property
    def acceleration_sigma(self) -> float:
        """Standard uncertainty of the acceleration (m/s²)."""
        return float(np.sqrt(self.covariance[2, 2]))

    def moved(self, epoch: float) -> Motion:
        """The same motion stated at another epoch."""
        t = epoch - self.epoch
        step = np.array([[1.0, t, 0.5 * t * t], [0.0, 1.0, t], [0.0, 0.0, 1.0]])
        return Motion(
            epoch,
            float(self.distance_at(epoch)),
            float(self.speed_at(epoch)),
            self.acceleration,
            step @ self.covariance @ step.T,
        )


@dataclass(frozen=True)
class Fit:
    """A regression: motion, residuals (m) in the order of the data, robust scale, weights."""

    motion: Motion
    residual: Array
    scale: float
    weight: Array


def robust_scale(residual: Array, parameters: int) -> float:
    """Standard deviation from the median absolute residual, degrees of freedom respected (m)."""
    n = residual.size
    if n <= parameters:
        return float("nan")
    return 1.4826 * float(np.median(np.abs(residual))) * float(np.sqrt(n / (n - parameters)))


def regress(
    time: Array,
    place: Array,
    noise: Array,
    epoch: float,
    prior_acceleration: float = PRIOR_ACCELERATION,
    least_scale: float = 0.02,
) -> Fit:
    """Huber regression of ``place`` (m) on ``time`` (s) with relative noise per point.

    The prior N(0, prior²) on the acceleration enters as one more observation. The covariance is
    scaled by the weighted residual variance, never below ``least_scale`` (m), the geometric
    tolerance of a train.
    """
    t = time - epoch
    design = np.stack([np.ones_like(t), t, 0.5 * t * t], axis=1)
    weight = np.ones_like(t)
    solution = np.zeros(3)
    scale = least_scale
    normal = np.eye(3)
    residual = np.zeros_like(t)
    for _ in range(12):
        w = weight / noise**2
        prior = np.diag([0.0, 0.0, (scale / prior_acceleration) ** 2])
        normal = (design * w[:, None]).T @ design + prior
        updated = np.linalg.solve(normal, design.T @ (w * place))
        residual = place - design @ updated
        scale = max(robust_scale(residual / noise, 3), least_scale)
        relative = np.abs(residual) / (noise * scale)
        weight = np.minimum(1.0, 1.5 / np.maximum(relative, 1e-12))
        weight[relative > 5] = 0.0
        if np.allclose(updated, solution, rtol=1e-10, atol=1e-9):
            break
        solution = updated
    freedom = max(float(np.sum(weight)) - 3, 1.0)
    variance = float(np.sum(weight * (residual / noise) ** 2)) / freedom
    scale = max(float(np.sqrt(variance)), least_scale)
    covariance = np.linalg.inv(normal) * scale**2
    motion = Motion(
        epoch, float(solution[0]), float(solution[1]), float(solution[2]), covariance
    )
    return Fit(motion, residual, scale, weight)
