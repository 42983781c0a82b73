"""The graphs' stage of the main job: every robot by itself, and the team; what is known is kept."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from groundfuse.backend.graph import RobotEstimate, robot_estimate
from groundfuse.backend.measurement import RelativePose, Se2, TeamEstimate
from groundfuse.backend.team import TeamOptions, fuse
from groundfuse.tools.code_version import code_of
from groundfuse.tools.front_end import FrontEndResult
from groundfuse.tools.robot import Robot
from groundfuse.tools.store import Store


@dataclass(frozen=True, slots=True, eq=False)
class Graphs:
    """The robots' graphs and the team's.

    Attributes:
        edges: all of them: the front-end's, then odometry's.
        alone: every robot by itself.
        team: all robots.
        rests_on: all that these depend on, as parts of a key.
    """

    edges: tuple[RelativePose, ...]
    alone: dict[str, RobotEstimate]
    team: TeamEstimate
    rests_on: tuple[object, ...]


def solved_graphs(
    robots: Sequence[Robot], found: FrontEndResult, options: TeamOptions, store: Store
) -> Graphs:
    """Optimise every robot by itself, and fuse; a robot whose edges are known already is kept."""
    edges = (*found.edges, *odometry_edges(robots))
    frames = [frame.id for robot in robots for frame in robot.frames]
    code = code_of("groundfuse.tools.team_graphs", rooms=("backend", "tools"))
    alone = {robot.name: _alone(robot, edges, options, store, code) for robot in robots}
    rests_on = (code, found.key, frames, _odometry(robots), options)
    team = store.kept("graphs", "team", rests_on, lambda: fuse(frames, edges, options))
    return Graphs(edges, alone, team, rests_on)


def _alone(
    robot: Robot, edges: Sequence[RelativePose], options: TeamOptions, store: Store, code: str
) -> RobotEstimate:
    """Optimise a robot, if its edges are not those of before."""
    own = [frame.id for frame in robot.frames]
    inner = [e for e in edges if e.a.robot == e.b.robot == robot.name]
    rests_on = (code, own, _numbers(inner), options)
    found: RobotEstimate = store.kept(
        "graph", robot.name, rests_on, lambda: robot_estimate(robot.name, own, inner, options)
    )
    return found


def _numbers(edges: Sequence[RelativePose]) -> tuple[object, ...]:
    """Return all that a graph makes of its edges, as few values."""
    ends = [f"{edge.a} {edge.b}" for edge in edges]
    poses = np.array([edge.a_from_b.vector() for edge in edges])
    return ends, poses, np.array([edge.covariance for edge in edges])


def _odometry(robots: Sequence[Robot]) -> list[tuple[Se2, Se2] | None]:
    """Return all odometry as plain values."""
    steps = (frame.odometry for robot in robots for frame in robot.frames)
    return [None if step is None else (step.map_from_base, step.sigma) for step in steps]


def odometry_edges(robots: Sequence[Robot]) -> tuple[RelativePose, ...]:
    """Return the motion between consecutive frames that both have odometry."""
    edges = []
    for robot in robots:
        for a, b in zip(robot.frames, robot.frames[1:], strict=False):
            if a.odometry is None or b.odometry is None:
                continue
            motion = a.odometry.map_from_base.inverse() @ b.odometry.map_from_base
            covariance = np.diag(b.odometry.sigma.vector() ** 2)
            edges.append(RelativePose(a.id, b.id, motion, covariance))
    return tuple(edges)


def accepted_edges(team: TeamEstimate, edges: Sequence[RelativePose]) -> list[RelativePose]:
    """Return the edges that took part in the solution."""
    return [e for e, v in zip(edges, team.verdicts, strict=True) if v.accepted]
