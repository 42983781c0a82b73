"""Where the cells of a floor grid appear in a picture; the exact half of every mosaic warp."""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from groundfuse.backend.measurement import Attitude, Se2
from groundfuse.frontend.arrays import Floats, Matrix, Picture32, Points
from groundfuse.frontend.camera import Camera
from groundfuse.frontend.footprint import widest_ray
from groundfuse.frontend.gains import half_diagonal_px
from groundfuse.frontend.overhead import foot_from_cam
from groundfuse.frontend.pyramid import Pyramid
from groundfuse.frontend.reading_compiled import find_cells, read_cells
from groundfuse.frontend.sight_compiled import fill_lattice, rays_of_lattice

RAY_SLACK = 1.0 + 1e-9
LINEAR_ERROR_CELLS = 0.02
LARGEST_STEP = 8
ROUNDING_CELLS = 1e-6
NO_FALLOFF = np.zeros(3)


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

    @property
    def first_cells(self) -> tuple[int, int]:
        """Row and column of the first cell, counted in cells from the origin of the team."""
        return round(-self.y_max_m / self.m_per_px), round(self.x_min_m / self.m_per_px)

    def part(self, rows: slice, columns: slice) -> "Grid":
        """Return some of the rows and columns as a grid of its own."""
        return Grid(
            self.x_min_m + columns.start * self.m_per_px,
            self.y_max_m - rows.start * self.m_per_px,
            self.m_per_px,
            rows.stop - rows.start,
            columns.stop - columns.start,
        )

    def centres(self) -> Points:
        """Return the cells' centres (rows columns, 2), row by row."""
        x = self.x_min_m + (np.arange(self.columns) + 0.5) * self.m_per_px
        y = self.y_max_m - (np.arange(self.rows) + 0.5) * self.m_per_px
        centres: Points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2).astype(np.float64)
        return centres


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """A part of a grid as one picture sees it: known at the middles of blocks, linear between.

    Attributes:
        lattice: (n, m, 4) column and row in the picture, longer side of a pixel on the floor in
            cells, and what the falloff multiplies a picture's values by; nan where there is none.
        slopes: (n, m, 4) change of column and row to the next cell, and to the cell below.
        reading: (n, m, 2) halvings of the picture and places a side that each cell's mean is of.
        step: cells from one middle to the next.
        first_row: of the grid, in the lattice's first block.
        first_column: of the grid, in the lattice's first block.
        limits: (4,) last column, first and last row of the used picture; largest footprint, cells.
    """

    lattice: Picture32
    slopes: Picture32
    reading: NDArray[np.uint8]
    step: int
    first_row: int
    first_column: int
    limits: Picture32


@dataclass(frozen=True, slots=True, eq=False)
class SeenCells:
    """Cells of a window that a picture shows, row by row.

    Attributes:
        cell: (n, 2) row and column in the window.
        place: (n, 4) column and row in the picture, footprint in cells, factor of the falloff.
        colour: (n, 3) BGR mean over the cell, levels.
    """

    cell: NDArray[np.int32]
    place: Picture32
    colour: Picture32


def sight(
    camera: Camera,
    attitude: Attitude,
    team_from_foot: Se2,
    grid: Grid,
    limit_cells: float,
    part: tuple[slice, slice] | None = None,
    falloff: Floats = NO_FALLOFF,
) -> Sight:
    """Project a grid into a picture.

    Projected exactly are the middles of blocks of step x step cells; in between it is linear. A
    place in the picture bends by up to 2 / depth over the floor, so with cells of c m that errs by
    at most step^2 c / (4 depth) cells; `_step` keeps this within `LINEAR_ERROR_CELLS` for depths of
    half the height and more. Blocks are counted from the team's origin, whatever the grid and the
    part: where cells lie at whole multiples of their side, another grid's are seen the same.

    Args:
        camera: lens and used rows.
        attitude: of this picture.
        team_from_foot: floor point below the camera, heading along the camera's.
        grid: in the team's frame.
        limit_cells: a pixel may cover this many cells, not more.
        part: rows and columns of the grid to look at; None: all.
        falloff: (3,) coefficients of the lens; see `gains`.
    """
    rows, columns = part or (slice(0, grid.rows), slice(0, grid.columns))
    step = _step(grid.m_per_px / attitude.height_m)
    origin = np.array(grid.first_cells)
    first = np.array([rows.start, columns.start]) + origin
    last = np.array([rows.stop, columns.stop]) + origin - 1
    first, last = first // step - 1, last // step + 1  # one block more, to interpolate to the edge
    px = _lattice_px(camera, attitude, team_from_foot, grid, step, first, last)
    shape = px.shape[0] - 2, px.shape[1] - 2
    lattice, slopes = np.empty((*shape, 4), np.float32), np.empty((*shape, 4), np.float32)
    reading = np.empty((*shape, 2), np.uint8)
    lens = camera.intrinsics
    centre = lens.cx_px, lens.cy_px, half_diagonal_px(lens)
    fill_lattice(px, (*centre, *falloff.tolist()), step, (lattice, slopes, reading))
    limits = np.array([lens.width_px - 1.0, *camera.used_rows, limit_cells], np.float32)
    first_row, first_column = (step * first - origin).tolist()
    return Sight(lattice, slopes, reading, step, first_row, first_column, limits)


def _lattice_px(
    camera: Camera,
    attitude: Attitude,
    team_from_foot: Se2,
    grid: Grid,
    step: int,
    first: NDArray[np.int64],
    last: NDArray[np.int64],
) -> Floats:
    """Pixels (n + 2, m + 2, 2) of the blocks from the first to the last, and one around them."""
    side_m = grid.m_per_px * step
    corner = (*(first - 1).tolist(), *_off_whole_cells_m(grid))
    rows, columns = (last - first + 3).tolist()
    rays = np.empty((rows * columns, 2))
    widest = widest_ray(camera) * RAY_SLACK
    matrix = cam_from_team(attitude, team_from_foot)
    rays_of_lattice(matrix, corner, side_m, columns, widest * widest, rays)
    px: Floats = camera.intrinsics.px_from_rays(rays).reshape(rows, columns, 2)
    return px


def _off_whole_cells_m(grid: Grid) -> tuple[float, float]:
    """Return how far a grid's cells lie off whole multiples of their side: x and y, m."""
    row, column = grid.first_cells
    off = grid.x_min_m - column * grid.m_per_px, grid.y_max_m + row * grid.m_per_px
    x_m, y_m = (0.0 if abs(m) < ROUNDING_CELLS * grid.m_per_px else m for m in off)
    return x_m, y_m


@functools.lru_cache(maxsize=1024)
def cam_from_team(attitude: Attitude, team_from_foot: Se2) -> Matrix:
    """Return the 3x3 matrix that takes floor points (x, y, 1) of the team to the camera's axes.

    Each view takes part in many tiles.
    """
    rotation = foot_from_cam(attitude.tilt_rad, attitude.roll_rad)
    cam_from_foot = np.column_stack([rotation[:2].T, -attitude.height_m * rotation[2]])
    foot_from_team = team_from_foot.inverse().matrix()
    matrix: Matrix = cam_from_foot @ foot_from_team
    matrix.flags.writeable = False
    return matrix


@dataclass(frozen=True, slots=True, eq=False)
class Room:
    """Memory for what is found in windows, used again and again: fresh memory costs more than that.

    Attributes:
        cell: (n, 2) for rows and columns.
        nearest: (n, 2) for points of the lattice.
        place: (n, 4) for places.
        colour: (n, 3) for colours.
    """

    cell: NDArray[np.int32]
    nearest: NDArray[np.int32]
    place: Picture32
    colour: Picture32


def room_for(num_cells: int) -> Room:
    """Return room for windows of so many cells."""
    cell, nearest = np.empty((num_cells, 2), np.int32), np.empty((num_cells, 2), np.int32)
    place, colour = np.empty((num_cells, 4), np.float32), np.empty((num_cells, 3), np.float32)
    return Room(cell, nearest, place, colour)


def read_window(
    sight: Sight,
    picture: Callable[[], Pyramid],
    rows: slice,
    columns: slice,
    room: Room | None = None,
) -> SeenCells:
    """Return the cells of a window that the picture shows.

    Args:
        sight: of the picture.
        picture: loads it; not called where the window shows none of it.
        rows: of the grid, within the sight's part.
        columns: likewise.
        room: that the result is written to, valid until it is used again; None: of its own.
    """
    height, width = rows.stop - rows.start, columns.stop - columns.start
    room = room or room_for(height * width)
    window = rows.start - sight.first_row, columns.start - sight.first_column, height, width
    found = room.cell, room.nearest, room.place
    number = find_cells(sight.lattice, sight.step, window, sight.limits, found)
    place, colour = room.place[:number], room.colour[:number]
    if number:
        pyramid, known = picture(), (sight.slopes, sight.reading)
        levels = pyramid.levels, pyramid.table
        read_cells(levels, known, room.nearest[:number], place, colour)
    return SeenCells(room.cell[:number], place, colour)


def _step(cell_per_height: float) -> int:
    """Return the largest step whose linear interpolation stays within the error allowed."""
    widest = math.isqrt(int(2.0 * LINEAR_ERROR_CELLS / cell_per_height))
    return min(max(widest, 1), LARGEST_STEP)
