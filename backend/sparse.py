"""Sparse symmetric systems over pose graphs: ordering, assembly in blocks, factorisation.

The order of elimination is gtsam's METIS (nested dissection) on the graph of poses; SuperLU then
factorises in that order without pivoting. SuperLU's own orderings take minutes on 100,000 poses.
"""

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, diags_array
from scipy.sparse.linalg import SuperLU, splu

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


def elimination_order(num_nodes: int, a: Indices, b: Indices) -> Indices:
    """Return (n,) the position of every node in the order of elimination."""
    pairs = np.unique(np.stack([np.minimum(a, b), np.maximum(a, b)]), axis=1)
    nodes = np.unique(pairs)
    rank = np.full(num_nodes, -1, dtype=np.int64)
    if len(nodes) > 2:
        order = _metis(pairs)
        rank[order] = np.arange(len(order))
    lone = np.flatnonzero(rank < 0)
    rank[lone] = np.arange(num_nodes - len(lone), num_nodes)
    return rank


def _metis(pairs: Indices) -> Indices:
    graph = gtsam.NonlinearFactorGraph()
    nothing, unit = gtsam.Pose2(), gtsam.noiseModel.Unit.Create(3)
    for a, b in pairs.T.tolist():
        graph.push_back(gtsam.BetweenFactorPose2(a, b, nothing, unit))
    order = gtsam.Ordering.MetisNonlinearFactorGraph(graph)
    return np.array([order.at(k) for k in range(order.size())], dtype=np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class Pattern:
    """Where the blocks of a pose graph's normal matrix go; made once, filled many times.

    Attributes:
        size: number of free nodes.
        rank: (n,) position of each node among the free ones, -1 for a held node.
        a: (m,) first node of every edge.
        b: (m,) second node of every edge.
    """

    size: int
    rank: Indices
    a: Indices
    b: Indices


def pattern(num_nodes: int, a: Indices, b: Indices, held: Indices) -> Pattern:
    """Return the pattern with `held` nodes left out (the gauge)."""
    rank = elimination_order(num_nodes, a, b)
    free = np.ones(num_nodes, dtype=bool)
    free[held] = False
    order = np.argsort(rank)
    order = order[free[order]]
    rank = np.full(num_nodes, -1, dtype=np.int64)
    rank[order] = np.arange(len(order))
    return Pattern(len(order), rank, a, b)


def assembled(
    layout: Pattern, aa: Array, ab: Array, bb: Array, extra: Array | None = None
) -> csc_array:
    """Sum blocks (m, k, k) of all edges into a symmetric matrix of the free nodes.

    Args:
        layout: where they go.
        aa: block of the first node with itself.
        ab: block of the first node with the second.
        bb: block of the second node with itself.
        extra: (n, k, k) further diagonal blocks per node, or None.
    """
    k = aa.shape[1]
    ra, rb = layout.rank[layout.a], layout.rank[layout.b]
    places = [(ra, ra, aa), (rb, rb, bb), (ra, rb, ab), (rb, ra, np.conj(np.swapaxes(ab, 1, 2)))]
    if extra is not None:
        places.append((layout.rank, layout.rank, extra))
    inner = np.arange(k)
    rows, columns, values = [], [], []
    for row, column, block in places:
        kept = (row >= 0) & (column >= 0)
        shape = (int(kept.sum()), k, k)
        rows.append(np.broadcast_to((k * row[kept])[:, None, None] + inner[:, None], shape).ravel())
        columns.append(np.broadcast_to((k * column[kept])[:, None, None] + inner, shape).ravel())
        values.append(block[kept].ravel())
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return csc_array(coo_array(entries, shape=(k * layout.size,) * 2))


def diagonal(values: Array) -> csc_array:
    """Return a diagonal matrix."""
    return csc_array(diags_array(values))


def factorised(matrix: csc_array) -> SuperLU:
    """Factorise a symmetric matrix in its given order (RuntimeError where it is singular)."""
    return splu(
        matrix, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )


def gathered(layout: Pattern, a_part: Array, b_part: Array) -> Array:
    """Sum vectors (m, k) of both ends of all edges into (size, k)."""
    total = np.zeros((layout.size + 1, *a_part.shape[1:]), dtype=a_part.dtype)
    np.add.at(total, layout.rank[layout.a], a_part)  # rank -1, the held nodes, is the last row
    np.add.at(total, layout.rank[layout.b], b_part)
    return total[:-1]


def spread(layout: Pattern, values: Array) -> Array:
    """Return (n, k) values of all nodes from those of the free ones; 0 at the held ones."""
    whole = np.zeros((len(layout.rank), *values.shape[1:]), dtype=values.dtype)
    free = layout.rank >= 0
    whole[free] = values[layout.rank[free]]
    return whole
