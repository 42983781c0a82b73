"""The loops of `area_remap.py`, compiled: means of bilinear samples of a picture, whole numbers."""

from typing import Any

import numpy as np

from groundfuse.backend.compiled import compiled

PART_BITS = 8
"""Samples lie on 1/256 px: the weights of a sample's four pixels add up to 2 ** 16."""


@compiled
def quads_of(plane: Any) -> np.ndarray:  # noqa: ANN401
    """Return (rows * columns) uint32: each pixel with its neighbours, so that one look has all.

    From the lowest byte on: the pixel, the one below, the one beside it, the one below that. What
    lies beyond the border is of no meaning: nothing but a weight of zero may fall on it.

    Args:
        plane: (rows, columns) uint8, without gaps.
    """
    rows, columns = plane.shape
    quads = np.empty(rows * columns, np.uint32)
    one, two, three = np.uint32(8), np.uint32(16), np.uint32(24)
    for row in range(rows):
        here, below = plane[row], plane[min(row + 1, rows - 1)]
        line = quads[row * columns : (row + 1) * columns]
        for x in range(columns - 1):
            left = np.uint32(here[x]) | (np.uint32(below[x]) << one)
            right = (np.uint32(here[x + 1]) << two) | (np.uint32(below[x + 1]) << three)
            line[x] = left | right
        line[columns - 1] = here[columns - 1] | (np.uint32(below[columns - 1]) << one)
    return quads


@compiled
def fill_means(quads: Any, starts: Any, parts: Any, cells: Any, view: Any, channel: int) -> None:  # noqa: ANN401
    """Write the mean of each cell's samples, rounded.

    Args:
        quads: (rows * columns) uint32 of one channel of the picture; see `quads_of`.
        starts: (n, samples) uint32 first of the four pixels of each sample: row * columns + column.
        parts: (n, samples) uint16 places behind it in 1 / 2 ** PART_BITS px: across, and down in
            the higher byte.
        cells: (n, 2) uint32 row and column of the view.
        view: (rows, columns, channels) uint8 to write into.
        channel: which of them.
    """
    # Unsigned: a number that may be negative is asked whether it counts from the end.
    at = np.uint64(channel)
    full, low = np.uint32(1 << PART_BITS), np.uint32((1 << PART_BITS) - 1)
    half, bits = np.uint32(16), np.uint32(PART_BITS)
    lanes, lane = np.uint32(0x00FF00FF), np.uint32(0x0000FFFF)
    samples = starts.shape[1]
    whole = np.uint64(samples) << np.uint64(2 * PART_BITS)
    for n in range(len(cells)):
        total = whole >> np.uint64(1)
        for k in range(samples):
            quad, part = quads[starts[n, k]], np.uint32(parts[n, k])
            across, down = part & low, part >> bits
            # Two columns side by side in one number: their sums stay below 2 ** 16.
            columns = (quad & lanes) * (full - down) + ((quad >> bits) & lanes) * down
            total += np.uint64((columns & lane) * (full - across) + (columns >> half) * across)
        view[np.uint64(cells[n, 0]), np.uint64(cells[n, 1]), at] = total // whole
