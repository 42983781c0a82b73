"""Where a floor point seen in camera a appears in camera b, with every derivative; numpy only.

The measurement model shared by the pair fit and the planar bundle. Frames: `foot` is on the floor
straight below a camera, x along its heading, y left, z up. With tilt a (from nadir) and roll r the
camera's axes in `foot` are R = Rx(r) B(a), B(a) = [[0, -cos a, sin a], [-1, 0, 0],
[0, -sin a, -cos a]]. A ray (x, y, 1) meets the floor at p = -h d_xy / d_z, d = R (x, y, 1).
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Transfer(NamedTuple):
    """Predicted rays in b and their derivatives.

    Attributes:
        rays_b: (n, 2) predicted rays; nan where the point is not in front of both cameras.
        by_pose: (n, 2, 3) by a right perturbation (x y theta) of `a_from_b`, foot to foot.
        by_attitude_a: (n, 2, 3) by tilt, roll, height of a.
        by_attitude_b: (n, 2, 3) by tilt, roll, height of b.
        by_rays_a: (n, 2, 2) by the measured ray in a.
    """

    rays_b: Array
    by_pose: Array
    by_attitude_a: Array
    by_attitude_b: Array
    by_rays_a: Array


def _axes(tilt: Array, roll: Array) -> tuple[Array, Array, Array]:
    """Camera axes in foot (n, 3, 3), and their derivatives by tilt and by roll."""
    ca, sa, cr, sr = np.cos(tilt), np.sin(tilt), np.cos(roll), np.sin(roll)
    zero = np.zeros_like(ca)

    def stack(rows: list[list[Array]]) -> Array:
        return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)

    axes = stack([[zero, -ca, sa], [-cr, sr * sa, sr * ca], [-sr, -cr * sa, -cr * ca]])
    by_tilt = stack([[zero, sa, ca], [zero, sr * ca, -sr * sa], [zero, -cr * ca, cr * sa]])
    by_roll = stack([[zero, zero, zero], [sr, cr * sa, cr * ca], [-cr, sr * sa, sr * ca]])
    return axes, by_tilt, by_roll


def _floor(rays: Array, attitude: Array) -> tuple[Array, Array, Array]:
    """Floor points (n, 2), derivatives by attitude (n, 2, 3) and by ray (n, 2, 2)."""
    axes, by_tilt, by_roll = _axes(attitude[:, 0], attitude[:, 1])
    homogeneous = np.column_stack([rays, np.ones(len(rays))])[:, :, None]
    direction = (axes @ homogeneous)[:, :, 0]
    fall = np.where(direction[:, 2] < 0.0, -direction[:, 2], np.nan)[:, None]
    slope = direction[:, :2] / fall
    height = attitude[:, 2:]

    def moved(change: Array) -> Array:
        return height * (change[:, :2] + slope * change[:, 2:]) / fall

    by_attitude = np.stack(
        [moved((by_tilt @ homogeneous)[:, :, 0]), moved((by_roll @ homogeneous)[:, :, 0]), slope],
        axis=2,
    )
    by_ray = np.stack([moved(axes[:, :, 0]), moved(axes[:, :, 1])], axis=2)
    return height * slope, by_attitude, by_ray


def _image(floor: Array, attitude: Array) -> tuple[Array, Array, Array]:
    """Rays (n, 2), derivatives by attitude (n, 2, 3) and by floor point (n, 2, 2)."""
    axes, by_tilt, by_roll = _axes(attitude[:, 0], attitude[:, 1])
    below = np.column_stack([floor, -attitude[:, 2]])[:, None, :]
    in_cam = (below @ axes)[:, 0, :]
    depth = np.where(in_cam[:, 2] > 0.0, in_cam[:, 2], np.nan)[:, None]
    rays = in_cam[:, :2] / depth

    def moved(change: Array) -> Array:
        moved_rays: Array = (change[:, :2] - rays * change[:, 2:]) / depth
        return moved_rays

    by_attitude = np.stack(
        [
            moved((below @ by_tilt)[:, 0, :]),
            moved((below @ by_roll)[:, 0, :]),
            moved(-axes[:, 2, :]),
        ],
        axis=2,
    )
    by_floor = np.stack([moved(axes[:, 0, :]), moved(axes[:, 1, :])], axis=2)
    return rays, by_attitude, by_floor


def transfer(rays_a: Array, attitude_a: Array, a_from_b: Array, attitude_b: Array) -> Transfer:
    """Carry rays of camera a over the floor into camera b (paper.md, "The right formulas").

    Args:
        rays_a: (n, 2) undistorted rays x/z, y/z in camera a.
        attitude_a: (n, 3) or (3,) tilt rad, roll rad, height m of a.
        a_from_b: (n, 3) or (3,) pose x m, y m, theta rad of foot b in foot a.
        attitude_b: (n, 3) or (3,) tilt rad, roll rad, height m of b.
    """
    shape = (len(rays_a), 3)
    attitude_a = np.broadcast_to(attitude_a, shape)
    attitude_b = np.broadcast_to(attitude_b, shape)
    pose = np.broadcast_to(a_from_b, shape)
    in_a, by_attitude_a, by_ray = _floor(rays_a, attitude_a)
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    turn = np.stack([np.stack([c, s], axis=-1), np.stack([-s, c], axis=-1)], axis=-2)
    in_b = (turn @ (in_a - pose[:, :2])[:, :, None])[:, :, 0]
    rays_b, by_attitude_b, by_floor = _image(in_b, attitude_b)
    by_pose = np.zeros((len(rays_a), 2, 3))
    by_pose[:, 0, 0] = by_pose[:, 1, 1] = -1.0
    by_pose[:, 0, 2], by_pose[:, 1, 2] = in_b[:, 1], -in_b[:, 0]
    by_in_a = by_floor @ turn
    return Transfer(
        rays_b, by_floor @ by_pose, by_in_a @ by_attitude_a, by_attitude_b, by_in_a @ by_ray
    )
