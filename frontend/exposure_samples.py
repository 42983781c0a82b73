"""The floor under a coarse grid, as every picture sees it: what gains are estimated from."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from groundfuse.frontend.arrays import Floats, Picture32
from groundfuse.frontend.gains import Samples, radius_squared
from groundfuse.frontend.mosaic_plan import Extent, MosaicPlan
from groundfuse.frontend.pyramid import Pyramid
from groundfuse.frontend.sight import Grid, read_window, sight

DARKEST = 4.0
BRIGHTEST = 250.0
"""Outside, a value may have been cut off and says nothing of the exposure."""


@dataclass(frozen=True, slots=True, eq=False)
class ViewSamples:
    """The floor as one picture sees it, as small as can be: it is kept from run to run.

    Attributes:
        cell: (n, 2) row and column, counted from the team's origin.
        radius2: (n,) see `Samples`.
        colour: (n, 3) see `Samples`.
        point: (n, 3) see `Samples`.
    """

    cell: NDArray[np.int32]
    radius2: Picture32
    colour: Picture32
    point: NDArray[np.uint8]


def sampling_grid(plan: MosaicPlan) -> Grid:
    """Return a grid of the layout's larger cells from the team's origin on, without an end."""
    return Grid(0.0, 0.0, plan.grid.m_per_px * plan.layout.sampling_cells, 0, 0)


def sampled_cells(plan: MosaicPlan, block: Extent) -> tuple[slice, slice]:
    """Return rows and columns of the sampling grid that hold a view's extent."""
    side, (row, column) = plan.layout.sampling_cells, plan.grid.first_cells

    def larger(first: int, cells: slice) -> slice:
        return slice((first + cells.start) // side, math.ceil((first + cells.stop) / side))

    return larger(row, block.rows), larger(column, block.columns)


def sample_exposure(plan: MosaicPlan, number: int, pyramid: Pyramid) -> ViewSamples:
    """Sample one view.

    Args:
        plan: of the mosaic.
        number: of the view's extent in the plan.
        pyramid: the view's picture and its halvings.
    """
    block, grid = plan.extents[number], sampling_grid(plan)
    view = plan.views[block.view]
    rows, columns = sampled_cells(plan, block)
    limit = plan.limit_m[block.view] / grid.m_per_px
    place = view.camera, view.attitude, view.team_from_foot
    found = sight(*place, grid, limit, (rows, columns))
    seen = read_window(found, lambda: pyramid, rows, columns)
    kept = (seen.colour.min(axis=1) >= DARKEST) & (seen.colour.max(axis=1) <= BRIGHTEST)
    px = seen.place[kept, :2].astype(np.float64)
    px_per_cell = 1.0 / (seen.place[kept, 2] * plan.layout.sampling_cells)
    corner = np.array([rows.start, columns.start])
    return ViewSamples(
        cell=(seen.cell[kept] + corner).astype(np.int32),
        radius2=radius_squared(view.camera.intrinsics, px).astype(np.float32),
        colour=seen.colour[kept],
        point=_points(pyramid, px, px_per_cell),
    )


def _points(pyramid: Pyramid, px: Floats, px_per_cell: Floats) -> NDArray[np.uint8]:
    """Colours (n, 3) at the cells' centres, about as fine as the mosaic's own cells."""
    if not len(px):
        return np.zeros((0, 3), np.uint8)
    finest = math.floor(math.log2(max(float(np.median(px_per_cell)), 1.0)))
    level = min(finest, len(pyramid.table) - 1)
    map_u, map_v = (px / 2.0**level).astype(np.float32).T
    read = cv2.remap(pyramid.level(level), map_u[None], map_v[None], cv2.INTER_LINEAR)
    points: NDArray[np.uint8] = np.asarray(read, dtype=np.uint8)[0, :, :3]
    return points


def merged(parts: Sequence[ViewSamples], views: Sequence[int]) -> Samples:
    """Return the samples of several views as one, with the views' numbers."""
    cell = np.concatenate([part.cell for part in parts]).astype(np.int64)
    cell -= cell.min(axis=0, initial=0)
    columns = int(cell[:, 1].max(initial=0)) + 1
    return Samples(
        cell=cell[:, 0] * columns + cell[:, 1],
        view=np.repeat(np.array(views, np.intp), [len(part.cell) for part in parts]),
        radius2=np.concatenate([part.radius2 for part in parts]).astype(np.float64),
        colour=np.concatenate([part.colour for part in parts]).astype(np.float64),
        point=np.concatenate([part.point for part in parts]).astype(np.float64),
    )
