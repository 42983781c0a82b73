"""Which overlaps agree, pair by pair: the same test as `consistency.chi2_between`, compiled."""

import math
from typing import Any

import numpy as np

from groundfuse.backend.compiled import compiled, part

SMALL_RAD = 1e-4  # as in `planar`
FULL_TURN_RAD = 2.0 * math.pi


@part
def _meeting(tree: tuple[Any, Any, Any], i: int, j: int) -> int:
    """Return the deepest common ancestor of two nodes of one tree."""
    depth, ancestors, _ = tree
    low, high = (i, j) if depth[i] >= depth[j] else (j, i)
    for k in range(len(ancestors) - 1, -1, -1):
        if depth[ancestors[k, low]] >= depth[high]:
            low = ancestors[k, low]
    for k in range(len(ancestors) - 1, -1, -1):
        if ancestors[k, low] != ancestors[k, high]:
            low, high = ancestors[k, low], ancestors[k, high]
    return int(low if low == high else ancestors[0, low])


@part
def _add_chain(tree: tuple[Any, Any, Any], i: int, j: int, total: Any) -> None:  # noqa: ANN401
    """Add the covariance of the chain from i to j to `total` (3, 3)."""
    spatial, met = tree[2], _meeting(tree, i, j)
    for r in range(3):
        for c in range(3):
            total[r, c] += spatial[i, r, c] + spatial[j, r, c] - 2.0 * spatial[met, r, c]


@part
def _squared(x: float, y: float, z: float, noise: Any) -> float:  # noqa: ANN401
    """Return the squared length of a vector under a covariance (3, 3), by Cramer's rule."""
    a, b, c = noise[0, 0], noise[0, 1], noise[0, 2]
    d, e, f = noise[1, 1], noise[1, 2], noise[2, 2]
    xx, xy, xz = d * f - e * e, c * e - b * f, b * e - c * d
    yy, yz, zz = a * f - c * c, b * c - a * e, a * d - b * b
    found = xx * x * x + yy * y * y + zz * z * z
    found += 2.0 * (xy * x * y + xz * x * z + yz * y * z)
    return float(found / (a * xx + b * xy + c * xz))


@compiled
def agreeing(
    edges: tuple[Any, Any, Any, Any],
    tree: tuple[Any, Any, Any],
    limit: float,
    agrees: Any,  # noqa: ANN401
) -> None:
    """Write which edges between two maps close a cycle with each other within `limit`.

    Args:
        edges: poses (m,) in F and in G, f_from_g (m, 3), noise (m, 3, 3); see `Links`.
        tree: depth (n,), ancestors (levels, n), spatial (n, 3, 3); see `Forest`.
        limit: chi2 up to which they agree.
        agrees: (m, m) flags, written.
    """
    a, b, f_from_g, noise = edges
    total, chain, by = np.empty((3, 3)), np.empty((3, 3)), np.zeros((3, 3))
    for i in range(len(a)):
        agrees[i, i] = True
        cos, sin = math.cos(f_from_g[i, 2]), math.sin(f_from_g[i, 2])
        back_x = -cos * f_from_g[i, 0] - sin * f_from_g[i, 1]
        back_y = sin * f_from_g[i, 0] - cos * f_from_g[i, 1]
        by[0, 0], by[0, 1], by[0, 2] = cos, sin, back_y
        by[1, 0], by[1, 1], by[1, 2] = -sin, cos, -back_x
        by[2, 2] = 1.0
        for j in range(i + 1, len(a)):
            for r in range(3):
                for c in range(3):
                    total[r, c] = noise[i, r, c] + noise[j, r, c]
                    chain[r, c] = 0.0
            _add_chain(tree, b[i], b[j], total)
            _add_chain(tree, a[i], a[j], chain)
            for r in range(3):
                for c in range(r, 3):
                    for k in range(3):
                        for m in range(3):
                            total[r, c] += by[r, k] * chain[k, m] * by[c, m]
            turn = f_from_g[j, 2] - f_from_g[i, 2]
            turn -= FULL_TURN_RAD * round(turn / FULL_TURN_RAD)
            dx, dy = f_from_g[j, 0] - f_from_g[i, 0], f_from_g[j, 1] - f_from_g[i, 1]
            x, y = cos * dx + sin * dy, cos * dy - sin * dx
            alpha = 1.0 - turn * turn / 12.0
            if abs(turn) >= SMALL_RAD:
                alpha = turn / 2.0 / math.tan(turn / 2.0)
            x, y = alpha * x + turn / 2.0 * y, alpha * y - turn / 2.0 * x
            agrees[i, j] = agrees[j, i] = _squared(x, y, turn, total) <= limit
