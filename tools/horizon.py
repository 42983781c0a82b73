"""Refuse pictures that look over the horizon: above it there is no floor to fuse.

A pixel sees the floor where its ray, undistorted exactly, falls in the expected attitude. The rays
that do fill a half-plane of (x/z, y/z), so a picture's used part is free of sky if its border is.
Only the expected attitude counts, not its wobble: how far towards the horizon a picture is of use
is the matchers' affair, which stop at a limit of ground resolution long before it.
"""

import numpy as np
from numpy.typing import NDArray

from groundfuse.backend.measurement import Attitude
from groundfuse.frontend.arrays import Mask, Points
from groundfuse.frontend.camera import Camera
from groundfuse.frontend.overhead import floor_from_rays

NUM_COLUMNS = 65
MAX_BLIND = 0.5

Rows = NDArray[np.int_]


def border_rays(camera: Camera) -> Points:
    """Return the rays (n, 2) of the border of the used part; nan where a pixel has none."""
    rows = _rows(camera)
    ends = _rays(camera, rows[[0, -1]], NUM_COLUMNS)
    return np.concatenate([ends.reshape(-1, 2), _rays(camera, rows, 2).reshape(-1, 2)])


def check_lens(camera: Camera) -> None:
    """Refuse a distortion that can't be undone in most of the used part.

    Corners without a ray are legal: the round picture of a fisheye lens leaves them black.

    Raises:
        ValueError: more than half of the border and of the inside has no ray.
    """
    if not np.isnan(border_rays(camera)).any():
        return
    blind = float(np.isnan(_rays(camera, _rows(camera), NUM_COLUMNS)[:, :, 0]).mean())
    if blind > MAX_BLIND:
        raise ValueError(
            f"distortion_coefficients can't be undone in {100.0 * blind:.0f} % of the picture, "
            "check them and distortion_model"
        )


def check_horizon(camera: Camera, attitude: Attitude, border: Points) -> None:
    """Refuse an attitude in which the used part of the picture has pixels above the horizon.

    Args:
        camera: its intrinsics and used rows.
        attitude: expected tilt and roll.
        border: of `border_rays(camera)`, made once for all frames.

    Raises:
        ValueError: says which rows have sky and what to change.
    """
    if not np.isnan(border).any() and not _sky(attitude, border).any():
        return
    rows = _rows(camera)
    rays = _rays(camera, rows, NUM_COLUMNS)
    pixels = _sky(attitude, rays.reshape(-1, 2)).reshape(rays.shape[:2])
    sky: Mask = np.logical_or.reduce(pixels, axis=1)
    if not sky.any():
        return
    tilt, roll = np.degrees((attitude.tilt_rad, attitude.roll_rad))
    raise ValueError(
        f"with tilt {tilt:.4g} and roll {roll:.3g} deg the horizon is in the used part of the "
        f"picture: rows {rows[sky][0]} to {rows[sky][-1]} have sky; {_advice(rows, sky)}"
    )


def _advice(rows: Rows, sky: Mask) -> str:
    """Say what to leave out where the sky is at one end of the used rows only."""
    if sky[0] and not sky[-1]:
        return f"set first_row to {rows[sky][-1] + 1}, or check tilt_deg (0 looks straight down)"
    if sky[-1] and not sky[0]:
        return f"set last_row to {rows[sky][0] - 1}, or check tilt_deg (0 looks straight down)"
    return "check tilt_deg (0 looks straight down) and roll_deg"


def _sky(attitude: Attitude, rays: Points) -> Mask:
    """Whether rays (n, 2) miss the floor; a pixel without a ray doesn't count."""
    missed = np.isnan(floor_from_rays(attitude, rays)[:, 0]) & ~np.isnan(rays[:, 0])
    return np.asarray(missed, dtype=np.bool_)


def _rows(camera: Camera) -> Rows:
    first, last = camera.used_rows
    return np.arange(first, last + 1)


def _rays(camera: Camera, rows: Rows, num_columns: int) -> Points:
    """Return the rays (rows, columns, 2) of evenly spread pixels of the rows, ends included."""
    columns = np.linspace(0.0, camera.intrinsics.width_px - 1.0, num_columns)
    u, v = np.meshgrid(columns, rows.astype(np.float64))
    rays = camera.intrinsics.rays_from_px(np.stack([u.ravel(), v.ravel()], axis=1))
    return rays.reshape(len(rows), num_columns, 2)
