"""The renderer puts every floor point where the camera model says, anti-aliased, at any height."""

import math

import cv2
import numpy as np
import pytest

from groundfuse.backend.measurement import Attitude, Se2
from groundfuse.frontend.camera import Camera, Distortion, Intrinsics, Mount
from groundfuse.frontend.overhead import floor_from_rays, rays_from_floor
from groundfuse.tools.floor_raster import FloorRaster
from groundfuse.tools.floors import CELL_PER_HEIGHT
from groundfuse.tools.obstacles import Obstacle
from groundfuse.tools.render import World, render_view

WOBBLE = Attitude(0.01, 0.01, 0.001)
PINHOLE = Intrinsics(160, 120, 131.0, 130.0, 80.3, 58.9)
BARREL = Intrinsics(
    160, 120, 131.0, 131.0, 79.0, 60.2, Distortion.PLUMB_BOB, (-0.2, 0.05, 1e-3, -8e-4, 0.0)
)
FISHEYE = Intrinsics(
    160, 120, 131.0, 131.0, 79.0, 60.2, Distortion.EQUIDISTANT, (0.02, -0.005, 0.0, 0.0)
)
BACKGROUND, SWING = 128.0, 50.0
WAVE_CELLS = 96.0  # 72 mm under 0.55 m: 17 pixels of the small test pictures straight below
WINDOW = 20


def camera(lens, height_m=0.55, tilt_deg=33.0, roll_deg=0.0, place=Se2(0.1, -0.05, 0.2)):  # noqa: B008
    attitude = Attitude(math.radians(tilt_deg), math.radians(roll_deg), height_m)
    return Camera(lens, Mount(attitude, WOBBLE, place))


def waves(x_cells, y_cells):
    """A smooth floor that is known at every point; coordinates in cells."""
    k = 2.0 * np.pi / WAVE_CELLS
    return BACKGROUND + SWING * (np.cos(k * x_cells) + np.sin(0.9 * k * y_cells + 0.4))


def wave_texture(_seed, rect):
    x = np.arange(rect.x0, rect.x0 + rect.width) + 0.5
    y = np.arange(rect.y0, rect.y0 + rect.height) + 0.5
    grey = np.clip(np.rint(waves(x[None, :], y[:, None])), 0, 255).astype(np.uint8)
    return np.repeat(grey[:, :, None], 3, axis=2)


def expected_picture(cam, pose, cell_m):
    """The same view without any raster: the mean of 5 x 5 exact rays per pixel."""
    lens, sub = cam.intrinsics, (np.arange(5) - 2.0) / 5.0
    v, u = np.mgrid[0 : lens.height_px, 0 : lens.width_px].astype(float)
    total = np.zeros(u.shape)
    for du in sub:
        for dv in sub:
            rays = lens.rays_from_px(np.column_stack([(u + du).ravel(), (v + dv).ravel()]))
            foot = floor_from_rays(cam.mount.attitude, rays)
            x, y = (pose @ cam.mount.base_from_foot).apply(foot).T / cell_m
            total += waves(x, y).reshape(u.shape)
    return total / 25.0


def shift_px(found, expected):
    """Least-squares shift (u, v) of a window against the expected one, and its gain."""
    gv, gu = np.gradient(expected)
    inner = (slice(1, -1), slice(1, -1))
    columns = [-gu, -gv, expected - expected.mean(), np.ones_like(expected)]
    design = np.column_stack([c[inner].ravel() for c in columns])
    solved = np.linalg.lstsq(design, (found - expected)[inner].ravel(), rcond=None)[0]
    return solved[:2], 1.0 + solved[2]


# Rounding of the floor and of what is read to 8 bits: 0.3 grey each over 400 pixels against a
# gradient of 10 grey per pixel, 1.5e-3 px; rays linear between pixel centres, 4 x 3e-4 px for these
# short lenses; worst seen 0.005, and 0.010 where a wave is but 3 pixels long.  A slip of half a
# pixel, or of half a cell, would show as 0.1 and more.
TOLERANCE_PX = 0.02


@pytest.mark.parametrize(
    ("lens", "height_m", "tilt_deg", "roll_deg"),
    [
        (PINHOLE, 0.55, 33, 0),
        (PINHOLE, 0.1, 0, 1),
        (PINHOLE, 70, 20, 3),
        (BARREL, 0.55, 45, -2),
        (FISHEYE, 0.55, 45, -2),
    ],
)
def test_every_floor_point_is_where_the_camera_model_says(lens, height_m, tilt_deg, roll_deg):
    cam = camera(lens, height_m, tilt_deg, roll_deg)
    pose = Se2(-3.2 * height_m, 1.7 * height_m, 2.1)
    cell = CELL_PER_HEIGHT * height_m
    world = World(FloorRaster(wave_texture, 0, cell))
    found = render_view(world, cam, cam.mount.attitude, pose)
    assert found.shape == (120, 160, 3)
    expected = expected_picture(cam, pose, cell)
    for row in range(0, 120, WINDOW):
        for column in range(0, 160, WINDOW):
            part = (slice(row, row + WINDOW), slice(column, column + WINDOW))
            moved, gain = shift_px(found[part][..., 1], expected[part])
            assert np.abs(moved).max() < TOLERANCE_PX, (row, column, moved)
            assert 0.7 < gain < 1.02


def noise_texture(_seed, rect):
    rng = np.random.default_rng([rect.x0 % 2**32, rect.y0 % 2**32])
    return rng.integers(0, 256, (rect.height, rect.width, 3), dtype=np.uint8)


def test_far_floor_is_averaged_not_sampled():
    """White noise: a pixel at 74 deg covers 59 x 15 mm, 1500 cells, so it keeps 1/40 of it."""
    cam = camera(PINHOLE, tilt_deg=50.0)
    world = World(FloorRaster(noise_texture, 0, CELL_PER_HEIGHT * 0.55))
    picture = render_view(world, cam, cam.mount.attitude, Se2(0, 0, 0))
    # 74 grey / 40 = 1.9; nine rays that each read four cells leave 74 x 0.44 / 3 = 11.
    assert 0.5 < picture[:5].std() < 4.0
    assert abs(picture[:5].mean() - 127.5) < 3.0
    assert picture[-5:].std() > picture[:5].std() * 2


def test_the_floor_ends_in_its_mean_colour_over_the_horizon():
    cam = camera(PINHOLE, tilt_deg=89.0)
    floor = FloorRaster(
        lambda _s, r: np.full((r.height, r.width, 3), (10, 90, 200), np.uint8), 0, 1e-3
    )
    picture = render_view(World(floor), cam, cam.mount.attitude, Se2(0, 0, 0))
    np.testing.assert_allclose(picture, np.broadcast_to([10, 90, 200], picture.shape), atol=1.0)


def test_a_lens_without_a_ray_for_a_pixel_is_refused():
    lens = Intrinsics(160, 120, 60.0, 60.0, 79.5, 59.5, Distortion.PLUMB_BOB, (-0.6, 0.0, 0.0, 0.0))
    cam = camera(lens)
    with pytest.raises(ValueError, match="has no ray for some pixels"):
        render_view(
            World(FloorRaster(wave_texture, 0, 1e-3)), cam, cam.mount.attitude, Se2(0, 0, 0)
        )


GREY = FloorRaster(lambda _s, r: np.full((r.height, r.width, 3), 128, np.uint8), 0, 1e-3)


def project(cam, pose, points):
    """World points (n, 3) to pixels, by hand: a point at z is a floor point for height - z."""
    foot = (pose @ cam.mount.base_from_foot).inverse().apply(points[:, :2])
    attitude = cam.mount.attitude
    rays = [
        rays_from_floor(
            Attitude(attitude.tilt_rad, attitude.roll_rad, attitude.height_m - z), p[None]
        )
        for p, z in zip(foot, points[:, 2], strict=True)
    ]
    return cam.intrinsics.px_from_rays(np.vstack(rays))


@pytest.mark.parametrize("lens", [PINHOLE, BARREL, FISHEYE], ids=["pinhole", "barrel", "fisheye"])
@pytest.mark.parametrize("is_round", [False, True])
def test_a_solid_covers_its_own_outline(lens, is_round):
    """The drawn share of the picture is the area of the projected outline, at its place."""
    cam, pose = camera(lens, tilt_deg=40.0), Se2(1.0, 2.0, 0.7)
    spot = (pose @ cam.mount.base_from_foot).apply(np.array([[0.45, 0.06]]))[0]
    solid = Obstacle(Se2(*spot, 0.4), 0.08, 0.08 if is_round else 0.05, 0.12, (0, 0, 255), is_round)
    picture = render_view(World(GREY, (solid,)), cam, cam.mount.attitude, pose)
    turn = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    ring = 0.08 * np.column_stack([np.cos(turn), np.sin(turn)])
    if not is_round:
        ring = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * (0.08, 0.05)
    flat = solid.world_from_solid.apply(ring)
    outline = np.vstack([np.column_stack([flat, np.full(len(flat), z)]) for z in (0.0, 0.12)])
    hull = cv2.convexHull(project(cam, pose, outline).astype(np.float32))[:, 0]
    covered = 1.0 - picture[..., 0] / 128.0  # the solid has no blue
    moments = cv2.moments(hull)
    # A pixel's share is counted in ninths: over 150 border pixels 0.1 x sqrt(150) = 1.3 px.
    assert covered.sum() == pytest.approx(moments["m00"], abs=4.0, rel=0.01)
    v, u = np.mgrid[0:120, 0:160]
    centre = np.array([(covered * u).sum(), (covered * v).sum()]) / covered.sum()
    hull_centre = np.array([moments["m10"], moments["m01"]]) / moments["m00"]
    np.testing.assert_allclose(centre, hull_centre, atol=0.1)


def test_the_nearer_solid_hides_the_farther():
    cam, pose = camera(PINHOLE, tilt_deg=50.0, place=Se2(0, 0, 0)), Se2(0, 0, 0)
    near = Obstacle(Se2(0.5, 0, 0), 0.05, 0.1, 0.25, (0, 0, 255))
    far = Obstacle(Se2(0.7, 0, 0), 0.05, 0.1, 0.1, (0, 255, 0))
    picture = render_view(World(GREY, (far, near)), cam, cam.mount.attitude, pose)
    again = render_view(World(GREY, (near, far)), cam, cam.mount.attitude, pose)
    np.testing.assert_array_equal(picture, again)
    u, v = np.rint(project(cam, pose, np.array([[0.7, 0.0, 0.02], [0.5, 0.0, 0.25]]))).astype(int).T
    for row, column in zip(v, u, strict=True):
        assert picture[row, column, 2] > 80
        assert picture[row, column, 1] < 1


def test_a_solid_needs_a_size():
    with pytest.raises(ValueError, match=r"positive sizes, got -0\.1 m"):
        Obstacle(Se2(0, 0, 0), 0.1, 0.1, -0.1, (0, 0, 0))
