"""Where a mosaic lies, how fine it is, and which part of it every picture can see."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import median

import numpy as np

from groundfuse.backend.measurement import Attitude, FrameId, Se2
from groundfuse.backend.option_checks import check_numbers
from groundfuse.frontend.arrays import Image
from groundfuse.frontend.camera import Camera
from groundfuse.frontend.footprint import Footprint, footprint
from groundfuse.frontend.selection_compiled import DEEPEST
from groundfuse.frontend.sight import Grid


@dataclass(frozen=True, slots=True, eq=False)
class MosaicView:
    """A picture with its place.

    Attributes:
        frame: robot and index.
        camera: lens, mount and used rows.
        attitude: tilt, roll and height of this picture.
        team_from_base: pose of the robot.
        load: returns the picture, BGR uint8 of the camera's size; may be called more than once, and
            from several threads.
    """

    frame: FrameId
    camera: Camera
    attitude: Attitude
    team_from_base: Se2
    load: Callable[[], Image]

    @property
    def team_from_foot(self) -> Se2:
        """Floor point straight below the camera, heading along the camera's."""
        return self.team_from_base @ self.camera.mount.base_from_foot


@dataclass(frozen=True, slots=True, kw_only=True)
class MosaicOptions:
    """How a mosaic is made."""

    m_per_px: float | None = None
    """Side of a cell, m; None: what a quarter of the finest robot's pixels resolve."""
    far_footprint: float = 3.0
    """Floor is used as far as a pixel covers this many times that length of its own robot."""
    max_depth: int = 16
    """Views of a cell that take part in the robust mean; the finest are taken."""
    num_sigmas: float = 3.0
    """Views this near to the mean of the surviving half take part in the final mean, sigmas."""
    compensate: bool = True
    """Estimate and remove differences of exposure, white balance and vignetting."""
    tile_cells: int = 256
    """Side of the square worked on at once, cells."""
    max_cells: int = 2_000_000_000
    """Largest mosaic, cells; a cell that was not asked for grows to meet it."""
    memory_cells: int = 60_000_000
    """Larger mosaics go tile by tile to a file, and their PNG is a reduced preview, cells."""
    cache_bytes: int = 256 * 2**20
    """Pictures held in memory at once, bytes."""
    workers: int = 2
    """Threads; each holds one tile."""

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense (ValueError)."""
        if not 1 <= self.max_depth <= DEEPEST:
            raise ValueError(f"max_depth must be 1 to {DEEPEST}, got {self.max_depth}")
        check_numbers(self, may_be_inf=("num_sigmas",))


@dataclass(frozen=True, slots=True)
class Extent:
    """A block of cells that holds all floor that one view shows.

    Attributes:
        view: number of the view in the plan.
        rows: of the grid.
        columns: of the grid.
    """

    view: int
    rows: slice
    columns: slice

    def within(self, rows: slice, columns: slice) -> tuple[slice, slice] | None:
        """Return the part inside another block, or None where they are apart."""
        row0, row1 = max(self.rows.start, rows.start), min(self.rows.stop, rows.stop)
        col0, col1 = max(self.columns.start, columns.start), min(self.columns.stop, columns.stop)
        if row0 >= row1 or col0 >= col1:
            return None
        return slice(row0, row1), slice(col0, col1)


@dataclass(frozen=True, slots=True, eq=False)
class MosaicPlan:
    """All that is decided before a picture is loaded.

    Attributes:
        views: in the order of their frames, whatever order they were given in.
        grid: of the mosaic.
        limit_m: (views,) longest useful footprint of a pixel.
        finest_m: (views,) shortest footprint of a pixel; inf where a view shows no floor.
        extents: of the views that show any useful floor.
    """

    views: tuple[MosaicView, ...]
    grid: Grid
    limit_m: tuple[float, ...]
    finest_m: tuple[float, ...]
    extents: tuple[Extent, ...]


FINEST_SHARE = 0.25


def plan_mosaic(views: Sequence[MosaicView], options: MosaicOptions) -> MosaicPlan:
    """Lay out the mosaic of some views.

    Raises:
        ValueError: no views; two of one frame; a cell that is not positive or makes the mosaic too
            large; no floor that any view resolves.
    """
    ordered = tuple(sorted(views, key=lambda view: view.frame))
    _check(ordered)
    prints = [footprint(v.camera, v.attitude, v.team_from_foot) for v in ordered]
    useful_m = _useful_m(ordered, prints)
    limit_m = tuple(options.far_footprint * useful_m[view.frame.robot] for view in ordered)
    found = [p.bounds(limit) for p, limit in zip(prints, limit_m, strict=True)]
    boxes = {i: np.array(box) for i, box in enumerate(found) if box is not None}
    if not boxes:
        raise ValueError("no view shows any floor below its horizon")
    low = np.min([box[0] for box in boxes.values()], axis=0)
    high = np.max([box[1] for box in boxes.values()], axis=0)
    cell_m = options.m_per_px or _cell_m(min(useful_m.values()), high - low, options.max_cells)
    grid = _grid(low, high, cell_m)
    if grid.rows * grid.columns > options.max_cells:
        raise ValueError(
            f"a mosaic of {grid.columns} x {grid.rows} cells of {cell_m:g} m exceeds max_cells "
            f"{options.max_cells}: raise m_per_px"
        )
    extents = tuple(extent(grid, i, box) for i, box in boxes.items())
    finest_m = tuple(shown.finest_m_per_px(0.0) for shown in prints)
    return MosaicPlan(ordered, grid, limit_m, finest_m, extents)


def _check(views: Sequence[MosaicView]) -> None:
    if not views:
        raise ValueError("a mosaic needs at least one view, got none")
    for a, b in pairwise(views):
        if a.frame == b.frame:
            raise ValueError(f"a mosaic takes every frame once, got {a.frame} twice")


def _useful_m(views: Sequence[MosaicView], prints: Sequence[Footprint]) -> dict[str, float]:
    """The footprint length that a robot's pictures reach on a quarter of their pixels, m."""
    of_robot: dict[str, list[float]] = {}
    for view, shown in zip(views, prints, strict=True):
        of_robot.setdefault(view.frame.robot, []).append(shown.finest_m_per_px(FINEST_SHARE))
    return {robot: median(lengths) for robot, lengths in of_robot.items()}


def _cell_m(useful_m: float, size_m: np.ndarray, max_cells: int) -> float:
    """The useful length, to two digits, or what keeps the mosaic within its cells."""
    least = math.sqrt(float(size_m[0] * size_m[1]) / max_cells)
    cell = max(useful_m, least * 1.01)
    unit = 10.0 ** (math.floor(math.log10(cell)) - 1)
    steps = math.ceil(cell / unit - 1e-9) if cell > useful_m else round(cell / unit)
    return float(f"{steps * unit:.6g}")


def _grid(low: np.ndarray, high: np.ndarray, cell_m: float) -> Grid:
    """Cells whose edges lie at whole multiples of their side: maps of one cell size align."""
    first = np.floor(low / cell_m).astype(int)
    last = np.ceil(high / cell_m).astype(int)
    columns, rows = (int(count) for count in np.maximum(last - first, 1))
    return Grid(float(first[0]) * cell_m, float(last[1]) * cell_m, cell_m, rows, columns)


def extent(grid: Grid, view: int, box: np.ndarray) -> Extent:
    """Return the cells of a grid that a box ((x, y) lowest, (x, y) highest), m, lies in."""
    (x0, y0), (x1, y1) = box
    columns = _span((x0 - grid.x_min_m) / grid.m_per_px, (x1 - grid.x_min_m) / grid.m_per_px)
    rows = _span((grid.y_max_m - y1) / grid.m_per_px, (grid.y_max_m - y0) / grid.m_per_px)
    return Extent(
        view,
        slice(max(rows.start, 0), min(rows.stop, grid.rows)),
        slice(max(columns.start, 0), min(columns.stop, grid.columns)),
    )


def _span(first: float, last: float) -> slice:
    return slice(math.floor(first), max(math.ceil(last), math.floor(first) + 1))
