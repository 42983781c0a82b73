"""The loop of `repetition.py`, compiled: the best shift of a view against itself."""

import math
from typing import Any

import numpy as np

from groundfuse.backend.compiled import compiled


@compiled
def best_shift(product: Any, power: Any, overlap: Any, shape: Any, limits: Any) -> float:  # noqa: ANN401
    """Return the highest correlation of shifts that count, 0 where none does.

    Opposite shifts are one: half of them are looked at.

    Args:
        product: (padded rows, padded columns) sums of products, no shift in the corner.
        power: the same of squares under the shifted view.
        overlap: cells that both cover.
        shape: rows and columns of the view.
        limits: smallest overlap; main lobe, cells; smallest power of a cell.
    """
    padded_rows, padded_columns = product.shape
    rows, columns = shape
    best = 0.0
    for down in range(rows):
        for across in range(1 - columns, columns):
            i, j = down, (across if across >= 0 else across + padded_columns)
            if not overlap[i, j] > limits[0] or down * down + across * across <= limits[1] ** 2:
                continue
            # The other way: of the view where it is covered by its shifted self.
            back_i = padded_rows - down if down > 0 else 0
            back_j = -across if across <= 0 else padded_columns - across
            norm = math.sqrt(max(np.float64(power[i, j]) * power[back_i, back_j], 0.0))
            if norm > limits[2] * overlap[i, j]:
                best = max(best, product[i, j] / norm)
    return min(best, 1.0)
