"""How a block matrix is eliminated: order, fronts, and where everything goes; numpy and scipy.

A front is dense and holds a few nodes that are eliminated together and the later nodes they touch.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import splu

Integers = NDArray[np.int64]

BLOCK = 6
RELAX = 1.35
"""Two fronts join where that stores at most this many times their entries: fewer, larger ones."""


@dataclass(frozen=True, slots=True, eq=False)
class Front:
    """Nodes that are eliminated together.

    Attributes:
        own: nodes eliminated here, in order.
        later: nodes touched that are eliminated later, in order.
        parent: index of the front that takes the update, -1 at a root.
        place: scalar positions of `later` inside the parent's front.
        entry: indices of the matrix blocks that are assembled here.
        row: block row of each entry inside this front.
        column: block column of each entry inside this front.
        flip: whether an entry is stored the other way round.
    """

    own: Integers
    later: Integers
    parent: int
    place: Integers
    entry: Integers
    row: Integers
    column: Integers
    flip: NDArray[np.bool_]


def elimination_order(
    rows: Integers, columns: Integers, num_nodes: int, last: Integers
) -> Integers:
    """Return nodes in an order of little fill (minimum degree); `last` come last."""
    free = np.setdiff1d(np.arange(num_nodes), last)
    position = np.full(num_nodes, -1)
    position[free] = np.arange(len(free))
    i, j = position[rows], position[columns]
    kept = (i >= 0) & (j >= 0) & (i != j)
    size = len(free)
    if size == 0:
        return last
    ones = np.ones(int(kept.sum()))
    pattern = coo_matrix((ones, (i[kept], j[kept])), shape=(size, size))
    matrix = (pattern + pattern.T).tocsc()
    matrix.data[:] = 1.0
    matrix.setdiag(np.asarray(matrix.sum(axis=0)).ravel() + 1.0)
    factor = splu(
        matrix.tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    order: Integers = np.concatenate([free[np.argsort(factor.perm_c)], last])
    return order


def _structures(order: Integers, rows: Integers, columns: Integers) -> list[list[int]]:
    """Positions below the diagonal of each column of the factor, by position."""
    size = len(order)
    position = np.empty(size, dtype=np.int64)
    position[order] = np.arange(size)
    i, j = position[rows], position[columns]
    touched: list[set[int]] = [set() for _ in range(size)]
    for low, high in zip(np.minimum(i, j).tolist(), np.maximum(i, j).tolist(), strict=True):
        if low != high:
            touched[low].add(high)
    structures: list[list[int]] = []
    for column in range(size):
        structure = sorted(touched[column])
        structures.append(structure)
        if structure:
            touched[structure[0]].update(structure[1:])
    return structures


def _amalgamate(structures: list[list[int]]) -> list[tuple[list[int], list[int]]]:
    """Join neighbouring columns whose structures nearly agree: (own, later) by position."""
    groups: list[tuple[list[int], list[int]]] = []
    for column, structure in enumerate(structures):
        if groups and groups[-1][1] and groups[-1][1][0] == column:
            own, later = groups[-1]
            size = len(own) + len(later)
            joined = len(own) + 1 + len(structure)
            if joined**2 <= RELAX * max(size**2, (1 + len(structure)) ** 2):
                groups[-1] = ([*own, column], structure)
                continue
        groups.append(([column], structure))
    return groups


def plan(rows: Integers, columns: Integers, num_nodes: int, last: Integers) -> tuple[Front, ...]:
    """Analyse the pattern of a symmetric block matrix.

    Args:
        rows: block row of each stored block (every pair once, diagonal blocks included).
        columns: block column of each stored block.
        num_nodes: nodes of the matrix.
        last: nodes to eliminate at the end, which lie together in the root front.
    """
    order = elimination_order(rows, columns, num_nodes, last)
    groups = _amalgamate(_structures(order, rows, columns))
    position = np.empty(num_nodes, dtype=np.int64)
    position[order] = np.arange(num_nodes)
    group_of = np.empty(num_nodes, dtype=np.int64)
    for index, (own, _) in enumerate(groups):
        group_of[own] = index
    i, j = position[rows], position[columns]
    low, high = np.minimum(i, j), np.maximum(i, j)
    by_group = np.argsort(group_of[low], kind="stable")
    bounds = np.searchsorted(group_of[low][by_group], np.arange(len(groups) + 1))
    fronts = []
    for index, (own, later) in enumerate(groups):
        inside = np.array([*own, *later], dtype=np.int64)
        entry = by_group[bounds[index] : bounds[index + 1]]
        parent = int(group_of[later[0]]) if later else -1
        at = np.zeros(0, dtype=np.int64)
        if later:
            target = np.array([*groups[parent][0], *groups[parent][1]], dtype=np.int64)
            at = np.searchsorted(target, np.array(later))
        fronts.append(
            Front(
                order[own],
                order[later] if later else np.zeros(0, dtype=np.int64),
                parent,
                scalars(at),
                entry,
                np.searchsorted(inside, high[entry]),
                np.searchsorted(inside, low[entry]),
                i[entry] < j[entry],
            )
        )
    return tuple(fronts)


def scalars(nodes: Integers) -> Integers:
    """Rows of a matrix that belong to some nodes, in their order."""
    scalars: Integers = (nodes[:, None] * BLOCK + np.arange(BLOCK)).ravel()
    return scalars
