"""The mosaic puts the floor in its place, without what stands on it, whatever the exposure."""

import dataclasses
import math

import numpy as np
import pytest
from analytic_floor import (
    centres,
    make_camera,
    picture,
    ring,
    rounded,
    shift_cells,
    view_of,
    waves,
)

from groundfuse.backend.measurement import Attitude, FrameId, Se2
from groundfuse.frontend.mosaic import MosaicOptions, build_mosaic
from groundfuse.frontend.overhead import rays_from_floor

# The bar is 0.05 cell.  Linear interpolation of the place errs by 0.02 cell at most, remap rounds
# to 1/32 px, both without a preferred direction; worst seen over all cases 0.005.
TOLERANCE_SHIFT_CELLS = 0.02
# Rounding twice is 0.5 in the mean of absolute values; worst mean seen 0.73.  A large cell on the
# picture's border is averaged over what is inside alone: worst single cell seen 7.5.
TOLERANCE_MEAN_LEVELS = 1.0
TOLERANCE_WORST_LEVELS = 10.0
PLAIN = MosaicOptions(compensate=False)
BARREL = (-0.1, 0.02, 0.001, -0.0005, 0.0)


def colour_of(camera, pixels):
    """A floor of waves as long as so many pixels at nadir."""
    length_m = pixels * camera.mount.attitude.height_m / camera.intrinsics.focal_px
    return lambda points: waves(points, length_m)


def options_for(camera, px_per_cell, **others):
    cell = px_per_cell * camera.mount.attitude.height_m / camera.intrinsics.focal_px
    return MosaicOptions(m_per_px=cell, compensate=False, **others)


def mosaic_of(frames, camera, options=PLAIN, change=lambda _, image: image):
    return build_mosaic(
        [
            view_of(frame, camera, pose, rounded(change(i, image)))
            for i, (frame, pose, image) in enumerate(frames)
        ],
        options,
    )


@pytest.mark.parametrize("px_per_cell", [0.6, 1.0, 1.7, 3.2, 9.0])
@pytest.mark.parametrize("coefficients", [(), BARREL])
@pytest.mark.parametrize("tilt_deg", [0.0, 33.0, -20.0])
def test_floor_comes_back_in_its_cells(tilt_deg, coefficients, px_per_cell):
    camera = make_camera(tilt_deg, coefficients=coefficients, offset=Se2(0.1, -0.05, 0.4))
    attitude = Attitude(camera.mount.attitude.tilt_rad + 0.02, 0.05, 0.56)
    colour, pose = colour_of(camera, 12 * max(px_per_cell, 2.5)), Se2(3.0, -2.0, 2.1)
    image = rounded(picture(camera, attitude, pose, colour))
    view = view_of(FrameId("A", 0), camera, pose, image, attitude)
    mosaic = build_mosaic([view], options_for(camera, px_per_cell, far_footprint=1.5))
    assert np.abs(shift_cells(mosaic, colour)).max() < TOLERANCE_SHIFT_CELLS
    seen = mosaic.count > 0
    error = np.abs(mosaic.floor[seen] - colour(centres(mosaic)[seen]))
    assert error.mean() < TOLERANCE_MEAN_LEVELS
    assert error.max() < TOLERANCE_WORST_LEVELS


def test_seen_is_what_the_used_picture_shows():
    camera = make_camera(20.0)
    camera = dataclasses.replace(camera, first_row=30, last_row=100)
    pose, attitude = Se2(0.3, 0.1, -0.7), camera.mount.attitude
    view = view_of(FrameId("A", 0), camera, pose, np.full((120, 160, 3), 90, np.uint8))
    mosaic = build_mosaic([view], options_for(camera, 1.5, far_footprint=9.0))
    foot = pose.inverse().apply(centres(mosaic).reshape(-1, 2))
    px = camera.intrinsics.px_from_rays(rays_from_floor(attitude, foot))
    outside = np.max([-px[:, 0], px[:, 0] - 159, 30 - px[:, 1], px[:, 1] - 100], axis=0)
    expected = (outside <= 0).reshape(mosaic.count.shape)
    # The place is interpolated to 0.02 cell: only cells whose centre is on the border may differ.
    differs = expected != (mosaic.count > 0)
    assert np.abs(outside.reshape(expected.shape)[differs]).max(initial=0.0) < 0.05
    assert expected.sum() > 3000


def test_obstacles_seen_by_a_minority_vanish():
    camera = make_camera(10.0)
    colour = colour_of(camera, 30)
    frames, rng = ring(9, camera, colour), np.random.default_rng(1)
    clean = mosaic_of(frames, camera)

    def spoil(index, image):
        spoiled = image.copy()
        if index % 3 == 0:
            row, column = rng.integers(10, 60, 2)
            spoiled[row : row + 50, column : column + 60] = (20, 240, 30)
        return spoiled

    mosaic = mosaic_of(frames, camera, change=spoil)
    inner = clean.count >= 7
    assert inner.sum() > 500
    error = np.abs(mosaic.floor[inner].astype(int) - clean.floor[inner])
    assert error.max() <= 3  # other views, other rounding; worst seen 2
    assert np.abs(mosaic.mean[inner].astype(int) - clean.floor[inner]).max() > 20


def test_mean_is_the_plain_mean_and_count_counts():
    camera = make_camera(0.0)
    frames = ring(5, camera, lambda points: np.full((len(points), 3), 100.0))
    mosaic = mosaic_of(frames, camera, change=lambda index, image: image + 20 * (index == 2))
    foot = [pose.inverse().apply(centres(mosaic).reshape(-1, 2)) for _, pose, _ in frames]
    px = [camera.intrinsics.px_from_rays(rays_from_floor(camera.mount.attitude, f)) for f in foot]
    sees = [((p >= 0) & (p <= (159, 119))).all(axis=1).reshape(mosaic.count.shape) for p in px]
    count = np.sum(sees, axis=0)
    assert (mosaic.count != count).mean() < 0.005  # centres on a picture's border
    same = (mosaic.count == count) & (count > 0)
    expected = 100 + 20 * sees[2][same] / count[same]
    assert np.abs(mosaic.mean[same] - expected[:, None]).max() <= 1.0
    assert (mosaic.uncertain == ((mosaic.count > 0) & (mosaic.count < 3))).all()
    assert not mosaic.floor[mosaic.count == 0].any()


def test_more_views_than_the_depth_still_count_and_the_finest_are_kept():
    low, high = make_camera(0.0), make_camera(0.0, height_m=0.8)
    views = [
        view_of(FrameId("A", i), high, Se2(0, 0, 0), np.full((120, 160, 3), 200, np.uint8))
        for i in range(7)
    ]
    views += [
        view_of(FrameId("B", i), low, Se2(0, 0, 0), np.full((120, 160, 3), 100, np.uint8))
        for i in range(4)
    ]
    options = MosaicOptions(compensate=False, max_depth=4)
    mosaic = build_mosaic(views, options)
    both = mosaic.count == 11
    assert both.sum() > 5000
    assert (mosaic.floor[both] == 100).all()
    assert np.abs(mosaic.mean[both] - (7 * 200 + 4 * 100) / 11).max() <= 0.5
    assert (mosaic.floor[mosaic.count == 7] == 200).all()


def test_order_of_views_threads_and_tiles_change_nothing():
    camera = make_camera(30.0)
    frames = ring(8, camera, colour_of(camera, 20))
    noise = np.random.default_rng(3).normal(0, 4, (8, 120, 160, 3))
    views = [
        view_of(frame, camera, pose, rounded(image * (1 + 0.05 * i) + noise[i]))
        for i, (frame, pose, image) in enumerate(frames)
    ]
    expected = build_mosaic(views, MosaicOptions(workers=1))
    for options in (MosaicOptions(workers=3), MosaicOptions(tile_cells=100, cache_bytes=1)):
        found = build_mosaic(views[3:] + views[:3], options)
        for layer in ("floor", "mean", "count"):
            assert np.array_equal(getattr(found, layer), getattr(expected, layer))


def test_anti_aliased_where_the_picture_is_finer():
    camera = make_camera(0.0)
    fine = np.random.default_rng(5).integers(0, 2, (120, 160, 1)) * np.array([255, 255, 255])
    view = view_of(FrameId("A", 0), camera, Se2(0, 0, 0.3), fine.astype(np.uint8))
    mosaic = build_mosaic([view], options_for(camera, 8.0))
    seen = mosaic.count > 0
    # The mean of 64 pixels of 0 or 255 has a deviation of 127.5 / 8 = 16; a single one 127.5.
    assert mosaic.floor[seen].std() < 22
    assert abs(mosaic.floor[seen].mean() - 127.5) < 6


@pytest.mark.parametrize("scale", [0.1, 100.0])
def test_scale_of_the_world_does_not_matter(scale):
    mosaics = []
    for factor in (1.0, scale):
        camera = make_camera(35.0, height_m=0.5 * factor)
        colour = colour_of(camera, 25)
        pose = Se2(0.2 * factor, 0.1 * factor, 0.8)
        image = rounded(picture(camera, camera.mount.attitude, pose, colour))
        mosaics.append(build_mosaic([view_of(FrameId("A", 0), camera, pose, image)]))
    a, b = mosaics
    assert b.m_per_px == pytest.approx(a.m_per_px * scale, rel=1e-9)
    assert (b.x_min_m, b.y_max_m) == pytest.approx((a.x_min_m * scale, a.y_max_m * scale))
    assert a.count.shape == b.count.shape
    assert (a.count != b.count).mean() < 0.002
    both = (a.count > 0) & (b.count > 0)
    assert np.abs(a.floor[both].astype(int) - b.floor[both]).max() <= 1


def test_cell_follows_the_finest_robot_and_the_coarse_one_still_shows():
    low, high = make_camera(0.0, height_m=0.1), make_camera(0.0, height_m=0.55)
    grey = np.full((120, 160, 3), 128, np.uint8)
    views = [
        view_of(FrameId("A", 0), low, Se2(0, 0, 0), grey),
        view_of(FrameId("B", 0), high, Se2(5, 0, 0), grey),
    ]
    mosaic = build_mosaic(views)
    assert mosaic.m_per_px == pytest.approx(0.1 / low.intrinsics.focal_px, rel=0.1)
    seen_m2 = (mosaic.count > 0).sum() * mosaic.m_per_px**2
    assert seen_m2 == pytest.approx((0.1**2 + 0.55**2) * 160 * 120 / 128**2, rel=0.05)


def test_a_mosaic_that_would_be_too_large_gets_larger_cells():
    camera = make_camera(0.0)
    grey = np.full((120, 160, 3), 128, np.uint8)
    views = [view_of(FrameId("A", i), camera, Se2(3.0 * i, 0, 0), grey) for i in range(2)]
    mosaic = build_mosaic(views, MosaicOptions(max_cells=50_000))
    assert 20_000 < mosaic.count.size <= 50_000
    assert (mosaic.count > 0).any(axis=0)[[0, -1]].all()


def test_progress_counts_to_its_end():
    camera = make_camera(0.0)
    frames = ring(3, camera, colour_of(camera, 20))
    views = [view_of(frame, camera, pose, rounded(image)) for frame, pose, image in frames]
    told = []
    build_mosaic(
        views, MosaicOptions(tile_cells=64), lambda done, total: told.append((done, total))
    )
    assert [done for done, _ in told] == list(range(1, told[0][1] + 1))
    assert told[0][1] > 3


def test_a_single_view_and_a_grey_one():
    camera = make_camera(0.0)
    view = view_of(FrameId("A", 4), camera, Se2(0, 0, 0), np.full((120, 160), 77, np.uint8))
    mosaic = build_mosaic([view])
    assert (mosaic.floor[mosaic.count == 1] == 77).all()
    assert mosaic.uncertain.sum() == (mosaic.count == 1).sum()


def view_with(tilt_deg=0.0, size=(160, 120), index=0):
    return view_of(
        FrameId("A", index),
        make_camera(tilt_deg),
        Se2(0, 0, 0),
        np.zeros((*size[::-1], 3), np.uint8),
    )


@pytest.mark.parametrize(
    ("views", "options", "message"),
    [
        ([], {}, "a mosaic needs at least one view, got none"),
        ([view_with(), view_with()], {}, "a mosaic takes every frame once, got A0 twice"),
        ([view_with()], {"m_per_px": 0.0}, "m_per_px must be positive, got 0"),
        ([view_with()], {"m_per_px": -1.0}, "m_per_px must be positive, got -1"),
        ([view_with()], {"max_depth": 0}, "max_depth must be 1 to 128, got 0"),
        ([view_with()], {"max_depth": 129}, "max_depth must be 1 to 128, got 129"),
        (
            [view_with()],
            {"m_per_px": 0.001, "max_cells": 1000},
            r"a mosaic of \d+ x \d+ cells of 0.001 m exceeds max_cells 1000: raise m_per_px",
        ),
        ([view_with(size=(80, 60))], {}, "picture A0 is 80 x 60 px, its camera's are 160 x 120"),
    ],
)
def test_refusals(views, options, message):
    with pytest.raises(ValueError, match=message):
        build_mosaic(views, MosaicOptions(**options))


def test_camera_that_sees_no_floor_is_refused():
    camera = make_camera(0.0)
    up = Attitude(math.radians(150), 0.0, 0.55)
    view = view_of(FrameId("A", 0), camera, Se2(0, 0, 0), np.zeros((120, 160, 3), np.uint8), up)
    with pytest.raises(ValueError, match="no view shows any floor below its horizon"):
        build_mosaic([view])
