"""The loops of `sight`, compiled."""

from typing import Any

import numpy as np

from groundfuse.backend.compiled import compiled
from groundfuse.frontend.reading_compiled import MOST_PLACES

MOST_HALVINGS = 24
SLACK = 1e-6
"""A pixel as long as the cell is one: rounding must not make it two places a side."""


@compiled
def rays_of_lattice(
    cam_from_team: Any,  # noqa: ANN401 - arrays, typed when compiled
    corner: tuple[int, int, float, float],
    side_m: float,
    columns: int,
    widest2: float,
    rays: Any,  # noqa: ANN401
) -> None:
    """Fill rays (n, 2) to floor points in rows; nan behind the camera or longer than the widest.

    Args:
        cam_from_team: see `sight.cam_from_team`.
        corner: row and column of the first block, counted from the origin, and x and y there.
        side_m: of a block; x grows with columns, y falls with rows. The points are the middles.
        columns: points in a row.
        widest2: squared length of the longest ray.
        rays: to fill.
    """
    m, (first_row, first_column, x_m, y_m) = cam_from_team, corner
    for k in range(len(rays)):
        x = x_m + (first_column + k % columns + 0.5) * side_m
        y = y_m - (first_row + k // columns + 0.5) * side_m
        depth = m[2, 0] * x + m[2, 1] * y + m[2, 2]
        a = (m[0, 0] * x + m[0, 1] * y + m[0, 2]) / depth
        b = (m[1, 0] * x + m[1, 1] * y + m[1, 2]) / depth
        seen = depth > 0.0 and a * a + b * b <= widest2
        rays[k, 0], rays[k, 1] = (a, b) if seen else (np.nan, np.nan)


@compiled
def fill_lattice(px: Any, falloff: Any, step: int, found: tuple[Any, Any, Any]) -> None:  # noqa: ANN401
    """Fill lattice, slopes and reading of a `Sight`.

    Args:
        px: (n + 2, m + 2, 2) pixels of the lattice and one point around it.
        falloff: principal point, half the diagonal, and three coefficients; see `gains`.
        step: cells from one point to the next.
        found: to fill.
    """
    lattice, slopes, reading = found
    cx, cy, half, c1, c2, c3 = falloff
    two = 2.0 * step
    for i in range(lattice.shape[0]):
        for j in range(lattice.shape[1]):
            a = (px[i + 1, j + 2, 0] - px[i + 1, j, 0]) / two
            b = (px[i + 1, j + 2, 1] - px[i + 1, j, 1]) / two
            c = (px[i + 2, j + 1, 0] - px[i, j + 1, 0]) / two
            d = (px[i + 2, j + 1, 1] - px[i, j + 1, 1]) / two
            plus = np.sqrt((a + d) * (a + d) + (b - c) * (b - c))
            minus = np.sqrt((a - d) * (a - d) + (b + c) * (b + c))
            most, least = (plus + minus) / 2.0, abs(plus - minus) / 2.0
            slopes[i, j, 0], slopes[i, j, 1], slopes[i, j, 2], slopes[i, j, 3] = a, b, c, d
            u, v = px[i + 1, j + 1, 0], px[i + 1, j + 1, 1]
            r2 = ((u - cx) * (u - cx) + (v - cy) * (v - cy)) / (half * half)
            lattice[i, j, 0], lattice[i, j, 1], lattice[i, j, 2] = u, v, 1.0 / least
            lattice[i, j, 3] = np.exp(-r2 * (c1 + r2 * (c2 + r2 * c3)))
            reading[i, j, 0], reading[i, j, 1] = _reading(most, least)


@compiled
def _reading(most: float, least: float) -> tuple[int, int]:
    """Return the halvings that still leave two pixels per cell, and places per cell side.

    Args:
        most: pixels per cell along the direction with more of them.
        least: along the other; nan for both where there are none.
    """
    level = 0
    while least >= 4.0 * (1 << level) and level < MOST_HALVINGS:
        level += 1
    if not most > 1.0:
        return level, 1
    return level, int(min(np.ceil(most / (1 << level) - SLACK), MOST_PLACES))
