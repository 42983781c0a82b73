"""Endless random fields: any rectangle of them can be made alone and fits its neighbours exactly.

A field is a function of integer cell coordinates and a key, so nothing is stored and nothing ever
repeats. Random numbers come from a 64-bit mix of the coordinates (the finaliser of SplitMix64,
Steele, Lea and Flood 2014), the same on every machine.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from groundfuse.frontend.arrays import Floats, Picture32

Integers = NDArray[np.int64]

CUBIC_VARIANCE = 151.0 / 315.0  # of white noise after one axis of a cubic B-spline, averaged
WHITE_SCALE = 12.0**0.5  # a uniform number of this width has standard deviation 1
_GOLDEN = np.array(0x9E3779B97F4A7C15, dtype=np.uint64)
_FIRST = np.array(0xBF58476D1CE4E5B9, dtype=np.uint64)
_SECOND = np.array(0x94D049BB133111EB, dtype=np.uint64)


@dataclass(frozen=True, slots=True)
class Rect:
    """A rectangle of cells: columns x0 to x0 + width - 1, rows y0 to y0 + height - 1."""

    x0: int
    y0: int
    width: int
    height: int

    def grown(self, margin: int) -> "Rect":
        """Return the rectangle with `margin` more cells on each side."""
        return Rect(
            self.x0 - margin, self.y0 - margin, self.width + 2 * margin, self.height + 2 * margin
        )


def _mixed(state: NDArray[np.uint64]) -> NDArray[np.uint64]:
    state = (state ^ (state >> np.uint64(30))) * _FIRST
    state = (state ^ (state >> np.uint64(27))) * _SECOND
    return state ^ (state >> np.uint64(31))


def uniform(key: tuple[int, ...], *coordinates: Integers) -> Floats:
    """Return a number in [0, 1) per coordinate tuple; the same key and place give the same."""
    state = np.zeros(1, dtype=np.uint64)
    for part in (*key, *coordinates):  # grows to the full shape only with the last coordinate
        word = np.asarray(part, dtype=np.int64).astype(np.uint64)
        state = _mixed((state + word) * _GOLDEN + _GOLDEN)
    numbers: Floats = (state >> np.uint64(11)).astype(np.float64) * 2.0**-53
    return numbers


def _nodes(start: int, count: int, pitch: int) -> tuple[int, int]:
    """First lattice node that a run of cells needs, and how many."""
    first = start // pitch - 1
    return first, (start + count - 1) // pitch + 3 - first


def _spread(lattice: Picture32, start: int, pitch: int, count: int) -> Picture32:
    """Interpolate along axis 0 from nodes to cells (cubic B-spline); returns the transpose."""
    cells = np.arange(start, start + count)
    node = cells // pitch - start // pitch
    t = ((cells % pitch + 0.5) / pitch).astype(np.float32)[:, None]
    parts = ((1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3)
    total = np.zeros((count, lattice.shape[1]), dtype=np.float32)
    for k, part in enumerate(parts):
        total += (part / np.float32(6.0)) * lattice[node + k]
    return np.ascontiguousarray(total.T)


def white(key: tuple[int, ...], rect: Rect) -> Picture32:
    """Return (height, width) independent numbers of mean 0 and deviation 1."""
    columns = np.arange(rect.x0, rect.x0 + rect.width)
    rows = np.arange(rect.y0, rect.y0 + rect.height)
    numbers = uniform(key, columns[None, :], rows[:, None])
    return ((numbers - 0.5) * WHITE_SCALE).astype(np.float32)


def smooth(key: tuple[int, ...], rect: Rect, pitch_x: int, pitch_y: int) -> Picture32:
    """Return (height, width) smooth numbers of mean 0 and deviation 1.

    Args:
        key: names the field.
        rect: the cells wanted.
        pitch_x: cells between the random nodes along x; the finest detail.
        pitch_y: the same along y.
    """
    x0, columns = _nodes(rect.x0, rect.width, pitch_x)
    y0, rows = _nodes(rect.y0, rect.height, pitch_y)
    lattice = white(key, Rect(x0, y0, columns, rows)) / np.float32(CUBIC_VARIANCE)
    by_row = _spread(lattice, rect.y0, pitch_y, rect.height)
    return _spread(by_row, rect.x0, pitch_x, rect.width)


def octaves(key: tuple[int, ...], rect: Rect, amplitudes: dict[int, float]) -> Picture32:
    """Return a weighted sum of `smooth` fields, one per pitch (cells); pitch 1 is `white`."""
    total = np.zeros((rect.height, rect.width), dtype=np.float32)
    for pitch, amplitude in amplitudes.items():
        if pitch == 1:
            field = white((*key, pitch), rect)
        else:
            field = smooth((*key, pitch), rect, pitch, pitch)
        total += np.float32(amplitude) * field
    return total
