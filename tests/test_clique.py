"""The largest agreeing set against trying all sets, and on sets that make naive listing hang."""

from itertools import combinations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from groundfuse.backend.clique import largest_clique


def flags(size, pairs):
    adjacent = np.eye(size, dtype=bool)
    for i, j in pairs:
        adjacent[i, j] = adjacent[j, i] = True
    return adjacent


@given(st.integers(1, 9), st.data())
def test_it_is_as_large_as_the_best_of_all_sets(size, data):
    pairs = list(combinations(range(size), 2))
    kept = data.draw(st.lists(st.sampled_from(pairs), unique=True)) if pairs else []
    adjacent = flags(size, kept)
    found = largest_clique(adjacent)
    assert adjacent[np.ix_(found, found)].all()
    assert found.tolist() == sorted(set(found.tolist()))
    sets = (s for k in range(size, 0, -1) for s in combinations(range(size), k))
    best = next(len(s) for s in sets if adjacent[np.ix_(s, s)].all())
    assert len(found) == best


def test_a_planted_set_is_found_in_a_crowd():
    rng = np.random.default_rng(3)
    adjacent = np.triu(rng.random((200, 200)) < 0.2, 1)
    adjacent = adjacent | adjacent.T
    members = rng.permutation(200)[:40]
    adjacent[np.ix_(members, members)] = True
    assert set(largest_clique(adjacent).tolist()) == set(members.tolist())


def test_dense_agreement_ends_at_once():
    adjacent = np.ones((300, 300), dtype=bool)
    for k in range(0, 300, 3):  # three by three, two of them disagree: 2^100 maximal sets
        adjacent[k, k + 1] = adjacent[k + 1, k] = False
    assert len(largest_clique(adjacent)) == 200


def test_nothing_agrees_with_nothing():
    assert largest_clique(np.zeros((0, 0), dtype=bool)).tolist() == []
    assert len(largest_clique(np.eye(5, dtype=bool))) == 1
