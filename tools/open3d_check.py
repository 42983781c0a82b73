"""A second opinion: the same graph, optimised by Open3D from another start.

Open3D's optimiser works on SE(3): a pose gets z = roll = pitch = 0, where it stays, because every
edge says so and weighs as much there as in the plane. No edge is marked uncertain: Open3D would
re-weight and drop it. Its criteria for stopping compare numbers with units; here they are so small
that the iteration itself comes to rest.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from groundfuse.backend.measurement import (
    IDENTITY,
    FrameId,
    RelativePose,
    Se2,
    TeamEstimate,
    wrap_rad,
)
from groundfuse.frontend.arrays import Floats
from groundfuse.tools.errors import TeamError
from groundfuse.tools.open3d_import import import_open3d

MOST_FRAMES = 500
"""Open3D solves a dense system of 6 numbers per frame: 500 frames take about ten seconds."""
ITERATIONS = 500
AT_REST = 1e-14
PLANAR = (3, 4, 2)
"""Where x, y, theta stand in Open3D's information matrix: rotations first."""


@dataclass(frozen=True, slots=True)
class Differences:
    """How far Open3D's trajectories are from ours, both from the component's first frame.

    Attributes:
        num_frames: compared.
        num_edges: used by both.
        mean_m: mean distance of positions.
        max_m: largest distance.
        max_rad: largest difference of headings.
        worst: frame with the largest distance.
    """

    num_frames: int
    num_edges: int
    mean_m: float
    max_m: float
    max_rad: float
    worst: FrameId

    def line(self) -> str:
        """Return what `--check` prints."""
        return (
            f"Open3D on {self.num_frames} frames and {self.num_edges} edges: positions differ by "
            f"{self.mean_m * 1e3:.4f} mm on average, {self.max_m * 1e3:.4f} mm at {self.worst}; "
            f"headings by {math.degrees(self.max_rad):.5f} deg at most"
        )


def check_with_open3d(
    frames: Sequence[FrameId], edges: Sequence[RelativePose], estimate: TeamEstimate
) -> Differences:
    """Optimise the accepted edges between some frames with Open3D; compare with our estimate.

    Open3D starts from poses chained along the fewest edges, not from ours.

    Args:
        frames: of one component; those that the edges between them connect.
        edges: measured; those that the estimate turned down are left out.
        estimate: ours, of the pose graph with these edges.

    Raises:
        TeamError: Open3D is missing or cannot start, too many frames, or frames without connection.
    """
    order = sorted(frames)
    if len(order) > MOST_FRAMES:
        raise TeamError(
            f"Open3D's optimiser is for small graphs: at most {MOST_FRAMES} frames, "
            f"got {len(order)}"
        )
    turned_down = {(v.a, v.b) for v in estimate.verdicts if not v.accepted}
    inside = set(order)
    used = [e for e in edges if {e.a, e.b} <= inside and (e.a, e.b) not in turned_down]
    start = chained(order, used)
    theirs = optimised_by_open3d(order, start, used)
    return _compared(order, len(used), theirs, estimate.team_from_base)


def chained(frames: Sequence[FrameId], edges: Sequence[RelativePose]) -> dict[FrameId, Se2]:
    """Return poses from the first frame along the fewest edges.

    Raises:
        TeamError: a frame can't be reached.
    """
    ways: dict[FrameId, list[tuple[FrameId, Se2]]] = {frame: [] for frame in frames}
    for edge in edges:
        ways[edge.a].append((edge.b, edge.a_from_b))
        ways[edge.b].append((edge.a, edge.a_from_b.inverse()))
    first_from = {frames[0]: IDENTITY}
    waiting = [frames[0]]
    for here in waiting:  # grows as frames are reached
        for there, here_from_there in ways[here]:
            if there not in first_from:
                first_from[there] = first_from[here] @ here_from_there
                waiting.append(there)
    lost = [frame for frame in frames if frame not in first_from]
    if lost:
        raise TeamError(f"no edge leads from {frames[0]} to {lost[0]}: check one part at a time")
    return first_from


def optimised_by_open3d(
    frames: Sequence[FrameId], start: Mapping[FrameId, Se2], edges: Sequence[RelativePose]
) -> dict[FrameId, Se2]:
    """Return Open3D's poses; the first frame stays where it is.

    Raises:
        TeamError: Open3D is missing or cannot start.
    """
    open3d = import_open3d()
    registration = open3d.pipelines.registration
    number = {frame: i for i, frame in enumerate(frames)}
    graph = registration.PoseGraph()
    for frame in frames:
        graph.nodes.append(registration.PoseGraphNode(_spatial(start[frame])))
    for edge in edges:
        graph.edges.append(
            registration.PoseGraphEdge(
                number[edge.b],
                number[edge.a],
                _spatial(edge.a_from_b),
                _information(edge.covariance),
                uncertain=False,
            )
        )
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        registration.global_optimization(
            graph,
            registration.GlobalOptimizationLevenbergMarquardt(),
            _criteria(registration),
            registration.GlobalOptimizationOption(reference_node=0),
        )
    return {frame: _planar(np.asarray(graph.nodes[number[frame]].pose)) for frame in frames}


def _criteria(registration: Any) -> Any:  # noqa: ANN401 - it has no type stubs
    criteria = registration.GlobalOptimizationConvergenceCriteria()
    criteria.max_iteration = criteria.max_iteration_lm = ITERATIONS
    criteria.min_relative_increment = criteria.min_relative_residual_increment = AT_REST
    criteria.min_right_term = criteria.min_residual = AT_REST
    return criteria


def _spatial(pose: Se2) -> Floats:
    matrix = np.eye(4)
    matrix[:2, :2] = pose.matrix()[:2, :2]
    matrix[:2, 3] = pose.x_m, pose.y_m
    return matrix


def _planar(matrix: Floats) -> Se2:
    heading = math.atan2(matrix[1, 0], matrix[0, 0])
    return Se2(float(matrix[0, 3]), float(matrix[1, 3]), heading)


def _information(covariance: Floats) -> Floats:
    planar = np.linalg.inv(covariance)
    spatial = np.diag(np.full(6, float(np.mean(np.diag(planar)))))
    spatial[np.ix_(PLANAR, PLANAR)] = (planar + planar.T) / 2.0
    return spatial


def _compared(
    order: Sequence[FrameId],
    num_edges: int,
    theirs: Mapping[FrameId, Se2],
    ours: Mapping[FrameId, Se2],
) -> Differences:
    to_our, to_their = ours[order[0]].inverse(), theirs[order[0]].inverse()
    pairs = [(to_our @ ours[frame], to_their @ theirs[frame]) for frame in order]
    apart_m = [math.hypot(a.x_m - b.x_m, a.y_m - b.y_m) for a, b in pairs]
    turned = [abs(wrap_rad(a.theta_rad - b.theta_rad)) for a, b in pairs]
    worst = int(np.argmax(apart_m))
    mean_m = float(np.mean(apart_m))
    return Differences(len(order), num_edges, mean_m, apart_m[worst], max(turned), order[worst])
