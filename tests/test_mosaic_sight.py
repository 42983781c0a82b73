"""Cells are looked up where the camera shows them, at their true coarseness, and nowhere else."""

import dataclasses

import numpy as np
import pytest
from analytic_floor import make_camera

from groundfuse.backend.measurement import Attitude, Se2
from groundfuse.frontend.footprint import footprint, widest_ray
from groundfuse.frontend.mosaic_plan import Extent
from groundfuse.frontend.overhead import rays_from_floor
from groundfuse.frontend.sight import LINEAR_ERROR_CELLS, Grid, sight

POSE, ATTITUDE = Se2(0.2, -0.1, 0.7), Attitude(0.5, 0.04, 0.55)
BARREL = (-0.1, 0.02, 0.001, -0.0005, 0.0)


def grid_over(camera, cell_m):
    box = footprint(camera, ATTITUDE, POSE).bounds(0.02)
    rows, columns = (np.ceil((box[1] - box[0]) / cell_m).astype(int)[::-1] + 1).tolist()
    whole = Grid(float(box[0][0]), float(box[1][1]), cell_m, rows, columns)
    middle = [slice(max(0, side // 2 - 150), side // 2 + 150) for side in (rows, columns)]
    return whole.part(*middle)


def exact_px(camera, points):
    return camera.intrinsics.px_from_rays(rays_from_floor(ATTITUDE, POSE.inverse().apply(points)))


@pytest.mark.parametrize("coefficients", [(), BARREL])
@pytest.mark.parametrize(("cell_m", "step"), [(0.001, 4), (0.002, 3), (0.02, 1)])
def test_place_and_footprint_agree_with_exact_projection(cell_m, step, coefficients):
    camera = make_camera(coefficients=coefficients, size=(640, 480))
    grid = grid_over(camera, cell_m)
    found = sight(camera, ATTITUDE, POSE, grid, 9.0)
    assert found.step == step
    assert found.seen.sum() > 50
    points = grid.centres().reshape(grid.rows, grid.columns, 2)[found.seen]
    exact = exact_px(camera, points)
    error_px = np.hypot(*(found.source_px[1:-1, 1:-1][found.seen] - exact).T)
    by_x, by_y = (
        (exact_px(camera, points + d) - exact_px(camera, points - d)) / (2 * 1e-6)
        for d in 1e-6 * np.eye(2)
    )
    least = np.linalg.svd(np.stack([by_x, by_y], axis=2), compute_uv=False)[:, 1] * cell_m
    assert (error_px / least).max() < LINEAR_ERROR_CELLS + 1e-9
    # The footprint comes from differences over blocks of up to 2 cm: worst seen 2.1 %.
    np.testing.assert_allclose(found.footprint_cells[found.seen], 1.0 / least, rtol=0.03)


def test_far_floor_is_cut_off_at_the_limit():
    camera = make_camera()
    grid = grid_over(camera, 0.004)
    near, far = (sight(camera, ATTITUDE, POSE, grid, limit) for limit in (1.6, 9.0))
    assert (near.seen == far.seen & (far.footprint_cells <= 1.6)).all()
    assert 0 < near.seen.sum() < far.seen.sum()


def test_what_folds_back_into_the_picture_is_not_seen():
    folding = make_camera(coefficients=(-0.2, 0.0, 0.0, 0.0, 0.0))
    limit = widest_ray(folding)
    # r - 0.2 r^3 turns back at r = 1.29 and is 0 again at 2.24; the corner's ray is 0.95 long.
    assert 0.95 < limit < 1.29
    grid = Grid(-2.0, 2.0, 0.02, 200, 200)
    found = sight(folding, Attitude(0.0, 0.0, 0.55), Se2(0, 0, 0), grid, 1e9)
    radius_m = np.hypot(*grid.centres().T).reshape(200, 200)
    assert found.seen.any()
    assert radius_m[found.seen].max() < limit * 0.55
    assert widest_ray(make_camera()) == np.inf
    # r - 0.35 r^3 never reaches the corner: whatever ray was found for it, growth ends at 0.976.
    assert widest_ray(make_camera(coefficients=(-0.35, 0.0, 0.0, 0.0, 0.0))) < 0.98


def test_spreading_is_exact_for_what_is_linear():
    camera = make_camera(size=(640, 480))
    grid = Grid(0.0, 0.5, 0.001, 203, 157)
    found = sight(camera, ATTITUDE, POSE, grid, 9.0)
    assert found.step > 1
    rows, columns = found.lattice_px.shape[:2]
    row, column = np.mgrid[0:rows, 0:columns] - 1.0  # a margin of one block
    middle = (found.step - 1) / 2
    linear = 3.0 * (row * found.step + middle) - 2.0 * (column * found.step + middle)
    fine_row, fine_column = np.mgrid[0:203, 0:157]
    np.testing.assert_allclose(found.spread(linear), 3.0 * fine_row - 2.0 * fine_column, atol=1e-3)


def test_part_of_a_grid_has_the_same_centres():
    grid = Grid(-1.0, 2.0, 0.5, 6, 8)
    centres = grid.centres().reshape(6, 8, 2)
    part = grid.part(slice(2, 5), slice(1, 7))
    np.testing.assert_allclose(part.centres().reshape(3, 6, 2), centres[2:5, 1:7])
    np.testing.assert_allclose(
        part.centres(margin=1).reshape(5, 8, 2)[1:-1, 1:-1], centres[2:5, 1:7]
    )
    assert centres[0, 0].tolist() == [-0.75, 1.75]


def test_horizon_in_the_picture_leaves_only_floor():
    camera = make_camera(75.0)
    high = dataclasses.replace(ATTITUDE, tilt_rad=1.3)
    found = footprint(camera, high, POSE)
    assert np.isnan(found.m_per_px).any()
    low, high_corner = found.bounds(0.02)
    assert np.isfinite([low, high_corner]).all()
    assert (high_corner > low).all()
    assert found.bounds(1e-9) is None


def test_extents_overlap_or_not():
    extent = Extent(0, slice(10, 20), slice(30, 40))
    assert extent.within(slice(0, 15), slice(35, 99)) == (slice(10, 15), slice(35, 40))
    assert extent.within(slice(0, 10), slice(0, 99)) is None
    assert extent.within(slice(0, 99), slice(40, 50)) is None
