"""A fused team, component by component: the edges it rests on, as arrays, and its certificate."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from groundfuse.backend import planar
from groundfuse.backend.certificate import Certificate, certificate
from groundfuse.backend.measurement import FrameId, RelativePose, TeamEstimate
from groundfuse.backend.problem import Array, Problem, chi2, from_edges

UNLIKELY = 1e-3  # of chi2 on either side: below it the covariances are called wrong


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """A connected part of a team.

    Attributes:
        component: its number.
        frames: in order of robot and index.
        problem: the accepted edges, on the frames' places.
        poses: (n, 3) in the frame of the first.
    """

    component: int
    frames: tuple[FrameId, ...]
    problem: Problem
    poses: Array

    @property
    def chi2(self) -> float:
        """Return the sum of squared Mahalanobis residuals."""
        return chi2(self.problem, self.poses)

    @property
    def degrees_of_freedom(self) -> int:
        """Return how many measurements there are beyond what the poses need."""
        return 3 * len(self.problem) - 3 * (len(self.frames) - 1)

    def certificate(self) -> Certificate:
        """Return what is proven about it."""
        return certificate(self.problem, self.poses)


@dataclass(frozen=True, slots=True)
class Consistency:
    """Whether residuals are as large as the covariances say.

    Attributes:
        chi2: sum of squared Mahalanobis residuals.
        degrees_of_freedom: what it should be about.
        below: probability of a chi2 of at most this.
        above: probability of a chi2 of at least this.
    """

    chi2: float
    degrees_of_freedom: int
    below: float
    above: float

    @property
    def verdict(self) -> str:
        """Return it in words."""
        if not self.degrees_of_freedom:
            return "nothing to compare"
        ratio = (self.chi2 / self.degrees_of_freedom) ** 0.5
        if self.above < UNLIKELY:
            return f"INCONSISTENT: residuals {ratio:.2f} times what the covariances say"
        if self.below < UNLIKELY:
            return f"residuals only {ratio:.2f} times what the covariances say"
        return "consistent with the covariances"


def consistency(solution: Solution) -> Consistency:
    """Compare chi2 with its distribution."""
    found, freedom = solution.chi2, solution.degrees_of_freedom
    if freedom <= 0:
        return Consistency(found, freedom, 1.0, 1.0)
    below = float(chi2_distribution.cdf(found, freedom))
    return Consistency(found, freedom, below, float(chi2_distribution.sf(found, freedom)))


def solutions(edges: Sequence[RelativePose], estimate: TeamEstimate) -> tuple[Solution, ...]:
    """Return the components, by number.

    Args:
        edges: all edges, as they were fused.
        estimate: what they were fused to.
    """
    members: dict[int, list[FrameId]] = {}
    for frame in sorted(estimate.component_of):
        members.setdefault(estimate.component_of[frame], []).append(frame)
    inside: dict[int, list[RelativePose]] = {number: [] for number in members}
    for edge, verdict in zip(edges, estimate.verdicts, strict=True):
        if verdict.accepted:
            inside[estimate.component_of[edge.a]].append(edge)
    found = []
    for number in sorted(members):
        frames = tuple(members[number])
        poses: Array = planar.stacked([estimate.team_from_base[f] for f in frames])
        place = {frame: k for k, frame in enumerate(frames)}
        found.append(Solution(number, frames, from_edges(place, inside[number]), poses))
    return tuple(found)


def residuals_of(edges: Sequence[RelativePose], estimate: TeamEstimate) -> list[Array | None]:
    """Return per edge x m, y m, theta rad of a_from_b^-1 (a^-1 b), None between components."""
    if not edges:
        return []
    poses = estimate.team_from_base
    one, two = (
        planar.stacked([poses[f] for f in ends]) for ends in zip(*_ends(edges), strict=True)
    )
    measured = planar.stacked([edge.a_from_b for edge in edges])
    error = planar.between(measured, planar.between(one, two))
    part = estimate.component_of
    return [
        e if part[edge.a] == part[edge.b] else None for e, edge in zip(error, edges, strict=True)
    ]


def _ends(edges: Sequence[RelativePose]) -> list[tuple[FrameId, FrameId]]:
    return [(edge.a, edge.b) for edge in edges]


def as_rows(covariance: Array) -> list[float]:
    """Return xx, xy, xt, yy, yt, tt."""
    rows: list[float] = covariance[np.triu_indices(3)].tolist()
    return rows
