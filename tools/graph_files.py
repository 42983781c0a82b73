"""Graph files of a team: g2o, TORO and JRL are told apart by what stands in them."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from groundfuse.backend import g2o, jrl_reader, toro
from groundfuse.backend.graph_keys import AUTO, KeyScheme
from groundfuse.backend.measurement import FrameId
from groundfuse.backend.team_graph import TeamGraph, team_graph
from groundfuse.backend.team_source import Source, source_of_dataset, source_of_graph
from groundfuse.tools.errors import DataError
from groundfuse.tools.files import read_text

FIRST_WORD = re.compile(r"^[ \t]*([^\s#]+)", re.MULTILINE)
TORO_TAG = re.compile(r"(VERTEX|EDGE)[23]?|EQUIV")


def read_source(path: Path, *, overlaps: bool = False) -> Source:
    """Read one file; beside X.g2o, X.ids.json may say which robot and frame every id is.

    Raises:
        DataError: unreadable, or what its reader refuses, with the line.
    """
    text = read_text(path)
    try:
        frame_of = _sidecar(path)
        return _source(path, text, frame_of, overlaps=overlaps)
    except ValueError as error:
        raise DataError(f"{path}: {error}") from error


def _source(path: Path, text: str, frame_of: Mapping[int, FrameId], *, overlaps: bool) -> Source:
    first = FIRST_WORD.search(text)
    if first and first[1].startswith(("{", "[")):
        return source_of_dataset(str(path), jrl_reader.parsed(text), frame_of)
    is_toro = first is not None and TORO_TAG.fullmatch(first[1]) is not None
    read = toro.parsed_with_places if is_toro else g2o.parsed_with_places
    graph, places = read(text)
    if not graph.vertices and not graph.edges and not overlaps:
        raise ValueError("holds no vertex and no edge")
    return source_of_graph(str(path), path.stem, graph, places, frame_of, overlaps=overlaps)


def _sidecar(path: Path) -> dict[int, FrameId]:
    beside = path.with_name(f"{path.stem}.ids.json")
    if not beside.is_file():
        return {}
    try:
        return g2o.parsed_ids(read_text(beside))
    except ValueError as error:
        raise DataError(f"{beside}: {error}") from error


def read_team_graph(
    paths: Sequence[Path], overlaps: Sequence[Path] = (), scheme: KeyScheme = AUTO
) -> TeamGraph:
    """Read a team: one file of all robots, or one per robot and files of overlaps.

    Raises:
        DataError: as `read_source`, a file given twice, or files that do not fit together.
    """
    every = [*paths, *overlaps]
    for k, path in enumerate(every):
        if path.resolve() in [other.resolve() for other in every[:k]]:
            raise DataError(f"{path}: given twice")
    sources = [read_source(path) for path in paths]
    sources += [read_source(path, overlaps=True) for path in overlaps]
    try:
        return team_graph(sources, scheme)
    except ValueError as error:
        raise DataError(str(error)) from error
