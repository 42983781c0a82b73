"""The loop of `footprint`, compiled."""

from typing import Any

import numpy as np

from groundfuse.backend.compiled import compiled, part


@part
def _slope(floor: Any, at: tuple[int, int], way: tuple[int, int], step_px: float) -> Any:  # noqa: ANN401
    """Return the change of x and y per pixel one way: to both sides, at a border inwards."""
    (row, column), (down, right) = at, way
    row0, row1 = max(row - down, 0), min(row + down, floor.shape[0] - 1)
    column0, column1 = max(column - right, 0), min(column + right, floor.shape[1] - 1)
    length = step_px * ((row1 - row0) + (column1 - column0))
    x = (floor[row1, column1, 0] - floor[row0, column0, 0]) / length
    return x, (floor[row1, column1, 1] - floor[row0, column0, 1]) / length


@compiled
def fill_seen_floor(
    rays: Any,  # noqa: ANN401 - arrays, typed when compiled
    foot_from_cam: Any,  # noqa: ANN401
    height_m: float,
    steps_px: tuple[float, float],
    found: tuple[Any, Any],
) -> None:
    """Fill the floor under a lattice of rays and the length of a pixel there, the longer way.

    Args:
        rays: (rows, columns, 2).
        foot_from_cam: see `overhead.foot_from_cam`.
        height_m: of the camera.
        steps_px: of the lattice, from row to row and from column to column.
        found: floor (rows, columns, 2) in `foot` and lengths (rows, columns), m; nan above the
            horizon.
    """
    floor, longest = found
    m = foot_from_cam
    for i in range(rays.shape[0]):
        for j in range(rays.shape[1]):
            a, b = rays[i, j]
            fall = -(m[2, 0] * a + m[2, 1] * b + m[2, 2])
            share = height_m / fall if fall > 0.0 else np.nan
            floor[i, j, 0] = share * (m[0, 0] * a + m[0, 1] * b + m[0, 2])
            floor[i, j, 1] = share * (m[1, 0] * a + m[1, 1] * b + m[1, 2])
    for i in range(rays.shape[0]):
        for j in range(rays.shape[1]):
            xv, yv = _slope(floor, (i, j), (1, 0), steps_px[0])
            xu, yu = _slope(floor, (i, j), (0, 1), steps_px[1])
            plus = np.sqrt((xu + yv) * (xu + yv) + (yu - xv) * (yu - xv))
            minus = np.sqrt((xu - yv) * (xu - yv) + (yu + xv) * (yu + xv))
            longest[i, j] = (plus + minus) / 2.0


@compiled
def fill_bounds(floor: Any, longest: Any, limits_m: tuple[float, float], bounds: Any) -> None:  # noqa: ANN401
    """Fill the bounds of the floor that is resolved; they stay as they are where none is.

    Args:
        floor: see `fill_seen_floor`, in any frame.
        longest: see `fill_seen_floor`.
        limits_m: a pixel may be as long, and as long where a neighbour is within the first limit.
        bounds: lowest and highest (x, y).
    """
    rows, columns = longest.shape
    for i in range(rows):
        for j in range(columns):
            seen = longest[i, j] <= limits_m[0]
            if not seen and longest[i, j] <= limits_m[1]:
                for k in range(max(i - 1, 0), min(i + 2, rows)):
                    for n in range(max(j - 1, 0), min(j + 2, columns)):
                        seen = seen or longest[k, n] <= limits_m[0]
            if seen:
                for axis in range(2):
                    bounds[0, axis] = min(bounds[0, axis], floor[i, j, axis])
                    bounds[1, axis] = max(bounds[1, axis], floor[i, j, axis])
