"""All robots in one frame: maps from chains, anchors voted from the overlaps, one robust solution.

Formulation: every pose in the frame of its component, one BetweenFactorPose2 per edge, the first
frame of a component held at the origin. A robot's anchor is then the pose of its map's first frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from groundfuse.backend import chain, native, planar
from groundfuse.backend import problem as graph
from groundfuse.backend.consistency import Flags
from groundfuse.backend.doubt import doubtful_steps
from groundfuse.backend.initial import held_poses, layout_of
from groundfuse.backend.measurement import FrameId, RelativePose, TeamEstimate
from groundfuse.backend.numbering import Team, team_of
from groundfuse.backend.option_checks import check_numbers
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
        max_cuts: steps of trajectories that may be found wrong and cut.
        max_trials: suspected steps tried before each of them.
        step_trust: a step turned down costs as much as this many other edges.
        rival_trust: and this many more where overlaps that repeat are another explanation.
        refine_below: graphs of fewer poses than this get their last iterations from gtsam's own
            Gauss-Newton on its own factors, as a second implementation of the same optimum.
    """

    max_skip: int = 5
    voting: VotingOptions = field(default_factory=VotingOptions)
    robust: RobustOptions = field(default_factory=RobustOptions)
    max_cuts: int = 10
    max_trials: int = 12
    step_trust: float = 2.0
    rival_trust: float = 2.5
    refine_below: int = 20_000

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense (ValueError)."""
        check_numbers(self, may_be_zero=("max_cuts", "max_trials", "rival_trust", "refine_below"))


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
    team = team_of(frames, edges, options.max_skip)
    steps = team.is_step
    found = _joined(team, steps, options, guess=True)
    kind_of_step = found.on_chain
    for _ in range(options.max_cuts):
        better = _with_a_cut(team, steps, found, options)
        if better is None:
            break
        found, steps = better
    if found.verdict is not None and found.verdict.rivals:
        found = _joined(team, steps, options, guess=False)
    found = replace(found, poses=_refined(found, options))
    return estimate(team.frames, found, kind_of_step, options.robust.limit)


def _joined(team: Team, steps: Flags, options: TeamOptions, *, guess: bool) -> Findings:
    """Chain the maps along `steps`, join them, and settle which edges belong.

    With `guess`, maps that could lie in several ways are put where the best answer says; that is
    for finding wrong steps only, since a wrong step looks like two answers.
    """
    whole = team.problem
    maps, on_chain = _chains(team, steps)
    inner = maps.part[whole.a] == maps.part[whole.b]
    believed, undecided = on_chain.copy(), np.zeros(len(whole), dtype=bool)
    meetings, verdict = None, None
    if not inner.all():
        meetings = skeleton(_upwards(whole.of(~inner), maps.part), maps)
        verdict = vote(meetings, options.voting)
        believed[~inner] = verdict.best.agreeing if guess else verdict.sure
        undecided[~inner] = _undecided(verdict)
    start = _start(whole, believed, on_chain, team.gap)
    poses, accepted = _settled(whole, start, on_chain, believed, options)
    open_edges = undecided & ~accepted
    return Findings(whole, maps, poses, accepted, on_chain, open_edges, meetings, verdict)


def _chains(team: Team, steps: Flags) -> tuple[chain.Forest, Flags]:
    """Return the maps chained along `steps` and which edges their chains are made of."""
    maps = chain.spanning_forest(team.problem.of(steps), team.gap[steps])
    number = np.append(np.flatnonzero(steps), -1)
    maps = replace(maps, edge=number[maps.edge])
    on_chain = np.zeros(len(steps), dtype=bool)
    on_chain[maps.edge[maps.edge >= 0]] = True
    return maps, on_chain


def _with_a_cut(
    team: Team, steps: Flags, found: Findings, options: TeamOptions
) -> tuple[Findings, Flags] | None:
    """Return the best result with one step less, if it explains the edges better."""
    limit = options.robust.limit
    rival = found.verdict is not None and bool(found.verdict.rivals)
    needed = limit * (options.rival_trust if rival else 0.5)
    cuts = doubtful_steps(team.problem, found.maps, found.poses, found.accepted, limit)
    best, lowest = None, _truncated(found, team.is_step, options) - needed
    for cut in cuts[: options.max_trials]:
        fewer = steps.copy()
        fewer[cut.edge] = False
        again = _joined(team, fewer, options, guess=True)
        cost = _truncated(again, team.is_step, options)
        if cost < lowest and not again.accepted[cut.edge]:  # a step that fits was not the reason
            best, lowest = (again, fewer), cost
    return best


def _truncated(found: Findings, is_step: Flags, options: TeamOptions) -> float:
    """Return the cost of all edges, cut at the limit; steps at `step_trust` times the limit."""
    most = np.where(is_step, options.step_trust, 1.0) * options.robust.limit
    error = graph.chi2_per_edge(found.whole, found.poses)
    return float(np.where(found.accepted, np.minimum(error, most), most).sum())


def _refined(found: Findings, options: TeamOptions) -> Array:
    """Let gtsam iterate on its own factors, where the graph is not too large."""
    kept = found.whole.of(found.accepted)
    if found.whole.num_poses >= options.refine_below or not len(kept):
        return found.poses
    return native.refined(kept, held_poses(kept), found.poses)


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


def _settled(
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
    return result.poses, accepted


def _undecided(verdict: Vote) -> Flags:
    """Return the edges that agree with some answer, but not with every answer."""
    some = np.logical_or.reduce([verdict.best.agreeing, *(r.agreeing for r in verdict.rivals)])
    undecided: Flags = some & ~verdict.sure
    return undecided
