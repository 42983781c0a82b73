"""The most similar columns of every row, compiled: one pass instead of a partial sort."""

import math
from typing import Any

import numpy as np

from groundfuse.backend.compiled import compiled, part
from groundfuse.frontend.arrays import Picture32

ONE, TWO, FOUR, TOP = np.uint64(1), np.uint64(2), np.uint64(4), np.uint64(56)
BY_ONE = np.uint64(0x5555555555555555)
BY_TWO = np.uint64(0x3333333333333333)
BY_FOUR = np.uint64(0x0F0F0F0F0F0F0F0F)
BYTES = np.uint64(0x0101010101010101)


@part
def _rank(row: Picture32, largest: Picture32, columns: np.ndarray) -> None:
    count = len(columns)
    for rank in range(count):
        largest[rank], columns[rank] = -math.inf, rank
    for j in range(len(row)):
        if row[j] > largest[count - 1]:
            rank = count - 1
            while rank > 0 and row[j] > largest[rank - 1]:
                largest[rank] = largest[rank - 1]
                columns[rank] = columns[rank - 1]
                rank -= 1
            largest[rank] = row[j]
            columns[rank] = j


@compiled
def most_similar(similarity: Picture32, columns: np.ndarray) -> None:
    """Write the columns of each row's largest values, the largest first; of equals the first.

    Args:
        similarity: (n, m).
        columns: (n, k) are written; k at most m.
    """
    largest = np.empty(columns.shape[1], np.float32)
    for i in range(len(similarity)):
        _rank(similarity[i], largest, columns[i])


@part
def _ones(bits: Any) -> Any:  # noqa: ANN401
    """Return how many bits of 64 are set, in the form that compilers know for one instruction."""
    bits = bits - ((bits >> ONE) & BY_ONE)
    bits = (bits & BY_TWO) + ((bits >> TWO) & BY_TWO)
    bits = (bits + (bits >> FOUR)) & BY_FOUR
    return (bits * BYTES) >> TOP


@compiled
def fewest_apart(bits_a: np.ndarray, bits_b: np.ndarray, columns: np.ndarray) -> None:
    """Write the columns that differ from each row in the fewest bits; of equals the first.

    Args:
        bits_a: (n, words) uint64.
        bits_b: (words, m) uint64: word by word, so that neighbours are compared together.
        columns: (n, k) are written; k at most m.
    """
    similarity = np.empty(bits_b.shape[1], np.float32)
    largest = np.empty(columns.shape[1], np.float32)
    for i in range(len(bits_a)):
        similarity[:] = 0.0
        for word in range(len(bits_b)):
            for j in range(len(similarity)):
                similarity[j] -= np.float32(_ones(bits_a[i, word] ^ bits_b[word, j]))
        _rank(similarity, largest, columns[i])
