"""Putting one view on a tile's stack, compiled; needs numba, else `TileStack.add` uses numpy."""

from typing import Any

import numpy as np
from numba import njit

from groundfuse.frontend.selection import LEVEL


def _slot(held_footprint: Any, cell: int) -> int:  # noqa: ANN401
    """Return the first of a cell's views with the largest footprint."""
    slot = 0
    for k in range(1, len(held_footprint)):
        if held_footprint[k, cell] > held_footprint[slot, cell]:
            slot = k
    return slot


_coarsest: Any = njit(cache=True, nogil=True)(_slot)


def _put(
    offset: tuple[int, int],
    window: tuple[Any, Any, Any, Any],
    stack: tuple[Any, Any, Any],
    tallies: tuple[Any, Any, Any],
    shape: tuple[int, int],
    highest: float,
) -> None:
    """Do what `TileStack.add` does, cell by cell.

    Args:
        offset: row and column of the window's first cell.
        window: seen, colours, footprint and weight of the view.
        stack: colours, footprint and weight of the views held.
        tallies: views held, views seen, and the colours left out.
        shape: of the tile.
        highest: level at which colours are cut.
    """
    seen, colours, footprint, weight = window
    held_colours, held_footprint, held_weight = stack
    held, count, left_out = tallies
    depth = len(held_footprint)
    level, cut = np.float32(LEVEL), np.float32(highest)
    new = np.zeros(3, np.uint16)
    for row in range(seen.shape[0]):
        for column in range(seen.shape[1]):
            if not seen[row, column]:
                continue
            cell = (row + offset[0]) * shape[1] + column + offset[1]
            for channel in range(3):
                new[channel] = np.uint16(np.rint(min(colours[row, column, channel], cut) * level))
            count[cell] += 1
            slot = held[cell]
            if slot < depth:
                held[cell] += 1
            else:
                slot = _coarsest(held_footprint, cell)
                keep = footprint[row, column] < held_footprint[slot, cell]
                for channel in range(3):
                    out = held_colours[slot, channel, cell] if keep else new[channel]
                    left_out[channel, cell] += np.float32(out)
                if not keep:
                    continue
            held_footprint[slot, cell] = footprint[row, column]
            held_weight[slot, cell] = weight[row, column]
            for channel in range(3):
                held_colours[slot, channel, cell] = new[channel]


put: Any = njit(cache=True, nogil=True)(_put)
