"""Tiles and samples of earlier mosaics, each with what it was made from.

What is kept of a part depends on its own record and on today's plan alone, and what is not kept is
made from today's plan alone. So it does not matter whether some parts were renewed already by a run
of the same plan that was interrupted: those are today's, and the others are kept or not as they
would have been.

A tile whose views all stay, but that a new view shows some of, is patched: only the cells around
what that view shows are rendered, as no cell depends on another. The patch has a record of its own.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
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
    only,
    same_views,
    stacked,
    taking_part,
)
from groundfuse.frontend.mosaic_options import MosaicOptions
from groundfuse.frontend.mosaic_plan import Block, Extent, MosaicPlan
from groundfuse.frontend.mosaic_tile import Tile

MOST_PATCHES = 8
"""A tile with more is rendered as a whole again."""


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
class Patch:
    """A block of a tile that was rendered later than the rest.

    Attributes:
        cells: first row, row after the last, and columns alike, from the tile's first.
        made_from: see there; of the views that show any of the block.
    """

    cells: tuple[int, int, int, int]
    made_from: MadeFrom

    def within(self, block: Block) -> Block:
        """Return its place in the grid, from that of the tile."""
        top, bottom, left, right = self.cells
        row, column = block[0].start, block[1].start
        return slice(row + top, row + bottom), slice(column + left, column + right)


@dataclass(frozen=True, slots=True, eq=False)
class KeptTile:
    """A finished tile, None where no view saw any of it, and what it was made from.

    The tile is not deflated: a third of the room is not worth a sixth of the time of a rendering.

    Attributes:
        made_from: see there; of all that is in no patch.
        tile: the layers.
        patches: blocks that new views made it necessary to render again.
    """

    made_from: MadeFrom
    tile: Tile | None
    patches: tuple[Patch, ...] = ()


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
            new = self._new(kept, today, block, shown)
            if new is not None and not new.any():
                return kept.tile
            if new is not None and len(kept.patches) < MOST_PATCHES:
                box = _around([extent.within(*block) or block for extent in compress(shown, new)])
                inside = [extent.view for extent in shown if extent.within(*box)]
                patch = Patch(_from(block, box), made_from(self._every, inside, exposure, settings))
                tile = _pasted(kept.tile, block, work(box), patch.cells)
                self._memory.save(name, KeptTile(kept.made_from, tile, (*kept.patches, patch)))
                return tile
        found = work(block)
        self._memory.save(name, KeptTile(today, found))
        return found

    def _new(
        self, kept: KeptTile, today: MadeFrom, block: Block, shown: Sequence[Extent]
    ) -> Mask | None:
        """Tell which of a tile's views are new (n,); None where the others may not stay."""
        known = np.zeros(len(today.who), bool)
        patches = [(patch.within(block), patch.made_from) for patch in kept.patches]
        for box, record in ((block, kept.made_from), *patches):
            there = taking_part(record, today)
            if there is None:
                return None
            corners_m = self._corners_m([e.within(*box) or box for e in compress(shown, there)])
            limits = self._plan.grid.m_per_px, self._options
            if not is_same(record, only(today, there), corners_m, *limits):
                return None
            known |= there
        return ~known

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


def _from(block: Block, box: Block) -> tuple[int, int, int, int]:
    """Return a box's rows and columns from the first of a block."""
    row, column = block[0].start, block[1].start
    return box[0].start - row, box[0].stop - row, box[1].start - column, box[1].stop - column


def _pasted(
    tile: Tile | None, block: Block, patch: Tile | None, cells: tuple[int, int, int, int]
) -> Tile | None:
    """Return a tile of a block with another's in these cells of it."""
    if patch is None:
        return tile
    top, bottom, left, right = cells
    shape, layers = (block[0].stop - block[0].start, block[1].stop - block[1].start), []
    for name in ("floor", "mean", "count"):
        new: np.ndarray[Any, Any] = getattr(patch, name)
        whole = np.zeros((*shape, *new.shape[2:]), new.dtype)
        if tile is not None:
            whole[:] = getattr(tile, name)
        whole[top:bottom, left:right] = new
        layers.append(whole)
    return Tile(*layers)
