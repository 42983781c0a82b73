"""Planar g2o text, read and written without loss.

Only VERTEX_SE2 and EDGE_SE2 are written, with ids from 0 without gaps: g2o's own tools silently
load nothing from 64-bit ids, and gtsam reads no edge after a FIX line or a leading comment. Numbers
are written with every digit of a double. The information matrix is the upper triangle in the order
x y theta. g2o takes an edge's error as (x, y, theta) of z^-1 a^-1 b, gtsam as its logarithm; the
matrix is the same for both, and their costs differ only by how far residuals bend.
"""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NoReturn

import numpy as np

from groundfuse.backend.measurement import Array, FrameId, RelativePose, Se2

UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
VERTEX_FIELDS = "VERTEX_SE2 id x y theta"
EDGE_FIELDS = "EDGE_SE2 id_a id_b x y theta I11 I12 I13 I22 I23 I33"


@dataclass(frozen=True, slots=True)
class Edge:
    """A measured pose of b in a with the upper triangle of its information, order x y theta."""

    a: int
    b: int
    a_from_b: Se2
    information: tuple[float, float, float, float, float, float]


@dataclass(frozen=True, slots=True)
class Graph:
    """The content of a g2o file.

    Attributes:
        vertices: pose by id, in the order of the file; empty where a file has only edges.
        edges: in the order of the file.
        fixed: ids of FIX lines.
    """

    vertices: dict[int, Se2]
    edges: tuple[Edge, ...]
    fixed: tuple[int, ...] = ()


def parsed(text: str) -> Graph:
    """Read g2o text; blank lines and comments (#) are skipped, FIX is kept.

    Raises:
        ValueError: with the line number: an unknown tag, a wrong number of fields, a field that is
            no (finite) number, a vertex given twice, an edge from a vertex to itself or to one that
            the file does not have (unless it has none at all), an information matrix that is not
            positive definite.
    """
    vertices: dict[int, Se2] = {}
    edges: list[Edge] = []
    fixed: list[int] = []
    lines_of: list[int] = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        try:
            match words[0]:
                case "VERTEX_SE2":
                    _add_vertex(vertices, words)
                case "EDGE_SE2":
                    edges.append(_edge(words))
                    lines_of.append(number)
                case "FIX":
                    fixed += [_id(word) for word in words[1:]]
                case tag:
                    _refuse(tag)
        except ValueError as error:
            raise ValueError(f"line {number}: {error}") from error
    _refuse_strangers(vertices, edges, lines_of)
    return Graph(vertices, tuple(edges), tuple(fixed))


def _refuse(tag: str) -> NoReturn:
    if tag.endswith(("SE3:QUAT", "_SE3", "3D")):
        raise ValueError(f"unknown tag {tag}: it is three-dimensional, only planar graphs are read")
    raise ValueError(f"unknown tag {tag}; VERTEX_SE2, EDGE_SE2 and FIX are read")


def _id(word: str) -> int:
    if not word.isdecimal():
        raise ValueError(f"an id must be a whole number from 0, got {word}")
    return int(word)


def _numbers(words: Sequence[str]) -> list[float]:
    numbers = [float(word) for word in words]
    for number, word in zip(numbers, words, strict=True):
        if not math.isfinite(number):
            raise ValueError(f"every number must be finite, got {word}")
    return numbers


def _add_vertex(vertices: dict[int, Se2], words: Sequence[str]) -> None:
    if len(words) != 5:
        raise ValueError(f"needs {VERTEX_FIELDS}, got {len(words)} fields")
    key = _id(words[1])
    if key in vertices:
        raise ValueError(f"vertex {key} is given twice")
    vertices[key] = Se2(*_numbers(words[2:]))


def _edge(words: Sequence[str]) -> Edge:
    if len(words) != 12:
        raise ValueError(f"needs {EDGE_FIELDS}, got {len(words)} fields")
    a, b = _id(words[1]), _id(words[2])
    if a == b:
        raise ValueError(f"an edge needs two different vertices, got {a} twice")
    numbers = _numbers(words[3:])
    i11, i12, i13, i22, i23, i33 = numbers[3:]
    smallest = float(np.linalg.eigvalsh(matrix((i11, i12, i13, i22, i23, i33)))[0])
    if smallest <= 0.0:
        raise ValueError(
            f"information must be positive definite, its smallest eigenvalue is {smallest:.3g}"
        )
    return Edge(a, b, Se2(*numbers[:3]), (i11, i12, i13, i22, i23, i33))


def _refuse_strangers(
    vertices: Mapping[int, Se2], edges: Sequence[Edge], lines_of: Sequence[int]
) -> None:
    if not vertices:
        return
    for edge, number in zip(edges, lines_of, strict=True):
        for end in (edge.a, edge.b):
            if end not in vertices:
                raise ValueError(f"line {number}: edge names vertex {end}, which the file lacks")


def matrix(upper: tuple[float, float, float, float, float, float]) -> Array:
    """Return the symmetric 3x3 matrix of an upper triangle."""
    whole = np.zeros((3, 3))
    for (i, j), value in zip(UPPER, upper, strict=True):
        whole[i, j] = whole[j, i] = value
    return whole


def text_of(graph: Graph) -> str:
    """Write g2o text; `parsed` gives back the same numbers to the bit (FIX is left out)."""
    lines = [
        f"VERTEX_SE2 {key} {_words((pose.x_m, pose.y_m, pose.theta_rad))}"
        for key, pose in graph.vertices.items()
    ]
    for edge in graph.edges:
        z = edge.a_from_b
        numbers = (z.x_m, z.y_m, z.theta_rad, *edge.information)
        lines.append(f"EDGE_SE2 {edge.a} {edge.b} {_words(numbers)}")
    return "\n".join(lines) + "\n"


def _words(numbers: Iterable[float]) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def numbered(poses: Mapping[FrameId, Se2], edges: Iterable[RelativePose]) -> Graph:
    """Return the graph with the frames, sorted by robot and index, as vertices 0, 1, 2, ...

    Edges to frames without a pose are left out.
    """
    key_of = {frame: key for key, frame in enumerate(sorted(poses))}
    some = [e for e in edges if e.a in key_of and e.b in key_of]
    return Graph(
        {key: poses[frame] for frame, key in key_of.items()},
        tuple(_of_relative_pose(e, key_of[e.a], key_of[e.b]) for e in some),
    )


def _of_relative_pose(edge: RelativePose, a: int, b: int) -> Edge:
    information = np.linalg.inv(edge.covariance)
    i11, i12, i13, i22, i23, i33 = (
        float(information[i, j] + information[j, i]) / 2.0 for i, j in UPPER
    )
    return Edge(a, b, edge.a_from_b, (i11, i12, i13, i22, i23, i33))


def relative_pose(edge: Edge, frame_of: Mapping[int, FrameId]) -> RelativePose:
    """Return the border type of an edge (ValueError where the frames are the same)."""
    covariance = np.linalg.inv(matrix(edge.information))
    a, b = frame_of[edge.a], frame_of[edge.b]
    return RelativePose(a, b, edge.a_from_b, (covariance + covariance.T) / 2.0)


def ids_text(frames: Iterable[FrameId]) -> str:
    """Return the sidecar file of `numbered`: JSON, one [robot, index] per vertex id from 0."""
    rows = [[frame.robot, frame.index] for frame in sorted(frames)]
    return json.dumps({"vertex": ["robot", "index"], "vertices": rows}, indent=None) + "\n"


def parsed_ids(text: str) -> dict[int, FrameId]:
    """Read the sidecar file.

    Raises:
        ValueError: it is not what `ids_text` writes.
    """
    content = json.loads(text)  # JSONDecodeError is a ValueError and names the line
    match content:
        case {"vertices": list(rows)}:
            return {key: _frame(key, row) for key, row in enumerate(rows)}
        case _:
            raise ValueError('needs a list "vertices"')


def _frame(key: int, row: object) -> FrameId:
    match row:
        case [str(robot), int(index)] if index >= 0:
            return FrameId(robot, index)
        case _:
            raise ValueError(f"vertex {key} needs [robot, index], got {row}")
