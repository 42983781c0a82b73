"""A floor whose colour is a formula, and its exact pictures: truth for the mosaic's tests."""

import math

import numpy as np

from groundfuse.backend.measurement import IDENTITY, Attitude, FrameId, Se2
from groundfuse.frontend.camera import Camera, Distortion, Intrinsics, Mount
from groundfuse.frontend.mosaic import MosaicView
from groundfuse.frontend.overhead import floor_from_rays

SIGMA = Attitude(0.01, 0.003, 0.002)


def make_camera(tilt_deg=33.0, height_m=0.55, coefficients=(), offset=IDENTITY, size=(160, 120)):
    width, height = size
    focal = 0.8 * width
    lens = Intrinsics(
        width, height, focal, focal * 1.01, width / 2 - 1.3, height / 2 + 0.7,
        Distortion.PLUMB_BOB, coefficients,
    )  # fmt: skip
    return Camera(lens, Mount(Attitude(math.radians(tilt_deg), 0.0, height_m), SIGMA, offset))


def waves(points_m, length_m):
    """Colours (n, 3), 60 to 200, of floor points (n, 2): waves of about the given length."""
    x, y = (2 * math.pi / length_m * points_m).T
    return np.stack(
        [
            130 + 35 * np.sin(x + 0.3) + 35 * np.cos(0.8 * y),
            130 + 35 * np.sin(0.7 * x - 0.6 * y) + 35 * np.cos(0.9 * y + 0.4 * x),
            130 + 35 * np.cos(0.9 * x + 1.0) + 35 * np.sin(0.75 * y - 0.2 * x),
        ],
        axis=1,
    )


def floor_of_pixels(camera, attitude, team_from_base):
    """Floor points (rows * columns, 2) of all pixels; nan above the horizon."""
    lens = camera.intrinsics
    v, u = np.mgrid[0 : lens.height_px, 0 : lens.width_px]
    rays = lens.rays_from_px(np.column_stack([u.ravel(), v.ravel()]).astype(float))
    foot = floor_from_rays(attitude, rays)
    return (team_from_base @ camera.mount.base_from_foot).apply(foot)


def picture(camera, attitude, team_from_base, colour):
    """What the camera sees where the floor's colour is `colour(points)`, not yet rounded."""
    lens = camera.intrinsics
    colours = colour(floor_of_pixels(camera, attitude, team_from_base))
    return np.nan_to_num(colours, nan=128.0).reshape(lens.height_px, lens.width_px, 3)


def rounded(image):
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def view_of(frame, camera, team_from_base, image, attitude=None):
    attitude = attitude or camera.mount.attitude
    return MosaicView(frame, camera, attitude, team_from_base, lambda: image)


def ring(number, camera, colour, radius_m=0.15, robot="A"):
    """Views from around a spot, with their exact pictures (float)."""
    poses = [
        Se2(radius_m * math.cos(t), radius_m * math.sin(t), 1.7 * t)
        for t in 2 * math.pi * np.arange(number) / number
    ]
    return [
        (FrameId(robot, i), pose, picture(camera, camera.mount.attitude, pose, colour))
        for i, pose in enumerate(poses)
    ]


def centres(mosaic):
    """Floor points (rows, columns, 2) of a mosaic's cells, by the documented formula."""
    rows, columns = mosaic.count.shape
    row, column = np.mgrid[0:rows, 0:columns]
    x = mosaic.x_min_m + (column + 0.5) * mosaic.m_per_px
    y = mosaic.y_max_m - (row + 0.5) * mosaic.m_per_px
    return np.stack([x, y], axis=-1)


def shift_cells(mosaic, colour, layer=None):
    """How far (x, y) the mosaic is shifted against the floor, in cells, by least squares."""
    layer = mosaic.floor if layer is None else layer
    seen = mosaic.count > 0
    points, cell = centres(mosaic)[seen], mosaic.m_per_px
    steps = np.eye(2) * cell / 2
    slopes = [(colour(points + step) - colour(points - step)).ravel() for step in steps]
    error = (layer[seen] - colour(points)).ravel()
    found, *_ = np.linalg.lstsq(np.column_stack(slopes), error, rcond=None)
    return -found
