"""The pair fit's loops, compiled: transfer errors with derivatives, and the steps to their least.

The transfer is that of `backend.reprojection`, for points that all share two cameras. Parameters
are x, y, theta of foot b in foot a, then tilt, roll, height of a, and of b. Rows (n, 2, 12) hold a
residual's derivatives by these nine, those by the ray in a, and the residual itself.
"""

import math
from typing import NamedTuple

import numpy as np

from groundfuse.backend.compiled import compiled, part
from groundfuse.frontend.arrays import Floats, Mask, Points

BEHIND = 1e9
"""Residual of a point behind a camera: no pull, never an inlier."""
MAD_TO_SIGMA = 1.0 / 1.1774
"""Sigmas in the median of a Rayleigh-distributed length."""
CONVERGED = 1e-4
"""Squared length of a step in sigmas: a hundredth of a sigma."""
LEAST_PIVOT = 1e-16
"""Of a diagonal element; what is below is rounding."""


class Pairs(NamedTuple):
    """Correspondences: rays (n, 2) of a and b, and their standard deviations (n,)."""

    rays_a: Points
    rays_b: Points
    sigma_a: Floats
    sigma_b: Floats


class Asked(NamedTuple):
    """What the fit is asked for; see `FitOptions`."""

    robust_iterations: int
    final_iterations: int
    cauchy_sigmas: float
    gate_sigmas: float
    min_noise: float


@part
def _axes(tilt: float, roll: float, axes: Floats) -> None:
    """Write a camera's axes in foot, and their derivatives by tilt and by roll (3, 3, 3)."""
    ca, sa, cr, sr = math.cos(tilt), math.sin(tilt), math.cos(roll), math.sin(roll)
    axes[:] = 0.0
    axes[0, 0, 1], axes[0, 0, 2] = -ca, sa
    axes[0, 1, 0], axes[0, 1, 1], axes[0, 1, 2] = -cr, sr * sa, sr * ca
    axes[0, 2, 0], axes[0, 2, 1], axes[0, 2, 2] = -sr, -cr * sa, -cr * ca
    axes[1, 0, 1], axes[1, 0, 2] = sa, ca
    axes[1, 1, 1], axes[1, 1, 2] = sr * ca, -sr * sa
    axes[1, 2, 1], axes[1, 2, 2] = -cr * ca, cr * sa
    axes[2, 1, 0], axes[2, 1, 1], axes[2, 1, 2] = sr, cr * sa, cr * ca
    axes[2, 2, 0], axes[2, 2, 1], axes[2, 2, 2] = -cr, sr * sa, sr * ca


@part
def _floor(x: float, y: float, axes: Floats, height: float, out: Floats) -> bool:
    """Write a floor point and its derivatives by tilt, roll, height and by the ray (2, 6)."""
    fall = -(axes[0, 2, 0] * x + axes[0, 2, 1] * y + axes[0, 2, 2])
    if not fall > 0.0:
        return False
    for k in range(2):
        slope = (axes[0, k, 0] * x + axes[0, k, 1] * y + axes[0, k, 2]) / fall
        out[k, 0], out[k, 3] = height * slope, slope
        for turn in (1, 2):
            along = axes[turn, k, 0] * x + axes[turn, k, 1] * y + axes[turn, k, 2]
            down = axes[turn, 2, 0] * x + axes[turn, 2, 1] * y + axes[turn, 2, 2]
            out[k, turn] = height * (along + slope * down) / fall
        for side in (0, 1):
            out[k, 4 + side] = height * (axes[0, k, side] + slope * axes[0, 2, side]) / fall
    return True


@part
def _image(x: float, y: float, axes: Floats, height: float, out: Floats) -> bool:
    """Write a floor point's ray and its derivatives by tilt, roll, height and place (2, 6)."""
    depth = x * axes[0, 0, 2] + y * axes[0, 1, 2] - height * axes[0, 2, 2]
    if not depth > 0.0:
        return False
    for k in range(2):
        ray = (x * axes[0, 0, k] + y * axes[0, 1, k] - height * axes[0, 2, k]) / depth
        out[k, 0] = ray
        for turn in (1, 2):
            along = x * axes[turn, 0, k] + y * axes[turn, 1, k] - height * axes[turn, 2, k]
            deep = x * axes[turn, 0, 2] + y * axes[turn, 1, 2] - height * axes[turn, 2, 2]
            out[k, turn] = (along - ray * deep) / depth
        out[k, 3] = (ray * axes[0, 2, 2] - axes[0, 2, k]) / depth
        for side in (0, 1):
            out[k, 4 + side] = (axes[0, side, k] - ray * axes[0, side, 2]) / depth
    return True


@part
def _carried(ray: Floats, found: Floats, axes: Floats, work: Floats, rows: Floats) -> bool:
    """Write rows (2, 12) with the ray in b; false where a point is not in front of both cameras.

    `axes` (2, 3, 3, 3) are those of a and b; `work` (2, 2, 6) is overwritten.
    """
    in_a, in_b = work[0], work[1]
    if not _floor(ray[0], ray[1], axes[0], found[5], in_a):
        return False
    c, s = math.cos(found[2]), math.sin(found[2])
    dx, dy = in_a[0, 0] - found[0], in_a[1, 0] - found[1]
    x, y = c * dx + s * dy, c * dy - s * dx
    if not _image(x, y, axes[1], found[8], in_b):
        return False
    for k in range(2):
        by_x, by_y = in_b[k, 4], in_b[k, 5]
        rows[k, 0], rows[k, 1], rows[k, 2] = -by_x, -by_y, by_x * y - by_y * x
        along, across = by_x * c - by_y * s, by_x * s + by_y * c
        for j in range(3):
            rows[k, 3 + j] = along * in_a[0, 1 + j] + across * in_a[1, 1 + j]
            rows[k, 6 + j] = in_b[k, 1 + j]
        for j in range(2):
            rows[k, 9 + j] = along * in_a[0, 4 + j] + across * in_a[1, 4 + j]
        rows[k, 11] = in_b[k, 0]
    return True


@part
def _transfer(rays_a: Points, found: Floats, rows: Floats) -> None:
    axes, work = np.empty((2, 3, 3, 3)), np.empty((2, 2, 6))
    _axes(found[3], found[4], axes[0])
    _axes(found[6], found[7], axes[1])
    for i in range(len(rays_a)):
        if not _carried(rays_a[i], found, axes, work, rows[i]):
            rows[i] = math.nan


@compiled
def transfer_rows(rays_a: Points, found: Floats, rows: Floats) -> None:
    """Write rows (n, 2, 12) with the rays in b in place of residuals; nan where there is none."""
    _transfer(rays_a, found, rows)


@part
def _whiten(pairs: Pairs, rows: Floats, white: Floats) -> None:
    """Write inverse Cholesky factors (n, 3) of the transfer errors' covariances: 00, 10, 11."""
    for i in range(len(rows)):
        ux, uy, vx, vy = rows[i, 0, 9], rows[i, 0, 10], rows[i, 1, 9], rows[i, 1, 10]
        ahead, own = pairs.sigma_a[i] ** 2, pairs.sigma_b[i] ** 2
        first, second = ahead * (ux * ux + uy * uy) + own, ahead * (vx * vx + vy * vy) + own
        cross = ahead * (ux * vx + uy * vy)
        corner, last = math.sqrt(first), math.sqrt(second - cross * cross / first)
        known = math.isfinite(corner) and math.isfinite(last)
        white[i, 0] = 1.0 / corner if known else 1.0
        white[i, 1] = -cross / (first * last) if known else 0.0
        white[i, 2] = 1.0 / last if known else 1.0


@part
def _residuals(pairs: Pairs, white: Floats, rows: Floats, length: Floats) -> None:
    """Turn the rays in b into residuals, and whiten the rows; write the residuals' lengths."""
    for i in range(len(rows)):
        seen = math.isfinite(rows[i, 0, 11]) and math.isfinite(rows[i, 1, 11])
        for j in range(12):
            u, v = rows[i, 0, j], rows[i, 1, j]
            if j == 11:
                u, v = u - pairs.rays_b[i, 0], v - pairs.rays_b[i, 1]
            if not seen:
                u, v = (BEHIND, BEHIND) if j == 11 else (0.0, 0.0)
            rows[i, 0, j], rows[i, 1, j] = white[i, 0] * u, white[i, 1] * u + white[i, 2] * v
        length[i] = math.sqrt(rows[i, 0, 11] ** 2 + rows[i, 1, 11] ** 2)


@part
def _median(values: Floats, count: int) -> float:
    """Return the median of the first values, which are reordered; infinite of none (Hoare 1961)."""
    if count == 0:
        return math.inf
    low, high, middle = 0, count - 1, count // 2
    while low < high:
        pivot, i, j = values[middle], low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i, j = i + 1, j - 1
        low, high = (i if j < middle else low), (j if middle < i else high)
    below = values[middle] if count % 2 else values[0]
    for i in range(middle * (1 - count % 2)):
        below = max(below, values[i])
    return float((below + values[middle]) / 2.0)


@part
def _normal(rows: Floats, weight: Floats, known: Floats, hessian: Floats, step: Floats) -> None:
    """Write the normal equations (9, 9) and add their right side (9,) to that of the prior."""
    hessian[:] = 0.0
    for p in range(9):
        hessian[p, p] = known[p]
    for i in range(len(rows)):
        for k in range(2):
            for p in range(9):
                weighted = weight[i] * rows[i, k, p]
                step[p] -= weighted * rows[i, k, 11]
                for q in range(p + 1):
                    hessian[p, q] += weighted * rows[i, k, q]
    # The motion alone can be singular (one point): a prior wider than any floor keeps it solvable.
    least = (hessian[0, 0] + hessian[1, 1] + hessian[2, 2]) * 1e-15 + 1e-12
    for p in range(9):
        hessian[p, p] += least if p < 3 else 0.0
        for q in range(p):
            hessian[q, p] = hessian[p, q]


@part
def _solve(matrix: Floats, right: Floats) -> None:
    """Write the solution of a symmetric positive definite system over its right side."""
    lower = np.empty((9, 9))
    for p in range(9):
        for q in range(p + 1):
            left = matrix[p, q]
            for k in range(q):
                left -= lower[p, k] * lower[q, k]
            pivot = math.sqrt(max(left, LEAST_PIVOT * matrix[p, p]))
            lower[p, q] = pivot if p == q else left / lower[q, q]
    for p in range(9):
        for k in range(p):
            right[p] -= lower[p, k] * right[k]
        right[p] /= lower[p, p]
    for p in range(8, -1, -1):
        for k in range(p + 1, 9):
            right[p] -= lower[k, p] * right[k]
        right[p] /= lower[p, p]


@part
def _moved(found: Floats, step: Floats, hessian: Floats) -> float:
    """Take a step, the motion's part in b's axes; return its squared length in sigmas."""
    c, s = math.cos(found[2]), math.sin(found[2])
    found[0] += c * step[0] - s * step[1]
    found[1] += s * step[0] + c * step[1]
    for p in range(2, 9):
        found[p] += step[p]
    squared = 0.0
    for p in range(9):
        for q in range(9):
            squared += step[p] * hessian[p, q] * step[q]
    return squared


@part
def _robust_weights(length: Floats, noise: float, asked: Asked, weight: Floats) -> float:
    """Write Cauchy weights (n,); return the noise they are scaled with, which never grows."""
    for i in range(len(length)):
        weight[i] = length[i]
    median = _median(weight, len(length))
    noise = min(noise, max(asked.min_noise, median * MAD_TO_SIGMA))
    for i in range(len(length)):
        ratio = length[i] / (asked.cauchy_sigmas * noise)
        weight[i] = 1.0 / (1.0 + ratio * ratio) / (noise * noise)
    return noise


@part
def _gate(length: Floats, noise: float, asked: Asked, weight: Floats, inliers: Mask) -> float:
    """Mark the inliers, write their weights, and return the noise they show."""
    near = 0
    for i in range(len(length)):
        if length[i] < asked.gate_sigmas * noise:
            weight[near] = length[i]
            near += 1
    noise = max(asked.min_noise, _median(weight, near) * MAD_TO_SIGMA)
    square, kept = 0.0, 0
    for i in range(len(length)):
        inliers[i] = length[i] < asked.gate_sigmas * noise
        if inliers[i]:
            square, kept = square + length[i] * length[i], kept + 1
    # Tails are heavier than a Gaussian's: what counts for the covariance is the mean square, of
    # residual coordinates less the parameters that they determine.
    noise = max(noise, math.sqrt(square / max(1.0, 2.0 * kept - 9.0)))
    for i in range(len(length)):
        weight[i] = 1.0 / (noise * noise) if inliers[i] else 0.0
    return noise


@compiled
def fit_rows(
    pairs: Pairs, asked: Asked, mean: Floats, information: Floats, found: Floats, inliers: Mask
) -> tuple[float, bool, Floats]:
    """Return the noise, whether the last step was short, and its normal equations (9, 9).

    Args:
        pairs: correspondences.
        asked: see there.
        mean: (9,) parameters expected.
        information: (9,) their inverse variances; 0 for the motion.
        found: (9,) parameters; the result is written over the start.
        inliers: (n,) is written.
    """
    count = len(inliers)
    rows, white, length = np.empty((count, 2, 12)), np.empty((count, 3)), np.empty(count)
    weight, hessian, step = np.empty(count), np.eye(9), np.empty(9)
    noise, squared, steps, final, renew = math.inf, math.inf, 0, False, True
    while True:
        if not final and (squared < CONVERGED or steps == asked.robust_iterations):
            # The weights follow the fitted geometry once, then stay.
            final, renew, steps = True, True, 0
        _transfer(pairs.rays_a, found, rows)
        if renew:
            _whiten(pairs, rows, white)
        _residuals(pairs, white, rows, length)
        if not final:
            noise = _robust_weights(length, noise, asked, weight)
        elif renew:
            noise = _gate(length, noise, asked, weight, inliers)
        renew = False
        if final and steps == asked.final_iterations:
            break
        for p in range(9):
            step[p] = information[p] * (mean[p] - found[p])
        _normal(rows, weight, information, hessian, step)
        _solve(hessian, step)
        squared = _moved(found, step, hessian)
        steps += 1
        if final and squared < CONVERGED:
            break
    return noise, squared < CONVERGED, hessian
