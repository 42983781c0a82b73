"""The loops that plan an overhead view, compiled: rays of its cells, and the samples of each."""

import math
from typing import Any

import numpy as np

from groundfuse.backend.compiled import compiled, part
from groundfuse.frontend.area_compiled import PART_BITS
from groundfuse.frontend.arrays import Floats, Matrix

Places = tuple[np.ndarray, np.ndarray]


@compiled
def rays_of_cells(
    corner: Floats,
    cell_m: float,
    shape: tuple[int, int],
    foot_from_cam: Matrix,
    height_m: float,
    widest: float,
) -> Floats:
    """Return the rays (rows * columns, 2) to the centres of cells; see `rays_from_floor`.

    Those behind the camera and those wider than the widest become nan.

    Args:
        corner: x and y of the first cell's centre in `foot`; x falls from row to row, y from
            column to column.
        cell_m: side of a cell.
        shape: rows and columns.
        foot_from_cam: (3, 3) rotation.
        height_m: of the camera.
        widest: length of the widest ray.
    """
    rows, columns = shape
    rays = np.empty((rows * columns, 2))
    axes = foot_from_cam
    for row in range(rows):
        x_m = corner[0] - row * cell_m
        u0 = x_m * axes[0, 0] - height_m * axes[2, 0]
        v0 = x_m * axes[0, 1] - height_m * axes[2, 1]
        depth_0 = x_m * axes[0, 2] - height_m * axes[2, 2]
        for column in range(columns):
            y_m = corner[1] - column * cell_m
            depth = depth_0 + y_m * axes[1, 2]
            u, v = (u0 + y_m * axes[1, 0]) / depth, (v0 + y_m * axes[1, 1]) / depth
            good = depth > 0.0 and math.sqrt(u * u + v * v) <= widest
            ray = rays[row * columns + column]
            ray[0], ray[1] = (u if good else math.nan), (v if good else math.nan)
    return rays


@part
def _between(three: Floats, at: float) -> float:
    """Return the value at a place between neighbours at -1, 0 and 1, along straight lines."""
    slope = three[1] - three[0] if at < 0.0 else three[2] - three[1]
    value: float = three[1] + at * slope
    return value


@part
def _pinned(place: float, last: int) -> int:
    """Return a place in 1 / 2 ** PART_BITS px: beyond its border a picture goes on."""
    return min(max(int(np.rint(place * (1 << PART_BITS))), 0), last << PART_BITS)


@compiled
def samples_of_cells(maps: Any, cells: Any, samples: int, last: Any) -> Places:  # noqa: ANN401
    """Return starts and parts of each cell's samples; see `AreaPlan`.

    Args:
        maps: (rows + 2, columns + 2, 2) picture columns and rows of the cells' centres, with a
            margin of one cell.
        cells: (n, 2) uint32 rows and columns of cells.
        samples: per side of a cell.
        last: last column and row of the picture.
    """
    starts = np.empty((len(cells), samples * samples), np.uint32)
    parts = np.empty((len(cells), samples * samples), np.uint16)
    lines = np.empty((2, 3))
    least = (1 << PART_BITS) - 1
    for n in range(len(cells)):
        row, column = np.int64(cells[n, 0]), np.int64(cells[n, 1])
        for j in range(samples):
            at_v = (j + 0.5) / samples - 0.5
            for k in range(3):
                for axis in range(2):
                    lines[axis, k] = _between(maps[row : row + 3, column + k, axis], at_v)
            for i in range(samples):
                at_u = (i + 0.5) / samples - 0.5
                u = _pinned(_between(lines[0], at_u), last[0])
                v = _pinned(_between(lines[1], at_u), last[1])
                start = (v >> PART_BITS) * (last[0] + 1) + (u >> PART_BITS)
                starts[n, j * samples + i] = start
                parts[n, j * samples + i] = ((v & least) << PART_BITS) | (u & least)
    return starts, parts
