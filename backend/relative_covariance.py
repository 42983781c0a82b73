"""How surely two frames of a solved graph lie relative to each other.

The pose of b in a, perturbed on the right at both frames, moves by -Ad(b_from_a) d_a + d_b; the
joint covariance of d_a and d_b is six columns of the inverse of the sparse normal matrix, which is
factorised once for any number of pairs. No gauge enters: the held pose's own columns are zero.
"""

from collections.abc import Sequence

import numpy as np

from groundfuse.backend import planar, sparse
from groundfuse.backend.initial import layout_of
from groundfuse.backend.problem import Array, Problem, components
from groundfuse.backend.solver import normal_equations


def relative_covariances(
    problem: Problem, poses: Array, pairs: Sequence[tuple[int, int]]
) -> list[Array]:
    """Return (3, 3) covariances of the pose of b in a, tangent at b, for every pair (a, b).

    Args:
        problem: the edges of the solution.
        poses: (n, 3) the solution.
        pairs: pose numbers.

    Raises:
        ValueError: the two poses of a pair are not connected, or are the same.
        RuntimeError: the information matrix is singular.
    """
    part = components(problem)
    for a, b in pairs:
        if a == b or part[a] != part[b]:
            why = "the same pose" if a == b else "not connected"
            raise ValueError(f"poses {a} and {b} are {why}")
    layout = layout_of(problem)
    if not pairs:
        return []
    matrix, _ = normal_equations(problem, poses, layout)
    factor = sparse.factorised(matrix)
    found = []
    for a, b in pairs:
        joint = np.zeros((6, 6))
        rank = layout.rank[[a, b]]
        free = rank >= 0
        rows = (3 * rank[free, None] + np.arange(3)).ravel()
        unit = np.zeros((3 * layout.size, len(rows)))
        unit[rows, np.arange(len(rows))] = 1.0
        place = np.flatnonzero(np.repeat(free, 3))
        joint[np.ix_(place, place)] = factor.solve(unit)[rows]
        b_from_a = planar.between(poses[b], poses[a])
        moves = np.hstack([-planar.adjoint(b_from_a), np.eye(3)])
        covariance: Array = moves @ joint @ moves.T
        found.append((covariance + covariance.T) / 2.0)
    return found
