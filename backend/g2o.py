"""Planar g2o text, read and written without loss.

VERTEX_SE2, EDGE_SE2 and FIX. What this project writes has ids from 0 without gaps: g2o's own tools
silently load nothing from 64-bit ids, and gtsam reads no edge after a FIX line or a leading
comment. The information matrix is the upper triangle in the order x y theta. g2o takes an edge's
error as (x, y, theta) of z^-1 a^-1 b, gtsam as its logarithm; the matrix is the same for both, and
their costs differ only by how far residuals bend.
"""

import json
from collections.abc import Callable, Iterable, Mapping
from itertools import count

import numpy as np

from groundfuse.backend import graph_lines
from groundfuse.backend.graph_lines import UPPER, Dialect, Edge, Graph, Places, matrix
from groundfuse.backend.measurement import FrameId, RelativePose, Se2

__all__ = ["Edge", "Graph", "matrix"]

DIALECT = Dialect(
    vertex="VERTEX_SE2",
    edge="EDGE_SE2",
    order=UPPER,
    numbers="I11 I12 I13 I22 I23 I33",
    refusals={"VERTEX2": "it is TORO's", "EDGE2": "it is TORO's"},
)


def parsed(text: str) -> Graph:
    """Read g2o text; blank lines and comments (#) are skipped.

    Raises:
        ValueError: with the line number: an unknown tag, a wrong number of fields, a field that is
            no (finite) number, a vertex given twice, an edge from a vertex to itself or to one that
            the file does not have (unless it has none at all), an information matrix that is not
            positive definite.
    """
    return graph_lines.parsed(text, DIALECT)


def parsed_with_places(text: str) -> tuple[Graph, Places]:
    """Read one file of several: edges may name vertices of the others (ValueError as `parsed`)."""
    return graph_lines.parsed_with_places(text, DIALECT)


def text_of(graph: Graph, name_of: Callable[[int], str] = str) -> str:
    """Write g2o text; `parsed` gives back the same content to the bit."""
    return graph_lines.text_of(graph, DIALECT, name_of)


def numbered(poses: Mapping[FrameId, Se2], edges: Iterable[RelativePose]) -> Graph:
    """Return the graph with the frames, sorted by robot and index, as vertices 0, 1, 2, ...

    Edges to frames without a pose are left out.
    """
    return keyed(dict(zip(sorted(poses), count(), strict=False)), poses, edges)


def keyed(
    key_of: Mapping[FrameId, int], poses: Mapping[FrameId, Se2], edges: Iterable[RelativePose]
) -> Graph:
    """Return the graph with the frames, sorted by robot and index, under ids of their own.

    Edges to frames without a pose are left out.
    """
    some = [e for e in edges if e.a in poses and e.b in poses]
    every = np.linalg.inv(np.array([e.covariance for e in some]).reshape(-1, 3, 3))
    upper = np.stack([(every[:, i, j] + every[:, j, i]) / 2.0 for i, j in UPPER], axis=1)
    return Graph(
        {key_of[frame]: poses[frame] for frame in sorted(poses)},
        tuple(
            Edge(key_of[e.a], key_of[e.b], e.a_from_b, (i11, i12, i13, i22, i23, i33))
            for e, (i11, i12, i13, i22, i23, i33) in zip(some, upper.tolist(), strict=True)
        ),
    )


def relative_pose(edge: Edge, frame_of: Mapping[int, FrameId]) -> RelativePose:
    """Return the border type of an edge (ValueError where the frames are the same)."""
    covariance = np.linalg.inv(matrix(edge.information))
    a, b = frame_of[edge.a], frame_of[edge.b]
    return RelativePose(a, b, edge.a_from_b, (covariance + covariance.T) / 2.0)


def ids_text(frames: Iterable[FrameId]) -> str:
    """Return the sidecar file of `numbered`: JSON, one [robot, index] per vertex id from 0."""
    rows = [[frame.robot, frame.index] for frame in sorted(frames)]
    return json.dumps({"vertex": ["robot", "index"], "vertices": rows}, indent=None) + "\n"


def keyed_ids_text(key_of: Mapping[FrameId, int]) -> str:
    """Return the sidecar file of `keyed`: as `ids_text`, and the id of every vertex."""
    rows = [[frame.robot, frame.index] for frame in sorted(key_of)]
    ids = [key_of[frame] for frame in sorted(key_of)]
    return json.dumps({"vertex": ["robot", "index"], "ids": ids, "vertices": rows}) + "\n"


def parsed_ids(text: str) -> dict[int, FrameId]:
    """Read the sidecar file.

    Raises:
        ValueError: it is not what `ids_text` or `keyed_ids_text` writes.
    """
    content = json.loads(text)  # JSONDecodeError is a ValueError and names the line
    match content:
        case {"ids": list(ids), "vertices": list(rows)}:
            if len(ids) != len(rows) or len(set(map(str, ids))) != len(ids):
                raise ValueError(f"needs one id per vertex, got {len(ids)} for {len(rows)}")
            keys = [_key(key) for key in ids]
        case {"vertices": list(rows)}:
            keys = list(range(len(rows)))
        case _:
            raise ValueError('needs a list "vertices"')
    frames = [_frame(key, row) for key, row in zip(keys, rows, strict=True)]
    if len(set(frames)) != len(frames):
        raise ValueError("a frame is given twice")
    return dict(zip(keys, frames, strict=True))


def _key(key: object) -> int:
    if isinstance(key, bool) or not isinstance(key, int) or key < 0:
        raise ValueError(f"an id must be a whole number from 0, got {key}")
    return key


def _frame(key: int, row: object) -> FrameId:
    match row:
        case [str(robot), int(index)] if index >= 0 and not isinstance(index, bool):
            return FrameId(robot, index)
        case _:
            raise ValueError(f"vertex {key} needs [robot, index], got {row}")
