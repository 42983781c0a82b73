"""Planar pose graphs as lines of text: what g2o and TORO share.

A line is a vertex (id x y theta), an edge (two ids, the pose of the second in the first, and six
numbers of its information) or a FIX. The dialects differ in their tags and in the order of the six
numbers. Ids are whole numbers below 2^64; a letter and a number, A12, stands for gtsam's symbol of
that name (`graph_keys`). Every number is written with all digits of a double.
"""

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from groundfuse.backend.graph_keys import MAX_KEY, key_of_symbol
from groundfuse.backend.measurement import Array, Se2

Six = tuple[float, float, float, float, float, float]
Order = tuple[tuple[int, int], ...]
UPPER: Order = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
SYMBOL = re.compile(r"([A-Za-z])(\d{1,17})", re.ASCII)


@dataclass(frozen=True, slots=True)
class Edge:
    """A measured pose of b in a with the upper triangle of its information, order x y theta."""

    a: int
    b: int
    a_from_b: Se2
    information: Six


@dataclass(frozen=True, slots=True)
class Graph:
    """The content of a file.

    Attributes:
        vertices: pose by id, in the order of the file; empty where a file has only edges.
        edges: in the order of the file.
        fixed: ids of FIX lines.
    """

    vertices: dict[int, Se2]
    edges: tuple[Edge, ...]
    fixed: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class Places:
    """Where things stand in a file, as "line 12".

    Attributes:
        vertices: by id.
        edges: in the order of the edges.
        fixed: in the order of the ids of FIX lines.
    """

    vertices: dict[int, str]
    edges: tuple[str, ...]
    fixed: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Dialect:
    """How a format says it.

    Attributes:
        vertex: tag of a vertex.
        edge: tag of an edge.
        order: place in the matrix of each of the six numbers of an information.
        numbers: names of those six, for messages.
        refusals: what to say about tags that are known and not read.
    """

    vertex: str
    edge: str
    order: Order
    numbers: str
    refusals: Mapping[str, str]

    @property
    def tags(self) -> str:
        """Return what is read, for messages."""
        return f"{self.vertex}, {self.edge} and FIX are read"


def parsed(text: str, dialect: Dialect) -> Graph:
    """Read text whose edges name its own vertices only (any ids where it has no vertex at all).

    Raises:
        ValueError: as `parsed_with_places`; an edge or a FIX names a vertex that the file lacks.
    """
    graph, places = parsed_with_places(text, dialect)
    if graph.vertices:
        for edge, place in zip(graph.edges, places.edges, strict=True):
            for end in (edge.a, edge.b):
                if end not in graph.vertices:
                    raise ValueError(f"{place}: edge names vertex {end}, which the file lacks")
        for key, place in zip(graph.fixed, places.fixed, strict=True):
            if key not in graph.vertices:
                raise ValueError(f"{place}: FIX names vertex {key}, which the file lacks")
    return graph


def parsed_with_places(text: str, dialect: Dialect) -> tuple[Graph, Places]:
    """Read text; blank lines and comments (#) are skipped, everything else is read or refused.

    Raises:
        ValueError: with the line number: an unknown tag, a wrong number of fields, a field that is
            no (finite) number, a vertex given twice, an edge from a vertex to itself, an
            information matrix that is not positive definite.
    """
    vertices: dict[int, Se2] = {}
    edges: list[Edge] = []
    fixed: list[int] = []
    vertex_at: dict[int, str] = {}
    edge_at: list[str] = []
    fixed_at: list[str] = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split("#", 1)[0].split()
        if not words:
            continue
        try:
            if words[0] == dialect.vertex:
                key = _add_vertex(vertices, words)
                vertex_at[key] = f"line {number}"
            elif words[0] == dialect.edge:
                edges.append(_edge(words, dialect))
                edge_at.append(f"line {number}")
            elif words[0] == "FIX":
                fixed += _fixed(words)
                fixed_at += [f"line {number}"] * (len(words) - 1)
            else:
                raise ValueError(_refusal(words[0], dialect))  # noqa: TRY301
        except ValueError as error:
            raise ValueError(f"line {number}: {error}") from error
    _check_information(edges, edge_at, dialect)
    places = Places(vertex_at, tuple(edge_at), tuple(fixed_at))
    return Graph(vertices, tuple(edges), tuple(fixed)), places


def _refusal(tag: str, dialect: Dialect) -> str:
    if tag in dialect.refusals:
        return f"unknown tag {tag}: {dialect.refusals[tag]}"
    if re.search(r"SE3|3D|XYZ|(VERTEX|EDGE)3", tag):
        return f"unknown tag {tag}: it is three-dimensional, only planar graphs are read"
    return f"unknown tag {tag}; {dialect.tags}"


def parsed_id(word: str) -> int:
    """Read an id.

    Raises:
        ValueError: it is neither a whole number below 2^64 nor a letter and a number.
    """
    symbol = SYMBOL.fullmatch(word)
    if symbol:
        return key_of_symbol(symbol[1], int(symbol[2]))
    if not (word.isascii() and word.isdecimal()):
        raise ValueError(f"an id must be a whole number from 0, or like A12, got {word}")
    if len(word) > 20 or int(word) > MAX_KEY:
        raise ValueError(f"an id must be below 2^64, got {word}")
    return int(word)


def _fixed(words: Sequence[str]) -> list[int]:
    if len(words) < 2:
        raise ValueError("FIX needs an id")
    return [parsed_id(word) for word in words[1:]]


def _numbers(words: Sequence[str]) -> list[float]:
    numbers = [float(word) for word in words]
    for number, word in zip(numbers, words, strict=True):
        if not math.isfinite(number):
            raise ValueError(f"every number must be finite, got {word}")
        if "_" in word:
            raise ValueError(f"could not read the number {word}")
    return numbers


def _add_vertex(vertices: dict[int, Se2], words: Sequence[str]) -> int:
    if len(words) != 5:
        raise ValueError(f"needs {words[0]} id x y theta, got {len(words)} fields")
    key = parsed_id(words[1])
    if key in vertices:
        raise ValueError(f"vertex {key} is given twice")
    vertices[key] = Se2(*_numbers(words[2:]))
    return key


def _edge(words: Sequence[str], dialect: Dialect) -> Edge:
    if len(words) != 12:
        needed = f"{dialect.edge} id_a id_b x y theta {dialect.numbers}"
        raise ValueError(f"needs {needed}, got {len(words)} fields")
    a, b = parsed_id(words[1]), parsed_id(words[2])
    if a == b:
        raise ValueError(f"an edge needs two different vertices, got {a} twice")
    numbers = _numbers(words[3:])
    told = dict(zip(dialect.order, numbers[3:], strict=True))
    i11, i12, i13, i22, i23, i33 = (told[place] for place in UPPER)
    return Edge(a, b, Se2(*numbers[:3]), (i11, i12, i13, i22, i23, i33))


def _check_information(edges: Sequence[Edge], places: Sequence[str], dialect: Dialect) -> None:
    """Refuse the first information matrix that is not positive definite."""
    smallest = _smallest([edge.information for edge in edges])
    bad = np.flatnonzero(~(smallest > 0.0))
    if not len(bad):
        return
    k = int(bad[0])
    hint = ""
    told = dict(zip(UPPER, edges[k].information, strict=True))
    as_upper = tuple(told[place] for place in dialect.order)
    if dialect.order != UPPER and _smallest([as_upper])[0] > 0.0:
        hint = "; it would be in the order of g2o, which some programs write"
    raise ValueError(
        f"{places[k]}: information must be positive definite, "
        f"its smallest eigenvalue is {smallest[k]:.3g}{hint}"
    )


def _smallest(rows: Sequence[tuple[float, ...]]) -> Array:
    """Return (m,) the smallest eigenvalues of matrices given by their upper triangles."""
    whole = np.zeros((len(rows), 3, 3))
    for k, (i, j) in enumerate(UPPER):
        whole[:, i, j] = whole[:, j, i] = [row[k] for row in rows]
    smallest: Array = np.asarray(np.linalg.eigvalsh(whole)[:, 0], dtype=np.float64)
    return smallest


def matrix(upper: Six) -> Array:
    """Return the symmetric 3x3 matrix of an upper triangle."""
    whole = np.zeros((3, 3))
    for (i, j), value in zip(UPPER, upper, strict=True):
        whole[i, j] = whole[j, i] = value
    return whole


def text_of(graph: Graph, dialect: Dialect, name_of: Callable[[int], str] = str) -> str:
    """Write text; `parsed` gives back the same content to the bit.

    FIX comes last, because gtsam reads no edge after it. `name_of` writes the ids.
    """
    lines = [
        f"{dialect.vertex} {name_of(key)} {_words((pose.x_m, pose.y_m, pose.theta_rad))}"
        for key, pose in graph.vertices.items()
    ]
    chosen = [UPPER.index(place) for place in dialect.order]
    for edge in graph.edges:
        z = edge.a_from_b
        numbers = (z.x_m, z.y_m, z.theta_rad, *(edge.information[k] for k in chosen))
        lines.append(f"{dialect.edge} {name_of(edge.a)} {name_of(edge.b)} {_words(numbers)}")
    if graph.fixed:
        lines.append(" ".join(["FIX", *map(name_of, graph.fixed)]))
    return "\n".join(lines) + "\n"


def _words(numbers: Iterable[float]) -> str:
    return " ".join(repr(float(number)) for number in numbers)
