"""The map as coloured points: floor cells, and trajectories that float over them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from groundfuse.backend.measurement import Se2, TeamEstimate
from groundfuse.frontend.arrays import Floats
from groundfuse.frontend.mosaic import Mosaic
from groundfuse.tools.canvas import Colour
from groundfuse.tools.drawing_style import robot_colour
from groundfuse.tools.ply_file import Colours

MOST_POINTS = 1_000_000
"""Of the floor: 15 MB in a file, and any viewer turns it smoothly."""
RIBBON_SHARE = 0.003
"""Half the width of a trajectory's ribbon of points, of the map's longer side."""
ROWS_AT_ONCE = 16
"""Rows of the thinned picture that are made from what the processor's cache holds."""
LIFT_SHARE = 0.01
"""How far trajectories float over the floor, of the map's longer side."""


@dataclass(frozen=True, slots=True, eq=False)
class MapPoints:
    """Points and the lines between some of them; see `ply_file.ply_bytes`.

    Attributes:
        points: (n, 3) in the team's frame, m, z up.
        colours: (n, 3) RGB.
        edges: (m, 2) numbers of points.
        edge_colours: (m, 3) RGB.
    """

    points: Floats
    colours: Colours
    edges: NDArray[np.int64]
    edge_colours: Colours


def map_points(
    mosaic: Mosaic, estimate: TeamEstimate, component: int = 0, most_points: int = MOST_POINTS
) -> MapPoints:
    """Return one component's floor and trajectories.

    Trajectories are there twice: as lines, and as ribbons of points for programs without lines.

    Args:
        mosaic: of the component.
        estimate: of the team.
        component: which.
        most_points: of the floor; larger mosaics are thinned out by averaging.
    """
    longer_m = max(mosaic.count.shape) * mosaic.m_per_px
    floor, spacing_m = floor_points(mosaic, most_points)
    parts = [floor]
    for number, robot in enumerate(sorted({frame.robot for frame in estimate.team_from_base})):
        inside = (f for f, part in estimate.component_of.items() if part == component)
        track = [estimate.team_from_base[f] for f in sorted(inside) if f.robot == robot]
        if track:
            parts.append(track_points(track, robot_colour(number), longer_m, spacing_m))
    return joined(parts)


def floor_points(mosaic: Mosaic, most_points: int) -> tuple[MapPoints, float]:
    """Return the seen floor, at most about so many points, and their spacing in m."""
    seen = mosaic.count > 0
    stride = max(1, math.ceil(math.sqrt(np.count_nonzero(seen) / most_points)))
    share, colour = _thinned(seen.view(np.uint8), stride), _thinned(mosaic.floor, stride)
    shown = share >= 0.5
    row, column = np.nonzero(shown)
    spacing_m = stride * mosaic.m_per_px
    points = np.zeros((len(row), 3))
    points[:, 0] = mosaic.x_min_m + (column + 0.5) * spacing_m
    points[:, 1] = mosaic.y_max_m - (row + 0.5) * spacing_m
    # Unseen cells are black and were averaged in: divide by the share that was seen.
    rgb = _levels(colour[shown] / share[shown][:, None])[:, ::-1]
    none = np.zeros((0, 2), np.int64)
    return MapPoints(points, rgb, none, np.zeros((0, 3), np.uint8)), spacing_m


def _thinned(picture: NDArray[np.uint8], stride: int) -> NDArray[np.float32]:
    """Return the means of square groups of cells; beyond the edges all is 0."""
    rows, columns = (math.ceil(side / stride) for side in picture.shape[:2])
    right = columns * stride - picture.shape[1]
    found = np.empty((rows, columns, *picture.shape[2:]), np.float32)
    for row in range(0, rows, ROWS_AT_ONCE):
        part = picture[row * stride : (row + ROWS_AT_ONCE) * stride]
        below = -len(part) % stride
        whole = cv2.copyMakeBorder(part, 0, below, 0, right, cv2.BORDER_CONSTANT, value=0)
        size = columns, len(whole) // stride
        mean = cv2.resize(whole.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        found[row : row + size[1]] = mean
    return found


def _levels(values: NDArray[np.float32]) -> Colours:
    levels: Colours = np.clip(np.rint(values), 0, 255).astype(np.uint8)
    return levels


def track_points(
    track: Sequence[Se2], colour: Colour, longer_m: float, spacing_m: float
) -> MapPoints:
    """Return a trajectory: its corners joined by lines, and a ribbon of points.

    Args:
        track: poses in order.
        colour: BGR.
        longer_m: longer side of the map, which sizes the ribbon.
        spacing_m: of the floor's points; the ribbon's are as dense, up to 100 across.
    """
    corners = np.array([[pose.x_m, pose.y_m] for pose in track])
    half_m = RIBBON_SHARE * longer_m
    step_m = max(spacing_m, half_m / 50.0)
    across = np.arange(-half_m, half_m + step_m / 2.0, step_m)
    pieces = [corners]
    for a, b in pairwise(corners):
        length_m = float(np.hypot(*(b - a)))
        if length_m > 0.0:
            along = np.arange(0.0, length_m, step_m)[:, None, None] * (b - a) / length_m
            side = across[None, :, None] * np.array([a[1] - b[1], b[0] - a[0]]) / length_m
            pieces.append((a + along + side).reshape(-1, 2))
    flat = np.vstack(pieces)
    points = np.column_stack([flat, np.full(len(flat), LIFT_SHARE * longer_m)])
    first = np.arange(len(corners) - 1)
    edges = np.column_stack([first, first + 1])
    rgb = np.array(colour[::-1], dtype=np.uint8)
    return MapPoints(points, np.tile(rgb, (len(flat), 1)), edges, np.tile(rgb, (len(edges), 1)))


def joined(parts: Sequence[MapPoints]) -> MapPoints:
    """Return several sets of points as one; edges keep their points."""
    before = np.cumsum([0, *(len(part.points) for part in parts[:-1])])
    edges = [part.edges + start for part, start in zip(parts, before, strict=True)]
    return MapPoints(
        np.vstack([part.points for part in parts]),
        np.vstack([part.colours for part in parts]),
        np.vstack(edges),
        np.vstack([part.edge_colours for part in parts]),
    )
