"""Sparse Cholesky over 6x6 blocks with the inverse's diagonal: multifrontal.

Cost is near-linear where the graph is like a map's. The selected inverse follows the same tree from
the root down (Takahashi, Fagan, Chin 1973), so covariances cost about as much as one solution.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import get_blas_funcs, get_lapack_funcs

from groundfuse.backend.bundle_compiled import add_update, assemble, take_square
from groundfuse.backend.bundle_plan import BLOCK, Front, Integers, scalars

Array = NDArray[np.float64]

# Fronts are small and many: the checks around `cholesky` would cost more than it does.
POTRF, TRTRS = get_lapack_funcs(("potrf", "trtrs"), dtype=np.float64)
(SYRK,) = get_blas_funcs(("syrk",), dtype=np.float64)


class NotPositiveDefiniteError(Exception):
    """The normal equations have no unique solution."""


@dataclass(frozen=True, slots=True, eq=False)
class Factor:
    """The Cholesky factor: per front L11 (m, m) and L21 (k, m)."""

    fronts: tuple[Front, ...]
    diagonal: tuple[Array, ...]
    below: tuple[Array, ...]
    num_nodes: int


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
        assemble(blocks, front.entry, (front.row, front.column), front.flip, dense)
        for child, update in zip(children[index], updates[index], strict=True):
            add_update(dense, update, fronts[child].place)
        updates[index] = []
        corner, failed = POTRF(dense[:m, :m], lower=1, clean=1)
        if failed:
            raise NotPositiveDefiniteError
        diagonal.append(corner)
        rows = _lower_solve(corner, dense[m:, :m].T)
        below.append(np.ascontiguousarray(rows.T))
        if front.parent >= 0:
            # The upper triangle of the transpose is the lower one: no copy on the way to BLAS.
            update = np.ascontiguousarray(dense[m:, m:])
            SYRK(-1.0, below[-1].T, beta=1.0, c=update.T, trans=1, overwrite_c=1)
            updates[front.parent].append(update)
            children[front.parent].append(index)
    return Factor(fronts, tuple(diagonal), tuple(below), num_nodes)


def with_held(factor: Factor, held: Integers) -> Factor:
    """Return the factor of the matrix with some unknowns held: their rows and columns are unit.

    Only unknowns of the last front: all others are eliminated as before.

    Args:
        factor: see there.
        held: scalar positions in the matrix.

    Raises:
        ValueError: one of them is eliminated earlier.
    """
    is_held = np.zeros(BLOCK * factor.num_nodes, dtype=np.bool_)
    is_held[held] = True
    diagonal, below = [], []
    for front, corner, rows in zip(factor.fronts, factor.diagonal, factor.below, strict=True):
        own, later = is_held[scalars(front.own)], is_held[scalars(front.later)]
        if own.any():
            if len(later):
                raise ValueError(f"only unknowns of the last front can be held, got {own.sum()}")
            whole = corner @ corner.T
            whole[own], whole[:, own] = 0.0, 0.0
            whole[own, own] = 1.0
            corner = POTRF(whole, lower=1, clean=1)[0]  # noqa: PLW2901
        diagonal.append(corner)
        below.append(np.where(later[:, None], 0.0, rows))
    return Factor(factor.fronts, tuple(diagonal), tuple(below), factor.num_nodes)


def _lower_solve(lower: Array, right: Array, *, transposed: bool = False) -> Array:
    """Solve with a lower triangular matrix or its transpose."""
    solution: Array = TRTRS(lower, right, lower=1, trans=1 if transposed else 0)[0]
    return solution


def solve(factor: Factor, right: Array) -> Array:
    """Solve for right-hand sides (6 nodes,) or (6 nodes, k), in the nodes' own order."""
    solution = np.array(right.reshape(len(right), -1))
    for front, corner, rows in zip(factor.fronts, factor.diagonal, factor.below, strict=True):
        own, later = scalars(front.own), scalars(front.later)
        part = _lower_solve(corner, solution[own])
        solution[own] = part
        solution[later] -= rows @ part
    for front, corner, rows in reversed(
        list(zip(factor.fronts, factor.diagonal, factor.below, strict=True))
    ):
        own, later = scalars(front.own), scalars(front.later)
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
    unit[scalars(nodes), np.arange(unit.shape[1])] = 1.0
    between: Array = solve(factor, unit)[scalars(nodes)]
    return between


def _inverse_front(factor: Factor, index: int, waiting: list[Array | None]) -> Array:
    """Inverse restricted to one front, from the inverse restricted to its parent's."""
    front, corner, rows = factor.fronts[index], factor.diagonal[index], factor.below[index]
    half = _lower_solve(corner, np.eye(len(corner)))
    own: Array = half.T @ half
    parent = waiting[front.parent] if front.parent >= 0 else None
    if parent is None:
        return own
    size, first = len(own) + len(rows), len(own)
    dense, gain = np.empty((size, size)), rows @ half
    later, cross = dense[first:, first:], dense[first:, :first]
    take_square(parent, front.place, later)
    cross[:] = -later @ gain
    dense[:first, :first] = own - gain.T @ cross
    dense[:first, first:] = cross.T
    return dense
