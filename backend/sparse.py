"""Sparse symmetric systems over pose graphs: ordering, assembly in blocks, factorisation.

The order of elimination is gtsam's on the graph of poses: COLAMD, or METIS (nested dissection) for
large graphs. SuperLU then factorises in that order without pivoting; its own orderings take minutes
on 100,000 poses, and panel sizes other than its default corrupt memory.
"""

import math
from dataclasses import dataclass
from typing import Any, Self

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, diags_array
from scipy.sparse.linalg import SuperLU, splu

Array = NDArray[np.float64]
Blocks = NDArray[Any]  # float64 or complex128
Indices = NDArray[np.int64]

DISSECT = 30_000  # edges from which nested dissection pays: it takes longer and saves fill


def elimination_order(num_nodes: int, a: Indices, b: Indices) -> Indices:
    """Return (n,) the position of every node in the order of elimination."""
    key = np.unique(np.minimum(a, b) * num_nodes + np.maximum(a, b))
    low, high = np.divmod(key, max(num_nodes, 1))
    nodes = np.unique(np.concatenate([low, high]))
    rank = np.full(num_nodes, -1, dtype=np.int64)
    if len(nodes) > 2:
        order = _ordered(low, high)
        rank[order] = np.arange(len(order))
    lone = np.flatnonzero(rank < 0)
    rank[lone] = np.arange(num_nodes - len(lone), num_nodes)
    return rank


def _ordered(low: Indices, high: Indices) -> Indices:
    """Return the nodes of linked pairs in gtsam's order of elimination."""
    graph = gtsam.SymbolicFactorGraph()
    for a, b in zip(low.tolist(), high.tolist(), strict=True):
        graph.push_factor(a, b)
    if len(low) < DISSECT:
        order = gtsam.Ordering.ColamdSymbolicFactorGraph(graph)
    else:
        order = gtsam.Ordering.MetisSymbolicFactorGraph(graph)
    return np.array([order.at(k) for k in range(order.size())], dtype=np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class Pattern:
    """Where the blocks of a pose graph's normal matrix go; made once, filled many times.

    Attributes:
        size: number of free nodes.
        rank: (n,) position of each node among the free ones, -1 for a held node.
        a: (m,) first node of every edge.
        b: (m,) second node of every edge.
        row: (blocks,) row of every block, column after column.
        start: (size + 1,) first block of every column.
        on_diagonal: (size,) block of every free node with itself.
        upper: (m,) block of row a and column b, -1 where an end is held.
        lower: (m,) block of row b and column a, -1 where an end is held.
    """

    size: int
    rank: Indices
    a: Indices
    b: Indices
    row: Indices
    start: Indices
    on_diagonal: Indices
    upper: Indices
    lower: Indices

    def of(self, a: Indices, b: Indices) -> Self:
        """Return the pattern of other edges between the same nodes, in the same order."""
        return type(self)(self.size, self.rank, a, b, *_blocks(self.size, self.rank, a, b))


def pattern(num_nodes: int, a: Indices, b: Indices, held: Indices) -> Pattern:
    """Return the pattern with `held` nodes left out (the gauge)."""
    rank = elimination_order(num_nodes, a, b)
    free = np.ones(num_nodes, dtype=bool)
    free[held] = False
    order = np.argsort(rank)
    order = order[free[order]]
    rank = np.full(num_nodes, -1, dtype=np.int64)
    rank[order] = np.arange(len(order))
    return Pattern(len(order), rank, a, b, *_blocks(len(order), rank, a, b))


def _blocks(
    size: int, rank: Indices, a: Indices, b: Indices
) -> tuple[Indices, Indices, Indices, Indices, Indices]:
    """Return the rows and column starts of all blocks, and the block of every node and edge."""
    ra, rb = rank[a], rank[b]
    inner = (ra >= 0) & (rb >= 0)
    ra, rb = ra[inner], rb[inner]
    own = np.arange(size)
    key = np.concatenate([own * size + own, rb * size + ra, ra * size + rb])
    distinct, block = np.unique(key, return_inverse=True)
    start = np.searchsorted(distinct, np.arange(size + 1) * size)
    upper, lower = np.full(len(a), -1, dtype=np.int64), np.full(len(a), -1, dtype=np.int64)
    upper[inner], lower[inner] = block[size : size + len(ra)], block[size + len(ra) :]
    return distinct % max(size, 1), start, block[:size], upper, lower


@dataclass(frozen=True, slots=True, eq=False)
class Filling:
    """Where the numbers of k x k blocks go in the compressed columns of a matrix.

    Attributes:
        place: for every number of all edges' blocks (first with first, second with second, first
            with second, second with first), then of the nodes' own; the last place is the bin.
        rows: row of every number of the matrix.
        ends: first number of every column, and their count.
    """

    place: Indices
    rows: NDArray[np.int32]
    ends: NDArray[np.int32]


def filling(layout: Pattern, k: int, *, own: bool = False) -> Filling:
    """Return where k x k blocks go; with `own`, one further block per node."""
    height = np.diff(layout.start)  # blocks per column
    column = np.repeat(np.arange(layout.size), height)
    inner = np.arange(k)
    first = k * k * layout.start[:-1]
    top = first[column] + k * (np.arange(len(layout.row)) - layout.start[column])
    across = top[:, None] + k * height[column, None] * inner
    block = across[:, None, :] + inner[:, None]  # (count, row in block, column in block)
    rows = np.empty(block.size, dtype=np.int32)
    rows[block] = (k * layout.row[:, None] + inner)[:, :, None]
    begins = (first[:, None] + k * height[:, None] * inner).ravel()
    ends: NDArray[np.int32] = np.append(begins, block.size).astype(np.int32)
    free = layout.rank >= 0
    at = np.full(len(free), -1, dtype=np.int64)
    at[free] = layout.on_diagonal[layout.rank[free]]
    where = [at[layout.a], at[layout.b], layout.upper, layout.lower] + ([at] if own else [])
    bins = np.full((1, k, k), block.size)
    return Filling(np.concatenate([block, bins])[np.concatenate(where)].ravel(), rows, ends)


def assembled(
    fill: Filling, aa: Blocks, ab: Blocks, bb: Blocks, own: Blocks | None = None
) -> csc_array:
    """Sum blocks (m, k, k) of all edges into a symmetric (Hermitian) matrix of the free nodes.

    Args:
        fill: where they go.
        aa: block of the first node with itself.
        ab: block of the first node with the second.
        bb: block of the second node with itself.
        own: (n, k, k) further diagonal blocks per node, where the filling has them.
    """
    parts = [aa, bb, ab, np.conj(np.swapaxes(ab, 1, 2))]
    if own is not None:
        parts.append(own)
    values = np.concatenate(parts).ravel()
    count = len(fill.rows)
    total: Blocks = np.bincount(fill.place, np.real(values), count + 1)[:-1]
    if np.iscomplexobj(values):
        total = total + 1j * np.bincount(fill.place, np.imag(values), count + 1)[:-1]
    size = len(fill.ends) - 1
    return csc_array((total, fill.rows, fill.ends), shape=(size, size))


def diagonal(values: Array) -> csc_array:
    """Return a diagonal matrix."""
    return csc_array(diags_array(values))


def factorised(matrix: csc_array) -> SuperLU:
    """Factorise a symmetric matrix in its given order (RuntimeError where it is singular)."""
    return splu(
        matrix, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )


def gathered(layout: Pattern, a_part: Blocks, b_part: Blocks) -> Blocks:
    """Sum vectors (m, ...) of both ends of all edges into (size, ...)."""
    where = np.concatenate([layout.rank[layout.a], layout.rank[layout.b]]) + 1  # held: place 0
    values = np.concatenate([a_part, b_part])
    flat = values.reshape(len(values), math.prod(values.shape[1:]))
    total = np.empty((layout.size, flat.shape[1]), dtype=values.dtype)
    for k in range(flat.shape[1]):
        total[:, k] = np.bincount(where, np.real(flat[:, k]), layout.size + 1)[1:]
        if np.iscomplexobj(values):
            total[:, k] += 1j * np.bincount(where, np.imag(flat[:, k]), layout.size + 1)[1:]
    return total.reshape(layout.size, *values.shape[1:])


def spread(layout: Pattern, values: Blocks) -> Blocks:
    """Return (n, ...) values of all nodes from those of the free ones; 0 at the held ones."""
    whole = np.zeros((len(layout.rank), *values.shape[1:]), dtype=values.dtype)
    free = layout.rank >= 0
    whole[free] = values[layout.rank[free]]
    return whole
