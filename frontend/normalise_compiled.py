"""The loops of `normalise.py`, compiled: sums over blocks, and the pixels against their means."""

import numpy as np

from groundfuse.backend.compiled import compiled, part
from groundfuse.frontend.arrays import Image, Picture32

UNROLLED = 4
"""Columns of a block whose sum is written out: a vector operation, 25 times as fast as a loop."""

EXPONENTS_APART = (127 - 15) << 23
"""What single precision adds to an exponent more than half precision does, in its bits."""
SMALLEST_HALF, LARGEST_HALF = 0x38800000, 0x477FE000
"""Bits of 2 ** -14 and of 65504 in single precision."""


@part
def _count_row(mask: Image, counts: np.ndarray) -> None:
    """Add a row to counts of columns: a vector operation."""
    for x in range(len(mask)):
        counts[x] += np.int32(mask[x])


@part
def _add_row(grey: Image, mask: Image, values: np.ndarray, squares: np.ndarray) -> None:
    """Add a row to sums of columns: with more arrays at once it would be no vector operation."""
    for x in range(len(grey)):
        value = np.int32(grey[x]) * np.int32(mask[x])
        values[x] += value
        squares[x] += value * value


@part
def _add_neighbours(line: np.ndarray, blocks: np.ndarray, step: int) -> None:
    """Sum up each block's columns."""
    if step == UNROLLED:
        for block in range(len(blocks)):
            x = UNROLLED * block
            blocks[block] = line[x] + line[x + 1] + line[x + 2] + line[x + 3]
        return
    for block in range(len(blocks)):
        total = np.int32(0)
        for x in range(block * step, (block + 1) * step):
            total += line[x]
        blocks[block] = total


@compiled
def block_sums(grey: Image, mask: Image, step: int) -> np.ndarray:
    """Return counts, sums, squares (3, rows / step, columns / step), int32, of pixels that count.

    Args:
        grey: (rows, columns) uint8; blocks reach beyond where they don't fit.
        mask: (rows, columns) uint8, 1 for pixels that count and 0 for the others.
        step: side of a block.
    """
    rows, columns = grey.shape
    sums = np.zeros((3, -(-rows // step), -(-columns // step)), np.int32)
    lines = np.empty((3, sums.shape[2] * step), np.int32)
    for block in range(sums.shape[1]):
        lines[:] = 0
        for y in range(block * step, min((block + 1) * step, rows)):
            _count_row(mask[y], lines[0])
            _add_row(grey[y], mask[y], lines[1], lines[2])
        for kind in range(3):
            _add_neighbours(lines[kind], sums[kind, block], step)
    return sums


@compiled
def centred_means(sums: np.ndarray, middle: int, step: int) -> Picture32:
    """Return weights, means and mean squares (3, ...) of differences from a grey value.

    Those of pixels that don't count are zero, and all are of whole blocks.

    Args:
        sums: see `block_sums`.
        middle: grey value.
        step: side of a block.
    """
    found = np.empty(sums.shape, np.float32)
    share = np.float32(1.0 / (step * step))
    for y in range(sums.shape[1]):
        for x in range(sums.shape[2]):
            count, total, square = sums[0, y, x], sums[1, y, x], sums[2, y, x]
            found[0, y, x] = np.float32(count) * share
            found[1, y, x] = np.float32(total - middle * count) * share
            square += middle * (middle * count - 2 * total)
            found[2, y, x] = np.float32(square) * share
    return found


@compiled
def against_means(
    grey: Image, mask: Image, mean: Picture32, inverse: Picture32, step: int, middle: int
) -> Picture32:
    """Return (grey - middle - mean) * inverse (rows, columns), 0 where the mask is.

    Args:
        grey: (rows, columns) uint8.
        mask: (rows, columns) uint8, 1 or 0.
        mean: (rows / step, at least columns) of blocks of rows, in between of which it is linear.
        inverse: the same of the factor.
        step: rows of a block.
        middle: grey value.
    """
    rows, columns = grey.shape
    found = np.empty((rows, columns), np.float32)
    for y in range(rows):
        at = min(max((y + 0.5) / step - 0.5, 0.0), float(len(mean) - 1))
        above = int(at)
        below, share = min(above + 1, len(mean) - 1), np.float32(at - above)
        mean_0, mean_1 = mean[above], mean[below]
        factor_0, factor_1 = inverse[above], inverse[below]
        here, valid, line = grey[y], mask[y], found[y]
        for x in range(columns):
            value = np.float32(np.int32(here[x]) - np.int32(middle))
            value -= mean_0[x] + share * (mean_1[x] - mean_0[x])
            value *= factor_0[x] + share * (factor_1[x] - factor_0[x])
            line[x] = value * np.float32(valid[x])
    return found


@compiled
def halves(picture: Picture32) -> np.ndarray:
    """Return the bits (rows, columns) uint16 of numbers of half precision, the nearest.

    What is too large becomes the largest, what is smaller than 2 ** -14 becomes 0.

    Args:
        picture: (rows, columns) float32, without gaps.
    """
    bits = picture.reshape(-1).view(np.uint32)
    found = np.empty(picture.shape, np.uint16)
    flat = found.reshape(-1)
    lost = np.uint32(13)  # bits of a number that half precision has no room for
    below = np.uint32((1 << 12) - 1)
    for i in range(len(bits)):
        sign = (bits[i] >> np.uint32(16)) & np.uint32(1 << 15)
        size = min(bits[i] & np.uint32((1 << 31) - 1), np.uint32(LARGEST_HALF))
        even = (size >> lost) & np.uint32(1)  # of two that are as near: the even one
        rounded = (size - np.uint32(EXPONENTS_APART) + below + even) >> lost
        flat[i] = sign | (rounded if size >= np.uint32(SMALLEST_HALF) else np.uint32(0))
    return found
