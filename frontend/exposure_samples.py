"""The floor under a coarse grid, as every picture sees it: what gains are estimated from."""

import math

import cv2
import numpy as np

from groundfuse.frontend.arrays import Floats
from groundfuse.frontend.gains import Samples, radius_squared
from groundfuse.frontend.mosaic_plan import MosaicPlan
from groundfuse.frontend.pyramid import Pyramid
from groundfuse.frontend.sight import Grid, read_window, sight

CELLS_PER_VIEW = 1200
DARKEST = 4.0
BRIGHTEST = 250.0
"""Outside, a value may have been cut off and says nothing of the exposure."""


def sampling_grid(plan: MosaicPlan) -> Grid:
    """Return cells so large that a typical view sees about `CELLS_PER_VIEW` of them."""
    fine = plan.grid
    sizes = [
        (e.rows.stop - e.rows.start) * (e.columns.stop - e.columns.start) for e in plan.extents
    ]
    side = max(1, round(math.sqrt(float(np.median(sizes)) / CELLS_PER_VIEW)))
    rows, columns = math.ceil(fine.rows / side), math.ceil(fine.columns / side)
    return Grid(fine.x_min_m, fine.y_max_m, fine.m_per_px * side, rows, columns)


def sample_exposure(plan: MosaicPlan, grid: Grid, number: int, pyramid: Pyramid) -> Samples:
    """Sample one view.

    Args:
        plan: of the mosaic.
        grid: see `sampling_grid`.
        number: of the view's extent in the plan.
        pyramid: the view's picture and its halvings.
    """
    block = plan.extents[number]
    view = plan.views[block.view]
    side = round(grid.m_per_px / plan.grid.m_per_px)
    rows = slice(block.rows.start // side, math.ceil(block.rows.stop / side))
    columns = slice(block.columns.start // side, math.ceil(block.columns.stop / side))
    limit = plan.limit_m[block.view] / grid.m_per_px
    place = view.camera, view.attitude, view.team_from_foot
    found = sight(*place, grid, limit, (rows, columns))
    seen = read_window(found, lambda: pyramid, rows, columns)
    kept = (seen.colour.min(axis=1) >= DARKEST) & (seen.colour.max(axis=1) <= BRIGHTEST)
    row, column = seen.cell[kept].astype(np.int64).T
    px = seen.place[kept, :2].astype(np.float64)
    px_per_cell = 1.0 / (seen.place[kept, 2] * side)
    return Samples(
        cell=(row + rows.start) * grid.columns + column + columns.start,
        view=np.full(len(row), block.view),
        radius2=radius_squared(view.camera.intrinsics, px),
        colour=seen.colour[kept].astype(np.float64),
        point=_points(pyramid, px, px_per_cell),
    )


def _points(pyramid: Pyramid, px: Floats, px_per_cell: Floats) -> Floats:
    """Colours (n, 3) at the cells' centres, about as fine as the mosaic's own cells."""
    if not len(px):
        return np.zeros((0, 3))
    finest = math.floor(math.log2(max(float(np.median(px_per_cell)), 1.0)))
    level = min(finest, len(pyramid.table) - 1)
    map_u, map_v = (px / 2.0**level).astype(np.float32).T
    read = cv2.remap(pyramid.level(level), map_u[None], map_v[None], cv2.INTER_LINEAR)
    points: Floats = np.asarray(read, dtype=np.float64)[0, :, :3]
    return points


def merged(parts: list[Samples]) -> Samples:
    """Return the samples of several views as one."""
    return Samples(
        np.concatenate([part.cell for part in parts]),
        np.concatenate([part.view for part in parts]),
        np.concatenate([part.radius2 for part in parts]),
        np.concatenate([part.colour for part in parts]),
        np.concatenate([part.point for part in parts]),
    )
