"""Frames and edges of a team as numbers, and which edges are steps of a trajectory."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from groundfuse.backend.consistency import Flags
from groundfuse.backend.measurement import FrameId, RelativePose
from groundfuse.backend.problem import Array, Problem, from_edges


@dataclass(frozen=True, slots=True, eq=False)
class Team:
    """Everything that was measured.

    Attributes:
        frames: in order of robot and index; a frame's number is its place here.
        problem: all edges, in the order given.
        gap: (m,) difference of the frame indices, 0 between robots.
        is_step: (m,) whether the edge may be a step of a trajectory.
    """

    frames: tuple[FrameId, ...]
    problem: Problem
    gap: Array
    is_step: Flags


def team_of(frames: Sequence[FrameId], edges: Sequence[RelativePose], max_skip: int) -> Team:
    """Number frames and edges; a step is an edge within a robot over at most `max_skip` indices.

    Raises:
        ValueError: a frame is given twice, or an edge names a frame that was not given.
    """
    order = tuple(sorted(frames))
    for one, two in pairwise(order):
        if one == two:
            raise ValueError(f"frame {one} is given twice")
    number = {frame: k for k, frame in enumerate(order)}
    for edge in edges:
        for end in (edge.a, edge.b):
            if end not in number:
                raise ValueError(f"edge {edge.a}-{edge.b} names frame {end}, which was not given")
    problem = from_edges(number, edges)
    own = np.array([e.a.robot == e.b.robot for e in edges], dtype=bool)
    gap = np.array([abs(e.a.index - e.b.index) for e in edges], dtype=np.float64) * own
    return Team(order, problem, gap, own & (gap <= max_skip))
