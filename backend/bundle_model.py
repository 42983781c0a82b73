"""How a floor point appears in a frame of the bundle, with every derivative; numpy only.

The same camera as in `reprojection.py`, written out by components because it runs over all
sightings at once. With tilt a, roll r, height h and the floor point q in `foot`, the camera sees
X = -cos r qy + h sin r, Y = -cos a qx + sin r sin a qy + h cos r sin a,
Z = sin a qx + sin r cos a qy + h cos r cos a, ray (X, Y) / Z; and with a focal length longer by the
fraction f and a first distortion term larger by k, the ray (1 + g f) (1 + k |ray|^2) ray. The gain
g is 1 for a pinhole; behind a distorting lens a ray grows by another multiple, a fisheye's by far.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from groundfuse.backend.bundle_compiled import residuals_of
from groundfuse.backend.bundle_tracks import Integers, Observations

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

NEAR = 1e-3
"""A point less deep than this share of the camera height does not count as seen."""


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """All unknowns.

    Attributes:
        pose: (frames, 3) x m, y m, theta rad of each foot in its component's frame.
        attitude: (frames, 3) tilt rad, roll rad, height m.
        shared: (robots, 6) per robot: mount offsets of tilt rad, roll rad, height (fraction); focal
            length (fraction), first distortion term; a spare that stays 0.
        point: (points, 3) floor points in their component's frame, m; z is 0 on a flat floor.
    """

    pose: Array
    attitude: Array
    shared: Array
    point: Array


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Some sightings as the model has them; all (n,), lengths in metres.

    Attributes:
        x: ray without lens corrections.
        y: the same.
        qx: floor point in `foot`.
        qy: the same.
        per_depth: 1 / Z; 0 where the point is behind the camera.
        turn: cosine and sine of the heading.
        tilt: cosine and sine.
        roll: cosine and sine.
        height: of the camera over the point.
    """

    x: Array
    y: Array
    qx: Array
    qy: Array
    per_depth: Array
    turn: tuple[Array, Array]
    tilt: tuple[Array, Array]
    roll: tuple[Array, Array]
    height: Array


@dataclass(frozen=True, slots=True, eq=False)
class Derivatives:
    """Derivatives of predicted rays; unknowns first, so that a frame's rows are a view.

    Attributes:
        by_frame: (6, n, 2) by a right perturbation of the pose, and by tilt, roll, height.
        by_point: (3, n, 2) by the floor point.
        by_lens: (2, n, 2) by focal length and distortion.
    """

    by_frame: Array
    by_point: Array
    by_lens: Array


def view_of(seen: Observations, state: State, part: slice) -> View:
    """Project the floor points of some sightings."""
    frame, point = seen.frame[part], seen.point[part]

    def turned(angle: Array) -> tuple[Array, Array]:
        return np.cos(angle)[frame], np.sin(angle)[frame]

    (turn_c, turn_s), tilt = turned(state.pose[:, 2]), turned(state.attitude[:, 0])
    roll = turned(state.attitude[:, 1])
    h = state.attitude[:, 2][frame] - state.point[:, 2][point]
    dx = state.point[:, 0][point] - state.pose[:, 0][frame]
    dy = state.point[:, 1][point] - state.pose[:, 1][frame]
    qx, qy = turn_c * dx + turn_s * dy, turn_c * dy - turn_s * dx
    leaning = roll[1] * qy + roll[0] * h
    depth = tilt[1] * qx + tilt[0] * leaning
    per = np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > NEAR * h)
    x, y = (roll[1] * h - roll[0] * qy) * per, (tilt[1] * leaning - tilt[0] * qx) * per
    return View(x, y, qx, qy, per, (turn_c, turn_s), tilt, roll, h)


def residuals(seen: Observations, state: State, robot_of: Integers) -> tuple[Array, Mask]:
    """Measured minus predicted rays (n, 2), and whether a point is behind its camera (n,).

    The residual of such a point is 0.
    """
    result, unseen = np.empty((len(seen.frame), 2)), np.empty(len(seen.frame), dtype=np.bool_)
    sightings = seen.frame, seen.point, seen.ray, seen.gain
    angles = np.column_stack([state.pose[:, 2], state.attitude[:, :2]])
    turns = np.stack([np.cos(angles), np.sin(angles)], axis=2).reshape(-1, 6)
    lenses = np.ascontiguousarray(state.shared[robot_of, 3:5])
    frames = state.pose, turns, np.ascontiguousarray(state.attitude[:, 2]), lenses
    residuals_of(sightings, frames, state.point, NEAR, result, unseen)
    return result, unseen


def derivatives(view: View) -> Derivatives:
    """Differentiate the projection, lens corrections apart."""
    x, y, per = view.x, view.y, view.per_depth
    (turn_c, turn_s), (ca, sa), (cr, sr) = view.turn, view.tilt, view.roll
    by_frame, by_point = np.empty((6, len(per), 2)), np.empty((3, len(per), 2))
    by_qx, by_qy = np.empty((len(per), 2)), np.empty((len(per), 2))
    by_qx[:, 0], by_qx[:, 1] = -x * sa * per, -(ca + y * sa) * per
    by_qy[:, 0], by_qy[:, 1] = -(cr + x * sr * ca) * per, sr * (sa - y * ca) * per
    by_frame[0], by_frame[1] = -by_qx, -by_qy
    by_frame[2] = by_qx * view.qy[:, None] - by_qy * view.qx[:, None]
    by_frame[3, :, 0], by_frame[3, :, 1] = x * y, 1.0 + y * y
    by_frame[4, :, 0] = (sr * view.qy + cr * view.height) * per + ca * x * x
    by_frame[4, :, 1] = x * (ca * y - sa)
    by_frame[5, :, 0], by_frame[5, :, 1] = (sr - x * cr * ca) * per, cr * (sa - y * ca) * per
    by_point[0] = by_qx * turn_c[:, None] - by_qy * turn_s[:, None]
    by_point[1] = by_qx * turn_s[:, None] + by_qy * turn_c[:, None]
    by_point[2] = -by_frame[5]
    return Derivatives(by_frame, by_point, np.zeros_like(by_point[:2]))


def through_lens(ideal: Derivatives, view: View, shared: Array, gain: Array) -> Derivatives:
    """Carry derivatives through focal length and distortion.

    `shared` (n, 6) and the focal length's `gain` (n,) are each sighting's.
    """
    ray = np.stack([view.x, view.y], axis=1)
    focal, term = 1.0 + shared[:, 3:4] * gain[:, None], shared[:, 4:5]
    radius2 = np.sum(ray * ray, axis=1, keepdims=True)
    bulge = 1.0 + term * radius2
    by_lens = np.stack([ray * bulge * gain[:, None], ray * focal * radius2])
    factor, gain = focal * bulge, 2.0 * focal * term * ray

    def carried(derivative: Array) -> Array:
        along = derivative[:, :, 0] * ray[:, 0] + derivative[:, :, 1] * ray[:, 1]
        through: Array = factor * derivative + gain * along[:, :, None]
        return through

    return Derivatives(carried(ideal.by_frame), carried(ideal.by_point), by_lens)


@dataclass(frozen=True, slots=True, eq=False)
class Landing:
    """Where rays meet the flat floor, in the component's frame.

    Attributes:
        point: (n, 2) m; nan above the horizon.
        by_ray: (n, 2, 2) its derivative by the ray.
        slope: (n, 2) horizontal way of the ray per height.
    """

    point: Array
    by_ray: Array
    slope: Array


def floor_points(
    frame: Integers, ray: Array, gain: Array | None, state: State, robot_of: Integers
) -> Landing:
    """Intersect rays with the flat floor; `gain` (n,) as in `Sightings`."""
    shared = state.shared[robot_of[frame]]
    radius2 = np.sum(ray * ray, axis=1, keepdims=True)
    longer = shared[:, 3:4] * (1.0 if gain is None else gain[:, None])
    ray = ray / ((1.0 + longer) * (1.0 + shared[:, 4:5] * radius2))
    ca, sa = np.cos(state.attitude[:, 0])[frame], np.sin(state.attitude[:, 0])[frame]
    cr, sr = np.cos(state.attitude[:, 1])[frame], np.sin(state.attitude[:, 1])[frame]
    h = state.attitude[:, 2][frame]
    x, y = ray.T
    lean = sa * y + ca
    fall = sr * x + cr * lean
    per = 1.0 / np.where(fall > NEAR, fall, np.nan)
    qx, qy = (sa - ca * y) * per, (sr * lean - cr * x) * per  # in heights
    by_x = np.stack([-qx * sr, -cr - qy * sr], axis=1) * (h * per)[:, None]
    by_y = np.stack([-ca - qx * cr * sa, sr * sa - qy * cr * sa], axis=1) * (h * per)[:, None]
    turn_c, turn_s = np.cos(state.pose[:, 2])[frame], np.sin(state.pose[:, 2])[frame]
    turn = np.stack([np.stack([turn_c, -turn_s], 1), np.stack([turn_s, turn_c], 1)], axis=1)
    slope = (turn @ np.stack([qx, qy], axis=1)[:, :, None])[:, :, 0]
    points = slope * h[:, None] + state.pose[frame, :2]
    return Landing(points, turn @ np.stack([by_x, by_y], axis=2), slope)


def moved(state: State, step: Array, point_step: Array) -> State:
    """Apply a step (frames + robots, 6) and a step of the points (n, 2 or 3)."""
    count = len(state.pose)
    c, s = np.cos(state.pose[:, 2]), np.sin(state.pose[:, 2])
    pose = state.pose + step[:count, :3]
    pose[:, 0] = state.pose[:, 0] + c * step[:count, 0] - s * step[:count, 1]
    pose[:, 1] = state.pose[:, 1] + s * step[:count, 0] + c * step[:count, 1]
    point = state.point.copy()
    point[:, : point_step.shape[1]] += point_step
    return State(pose, state.attitude + step[:count, 3:], state.shared + step[count:], point)
