"""The most similar columns of every row, compiled: one pass instead of a partial sort."""

import math

import numpy as np

from groundfuse.backend.compiled import compiled
from groundfuse.frontend.arrays import Picture32


@compiled
def most_similar(similarity: Picture32, columns: np.ndarray) -> None:
    """Write the columns of each row's largest values, the largest first; of equals the first.

    Args:
        similarity: (n, m).
        columns: (n, k) are written; k at most m.
    """
    count = columns.shape[1]
    largest = np.empty(count, np.float32)
    for i in range(len(similarity)):
        for rank in range(count):
            largest[rank], columns[i, rank] = -math.inf, rank
        for j in range(similarity.shape[1]):
            if similarity[i, j] > largest[count - 1]:
                rank = count - 1
                while rank > 0 and similarity[i, j] > largest[rank - 1]:
                    largest[rank] = largest[rank - 1]
                    columns[i, rank] = columns[i, rank - 1]
                    rank -= 1
                largest[rank] = similarity[i, j]
                columns[i, rank] = j
