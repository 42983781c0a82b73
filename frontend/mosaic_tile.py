"""One tile of a mosaic: at most so many views per cell are held, however many there are."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from groundfuse.frontend.arrays import Floats, Image, Mask, Picture32
from groundfuse.frontend.camera import Camera
from groundfuse.frontend.selection import LEVEL

try:
    from groundfuse.frontend.selection_compiled import combined
except ImportError:  # without numba: the same result, seven times slower at 16 views
    from groundfuse.frontend.selection import combined
try:
    from groundfuse.frontend.tile_compiled import put
except ImportError:
    put = None

__all__ = ["Tile", "TileStack", "border_weight", "combined", "sharpness_weight"]

CHUNK_CELLS = 4096
"""Cells combined at once: the views' colours stay in the processor's cache."""
BORDER_SHARE = 0.08
"""A view fades in over this share of the picture's shorter side."""
SMALLEST_WEIGHT = 0.02
FINE_CELLS = 0.5
"""A footprint this long, in cells, blurs a cell hardly more than a shorter one."""
HIGHEST = 511.0
"""Levels; brighter ones (after division by a small gain) are cut, so that squares stay exact."""


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
        self._colours = np.zeros((depth, 3, num_cells), dtype=np.uint16)
        self._footprint = np.zeros((depth, num_cells), dtype=np.float32)
        self._weight = np.zeros((depth, num_cells), dtype=np.float32)
        self._held = np.zeros(num_cells, dtype=np.intp)
        self._left_out = np.zeros((3, num_cells), dtype=np.float32)
        self._count = np.zeros(num_cells, dtype=np.uint16)

    def add(
        self,
        offset: tuple[int, int],
        seen: Mask,
        colours: Picture32,
        footprint: Picture32,
        weight: Picture32,
    ) -> None:
        """Add one view of a window of the tile.

        Args:
            offset: row and column of the window's first cell.
            seen: (n, m) cells of the window that count.
            colours: (n, m, 3) levels, compensated, not negative.
            footprint: (n, m) length of its pixels on the floor.
            weight: (n, m) positive, in the final mean.
        """
        if put is not None:
            view = seen, colours, footprint, weight
            stack = self._colours, self._footprint, self._weight
            tallies = self._held, self._count, self._left_out
            put(offset, view, stack, tallies, self._shape, HIGHEST)
            return
        window = np.flatnonzero(seen)
        row, column = np.divmod(window, seen.shape[1])
        cells = (row + offset[0]) * self._shape[1] + column + offset[1]
        picked = np.minimum(colours.reshape(-1, 3)[window].T, HIGHEST) * np.float32(LEVEL)
        half_levels = np.rint(picked).astype(np.uint16)
        fine, share = footprint.ravel()[window], weight.ravel()[window]
        self._count[cells] += 1
        slot = self._held[cells]
        full = slot == len(self._footprint)
        if full.any():
            kept = self._make_room(cells, slot, full, half_levels, fine)
            cells, slot, full = cells[kept], slot[kept], full[kept]
            half_levels, fine, share = half_levels[:, kept], fine[kept], share[kept]
        self._held[cells] += ~full
        place = slot * len(self._held) + cells
        self._footprint.reshape(-1)[place] = fine
        self._weight.reshape(-1)[place] = share
        place += 2 * slot * len(self._held)
        for channel in range(3):
            self._colours.reshape(-1)[place + channel * len(self._held)] = half_levels[channel]

    def _make_room(
        self,
        cells: NDArray[np.intp],
        slot: NDArray[np.intp],
        full: Mask,
        half_levels: NDArray[np.uint16],
        fine: Picture32,
    ) -> Mask:
        """Point `slot` of full cells at their coarsest view; return where the new one replaces it.

        Of the two the one left out still counts in the plain mean.
        """
        slot[full] = np.argmax(self._footprint[:, cells[full]], axis=0)
        kept = ~full
        kept[full] = fine[full] < self._footprint[slot[full], cells[full]]
        replaced = full & kept
        self._left_out[:, cells[replaced]] += self._colours[slot[replaced], :, cells[replaced]].T
        self._left_out[:, cells[~kept]] += half_levels[:, ~kept]
        return kept

    def finished(self, noise_levels: float, num_sigmas: float) -> Tile:
        """Return the layers of the tile."""
        floor = np.zeros((3, len(self._held)), dtype=np.float32)
        mean = self._left_out
        for depth in range(1, len(self._footprint) + 1):
            of_depth = np.flatnonzero(self._held == depth)
            for start in range(0, len(of_depth), CHUNK_CELLS):
                cells = of_depth[start : start + CHUNK_CELLS]
                colours = np.take(self._colours[:depth], cells, axis=2)
                mean[:, cells] += colours.sum(axis=0, dtype=np.float32)
                footprint = np.take(self._footprint[:depth], cells, axis=1)
                weight = np.take(self._weight[:depth], cells, axis=1)
                noise = noise_levels * LEVEL
                floor[:, cells] = combined(colours, footprint, weight, noise, num_sigmas)
        mean /= np.maximum(self._count, 1).astype(np.float32)
        return Tile(self._levels(floor), self._levels(mean), self._count.reshape(self._shape))

    def _levels(self, half_levels: Picture32) -> Image:
        """Turn (3, cells) half levels into a picture."""
        rounded = np.clip(np.rint(half_levels / LEVEL), 0.0, 255.0).astype(np.uint8)
        picture: Image = np.ascontiguousarray(rounded.T).reshape(*self._shape, 3)
        return picture


def border_weight(px: Floats, camera: Camera) -> Floats:
    """Return weights (...) of pixels (..., 2) that fade towards the picture's border.

    No seam shows where a view ends. A pixel without a place has weight nan.
    """
    first, last = camera.used_rows
    width_px, u, v = camera.intrinsics.width_px, px[..., 0], px[..., 1]
    inside = np.minimum(np.minimum(u, width_px - 1.0 - u), np.minimum(v - first, last - v))
    ramp = max(BORDER_SHARE * min(width_px, last - first + 1), 1.0)
    weight: Floats = np.clip(inside / ramp, SMALLEST_WEIGHT, 1.0)
    return weight


def sharpness_weight(footprint_cells: Picture32) -> Picture32:
    """Return weights (...) of views from the footprints of their pixels, in cells.

    The fourth power of the footprint: a view twice as coarse as another hardly blurs what the
    finer one shows, while views alike are averaged against noise. Among views that are all finer
    than the cell the footprint matters little.
    """
    blur = np.square(footprint_cells) + np.float32(FINE_CELLS**2)
    return np.asarray(np.float32(1.0) / np.square(blur), dtype=np.float32)
