"""The compiled rule is numpy's, view for view, ties and all; the stack keeps the finest views."""

import numpy as np
import plain_selection
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from groundfuse.frontend import selection_compiled as compiled
from groundfuse.frontend.mosaic_tile import TileStack
from groundfuse.frontend.sight import SeenCells

# Rounding of single-precision means of at most 128 numbers up to 1022: 1022 x 2^-23 x 12.  A view
# on the very limit may count or not; none did in these cases.  Worst seen 1e-4.
TOLERANCE_HALF_LEVELS = 2e-3
# Two roundings of a level lie between the plain reading and the stack's: half levels, then levels.
TOLERANCE_LEVELS = 1
LIMITS = np.array([159.0, 0.0, 119.0], np.float32)


def compiled_combined(colours, footprint, weight, noise, num_sigmas):
    """What `plain_selection.combined` returns, by the compiled rule."""
    words = sum(colours[:, k].astype(np.uint32) << np.uint32(compiled.BITS * k) for k in range(3))
    floor = np.empty(colours.shape[1:], np.float32)
    every, limits = np.arange(floor.shape[1]), (np.float32(noise**2), np.float32(num_sigmas**2))
    sizes = np.ascontiguousarray(footprint.T)
    compiled.combine_cells(words, sizes, weight, every, limits, floor)
    return floor


def cells(num_views, num_cells, highest, seed):
    rng = np.random.default_rng(seed)
    colours = rng.integers(0, highest + 1, (num_views, 3, num_cells)).astype(np.uint16)
    footprint = rng.integers(1, 4, (num_views, num_cells)).astype(np.float32)
    return colours, footprint, rng.uniform(0.02, 1.0, (num_views, num_cells)).astype(np.float32)


@settings(max_examples=60)
@given(
    st.integers(1, 20),
    st.integers(1, 2 * compiled.LANES + 3),
    st.sampled_from([1, 2, 30, 1022]),
    st.integers(0, 10**6),
)
def test_views_that_count_are_those_of_numpy(num_views, num_cells, highest, seed):
    """Powers of two as weights: the sum of those that count tells which they are."""
    colours, footprint, _ = cells(num_views, num_cells, highest, seed)
    weight = np.repeat(2.0 ** np.arange(num_views)[:, None], num_cells, axis=1).astype(np.float32)
    for some in (np.ones_like(weight), weight):
        arguments = colours, footprint, some, 3.0, 3.0
        expected, found = plain_selection.combined(*arguments), compiled_combined(*arguments)
        assert np.abs(found - expected).max() < TOLERANCE_HALF_LEVELS


@pytest.mark.parametrize("num_views", [64, compiled.DEEPEST])
def test_the_highest_sums_do_not_overflow(num_views):
    colours, footprint, weight = cells(num_views, 70, 1022, 5)
    colours[: num_views // 3] = 1022
    colours[num_views // 3 : num_views // 2] = 0
    arguments = colours, footprint, weight, 3.0, 0.1
    expected, found = plain_selection.combined(*arguments), compiled_combined(*arguments)
    assert np.abs(found - expected).max() < TOLERANCE_HALF_LEVELS


def test_obstacles_are_outvoted():
    colours = np.full((7, 3, 300), 200, np.uint16)
    things = np.array([(900, 20, 400), (30, 700, 10), (1000, 1000, 1000)])
    colours[[0, 3, 5]] = things[:, :, None]
    ones = np.ones((7, 300), np.float32)
    assert (compiled_combined(colours, ones, ones, 3.0, 3.0) == 200.0).all()


def random_views(rng, shape):
    """Views of windows of a tile: offset, gain, and the cells that each shows."""
    for offset in ((0, 0), (3, 2), (0, 5)) * 2:
        row, column = np.nonzero(rng.random(shape) < 0.8)
        cell = np.column_stack([row, column]).astype(np.int32)
        place = np.column_stack(
            [
                rng.uniform(0, 159, len(row)),
                rng.uniform(0, 119, len(row)),
                rng.integers(1, 5, len(row)),
                rng.uniform(0.8, 1.4, len(row)),
            ]
        ).astype(np.float32)
        colour = rng.uniform(0.0, 255.0, (len(row), 3)).astype(np.float32)
        yield offset, rng.normal(0.0, 0.3, 3), SeenCells(cell, place, colour)


def plain_layers(views, shape, depth):
    """Cell by cell, as the words of `TileStack` say it."""
    held = {}
    for offset, log_gain, seen in views:
        for cell, place, colour in zip(seen.cell, seen.place, seen.colour, strict=True):
            u, v, size, factor = map(float, place)
            levels = np.minimum(colour * factor * np.exp(-log_gain), 511.0)
            fade = np.clip(min(u, 159 - u, v, 119 - v) / (0.08 * 120), 0.02, 1.0)
            view = np.rint(2.0 * levels), size, fade / (size**2 + 0.25) ** 2
            held.setdefault((cell[0] + offset[0], cell[1] + offset[1]), []).append(view)
    floor, mean = np.zeros((*shape, 3)), np.zeros((*shape, 3))
    for cell, found in held.items():
        mean[cell] = np.mean([half for half, _, _ in found], axis=0) / 2.0
        kept = found[:depth]
        for view in found[depth:]:
            coarsest = max(range(depth), key=lambda k: (kept[k][1], -k))
            if view[1] < kept[coarsest][1]:
                kept[coarsest] = view
        colours, sizes, weights = (np.array(part, np.float32) for part in zip(*kept, strict=True))
        column = colours[:, :, None], sizes[:, None], weights[:, None]
        floor[cell] = plain_selection.combined(*column, 6.0, 3.0)[:, 0] / 2.0
    return floor, mean, {cell: len(found) for cell, found in held.items()}


@pytest.mark.parametrize("depth", [1, 3, 8])
def test_a_stack_is_what_its_words_say(depth):
    """Six views on three places: with depth 3 the finest are kept, the others counted."""
    views = list(random_views(np.random.default_rng(depth), (25, 15)))
    stack = TileStack(30, 20, depth)
    for offset, log_gain, seen in views:
        stack.add(offset, seen, LIMITS, log_gain)
    tile = stack.finished(3.0, 3.0)
    floor, mean, count = plain_layers(views, (30, 20), depth)
    assert np.abs(tile.floor - np.minimum(floor, 255.0)).max() <= TOLERANCE_LEVELS
    assert np.abs(tile.mean - np.minimum(mean, 255.0)).max() <= TOLERANCE_LEVELS
    assert {cell: tile.count[cell] for cell in count} == count
    assert tile.count.sum() == sum(count.values())
    assert tile.count.max() > 3
