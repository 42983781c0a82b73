"""Starts for planar pose graphs: chordal relaxation with full covariances, and a spanning tree.

The chordal start needs no guess: headings as free complex numbers (linear least squares) put back
on the unit circle, then positions and small turns together in one linear solution. Martinec and
Pajdla (2007); Carlone et al., "A linear approximation for graph-based SLAM" (2011) and
"Initialization techniques for 3D SLAM" (2015).
"""

from typing import NamedTuple

import numpy as np
from scipy.sparse.linalg import SuperLU

from groundfuse.backend import normal, planar, sparse
from groundfuse.backend.chain import spanning_forest
from groundfuse.backend.problem import Array, Indices, Linear, Problem, components


def held_poses(problem: Problem) -> Indices:
    """Return the first pose of every connected part: the gauge."""
    _, first = np.unique(components(problem), return_index=True)
    return np.sort(first).astype(np.int64)


def layout_of(problem: Problem) -> sparse.Pattern:
    """Return where the blocks of the problem go, the first pose of every part held."""
    return sparse.pattern(problem.num_poses, problem.a, problem.b, held_poses(problem))


class Start(NamedTuple):
    """Poses (n, 3) and the factor of their normal equations (None where nothing is free)."""

    poses: Array
    factor: SuperLU | None


def chordal(problem: Problem, layout: sparse.Pattern, fill: sparse.Filling | None = None) -> Start:
    """Return the chordal start; `fill` is that of 3 x 3 blocks.

    Raises:
        RuntimeError: the system is singular (not reached where every part has one held pose).
    """
    if not layout.size:
        return Start(np.zeros((problem.num_poses, 3)), None)
    covariance = planar.inverted(problem.information)
    theta_rad = _rotations(problem, layout, 1.0 / covariance[:, 2, 2])
    linear = _about_headings(problem, theta_rad)
    matrix, gradient = normal.of_linear(linear, problem.information, layout, fill)
    factor = sparse.factorised(matrix)
    step = sparse.spread(layout, factor.solve(-gradient.ravel()).reshape(-1, 3))
    place_m = planar.rotated(step[:, :2], theta_rad)
    poses = np.column_stack([place_m, planar.wrapped(theta_rad + step[:, 2])])
    return Start(poses, factor)


def _rotations(problem: Problem, layout: sparse.Pattern, weight: Array) -> Array:
    """Minimise the sum of weight |u_b - u_a exp(i theta)|^2; held poses are u = 1."""
    turn = np.exp(1j * problem.a_from_b[:, 2])
    diagonal = weight[:, None, None].astype(complex)
    matrix = sparse.assembled(
        sparse.filling(layout, 1), diagonal, (-weight * turn.conj())[:, None, None], diagonal
    )
    a_held = layout.rank[problem.a] < 0
    b_held = layout.rank[problem.b] < 0
    right = sparse.gathered(
        layout,
        np.where(b_held, weight * turn.conj(), 0.0),
        np.where(a_held, weight * turn, 0.0),
    )
    u = sparse.spread(layout, sparse.factorised(matrix).solve(right))
    return np.where(layout.rank >= 0, np.angle(u), 0.0)


def _about_headings(problem: Problem, theta_rad: Array) -> Linear:
    """Linearise in positions and small turns, with all positions at the origin.

    What a turn moves is taken from the measured steps: positions are not known yet.
    """
    measured = problem.a_from_b
    turned = theta_rad[problem.b] - theta_rad[problem.a]
    over = planar.wrapped(turned - measured[:, 2])
    short_m = planar.rotated(-measured[:, :2], -measured[:, 2])
    by_b = planar.turn(np.column_stack([np.zeros_like(short_m), over]))
    step = np.column_stack([measured[:, :2], turned])
    by_a = -by_b @ planar.adjoint(planar.inverse(step))
    return Linear(np.column_stack([short_m, over]), by_a, by_b)


def spanning_tree(problem: Problem) -> Array:
    """Return (n, 3) poses chained along the tree of edges that skips the fewest numbers.

    Where poses are numbered along a trajectory this is dead reckoning.
    """
    return spanning_forest(problem, np.abs(problem.b - problem.a).astype(float)).poses
