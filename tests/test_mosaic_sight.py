"""Cells are looked up where the camera shows them, at their true coarseness, and nowhere else."""

import dataclasses

import numpy as np
import pytest
from analytic_floor import make_camera

from groundfuse.backend.measurement import Attitude, Se2
from groundfuse.frontend.footprint import footprint, widest_ray
from groundfuse.frontend.gains import radius_squared
from groundfuse.frontend.mosaic_plan import Extent
from groundfuse.frontend.overhead import rays_from_floor
from groundfuse.frontend.pyramid import pyramid
from groundfuse.frontend.sight import LINEAR_ERROR_CELLS, Grid, read_window, sight

POSE, ATTITUDE = Se2(0.2, -0.1, 0.7), Attitude(0.5, 0.04, 0.55)
# Places are kept in single precision: 640 px x 2^-24, and pixels are up to 4 a cell.
TOLERANCE_CELLS = 1e-4
BARREL = (-0.1, 0.02, 0.001, -0.0005, 0.0)


def grid_over(camera, cell_m):
    box = footprint(camera, ATTITUDE, POSE).bounds(0.02)
    rows, columns = (np.ceil((box[1] - box[0]) / cell_m).astype(int)[::-1] + 1).tolist()
    whole = Grid(float(box[0][0]), float(box[1][1]), cell_m, rows, columns)
    middle = [slice(max(0, side // 2 - 150), side // 2 + 150) for side in (rows, columns)]
    return whole.part(*middle)


def seen_by(camera, grid, limit_cells, attitude=ATTITUDE, pose=POSE, part=None):
    """The sight of a grid, a mask of the cells seen, and their places (rows, columns, 4)."""
    found = sight(camera, attitude, pose, grid, limit_cells, part)
    rows, columns = part or (slice(0, grid.rows), slice(0, grid.columns))
    lens = camera.intrinsics
    black = pyramid(np.zeros((lens.height_px, lens.width_px, 3), np.uint8), 9)
    cells = read_window(found, lambda: black, rows, columns)
    seen = np.zeros((grid.rows, grid.columns), bool)
    places = np.full((grid.rows, grid.columns, 4), np.nan)
    row, column = cells.cell.T
    seen[row + rows.start, column + columns.start] = True
    places[row + rows.start, column + columns.start] = cells.place
    return found, seen, places


def exact_px(camera, points):
    return camera.intrinsics.px_from_rays(rays_from_floor(ATTITUDE, POSE.inverse().apply(points)))


@pytest.mark.parametrize("coefficients", [(), BARREL])
@pytest.mark.parametrize(("cell_m", "step"), [(0.001, 4), (0.002, 3), (0.02, 1)])
def test_place_and_footprint_agree_with_exact_projection(cell_m, step, coefficients):
    camera = make_camera(coefficients=coefficients, size=(640, 480))
    grid = grid_over(camera, cell_m)
    found, seen, places = seen_by(camera, grid, 9.0)
    assert found.step == step
    assert seen.sum() > 50
    points = grid.centres().reshape(grid.rows, grid.columns, 2)[seen]
    exact = exact_px(camera, points)
    error_px = np.hypot(*(places[seen][:, :2] - exact).T)
    by_x, by_y = (
        (exact_px(camera, points + d) - exact_px(camera, points - d)) / (2 * 1e-6)
        for d in 1e-6 * np.eye(2)
    )
    least = np.linalg.svd(np.stack([by_x, by_y], axis=2), compute_uv=False)[:, 1] * cell_m
    assert (error_px / least).max() < LINEAR_ERROR_CELLS + TOLERANCE_CELLS
    # The footprint comes from differences over blocks of up to 2 cm: worst seen 2.1 %.
    np.testing.assert_allclose(places[seen][:, 2], 1.0 / least, rtol=0.03)


@pytest.mark.parametrize("share", [0.0, 0.25, 0.6, 1.0])
def test_the_finest_share_is_a_quantile_of_what_shows_floor(share):
    upwards = Attitude(1.4, 0.0, 0.55)
    for attitude in (ATTITUDE, upwards):
        found = footprint(make_camera(), attitude, POSE)
        on_floor = found.m_per_px[np.isfinite(found.m_per_px)]
        # The same formula, rounded in another order.
        assert found.finest_m_per_px(share) == pytest.approx(
            np.quantile(on_floor, share), rel=1e-15
        )
    assert on_floor.size < found.m_per_px.size
    nothing = footprint(make_camera(), Attitude(3.0, 0.0, 0.55), POSE)
    assert nothing.finest_m_per_px(share) == np.inf


def test_far_floor_is_cut_off_at_the_limit():
    camera = make_camera()
    grid = grid_over(camera, 0.004)
    (_, near, _), (_, far, places) = (seen_by(camera, grid, limit) for limit in (1.6, 9.0))
    assert (near == far & (places[..., 2] <= np.float32(1.6))).all()
    assert 0 < near.sum() < far.sum()


def test_what_folds_back_into_the_picture_is_not_seen():
    folding = make_camera(coefficients=(-0.2, 0.0, 0.0, 0.0, 0.0))
    limit = widest_ray(folding)
    # r - 0.2 r^3 turns back at r = 1.29 and is 0 again at 2.24; the corner's ray is 0.95 long.
    assert 0.95 < limit < 1.29
    grid = Grid(-2.0, 2.0, 0.02, 200, 200)
    _, seen, _ = seen_by(folding, grid, 1e9, Attitude(0.0, 0.0, 0.55), Se2(0, 0, 0))
    radius_m = np.hypot(*grid.centres().T).reshape(200, 200)
    assert seen.any()
    assert radius_m[seen].max() < limit * 0.55
    assert widest_ray(make_camera()) == np.inf
    # r - 0.35 r^3 never reaches the corner: whatever ray was found for it, growth ends at 0.976.
    assert widest_ray(make_camera(coefficients=(-0.35, 0.0, 0.0, 0.0, 0.0))) < 0.98


@pytest.mark.parametrize("cell_m", [0.001, 0.002, 0.02])
def test_a_window_sees_what_the_whole_sees_there(cell_m):
    """To the bit: so tiles don't show in a mosaic."""
    camera = make_camera(coefficients=BARREL, size=(640, 480))
    grid = grid_over(camera, cell_m)
    _, seen, places = seen_by(camera, grid, 9.0)
    row, column = (np.sort(at) for at in np.nonzero(seen))
    middle = len(row) // 2
    rows = slice(int(row[0]) + 1, int(row[middle]) + 1)
    columns = slice(int(column[middle]), grid.columns - 1)
    _, part, part_places = seen_by(camera, grid, 9.0, part=(rows, columns))
    assert part.any()
    assert (part[rows, columns] == seen[rows, columns]).all()
    assert np.array_equal(part_places[part], places[part])


def test_the_falloff_is_undone_at_every_cell():
    camera = make_camera(coefficients=BARREL, size=(640, 480))
    grid, falloff = grid_over(camera, 0.002), np.array([-0.3, 0.1, -0.2])
    part = slice(0, grid.rows), slice(0, grid.columns)
    found = sight(camera, ATTITUDE, POSE, grid, 9.0, part, falloff)
    black = pyramid(np.zeros((480, 640, 3), np.uint8), 0)
    place = read_window(found, lambda: black, *part).place.astype(float)
    radius2 = radius_squared(camera.intrinsics, place[:, :2])
    fall = (radius2[:, None] ** [1, 2, 3]) @ falloff
    # Linear over three cells of 2 mm: worst seen 3.4e-5.
    np.testing.assert_allclose(place[:, 3], np.exp(-fall), rtol=1e-4)


def test_part_of_a_grid_has_the_same_centres():
    grid = Grid(-1.0, 2.0, 0.5, 6, 8)
    centres = grid.centres().reshape(6, 8, 2)
    part = grid.part(slice(2, 5), slice(1, 7))
    np.testing.assert_allclose(part.centres().reshape(3, 6, 2), centres[2:5, 1:7])
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
