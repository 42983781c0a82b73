"""What the main job leaves in the out folder, apart from pictures."""

import csv
import io
import json
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from groundfuse.backend import g2o
from groundfuse.backend.bundle_estimate import BundleEstimate
from groundfuse.backend.measurement import (
    Array,
    EdgeVerdict,
    FrameId,
    Rejected,
    RelativePose,
    Se2,
    TeamEstimate,
)
from groundfuse.backend.trajectory import tum_text
from groundfuse.frontend.decomposition import gamma
from groundfuse.tools.errors import TeamError
from groundfuse.tools.files import write_atomic
from groundfuse.tools.pipeline import Fused, bundle_rejected, used_edges
from groundfuse.tools.team_graphs import accepted_edges

SIGMAS = ("sigma_x_m", "sigma_y_m", "sigma_theta_deg")
POSE = ("x_m", "y_m", "theta_deg", *SIGMAS)
VERDICT = ("a", "b", "verdict", "reason", "value", "limit")
GAMMA = ("rho_m", "phi1_deg", "phi2_deg")  # the paper's relative location, eq. 18
PAIR_COLUMNS = (*VERDICT, *POSE, *GAMMA, "inliers", "ambiguity", "chi2")
ATTITUDE_COLUMNS = (
    *("robot", "index", "image", "tilt_deg", "tilt_sigma_deg", "roll_deg", "roll_sigma_deg"),
    *("height_m", "height_sigma_m"),
)
POSE_COLUMNS = ("robot", "index", "image", "component", *POSE)


AS_THEY_ARE = frozenset({type(None), float, int, str})
"""What Python's CSV writer writes as we would: nothing, or every digit."""


def check_names(robots: Iterable[str]) -> None:
    """Refuse robots whose files would overwrite others' (TeamError)."""
    names = sorted(robots)
    for name in names:
        for other in ("team", *names):
            parts = rf"{re.escape(other)}(_chained|_groundtruth)?(_\d+)?"
            if re.fullmatch(parts, name) and (name != other or other == "team"):
                raise TeamError(
                    f"robot {name!r}: its files would be taken for {other}'s, rename it"
                )


def files_before(out: Path, begin_s: float) -> list[str]:
    """Return the files that were there already and have not been written since a time.

    Stores and their locks outlast runs.
    """
    files = (path for path in out.iterdir() if path.is_file() and ".sqlite" not in path.name)
    return sorted(path.name for path in files if path.stat().st_mtime < begin_s)


def clear_parts(out: Path) -> None:
    """Remove what runs that were killed left half written; see `write_atomic`."""
    for folder in (out, out / "overhead"):
        for path in folder.glob(f".{'[0-9a-f]' * 16}.part"):
            path.unlink(missing_ok=True)


def csv_text(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return CSV text with every digit of every number."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(
        [value if type(value) in AS_THEY_ARE else _word(value) for value in row] for row in rows
    )
    return stream.getvalue()


def _word(value: object) -> str:
    return repr(float(value)) if isinstance(value, float) else str(value)


def write_pairs(out: Path, fused: Fused) -> None:
    """Write pairs.csv: every pair that was tried, with its verdict and its numbers."""
    late = {(r.a, r.b): r for r in bundle_rejected(fused)}
    # The verdicts are in the order of the edges: the front-end's come first, odometry's follow.
    edges = zip(fused.front_end.edges, fused.team.verdicts, strict=False)
    rows = [_accepted_row(e, v, late.get((e.a, e.b))) for e, v in edges]
    rows += [_rejected_row(r) for r in fused.front_end.rejected]
    write_atomic(out / "pairs.csv", csv_text(PAIR_COLUMNS, sorted(rows, key=_pair_order)))


def _pair_order(row: Sequence[Any]) -> tuple[FrameId, FrameId]:
    return row[0], row[1]


def _accepted_row(edge: RelativePose, graph: EdgeVerdict, late: Rejected | None) -> list[Any]:
    verdict: list[Any] = ["used", None, None, None]
    if graph.reason is not None:
        verdict = ["turned_down", graph.reason.value, graph.chi2, graph.limit]
    elif late is not None:
        verdict = ["turned_down", late.reason.value, late.value, late.limit]
    pose = pose_cells(edge.a_from_b, edge.covariance)
    found = [edge.num_inliers, edge.ambiguity, graph.chi2]
    seen = gamma(edge.a_from_b)
    bearings = [seen.rho_m, math.degrees(seen.phi1_rad), math.degrees(seen.phi2_rad)]
    return [edge.a, edge.b, *verdict, *pose, *bearings, *found]


def _rejected_row(rejected: Rejected) -> list[Any]:
    reason = [rejected.reason.value, float(rejected.value), float(rejected.limit)]
    return [rejected.a, rejected.b, "rejected", *reason, *[None] * 12]


def write_graphs(out: Path, fused: Fused) -> None:
    """Write each robot's own optimised graph, and the team's: one g2o file per component."""
    for name, alone in fused.alone.items():
        inner = [e for e in fused.edges if e.a.robot == e.b.robot == name]
        _write_components(out, name, alone.optimised, accepted_edges(alone.optimised, inner))
    _write_components(out, "team", fused.best, used_edges(fused))


def _write_components(
    out: Path, name: str, estimate: TeamEstimate, edges: Sequence[RelativePose]
) -> None:
    for component in sorted(set(estimate.component_of.values())):
        poses = _component(estimate, component)
        stem = component_name(name, component)
        write_atomic(out / f"{stem}.g2o", g2o.text_of(g2o.numbered(poses, edges)))
        write_atomic(out / f"{stem}.ids.json", g2o.ids_text(poses))


def component_name(name: str, component: int) -> str:
    """Return the stem of a component's files: the largest has no number."""
    return name if component == 0 else f"{name}_{component}"


def _component(estimate: TeamEstimate, component: int) -> dict[FrameId, Se2]:
    return {
        frame: pose
        for frame, pose in estimate.team_from_base.items()
        if estimate.component_of[frame] == component
    }


def write_trajectories(out: Path, fused: Fused) -> None:
    """Write TUM files: every robot in the team frame, chained in its own, and the true one."""
    best = fused.best
    for robot in fused.robots:
        time_s = {frame.id: frame.time_s for frame in robot.frames}

        def stamped(poses: dict[FrameId, Se2], times: dict[FrameId, float] = time_s) -> str:
            return tum_text((times[f], poses[f]) for f in sorted(poses) if f in times)

        for component in sorted({best.component_of[frame] for frame in time_s}):
            stem = component_name(robot.name, component)
            write_atomic(out / f"{stem}.tum", stamped(_component(best, component)))
        alone = fused.alone[robot.name]
        for fragment in sorted(set(alone.fragment_of.values())):
            poses = {f: p for f, p in alone.chained.items() if alone.fragment_of[f] == fragment}
            stem = component_name(f"{robot.name}_chained", fragment)
            write_atomic(out / f"{stem}.tum", stamped(poses))
        if robot.truth:
            write_atomic(out / f"{robot.name}_groundtruth.tum", stamped(robot.truth))


def write_poses(out: Path, fused: Fused) -> None:
    """Write poses.csv: every frame in its component's frame, with standard deviations."""
    best, frames = fused.best, fused.frames
    rows: list[list[Any]] = []
    for frame, pose in sorted(best.team_from_base.items()):
        where = pose_cells(pose, best.covariance.get(frame))
        image = frames[frame][1].path.name
        rows.append([frame.robot, frame.index, image, best.component_of[frame], *where])
    write_atomic(out / "poses.csv", csv_text(POSE_COLUMNS, rows))


def pose_cells(pose: Se2, covariance: Array | None) -> list[float | None]:
    """Return m, m, deg and their standard deviations, empty where there are none."""
    where = [pose.x_m, pose.y_m, math.degrees(pose.theta_rad)]
    if covariance is None:
        return [*where, None, None, None]
    x_m, y_m, theta_rad = (math.sqrt(covariance[k, k]) for k in range(3))
    return [*where, x_m, y_m, math.degrees(theta_rad)]


def write_attitudes(out: Path, fused: Fused) -> None:
    """Write frames_estimated.csv: every frame's bundled tilt, roll and height with sigmas."""
    if not isinstance(fused.bundled, BundleEstimate):
        return
    found, spread = fused.bundled.attitude, fused.bundled.attitude_sigma
    rows = []
    for frame, (_, known) in sorted(fused.frames.items()):
        if frame in found:
            here, sigma = found[frame], spread[frame]
            angles = [here.tilt_rad, sigma.tilt_rad, here.roll_rad, sigma.roll_rad]
            height = [here.height_m, sigma.height_m]
            image = known.path.name
            rows.append([frame.robot, frame.index, image, *map(math.degrees, angles), *height])
    write_atomic(out / "frames_estimated.csv", csv_text(ATTITUDE_COLUMNS, rows))


def write_json(path: Path, content: object) -> None:
    """Write JSON that a person can read; infinity becomes null."""
    write_atomic(path, json.dumps(_finite(content), indent=2) + "\n")


def _finite(content: object) -> object:
    if isinstance(content, dict):
        return {str(key): _finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_finite(value) for value in content]
    if isinstance(content, float) and not math.isfinite(content):
        return None
    return content
