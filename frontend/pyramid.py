"""A picture and its halvings, laid out for the compiled readers."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from groundfuse.frontend.area_remap import point_values
from groundfuse.frontend.arrays import Image
from groundfuse.frontend.reading_compiled import CHANNELS, PADDING_PX

SMALLEST_PX = 32


@dataclass(frozen=True, slots=True, eq=False)
class Pyramid:
    """Point values of a picture and its halvings, each with its border drawn out.

    Halving a pixel's coordinates gives its place in each.

    Attributes:
        levels: bytes of all levels, four a pixel: blue, green, red, anything.
        table: (levels, 4) byte of each level's first pixel, bytes per row, columns, rows.
    """

    levels: NDArray[np.uint8]
    table: NDArray[np.int64]

    @property
    def nbytes(self) -> int:
        """Memory held."""
        return self.levels.nbytes

    def level(self, number: int) -> Image:
        """Return the pixels (rows, columns, 4) of one level, a view."""
        first, stride, columns, rows = self.table[number].tolist()
        picture: Image = np.ndarray(
            (rows, columns, CHANNELS), np.uint8, self.levels, first, (stride, CHANNELS, 1)
        )
        return picture


def halvings(px_per_cell: float) -> int:
    """Return how often a picture is halved that still leaves two pixels per cell."""
    return max(0, math.floor(math.log2(max(px_per_cell, 1.0) / 2.0)))


def pyramid(image: Image, most: int) -> Pyramid:
    """Return a picture, colour or grey, and its halvings.

    So many at most; none is much smaller than `SMALLEST_PX`.
    """
    if image.ndim == 2:
        image = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    pictures = [point_values(image)]
    while len(pictures) <= most and min(pictures[-1].shape[:2]) > SMALLEST_PX:
        pictures.append(np.asarray(cv2.pyrDown(pictures[-1]), dtype=np.uint8))
    return _laid_out(pictures)


def _laid_out(pictures: list[Image]) -> Pyramid:
    pad = PADDING_PX
    sizes = [
        (rows + 2 * pad, columns + 2 * pad) for rows, columns in (p.shape[:2] for p in pictures)
    ]
    begins = np.cumsum([0, *(rows * columns * CHANNELS for rows, columns in sizes)]).tolist()
    levels = np.zeros(begins[-1], np.uint8)
    table = np.zeros((len(pictures), 4), np.int64)
    for number, (picture, (rows, columns)) in enumerate(zip(pictures, sizes, strict=True)):
        stride = columns * CHANNELS
        place = levels[begins[number] : begins[number + 1]].reshape(rows, columns, CHANNELS)
        four = cv2.cvtColor(picture, cv2.COLOR_BGR2BGRA)
        place[:] = cv2.copyMakeBorder(four, pad, pad, pad, pad, cv2.BORDER_REPLICATE)
        first = begins[number] + pad * (stride + CHANNELS)
        table[number] = first, stride, columns - 2 * pad, rows - 2 * pad
    return Pyramid(levels, table)
