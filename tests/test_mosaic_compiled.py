"""The compiled rule is numpy's, view for view, ties and all."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from groundfuse.frontend import mosaic_tile, selection

pytest.importorskip("numba", reason="numba is not installed: numpy does the work")
from groundfuse.frontend import selection_compiled as compiled

# Rounding of single-precision means of at most 128 numbers up to 1022: 1022 x 2^-23 x 12.  A view
# on the very limit may count or not; none did in these cases.  Worst seen 1e-4.
TOLERANCE_HALF_LEVELS = 2e-3


def cells(num_views, num_cells, highest, seed):
    rng = np.random.default_rng(seed)
    colours = rng.integers(0, highest + 1, (num_views, 3, num_cells)).astype(np.uint16)
    footprint = rng.integers(1, 4, (num_views, num_cells)).astype(np.float32)
    return colours, footprint, rng.uniform(0.02, 1.0, (num_views, num_cells)).astype(np.float32)


@settings(deadline=None, max_examples=60)
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
        expected, found = selection.combined(*arguments), compiled.combined(*arguments)
        assert np.abs(found - expected).max() < TOLERANCE_HALF_LEVELS


@pytest.mark.parametrize("num_views", [64, compiled.DEEPEST, compiled.DEEPEST + 1])
def test_the_highest_sums_do_not_overflow(num_views):
    colours, footprint, weight = cells(num_views, 70, 1022, 5)
    colours[: num_views // 3] = 1022
    colours[num_views // 3 : num_views // 2] = 0
    arguments = colours, footprint, weight, 3.0, 0.1
    expected, found = selection.combined(*arguments), compiled.combined(*arguments)
    assert np.abs(found - expected).max() < TOLERANCE_HALF_LEVELS


def test_obstacles_are_outvoted():
    colours = np.full((7, 3, 300), 200, np.uint16)
    things = np.array([(900, 20, 400), (30, 700, 10), (1000, 1000, 1000)])
    colours[[0, 3, 5]] = things[:, :, None]
    ones = np.ones((7, 300), np.float32)
    assert (compiled.combined(colours, ones, ones, 3.0, 3.0) == 200.0).all()


@pytest.mark.parametrize("depth", [1, 3, 8])
def test_a_stack_is_numpys_to_the_bit(depth, monkeypatch):
    """Six views on three places: with depth 3 the finest are kept, the others counted."""
    layers = []
    for put in (mosaic_tile.put, None):
        monkeypatch.setattr(mosaic_tile, "put", put)
        rng, stack = np.random.default_rng(depth), mosaic_tile.TileStack(30, 20, depth)
        for offset in ((0, 0), (3, 2), (0, 5)) * 2:
            seen = rng.random((25, 15)) < 0.8
            colours = rng.uniform(0.0, 600.0, (25, 15, 3)).astype(np.float32)
            footprint = rng.integers(1, 5, (25, 15)).astype(np.float32)
            weight = rng.uniform(0.1, 1.0, (25, 15)).astype(np.float32)
            stack.add(offset, seen, colours, footprint, weight)
        layers.append(stack.finished(3.0, 3.0))
    for name in ("floor", "mean", "count"):
        assert np.array_equal(getattr(layers[0], name), getattr(layers[1], name))
    assert layers[0].count.max() > 3
