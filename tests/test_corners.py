"""Corners lie where the floor has them, at one scale on the floor, as many as asked for."""

import math

import numpy as np
import pytest
from flat_world import CELL_M, SIDE_PX, painted_floor, photograph

from groundfuse.backend.measurement import IDENTITY, Attitude, Se2
from groundfuse.frontend.camera import Camera, Distortion, Intrinsics, Mount
from groundfuse.frontend.corners import CornerOptions, find_corners
from groundfuse.frontend.overhead import floor_from_rays, rays_from_floor
from groundfuse.frontend.overhead_view import overhead_grid

SIGMA = Attitude(0.01, 0.003, 0.002)
TILTED = Attitude(math.radians(40), math.radians(2), 0.55)


def camera_of(attitude=TILTED, focal_px=260.0, size=(320, 240), **rows):
    lens = Intrinsics(
        *size,
        focal_px,
        focal_px,
        size[0] / 2 - 0.5,
        size[1] / 2 - 0.5,
        Distortion.PLUMB_BOB,
        (-0.1, 0.02, 0.0, 0.0, 0.0),
    )
    return Camera(lens, Mount(attitude, SIGMA), **rows)


def found(floor, camera, attitude=TILTED, options=None, world_from_foot=IDENTITY):
    grey = photograph(floor, camera, attitude, world_from_foot)[:, :, 1].copy()
    grid = overhead_grid(camera, attitude)
    return find_corners(grey, camera, attitude, grid, options), grid


def dots(spacing_px=30):
    """Round dots, 1 cell of sigma, at every 30th cell each way from the origin."""
    away = (np.arange(SIDE_PX) - SIDE_PX // 2 + spacing_px // 2) % spacing_px - spacing_px // 2
    profile = np.exp(-0.5 * away**2)
    board = 60.0 + 160.0 * profile[:, None] * profile
    return np.repeat(board[:, :, None], 3, axis=2).astype(np.float32)


@pytest.mark.parametrize("focal_px", [260.0, 900.0])
def test_dots_are_found_where_they_are(focal_px):
    camera = camera_of(focal_px=focal_px, size=(320, 240) if focal_px < 500 else (800, 600))
    options = CornerOptions(max_corners=40)
    corners, grid = found(dots(), camera, options=options)
    floor = floor_from_rays(TILTED, camera.intrinsics.rays_from_px(corners.px))
    spacing = 30 * CELL_M
    nearest = np.round(floor / spacing) * spacing
    truth_px = camera.intrinsics.px_from_rays(rays_from_floor(TILTED, nearest))
    off_px = np.hypot(*(corners.px - truth_px).T)
    assert len(off_px) == 40
    # On a dot about as large as the scale the response is flat: nine in ten within 0.53 scales
    # seen, half within 0.06; a wrong octave or strip would be off by whole pixels.
    off = off_px / (corners.sigma_px / 0.16)
    assert np.median(off) < 0.15
    assert np.quantile(off, 0.9) < 0.8
    assert np.hypot(*floor.T).max() < grid.far_m * 1.02


def test_the_scale_follows_the_floor():
    camera = camera_of(focal_px=900.0, size=(800, 600))
    corners, grid = found(painted_floor(0), camera)
    floor = floor_from_rays(TILTED, camera.intrinsics.rays_from_px(corners.px))
    ends = np.stack(
        [
            floor_from_rays(TILTED, camera.intrinsics.rays_from_px(corners.px + step))
            for step in ((0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5))
        ]
    )
    by_u, by_v = ends[0] - ends[1], ends[2] - ends[3]
    length_m = np.sqrt(np.abs(by_u[:, 0] * by_v[:, 1] - by_u[:, 1] * by_v[:, 0]))
    scale_m = corners.sigma_px / 0.16 * length_m
    wanted = 1.1 * grid.m_per_px
    # Two scales per octave: off by at most a quarter of an octave.
    assert np.abs(np.log2(scale_m / wanted)).max() < 0.26
    near, far = np.hypot(*floor.T) < 0.35, np.hypot(*floor.T) > 0.7
    assert np.median(corners.sigma_px[near]) > 1.5 * np.median(corners.sigma_px[far])


def test_near_and_far_floor_get_their_share():
    camera = camera_of(focal_px=900.0, size=(800, 600))
    options = CornerOptions(max_corners=150)
    corners, _ = found(painted_floor(0), camera, options=options)
    everywhere, _ = found(painted_floor(0), camera, options=CornerOptions(max_corners=5000))
    distance, all_distances = (
        np.hypot(*floor_from_rays(TILTED, camera.intrinsics.rays_from_px(c.px)).T)
        for c in (corners, everywhere)
    )
    # Strengths compare across scales: the strongest are spread as all are; chance leaves
    # 0.5 / sqrt(150) = 0.04 of the half, unequal blur some more; four floors 0.41 to 0.54.
    assert 0.3 < (distance < np.median(all_distances)).mean() < 0.7


def test_corners_are_found_again_from_elsewhere():
    camera = camera_of(focal_px=500.0, size=(640, 480))
    moved = Se2(0.3, 0.05, 0.5)
    options = CornerOptions(max_corners=400)
    floor = painted_floor(1)
    here, there = (
        found(floor, camera, options=options, world_from_foot=pose)[0] for pose in (IDENTITY, moved)
    )
    world, other = (
        pose.apply(floor_from_rays(TILTED, camera.intrinsics.rays_from_px(corners.px)))
        for pose, corners in ((IDENTITY, here), (moved, there))
    )
    from_there = rays_from_floor(TILTED, moved.inverse().apply(world))
    px = camera.intrinsics.px_from_rays(from_there)
    grid = overhead_grid(camera, TILTED)
    near = np.hypot(*moved.inverse().apply(world).T) < grid.far_m
    seen = near & (px > 6).all(axis=1) & (px < (633, 473)).all(axis=1)
    distance = np.linalg.norm(world[seen][:, None] - other, axis=2).min(axis=1)
    # Three quarters seen; a corner by chance within 4 mm: 400 corners on 0.6 m^2, 3 %.
    assert (distance < 0.004).mean() > 0.5


def test_only_rows_in_use_are_searched():
    camera = camera_of(first_row=60, last_row=200)
    corners, _ = found(painted_floor(2), camera)
    assert corners.px[:, 1].min() > 59
    assert corners.px[:, 1].max() < 201


def test_as_many_as_asked_for_and_the_strongest():
    camera, floor = camera_of(), painted_floor(3)
    few = found(floor, camera, options=CornerOptions(max_corners=50))[0]
    many = found(floor, camera, options=CornerOptions(max_corners=200))[0]
    some = found(floor, camera, options=CornerOptions(per_square_height=1.0, min_corners=80))[0]
    assert [len(corners.px) for corners in (few, some, many)] == [50, 80, 200]
    np.testing.assert_array_equal(few.px, many.px[:50])


def test_corners_keep_their_distance():
    corners, _ = found(painted_floor(4), camera_of(), options=CornerOptions(spacing_px=6))
    fine = corners.sigma_px <= 0.16 * 1.5
    px = corners.px[fine]
    distance = np.linalg.norm(px[:, None] - px, axis=2) + 99.0 * np.eye(len(px))
    # Strips of neighbouring scales do not see each other: a few pairs may be closer.
    assert (distance.min(axis=1) > 5.0).mean() > 0.9


def test_an_even_floor_has_none():
    even = np.full((SIDE_PX, SIDE_PX, 3), 90.0, np.float32)
    corners, _ = found(even, camera_of())
    assert len(corners.px) == len(corners.sigma_px) == 0
