"""The overhead view shows the floor in metres, forward up, whatever the lens and the tilt."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from groundfuse.backend.measurement import Attitude
from groundfuse.frontend.camera import Camera, Distortion, Intrinsics, Mount
from groundfuse.frontend.overhead import floor_from_rays, rays_from_floor
from groundfuse.frontend.overhead_view import (
    OverheadGrid,
    OverheadOptions,
    overhead_grid,
    overhead_view,
    raster_cell_m,
)

SIGMA = Attitude(0.01, 0.003, 0.002)
LENSES = {
    "pinhole": Intrinsics(640, 480, 550.0, 550.0, 319.5, 239.5),
    "plumb_bob": Intrinsics(
        640, 480, 550.0, 552.0, 322.0, 236.0, Distortion.PLUMB_BOB, (-0.25, 0.08, 1e-3, -5e-4, 0.0)
    ),
    "fisheye": Intrinsics(
        640, 480, 320.0, 321.0, 318.0, 243.0, Distortion.EQUIDISTANT, (-0.02, 0.004, 0.0, 0.0)
    ),
}
ATTITUDES = {
    "nadir": Attitude(0.0, 0.0, 0.55),
    "33": Attitude(math.radians(33), math.radians(1.5), 0.55),
    "45": Attitude(math.radians(45), math.radians(-2.0), 0.55),
    "scrubber": Attitude(math.radians(30), 0.0, 0.1),
    "drone": Attitude(math.radians(12), math.radians(-8), 70.0),
}
# Waves of 40 and 64 cells, amplitudes 50 and 40: rounding twice is off by 1.0 and OpenCV's 1/32 px
# steps by (2 pi / 40) 50 x 3 / 64 = 0.4, bilinear samples by (2 pi / 40)^2 / 8 x 90 = 0.3, the
# mean over a cell by a third of that; bicubic overshoot at a picture pixel of 3 cells 0.5; sum 2.3,
# worst seen 2.5.
TOLERANCE_GREY = 3.0


def camera_of(lens, attitude, **rows):
    return Camera(lens, Mount(attitude, SIGMA), **rows)


def waves(floor_m, attitude):
    """A smooth picture of the floor without symmetry."""
    k = 2 * math.pi / (40 * 0.0036 * attitude.height_m)
    x, y = floor_m[:, 0], floor_m[:, 1]
    return 128.0 + 50.0 * np.sin(k * (x + 0.3 * y)) + 40.0 * np.sin(0.6 * k * (y - 0.2 * x) + 1.0)


def photograph(lens, attitude, paint):
    u, v = np.meshgrid(np.arange(lens.width_px), np.arange(lens.height_px))
    rays = lens.rays_from_px(np.stack([u, v], axis=-1).reshape(-1, 2).astype(float))
    grey = np.nan_to_num(paint(floor_from_rays(attitude, rays)), nan=0.0)
    return np.round(grey).astype(np.uint8).reshape(lens.height_px, lens.width_px)


def centres(grid):
    u, v = np.meshgrid(np.arange(grid.width_px), np.arange(grid.height_px))
    return grid.floor_from_overhead(np.stack([u, v], axis=-1).reshape(-1, 2))


@pytest.mark.parametrize(
    ("lens", "name"),
    [("pinhole", name) for name in ATTITUDES] + [("plumb_bob", "33"), ("fisheye", "45")],
)
def test_the_view_shows_the_floor(lens, name):
    attitude = ATTITUDES[name]
    camera = camera_of(LENSES[lens], attitude)
    grid = overhead_grid(camera, attitude)
    image = photograph(LENSES[lens], attitude, lambda floor: waves(floor, attitude))
    view, mask = overhead_view(image, camera, attitude, grid)
    expected = waves(centres(grid), attitude).reshape(mask.shape)
    inner = cv2.erode(mask.astype(np.uint8), np.ones((5, 5)), borderValue=0).astype(bool)
    assert inner.mean() > 0.3
    assert np.abs(view[inner] - expected[inner]).max() < TOLERANCE_GREY
    assert (view[~mask] == 0).all()


def test_forward_is_up_and_left_is_left():
    attitude = ATTITUDES["33"]
    camera = camera_of(LENSES["pinhole"], attitude)
    grid = overhead_grid(camera, attitude)
    ahead_left = np.array([[0.5, 0.2]])
    image = photograph(
        camera.intrinsics,
        attitude,
        lambda floor: 20.0 + 200.0 * (np.hypot(*(floor - ahead_left).T) < 0.03),
    )
    view, _ = overhead_view(image, camera, attitude, grid)
    rows, columns = np.nonzero(view > 120)
    middle = grid.floor_from_overhead(np.array([[columns.mean(), rows.mean()]]))
    np.testing.assert_allclose(middle, ahead_left, atol=grid.m_per_px / 2)
    foot_u, foot_v = grid.overhead_from_floor(np.zeros((1, 2)))[0]
    assert rows.mean() < foot_v
    assert columns.mean() < foot_u


@given(
    st.floats(1e-3, 1.0),
    st.tuples(st.floats(-9, 9), st.floats(-9, 9)),
    st.tuples(st.floats(-500, 500), st.floats(-500, 500)),
)
def test_pixels_and_metres_go_round(cell_m, corner, px):
    grid = OverheadGrid(cell_m, *corner, 100, 100, 9.0)
    points = np.array([px])
    # Cancellation: 9 m x 2.2e-16 / 1e-3 m per px x 4 operations = 8e-12 px.
    there_and_back = grid.overhead_from_floor(grid.floor_from_overhead(points))
    np.testing.assert_allclose(there_and_back, points, atol=1e-11)


@settings(max_examples=25)
@given(st.floats(-0.9, 1.2), st.floats(-0.2, 0.2), st.sampled_from(sorted(LENSES)))
def test_the_grid_covers_the_useful_floor_and_no_more(tilt, roll, lens):
    attitude = Attitude(tilt, roll, 0.55)
    camera = camera_of(LENSES[lens], attitude, first_row=40, last_row=430)
    grid = overhead_grid(camera, attitude)
    rng = np.random.default_rng(0)
    px = rng.uniform([0, 40], [639, 430], (4000, 2))
    floor = floor_from_rays(attitude, camera.intrinsics.rays_from_px(px))
    near = np.hypot(*floor.T) < grid.far_m - 2 * grid.m_per_px
    at = grid.overhead_from_floor(floor[near])
    # The outline bulges between lattice samples 4 px of up to 3 cells apart.
    slack = 12.0
    assert (at > -slack).all()
    assert (at < np.array([grid.width_px, grid.height_px]) + slack).all()


@pytest.mark.parametrize("tilt_deg", [33.0, 45.0, 75.0])
def test_the_far_limit_is_the_length_of_a_pixel_on_the_floor(tilt_deg):
    attitude = Attitude(math.radians(tilt_deg), 0.0, 0.55)
    camera = camera_of(LENSES["pinhole"], attitude)
    grid = overhead_grid(camera, attitude)
    far = np.array([[grid.far_m * 0.99, 0.0]])
    v = camera.intrinsics.px_from_rays(rays_from_floor(attitude, far))[0, 1]
    ends = np.array([[319.5, v - 0.5], [319.5, v + 0.5]])
    floor = floor_from_rays(attitude, camera.intrinsics.rays_from_px(ends))
    assert abs(floor[0, 0] - floor[1, 0]) <= 3.0 * grid.m_per_px


def test_rows_out_of_use_are_not_shown():
    attitude = ATTITUDES["33"]
    camera = camera_of(LENSES["pinhole"], attitude, first_row=100, last_row=400)
    grid = overhead_grid(camera, attitude)
    _, mask = overhead_view(np.full((480, 640), 9, np.uint8), camera, attitude, grid)
    px = camera.intrinsics.px_from_rays(rays_from_floor(attitude, centres(grid)[mask.ravel()]))
    assert (px[:, 1] >= 100).all()
    assert (px[:, 1] <= 400).all()


@pytest.mark.parametrize("focal_px", [900.0, 2600.0])
def test_fine_detail_averages_out_instead_of_aliasing(focal_px):
    attitude = Attitude(math.radians(20), 0.0, 0.55)
    lens = Intrinsics(1200, 900, focal_px, focal_px, 599.5, 449.5)
    camera = camera_of(lens, attitude)
    grid = overhead_grid(camera, attitude)
    checks = (np.indices((900, 1200)).sum(axis=0) % 2 * 200).astype(np.uint8)
    view, mask = overhead_view(checks, camera, attitude, grid)
    # Cells of 2.4 to 3.2, and 7 to 9 pixels: the deviation is 100 without averaging, 2.2 with.
    assert view[mask].std() < 5.0
    assert abs(view[mask].mean() - 100.0) < 1.0
    image = photograph(lens, attitude, lambda floor: waves(floor, attitude))
    view, mask = overhead_view(image, camera, attitude, grid)
    expected = waves(centres(grid), attitude).reshape(mask.shape)
    inner = cv2.erode(mask.astype(np.uint8), np.ones((5, 5)), borderValue=0).astype(bool)
    assert np.abs(view[inner] - expected[inner]).max() < TOLERANCE_GREY


def test_a_lens_that_folds_does_not_show_the_floor_twice():
    lens = Intrinsics(
        320, 240, 150.0, 150.0, 160.0, 120.0, Distortion.PLUMB_BOB, (-0.12, 0.0, 0.0, 0.0, 0.0)
    )
    attitude = Attitude(math.radians(45), 0.0, 0.55)
    camera = camera_of(lens, attitude)
    grid = OverheadGrid(0.02, 8.0, 8.0, 800, 800, 20.0)
    _, mask = overhead_view(np.zeros((240, 320), np.uint8), camera, attitude, grid)
    rays = rays_from_floor(attitude, centres(grid)[mask.ravel()])
    back = lens.rays_from_px(lens.px_from_rays(rays))
    np.testing.assert_allclose(back, rays, atol=1e-6)


def test_rasters_beyond_the_limit_of_remap_work():
    attitude = ATTITUDES["nadir"]
    camera = camera_of(LENSES["pinhole"], attitude)
    grid = OverheadGrid(1e-5, 0.0, 0.2, 40_000, 3, 1.0)
    image = photograph(camera.intrinsics, attitude, lambda floor: 100.0 + 200.0 * floor[:, 1])
    view, mask = overhead_view(image, camera, attitude, grid)
    expected = 100.0 + 200.0 * centres(grid)[:, 1].reshape(mask.shape)
    assert mask.all()
    assert np.abs(view - expected).max() < TOLERANCE_GREY


def test_colour_stays_colour():
    attitude = ATTITUDES["33"]
    camera = camera_of(LENSES["pinhole"], attitude)
    grid = overhead_grid(camera, attitude)
    image = np.full((480, 640, 3), (10, 120, 240), np.uint8)
    view, mask = overhead_view(image, camera, attitude, grid)
    assert view.shape == (*mask.shape, 3)
    assert (view[mask] == (10, 120, 240)).all()


def test_the_cell_follows_the_height_of_the_mount():
    camera = camera_of(LENSES["pinhole"], ATTITUDES["drone"])
    assert raster_cell_m(camera, OverheadOptions()) == pytest.approx(0.0036 * 70.0)
    assert raster_cell_m(camera, OverheadOptions(m_per_px=0.1)) == 0.1
    coarse = Intrinsics(64, 48, 50.0, 50.0, 31.5, 23.5)
    assert raster_cell_m(camera_of(coarse, ATTITUDES["33"]), OverheadOptions()) == 0.55 / 50.0


def test_no_resolved_floor_is_refused():
    camera = camera_of(LENSES["pinhole"], ATTITUDES["33"])
    with pytest.raises(ValueError, match=r"a pixel covers 0\.00\d+ m at best, limit 0\.0003 m"):
        overhead_grid(camera, ATTITUDES["33"], OverheadOptions(m_per_px=1e-4))


def test_a_camera_that_sees_only_sky_is_refused():
    camera = camera_of(LENSES["pinhole"], ATTITUDES["33"])
    with pytest.raises(ValueError, match="a pixel covers inf m at best"):
        overhead_grid(camera, Attitude(math.radians(130), 0.0, 0.55))


def test_a_raster_too_large_is_refused():
    camera = camera_of(LENSES["pinhole"], ATTITUDES["33"])
    with pytest.raises(ValueError, match=r"\d+ x \d+ cells exceeds 1000, got m_per_px 0\.002"):
        overhead_grid(camera, ATTITUDES["33"], OverheadOptions(m_per_px=0.002, max_cells=1000))


def test_a_cell_without_size_is_refused():
    camera = camera_of(LENSES["pinhole"], ATTITUDES["33"])
    with pytest.raises(ValueError, match="m_per_px must be positive, got 0"):
        overhead_grid(camera, ATTITUDES["33"], OverheadOptions(m_per_px=0.0))


def test_a_picture_of_another_size_is_refused():
    camera = camera_of(LENSES["pinhole"], ATTITUDES["33"])
    grid = overhead_grid(camera, ATTITUDES["33"])
    with pytest.raises(ValueError, match="picture is 32 x 20 px, the camera's are 640 x 480"):
        overhead_view(np.zeros((20, 32), np.uint8), camera, ATTITUDES["33"], grid)
