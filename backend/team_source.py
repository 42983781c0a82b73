"""One graph file of a team, whatever its format: ids, measurements, covariances, places."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from groundfuse.backend import planar
from groundfuse.backend.graph_lines import UPPER, Graph, Places, Six
from groundfuse.backend.jrl import Between, Dataset, Values
from groundfuse.backend.measurement import Array, FrameId, Se2

FRAME = "a component's frame is that of its first frame"


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Source:
    """One file.

    Attributes:
        name: what messages call it.
        robot: whom its plain ids belong to; empty where nobody.
        own: ids of the frames that it brings; other ids in its edges are other files'.
        start: poses that it gives, by id.
        ends: (a, b) ids of every edge.
        measured: a_from_b of every edge.
        covariance: (m, 3, 3).
        information: upper triangles as the file has them; empty where it has covariances.
        vertex_places: where its poses stand.
        edge_places: where its edges stand.
        frame_of: what a sidecar file says of its ids.
        overlaps: whether it only leads between the frames of other files.
        truth: true poses by id; empty where it has none.
        wrong: per edge, whether the file calls it wrong; empty where it does not say.
        notes: what was read and is not used in fusing.
    """

    name: str
    robot: str
    own: tuple[int, ...]
    start: dict[int, Se2]
    ends: tuple[tuple[int, int], ...]
    measured: tuple[Se2, ...]
    covariance: Array
    information: tuple[Six, ...] = ()
    vertex_places: Mapping[int, str] = field(default_factory=dict)
    edge_places: tuple[str, ...] = ()
    frame_of: Mapping[int, FrameId] = field(default_factory=dict)
    overlaps: bool = False
    truth: Values = field(default_factory=dict)
    wrong: tuple[bool, ...] = ()
    notes: tuple[str, ...] = ()


def source_of_graph(
    name: str,
    robot: str,
    graph: Graph,
    places: Places,
    frame_of: Mapping[int, FrameId] | None = None,
    *,
    overlaps: bool = False,
) -> Source:
    """Return the source of a g2o or TORO file; without a vertex, all its ids are its own."""
    ends = tuple((edge.a, edge.b) for edge in graph.edges)
    bare = not graph.vertices and not overlaps
    upper = tuple(edge.information for edge in graph.edges)
    whole = np.zeros((len(upper), 3, 3))
    for k, (i, j) in enumerate(UPPER):
        whole[:, i, j] = whole[:, j, i] = [row[k] for row in upper]
    fixed = len(graph.fixed)
    return Source(
        name=name,
        robot=robot,
        own=tuple(dict.fromkeys(key for pair in ends for key in pair) if bare else graph.vertices),
        start=graph.vertices,
        ends=ends,
        measured=tuple(edge.a_from_b for edge in graph.edges),
        covariance=planar.inverted(whole),
        information=upper,
        vertex_places=places.vertices,
        edge_places=places.edges,
        frame_of=frame_of or {},
        overlaps=overlaps,
        notes=(f"{name}: {fixed} FIX read and not used: {FRAME}",) if fixed else (),
    )


def source_of_dataset(
    name: str, dataset: Dataset, frame_of: Mapping[int, FrameId] | None = None
) -> Source:
    """Return the source of a JRL file."""
    edges: list[Between] = []
    places: list[str] = []
    wrong: list[bool] = []
    prior: list[int] = []
    for robot, entries in dataset.measurements.items():
        known = set((dataset.outlier_factors or {}).get(robot, ()))
        for i, entry in enumerate(entries):
            for j, made in enumerate(entry.measurements):
                if isinstance(made, Between):
                    edges.append(made)
                    places.append(f"measurements.{robot}[{i}].measurements[{j}]")
                    wrong.append((i, j) in known)
                else:
                    prior.append(made.key)
    start = _of_owners(dataset.initialization or {})
    covariance = np.array([e.covariance for e in edges]).reshape(-1, 3, 3)
    ends = tuple((e.a, e.b) for e in edges)
    note = f"{name}: {len(prior)} priors read and not used: {FRAME}"
    return Source(
        name=name,
        robot=dataset.robots[0] if len(dataset.robots) == 1 else "",
        own=tuple(dict.fromkeys([*start, *prior, *(key for pair in ends for key in pair)])),
        start=start,
        ends=ends,
        measured=tuple(e.a_from_b for e in edges),
        covariance=(covariance + np.swapaxes(covariance, 1, 2)) / 2.0,
        vertex_places=dict.fromkeys(start, "initialization"),
        edge_places=tuple(places),
        frame_of=frame_of or {},
        truth=_of_owners(dataset.groundtruth or {}),
        wrong=() if dataset.outlier_factors is None else tuple(wrong),
        notes=(note,) if prior else (),
    )


def _of_owners(values: Mapping[str, Values]) -> Values:
    """Return every pose once: as its own robot has it, where several robots give it."""
    merged: Values = {}
    for robot, own in values.items():
        for key, pose in own.items():
            if key not in merged or key >> 56 == ord(robot):
                merged[key] = pose
    return merged
