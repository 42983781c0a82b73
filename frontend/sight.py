"""Where the cells of a floor grid appear in a picture; the exact half of every mosaic warp."""

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from groundfuse.backend.measurement import Attitude, Se2
from groundfuse.frontend.area_remap import singular_values
from groundfuse.frontend.arrays import Floats, Mask, Picture32, Points
from groundfuse.frontend.camera import Camera
from groundfuse.frontend.footprint import widest_ray
from groundfuse.frontend.overhead import rays_from_floor

RAY_SLACK = 1.0 + 1e-9
MARGIN = 2
"""Blocks around a grid: one to interpolate to its edge, one more for differences."""
LINEAR_ERROR_CELLS = 0.02
LARGEST_STEP = 8


@dataclass(frozen=True, slots=True)
class Grid:
    """Square cells on the floor, north up: columns along team x, rows against team y.

    Attributes:
        x_min_m: left edge of the first column.
        y_max_m: upper edge of the first row.
        m_per_px: side of a cell.
        rows: of cells.
        columns: of cells.
    """

    x_min_m: float
    y_max_m: float
    m_per_px: float
    rows: int
    columns: int

    def part(self, rows: slice, columns: slice) -> "Grid":
        """Return some of the rows and columns as a grid of its own."""
        return Grid(
            self.x_min_m + columns.start * self.m_per_px,
            self.y_max_m - rows.start * self.m_per_px,
            self.m_per_px,
            rows.stop - rows.start,
            columns.stop - columns.start,
        )

    def centres(self, margin: int = 0) -> Points:
        """Return the cells' centres ((rows + 2 margin) (columns + 2 margin), 2), row by row."""
        columns = np.arange(-margin, self.columns + margin) + 0.5
        rows = np.arange(-margin, self.rows + margin) + 0.5
        x = self.x_min_m + columns * self.m_per_px
        y = self.y_max_m - rows * self.m_per_px
        centres: Points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2).astype(np.float64)
        return centres


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """A grid as one picture sees it.

    Attributes:
        source_px: (rows + 2, columns + 2, 2) pixel of every centre, with a margin of one cell; nan
            where there is none.
        footprint_cells: (rows, columns) length of one pixel on the floor, the longer way, in cells.
        seen: (rows, columns) cells inside the used picture whose footprint is within the limit.
        lattice_px: (n, m, 2) pixel of every lattice point, for what varies as slowly as the place
            itself; see `spread`.
        step: cells from one lattice point to the next.
    """

    source_px: Floats
    footprint_cells: Picture32
    seen: Mask
    lattice_px: Floats
    step: int

    def spread(self, at_lattice: Floats) -> Picture32:
        """Interpolate (n, m, ...) values at the lattice to the cells (rows, columns, ...)."""
        rows, columns = self.seen.shape
        coarse = at_lattice.astype(np.float32)
        fine: Picture32 = _spread(coarse, self.step, slice(0, rows), slice(0, columns))
        return fine


def sight(
    camera: Camera, attitude: Attitude, team_from_foot: Se2, grid: Grid, limit_cells: float
) -> Sight:
    """Project a grid into a picture.

    Projected exactly are the middles of blocks of step x step cells; in between it is linear. A
    place in the picture bends by up to 2 / depth over the floor, so with cells of c m that errs by
    at most step^2 c / (4 depth) cells; `_step` keeps this within `LINEAR_ERROR_CELLS` for depths of
    half the height and more.

    Args:
        camera: lens and used rows.
        attitude: of this picture.
        team_from_foot: floor point below the camera, heading along the camera's.
        grid: in the team's frame.
        limit_cells: a pixel may cover this many cells, not more.
    """
    step = _step(grid.m_per_px / attitude.height_m)
    blocks = Grid(
        grid.x_min_m,
        grid.y_max_m,
        grid.m_per_px * step,
        -(-grid.rows // step),
        -(-grid.columns // step),
    )
    in_foot = team_from_foot.inverse().apply(blocks.centres(margin=MARGIN))
    rays = rays_from_floor(attitude, in_foot)
    wide = np.einsum("ij,ij->i", rays, rays) > (widest_ray(camera) * RAY_SLACK) ** 2
    rays[wide] = np.nan
    px = camera.intrinsics.px_from_rays(rays)
    px = px.reshape(blocks.rows + 2 * MARGIN, blocks.columns + 2 * MARGIN, 2)
    by_u = (px[1:-1, 2:] - px[1:-1, :-2]) / 2.0
    by_v = (px[2:, 1:-1] - px[:-2, 1:-1]) / 2.0
    _, least = singular_values(by_u, by_v)
    with np.errstate(divide="ignore"):
        footprint = step / least
    lattice = px[1:-1, 1:-1]
    source = _spread(lattice, step, slice(-1, grid.rows + 1), slice(-1, grid.columns + 1))
    footprint_cells = _spread(
        footprint.astype(np.float32), step, slice(0, grid.rows), slice(0, grid.columns)
    )
    seen = _inside(source[1:-1, 1:-1], camera) & (footprint_cells <= limit_cells)
    return Sight(source, footprint_cells, seen, lattice, step)


def _step(cell_per_height: float) -> int:
    """Return the largest step whose linear interpolation stays within the error allowed."""
    widest = math.isqrt(int(2.0 * LINEAR_ERROR_CELLS / cell_per_height))
    return min(max(widest, 1), LARGEST_STEP)


def _spread(at_lattice: NDArray[Any], step: int, rows: slice, columns: slice) -> NDArray[Any]:
    """Interpolate values at the blocks' middles, with a margin of one block, to a range of cells.

    Enlarging a picture by `step` about its pixels' middles does exactly this.
    """
    fine = cv2.resize(at_lattice, None, fx=step, fy=step, interpolation=cv2.INTER_LINEAR)
    first_row, first_column = step + rows.start, step + columns.start
    part: NDArray[Any] = np.asarray(fine)[
        first_row : first_row + rows.stop - rows.start,
        first_column : first_column + columns.stop - columns.start,
    ]
    return part


def _inside(px: Floats, camera: Camera) -> Mask:
    first, last = camera.used_rows
    u, v = px[..., 0], px[..., 1]
    inside: Mask = (u >= 0.0) & (u <= camera.intrinsics.width_px - 1.0) & (v >= first) & (v <= last)
    return inside
