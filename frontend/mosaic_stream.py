"""The tiles of a mosaic one after the other, however many there are; only a few are ever held."""

import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from groundfuse.frontend.ahead import in_order
from groundfuse.frontend.exposure_samples import (
    ViewSamples,
    merged,
    sample_exposure,
    sampling_grid,
)
from groundfuse.frontend.gains import Exposure, estimate_exposure, neutral_exposure
from groundfuse.frontend.kept_parts import Keeper, Memory
from groundfuse.frontend.mosaic_options import MosaicOptions
from groundfuse.frontend.mosaic_plan import Block, Extent, MosaicPlan
from groundfuse.frontend.mosaic_tile import Tile, TileStack
from groundfuse.frontend.picture_cache import Cache
from groundfuse.frontend.pyramid import Pyramid, halvings, pyramid
from groundfuse.frontend.sight import Room, read_window, room_for, sight

AHEAD_PER_WORKER = 3
"""Tiles being made or waiting to be taken, for each thread."""

Told = Callable[[int, int], None]
"""Is told how many steps of how many are done."""


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """What every tile needs."""

    plan: MosaicPlan
    pictures: Cache[Pyramid]
    exposure: Exposure
    options: MosaicOptions
    keeper: Keeper


class _Steps:
    """Counts finished steps for whoever wants to know."""

    def __init__(self, tell: Told | None, total: int) -> None:
        self._tell, self._total, self._done = tell, total, 0

    def step(self) -> None:
        self._done += 1
        if self._tell is not None:
            self._tell(self._done, self._total)


def mosaic_tiles(
    plan: MosaicPlan,
    options: MosaicOptions,
    progress: Told | None = None,
    memory: Memory | None = None,
) -> Iterator[tuple[Block, Tile]]:
    """Yield all tiles that show any floor, always in the same order.

    Pictures are loaded when a tile needs them and held within a budget. Tiles that no view reaches
    cost nothing. A tile of an earlier mosaic is taken from the memory if it has the same views of
    the same pictures, and none of them, as the tile was rendered with it, would move or change its
    light by more than `keep_within_cells` and `keep_within_levels`; so are the samples that
    exposures are estimated from. Where there are new views besides, the cells around what they show
    are rendered anew. The others are rendered, and kept in their places.

    Raises:
        ValueError: a picture of another size than its camera's; a memory, and no digest of a
            picture.
    """

    def picture(number: int) -> Pyramid:
        return _picture(plan, number, plan.grid.m_per_px)

    pictures = Cache(picture, options.cache_bytes)
    blocks = _blocks(plan, options.tile_cells)
    samplings = len(plan.extents) if options.compensate else 0
    told = _Steps(progress, samplings + len(blocks))
    exposure, keeper = neutral_exposure(len(plan.views)), Keeper(plan, options, memory)
    with ThreadPoolExecutor(options.workers) as threads:
        if options.compensate:
            exposure = _exposure(plan, keeper, threads, told)
        scene = _Scene(plan, pictures, exposure, options, keeper)

        def work(item: tuple[Block, list[Extent]]) -> Tile | None:
            block, shown = item
            return scene.keeper.tile(block, shown, exposure, lambda part: _tile(scene, part, shown))

        ahead = AHEAD_PER_WORKER * options.workers
        for (block, _), tile in zip(blocks, in_order(threads, work, blocks, ahead), strict=True):
            told.step()
            if tile is not None:
                yield block, tile


def _picture(plan: MosaicPlan, number: int, cell_m: float) -> Pyramid:
    """Load a view's picture, with the halvings that cells of this side are read from.

    Raises:
        ValueError: it is of another size than its camera's.
    """
    view = plan.views[number]
    image = view.load()
    lens = view.camera.intrinsics
    if image.shape[:2] != (lens.height_px, lens.width_px):
        raise ValueError(
            f"picture {view.frame} is {image.shape[1]} x {image.shape[0]} px, "
            f"its camera's are {lens.width_px} x {lens.height_px}"
        )
    return pyramid(image, halvings(cell_m / plan.finest_m[number]))


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
    plan: MosaicPlan, keeper: Keeper, threads: ThreadPoolExecutor, told: _Steps
) -> Exposure:
    cell_m = sampling_grid(plan).m_per_px

    kept = keeper.kept_samples()

    def work(number: int) -> ViewSamples:
        """Sample one view."""
        extent = plan.extents[number]
        samples = sample_exposure(plan, number, _picture(plan, extent.view, cell_m))
        keeper.keep_samples(extent, samples)
        return samples

    missing = [number for number, samples in enumerate(kept) if samples is None]
    made = threads.map(work, missing)
    parts: list[ViewSamples] = []
    for samples in kept:
        parts.append(next(made) if samples is None else samples)
        told.step()
    robots = sorted({view.frame.robot for view in plan.views})
    lens_of_view = np.array([robots.index(view.frame.robot) for view in plan.views])
    return estimate_exposure(merged(parts, [e.view for e in plan.extents]), lens_of_view)


def _tile(scene: _Scene, block: Block, shown: list[Extent]) -> Tile | None:
    """Combine all views of a tile, or of a block of one; None where no view sees any of it."""
    rows, columns = block[0].stop - block[0].start, block[1].stop - block[1].start
    stack = TileStack(rows, columns, min(scene.options.max_depth, len(shown)))
    room = room_for(rows * columns)
    seen = [_add_view(stack, scene, block, extent, room) for extent in shown]
    if not any(seen):
        return None
    return stack.finished(scene.exposure.noise_levels, scene.options.num_sigmas)


def _add_view(stack: TileStack, scene: _Scene, block: Block, extent: Extent, room: Room) -> bool:
    """Read what one view shows of a tile and put it on the stack; False for none."""
    part = extent.within(*block)
    if part is None:
        return False
    plan, view, exposure = scene.plan, scene.plan.views[extent.view], scene.exposure
    limit_cells = plan.limit_m[extent.view] / plan.grid.m_per_px
    place = view.camera, view.attitude, view.team_from_foot
    falloff = exposure.falloff[extent.view]
    found = sight(*place, plan.grid, limit_cells, part, falloff)
    seen = read_window(found, lambda: scene.pictures.get(extent.view), *part, room)
    if not len(seen.cell):
        return False
    offset = part[0].start - block[0].start, part[1].start - block[1].start
    stack.add(offset, seen, found.limits, exposure.log_gain[extent.view])
    return True
