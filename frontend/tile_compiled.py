"""The loops of `TileStack`, compiled: putting a view's cells on the stack, and taking it down."""

from typing import Any

import numpy as np

from groundfuse.backend.compiled import compiled
from groundfuse.frontend.selection_compiled import BITS, LEVEL

HIGHEST = 511.0
"""Levels; brighter ones (after division by a small gain) are cut, so that squares stay exact."""
BORDER_SHARE = 0.08
"""A view fades in over this share of the picture's shorter side."""
SMALLEST_WEIGHT = 0.02
FINE_CELLS = 0.5
"""A footprint this long, in cells, blurs a cell hardly more than a shorter one."""


@compiled
def slope_of(limits: Any) -> Any:  # noqa: ANN401
    """Return the weight that a view gains per pixel from its border inwards; see `border_weight`.

    Args:
        limits: last column, first and last row of the used picture.
    """
    shorter = min(limits[0], limits[2] - limits[1]) + np.float32(1.0)
    return np.float32(1.0) / max(np.float32(BORDER_SHARE) * shorter, np.float32(1.0))


@compiled
def border_weight(u: Any, v: Any, limits: Any, slope: Any) -> Any:  # noqa: ANN401
    """Return the weight of a pixel: it fades towards the picture's border.

    No seam shows where a view ends.

    Args:
        u: column.
        v: row.
        limits: see `slope_of`.
        slope: likewise.
    """
    inside = min(u, limits[0] - u, v - limits[1], limits[2] - v)
    return min(max(inside * slope, np.float32(SMALLEST_WEIGHT)), np.float32(1.0))


@compiled
def sharpness_weight(footprint_cells: Any) -> Any:  # noqa: ANN401
    """Return the weight of a view from the footprint of its pixel, in cells.

    The fourth power of the footprint: a view twice as coarse as another hardly blurs what the
    finer one shows, while views alike are averaged against noise. Among views that are all finer
    than the cell the footprint matters little.
    """
    blur = footprint_cells * footprint_cells + np.float32(FINE_CELLS * FINE_CELLS)
    return np.float32(1.0) / (blur * blur)


@compiled
def _word(colours: Any, k: int, factor: Any, gain: Any) -> Any:  # noqa: ANN401
    """Return a compensated colour as half levels, three in a word."""
    word = np.uint32(0)
    for channel in range(3):
        level = min(colours[k, channel] * factor * gain[channel], np.float32(HIGHEST))
        half = np.uint32(np.rint(level * np.float32(LEVEL)))
        word |= half << np.uint32(BITS * channel)
    return word


@compiled
def _coarsest(footprint: Any, cell: int) -> int:  # noqa: ANN401
    """Return the first of a cell's views with the largest footprint."""
    slot, largest = 0, footprint[cell, 0]
    for k in range(1, footprint.shape[1]):
        if footprint[cell, k] > largest:
            slot, largest = k, footprint[cell, k]
    return slot


@compiled
def _leave_out(word: Any, cell: int, left_out: Any) -> None:  # noqa: ANN401
    for channel in range(3):
        half = (word >> np.uint32(BITS * channel)) & np.uint32((1 << BITS) - 1)
        left_out[channel, cell] += np.float32(half)


@compiled
def put(
    seen: tuple[Any, Any, Any],
    origin: tuple[int, int, int],
    gain: Any,  # noqa: ANN401
    limits: Any,  # noqa: ANN401
    stack: tuple[Any, Any, Any],
    tallies: tuple[Any, Any, Any, Any],
) -> None:
    """Put one view on the stack; of more than it has room for, the finest stay.

    Args:
        seen: cells, places and colours; see `SeenCells`.
        origin: row and column of the window in the tile, and the tile's columns.
        gain: (3,) what the view's colours are multiplied by, besides the falloff's factor.
        limits: see `border_weight`.
        stack: of the views held: colours (depth, cells) as words, footprints (cells, depth), which
            are searched cell by cell, and weights (depth, cells).
        tallies: views held, views seen, the coarsest of a full stack (cells,), `depth` until
            it is needed, and the sums (3, cells) of the colours left out.
    """
    cells, places, colours = seen
    words, footprint, weight = stack
    held, count, coarsest, left_out = tallies
    depth, slope = len(words), slope_of(limits)
    edges, factors = (limits[0], limits[1], limits[2]), (gain[0], gain[1], gain[2])
    for k in range(len(cells)):
        cell = (cells[k, 0] + origin[0]) * origin[2] + cells[k, 1] + origin[1]
        word, size = _word(colours, k, places[k, 3], factors), places[k, 2]
        count[cell] += 1
        slot = np.int64(held[cell])
        if slot < depth:
            held[cell] += 1
        else:
            if coarsest[cell] == depth:
                coarsest[cell] = _coarsest(footprint, cell)
            slot = np.int64(coarsest[cell])
            if not size < footprint[cell, slot]:
                _leave_out(word, cell, left_out)
                continue
            _leave_out(words[slot, cell], cell, left_out)
        words[slot, cell], footprint[cell, slot] = word, size
        faded = border_weight(places[k, 0], places[k, 1], edges, slope)
        weight[slot, cell] = faded * sharpness_weight(size)
        if coarsest[cell] < depth:
            coarsest[cell] = _coarsest(footprint, cell)


@compiled
def by_depth(held: Any, depth: int) -> Any:  # noqa: ANN401
    """Return the cells (n,) in order of how many views they hold, and where each number begins."""
    begins = np.zeros(depth + 2, np.int64)
    for cell in range(len(held)):
        begins[held[cell] + 1] += 1
    for k in range(depth + 1):
        begins[k + 1] += begins[k]
    order, place = np.empty(len(held), np.int64), begins.copy()
    for cell in range(len(held)):
        order[place[held[cell]]] = cell
        place[held[cell]] += 1
    return order, begins


@compiled
def add_held(words: Any, held: Any, left_out: Any) -> None:  # noqa: ANN401
    """Add the colours held to those left out."""
    for k in range(len(words)):
        for cell in range(len(held)):
            if k < held[cell]:
                _leave_out(words[k, cell], cell, left_out)


@compiled
def to_levels(half_levels: Any, share: Any, picture: Any) -> None:  # noqa: ANN401
    """Fill a picture (cells, 3) with half levels (3, cells) times a share (cells,), rounded."""
    for cell in range(len(picture)):
        for channel in range(3):
            level = np.rint(half_levels[channel, cell] * share[cell])
            picture[cell, channel] = np.uint8(min(max(level, np.float32(0.0)), np.float32(255.0)))
