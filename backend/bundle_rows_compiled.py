"""Derivatives of sightings and their floor points' elimination, compiled: a loop each.

Every sighting has lines of its own, so that threads may share a list; sums over the sightings of a
floor point run in their order. Arrays are by sighting, coordinate (or row of Q'), unknown.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from groundfuse.backend.bundle_plan import BLOCK
from groundfuse.backend.compiled import compiled, part

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]


class Sighted(NamedTuple):
    """Sightings: frame and floor point (n,), ray (n, 2), the focal length's gain (n,)."""

    frame: Integers
    point: Integers
    ray: Array
    gain: Array


class Placed(NamedTuple):
    """Frames and floor points: see `bundle_model.State`.

    Attributes:
        pose: (frames, 3).
        turn: (frames, 6) cosines and sines of heading, tilt and roll.
        height: (frames,).
        lens: (frames, 2) corrections of focal length and distortion.
        point: (points, 3).
    """

    pose: Array
    turn: Array
    height: Array
    lens: Array
    point: Array


class Lines(NamedTuple):
    """Derivatives: (n, 2, 6) by the frame, (n, 2, d) by the point, (n or 0, 2, 2) by the lens."""

    by_frame: Array
    by_point: Array
    by_lens: Array


@part
def _local(seen: Sighted, at: Placed, s: int, where: Array) -> float:
    """Write a floor point in `foot` and its height below the camera (3,); return its depth."""
    f, p = seen.frame[s], seen.point[s]
    turn_c, turn_s, tilt_c, tilt_s, roll_c, roll_s = at.turn[f]
    dx, dy = at.point[p, 0] - at.pose[f, 0], at.point[p, 1] - at.pose[f, 1]
    height = at.height[f] - at.point[p, 2]
    qx, qy = turn_c * dx + turn_s * dy, turn_c * dy - turn_s * dx
    where[0], where[1], where[2] = qx, qy, height
    depth: float = tilt_s * qx + tilt_c * (roll_s * qy + roll_c * height)
    return depth


@compiled
def residuals_of(seen: Sighted, at: Placed, near: float, residual: Array, unseen: Mask) -> None:
    """Compare rays with where their floor points appear; see `bundle_model`.

    Args:
        seen: sightings.
        at: frames and floor points.
        near: least depth in heights.
        residual: (n, 2) measured minus predicted, written; 0 where unseen.
        unseen: (n,) whether a point is behind its camera, written.
    """
    where = np.empty(3)
    for s in range(len(seen.frame)):
        f = seen.frame[s]
        _, _, tilt_c, tilt_s, roll_c, roll_s = at.turn[f]
        depth = _local(seen, at, s, where)
        qx, qy, height = where
        unseen[s] = not depth > near * height
        if unseen[s]:
            residual[s, 0] = residual[s, 1] = 0.0
            continue
        leaning = roll_s * qy + roll_c * height
        x, y = (roll_s * height - roll_c * qy) / depth, (tilt_s * leaning - tilt_c * qx) / depth
        factor = (1.0 + at.lens[f, 0] * seen.gain[s]) * (1.0 + at.lens[f, 1] * (x * x + y * y))
        residual[s, 0] = seen.ray[s, 0] - factor * x
        residual[s, 1] = seen.ray[s, 1] - factor * y


@part
def _bare(turn: Array, where: Array, per: float, line: Array) -> None:
    """Write a ray (line[:, 9]) and its derivatives by the frame (0 to 5) and the point (6 to 8).

    Args:
        turn: (6,) of the frame.
        where: (3,) of the point.
        per: 1 / depth, 0 where it is unseen.
        line: (2, 12).
    """
    turn_c, turn_s, ca, sa, cr, sr = turn
    qx, qy, height = where
    leaning = sr * qy + cr * height
    x, y = (sr * height - cr * qy) * per, (sa * leaning - ca * qx) * per
    line[0, 0], line[1, 0] = x * sa * per, (ca + y * sa) * per
    line[0, 1], line[1, 1] = (cr + x * sr * ca) * per, -sr * (sa - y * ca) * per
    line[0, 3], line[1, 3] = x * y, 1.0 + y * y
    line[0, 4], line[1, 4] = (sr * qy + cr * height) * per + ca * x * x, x * (ca * y - sa)
    line[0, 5], line[1, 5] = (sr - x * cr * ca) * per, cr * (sa - y * ca) * per
    line[0, 9], line[1, 9] = x, y
    for k in range(2):
        line[k, 2] = line[k, 1] * qx - line[k, 0] * qy
        line[k, 6] = line[k, 1] * turn_s - line[k, 0] * turn_c
        line[k, 7] = -line[k, 0] * turn_s - line[k, 1] * turn_c
        line[k, 8] = -line[k, 5]


@part
def _through_lens(focal: float, term: float, gain: float, line: Array) -> None:
    """Carry derivatives through a lens's corrections, and write those by them (line[:, 10:])."""
    x, y = line[0, 9], line[1, 9]
    radius2, longer = x * x + y * y, 1.0 + focal * gain
    bulge = 1.0 + term * radius2
    for k in range(9):
        pull = 2.0 * longer * term * (line[0, k] * x + line[1, k] * y)
        line[0, k] = longer * bulge * line[0, k] + pull * x
        line[1, k] = longer * bulge * line[1, k] + pull * y
    line[0, 10], line[1, 10] = x * bulge * gain, y * bulge * gain
    line[0, 11], line[1, 11] = x * longer * radius2, y * longer * radius2


@compiled
def write_lines(seen: Sighted, at: Placed, near: float, factor: Array, lines: Lines) -> None:
    """Differentiate sightings, each times a factor (n,); 0 by where an unseen point is."""
    line, where = np.zeros((2, 12)), np.empty(3)
    size, with_lens = lines.by_point.shape[2], len(lines.by_lens) > 0
    for s in range(len(seen.frame)):
        f = seen.frame[s]
        depth = _local(seen, at, s, where)
        per = 1.0 / depth if depth > near * where[2] else 0.0
        _bare(at.turn[f], where, per, line)
        focal, term = at.lens[f]
        if with_lens or focal != 0.0 or term != 0.0:
            _through_lens(focal, term, seen.gain[s], line)
        for k in range(2):
            for u in range(BLOCK):
                lines.by_frame[s, k, u] = line[k, u] * factor[s]
            for u in range(size):
                lines.by_point[s, k, u] = line[k, 6 + u] * factor[s]
            if with_lens:
                lines.by_lens[s, k, 0] = line[k, 10] * factor[s]
                lines.by_lens[s, k, 1] = line[k, 11] * factor[s]


@compiled
def point_roots(point: Integers, by_point: Array, relief: Array, tiny: float, root: Array) -> None:
    """Write the lower Cholesky factor (d, d, points) of each point's information.

    A direction that no sighting tells gets a tiny pivot instead of zero: no step goes there,
    because no derivative does.

    Args:
        point: (n,) of each sighting.
        by_point: (n, 2, d).
        relief: (points or 0,) derivative of the prior of a point's height.
        tiny: least pivot's square.
        root: zeros.
    """
    size = by_point.shape[2]
    for s in range(len(point)):
        for i in range(size):
            for j in range(i + 1):
                product = by_point[s, 0, i] * by_point[s, 0, j]
                root[i, j, point[s]] += product + by_point[s, 1, i] * by_point[s, 1, j]
    for p in range(root.shape[2]):
        for i in range(size):
            for j in range(i + 1):
                total = root[i, j, p]
                if i == 2 and j == 2:
                    total += relief[p] * relief[p]
                rest = total
                for k in range(j):
                    rest -= root[i, k, p] * root[j, k, p]
                if i == j:
                    root[i, i, p] = math.sqrt(max(rest, 1e-12 * total + tiny))
                else:
                    root[i, j, p] = rest / root[j, j, p]


@compiled
def project(point: Integers, lines: Lines, root: Array, basis: Array, taken: Lines) -> None:
    """Write what floor points take of their sightings.

    Args:
        point: (n,) of each sighting.
        lines: whitened derivatives.
        root: see `point_roots`.
        basis: (n, d, 2) Q' of every sighting: orthonormal over the sightings of a point, written.
        taken: Q'J (n, d, 6) by the frame and (n or 0, d, 2) by the lens, written.
    """
    size = basis.shape[1]
    for s in range(len(point)):
        p = point[s]
        for i in range(size):
            x, y = lines.by_point[s, 0, i], lines.by_point[s, 1, i]
            for k in range(i):
                x -= root[i, k, p] * basis[s, k, 0]
                y -= root[i, k, p] * basis[s, k, 1]
            x, y = x / root[i, i, p], y / root[i, i, p]
            basis[s, i, 0], basis[s, i, 1] = x, y
            for u in range(BLOCK):
                in_x, in_y = lines.by_frame[s, 0, u], lines.by_frame[s, 1, u]
                taken.by_frame[s, i, u] = x * in_x + y * in_y
            for u in range(taken.by_lens.shape[2] if len(taken.by_lens) else 0):
                in_x, in_y = lines.by_lens[s, 0, u], lines.by_lens[s, 1, u]
                taken.by_lens[s, i, u] = x * in_x + y * in_y


@compiled
def add_explained(basis: Array, error: Array, point: Integers, explained: Array) -> None:
    """Add Q'e of the sightings to their floor points' (points, d), in place."""
    for s in range(len(point)):
        for k in range(basis.shape[1]):
            explained[point[s], k] += basis[s, k, 0] * error[s, 0] + basis[s, k, 1] * error[s, 1]
