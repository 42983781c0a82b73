"""Cells average the picture; what that looks like on a floor is in `test_overhead_view.py`."""

import itertools
import math

import cv2
import numpy as np
import pytest

from groundfuse.frontend.area_remap import Halvings, area_plan, area_read, singular_values


def test_jacobians_have_the_singular_values_of_numpy():
    jacobians = np.random.default_rng(1).normal(size=(50, 2, 2))
    expected = np.linalg.svd(jacobians, compute_uv=False)
    got = singular_values(jacobians[:, :, 0], jacobians[:, :, 1])
    np.testing.assert_allclose(np.stack(got, axis=1), expected, atol=1e-12)


def test_a_tile_without_wanted_cells_is_no_error():
    source = np.full((6, 6, 2), np.nan)
    plan = area_plan(source, np.zeros((4, 4), bool), (9, 9))
    view = np.full((4, 4), 7, np.uint8)
    area_read(Halvings([np.zeros((9, 9), np.uint8)]), plan, view)
    assert (view == 7).all()


@pytest.mark.parametrize("channels", [(), (3,)])
@pytest.mark.parametrize("side_px", [1.0, 2.0, 3.4])
def test_cells_are_means_of_bilinear_samples(side_px, channels):
    """Against float arithmetic on the same samples, cells beyond every border included."""
    rng = np.random.default_rng(3)
    picture = rng.integers(0, 256, (23, 31, *channels)).astype(np.uint8)
    at = np.stack(np.meshgrid(np.arange(-4, 22), np.arange(-3, 19)), axis=-1) * side_px - 1.3
    wanted = rng.random((20, 24)) < 0.7
    plan = area_plan(at, wanted, (31, 23))
    view = np.full((20, 24, *channels), 7, np.uint8)
    area_read(Halvings([picture]), plan, view)
    assert plan.samples == (1 if side_px == 1.0 else max(2, math.ceil(side_px / 1.25)))
    assert (view[~wanted] == 7).all()
    offsets = (np.arange(plan.samples) - (plan.samples - 1) / 2) / plan.samples * side_px
    kernel = cv2.INTER_CUBIC if plan.samples == 1 else cv2.INTER_LINEAR
    total = np.zeros(view.shape)
    for du, dv in itertools.product(offsets, offsets):
        u, v = (np.float32(at[1:-1, 1:-1, k] + d) for k, d in ((0, du), (1, dv)))
        total += cv2.remap(
            picture.astype(np.float32), u, v, kernel, borderMode=cv2.BORDER_REPLICATE
        )
    expected = np.clip(total / plan.samples**2, 0, 255)
    # OpenCV's places are rounded to 1/32 px: steps of 255 levels by 1/64 at most, and rounding.
    assert np.abs(view - expected)[wanted].max() < 255 / 64 * 2 + 0.5
    assert abs((view - expected)[wanted].mean()) < 0.2
