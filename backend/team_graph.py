"""One team out of several graph files: which frame every id means, and every edge once.

A robot's file brings its own frames; a file of overlaps leads between those of others. Ids with a
robot's letter, or in an offset scheme, name their frame wherever they stand; plain ids belong to
the robot of their file, and in a file of overlaps to the one robot that has them.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from groundfuse.backend.graph_keys import AUTO, KeyScheme, named_frame
from groundfuse.backend.graph_lines import Six
from groundfuse.backend.measurement import FrameId, RelativePose, Se2
from groundfuse.backend.team_source import Source

FAR = 1e9  # m, rad: beyond it doubles do not resolve a step of a robot
VARIANCES = (1e-24, 1e24)  # m^2, rad^2: beyond these are slips


@dataclass(frozen=True, slots=True, eq=False)
class TeamGraph:
    """A team.

    Attributes:
        frames: in order of robot and index.
        edges: in the order of the files.
        places: of every edge, as "overlaps.g2o: line 12".
        information: of every edge as its file has it, None where that has a covariance.
        key_of: the id of every frame; ids of different robots may be the same.
        start: poses that the files give.
        truth: true poses, where a file has them.
        wrong: per edge, whether a file calls it wrong; None where no file says.
        notes: what was read and is not used in fusing.
        names: who owns which id.
    """

    frames: tuple[FrameId, ...]
    edges: tuple[RelativePose, ...]
    places: tuple[str, ...]
    information: tuple[Six | None, ...]
    key_of: dict[FrameId, int]
    start: dict[FrameId, Se2]
    truth: dict[FrameId, Se2]
    wrong: tuple[bool | None, ...]
    notes: tuple[str, ...]
    names: "Names"


@dataclass(frozen=True, slots=True, eq=False)
class Names:
    """Who owns which id.

    Attributes:
        scheme: how ids name frames.
        key_of: the id of every frame.
        plain: frames of every plain id; several where robots share it.
    """

    scheme: KeyScheme
    key_of: dict[FrameId, int] = field(default_factory=dict)
    plain: dict[int, list[FrameId]] = field(default_factory=dict)


def team_graph(sources: Sequence[Source], scheme: KeyScheme = AUTO) -> TeamGraph:
    """Join the files of a team.

    Raises:
        ValueError: with file and place: nothing to fuse, an id that no file has or that two robots
            share, a pose given twice and differently, an edge of two frames that are the same, or
            numbers out of range.
    """
    names = _names(sources, scheme)
    if not names.key_of:
        raise ValueError(f"{sources[0].name}: holds no vertex and no edge")
    start: dict[FrameId, Se2] = {}
    truth: dict[FrameId, Se2] = {}
    for source in sources:
        _add_poses(source, names, start)
        truth |= poses_of(source.truth, source, names)
    edges: list[RelativePose] = []
    places: list[str] = []
    information: list[Six | None] = []
    wrong: list[bool | None] = []
    kept, twice = _once(sources, names)
    for source, k, a, b in kept:
        edges.append(_edge(source, k, a, b))
        places.append(f"{source.name}: {source.edge_places[k]}")
        information.append(source.information[k] if source.information else None)
        wrong.append(source.wrong[k] if source.wrong else None)
    notes = [note for source in sources for note in source.notes]
    if twice:
        notes.append(f"{twice} edges stand in two files and count once")
    return TeamGraph(
        tuple(sorted(names.key_of)),
        tuple(edges),
        tuple(places),
        tuple(information),
        names.key_of,
        start,
        truth,
        tuple(wrong),
        tuple(notes),
        names,
    )


def _names(sources: Sequence[Source], scheme: KeyScheme) -> Names:
    """Find every robot's own frames."""
    names = Names(scheme)
    file_of: dict[str, str] = {}
    for source in sources:
        for key in source.own:
            place = source.vertex_places.get(key, "its edges")
            frame = _named(source, key, place, scheme)
            if frame is None and source.overlaps:
                raise ValueError(f"{source.name}: {place}: vertex {key} belongs to no robot")
            if frame is None:
                if not source.robot:
                    raise ValueError(f"{source.name}: id {key} has no robot's letter")
                if file_of.setdefault(source.robot, source.name) != source.name:
                    raise ValueError(
                        f"{source.name}: robot {source.robot} is that of "
                        f"{file_of[source.robot]} too, rename one file"
                    )
                frame = FrameId(source.robot, key)
                names.plain.setdefault(key, []).append(frame)
            names.key_of.setdefault(frame, key)
    return names


def poses_of(values: Mapping[int, Se2], source: Source, names: Names) -> dict[FrameId, Se2]:
    """Return poses by frame; those of frames that the team does not have are left out."""
    found: dict[FrameId, Se2] = {}
    for key, pose in values.items():
        frame = _named(source, key, "groundtruth", names.scheme)
        owners = names.plain.get(key, [])
        if frame is None and len(owners) == 1:
            frame = owners[0]
        if frame in names.key_of:
            found[frame] = pose
    return found


def _named(source: Source, key: int, place: str, scheme: KeyScheme) -> FrameId | None:
    if key in source.frame_of:
        return source.frame_of[key]
    try:
        return named_frame(key, scheme)
    except ValueError as error:
        raise ValueError(f"{source.name}: {place}: {error}") from error


def _frame(source: Source, key: int, place: str, names: Names, own: Iterable[int] = ()) -> FrameId:
    """Return the frame that an id means in a file."""
    frame = _named(source, key, place, names.scheme)
    if frame is None and key in own:
        frame = FrameId(source.robot, key)
    if frame is None:
        owners = names.plain.get(key, [])
        if len(owners) > 1:
            robots = ", ".join(sorted(owner.robot for owner in owners))
            raise ValueError(
                f"{source.name}: {place}: id {key} is a frame of {robots} alike; "
                "name robots by letters (A12), or keys by an offset"
            )
        frame = owners[0] if owners else None
    if frame is None or frame not in names.key_of:
        what = f"frame {frame}" if frame else f"vertex {key}"
        raise ValueError(f"{source.name}: {place}: names {what}, which no file has")
    return frame


def _add_poses(source: Source, names: Names, start: dict[FrameId, Se2]) -> None:
    own = set(source.own)
    for key, pose in source.start.items():
        place = source.vertex_places[key]
        frame = _frame(source, key, place, names, own)
        if max(abs(pose.x_m), abs(pose.y_m), abs(pose.theta_rad)) > FAR:
            raise ValueError(f"{source.name}: {place}: a number is beyond {FAR:g}")
        if source.overlaps and frame in start:
            continue  # repeated for its edges; the robot's own file counts
        if start.setdefault(frame, pose) != pose:
            raise ValueError(f"{source.name}: {place}: vertex {frame} is another file's, elsewhere")


def _once(
    sources: Sequence[Source], names: Names
) -> tuple[list[tuple[Source, int, FrameId, FrameId]], int]:
    """Return the edges and how many were left out: the same one in two files is one measurement."""
    kept: list[tuple[Source, int, FrameId, FrameId]] = []
    first: dict[object, int] = {}
    twice = 0
    for number, source in enumerate(sources):
        own = () if source.overlaps else set(source.own)
        for k, ends in enumerate(source.ends):
            place = source.edge_places[k]
            a, b = (_frame(source, key, f"{place}: edge", names, own) for key in ends)
            same = (a, b, source.measured[k], source.covariance[k].tobytes())
            if first.setdefault(same, number) != number:
                twice += 1
                continue
            kept.append((source, k, a, b))
    return kept, twice


def _edge(source: Source, k: int, a: FrameId, b: FrameId) -> RelativePose:
    z, covariance = source.measured[k], source.covariance[k]
    try:
        if max(abs(z.x_m), abs(z.y_m), abs(z.theta_rad)) > FAR:
            raise ValueError(f"a number is beyond {FAR:g}")  # noqa: TRY301
        if not np.all(
            (covariance.diagonal() > VARIANCES[0]) & (covariance.diagonal() < VARIANCES[1])
        ):
            raise ValueError(f"a variance is beyond {VARIANCES[0]:g} to {VARIANCES[1]:g}")  # noqa: TRY301
        return RelativePose(a, b, z, covariance)
    except ValueError as error:
        raise ValueError(f"{source.name}: {source.edge_places[k]}: {error}") from error


def shared_keys(key_of: Mapping[FrameId, int]) -> bool:
    """Return whether two frames have the same id."""
    return len(set(key_of.values())) < len(key_of)
