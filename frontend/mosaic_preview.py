"""A reduced picture of a mosaic that is too large to be held."""

import math

import cv2
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
        share = self._means(tile.count > 0)
        place = slice(row, row + share.shape[0]), slice(column, column + share.shape[1])
        self._floor[place] = self._reduced(tile.floor, share)
        self._mean[place] = self._reduced(tile.mean, share)
        along = np.arange(0, tile.count.shape[1], self._factor)
        down = np.arange(0, tile.count.shape[0], self._factor)
        most = np.maximum.reduceat(np.maximum.reduceat(tile.count, down, axis=0), along, axis=1)
        self._count[place] = most

    def _means(self, cells: np.ndarray) -> Picture32:
        """Return the means of groups of cells (rows, columns, ...), filled up by zeros.

        Exact: a group's sum is below 2 ** 24, and its size a power of two.
        """
        rows, columns = cells.shape[:2]
        sides = -(-rows // self._factor), -(-columns // self._factor)
        below, beside = sides[0] * self._factor - rows, sides[1] * self._factor - columns
        full: np.ndarray = cells.astype(np.float32)
        if below or beside:
            full = cv2.copyMakeBorder(full, 0, below, 0, beside, cv2.BORDER_CONSTANT, value=0.0)
        means = cv2.resize(full, sides[::-1], interpolation=cv2.INTER_AREA)
        return np.asarray(means, dtype=np.float32)

    def _reduced(self, colours: Image, share: Picture32) -> Image:
        """Mean of the seen cells: the others are 0 and don't count."""
        least = np.float32(1.0 / self._factor**2)
        mean: Image = np.rint(self._means(colours) / np.maximum(share, least)[..., None]).astype(
            np.uint8
        )
        return mean

    def finished(self) -> Mosaic:
        """Return the preview; a cell's count is the largest of its group's.

        Raises:
            ValueError: nothing was seen.
        """
        return trimmed(self._grid, Tile(self._floor, self._mean, self._count))
