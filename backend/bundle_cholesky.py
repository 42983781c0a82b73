"""Sparse Cholesky over 6x6 blocks with the inverse's diagonal: multifrontal, numpy only per front.

A front is dense and holds a few nodes that are eliminated together and the later nodes they touch.
Cost is near-linear where the graph is like a map's. The selected inverse follows the same tree from
the root down (Takahashi, Fagan, Chin 1973), so covariances cost about as much as one solution.
"""

from dataclasses import dataclass

import numpy as np
from numpy.linalg import LinAlgError
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import splu

Array = NDArray[np.float64]
Integers = NDArray[np.int64]

BLOCK = 6
RELAX = 1.35
"""Two fronts join where that stores at most this many times their entries: fewer, larger ones."""


class NotPositiveDefiniteError(Exception):
    """The normal equations have no unique solution."""


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


@dataclass(frozen=True, slots=True, eq=False)
class Factor:
    """The Cholesky factor: per front L11 (m, m) and L21 (k, m)."""

    fronts: tuple[Front, ...]
    diagonal: tuple[Array, ...]
    below: tuple[Array, ...]
    num_nodes: int


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
        place = np.zeros(0, dtype=np.int64)
        if later:
            target = np.array([*groups[parent][0], *groups[parent][1]], dtype=np.int64)
            blocks = np.searchsorted(target, np.array(later))
            place = (blocks[:, None] * BLOCK + np.arange(BLOCK)).ravel()
        fronts.append(
            Front(
                order[own],
                order[later] if later else np.zeros(0, dtype=np.int64),
                parent,
                place,
                entry,
                np.searchsorted(inside, high[entry]),
                np.searchsorted(inside, low[entry]),
                i[entry] < j[entry],
            )
        )
    return tuple(fronts)


def factorise(fronts: tuple[Front, ...], blocks: Array, num_nodes: int) -> Factor:
    """Factorise the matrix whose stored blocks (n, 6, 6) follow the plan's rows and columns.

    Raises:
        NotPositiveDefiniteError: a pivot is not positive.
    """
    updates: list[list[Array]] = [[] for _ in fronts]
    children: list[list[int]] = [[] for _ in fronts]
    diagonal, below = [], []
    for index, front in enumerate(fronts):
        m = BLOCK * len(front.own)
        size = m + BLOCK * len(front.later)
        dense = np.zeros((size, size))
        values = blocks[front.entry]
        values = np.where(front.flip[:, None, None], values.transpose(0, 2, 1), values)
        as_blocks = dense.reshape(size // BLOCK, BLOCK, size // BLOCK, BLOCK)
        as_blocks[front.row, :, front.column, :] += values
        for child, update in zip(children[index], updates[index], strict=True):
            place = fronts[child].place
            dense[place[:, None], place] += update
        updates[index] = []
        try:
            corner = cholesky(dense[:m, :m], lower=True, check_finite=False)
        except LinAlgError:
            raise NotPositiveDefiniteError from None
        diagonal.append(corner)
        rows = _lower_solve(corner, dense[m:, :m].T)
        below.append(np.ascontiguousarray(rows.T))
        if front.parent >= 0:
            updates[front.parent].append(dense[m:, m:] - below[-1] @ rows)
            children[front.parent].append(index)
    return Factor(fronts, tuple(diagonal), tuple(below), num_nodes)


def _lower_solve(lower: Array, right: Array, *, transposed: bool = False) -> Array:
    """Solve with a lower triangular matrix or its transpose."""
    trans = 1 if transposed else 0
    solution: Array = solve_triangular(lower, right, trans=trans, lower=True, check_finite=False)
    return solution


def _scalars(nodes: Integers) -> Integers:
    scalars: Integers = (nodes[:, None] * BLOCK + np.arange(BLOCK)).ravel()
    return scalars


def solve(factor: Factor, right: Array) -> Array:
    """Solve for right-hand sides (6 nodes,) or (6 nodes, k), in the nodes' own order."""
    solution = np.array(right.reshape(len(right), -1))
    for front, corner, rows in zip(factor.fronts, factor.diagonal, factor.below, strict=True):
        own, later = _scalars(front.own), _scalars(front.later)
        part = _lower_solve(corner, solution[own])
        solution[own] = part
        solution[later] -= rows @ part
    for front, corner, rows in reversed(
        list(zip(factor.fronts, factor.diagonal, factor.below, strict=True))
    ):
        own, later = _scalars(front.own), _scalars(front.later)
        rest = solution[own] - rows.T @ solution[later]
        solution[own] = _lower_solve(corner, rest, transposed=True)
    return solution.reshape(right.shape)


def inverse_diagonal(factor: Factor) -> Array:
    """Diagonal blocks (nodes, 6, 6) of the inverse."""
    result = np.zeros((factor.num_nodes, BLOCK, BLOCK))
    fronts = factor.fronts
    waiting: list[Array | None] = [None] * len(fronts)
    todo = np.bincount([front.parent + 1 for front in fronts], minlength=len(fronts) + 1)[1:]
    for index in reversed(range(len(fronts))):
        front = fronts[index]
        dense = _inverse_front(factor, index, waiting)
        count, size = np.arange(len(front.own)), len(dense) // BLOCK
        result[front.own] = dense.reshape(size, BLOCK, size, BLOCK)[count, :, count, :]
        waiting[index] = dense if todo[index] else None
        if front.parent >= 0:
            todo[front.parent] -= 1
            if todo[front.parent] == 0:
                waiting[front.parent] = None
    return result


def inverse_between(factor: Factor, nodes: Integers) -> Array:
    """Blocks of the inverse between some nodes, (6 k, 6 k)."""
    unit = np.zeros((BLOCK * factor.num_nodes, BLOCK * len(nodes)))
    unit[_scalars(nodes), np.arange(unit.shape[1])] = 1.0
    between: Array = solve(factor, unit)[_scalars(nodes)]
    return between


def _inverse_front(factor: Factor, index: int, waiting: list[Array | None]) -> Array:
    """Inverse restricted to one front, from the inverse restricted to its parent's."""
    front, corner, rows = factor.fronts[index], factor.diagonal[index], factor.below[index]
    half = _lower_solve(corner, np.eye(len(corner)))
    own: Array = half.T @ half
    parent = waiting[front.parent] if front.parent >= 0 else None
    if parent is None:
        return own
    gain = rows @ half
    later = parent[front.place[:, None], front.place]
    cross = -later @ gain
    dense: Array = np.block([[own - gain.T @ cross, cross.T], [cross, later]])
    return dense
