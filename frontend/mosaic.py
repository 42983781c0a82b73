"""From poses and pictures to a metric picture of the floor (paper §5.1), tile by tile.

The mosaic is north up: columns along team x, rows against team y. `x_min_m` and `y_max_m` are the
outer edges of the first column and row; the centre of cell (row, column) lies at
x = x_min_m + (column + 1/2) m_per_px, y = y_max_m - (row + 1/2) m_per_px.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from groundfuse.frontend.arrays import Image, Mask
from groundfuse.frontend.kept_parts import Memory
from groundfuse.frontend.mosaic_options import MosaicOptions
from groundfuse.frontend.mosaic_plan import MosaicPlan, MosaicView, plan_mosaic
from groundfuse.frontend.mosaic_stream import mosaic_tiles
from groundfuse.frontend.mosaic_tile import Tile
from groundfuse.frontend.selection_compiled import FEWEST_VIEWS
from groundfuse.frontend.sight import Grid

__all__ = ["Mosaic", "MosaicOptions", "MosaicView", "build_mosaic"]


@dataclass(frozen=True, slots=True, eq=False)
class Mosaic:
    """A metric picture of the floor.

    Attributes:
        floor: (rows, columns, 3) BGR without obstacles; 0 where nothing was seen.
        mean: (rows, columns, 3) BGR plain mean of all views, as in the paper's figure 4(a).
        count: (rows, columns) uint16 views that see the cell.
        uncertain: (rows, columns) seen, but by fewer than three views: what stands there could not
            be outvoted.
        x_min_m: left edge in the team's frame.
        y_max_m: upper edge in the team's frame.
        m_per_px: side of a cell.
    """

    floor: Image
    mean: Image
    count: np.ndarray
    uncertain: Mask
    x_min_m: float
    y_max_m: float
    m_per_px: float


def build_mosaic(
    views: Sequence[MosaicView],
    options: MosaicOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Mosaic:
    """Fuse views of one floor.

    Pictures are loaded when a tile needs them and held within a budget. The result doesn't depend
    on the order of the views or the number of threads.

    Args:
        views: of one connected part of the team.
        options: how.
        progress: told how many steps of how many are done.

    Raises:
        ValueError: no views, two of one frame, a picture of another size than its camera's, no
            floor in sight, or a mosaic that would be too large.
    """
    options = options or MosaicOptions()
    limit = min(options.max_cells, options.memory_cells)
    return planned_mosaic(plan_mosaic(views, replace(options, max_cells=limit)), options, progress)


def planned_mosaic(
    plan: MosaicPlan,
    options: MosaicOptions,
    progress: Callable[[int, int], None] | None = None,
    memory: Memory | None = None,
) -> Mosaic:
    """Carry out a plan whose cells fit into memory; see `build_mosaic` and `mosaic_tiles`."""
    layers = _blank_layers(plan)
    for block, tile in mosaic_tiles(plan, options, progress, memory):
        layers.floor[block], layers.mean[block] = tile.floor, tile.mean
        layers.count[block] = tile.count
    return trimmed(plan.grid, layers)


def _blank_layers(plan: MosaicPlan) -> Tile:
    shape = (plan.grid.rows, plan.grid.columns)
    colour = (*shape, 3)
    return Tile(np.zeros(colour, np.uint8), np.zeros(colour, np.uint8), np.zeros(shape, np.uint16))


def trimmed(grid: Grid, layers: Tile) -> Mosaic:
    """Cut off rows and columns at the edges that nothing was seen in.

    Raises:
        ValueError: nothing was seen at all.
    """
    seen = layers.count > 0
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    if not len(rows):
        raise ValueError("no view shows any floor within its far limit")
    block = slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
    grid, count = grid.part(*block), layers.count[block]
    return Mosaic(
        layers.floor[block],
        layers.mean[block],
        count,
        (count > 0) & (count < FEWEST_VIEWS),
        grid.x_min_m,
        grid.y_max_m,
        grid.m_per_px,
    )
