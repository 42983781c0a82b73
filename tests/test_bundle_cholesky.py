"""The block factorisation against dense linear algebra."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from groundfuse.backend.bundle_cholesky import (
    NotPositiveDefiniteError,
    factorise,
    inverse_between,
    inverse_diagonal,
    solve,
    with_held,
)
from groundfuse.backend.bundle_plan import BLOCK, elimination_order, plan

# Condition numbers stay below 1e4 by construction; eps x 1e4 = 2e-12, worst seen 2e-14.
TOLERANCE = 1e-11


def random_system(num_nodes, num_pairs, seed):
    """A positive definite block matrix, its stored blocks, and the same dense."""
    rng = np.random.default_rng(seed)
    i, j = np.triu_indices(num_nodes, 1)
    picked = rng.permutation(len(i))[:num_pairs]
    swap = rng.random(len(picked)) < 0.5  # either triangle may be stored
    rows = np.concatenate([np.arange(num_nodes), np.where(swap, j[picked], i[picked])])
    columns = np.concatenate([np.arange(num_nodes), np.where(swap, i[picked], j[picked])])
    blocks = rng.normal(size=(len(rows), BLOCK, BLOCK))
    dense = np.zeros((BLOCK * num_nodes,) * 2)
    for r, c, block in zip(rows, columns, blocks, strict=True):
        at, across = slice(BLOCK * r, BLOCK * r + BLOCK), slice(BLOCK * c, BLOCK * c + BLOCK)
        dense[at, across] += block
        dense[across, at] += block.T
    heavy = np.abs(dense).sum(axis=1).reshape(num_nodes, BLOCK)
    for node in range(num_nodes):
        blocks[node] += blocks[node].T + np.diag(heavy[node])
    dense += np.diag(heavy.ravel())
    return rows, columns, blocks, dense


@settings(max_examples=40)
@given(st.integers(1, 14), st.integers(0, 60), st.integers(0, 999), st.integers(0, 3))
def test_solution_and_inverse_agree_with_dense_ones(num_nodes, num_pairs, seed, num_last):
    rows, columns, blocks, dense = random_system(num_nodes, num_pairs, seed)
    last = np.arange(num_nodes - min(num_last, num_nodes), num_nodes)
    factor = factorise(plan(rows, columns, num_nodes, last), blocks, num_nodes)
    right = np.random.default_rng(seed).normal(size=(BLOCK * num_nodes, 2))
    np.testing.assert_allclose(dense @ solve(factor, right), right, atol=TOLERANCE * 100)
    np.testing.assert_allclose(dense @ solve(factor, right[:, 0]), right[:, 0], atol=1e-9)
    inverse = np.linalg.inv(dense).reshape(num_nodes, BLOCK, num_nodes, BLOCK)
    expected = inverse[np.arange(num_nodes), :, np.arange(num_nodes), :]
    np.testing.assert_allclose(inverse_diagonal(factor), expected, atol=TOLERANCE)
    between = inverse[last][:, :, last].reshape(BLOCK * len(last), BLOCK * len(last))
    np.testing.assert_allclose(inverse_between(factor, last), between, atol=TOLERANCE)


@settings(max_examples=40)
@given(st.integers(2, 12), st.integers(0, 50), st.integers(0, 999), st.integers(1, 3))
def test_unknowns_of_the_last_nodes_can_be_held(num_nodes, num_pairs, seed, num_last):
    """As in the dense matrix with their rows and columns unit, factorised from the beginning."""
    rows, columns, blocks, dense = random_system(num_nodes, num_pairs, seed)
    last = np.arange(num_nodes - min(num_last, num_nodes), num_nodes)
    # The bundle's robots are all tied to each other, so that they lie in one front.
    i, j = np.triu_indices(len(last), 1)
    rows, columns = np.concatenate([rows, last[i]]), np.concatenate([columns, last[j]])
    blocks = np.concatenate([blocks, np.zeros((len(i), BLOCK, BLOCK))])
    factor = factorise(plan(rows, columns, num_nodes, last), blocks, num_nodes)
    rng = np.random.default_rng(seed)
    held = rng.choice(BLOCK * len(last), rng.integers(1, BLOCK * len(last) + 1), replace=False)
    held += BLOCK * last[0]
    dense[held], dense[:, held] = 0.0, 0.0
    dense[held, held] = 1.0
    right = rng.normal(size=BLOCK * num_nodes)
    found = solve(with_held(factor, held), right)
    np.testing.assert_allclose(dense @ found, right, atol=TOLERANCE * 100)
    inverse = np.linalg.inv(dense).reshape(num_nodes, BLOCK, num_nodes, BLOCK)
    expected = inverse[np.arange(num_nodes), :, np.arange(num_nodes), :]
    np.testing.assert_allclose(inverse_diagonal(with_held(factor, held)), expected, atol=TOLERANCE)


def test_an_unknown_that_is_eliminated_early_cannot_be_held():
    rows, columns, blocks, _ = random_system(9, 14, 1)
    factor = factorise(plan(rows, columns, 9, np.array([8])), blocks, 9)
    early = BLOCK * factor.fronts[0].own[0]
    with pytest.raises(ValueError, match="only unknowns of the last front can be held, got 1"):
        with_held(factor, np.array([early]))


def test_last_nodes_come_last_and_every_node_once():
    rows, columns, _, _ = random_system(9, 14, 1)
    order = elimination_order(rows, columns, 9, np.array([2, 5]))
    assert order[-2:].tolist() == [2, 5]
    assert sorted(order.tolist()) == list(range(9))


def test_a_chain_is_eliminated_without_fill():
    rows = np.concatenate([np.arange(40), np.arange(39)])
    columns = np.concatenate([np.arange(40), np.arange(1, 40)])
    fronts = plan(rows, columns, 40, np.zeros(0, dtype=np.int64))
    assert max(len(front.own) + len(front.later) for front in fronts) <= 3


def test_an_indefinite_matrix_is_refused():
    rows, columns, blocks, _ = random_system(5, 6, 3)
    blocks[4] -= 1e3 * np.eye(BLOCK)
    with pytest.raises(NotPositiveDefiniteError):
        factorise(plan(rows, columns, 5, np.zeros(0, dtype=np.int64)), blocks, 5)
