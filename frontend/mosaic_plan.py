"""Where a mosaic lies, how fine it is, and which part of it every picture can see."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import median

import numpy as np

from groundfuse.backend.measurement import Attitude, FrameId, Se2
from groundfuse.frontend.arrays import Image
from groundfuse.frontend.camera import Camera
from groundfuse.frontend.footprint import Footprint, footprint
from groundfuse.frontend.mosaic_options import MosaicOptions
from groundfuse.frontend.sight import Grid

Block = tuple[slice, slice]
"""Rows and columns of the grid."""


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
        digest: stands for the picture's content, where earlier mosaics are kept.
    """

    frame: FrameId
    camera: Camera
    attitude: Attitude
    team_from_base: Se2
    load: Callable[[], Image]
    digest: bytes = b""

    @property
    def team_from_foot(self) -> Se2:
        """Floor point straight below the camera, heading along the camera's."""
        return self.team_from_base @ self.camera.mount.base_from_foot


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

    def within(self, rows: slice, columns: slice) -> Block | None:
        """Return the part inside another block, or None where they are apart."""
        row0, row1 = max(self.rows.start, rows.start), min(self.rows.stop, rows.stop)
        col0, col1 = max(self.columns.start, columns.start), min(self.columns.stop, columns.stop)
        if row0 >= row1 or col0 >= col1:
            return None
        return slice(row0, row1), slice(col0, col1)


@dataclass(frozen=True, slots=True)
class Layout:
    """What cells and limits follow from; the next mosaic of a team that grows keeps it.

    Attributes:
        useful_m: footprint that a robot's pictures reach on a quarter of their pixels, m.
        sampling_cells: cells a side of those that exposures are estimated from.
    """

    useful_m: dict[str, float]
    sampling_cells: int


@dataclass(frozen=True, slots=True, eq=False)
class MosaicPlan:
    """All that is decided before a picture is loaded.

    Attributes:
        views: in the order of their frames, whatever order they were given in.
        grid: of the mosaic; its tiles begin at whole multiples of their side.
        layout: what it follows from.
        limit_m: (views,) longest useful footprint of a pixel.
        finest_m: (views,) shortest footprint of a pixel; inf where a view shows no floor.
        extents: of the views that show any useful floor.
    """

    views: tuple[MosaicView, ...]
    grid: Grid
    layout: Layout
    limit_m: tuple[float, ...]
    finest_m: tuple[float, ...]
    extents: tuple[Extent, ...]


FINEST_SHARE = 0.25
CELLS_PER_VIEW = 1200
"""Samples of a picture's exposure, about."""
SAME_LENGTH = 0.01
"""A robot's useful length stays what it was while today's is as near, as a share."""


def plan_mosaic(
    views: Sequence[MosaicView], options: MosaicOptions, earlier: Layout | None = None
) -> MosaicPlan:
    """Lay out the mosaic of some views.

    Args:
        views: of one connected part of the team.
        options: how.
        earlier: layout of the mosaic before this, kept where it still fits.

    Raises:
        ValueError: no views; two of one frame; a cell that is not positive or makes the mosaic too
            large; no floor that any view resolves.
    """
    ordered = tuple(sorted(views, key=lambda view: view.frame))
    _check(ordered)
    if options.keep_within_cells == 0.0:
        earlier = None
    prints = [footprint(v.camera, v.attitude, v.team_from_foot) for v in ordered]
    useful_m = _kept_lengths(_useful_m(ordered, prints), earlier)
    limit_m = tuple(options.far_footprint * useful_m[view.frame.robot] for view in ordered)
    found = [p.bounds(limit) for p, limit in zip(prints, limit_m, strict=True)]
    boxes = {i: np.array(box) for i, box in enumerate(found) if box is not None}
    if not boxes:
        raise ValueError("no view shows any floor below its horizon")
    low = np.min([box[0] for box in boxes.values()], axis=0)
    high = np.max([box[1] for box in boxes.values()], axis=0)
    cell_m = options.m_per_px or _cell_m(min(useful_m.values()), high - low, options.max_cells)
    grid = _grid(low, high, cell_m, options)
    extents = tuple(extent(grid, i, box) for i, box in boxes.items())
    finest_m = tuple(shown.finest_m_per_px(0.0) for shown in prints)
    layout = Layout(useful_m, _sampling_cells(extents, earlier))
    return MosaicPlan(ordered, grid, layout, limit_m, finest_m, extents)


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


def _kept_lengths(useful_m: dict[str, float], earlier: Layout | None) -> dict[str, float]:
    """Return the lengths, those of an earlier mosaic where today's are hardly others."""
    old = {} if earlier is None else earlier.useful_m
    return {
        robot: old[robot] if abs(old.get(robot, math.inf) / m - 1.0) <= SAME_LENGTH else m
        for robot, m in useful_m.items()
    }


def _sampling_cells(extents: Sequence[Extent], earlier: Layout | None) -> int:
    """Cells so large that a typical view sees about `CELLS_PER_VIEW` of them, or an earlier's."""
    sizes = [(e.rows.stop - e.rows.start) * (e.columns.stop - e.columns.start) for e in extents]
    side = max(1, round(math.sqrt(float(np.median(sizes)) / CELLS_PER_VIEW)))
    if earlier is not None and abs(side - earlier.sampling_cells) <= max(1, side // 10):
        return earlier.sampling_cells
    return side


def _cell_m(useful_m: float, size_m: np.ndarray, max_cells: int) -> float:
    """The useful length, to two digits, or what keeps the mosaic within its cells."""
    least = math.sqrt(float(size_m[0] * size_m[1]) / max_cells)
    cell = max(useful_m, least * 1.01)
    unit = 10.0 ** (math.floor(math.log10(cell)) - 1)
    steps = math.ceil(cell / unit - 1e-9) if cell > useful_m else round(cell / unit)
    return float(f"{steps * unit:.6g}")


def _grid(low: np.ndarray, high: np.ndarray, cell_m: float, options: MosaicOptions) -> Grid:
    """Cells whose edges lie at whole multiples of their side, in whole tiles: maps align.

    Raises:
        ValueError: too many cells.
    """
    first = np.floor(low / cell_m).astype(int)
    last = np.maximum(np.ceil(high / cell_m).astype(int), first + 1)
    columns, rows = (last - first).tolist()
    if rows * columns > options.max_cells:
        raise ValueError(
            f"a mosaic of {columns} x {rows} cells of {cell_m:g} m exceeds max_cells "
            f"{options.max_cells}: raise m_per_px"
        )
    side = options.tile_cells
    first, last = first // side * side, -(-last // side) * side
    columns, rows = (last - first).tolist()
    return Grid(float(first[0]) * cell_m, float(last[1]) * cell_m, cell_m, rows, columns)


def extent(grid: Grid, view: int, box: np.ndarray) -> Extent:
    """Return the cells of a grid that a box ((x, y) lowest, (x, y) highest), m, lies in."""
    (x0, y0), (x1, y1) = box / grid.m_per_px
    row, column = grid.first_cells
    rows, columns = _span(-y1, -y0, row), _span(x0, x1, column)
    return Extent(
        view,
        slice(max(rows.start, 0), min(rows.stop, grid.rows)),
        slice(max(columns.start, 0), min(columns.stop, grid.columns)),
    )


def _span(first: float, last: float, origin: int) -> slice:
    begin = math.floor(first)
    return slice(begin - origin, max(math.ceil(last), begin + 1) - origin)
