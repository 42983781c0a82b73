"""What plans an overhead view agrees with plain formulas for rays and for samples."""

import cv2
import numpy as np
import pytest

from groundfuse.backend.measurement import Attitude
from groundfuse.frontend.area_compiled import PART_BITS
from groundfuse.frontend.overhead import foot_from_cam, rays_from_floor
from groundfuse.frontend.plan_compiled import rays_of_cells, samples_of_cells

LAST = (30, 22)


@pytest.mark.parametrize("tilt_rad", [0.0, 0.6, 1.2])
@pytest.mark.parametrize("widest", [0.5, 2.0, np.inf])
def test_rays_of_cells_are_rays_to_their_middles(tilt_rad, widest):
    attitude, cell_m = Attitude(tilt_rad, 0.05, 0.55), 0.02
    corner, shape = np.array([1.7, 0.9]), (160, 80)  # floor behind the camera too
    rotation = foot_from_cam(attitude.tilt_rad, attitude.roll_rad)
    found = rays_of_cells(corner, cell_m, shape, rotation, attitude.height_m, widest)
    v, u = np.divmod(np.arange(shape[0] * shape[1]), shape[1])
    expected = rays_from_floor(attitude, corner - cell_m * np.stack([v, u], axis=1))
    expected[~(np.hypot(*expected.T) <= widest)] = np.nan
    # Rounding of a depth that is nearly 0 where a ray is 3e5 long: worst seen 5e-12.
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-14)
    seen = np.isfinite(found[:, 0])
    assert seen.any()
    assert seen.all() == (np.isinf(widest) and tilt_rad == 0.0)


@pytest.mark.parametrize("samples", [2, 3, 5])
def test_samples_lie_between_the_middles_of_neighbours(samples):
    """Curved places, against OpenCV's bilinear enlargement of them; cells beyond every border."""
    rng = np.random.default_rng(samples)
    v, u = np.mgrid[0:22, 0:26].astype(float)
    maps = np.stack([1.5 * u + 0.02 * u * v - 4.0, 1.3 * v - 0.03 * u * u - 2.0], axis=2)
    wanted = rng.random((20, 24)) < 0.7
    cells = np.argwhere(wanted).astype(np.uint32)
    starts, parts = samples_of_cells(maps, cells, samples, LAST)
    fine = cv2.resize(maps, None, fx=samples, fy=samples, interpolation=cv2.INTER_LINEAR)
    blocks = fine[samples:-samples, samples:-samples].reshape(20, samples, 24, samples, 2)
    places = np.clip(blocks.swapaxes(1, 2)[wanted].reshape(-1, samples**2, 2), 0, LAST)
    least = (1 << PART_BITS) - 1
    row, column = np.divmod(starts, LAST[0] + 1)
    found = np.stack(
        [column + (parts & least) / 2**PART_BITS, row + (parts >> PART_BITS) / 2**PART_BITS], axis=2
    )
    # Half of 1/256 px; OpenCV's weights are single: 1e-7 of 40 px.
    assert np.abs(found - places).max() < 0.5 / 2**PART_BITS + 1e-5
    assert len(np.unique(parts)) > 100
