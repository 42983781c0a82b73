"""An endless floor held as square chunks with their pyramids, made when first looked at.

Cell k of level n covers the metres [k, k + 1) * cell_m * 2**n of a world axis, so that its centre
is at (k + 0.5) * cell_m * 2**n: halving by the mean keeps every level in place.
"""

import math
from collections import OrderedDict
from collections.abc import Callable

import cv2
import numpy as np

from groundfuse.frontend.arrays import Floats, Image
from groundfuse.tools.noise import Rect

CHUNK = 512
LEVELS = 6
MAX_CHUNKS = 256

Texture = Callable[[int, Rect], Image]
"""Colours (height, width, 3) of a rectangle of cells for a seed."""


class FloorRaster:
    """A floor that can be read at any place and level, by one thread at a time.

    Attributes:
        cell_m: size of a cell of level 0.
    """

    def __init__(self, texture: Texture, seed: int, cell_m: float) -> None:
        """Prepare an endless floor; nothing is drawn yet.

        Raises:
            ValueError: the cell has no size.
        """
        if not (math.isfinite(cell_m) and cell_m > 0.0):
            raise ValueError(f"a floor needs a positive cell size, got {cell_m:g} m")
        self.cell_m = cell_m
        self._texture = texture
        self._seed = seed
        self._chunks: OrderedDict[tuple[int, int], tuple[Image, ...]] = OrderedDict()

    def _chunk(self, column: int, row: int) -> tuple[Image, ...]:
        place = (column, row)
        if place in self._chunks:
            self._chunks.move_to_end(place)
            return self._chunks[place]
        base = self._texture(self._seed, Rect(column * CHUNK, row * CHUNK, CHUNK, CHUNK))
        pyramid = [base]
        for _ in range(1, LEVELS):
            side = pyramid[-1].shape[0] // 2
            halved = cv2.resize(pyramid[-1], (side, side), interpolation=cv2.INTER_AREA)
            pyramid.append(np.asarray(halved, dtype=np.uint8))
        self._chunks[place] = tuple(pyramid)
        if len(self._chunks) > MAX_CHUNKS:
            self._chunks.popitem(last=False)
        return self._chunks[place]

    def patch(self, rect: Rect, level: int) -> Image:
        """Return the colours (height, width, 3) of a rectangle of cells of a level."""
        side = CHUNK >> level
        out = np.empty((rect.height, rect.width, 3), dtype=np.uint8)
        for row in range(rect.y0 // side, (rect.y0 + rect.height - 1) // side + 1):
            for column in range(rect.x0 // side, (rect.x0 + rect.width - 1) // side + 1):
                chunk = self._chunk(column, row)[level]
                left, top = column * side - rect.x0, row * side - rect.y0
                x0, y0 = max(left, 0), max(top, 0)
                x1, y1 = min(left + side, rect.width), min(top + side, rect.height)
                out[y0:y1, x0:x1] = chunk[y0 - top : y1 - top, x0 - left : x1 - left]
        return out

    def mean_colour(self) -> Floats:
        """Return the mean colour (3,) of the chunk at the origin."""
        mean: Floats = self._chunk(0, 0)[0].reshape(-1, 3).mean(axis=0)
        return mean
