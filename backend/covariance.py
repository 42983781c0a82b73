"""Covariances of all poses of a graph from one sparse factorisation; numpy and scipy.

The entries of the inverse inside the fill pattern follow from the factor by a recursion from the
root of the elimination tree down (Takahashi 1973; Golub and Plemmons 1980): every front (a pose and
the later poses it is coupled to) takes their joint covariance from its parent's front.
One pass gives every pose; a pair of poses anywhere costs three columns of the inverse.
"""

from typing import NamedTuple

import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import SuperLU

from groundfuse.backend import sparse
from groundfuse.backend.problem import Array, Indices, Problem
from groundfuse.backend.solver import normal_equations


class Fronts(NamedTuple):
    """The elimination tree: per free node its parent (-1 at roots) and its later couplings."""

    parent: list[int]
    coupled: list[Indices]


def fronts(layout: sparse.Pattern) -> Fronts:
    """Eliminate symbolically in the layout's order."""
    ra, rb = layout.rank[layout.a], layout.rank[layout.b]
    inner = (ra >= 0) & (rb >= 0) & (ra != rb)
    low, high = np.minimum(ra, rb)[inner], np.maximum(ra, rb)[inner]
    order = np.lexsort((high, low))
    low, high = low[order], high[order]
    cut = np.searchsorted(low, np.arange(layout.size + 1))
    parent, coupled = [-1] * layout.size, []
    children: list[list[Indices]] = [[] for _ in range(layout.size)]
    for j in range(layout.size):
        below = [high[cut[j] : cut[j + 1]], *(c[1:] for c in children[j])]
        later = np.unique(np.concatenate(below)).astype(np.int64)
        coupled.append(later)
        children[j] = []
        if len(later):
            parent[j] = int(later[0])
            children[parent[j]].append(later)
    return Fronts(parent, coupled)


def marginals(problem: Problem, poses: Array, layout: sparse.Pattern) -> Array:
    """Return (n, 3, 3) covariances, each in its pose's right tangent; zero for held poses.

    Raises:
        RuntimeError: the information matrix is singular.
    """
    if not layout.size:
        return np.zeros((problem.num_poses, 3, 3))
    matrix, _ = normal_equations(problem, poses, layout)
    return sparse.spread(layout, _diagonal_blocks(layout, sparse.factorised(matrix)))


def _diagonal_blocks(layout: sparse.Pattern, factor: SuperLU) -> Array:
    """Return (size, 3, 3) diagonal blocks of the inverse."""
    lower = factor.L.tocsc()[factor.perm_r][:, factor.perm_c].tocsc()
    pivots = factor.U.diagonal()[factor.perm_c]
    tree = fronts(layout)
    joint: list[Array | None] = [None] * layout.size
    waiting = np.bincount([p for p in tree.parent if p >= 0], minlength=layout.size)
    blocks = np.empty((layout.size, 3, 3))
    for j in range(layout.size - 1, -1, -1):
        rows = np.concatenate([[j], tree.coupled[j]])
        front = _front(lower, pivots, j, rows, _of_parent(tree, joint, j))
        blocks[j] = front[:3, :3]
        joint[j] = front if waiting[j] else None
        above = tree.parent[j]
        if above >= 0:
            waiting[above] -= 1
            if not waiting[above]:
                joint[above] = None
    symmetric: Array = (blocks + np.swapaxes(blocks, 1, 2)) / 2.0
    return symmetric


def _of_parent(tree: Fronts, joint: list[Array | None], j: int) -> Array:
    """Return the joint covariance of the nodes that j is coupled to."""
    above = joint[tree.parent[j]] if tree.parent[j] >= 0 else None
    if above is None:
        return np.zeros((0, 0))
    members = np.concatenate([[tree.parent[j]], tree.coupled[tree.parent[j]]])
    place = np.searchsorted(members, tree.coupled[j])
    scalar = (3 * place[:, None] + np.arange(3)).ravel()
    selected: Array = above[np.ix_(scalar, scalar)]
    return selected


def _front(lower: csc_array, pivots: Array, j: int, rows: Indices, later: Array) -> Array:
    """Return the joint covariance of node j and the later nodes, from that of the later ones."""
    scalar = (3 * rows[:, None] + np.arange(3)).ravel()
    columns = np.zeros((len(scalar), 3))
    for k in range(3):
        begin, end = lower.indptr[3 * j + k], lower.indptr[3 * j + k + 1]
        place = np.searchsorted(scalar, lower.indices[begin:end])
        columns[place, k] = lower.data[begin:end]
    inverse = np.linalg.inv(columns[:3])
    gain = -columns[3:] @ inverse  # later <- own
    joint = np.empty((len(scalar), len(scalar)))
    joint[3:, 3:] = later
    joint[3:, :3] = later @ gain
    joint[:3, 3:] = joint[3:, :3].T
    joint[:3, :3] = gain.T @ joint[3:, :3] + inverse.T @ (inverse / pivots[3 * j : 3 * j + 3, None])
    return joint
