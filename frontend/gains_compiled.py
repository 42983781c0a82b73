"""The loops of `gains`, compiled: normal equations and distances, cell by cell."""

from typing import Any

import numpy as np

from groundfuse.frontend.compiled import compiled

POWERS = 3
CHANNELS = 3


@compiled
def cell_means(begins: Any, weight: Any, values: Any, means: Any) -> None:  # noqa: ANN401
    """Fill the weighted means (cells, 3) of values (n, 3) that are in order of their cells.

    Args:
        begins: (cells + 1,) first sample of each cell, and the number of samples.
        weight: (n,) of the samples.
        values: (n, 3).
        means: to fill.
    """
    for cell in range(len(means)):
        whole = 0.0
        means[cell] = 0.0
        for k in range(begins[cell], begins[cell + 1]):
            whole += weight[k]
            for channel in range(CHANNELS):
                means[cell, channel] += weight[k] * values[k, channel]
        for channel in range(CHANNELS):
            means[cell, channel] /= whole


@compiled
def add_normal(
    columns: Any,  # noqa: ANN401 - arrays, typed when compiled
    entries: Any,  # noqa: ANN401
    begins: Any,  # noqa: ANN401
    weight: Any,  # noqa: ANN401
    rest: Any,  # noqa: ANN401
    equations: tuple[Any, Any],
) -> None:
    """Add samples to the normal equations with each cell's own colour eliminated.

    With a row a of the design for each of a cell's samples, their weights w of sum W, and s the
    sum of w a, the cell adds the sum of w a a' less s s' / W.

    Args:
        columns: (n, POWERS + 1) of a sample's entries in the design, in order of the cells.
        entries: (n, POWERS + 1).
        begins: see `cell_means`.
        weight: see `cell_means`.
        rest: (n, 3) values less their cells' weighted means.
        equations: matrix and right side (columns, 3) to add to.
    """
    normal, right = equations
    size = len(normal)
    total, is_in = np.zeros(size), np.zeros(size, np.bool_)
    used = np.zeros(size, np.int64)
    for cell in range(len(begins) - 1):
        whole, number = 0.0, 0
        for k in range(begins[cell], begins[cell + 1]):
            w = weight[k]
            whole += w
            for i in range(POWERS + 1):
                a = columns[k, i]
                if not is_in[a]:
                    is_in[a], used[number] = True, a
                    number += 1
                share = w * entries[k, i]
                total[a] += share
                for j in range(POWERS + 1):
                    normal[a, columns[k, j]] += share * entries[k, j]
                for channel in range(CHANNELS):
                    right[a, channel] += share * rest[k, channel]
        for i in range(number):
            share = total[used[i]] / whole
            for j in range(number):
                normal[used[i], used[j]] -= share * total[used[j]]
        for i in range(number):
            total[used[i]], is_in[used[i]] = 0.0, False
