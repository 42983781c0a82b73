"""One connected part of the team, sorted out for drawing."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from itertools import pairwise

import numpy as np

from groundfuse.backend.measurement import FrameId, Rejected, RelativePose, Se2, TeamEstimate
from groundfuse.frontend.arrays import Floats


class EdgeKind(IntEnum):
    """What an edge is drawn as, in the order of drawing."""

    REJECTED = 0
    LOOP = 1
    OVERLAP = 2
    NEIGHBOUR = 3


@dataclass(frozen=True, slots=True, eq=False)
class Graph:
    """One component, ready to be drawn.

    Attributes:
        poses: pose of every frame of the component, in the order of frames.
        robots: names in the order of their colours.
        edges: pairs of frames by kind.
        covariance: (2, 2) of the position in the team's frame, per frame that has one.
        base_from_foot: per robot, where its camera looks from.
    """

    poses: Mapping[FrameId, Se2]
    robots: Sequence[str]
    edges: Mapping[EdgeKind, Sequence[tuple[FrameId, FrameId]]]
    covariance: Mapping[FrameId, Floats]
    base_from_foot: Mapping[str, Se2]

    def track(self, robot: str) -> list[FrameId]:
        """Return a robot's frames in order."""
        return [frame for frame in self.poses if frame.robot == robot]

    def places(self) -> Floats:
        """Return the positions (n, 2) of all frames, m."""
        return np.array([[pose.x_m, pose.y_m] for pose in self.poses.values()])

    def usual_step_m(self) -> float:
        """Return the median distance from one frame to the robot's next; 0 with single frames."""
        tracks = ([self.poses[frame] for frame in self.track(robot)] for robot in self.robots)
        steps = [
            math.hypot(b.x_m - a.x_m, b.y_m - a.y_m) for track in tracks for a, b in pairwise(track)
        ]
        return float(np.median(steps)) if steps else 0.0


def graph_of(
    estimate: TeamEstimate,
    edges: Sequence[RelativePose | Rejected],
    component: int,
    base_from_foot: Mapping[str, Se2],
) -> Graph:
    """Sort out what belongs to one component.

    Raises:
        ValueError: the component has no frame.
    """
    inside = sorted(f for f, number in estimate.component_of.items() if number == component)
    if not inside:
        raise ValueError(f"no frame belongs to component {component}")
    poses = {frame: estimate.team_from_base[frame] for frame in inside}
    turned_down = {(v.a, v.b) for v in estimate.verdicts if not v.accepted}
    kinds: dict[EdgeKind, list[tuple[FrameId, FrameId]]] = {kind: [] for kind in EdgeKind}
    for edge in edges:
        if edge.a in poses and edge.b in poses:
            refused = isinstance(edge, Rejected) or (edge.a, edge.b) in turned_down
            kinds[EdgeKind.REJECTED if refused else _kind(edge.a, edge.b)].append((edge.a, edge.b))
    covariance = {
        frame: _in_team(poses[frame], estimate.covariance[frame])
        for frame in inside
        if frame in estimate.covariance
    }
    everyone = sorted({frame.robot for frame in estimate.team_from_base})
    return Graph(poses, everyone, kinds, covariance, base_from_foot)


def _kind(a: FrameId, b: FrameId) -> EdgeKind:
    if a.robot != b.robot:
        return EdgeKind.OVERLAP
    return EdgeKind.NEIGHBOUR if abs(a.index - b.index) == 1 else EdgeKind.LOOP


def _in_team(pose: Se2, covariance: Floats) -> Floats:
    """Turn the position's part of a covariance in the frame's tangent to the team's axes."""
    turn = pose.matrix()[:2, :2]
    turned: Floats = turn @ covariance[:2, :2] @ turn.T
    return turned
