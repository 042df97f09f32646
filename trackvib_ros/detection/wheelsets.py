"""Wheelsets on an axis of distance, without a catalogue: a point process with a pulse at each.

A signal over distance is the sum of one pulse per wheelset and Gaussian noise,

    y(s) = sum_i q_i p(s - s_i) + noise,

so the log-likelihood of wheelsets is sum_i q_i c_i - 1/2 sum_ij q_i q_j r(s_i - s_j), over the
variance, with the signal's matched-filter output c and the pulse's autocorrelation r. Only
neighbours overlap, and the gaps between neighbours repeat along a train: the most probable set is
found exactly by dynamic programming (a hidden semi-Markov chain), and what is found gives the gaps,
the pulse and the noise of the next round. Paths drawn from the posterior tell how sure their number
is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import solveh_banded

Array = NDArray[np.float64]

CELL = 0.1
"""Spacing of the signals (m)."""

_STEP = 2  # cells between the places that are tried
_LEAST, _MOST = 1.4, 25.0  # m, between successive wheelsets; wheelbases are 1.7 m and more
_LEVELS = np.array([0.6, 1.0, 1.6])  # loads of a train's wheelsets over the typical one
_STAY = 0.8  # probability that the next wheelset has the same
_HALF = 3.0  # m, half the length of a pulse
_ROUNDS = 4
_GAP_SPREAD = 0.12  # m, of a gap that repeats
_NEW_GAP = 0.3  # prior probability that a gap is none of those seen
_PATHS = 100
_MANY = 400  # wheelsets, more than any train has
_LEAST_CONTRAST = 3.5  # of a first wheelset over the noise
_LEAST_LEVEL = 0.35  # of a first wheelset over the typical one
_LEARN_CONTRAST = 8.0  # from which on the record shows the pulse better than the first guess
_MISFIT = 0.12  # of the pulse: those of one train differ by 1 dB in shape


@dataclass(frozen=True)
class Wheelsets:
    """What was found.

    Attributes:
        place: of every wheelset (m along the axis of the signal).
        level: its pulse over the typical one.
        sigma: of the places (m).
        contrast: typical pulse over the noise of its estimate.
        certainty: posterior probability of the number.
        explained: part of the signal's variance.
        pulse: of unit energy.
    """

    place: Array
    level: Array
    sigma: Array
    contrast: float
    certainty: float
    explained: float
    pulse: Array


def _shifted(pulse: Array, places: Array, n: int) -> sparse.csc_array:
    """The pulse at every place (cells), shape (n, places); columns of cells beside it are empty."""
    half = pulse.size // 2
    first = np.ceil(places - half).astype(np.int64)
    grid = first[:, None] + np.arange(pulse.size)
    value = np.interp(grid - places[:, None], np.arange(-half, half + 1), pulse, 0.0, 0.0)
    column = np.broadcast_to(np.arange(places.size)[:, None], grid.shape)
    use = (grid >= 0) & (grid < n)
    entries = (value[use], (grid[use], column[use]))
    return sparse.csc_array(entries, shape=(n, places.size))


def _solved(columns: sparse.csc_array, y: Array, ridge: float) -> Array:
    """Least squares of columns of which only neighbours overlap: banded normal equations."""
    normal = sparse.coo_array(columns.T @ columns)
    width = int(np.max(np.abs(normal.row - normal.col), initial=0))
    upper = normal.row <= normal.col
    row, column = normal.row[upper], normal.col[upper]
    band = np.zeros((width + 1, normal.shape[0]))
    band[width + row - column, column] = normal.data[upper]
    band[width] += ridge
    return np.asarray(solveh_banded(band, columns.T @ y, check_finite=False))


def _fitted(y: Array, pulse: Array, places: Array) -> tuple[Array, Array, Array]:
    """Places, heights and rest after least squares in both."""
    slope = np.gradient(pulse)
    ridge = 1e-6 * float(pulse @ pulse)
    pairs = np.arange(2 * places.size).reshape(2, -1).T.ravel()  # height and move side by side
    for _ in range(4):
        a = _shifted(pulse, places, y.size)
        d = _shifted(slope, places, y.size)
        both = sparse.csc_array(sparse.hstack([a, -d])[:, pairs])
        q, move = _solved(both, y, ridge).reshape(-1, 2).T
        shift = np.where(q > 0, move / np.maximum(q, 1e-12), 0.0)
        places = places + np.clip(shift, -1.0, 1.0)
    a = _shifted(pulse, places, y.size)
    q = _solved(a, y, ridge)
    return places, q, np.asarray(y - a @ q)


def _learnt(y: Array, places: Array, heights: Array, pulse: Array) -> Array:
    """The pulse of the record itself by least squares, tapered to zero."""
    half = pulse.size // 2
    columns = np.zeros((y.size, pulse.size))
    for place, height in zip(places, heights, strict=True):
        first = int(np.floor(place))
        part = place - first
        for shift, weight in ((0, 1 - part), (1, part)):
            for k in range(pulse.size):
                row = first + shift + k - half
                if 0 <= row < y.size:
                    columns[row, k] += weight * height
    normal = columns.T @ columns
    ridge = 0.02 * float(np.trace(normal)) / pulse.size
    # what the record does not show of the pulse is taken from the last one
    learnt = np.linalg.solve(normal + ridge * np.eye(pulse.size), columns.T @ y + ridge * pulse)
    taper = np.minimum(1.0, 2.0 * (1 - np.abs(np.arange(-half, half + 1)) / half))
    return np.asarray(learnt * taper)


def _mixed(y: Array, places: Array, heights: Array, family: Array) -> Array:
    """The pulse of the record among mixtures of a family, by least squares.

    A free one takes up what its places are off: of equal bogies any wheelbase has its pulse.
    """
    columns = np.stack([_shifted(shape, places, y.size) @ heights for shape in family], axis=1)
    return np.asarray(np.linalg.lstsq(columns, y, rcond=None)[0] @ family)


class _Chain:
    """Scores of all places, and the best or drawn paths through them."""

    def __init__(self, c: Array, height: float, noise: float, gaps: Array) -> None:
        # for a pulse of unit energy the likelihood is (q c - q² / 2) / noise²
        q = height * _LEVELS
        self.unary = (q[None, :] * c[:, None] - 0.5 * q**2) / noise**2
        other = (1 - _STAY) / (_LEVELS.size - 1)
        move = np.log(np.where(np.eye(_LEVELS.size) > 0, _STAY, other))
        with np.errstate(divide="ignore"):
            prior = np.log(gaps)
        self.pair = move[None] + prior[:, None, None]  # gap, before, now
        self.start = float(-np.log(c.size * _LEVELS.size))

    def _steps(self, value: Array, k: int) -> Array:
        n = min(k, self.pair.shape[0] - 1)
        before = value[k - n : k][::-1]  # gap 1, 2, ...
        return np.asarray(before[:, :, None] + self.pair[1 : n + 1])

    def best(self) -> Array:
        """Most probable places (indices)."""
        value = self.unary + self.start
        back = np.full(value.shape, -1)
        levels = _LEVELS.size
        for k in range(1, len(value)):
            steps = self._steps(value, k)
            flat = steps.reshape(-1, levels)
            top = flat.argmax(axis=0)
            score = flat[top, np.arange(levels)]
            better = score > self.start
            value[k] = np.where(better, self.unary[k] + score, value[k])
            back[k] = np.where(better, top, -1)
        k, level = divmod(int(np.argmax(value)), levels)
        path = []
        while True:
            path.append(k)
            step = int(back[k, level])
            if step < 0:
                break
            k, level = k - (step // levels + 1), step % levels
        return np.array(path[::-1])

    def numbers(self, paths: int, rng: np.random.Generator) -> Array:
        """Numbers of wheelsets of paths drawn from the posterior."""
        total = self.unary + self.start
        levels = _LEVELS.size
        for k in range(1, len(total)):
            flat = self._steps(total, k).reshape(-1, levels)
            top = np.maximum(flat.max(axis=0), self.start)
            into = top + np.log(np.exp(flat - top).sum(axis=0) + np.exp(self.start - top))
            total[k] = self.unary[k] + into
        ends = np.exp(total - total.max()).reshape(-1)
        ends /= ends.sum()
        out = []
        for end in rng.choice(ends.size, paths, p=ends):
            k, level = divmod(int(end), levels)
            number = 1
            while True:
                before = self._steps(total, k)[:, :, level].ravel() if k else np.zeros(0)
                options = np.append(before, self.start)
                share = np.cumsum(np.exp(options - options.max()))
                chosen = int(np.searchsorted(share, rng.random() * share[-1], side="right"))
                if chosen == before.size:
                    break
                k, level = k - (chosen // levels + 1), chosen % levels
                number += 1
            out.append(number)
        return np.array(out)


def _gap_prior(found: Array) -> Array:
    """Probability of every gap (in steps): anything, and more probably one that was seen."""
    lag = np.arange(int(_MOST / (CELL * _STEP)) + 1) * CELL * _STEP
    allowed = lag >= _LEAST
    prior = allowed / allowed.sum()
    if found.size:
        near = np.exp(-0.5 * ((lag[:, None] - found[None, :]) / _GAP_SPREAD) ** 2).sum(axis=1)
        near = near * allowed
        if near.sum() > 0:
            prior = _NEW_GAP * prior + (1 - _NEW_GAP) * near / near.sum()
    return np.asarray(prior)


def _pursued(c: Array, r: Array, noise: float) -> tuple[Array, Array]:
    """Places (cells) and heights by orthogonal matching pursuit, strongest first."""
    places: list[int] = []
    q: Array = np.zeros(0)
    rest = c.copy()
    near = round(_LEAST / CELL) - 1
    free = np.ones(c.size, dtype=bool)

    def pulse_at(place: int) -> Array:
        lag = np.abs(np.arange(c.size) - place)
        return np.where(lag < r.size, r[np.minimum(lag, r.size - 1)], 0.0)

    columns: list[Array] = []
    while len(places) < _MANY:
        k = int(np.argmax(np.where(free, rest, -np.inf)))
        if rest[k] < max(
            _LEAST_CONTRAST * noise, _LEAST_LEVEL * float(np.median(q)) if places else 0.0
        ):
            break
        places.append(k)
        columns.append(pulse_at(k))
        free[max(k - near, 0) : k + near + 1] = False
        both = np.stack(columns)
        q = np.asarray(np.linalg.solve(both[:, places] + 1e-9 * np.eye(len(places)), c[places]))
        rest = c - q @ both
    return np.array(places), q


def _own(rest: Array, r: Array, places: Array, q: Array) -> Array:
    """Matched-filter output of every place, without the pulses of other wheelsets."""
    lag = np.abs(np.arange(rest.size)[:, None] - places[None, :])
    near = np.argmin(lag, axis=1)
    rows = np.arange(rest.size)
    own = np.interp(lag[rows, near], np.arange(r.size), r, right=0.0) * q[near]
    return np.asarray(rest + np.where(lag[rows, near] < 0.5 * _LEAST / CELL, own, 0.0))


def _left(rest: Array, r: Array, places: Array) -> float:
    """Standard deviation of what wheelsets leave of a matched filter's output along the train.

    Places and heights took two of the independent values each (Bartlett: N / sum of r²).
    """
    half = r.size // 2
    part = rest[max(int(places[0]) - half, 0) : int(places[-1]) + half + 1]
    values = part.size / (2 * float(r @ r) / float(r[0]) ** 2 - 1)
    freedom = max(1 - 2 * places.size / values, 0.1)
    return float(np.sqrt(np.mean(part**2) / freedom))


def _begun(
    y: Array, noise: Array | None, pulse: Array
) -> tuple[Array, float, Array, Array, Array] | None:
    """First wheelsets by a pulse: it at unit energy, the noise of its estimate, places (cells),
    heights, rest."""
    pulse = pulse / np.sqrt(float(pulse @ pulse))
    output = np.asarray(np.convolve(y, pulse[::-1], "same"))
    least = 1.4826 * float(np.median(np.abs(output)))
    if noise is not None:
        least = float(np.std(np.convolve(noise, pulse[::-1], "same")))
    overlap = np.asarray(np.correlate(pulse, pulse, "full")[pulse.size - 1 :])
    start, _ = _pursued(output, overlap, least)
    if start.size < 2:
        return None
    return pulse, least, *_fitted(y, pulse, np.sort(start).astype(float))


def find(y: Array, noise: Array | None, pulse: Array) -> Wheelsets | None:
    """The wheelsets in a signal.

    Args:
        y: over distance, spacing :data:`CELL`, shape (cells,).
        noise: what of it is known to be noise, the same shape: half the difference of two records;
            ``None`` where nothing is known but what the wheelsets leave.
        pulse: first guess, odd number of cells; or several, shape (shapes, cells), that the pulse
            is a mixture of.
    """
    half = round(_HALF / CELL)
    middle = pulse.shape[-1] // 2
    family = np.atleast_2d(pulse)[:, middle - half : middle + half + 1]
    begun = [found for shape in family if (found := _begun(y, noise, shape)) is not None]
    if not begun:
        return None
    pulse, least, places, q, rest = min(begun, key=lambda found: float(found[-1] @ found[-1]))
    height = float(np.median(q))

    def filtered(x: Array) -> Array:
        return np.asarray(np.convolve(x, pulse[::-1], "same"))

    def overlap() -> Array:
        return np.asarray(np.correlate(pulse, pulse, "full")[pulse.size - 1 :])

    def doubt(rest: Array) -> float:
        return float(np.std(filtered(rest if noise is None else noise)))

    for round_ in range(_ROUNDS):
        if height > _LEARN_CONTRAST * least and (round_ == 0 or len(family) > 1):
            if len(family) > 1:
                pulse = _mixed(y, places, q, family)
            else:
                pulse = _learnt(y, places, q, pulse)
            pulse = pulse / np.sqrt(float(pulse @ pulse))
            places, q, rest = _fitted(y, pulse, places)
        deviation = float(np.hypot(doubt(rest), _MISFIT * height))
        c = _own(filtered(rest), overlap(), places, q)[::_STEP]
        chain = _Chain(c, height, deviation, _gap_prior(np.diff(places) * CELL))
        path = chain.best()
        if path.size < 2:
            return None
        places, q, rest = _fitted(y, pulse, path.astype(float) * _STEP)
        height = float(np.median(q))
    numbers = chain.numbers(_PATHS, np.random.default_rng(0))
    slope = np.gradient(pulse)
    steep = float(np.sqrt(slope @ slope))
    # what moves a wheelset is noise of the shape of its pulse's slope
    pushed = np.convolve(rest, slope[::-1] / steep, "same")
    left = _left(np.asarray(pushed), overlap(), places)
    return Wheelsets(
        place=places * CELL,
        level=q / height,
        sigma=CELL * left / (steep * np.maximum(q, 0.2 * height)),
        contrast=height / deviation,
        certainty=float(np.mean(numbers == places.size)),
        explained=float(1 - rest @ rest / (y @ y)),
        pulse=pulse,
    )


def heights(y: Array, found: Wheelsets) -> Array:
    """Heights of the pulses of wheelsets that were found, in another signal over the same axis."""
    a = _shifted(found.pulse, found.place / CELL, y.size)
    return _solved(a, y, 1e-6 * float(found.pulse @ found.pulse))
