"""The tiles of a mosaic one after the other, however many there are; only a few are ever held."""

import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from groundfuse.frontend.ahead import in_order
from groundfuse.frontend.area_remap import area_remap
from groundfuse.frontend.arrays import Image
from groundfuse.frontend.exposure_samples import merged, sample_exposure
from groundfuse.frontend.gains import (
    Exposure,
    Samples,
    estimate_exposure,
    neutral_exposure,
    radius_squared,
)
from groundfuse.frontend.mosaic_plan import Extent, MosaicOptions, MosaicPlan, MosaicView
from groundfuse.frontend.mosaic_tile import Tile, TileStack, border_weight, sharpness_weight
from groundfuse.frontend.picture_cache import PictureCache
from groundfuse.frontend.sight import sight

AHEAD_PER_WORKER = 3
"""Tiles being made or waiting to be taken, for each thread."""

Block = tuple[slice, slice]
"""Rows and columns of the grid."""
Told = Callable[[int, int], None]
"""Is told how many steps of how many are done."""


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """What every tile needs."""

    plan: MosaicPlan
    pictures: PictureCache
    exposure: Exposure
    options: MosaicOptions


class _Steps:
    """Counts finished steps for whoever wants to know."""

    def __init__(self, tell: Told | None, total: int) -> None:
        self._tell, self._total, self._done = tell, total, 0

    def step(self) -> None:
        self._done += 1
        if self._tell is not None:
            self._tell(self._done, self._total)


def mosaic_tiles(
    plan: MosaicPlan, options: MosaicOptions, progress: Told | None = None
) -> Iterator[tuple[Block, Tile]]:
    """Yield all tiles that show any floor, always in the same order.

    Pictures are loaded when a tile needs them and held within a budget. Tiles that no view reaches
    cost nothing.

    Raises:
        ValueError: a picture of another size than its camera's.
    """
    pictures = PictureCache([_checked_load(view) for view in plan.views], options.cache_bytes)
    blocks = _blocks(plan, options.tile_cells)
    samplings = len(plan.extents) if options.compensate else 0
    told = _Steps(progress, samplings + len(blocks))
    exposure = neutral_exposure(len(plan.views))
    with ThreadPoolExecutor(options.workers) as threads:
        if options.compensate:
            exposure = _exposure(plan, pictures, threads, told)
        scene = _Scene(plan, pictures, exposure, options)

        def work(item: tuple[Block, list[Extent]]) -> Tile | None:
            return _tile(scene, *item)

        ahead = AHEAD_PER_WORKER * options.workers
        for (block, _), tile in zip(blocks, in_order(threads, work, blocks, ahead), strict=True):
            told.step()
            if tile is not None:
                yield block, tile


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


def _blocks(plan: MosaicPlan, side: int) -> list[tuple[Block, list[Extent]]]:
    """Tiles with what reaches them, row by row, every other row backwards.

    So the next tile needs much the same pictures.
    """
    reached: dict[tuple[int, int], list[Extent]] = {}
    for extent in plan.extents:
        for row in range(extent.rows.start // side, math.ceil(extent.rows.stop / side)):
            first, stop = extent.columns.start // side, math.ceil(extent.columns.stop / side)
            for column in range(first, stop):
                reached.setdefault((row, column), []).append(extent)
    order = sorted(reached, key=lambda at: (at[0], at[1] if at[0] % 2 == 0 else -at[1]))
    return [
        (
            (
                slice(row * side, min((row + 1) * side, plan.grid.rows)),
                slice(column * side, min((column + 1) * side, plan.grid.columns)),
            ),
            reached[row, column],
        )
        for row, column in order
    ]


def _exposure(
    plan: MosaicPlan, pictures: PictureCache, threads: ThreadPoolExecutor, told: _Steps
) -> Exposure:
    def work(number: int) -> Samples:
        return sample_exposure(plan, number, pictures.pyramid(plan.extents[number].view))

    parts: list[Samples] = []
    for part in threads.map(work, range(len(plan.extents))):
        parts.append(part)
        told.step()
    robots = sorted({view.frame.robot for view in plan.views})
    lens_of_view = np.array([robots.index(view.frame.robot) for view in plan.views])
    return estimate_exposure(merged(parts), lens_of_view)


def _tile(scene: _Scene, block: Block, shown: list[Extent]) -> Tile | None:
    """Combine all views of one tile, or return None where no view sees any of it."""
    rows, columns = block[0].stop - block[0].start, block[1].stop - block[1].start
    stack = TileStack(rows, columns, min(scene.options.max_depth, len(shown)))
    seen = [_add_view(stack, scene, block, extent) for extent in shown]
    if not any(seen):
        return None
    return stack.finished(scene.exposure.noise_levels, scene.options.num_sigmas)


def _add_view(stack: TileStack, scene: _Scene, block: Block, extent: Extent) -> bool:
    """Warp what one view shows of a tile, compensate it, put it on the stack; False for none."""
    part = extent.within(*block)
    if part is None:
        return False
    plan, view = scene.plan, scene.plan.views[extent.view]
    limit_cells = plan.limit_m[extent.view] / plan.grid.m_per_px
    grid = plan.grid.part(*part)
    found = sight(view.camera, view.attitude, view.team_from_foot, grid, limit_cells)
    if not found.seen.any():
        return False
    warped = area_remap(scene.pictures.pyramid(extent.view), found.source_px, found.seen)
    radius2 = radius_squared(view.camera.intrinsics, found.lattice_px)
    factor = found.spread(np.exp(-scene.exposure.log_factor(extent.view, radius2)))
    fade = found.spread(border_weight(found.lattice_px, view.camera))
    weight = np.asarray(fade * sharpness_weight(found.footprint_cells), dtype=np.float32)
    offset = part[0].start - block[0].start, part[1].start - block[1].start
    stack.add(offset, found.seen, warped * factor, found.footprint_cells, weight)
    return True
