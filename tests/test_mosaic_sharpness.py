"""The mosaic keeps the detail that its sharpest views hold: gains of waves near a pixel's size."""

import math

import numpy as np
import pytest
from analytic_floor import centres, make_camera, rounded, view_of

from groundfuse.backend.measurement import FrameId, Se2
from groundfuse.frontend.area_remap import point_values
from groundfuse.frontend.mosaic import MosaicOptions, build_mosaic
from groundfuse.frontend.overhead import floor_from_rays
from groundfuse.frontend.tile_compiled import sharpness_weight

RAYS = 5  # a side: their mean is the mean over a pixel to 1/200 of the wave's curvature


def wave(length_m):
    """Grey 60 to 200 along a slanted direction."""
    normal = np.array([math.cos(0.4), math.sin(0.4)]) * 2.0 * math.pi / length_m
    return lambda points: 130.0 + 70.0 * np.sin(points @ normal)


def photographed(camera, pose, colour):
    """What a camera sees when each pixel is the mean over its square, BGR uint8."""
    lens = camera.intrinsics
    v, u = np.mgrid[0 : lens.height_px * RAYS, 0 : lens.width_px * RAYS]
    px = (np.column_stack([u.ravel(), v.ravel()]) + 0.5) / RAYS - 0.5
    floor = pose.apply(floor_from_rays(camera.mount.attitude, lens.rays_from_px(px)))
    rays = colour(floor).reshape(lens.height_px, RAYS, lens.width_px, RAYS)
    return rounded(rays.mean(axis=(1, 3))[..., None].repeat(3, axis=2))


def cell_means(mosaic, colour):
    steps = ((np.arange(RAYS) + 0.5) / RAYS - 0.5) * mosaic.m_per_px
    shifts = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    return np.mean([colour(centres(mosaic) + shift) for shift in shifts], axis=0)


def gain(views, cell_m, length_m, where=None):
    """Slope of the mosaic's grey against the floor's means over the cells."""
    mosaic = build_mosaic(views, MosaicOptions(m_per_px=cell_m, compensate=False))
    where = mosaic.count > 0 if where is None else where(mosaic)
    truth = cell_means(mosaic, wave(length_m))[where] - 130.0
    return float(truth @ (mosaic.floor[where][:, 0] - 130.0) / (truth @ truth))


def views_from(cameras, length_m):
    for index, camera in enumerate(cameras):
        pose = Se2(0.01 * index, -0.02 * index, 0.3 + index)
        image = photographed(camera, pose, wave(length_m))
        yield view_of(FrameId("A", index), camera, pose, image)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_means_over_pixels_become_the_light_at_their_middles(dtype):
    u = np.arange(64)
    for length_px, worst in ((8.0, 0.002), (16.0, 0.00012)):  # fourth order: 16 times less
        turn = 2.0 * math.pi * u / length_px
        means = np.tile(np.sin(turn) * np.sinc(1.0 / length_px), (9, 1)).astype(dtype)
        got = point_values(means)[4, 2:-2]
        assert np.abs(got - np.sin(turn)[2:-2]).max() < worst
        assert np.abs(means[4, 2:-2] - np.sin(turn)[2:-2]).max() > 10 * worst


def test_what_is_linear_or_grey_stays_as_it_is():
    ramp = np.tile(np.arange(0, 200, 5, dtype=np.uint8), (20, 1))[..., None].repeat(3, axis=2)
    assert np.array_equal(point_values(ramp)[:, 1:-1], ramp[:, 1:-1])
    steep = ramp.transpose(1, 0, 2)
    assert np.array_equal(point_values(steep)[1:-1], steep[1:-1])
    assert point_values(ramp).dtype == np.uint8


@pytest.mark.parametrize("px_per_cell", [1.0, 1.4, 2.5])
def test_waves_four_cells_long_keep_their_height(px_per_cell):
    """Seen 0.99, 1.03, 1.02; means joined as if they were points, linearly, left 0.75, 0.88, 0.96.

    The excess is OpenCV's bicubic kernel, which overshoots by up to 4 % where waves are 5 px long.
    """
    camera = make_camera(0.0)
    cell_m = px_per_cell * camera.mount.attitude.height_m / camera.intrinsics.focal_px
    found = gain(list(views_from([camera], 4.0 * cell_m)), cell_m, 4.0 * cell_m)
    assert abs(found - 1.0) < 0.04


def test_coarse_views_hardly_blur_what_a_fine_one_shows():
    low, high = make_camera(0.0), make_camera(0.0, height_m=1.1)
    cell_m = low.mount.attitude.height_m / low.intrinsics.focal_px
    length_m = 5.0 * cell_m

    def middle(mosaic):
        return np.hypot(*np.moveaxis(centres(mosaic), 2, 0)) < 0.2

    alone = gain(list(views_from([low], length_m)), cell_m, length_m, middle)
    together = gain(list(views_from([low, high], length_m)), cell_m, length_m, middle)
    coarse = gain(list(views_from([high], length_m)), cell_m, length_m, middle)
    assert coarse < 0.8 * alone
    assert together > 0.93 * alone


def test_weights_follow_the_footprint_where_it_blurs_and_level_off_where_not():
    sizes = np.array([0.05, 0.1, 1.0, 2.0, 8.0, 16.0], np.float32)
    weight = np.array([sharpness_weight(size) for size in sizes])
    assert (np.diff(weight) < 0.0).all()
    assert 8.0 < weight[2] / weight[3] < 16.0
    np.testing.assert_allclose(weight[4] / weight[5], 16.0, rtol=0.02)
    np.testing.assert_allclose(weight[0] / weight[1], 1.0, rtol=0.1)
