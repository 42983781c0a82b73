"""What fuse_graphs leaves in its folder."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

from groundfuse.backend import g2o, jrl, toro
from groundfuse.backend.graph_lines import Edge, Graph
from groundfuse.backend.measurement import Array, EdgeVerdict, FrameId, Reason, Se2, TeamEstimate
from groundfuse.backend.team_graph import TeamGraph, shared_keys
from groundfuse.backend.team_jrl import dataset_of_team, keys_with_letters, letters_of
from groundfuse.backend.team_solution import Solution, as_rows, residuals_of
from groundfuse.tools.errors import TeamError
from groundfuse.tools.files import write_atomic
from groundfuse.tools.outputs import POSE, component_name, csv_text, pose_cells

POSE_COLUMNS = ("robot", "index", "id", "component", *POSE)
EDGE_COLUMNS = (
    *("a", "b", "kind", "verdict", "weight", "chi2", "limit", "reason"),
    *("residual_x_m", "residual_y_m", "residual_theta_deg", "place"),
)

RELATIVE_COLUMNS = (
    *("a", "b", "x_m", "y_m", "theta_deg"),
    *("cov_xx_m2", "cov_xy_m2", "cov_xt_m_rad", "cov_yy_m2", "cov_yt_m_rad", "cov_tt_rad2"),
)


class Format(StrEnum):
    """What fused graphs are written in."""

    G2O = "g2o"
    TORO = "toro"
    JRL = "jrl"


@dataclass(frozen=True, slots=True, eq=False)
class Relative:
    """The pose of b in a with its covariance; None where their components are not connected."""

    a: FrameId
    b: FrameId
    a_from_b: Se2 | None
    covariance: Array | None


ENDING = {Format.G2O: ".g2o", Format.TORO: ".graph", Format.JRL: ".jrl"}


def write_tables(out: Path, team: TeamGraph, estimate: TeamEstimate) -> None:
    """Write poses.csv and edges.csv."""
    rows = [_pose_row(frame, team, estimate) for frame in team.frames]
    write_atomic(out / "poses.csv", csv_text(POSE_COLUMNS, rows))
    error = residuals_of(team.edges, estimate)
    told = zip(estimate.verdicts, error, team.places, strict=True)
    write_atomic(out / "edges.csv", csv_text(EDGE_COLUMNS, [_edge_row(*row) for row in told]))


def _pose_row(frame: FrameId, team: TeamGraph, estimate: TeamEstimate) -> list[Any]:
    name = [frame.robot, frame.index, team.key_of[frame], estimate.component_of[frame]]
    return [*name, *pose_cells(estimate.team_from_base[frame], estimate.covariance.get(frame))]


def verdict_word(verdict: EdgeVerdict) -> str:
    """Return accepted, turned_down, or open where answers of like support disagree about it."""
    if verdict.accepted:
        return "accepted"
    return "open" if verdict.reason is Reason.UNDECIDED else "turned_down"


def _edge_row(verdict: EdgeVerdict, error: Array | None, place: str) -> list[Any]:
    residual: list[float | None] = [None] * 3
    if error is not None:
        residual = [float(error[0]), float(error[1]), math.degrees(error[2])]
    chi2 = verdict.chi2 if math.isfinite(verdict.chi2) else None
    word, reason = verdict_word(verdict), verdict.reason.value if verdict.reason else None
    found = [word, float(verdict.accepted), chi2, verdict.limit, reason]
    return [verdict.a, verdict.b, verdict.kind.value, *found, *residual, place]


def write_relative(out: Path, pairs: Sequence[Relative]) -> None:
    """Write relative.csv where pairs were asked for: poses with the whole covariance."""
    rows: list[list[Any]] = []
    for one in pairs:
        numbers: list[float | None] = [None] * 9
        if one.a_from_b is not None and one.covariance is not None:
            z = one.a_from_b
            numbers = [z.x_m, z.y_m, math.degrees(z.theta_rad), *as_rows(one.covariance)]
        rows.append([one.a, one.b, *numbers])
    if rows:
        write_atomic(out / "relative.csv", csv_text(RELATIVE_COLUMNS, rows))


def output_keys(team: TeamGraph, form: Format) -> dict[FrameId, int]:
    """Return the ids to write: the input's own where they are distinct, otherwise 0, 1, 2, ...

    JRL has letters.

    Raises:
        TeamError: more robots than letters, or ids beyond 56 bits, in JRL.
    """
    if form is Format.JRL:
        try:
            letter = letters_of(frame.robot for frame in team.frames)
            return keys_with_letters(team.frames, letter)
        except ValueError as error:
            raise TeamError(f"--format jrl: {error}") from error
    if shared_keys(team.key_of):
        return {frame: k for k, frame in enumerate(team.frames)}
    return team.key_of


def write_components(
    out: Path, team: TeamGraph, estimate: TeamEstimate, parts: Sequence[Solution], form: Format
) -> None:
    """Write the fused graph of every component of two frames or more, and who its ids are."""
    key_of = output_keys(team, form)
    for part in parts:
        if len(part.frames) < 2 and part.component:
            continue
        stem = component_name("team", part.component)
        poses = {frame: estimate.team_from_base[frame] for frame in part.frames}
        chosen = [
            k
            for k, verdict in enumerate(estimate.verdicts)
            if verdict.accepted and verdict.a in poses
        ]
        text = _text(team, poses, chosen, key_of, form, stem)
        write_atomic(out / f"{stem}{ENDING[form]}", text)
        own = {frame: key_of[frame] for frame in part.frames}
        write_atomic(out / f"{stem}.ids.json", g2o.keyed_ids_text(own))


def _text(
    team: TeamGraph,
    poses: dict[FrameId, Se2],
    chosen: Sequence[int],
    key_of: dict[FrameId, int],
    form: Format,
    name: str,
) -> str:
    edges = [team.edges[k] for k in chosen]
    if form is Format.JRL:
        letter = letters_of(frame.robot for frame in team.frames)
        return jrl.text_of(dataset_of_team(name, poses, edges, letter))
    graph = g2o.keyed(key_of, poses, edges)
    exact: list[Edge] = []
    for edge, k in zip(graph.edges, chosen, strict=True):
        known = team.information[k]
        exact.append(edge if known is None else replace(edge, information=known))
    write = toro.text_of if form is Format.TORO else g2o.text_of
    return write(Graph(graph.vertices, tuple(exact)))
