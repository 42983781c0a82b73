"""Planar TORO text (.graph), read and written without loss.

VERTEX2 and EDGE2, whose information is told as forward-forward, forward-sideward,
sideward-sideward, rotation-rotation, forward-rotation, sideward-rotation. The measurement is the
pose of the second vertex in the first, as gtsam's load2D reads it.
"""

from collections.abc import Callable

from groundfuse.backend import graph_lines
from groundfuse.backend.graph_lines import Dialect, Graph, Places

DIALECT = Dialect(
    vertex="VERTEX2",
    edge="EDGE2",
    order=((0, 0), (0, 1), (1, 1), (2, 2), (0, 2), (1, 2)),
    numbers="I11 I12 I22 I33 I13 I23",
    refusals={
        "VERTEX_SE2": "it is g2o's",
        "EDGE_SE2": "it is g2o's",
        "EQUIV": "equal vertices are not merged, give them one id",
    },
)


def parsed(text: str) -> Graph:
    """Read TORO text; blank lines and comments (#) are skipped.

    Raises:
        ValueError: as `g2o.parsed`.
    """
    return graph_lines.parsed(text, DIALECT)


def parsed_with_places(text: str) -> tuple[Graph, Places]:
    """Read one file of several: edges may name vertices of the others (ValueError as `parsed`)."""
    return graph_lines.parsed_with_places(text, DIALECT)


def text_of(graph: Graph, name_of: Callable[[int], str] = str) -> str:
    """Write TORO text; `parsed` gives back the same content to the bit."""
    return graph_lines.text_of(graph, DIALECT, name_of)
