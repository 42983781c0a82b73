"""From poses and pictures to a metric picture of the floor (paper §5.1), tile by tile.

The mosaic is north up: columns along team x, rows against team y. `x_min_m` and `y_max_m` are the
outer edges of the first column and row; the centre of cell (row, column) lies at
x = x_min_m + (column + 1/2) m_per_px, y = y_max_m - (row + 1/2) m_per_px.
"""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from groundfuse.frontend.area_remap import area_remap
from groundfuse.frontend.arrays import Image, Mask
from groundfuse.frontend.exposure_samples import merged, sample_exposure
from groundfuse.frontend.gains import (
    Exposure,
    Samples,
    estimate_exposure,
    neutral_exposure,
    radius_squared,
)
from groundfuse.frontend.mosaic_plan import (
    Extent,
    MosaicOptions,
    MosaicPlan,
    MosaicView,
    plan_mosaic,
)
from groundfuse.frontend.mosaic_tile import Tile, TileStack, border_weight, sharpness_weight
from groundfuse.frontend.picture_cache import PictureCache
from groundfuse.frontend.selection import FEWEST_VIEWS
from groundfuse.frontend.sight import sight

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
    plan = plan_mosaic(views, options)
    pictures = PictureCache([_checked_load(view) for view in plan.views], options.cache_bytes)
    blocks = list(_blocks(plan, options.tile_cells))
    samplings = len(plan.extents) if options.compensate else 0
    told = _Steps(progress, samplings + len(blocks))
    exposure = neutral_exposure(len(plan.views))
    if options.compensate:
        exposure = _exposure(plan, pictures, options.workers, told)
    scene = _Scene(plan, pictures, exposure, options)
    layers = _blank_layers(plan)

    def work(block: tuple[slice, slice]) -> None:
        tile = _tile(scene, block)
        if tile is not None:
            layers.floor[block], layers.mean[block] = tile.floor, tile.mean
            layers.count[block] = tile.count

    with ThreadPoolExecutor(options.workers) as threads:
        for _ in threads.map(work, blocks):
            told.step()
    return _trimmed(plan, layers)


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """What every tile needs."""

    plan: MosaicPlan
    pictures: PictureCache
    exposure: Exposure
    options: MosaicOptions


class _Steps:
    """Counts finished steps for whoever wants to know."""

    def __init__(self, tell: Callable[[int, int], None] | None, total: int) -> None:
        self._tell, self._total, self._done = tell, total, 0

    def step(self) -> None:
        self._done += 1
        if self._tell is not None:
            self._tell(self._done, self._total)


def _checked_load(view: MosaicView) -> Callable[[], Image]:
    """Return what loads a view's picture and refuses one of another size than its camera's."""

    def load() -> Image:
        image = view.load()
        lens = view.camera.intrinsics
        if image.shape[:2] != (lens.height_px, lens.width_px):
            raise ValueError(
                f"picture {view.frame} is {image.shape[1]} x {image.shape[0]} px, "
                f"its camera's are {lens.width_px} x {lens.height_px}"
            )
        return image

    return load


def _blocks(plan: MosaicPlan, side: int) -> Iterator[tuple[slice, slice]]:
    """Tiles row by row, every other row backwards: the next tile needs much the same pictures."""
    for number, row in enumerate(range(0, plan.grid.rows, side)):
        columns = range(0, plan.grid.columns, side)
        for column in columns if number % 2 == 0 else reversed(columns):
            yield (
                slice(row, min(row + side, plan.grid.rows)),
                slice(column, min(column + side, plan.grid.columns)),
            )


def _exposure(plan: MosaicPlan, pictures: PictureCache, workers: int, told: _Steps) -> Exposure:
    def work(number: int) -> Samples:
        return sample_exposure(plan, number, pictures.pyramid(plan.extents[number].view))

    parts: list[Samples] = []
    with ThreadPoolExecutor(workers) as threads:
        for part in threads.map(work, range(len(plan.extents))):
            parts.append(part)
            told.step()
    robots = sorted({view.frame.robot for view in plan.views})
    lens_of_view = np.array([robots.index(view.frame.robot) for view in plan.views])
    return estimate_exposure(merged(parts), lens_of_view)


def _tile(scene: _Scene, block: tuple[slice, slice]) -> Tile | None:
    """Combine all views of one tile, or return None where no view sees any of it."""
    rows, columns = block[0].stop - block[0].start, block[1].stop - block[1].start
    shown = [e for e in scene.plan.extents if e.within(*block) is not None]
    if not shown:
        return None
    stack = TileStack(rows, columns, min(scene.options.max_depth, len(shown)))
    for extent in shown:
        _add_view(stack, scene, block, extent)
    return stack.finished(scene.exposure.noise_levels, scene.options.num_sigmas)


def _add_view(stack: TileStack, scene: _Scene, block: tuple[slice, slice], extent: Extent) -> None:
    """Warp what one view shows of a tile, compensate it and put it on the stack."""
    part = extent.within(*block)
    if part is None:
        return
    plan, view = scene.plan, scene.plan.views[extent.view]
    limit_cells = plan.limit_m[extent.view] / plan.grid.m_per_px
    grid = plan.grid.part(*part)
    found = sight(view.camera, view.attitude, view.team_from_foot, grid, limit_cells)
    if not found.seen.any():
        return
    warped = area_remap(scene.pictures.pyramid(extent.view), found.source_px, found.seen)
    radius2 = radius_squared(view.camera.intrinsics, found.lattice_px)
    factor = found.spread(np.exp(-scene.exposure.log_factor(extent.view, radius2)))
    fade = found.spread(border_weight(found.lattice_px, view.camera))
    weight = np.asarray(fade * sharpness_weight(found.footprint_cells), dtype=np.float32)
    offset = part[0].start - block[0].start, part[1].start - block[1].start
    stack.add(offset, found.seen, warped * factor, found.footprint_cells, weight)


def _blank_layers(plan: MosaicPlan) -> Tile:
    shape = (plan.grid.rows, plan.grid.columns)
    colour = (*shape, 3)
    return Tile(np.zeros(colour, np.uint8), np.zeros(colour, np.uint8), np.zeros(shape, np.uint16))


def _trimmed(plan: MosaicPlan, layers: Tile) -> Mosaic:
    """Cut off rows and columns at the edges that nothing was seen in."""
    seen = layers.count > 0
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    if not len(rows):
        raise ValueError("no view shows any floor within its far limit")
    block = slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
    grid, count = plan.grid.part(*block), layers.count[block]
    return Mosaic(
        layers.floor[block],
        layers.mean[block],
        count,
        (count > 0) & (count < FEWEST_VIEWS),
        grid.x_min_m,
        grid.y_max_m,
        grid.m_per_px,
    )
