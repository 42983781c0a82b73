"""Planar rigid motions in bulk: arrays (n, 3) of x m, y m, theta rad; numpy only.

The same algebra as `measurement.Se2`, vectorised. Tangent vectors are (n, 3), order x y theta;
`log` and `exp` are those of the group, as gtsam's Pose2 uses them.
"""

import numpy as np
from numpy.typing import NDArray

from groundfuse.backend.measurement import Se2

Array = NDArray[np.float64]

SMALL_RAD = 1e-4  # below it the series is exact to 1e-17


def wrapped(theta_rad: Array) -> Array:
    """Return angles in [-pi, pi]; values already inside come back unchanged to the bit."""
    is_inside = np.abs(theta_rad) <= np.pi
    if np.all(is_inside):  # mostly, and remainders take long
        return np.array(theta_rad)
    turned = np.remainder(theta_rad + np.pi, 2.0 * np.pi) - np.pi
    inside: Array = np.where(is_inside, theta_rad, turned)
    return inside


def rotated(vectors: Array, theta_rad: Array) -> Array:
    """Turn (n, 2) vectors by (n,) angles."""
    c, s = np.cos(theta_rad), np.sin(theta_rad)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([c * x - s * y, s * x + c * y], axis=-1)


def _joined(translation: Array, theta_rad: Array) -> Array:
    joined: Array = np.concatenate([translation, wrapped(theta_rad)[..., None]], axis=-1)
    return joined


def compose(a_from_b: Array, b_from_c: Array) -> Array:
    """Return a_from_c."""
    turned = rotated(b_from_c[..., :2], a_from_b[..., 2])
    return _joined(a_from_b[..., :2] + turned, a_from_b[..., 2] + b_from_c[..., 2])


def inverse(a_from_b: Array) -> Array:
    """Return b_from_a."""
    return _joined(-rotated(a_from_b[..., :2], -a_from_b[..., 2]), -a_from_b[..., 2])


def between(map_from_a: Array, map_from_b: Array) -> Array:
    """Return a_from_b."""
    moved = rotated(map_from_b[..., :2] - map_from_a[..., :2], -map_from_a[..., 2])
    return _joined(moved, map_from_b[..., 2] - map_from_a[..., 2])


def _series(theta_rad: Array) -> tuple[Array, Array]:
    """Return (theta/2) / tan(theta/2), and (1 - that) / theta."""
    small = np.abs(theta_rad) < SMALL_RAD
    safe = np.where(small, 1.0, theta_rad)
    alpha = np.where(small, 1.0 - theta_rad**2 / 12.0, safe / 2.0 / np.tan(safe / 2.0))
    return alpha, np.where(small, theta_rad / 12.0, (1.0 - alpha) / safe)


def log(pose: Array) -> Array:
    """Return the tangent vectors whose `exp` are the poses."""
    x, y, theta = pose[..., 0], pose[..., 1], wrapped(pose[..., 2])
    alpha, _ = _series(theta)
    return np.stack([alpha * x + theta / 2 * y, alpha * y - theta / 2 * x, theta], axis=-1)


def exp(tangent: Array) -> Array:
    """Return the poses of the tangent vectors."""
    x, y, theta = tangent[..., 0], tangent[..., 1], tangent[..., 2]
    small = np.abs(theta) < SMALL_RAD
    safe = np.where(small, 1.0, theta)
    sine = np.where(small, 1.0 - theta**2 / 6.0, np.sin(safe) / safe)
    # 1 - cos as twice the square of a sine: the difference would keep half of the digits.
    versine = np.where(small, theta / 2.0 - theta**3 / 24.0, 2.0 * np.sin(safe / 2.0) ** 2 / safe)
    moved = np.stack([sine * x - versine * y, versine * x + sine * y], axis=-1)
    return _joined(moved, theta)


def adjoint(a_from_b: Array) -> Array:
    """Return (n, 3, 3): `a_from_b exp(d) = exp(adjoint d) a_from_b`."""
    c, s = np.cos(a_from_b[..., 2]), np.sin(a_from_b[..., 2])
    matrix = np.zeros((*a_from_b.shape[:-1], 3, 3))
    matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 0, 2] = c, -s, a_from_b[..., 1]
    matrix[..., 1, 0], matrix[..., 1, 1], matrix[..., 1, 2] = s, c, -a_from_b[..., 0]
    matrix[..., 2, 2] = 1.0
    return matrix


def by_right(tangent: Array) -> Array:
    """Return (n, 3, 3) the derivative of log(exp(tangent) exp(d)) by d at 0 (Jr inverse)."""
    x, y, theta = tangent[..., 0], tangent[..., 1], tangent[..., 2]
    alpha, beta = _series(theta)
    matrix = np.zeros((*tangent.shape[:-1], 3, 3))
    matrix[..., 0, 0] = matrix[..., 1, 1] = alpha
    matrix[..., 0, 1], matrix[..., 1, 0] = -theta / 2, theta / 2
    matrix[..., 0, 2] = beta * x + y / 2
    matrix[..., 1, 2] = beta * y - x / 2
    matrix[..., 2, 2] = 1.0
    return matrix


def turn(pose: Array) -> Array:
    """Return (n, 3, 3) the derivative of (x, y, theta) of pose exp(d) by d at 0."""
    matrix = adjoint(pose)
    matrix[..., :2, 2] = 0.0
    return matrix


def carried(by: Array, covariance: Array) -> Array:
    """Return by covariance by' for stacks of 3x3."""
    moved: Array = by @ covariance @ np.swapaxes(by, -1, -2)
    return moved


def mahalanobis2(tangent: Array, covariance: Array) -> Array:
    """Return (n,) squared lengths of (n, 3) vectors under (n, 3, 3) covariances."""
    solved = np.linalg.solve(covariance, tangent[..., None])[..., 0]
    squared: Array = np.einsum("...i,...i->...", tangent, solved)
    return squared


def inverted(matrices: Array) -> Array:
    """Return the inverses of symmetric matrices (..., k, k), symmetric to the bit."""
    inverses = np.asarray(np.linalg.inv(matrices), dtype=np.float64)
    symmetric: Array = (inverses + np.swapaxes(inverses, -1, -2)) / 2.0
    return symmetric


def stacked(poses: list[Se2]) -> Array:
    """Return (n, 3) of a list of poses."""
    return np.array([[p.x_m, p.y_m, p.theta_rad] for p in poses]).reshape(-1, 3)


def pose(row: Array) -> Se2:
    """Return one row as a pose."""
    return Se2(float(row[0]), float(row[1]), float(row[2]))
