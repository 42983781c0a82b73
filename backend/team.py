"""All robots in one frame: maps from chains, anchors voted from the overlaps, one robust solution.

Formulation: every pose in the frame of its component, one BetweenFactorPose2 per edge, the first
frame of a component held at the origin. A robot's anchor is then the pose of its map's first frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from groundfuse.backend import chain, native, planar
from groundfuse.backend import problem as graph
from groundfuse.backend.consistency import Flags, against_chain, links
from groundfuse.backend.initial import layout_of
from groundfuse.backend.measurement import FrameId, RelativePose, TeamEstimate
from groundfuse.backend.problem import Array, Indices, Problem
from groundfuse.backend.report import Findings, estimate
from groundfuse.backend.robust import RobustOptions, settle
from groundfuse.backend.skeleton import skeleton
from groundfuse.backend.voting import Vote, VotingOptions, vote


@dataclass(frozen=True, slots=True, kw_only=True)
class TeamOptions:
    """How a team is fused.

    Attributes:
        max_skip: largest gap of frame numbers that still counts as a step along a trajectory; a
            step over failed frames continues the chain, anything longer is a loop.
        voting: how overlaps between maps are weighed.
        robust: when an edge is turned down.
        refine_below: graphs of fewer poses than this get their last iterations from gtsam's own
            Gauss-Newton on its own factors, as a second implementation of the same optimum.
    """

    max_skip: int = 5
    voting: VotingOptions = field(default_factory=VotingOptions)
    robust: RobustOptions = field(default_factory=RobustOptions)
    refine_below: int = 20_000


DEFAULTS = TeamOptions()


def fuse(
    frames: Sequence[FrameId], edges: Sequence[RelativePose], options: TeamOptions = DEFAULTS
) -> TeamEstimate:
    """Fuse the edges of one or more robots.

    Args:
        frames: every frame of every robot; one without any edge becomes a component of its own.
        edges: measured relative poses, within and between robots, in any order and direction.
        options: limits.

    Raises:
        ValueError: a frame is given twice, or an edge names a frame that was not given.
    """
    order, whole = _numbered(frames, edges)
    step = _is_step(order, whole, options.max_skip)
    gap = np.abs(whole.b - whole.a).astype(float)
    maps = chain.spanning_forest(whole.of(step), gap[step])
    on_chain = np.zeros(len(whole), dtype=bool)
    on_chain[np.flatnonzero(step)[maps.edge[maps.edge >= 0]]] = True
    inner = maps.part[whole.a] == maps.part[whole.b]
    believed = on_chain.copy()
    believed[inner] |= _fits(whole.of(inner), maps, options.robust.limit)
    team = skeleton(_upwards(whole.of(~inner), maps.part), maps) if (~inner).any() else None
    verdict = vote(team, options.voting) if team is not None else None
    if verdict is not None:
        believed[~inner] = verdict.sure
    start = _start(whole, believed, on_chain, gap)
    poses, accepted = _solved(whole, start, on_chain, believed, options)
    undecided = np.zeros(len(whole), dtype=bool)
    if verdict is not None:
        undecided[~inner] = _undecided(verdict)
    found = Findings(whole, maps, poses, accepted, on_chain, undecided & ~accepted, team, verdict)
    return estimate(order, found, options.robust.limit)


def _numbered(
    frames: Sequence[FrameId], edges: Sequence[RelativePose]
) -> tuple[list[FrameId], Problem]:
    """Return the frames in order and the edges on their numbers."""
    order = sorted(frames)
    for one, two in pairwise(order):
        if one == two:
            raise ValueError(f"frame {one} is given twice")
    index_of = {frame: k for k, frame in enumerate(order)}
    for edge in edges:
        for end in (edge.a, edge.b):
            if end not in index_of:
                raise ValueError(f"edge {edge.a}-{edge.b} names frame {end}, which was not given")
    return order, graph.from_edges(index_of, edges)


def _is_step(order: Sequence[FrameId], whole: Problem, max_skip: int) -> Flags:
    """Return whether each edge may be a step of a trajectory."""
    names = {name: k for k, name in enumerate(sorted({f.robot for f in order}))}
    robot = np.array([names[f.robot] for f in order], dtype=np.int64)
    index = np.array([f.index for f in order], dtype=np.int64)
    a, b = whole.a, whole.b
    near: Flags = (robot[a] == robot[b]) & (np.abs(index[a] - index[b]) <= max_skip)
    return near


def _fits(loops: Problem, maps: chain.Forest, limit: float) -> Flags:
    """Return whether edges within maps agree with their chain."""
    return against_chain(links(loops, maps), maps) <= limit


def _upwards(overlaps: Problem, part: Indices) -> Problem:
    """Turn every edge so that it leads from the lower map to the higher."""
    down = part[overlaps.a] > part[overlaps.b]
    covariance = planar.inverted(overlaps.information)
    turned = planar.carried(planar.adjoint(overlaps.a_from_b), covariance)
    return Problem(
        overlaps.num_poses,
        np.where(down, overlaps.b, overlaps.a),
        np.where(down, overlaps.a, overlaps.b),
        np.where(down[:, None], planar.inverse(overlaps.a_from_b), overlaps.a_from_b),
        np.where(down[:, None, None], planar.inverted(turned), overlaps.information),
    )


def _start(whole: Problem, believed: Flags, on_chain: Flags, gap: Array) -> Array:
    """Chain the maps and join them by believed overlaps."""
    length = np.where(on_chain, gap, whole.num_poses + gap)
    return chain.spanning_forest(whole.of(believed), length[believed]).poses


def _solved(
    whole: Problem, start: Array, on_chain: Flags, believed: Flags, options: TeamOptions
) -> tuple[Array, Flags]:
    """Return the poses and the accepted edges."""
    part = graph.components(whole.of(believed))
    within = np.flatnonzero(part[whole.a] == part[whole.b])
    some = whole.of(within)
    layout = layout_of(some)
    result = settle(some, start, layout, on_chain[within], believed[within], options=options.robust)
    accepted = np.zeros(len(whole), dtype=bool)
    accepted[within] = result.accepted
    kept = whole.of(accepted)
    poses = result.poses
    if whole.num_poses < options.refine_below and len(kept):
        held = np.unique(graph.components(kept), return_index=True)[1].astype(np.int64)
        poses = native.refined(kept, held, poses)
    return poses, accepted


def _undecided(verdict: Vote) -> Flags:
    """Return the edges that agree with some answer, but not with every answer."""
    some = np.logical_or.reduce([verdict.best.agreeing, *(r.agreeing for r in verdict.rivals)])
    undecided: Flags = some & ~verdict.sure
    return undecided
