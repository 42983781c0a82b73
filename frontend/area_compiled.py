"""The loop of `area_remap.py`, compiled: means of bilinear samples of a picture, whole numbers."""

from typing import Any

import numpy as np

from groundfuse.frontend.compiled import compiled

PART_BITS = 8
"""Samples lie on 1/256 px: the weights of a sample's four pixels add up to 2 ** 16."""


@compiled
def fill_means(flat: Any, shape: Any, starts: Any, parts: Any, cells: Any, view: Any) -> None:  # noqa: ANN401
    """Write the mean of each cell's samples, rounded.

    Args:
        flat: (rows * columns * channels) uint8 picture.
        shape: its columns and channels.
        starts: (n, samples) uint32 first of the four pixels of each sample: row * columns + column.
        parts: (n, samples, 2) uint16 places behind it, across and down, in 1 / 2 ** PART_BITS px.
        cells: (n, 2) uint32 row and column of the view.
        view: (rows, columns, channels) uint8 to write into.
    """
    # Unsigned: a number that may be negative is asked whether it counts from the end.
    channels = np.uint64(shape[1])
    below = np.uint64(shape[0]) * channels
    one = np.uint32(1 << PART_BITS)
    samples = starts.shape[1]
    whole = np.uint64(samples) << np.uint64(2 * PART_BITS)
    for n in range(len(cells)):
        row, column = np.uint64(cells[n, 0]), np.uint64(cells[n, 1])
        for channel in range(channels):
            total = whole >> np.uint64(1)
            for k in range(samples):
                at = np.uint64(starts[n, k]) * channels + np.uint64(channel)
                across, down = np.uint32(parts[n, k, 0]), np.uint32(parts[n, k, 1])
                top = np.uint32(flat[at]) * np.uint32(one - across)
                top += np.uint32(flat[at + channels]) * across
                low = np.uint32(flat[at + below]) * np.uint32(one - across)
                low += np.uint32(flat[at + below + channels]) * across
                total += np.uint64(top * np.uint32(one - down) + low * down)
            view[row, column, np.uint64(channel)] = total // whole
