"""Starts for planar pose graphs: chordal relaxation with full covariances, and a spanning tree.

The chordal start needs no guess: rotations as free complex numbers (linear least squares) put back
on the unit circle, then translations with the rotations held. Carlone et al., "Initialization
techniques for 3D SLAM" (2015); Martinec and Pajdla (2007).
"""

import numpy as np

from groundfuse.backend import planar, sparse
from groundfuse.backend.chain import spanning_forest
from groundfuse.backend.problem import Array, Indices, Problem, components


def held_poses(problem: Problem) -> Indices:
    """Return the first pose of every connected part: the gauge."""
    _, first = np.unique(components(problem), return_index=True)
    return np.sort(first).astype(np.int64)


def layout_of(problem: Problem) -> sparse.Pattern:
    """Return where the blocks of the problem go, the first pose of every part held."""
    return sparse.pattern(problem.num_poses, problem.a, problem.b, held_poses(problem))


def chordal(problem: Problem, layout: sparse.Pattern) -> Array:
    """Return (n, 3) poses with the held ones at the origin.

    Raises:
        RuntimeError: the system is singular (not reached where every part has one held pose).
    """
    covariance = planar.inverted(problem.information)
    theta_rad = _rotations(problem, layout, 1.0 / covariance[:, 2, 2])
    position_m = _translations(problem, layout, theta_rad, covariance[:, :2, :2])
    return np.column_stack([position_m, theta_rad])


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
    if not layout.size:
        return np.zeros(problem.num_poses)
    u = sparse.spread(layout, sparse.factorised(matrix).solve(right))
    return np.where(layout.rank >= 0, np.angle(u), 0.0)


def _translations(
    problem: Problem, layout: sparse.Pattern, theta_rad: Array, covariance: Array
) -> Array:
    """Minimise over the positions with all headings held."""
    if not layout.size:
        return np.zeros((problem.num_poses, 2))
    turned = theta_rad[problem.a] + problem.a_from_b[:, 2]
    axes = np.stack([planar.rotated(np.eye(2)[k], turned) for k in range(2)], axis=-1)
    weight = axes @ planar.inverted(covariance) @ np.swapaxes(axes, 1, 2)
    step = planar.rotated(problem.a_from_b[:, :2], theta_rad[problem.a])
    push = (weight @ step[:, :, None])[:, :, 0]
    matrix = sparse.assembled(sparse.filling(layout, 2), weight, -weight, weight)
    right = sparse.gathered(layout, -push, push)
    solved = sparse.factorised(matrix).solve(right.ravel()).reshape(-1, 2)
    return sparse.spread(layout, solved)


def spanning_tree(problem: Problem) -> Array:
    """Return (n, 3) poses chained along the tree of edges that skips the fewest numbers.

    Where poses are numbered along a trajectory this is dead reckoning.
    """
    return spanning_forest(problem, np.abs(problem.b - problem.a).astype(float)).poses
