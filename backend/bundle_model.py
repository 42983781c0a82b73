"""How a floor point appears in a frame of the bundle, with every derivative.

The same camera as in `reprojection.py`, written out by components in compiled loops. With tilt a,
roll r, height h and the floor point q in `foot`, the camera sees X = -cos r qy + h sin r,
Y = -cos a qx + sin r sin a qy + h cos r sin a, Z = sin a qx + sin r cos a qy + h cos r cos a, ray
(X, Y) / Z; and with a focal length longer by the fraction f and a first distortion term larger by
k, the ray (1 + g f) (1 + k |ray|^2) ray. The gain g is 1 for a pinhole; behind a distorting lens a
ray grows by another multiple, a fisheye's by far.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from groundfuse.backend.bundle_landing_compiled import Landing, land
from groundfuse.backend.bundle_rows_compiled import (
    Lines,
    Placed,
    Sighted,
    residuals_of,
    write_lines,
)
from groundfuse.backend.bundle_tracks import Integers, Observations
from groundfuse.backend.side_by_side import side_by_side

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


def placed(state: State, robot_of: Integers) -> Placed:
    """List frames and floor points for the compiled loops."""
    angles = np.column_stack([state.pose[:, 2], state.attitude[:, :2]])
    turns = np.stack([np.cos(angles), np.sin(angles)], axis=2).reshape(-1, 6)
    heights = np.ascontiguousarray(state.attitude[:, 2])
    lenses = np.ascontiguousarray(state.shared[robot_of, 3:5])
    return Placed(state.pose, turns, heights, lenses, state.point)


def sighted(seen: Observations, part: slice) -> Sighted:
    """List some sightings for the compiled loops."""
    return Sighted(seen.frame[part], seen.point[part], seen.ray[part], seen.gain[part])


def residuals(seen: Observations, state: State, robot_of: Integers) -> tuple[Array, Mask]:
    """Measured minus predicted rays (n, 2), and whether a point is behind its camera (n,).

    The residual of such a point is 0.
    """
    result, unseen = np.empty((len(seen.frame), 2)), np.empty(len(seen.frame), dtype=np.bool_)
    at = placed(state, robot_of)

    def compare(part: slice) -> None:
        residuals_of(sighted(seen, part), at, NEAR, result[part], unseen[part])

    side_by_side(compare, len(result))
    return result, unseen


def derivatives(
    seen: Observations, state: State, robot_of: Integers, factor: Array, *, size: int, lens: bool
) -> Lines:
    """Differentiate predicted rays.

    Args:
        seen: sightings.
        state: where.
        robot_of: (frames,) robot of each frame.
        factor: (n,) of each sighting's derivatives.
        size: unknowns of a floor point, 2 or 3.
        lens: with those by focal length and distortion.

    Returns:
        (n, 2, 6) by a right perturbation of the pose, and by tilt, roll, height; (n, 2, size) by
        the floor point; (n, 2, 2), or none, by focal length and distortion.
    """
    count, at = len(seen.frame), placed(state, robot_of)
    shapes = (count, 2, 6), (count, 2, size), (count if lens else 0, 2, 2)
    lines = Lines(*map(np.empty, shapes))

    def differentiate(part: slice) -> None:
        mine = Lines(*(of[part] for of in lines))
        write_lines(sighted(seen, part), at, NEAR, factor[part], mine)

    side_by_side(differentiate, count)
    return lines


def floor_points(
    frame: Integers, ray: Array, gain: Array | None, state: State, robot_of: Integers
) -> Landing:
    """Intersect rays with the flat floor; `gain` (n,) as in `Sightings`."""
    count, at = len(frame), placed(state, robot_of)
    longer = np.ones(count) if gain is None else gain
    landing = Landing(*map(np.empty, ((count, 2), (count, 2, 2), (count, 2))))

    def drop(part: slice) -> None:
        mine = Landing(*(of[part] for of in landing))
        land(frame[part], ray[part], longer[part], at, NEAR, mine)

    side_by_side(drop, count)
    return landing


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
