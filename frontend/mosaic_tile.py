"""One tile of a mosaic: at most so many views per cell are held, however many there are."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from groundfuse.frontend.arrays import Floats, Image, Picture32
from groundfuse.frontend.selection_compiled import LEVEL, combine_cells
from groundfuse.frontend.sight import SeenCells
from groundfuse.frontend.tile_compiled import add_held, by_depth, put, to_levels

LEVELS_PER_HALF = np.float32(1.0 / LEVEL)


@dataclass(frozen=True, slots=True, eq=False)
class Tile:
    """The finished layers of a tile; see `Mosaic`."""

    floor: Image
    mean: Image
    count: NDArray[np.uint16]


class TileStack:
    """The views of each cell as they come, the `depth` finest of them kept."""

    def __init__(self, rows: int, columns: int, depth: int) -> None:
        """Make room for `depth` views of every cell."""
        self._shape = (rows, columns)
        num_cells = rows * columns
        self._words = np.empty((depth, num_cells), dtype=np.uint32)
        self._footprint = np.empty((num_cells, depth), dtype=np.float32)
        self._weight = np.empty((depth, num_cells), dtype=np.float32)
        self._held = np.zeros(num_cells, dtype=np.uint8)
        self._coarsest = np.full(num_cells, depth, dtype=np.uint8)
        self._left_out = np.zeros((3, num_cells), dtype=np.float32)
        self._count = np.zeros(num_cells, dtype=np.uint16)

    def add(
        self,
        offset: tuple[int, int],
        seen: SeenCells,
        limits: Picture32,
        log_gain: Floats,
    ) -> None:
        """Add one view of a window of the tile.

        Args:
            offset: row and column of the window's first cell.
            seen: cells of the window that the view shows.
            limits: (3 or more,) last column, first and last row of the used picture.
            log_gain: (3,) BGR exposure of the view.
        """
        stack = self._words, self._footprint, self._weight
        tallies = self._held, self._count, self._coarsest, self._left_out
        view = seen.cell, seen.place, seen.colour
        gain = np.exp(-log_gain).astype(np.float32)
        put(view, (*offset, self._shape[1]), gain, limits, stack, tallies)

    def finished(self, noise_levels: float, num_sigmas: float) -> Tile:
        """Return the layers of the tile."""
        floor = np.zeros((3, len(self._held)), dtype=np.float32)
        order, begins = by_depth(self._held, len(self._words))
        limits = np.float32((noise_levels * LEVEL) ** 2), np.float32(num_sigmas**2)
        for depth in range(1, len(self._words) + 1):
            cells = order[begins[depth] : begins[depth + 1]]
            stack = self._words[:depth], self._footprint, self._weight[:depth]
            combine_cells(*stack, cells, limits, floor)
        add_held(self._words, self._held, self._left_out)
        every = np.full(len(self._held), LEVELS_PER_HALF)
        share = LEVELS_PER_HALF / np.maximum(self._count, 1).astype(np.float32)
        return Tile(
            self._picture(floor, every),
            self._picture(self._left_out, share),
            self._count.reshape(self._shape),
        )

    def _picture(self, half_levels: Picture32, share: Picture32) -> Image:
        picture: Image = np.empty((*self._shape, 3), dtype=np.uint8)
        to_levels(half_levels, share, picture.reshape(-1, 3))
        return picture
