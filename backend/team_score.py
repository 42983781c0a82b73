"""How a fused team does against known truth: poses, anchors, and the verdicts on its edges."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from groundfuse.backend import planar
from groundfuse.backend.drift import Accuracy, BetweenRobots, accuracy, between_robots
from groundfuse.backend.measurement import FrameId, RelativePose, Se2, TeamEstimate
from groundfuse.backend.problem import chi2_per_edge, from_edges

WRONG = float(chi2_distribution.isf(1e-6, 3))  # one right edge in a million is called wrong
THREE_SIGMA = float(chi2_distribution.isf(2.7e-3, 3))


@dataclass(frozen=True, slots=True)
class Score:
    """Against truth.

    Attributes:
        accuracy: errors of the poses, by component; components of one known frame are left out.
        between: errors between robots, by component.
        anchors_right: anchors within three sigma of the truth.
        anchors: anchors compared.
        wrong: edges that are wrong.
        refused: edges not used, turned down or open.
        both: edges that are wrong and were not used.
        judged: edges whose truth is known.
    """

    accuracy: dict[int, Accuracy]
    between: dict[int, BetweenRobots]
    anchors_right: int
    anchors: int
    wrong: int
    refused: int
    both: int
    judged: int


def score(
    edges: Sequence[RelativePose],
    estimate: TeamEstimate,
    truth: Mapping[FrameId, Se2],
    labels: Sequence[bool | None],
) -> Score:
    """Compare a fused team with the truth.

    Args:
        edges: as they were fused.
        estimate: what they were fused to.
        truth: true poses of some frames, all in one frame.
        labels: per edge, whether it is known to be wrong; where None, the truth decides.
    """
    by_part: dict[int, dict[FrameId, Se2]] = {}
    for frame, pose in estimate.team_from_base.items():
        by_part.setdefault(estimate.component_of[frame], {})[frame] = pose
    accuracies = {n: accuracy(by_part[n], truth) for n in sorted(by_part)}
    between = {n: between_robots(by_part[n], truth) for n in sorted(by_part)}
    judged = _judged(edges, truth, labels)
    refused = [not verdict.accepted for verdict in estimate.verdicts]
    pairs = [(w, r) for w, r in zip(judged, refused, strict=True) if w is not None]
    right, compared = _anchors(estimate, truth)
    return Score(
        {n: found for n, found in accuracies.items() if found is not None},
        {n: found for n, found in between.items() if found is not None},
        right,
        compared,
        sum(w for w, _ in pairs),
        sum(r for _, r in pairs),
        sum(w and r for w, r in pairs),
        len(pairs),
    )


def _judged(
    edges: Sequence[RelativePose], truth: Mapping[FrameId, Se2], labels: Sequence[bool | None]
) -> list[bool | None]:
    """Return per edge whether it is wrong, None where nobody knows."""
    judged = list(labels)
    known = [k for k, e in enumerate(edges) if judged[k] is None and e.a in truth and e.b in truth]
    if known:
        frames = sorted({f for k in known for f in (edges[k].a, edges[k].b)})
        problem = from_edges({f: n for n, f in enumerate(frames)}, [edges[k] for k in known])
        error = chi2_per_edge(problem, planar.stacked([truth[f] for f in frames]))
        for k, value in zip(known, error.tolist(), strict=True):
            judged[k] = value > WRONG
    return judged


def _anchors(estimate: TeamEstimate, truth: Mapping[FrameId, Se2]) -> tuple[int, int]:
    """Return how many anchors lie within three sigma, of how many."""
    reference: dict[int, FrameId] = {}
    for frame in sorted(estimate.component_of):
        reference.setdefault(estimate.component_of[frame], frame)
    right = compared = 0
    for anchor in estimate.anchors:
        base = reference[anchor.component]
        if anchor.covariance is None or base not in truth or anchor.first not in truth:
            continue
        wanted = truth[base].inverse() @ truth[anchor.first]
        error = planar.log((wanted.inverse() @ anchor.team_from_map).vector())
        compared += 1
        right += float(error @ np.linalg.solve(anchor.covariance, error)) <= THREE_SIGMA
    return right, compared
