"""The overhead view: the floor of one picture as a metric raster seen from straight above.

Forward is up and left is left: the centre of raster pixel (u, v) lies at x = x_m - v m_per_px,
y = y_m - u m_per_px in `foot` (see `camera.py` for the frames). Paper §2, eq. 1, for any lens.
"""

import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from groundfuse.backend.measurement import Attitude
from groundfuse.backend.option_checks import check_numbers
from groundfuse.frontend.area_remap import (
    AreaPlan,
    Halvings,
    area_plan,
    area_read,
    singular_values,
)
from groundfuse.frontend.arrays import Floats, Image, Mask, Points
from groundfuse.frontend.camera import Camera
from groundfuse.frontend.overhead import floor_from_rays, foot_from_cam
from groundfuse.frontend.plan_compiled import rays_of_cells

TILE_PX = 256
"""Raster pixels per tile: remap takes no picture of 32767 px or more, and no tile needs many."""
PLANS_KEPT = 4
"""Some 10 MB each; a team of many cameras works them out again."""
GRIDS_KEPT = 256
LATTICES_KEPT = 16
"""Half a megabyte each."""
LATTICE_STEP_PX = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class OverheadOptions:
    """How the floor is rastered."""

    m_per_px: float | None = None
    """Side of a raster cell on the floor, m; None derives it from the mount's height."""
    cell_per_height: float = 0.0036
    """Derived cell over the mount's height (2 mm at 0.55 m); at least one pixel at nadir."""
    max_footprint_cells: float = 3.0
    """The floor is used as far as a picture pixel covers at most this many cells in length."""
    max_cells: int = 200_000_000
    """Refuse larger rasters, cells."""

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense (ValueError)."""
        check_numbers(self)


@dataclass(frozen=True, slots=True)
class OverheadGrid:
    """A metric raster over the useful floor of one camera.

    Attributes:
        m_per_px: side of a cell, m.
        x_m: forward coordinate of the centre of pixel (0, 0) in `foot`.
        y_m: left coordinate of the centre of pixel (0, 0) in `foot`.
        width_px: columns.
        height_px: rows.
        far_m: the useful floor ends at this distance from the foot.
    """

    m_per_px: float
    x_m: float
    y_m: float
    width_px: int
    height_px: int
    far_m: float

    def floor_from_overhead(self, points_px: Points) -> Points:
        """Turn raster pixels (n, 2) into floor points (n, 2), metres in `foot`."""
        corner = np.array([self.x_m, self.y_m])
        floor: Points = corner - np.asarray(points_px)[:, ::-1] * self.m_per_px
        return floor

    def overhead_from_floor(self, floor_m: Points) -> Points:
        """Turn floor points (n, 2), metres in `foot`, into raster pixels (n, 2)."""
        corner = np.array([self.x_m, self.y_m])
        points: Points = ((corner - floor_m) / self.m_per_px)[:, ::-1]
        return points


def raster_cell_m(camera: Camera, options: OverheadOptions) -> float:
    """Return the side of a raster cell: as given, or from the mount's height, m.

    Frames of one camera share it whatever their own heights, so that descriptors compare.
    """
    if options.m_per_px is None:
        height_m = camera.mount.attitude.height_m
        return height_m * max(options.cell_per_height, 1.0 / camera.intrinsics.focal_px)
    return options.m_per_px


def overhead_grid(
    camera: Camera, attitude: Attitude, options: OverheadOptions | None = None
) -> OverheadGrid:
    """Return the smallest raster over the floor that the camera resolves well enough.

    Raises:
        ValueError: no floor is resolved, or the raster would have more than `max_cells` cells.
    """
    return _grid(camera, attitude, options or OverheadOptions())


@functools.lru_cache(maxsize=GRIDS_KEPT)
def _grid(camera: Camera, attitude: Attitude, options: OverheadOptions) -> OverheadGrid:
    cell_m = raster_cell_m(camera, options)
    floor, footprint = _sampled_floor(camera, attitude)
    distance = np.hypot(floor[:, 0], floor[:, 1])
    limit_m = options.max_footprint_cells * cell_m
    with np.errstate(invalid="ignore"):
        coarse = np.isfinite(footprint) & (footprint > limit_m)
        nearest_coarse = distance[coarse].min(initial=math.inf)
        useful = (footprint <= limit_m) & (distance < nearest_coarse)
    if not useful.any():
        finest = np.nanmin(footprint, initial=math.inf)
        raise ValueError(
            f"no floor is resolved: a pixel covers {finest:.4g} m at best, limit {limit_m:.4g} m"
        )
    low, high = floor[useful].min(axis=0), floor[useful].max(axis=0)
    rows, columns = (int(extent) + 1 for extent in np.ceil((high - low) / cell_m))
    if rows * columns > options.max_cells:
        raise ValueError(
            f"overhead view of {columns} x {rows} cells exceeds {options.max_cells}, "
            f"got m_per_px {cell_m:g}"
        )
    far_m = float(distance[useful].max())
    return OverheadGrid(cell_m, float(high[0]), float(high[1]), columns, rows, far_m)


def overhead_view(
    image: Image, camera: Camera, attitude: Attitude, grid: OverheadGrid
) -> tuple[Image, Mask]:
    """Warp a picture to the raster, averaging where the picture is finer than the raster.

    Returns the view (0 where there is no floor) and the mask of cells that have floor.

    Raises:
        ValueError: the picture is not of the camera's size.
    """
    lens = camera.intrinsics
    if image.shape[:2] != (lens.height_px, lens.width_px):
        raise ValueError(
            f"picture is {image.shape[1]} x {image.shape[0]} px, "
            f"the camera's are {lens.width_px} x {lens.height_px}"
        )
    view = np.zeros((grid.height_px, grid.width_px, *image.shape[2:]), dtype=image.dtype)
    mask = np.zeros((grid.height_px, grid.width_px), dtype=np.bool_)
    halvings = Halvings([image])
    for rows, columns, seen, plan in _planned_tiles(camera, attitude, grid):
        area_read(halvings, plan, view[rows, columns])
        mask[rows, columns] = seen
    return view, mask


@functools.lru_cache(maxsize=PLANS_KEPT)
def _planned_tiles(
    camera: Camera, attitude: Attitude, grid: OverheadGrid
) -> tuple[tuple[slice, slice, Mask, AreaPlan], ...]:
    """Tiles with floor and where they read; most frames of a robot share camera and attitude."""
    widest = _widest_ray(camera)
    size_px = camera.intrinsics.width_px, camera.intrinsics.height_px
    planned = []
    for rows, columns in _tiles(grid):
        source_px = _source_px(camera, attitude, grid, (rows, columns), widest)
        seen = _seen(source_px[1:-1, 1:-1], camera) & _near(grid, rows, columns)
        if seen.any():
            planned.append((rows, columns, seen, area_plan(source_px, seen, size_px)))
    return tuple(planned)


def _sampled_floor(camera: Camera, attitude: Attitude) -> tuple[Points, Floats]:
    """Floor points of a lattice over the used rows, and the length of one pixel there."""
    u, v, rays = _lattice(camera)
    floor = floor_from_rays(attitude, rays)
    lattice = floor.reshape(len(v), len(u), 2)
    by_v = np.asarray(np.gradient(lattice, v, axis=0), dtype=np.float64)
    by_u = np.asarray(np.gradient(lattice, u, axis=1), dtype=np.float64)
    return floor, singular_values(by_u, by_v)[0].ravel()


@functools.lru_cache(maxsize=LATTICES_KEPT)
def _lattice(camera: Camera) -> tuple[Floats, Floats, Points]:
    """Columns, rows and rays of a lattice; attitudes may change from frame to frame."""
    first, last = camera.used_rows
    width = camera.intrinsics.width_px
    u = np.linspace(0.0, width - 1.0, max(2, width // LATTICE_STEP_PX + 1))
    v = np.linspace(first, last, max(2, (last - first) // LATTICE_STEP_PX + 1))
    px = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    rays = camera.intrinsics.rays_from_px(px)
    for array in (u, v, rays):
        array.setflags(write=False)
    return u, v, rays


def _widest_ray(camera: Camera) -> float:
    """Length of the widest ray of the picture; wider ones can fold back into it."""
    lens = camera.intrinsics
    u, v = np.linspace(0, lens.width_px - 1, 17), np.linspace(0, lens.height_px - 1, 17)
    rays = lens.rays_from_px(np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2))
    return float(np.nanmax(np.hypot(rays[:, 0], rays[:, 1])))


def _tiles(grid: OverheadGrid) -> Iterator[tuple[slice, slice]]:
    for row in range(0, grid.height_px, TILE_PX):
        for column in range(0, grid.width_px, TILE_PX):
            yield (
                slice(row, min(row + TILE_PX, grid.height_px)),
                slice(column, min(column + TILE_PX, grid.width_px)),
            )


def _source_px(
    camera: Camera,
    attitude: Attitude,
    grid: OverheadGrid,
    tile: tuple[slice, slice],
    widest: float,
) -> Floats:
    """Picture coordinates (rows + 2, columns + 2, 2) of a tile with a margin of one cell."""
    rows, columns = (slice(side.start - 1, side.stop + 1) for side in tile)
    shape = rows.stop - rows.start, columns.stop - columns.start
    corner = np.array(
        [grid.x_m - rows.start * grid.m_per_px, grid.y_m - columns.start * grid.m_per_px]
    )
    rotation = foot_from_cam(attitude.tilt_rad, attitude.roll_rad)
    rays = rays_of_cells(corner, grid.m_per_px, shape, rotation, attitude.height_m, widest)
    return camera.intrinsics.px_from_rays(rays).reshape(*shape, 2)


def _seen(source_px: Floats, camera: Camera) -> Mask:
    first, last = camera.used_rows
    u, v = source_px[..., 0], source_px[..., 1]
    with np.errstate(invalid="ignore"):
        inside: Mask = (u >= 0) & (u <= camera.intrinsics.width_px - 1) & (v >= first) & (v <= last)
    return inside


def _near(grid: OverheadGrid, rows: slice, columns: slice) -> Mask:
    x_m = grid.x_m - np.arange(rows.start, rows.stop) * grid.m_per_px
    y_m = grid.y_m - np.arange(columns.start, columns.stop) * grid.m_per_px
    near: Mask = np.hypot(x_m[:, None], y_m[None, :]) <= grid.far_m
    return near
