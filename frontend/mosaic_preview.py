"""A reduced picture of a mosaic that is too large to be held."""

import math

import numpy as np

from groundfuse.frontend.arrays import Image, Picture32
from groundfuse.frontend.mosaic import Mosaic, trimmed
from groundfuse.frontend.mosaic_plan import Block
from groundfuse.frontend.mosaic_tile import Tile
from groundfuse.frontend.sight import Grid


def reduction(grid: Grid, most_cells: int, largest: int) -> int:
    """Return the power of two, `largest` at most, by which a grid shrinks to so many cells."""
    factor = 1
    while grid.rows * grid.columns > most_cells * factor**2 and factor < largest:
        factor *= 2
    return factor


class Preview:
    """Takes the tiles of a mosaic and keeps the means of square groups of their cells."""

    def __init__(self, grid: Grid, factor: int) -> None:
        """Make room for one cell in place of `factor` x `factor`."""
        self._factor = factor
        rows, columns = math.ceil(grid.rows / factor), math.ceil(grid.columns / factor)
        self._grid = Grid(grid.x_min_m, grid.y_max_m, grid.m_per_px * factor, rows, columns)
        colour = (rows, columns, 3)
        self._floor, self._mean = np.zeros(colour, np.uint8), np.zeros(colour, np.uint8)
        self._count = np.zeros((rows, columns), np.uint16)

    def add(self, block: Block, tile: Tile) -> None:
        """Take one tile, whose first row and column are multiples of the factor."""
        row, column = (part.start // self._factor for part in block)
        count = self._groups(tile.count).max(axis=(1, 3))
        place = slice(row, row + count.shape[0]), slice(column, column + count.shape[1])
        seen = (tile.count > 0).astype(np.float32)
        share = self._groups(seen).sum(axis=(1, 3))
        self._floor[place] = self._reduced(tile.floor, share)
        self._mean[place] = self._reduced(tile.mean, share)
        self._count[place] = count

    def _groups(self, cells: np.ndarray) -> np.ndarray:
        """Return (n, factor, m, factor, ...) of cells (rows, columns, ...), filled up by zeros."""
        rows, columns = cells.shape[:2]
        more = [(0, -rows % self._factor), (0, -columns % self._factor)]
        full = np.pad(cells, more + [(0, 0)] * (cells.ndim - 2))
        sides = full.shape[0] // self._factor, full.shape[1] // self._factor
        shape = (sides[0], self._factor, sides[1], self._factor, *cells.shape[2:])
        return full.reshape(shape)

    def _reduced(self, colours: Image, share: Picture32) -> Image:
        """Mean of the seen cells: the others are 0 and don't count."""
        total = self._groups(colours).sum(axis=(1, 3), dtype=np.float32)
        mean: Image = np.rint(total / np.maximum(share, 1.0)[..., None]).astype(np.uint8)
        return mean

    def finished(self) -> Mosaic:
        """Return the preview; a cell's count is the largest of its group's.

        Raises:
            ValueError: nothing was seen.
        """
        return trimmed(self._grid, Tile(self._floor, self._mean, self._count))
