"""Drift in numbers: chained, optimised and bundled, per robot and for the team."""

from collections.abc import Mapping
from typing import Any

from groundfuse.backend.drift import (
    Poses,
    accuracy,
    between_robots,
    closing,
    path_length_m,
)
from groundfuse.backend.measurement import FrameId, Se2, TeamEstimate
from groundfuse.tools.pair_scores import pair_scores
from groundfuse.tools.pipeline import Fused
from groundfuse.tools.team_graphs import accepted_edges


def drift_record(fused: Fused) -> dict[str, Any]:
    """Return drift.json's content: per robot and team, a row per stage; null where unknown."""
    truth: dict[FrameId, Se2] = {}
    for robot in fused.robots:
        truth.update(robot.truth or {})
    stages = _stages(fused)
    accepted = accepted_edges(fused.team, fused.edges)
    robots = {
        robot.name: {
            stage: _robot_row(poses, fused, robot.name, truth, accepted)
            for stage, poses in stages.items()
        }
        for robot in fused.robots
    }
    team = {
        stage: _team_row(_largest(estimate), truth) for stage, estimate in _estimates(fused).items()
    }
    heights = {frame: known.attitude.height_m for frame, (_, known) in fused.frames.items()}
    return {
        "robots": robots,
        "team": team,
        "pairs": pair_scores(fused.front_end.edges, truth, heights),
        "has_ground_truth": bool(truth),
    }


def _estimates(fused: Fused) -> dict[str, TeamEstimate]:
    estimates = {"optimised": fused.team}
    if fused.best is not fused.team:
        estimates["bundled"] = fused.best
    return estimates


def _stages(fused: Fused) -> dict[str, Mapping[str, list[Poses]]]:
    """Poses of every stage: per robot, the pieces that share a frame."""
    chained: dict[str, list[Poses]] = {}
    for name, alone in fused.alone.items():
        pieces: dict[int, dict[FrameId, Se2]] = {}
        for frame, pose in alone.chained.items():
            pieces.setdefault(alone.fragment_of[frame], {})[frame] = pose
        chained[name] = [pieces[k] for k in sorted(pieces)]
    stages: dict[str, Mapping[str, list[Poses]]] = {"chained": chained}
    for stage, estimate in _estimates(fused).items():
        per_robot: dict[str, list[Poses]] = {}
        for name in fused.alone:
            parts: dict[int, dict[FrameId, Se2]] = {}
            for frame, pose in estimate.team_from_base.items():
                if frame.robot == name:
                    parts.setdefault(estimate.component_of[frame], {})[frame] = pose
            per_robot[name] = [parts[k] for k in sorted(parts)]
        stages[stage] = per_robot
    return stages


def _robot_row(
    pieces_of: Mapping[str, list[Poses]],
    fused: Fused,
    name: str,
    truth: Poses,
    accepted: list[Any],
) -> dict[str, Any]:
    """The longest piece's numbers, and how many pieces there are."""
    pieces = sorted(pieces_of[name], key=len, reverse=True)
    longest = pieces[0]
    loop = closing(longest, accepted, name)
    row: dict[str, Any] = {
        "num_pieces": len(pieces),
        "num_frames": len(longest),
        "num_frames_in_all": len(fused.alone[name].chained),
        "path_m": path_length_m(longest),
        "closing": None,
        "against_truth": None,
    }
    if loop is not None:
        row["closing"] = {
            "first": str(loop.first),
            "last": str(loop.last),
            "error_m": loop.error_m,
            "error_rad": loop.error_rad,
            "path_m": loop.path_m,
            "percent": loop.percent,
        }
    score = accuracy(longest, truth)
    if score is not None:
        row["against_truth"] = score._asdict()
    return row


def _largest(estimate: TeamEstimate) -> Poses:
    return {
        frame: pose
        for frame, pose in estimate.team_from_base.items()
        if estimate.component_of[frame] == 0
    }


def _team_row(poses: Poses, truth: Poses) -> dict[str, Any]:
    score, between = accuracy(poses, truth), between_robots(poses, truth)
    return {
        "num_frames": len(poses),
        "path_m": path_length_m(poses),
        "against_truth": None if score is None else score._asdict(),
        "between_robots": None if between is None else between._asdict(),
    }
