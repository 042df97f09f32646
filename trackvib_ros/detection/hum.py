"""Mains hum taken out of a record that is there as a whole.

A line at a mains frequency or a harmonic of it lasts through the record with nearly one amplitude;
a train does not. Its complex amplitude b_k in cells of 0.1 s, each of variance s_k² by how
neighbours differ, would without a line be independent Gaussian noise, and

    G = |sum b_k / s_k²|² / sum 1/s_k²

exponential with mean 1 (Kay, Fundamentals of Statistical Signal Processing II, 1998, sec. 7.6.2):
quiet stretches count, those in which a train is loud hardly do.

A stream (:class:`.TrainDetector`, the nodes) keeps its hum: the amplitude under a train is that
before and after it, so that what is told while it passes would have to wait. There the hum is part
of the noise floor; where it is as strong as trains, take it out at the sensor.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

Array = NDArray[np.float64]

_MAINS = (50 / 3, 60.0)  # Hz, railways and grids; 50 Hz is a harmonic of the first
_HIGHEST = 1000.0  # Hz
_OFF = 2e-3  # largest relative error of a grid's frequency, 0.1 Hz of 50 Hz
_BAND = 10.0  # Hz, about a line
_SPREAD = 5  # cells over which the noise is taken
_FOLLOWED_S = 2.0  # an amplitude changes within this
_LEAST = 30.0  # e^30 outweighs all lines and frequencies tried, with noise known from few cells
_SHORTEST_S = 1.0


def without_hum(samples: Array, rate: float) -> Array:
    """Samples without lines at mains frequencies.

    Args:
        samples: finite, shape (samples,).
        rate: samples per second.
    """
    n = samples.size
    length = n / rate
    if length < _SHORTEST_S:
        return samples
    cells = int(_BAND * length) // 2 * 2
    spectrum = fft.rfft(samples)
    time = np.asarray(np.arange(cells) * (length / cells), dtype=np.float64)
    out = samples
    for line in _lines(rate):
        middle = round(line * length)
        near = spectrum[middle - cells // 2 : middle + cells // 2]
        amplitude = np.asarray(fft.ifft(fft.ifftshift(near)) * (cells / n))
        found = _followed(amplitude, time, line)
        if found is not None:
            off, followed = found
            t = np.arange(n) / rate
            wave = np.exp(2j * np.pi * (middle / length + off) * t)
            real, imaginary = (np.interp(t, time, part) for part in (followed.real, followed.imag))
            out = out - 2 * (real * wave.real - imaginary * wave.imag)
    return out


def _lines(rate: float) -> list[float]:
    """Mains frequencies and harmonics (Hz) below the Nyquist frequency."""
    top = min(_HIGHEST, 0.5 * rate - _BAND)
    found = {round(f * k, 3) for f in _MAINS for k in range(1, int(top / f) + 1)}
    return sorted(found)


def _followed(
    amplitude: NDArray[np.complex128], time: Array, line: float
) -> tuple[float, NDArray[np.complex128]] | None:
    """By how much a line is off (Hz) and its amplitude there; ``None`` without one.

    Args:
        amplitude: in cells, at the frequency of the middle of the band.
        time: of the cells (s).
        line: its frequency (Hz).
    """
    power = 0.5 * np.abs(amplitude - np.roll(amplitude, 1)) ** 2
    noise = ndimage.uniform_filter1d(power, _SPREAD, mode="wrap")
    weight = 1 / np.maximum(noise, 1e-12 * float(np.mean(np.abs(amplitude) ** 2)) + 1e-300)
    length = time.size * float(time[1])
    most = min(max(1, int(np.ceil(4 * _OFF * line * length))), 2 * time.size)
    quarters = np.arange(-most, most + 1)
    offs = quarters / (4 * length)
    gain = np.abs(fft.fft(weight * amplitude, 4 * time.size)[quarters])
    best = int(np.argmax(gain))
    if gain[best] ** 2 < _LEAST * float(weight.sum()):
        return None
    steady = weight * amplitude * np.exp(-2j * np.pi * offs[best] * time)
    sigma = _FOLLOWED_S / float(time[1])
    total, real, imaginary = (
        ndimage.gaussian_filter1d(x, sigma, mode="nearest")
        for x in (weight, steady.real, steady.imag)
    )
    return float(offs[best]), np.asarray((real + 1j * imaginary) / total)
