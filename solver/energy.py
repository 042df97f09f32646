"""Energy balance of a line that is stepped in complex modes.

Complex modes of a non-proportionally damped line carry no energy of their own, so the motion is put
together in the coordinates of the undamped modes, where the mass is 1, the stiffness omega^2
and the damping a full matrix:

    u = Re(V q), v = Re(V lambda q),   E = (v.v + (omega u).(omega u))/2,
    work done per time: sum of F_i v(x_i);   lost per time: v.C v.

The loss has no frequency above twice the model's limit, so a sum over samples taken more often than
that is its integral, and the motion need not be put together in every step. Work, sum of
p lambda q over the modes, is summed at every step: forces change fast where the rail has kinks.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .modes import LineForms, ModalLine

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

SAMPLES_PER_PERIOD = 2.5
"""Least samples of the loss per period of the frequency limit; above 2 for motion beyond it."""

BATCH = 96
"""Samples of the motion that are evaluated together."""


class EnergyBalance:
    """Work of the wheels on a line, its energy and what is lost, from the modes at every step.

    The balance runs from the first sample to the last one of the loss.

    Args:
        line, forms: the line's modes and what they are made of.
        step: of the run (s).
    """

    def __init__(self, line: ModalLine, forms: LineForms, step: float) -> None:
        self._line, self._forms, self._step = line, forms, step
        self._stride = max(1, int(1 / (SAMPLES_PER_PERIOD * forms.frequency_limit * step)))
        self._root = np.sqrt(line.weights)
        self._rates = line.eigenvalues
        shapes = (forms.vectors * self._root).T
        self._re, self._im = np.ascontiguousarray(shapes.real), np.ascontiguousarray(shapes.imag)
        # samples after those that are summed; the first one is a sample of the loss
        self._pending: list[tuple[Complex, Complex]] = []
        self._started = False
        self._first = np.zeros(3)
        self._sums = np.zeros(2)
        self._largest = 0.0

    def load(self, place: Array, force: Array) -> Complex:
        """(K,) load of the modes, weights folded in: sum of shape times force on the line."""
        on = (place >= 0) & (place <= self._line.length)
        return np.asarray((self._line.rail(place[on]) * self._root).T @ force[on])

    def sample(self, amplitude: Complex, load: Complex) -> None:
        """Take in the next sample: (K,) modes q, weights folded in, and their load."""
        self._pending.append((amplitude, load))
        if len(self._pending) > BATCH * self._stride:
            self._evaluate()

    def _motion(self, amplitude: Complex) -> Array:
        """(n, N) coordinates of the undamped modes of (n, K)."""
        return np.asarray(amplitude.real @ self._re - amplitude.imag @ self._im)

    def _powers(self, samples: list[tuple[Complex, Complex]]) -> tuple[Array, Array, Array]:
        """Power in at every sample, loss and energy at every stride (W, W, J)."""
        q, loads = (np.array(part) for part in zip(*samples, strict=True))
        rate = q * self._rates
        velocity = self._motion(rate[:: self._stride])
        shape = self._motion(q[:: self._stride]) * self._forms.omega
        return (
            (loads * rate).sum(axis=1).real,
            ((velocity @ self._forms.damping) * velocity).sum(axis=1),
            0.5 * ((velocity**2).sum(axis=1) + (shape**2).sum(axis=1)),
        )

    def _evaluate(self) -> None:
        count = (len(self._pending) - 1) // self._stride * self._stride
        if count <= 0:
            return
        power, loss, energy = self._powers(self._pending[:count])
        del self._pending[:count]
        if not self._started:
            self._first[:] = power[0], loss[0], energy[0]
            self._started = True
        self._sums += power.sum(), self._stride * loss.sum()
        self._largest = max(self._largest, float(energy.max()))

    def totals(self) -> tuple[float, float, float]:
        """Work done, loss and change of energy since the first sample (J)."""
        self._evaluate()
        if not self._started:
            return 0.0, 0.0, 0.0
        power, loss, energy = (float(part[0]) for part in self._powers(self._pending[:1]))
        # trapezoidal sums: half of the first and of the last sample
        work = self._sums[0] + (power - self._first[0]) / 2
        lost = self._sums[1] + self._stride * (loss - self._first[1]) / 2
        return self._step * work, self._step * lost, energy - float(self._first[2])

    @property
    def residual(self) -> float | None:
        """|work - loss - change of energy| per work or largest energy; None before two samples."""
        work, lost, change = self.totals()
        if not self._started:
            return None
        return abs(work - lost - change) / max(abs(work), self._largest, 1e-300)
