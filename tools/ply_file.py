"""PLY files (binary, little endian) of coloured points joined by coloured lines."""

import numpy as np
from numpy.typing import NDArray

from groundfuse.frontend.arrays import Floats

Colours = NDArray[np.uint8]
"""(n, 3) red, green, blue."""
VERTEX = np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)])
EDGE = np.dtype([("ends", "<i4", 2), ("rgb", "u1", 3)])


def ply_bytes(
    points: Floats, colours: Colours, edges: NDArray[np.int64], edge_colours: Colours
) -> bytes:
    """Return the file's content.

    Open3D, CloudCompare and MeshLab read the points; Open3D and MeshLab the lines, too.

    Args:
        points: (n, 3) m.
        colours: (n, 3).
        edges: (m, 2) numbers of the points that are joined; none is fine.
        edge_colours: (m, 3).

    Raises:
        ValueError: as many colours as points are needed; an edge names a point that isn't there.
    """
    if len(colours) != len(points) or len(edge_colours) != len(edges):
        found = f"{len(colours)} for {len(points)} and {len(edge_colours)} for {len(edges)}"
        raise ValueError(f"every point and edge needs a colour, got {found}")
    strange = edges[(edges < 0) | (edges >= len(points))]
    if len(strange):
        raise ValueError(f"edges must name points 0 to {len(points) - 1}, got {strange[0]}")
    vertices = np.empty(len(points), VERTEX)
    vertices["xyz"], vertices["rgb"] = points, colours
    joined = np.empty(len(edges), EDGE)
    joined["ends"], joined["rgb"] = edges, edge_colours
    header = _header(len(points), len(edges))
    return header.encode("ascii") + vertices.tobytes() + joined.tobytes()


def _header(num_points: int, num_edges: int) -> str:
    rgb = [f"property uchar {name}" for name in ("red", "green", "blue")]
    lines = ["ply", "format binary_little_endian 1.0", "comment metres, z up"]
    lines += [f"element vertex {num_points}"]
    lines += [f"property float {axis}" for axis in "xyz"] + rgb
    if num_edges:
        lines += [f"element edge {num_edges}", "property int vertex1", "property int vertex2", *rgb]
    return "\n".join([*lines, "end_header", ""])
