"""From the solved graph to the border types: components, anchors, covariances, verdicts."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from groundfuse.backend import planar
from groundfuse.backend.chain import Forest
from groundfuse.backend.consistency import Flags
from groundfuse.backend.covariance import marginals
from groundfuse.backend.initial import layout_of
from groundfuse.backend.measurement import (
    Ambiguity,
    Anchor,
    Answer,
    EdgeKind,
    EdgeVerdict,
    FrameId,
    Reason,
    TeamEstimate,
)
from groundfuse.backend.problem import Array, Indices, Problem, chi2_per_edge, components
from groundfuse.backend.skeleton import Skeleton
from groundfuse.backend.voting import Vote


@dataclass(frozen=True, slots=True, eq=False)
class Findings:
    """The solved graph.

    Attributes:
        whole: all edges.
        maps: chains of the maps.
        poses: (n, 3) solution.
        accepted: (m,) edges in the solution.
        on_chain: (m,) edges of the chains.
        undecided: (m,) edges withheld because another answer has comparable support.
        team: the meeting poses, or None where no two maps meet.
        verdict: the vote on them.
    """

    whole: Problem
    maps: Forest
    poses: Array
    accepted: Flags
    on_chain: Flags
    undecided: Flags
    team: Skeleton | None
    verdict: Vote | None


def estimate(
    order: Sequence[FrameId], found: Findings, is_step: Flags, limit: float
) -> TeamEstimate:
    """Return the border type.

    Args:
        order: the frames by number.
        found: the solved graph.
        is_step: (m,) edges that are steps of a trajectory, used or turned down.
        limit: the chi2 above which an edge was turned down.
    """
    kept = found.whole.of(found.accepted)
    part = components(kept)
    layout = layout_of(kept)
    poses = _from_reference(found.poses, part)
    covariance = marginals(kept, poses, layout)
    rank = _by_size(part)
    free = layout.rank >= 0
    error = chi2_per_edge(found.whole, poses)
    error[part[found.whole.a] != part[found.whole.b]] = math.inf
    return TeamEstimate(
        team_from_base={f: planar.pose(p) for f, p in zip(order, poses, strict=True)},
        component_of={f: int(rank[c]) for f, c in zip(order, part, strict=True)},
        covariance={f: covariance[k] for k, f in enumerate(order) if free[k]},
        anchors=_anchors(order, found, poses, covariance, rank[part]),
        verdicts=_verdicts(order, found, error, is_step, limit),
        chi2=float(error[found.accepted].sum()),
        degrees_of_freedom=3 * len(kept) - 3 * int(free.sum()),
        ambiguities=_ambiguities(order, found),
        map_of={f: int(m) for f, m in zip(order, found.maps.part, strict=True)},
        map_from_base={f: planar.pose(p) for f, p in zip(order, found.maps.poses, strict=True)},
    )


def _from_reference(poses: Array, part: Indices) -> Array:
    """Put the first pose of every component at the origin."""
    _, first = np.unique(part, return_index=True)
    return planar.between(poses[first[part]], poses)


def _by_size(part: Indices) -> Indices:
    """Return the rank of every component: larger first, then earlier first."""
    size = np.bincount(part)
    order = np.argsort(-size, kind="stable")
    rank = np.empty(len(size), dtype=np.int64)
    rank[order] = np.arange(len(size))
    return rank


def _verdicts(
    order: Sequence[FrameId], found: Findings, error: Array, is_step: Flags, limit: float
) -> tuple[EdgeVerdict, ...]:
    inner = found.maps.part[found.whole.a] == found.maps.part[found.whole.b]
    verdicts = []
    for k in range(len(found.whole)):
        accepted = bool(found.accepted[k])
        kind = EdgeKind.LOOP if inner[k] else EdgeKind.OVERLAP
        reason = Reason.UNDECIDED if found.undecided[k] else Reason.INCONSISTENT
        verdicts.append(
            EdgeVerdict(
                order[found.whole.a[k]],
                order[found.whole.b[k]],
                accepted,
                float(error[k]),
                limit,
                EdgeKind.CHAIN if is_step[k] else kind,
                None if accepted else reason,
            )
        )
    return tuple(verdicts)


def _anchors(
    order: Sequence[FrameId], found: Findings, poses: Array, covariance: Array, component: Indices
) -> tuple[Anchor, ...]:
    """Return one anchor per map, in the order of their first frames."""
    part = found.maps.part
    _, first = np.unique(part, return_index=True)
    pairs = np.stack([part[found.whole.a], part[found.whole.b]], axis=1)[found.accepted]
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    count = np.bincount(pairs.ravel(), minlength=len(first))
    hanging = hanging_by_one(len(first), pairs)
    anchors, seen = [], dict[str, int]()
    for m, k in enumerate(first.tolist()):
        robot = order[k].robot
        seen[robot] = seen.get(robot, -1) + 1
        anchors.append(
            Anchor(
                robot,
                seen[robot],
                int(component[k]),
                order[k],
                planar.pose(poses[k]),
                covariance[k] if covariance[k].any() else None,
                int(count[m]),
                bool(hanging[m]),
            )
        )
    return tuple(anchors)


def hanging_by_one(num_maps: int, pairs: Indices) -> Flags:
    """Return which maps one single edge alone ties to the first map of their component.

    Args:
        num_maps: number of maps.
        pairs: (m, 2) maps of every accepted edge between maps.
    """
    hanging = np.zeros(num_maps, dtype=bool)
    everything = _labels(num_maps, pairs)
    unique, count = np.unique(np.sort(pairs, axis=1), axis=0, return_counts=True)
    for pair in unique[count == 1]:
        rest = pairs[~(np.sort(pairs, axis=1) == pair).all(axis=1)]
        label = _labels(num_maps, rest)
        if label[pair[0]] != label[pair[1]]:
            head = everything.tolist().index(everything[pair[0]])
            hanging |= (everything == everything[pair[0]]) & (label != label[head])
    return hanging


def _labels(num_maps: int, pairs: Indices) -> Indices:
    poses, information = np.zeros((len(pairs), 3)), np.zeros((len(pairs), 3, 3))
    return components(Problem(num_maps, pairs[:, 0], pairs[:, 1], poses, information))


def _ambiguities(order: Sequence[FrameId], found: Findings) -> tuple[Ambiguity, ...]:
    """Return, per pair of maps that answers place differently, the answers."""
    if found.team is None or found.verdict is None or not found.verdict.rivals:
        return ()
    team, best = found.team, found.verdict.best
    answers = [best, *found.verdict.rivals]
    withheld = best.agreeing & ~found.verdict.sure
    first = np.unique(found.maps.part, return_index=True)[1].tolist()
    result = []
    for f, g in np.unique(team.maps[withheld], axis=0).tolist():
        pair = (team.maps[:, 0] == f) & (team.maps[:, 1] == g)
        found_by: list[tuple[Indices, Answer]] = []
        for assignment in answers:
            agreeing = np.flatnonzero(assignment.agreeing & pair)
            if len(agreeing):
                pose = planar.pose(_place(found, team, int(agreeing[0])))
                answer = Answer(order[first[f]], order[first[g]], pose, len(agreeing))
                found_by.append((agreeing, answer))
        distinct = distinct_answers(found_by)
        if len(distinct) > 1 or len(found_by) < len(answers):
            result.append(Ambiguity(distinct))
    return tuple(result)


def distinct_answers(found_by: Sequence[tuple[Indices, Answer]]) -> tuple[Answer, ...]:
    """Return one answer per place, the best supported first.

    Two answers mean one place if they share half of the overlaps of the one with fewer; whoever has
    more speaks for both.

    Args:
        found_by: the overlaps that agree with an answer, and the answer.
    """
    kept: list[tuple[Indices, Answer]] = []
    for overlaps, answer in sorted(found_by, key=lambda one: -one[1].support):
        shared = (len(np.intersect1d(overlaps, known)) for known, _ in kept)
        if all(2 * number < len(overlaps) for number in shared):
            kept.append((overlaps, answer))
    return tuple(answer for _, answer in kept)


def _place(found: Findings, team: Skeleton, k: int) -> Array:
    """Return the first map's frame from the second's, as overlap k says."""
    poses, joins = found.maps.poses, team.joins
    f_from_b = planar.compose(poses[team.node[joins.a[k]]], joins.a_from_b[k])
    return planar.compose(f_from_b, planar.inverse(poses[team.node[joins.b[k]]]))
