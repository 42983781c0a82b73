"""Tiles and samples of earlier mosaics, each with what it was made from.

What is kept of a part depends on its own record and on today's plan alone, and what is not kept is
made from today's plan alone. So it does not matter whether some parts were renewed already by a run
of the same plan that was interrupted: those are today's, and the others are kept or not as they
would have been.

A tile whose views all stay, but that a new view shows some of, is patched: rendered are the cells
around what that view shows, and no cell depends on another. Its record goes on saying how the rest
was rendered, from which the patch may differ by half of what is allowed; so may today's from then
on.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from typing import Any, Protocol

import numpy as np

from groundfuse.frontend.arrays import Floats, Mask
from groundfuse.frontend.exposure_samples import ViewSamples
from groundfuse.frontend.gains import Exposure, neutral_exposure
from groundfuse.frontend.made_from import (
    MadeFrom,
    every_view,
    is_same,
    made_from,
    new_views,
    only,
    patched,
    same_views,
    stacked,
)
from groundfuse.frontend.mosaic_options import MosaicOptions
from groundfuse.frontend.mosaic_plan import Block, Extent, MosaicPlan
from groundfuse.frontend.mosaic_tile import Tile

PATCHED_SHARE = 0.5
"""Of what may change, for a tile that is patched or was: patch and rest may each be that far off
its record, so they are off each other and off today by no more than what may change."""


class Memory(Protocol):
    """Where the parts of a mosaic are kept, by name; threads use it at once."""

    def load(self, name: str) -> object:
        """Return what was saved last by that name; None where nothing was."""

    def load_all(self, names: Sequence[str]) -> Iterable[object]:
        """Return what `load` returns for each of many names: a question for each costs more."""
        ...

    def save(self, name: str, part: object) -> None:
        """Keep a part in place of what had its name."""


@dataclass(frozen=True, slots=True, eq=False)
class KeptTile:
    """A finished tile, None where no view saw any of it, and what it was made from.

    The tile is not deflated: a third of the room is not worth a sixth of the time of a rendering.

    Attributes:
        made_from: see there.
        tile: the layers.
        patched: whether some of it was rendered later than its record says.
    """

    made_from: MadeFrom
    tile: Tile | None
    patched: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class KeptSamples:
    """The samples of a view, and what they were made from."""

    made_from: MadeFrom
    samples: ViewSamples


class Keeper:
    """Makes only those parts of a mosaic that an earlier one does not have."""

    def __init__(self, plan: MosaicPlan, options: MosaicOptions, memory: Memory | None) -> None:
        """Take what the parts belong to; without a memory all are made.

        Raises:
            ValueError: there is a memory, and a view whose picture it can't know again.
        """
        self._plan, self._options, self._memory = plan, options, memory
        self._every = every_view(plan)
        self._sampling = "samples", plan.grid.m_per_px, plan.layout.sampling_cells
        self._neutral = neutral_exposure(len(plan.views))  # samples have no gain
        for view in plan.views:
            if memory is not None and not view.digest:
                raise ValueError(f"a mosaic that is kept needs a digest of picture {view.frame}")

    def kept_samples(self) -> list[ViewSamples | None]:
        """Return the samples of each extent's view that may stay, None for the others."""
        extents = self._plan.extents
        found: list[ViewSamples | None] = [None] * len(extents)
        if self._memory is None:
            return found
        kept = dict[int, KeptSamples]()
        for k, part in enumerate(self._memory.load_all([self._name(extent) for extent in extents])):
            if isinstance(part, KeptSamples) and part.made_from.settings == self._sampling:
                kept[k] = part
        if kept:
            today = self._samples_made_from([extents[k] for k in kept])
            before = stacked([part.made_from for part in kept.values()])
            corners_m = self._corners_m([(extents[k].rows, extents[k].columns) for k in kept])
            cell_m = self._plan.grid.m_per_px
            same = same_views(before, today, corners_m, cell_m, self._options)
            for (k, part), stays in zip(kept.items(), same, strict=True):
                found[k] = part.samples if stays else None
        return found

    def keep_samples(self, extent: Extent, samples: ViewSamples) -> None:
        """Keep the samples of an extent's view."""
        if self._memory is not None:
            today = self._samples_made_from([extent])
            self._memory.save(self._name(extent), KeptSamples(today, samples))

    def _name(self, extent: Extent) -> str:
        return f"samples of {self._plan.views[extent.view].frame}"

    def _samples_made_from(self, extents: Sequence[Extent]) -> MadeFrom:
        views = [extent.view for extent in extents]
        return made_from(self._every, views, self._neutral, self._sampling)

    def tile(
        self,
        block: Block,
        shown: Sequence[Extent],
        exposure: Exposure,
        work: Callable[[Block], Tile | None],
    ) -> Tile | None:
        """Return one tile, made now if need be, or as much of it as need be.

        Args:
            block: its place in the grid.
            shown: the views' parts of it.
            exposure: of all views.
            work: makes it, or a block of it.
        """
        if self._memory is None:
            return work(block)
        (row, column), grid = self._plan.grid.first_cells, self._plan.grid
        side, options = self._options.tile_cells, self._options
        at = row + block[0].start, column + block[1].start
        settings = "tile", grid.m_per_px, at, side, options.max_depth, options.num_sigmas
        today = made_from(self._every, [extent.view for extent in shown], exposure, settings)
        name = f"tile {at[0] // side} {at[1] // side}"
        kept = self._memory.load(name)
        if isinstance(kept, KeptTile):
            parts = [extent.within(*block) or block for extent in shown]
            new = self._new(kept, today, parts)
            if new is not None and not new.any():
                return kept.tile
            if new is not None and (box := _around(compress(parts, new))) != block:
                tile = _pasted(kept.tile, block, work(box), box)
                now = patched(kept.made_from, today, new)
                self._memory.save(name, KeptTile(now, tile, patched=True))
                return tile
        found = work(block)
        self._memory.save(name, KeptTile(today, found))
        return found

    def _new(self, kept: KeptTile, today: MadeFrom, parts: Sequence[Block]) -> Mask | None:
        """Tell which of a tile's views are new (n,); None where others may not stay as they are."""
        new = new_views(kept.made_from, today)
        if new is None:
            return None
        options, cell_m = self._options, self._plan.grid.m_per_px
        if kept.patched or new.any():
            options = replace(
                options,
                keep_within_cells=PATCHED_SHARE * options.keep_within_cells,
                keep_within_levels=PATCHED_SHARE * options.keep_within_levels,
            )
        corners_m = self._corners_m(list(compress(parts, ~new)))
        stays = is_same(kept.made_from, only(today, ~new), corners_m, cell_m, options)
        return new if stays else None

    def _corners_m(self, parts: Sequence[Block]) -> Floats:
        """Return the corners (n, 4, 2) of blocks of cells."""
        grid = self._plan.grid
        ends = [(rows.start, rows.stop, columns.start, columns.stop) for rows, columns in parts]
        rows, columns = np.hsplit(np.array(ends, np.float64), 2)
        x = grid.x_min_m + columns * grid.m_per_px
        y = grid.y_max_m - rows * grid.m_per_px
        corners: Floats = np.stack([x[:, [0, 1, 0, 1]], y[:, [0, 0, 1, 1]]], axis=-1)
        return corners


def _around(parts: Iterable[Block]) -> Block:
    """Return the smallest block that holds all parts."""
    rows, columns = zip(*parts, strict=True)
    return (
        slice(min(r.start for r in rows), max(r.stop for r in rows)),
        slice(min(c.start for c in columns), max(c.stop for c in columns)),
    )


def _pasted(tile: Tile | None, block: Block, patch: Tile | None, box: Block) -> Tile | None:
    """Return a tile of a block with another's cells in a box of it."""
    if patch is None:
        return tile
    shape = block[0].stop - block[0].start, block[1].stop - block[1].start
    (row, column), (rows, columns) = (block[0].start, block[1].start), patch.count.shape
    first = box[0].start - row, box[1].start - column
    cells = slice(first[0], first[0] + rows), slice(first[1], first[1] + columns)
    layers = []
    for name in ("floor", "mean", "count"):
        new: np.ndarray[Any, Any] = getattr(patch, name)
        whole = np.zeros((*shape, *new.shape[2:]), new.dtype)
        if tile is not None:
            whole[:] = getattr(tile, name)
        whole[cells] = new
        layers.append(whole)
    return Tile(*layers)
