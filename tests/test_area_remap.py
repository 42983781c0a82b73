"""Cells average the picture; what that looks like on a floor is in `test_overhead_view.py`."""

import numpy as np

from groundfuse.frontend.area_remap import area_plan, area_read, singular_values


def test_jacobians_have_the_singular_values_of_numpy():
    jacobians = np.random.default_rng(1).normal(size=(50, 2, 2))
    expected = np.linalg.svd(jacobians, compute_uv=False)
    got = singular_values(jacobians[:, :, 0], jacobians[:, :, 1])
    np.testing.assert_allclose(np.stack(got, axis=1), expected, atol=1e-12)


def test_a_tile_without_wanted_cells_is_no_error():
    source = np.full((6, 6, 2), np.nan)
    plan = area_plan(source, np.zeros((4, 4), bool))
    got = area_read([np.zeros((9, 9), np.uint8)], plan)
    assert got.shape == (4, 4)
