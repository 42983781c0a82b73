"""Which edges belong: graduated non-convexity for truncated least squares, from a believed start.

Yang et al., "Graduated non-convexity for robust spatial perception" (2020), with three changes: the
start is the solution over the edges already believed, every round starts where the last one ended,
and an edge is let in only if its error is plausible given how well the believed edges tie its two
poses together. What is accepted is believed in the next pass, until nothing changes.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from groundfuse.backend import planar, sparse
from groundfuse.backend.chain import spanning_forest
from groundfuse.backend.consistency import Flags
from groundfuse.backend.initial import chordal, layout_of
from groundfuse.backend.option_checks import check_numbers
from groundfuse.backend.problem import Array, Problem, chi2, chi2_per_edge, components, residuals
from groundfuse.backend.solver import SolverOptions, gauss_newton_step, minimise

ROUGH = SolverOptions(max_iterations=10, relative_decrease=1e-4)
SAME = 1e-9  # relative decreases of the truncated cost below this are rounding
COARSE = 1e-6  # part of chi2 that an inexact step of a round may miss
RIDGE = 1e-9  # keeps the system regular while all edges of a part have lost their weight


@dataclass(frozen=True, slots=True, kw_only=True)
class RobustOptions:
    """When an edge is turned down.

    Attributes:
        limit: chi2 (3 degrees of freedom) above which an edge is turned down.
        growth: factor of the control parameter per round.
        max_rounds: rounds at most.
        max_passes: how often what was accepted may let further edges in.
    """

    limit: float = 16.27  # 99.9 %
    growth: float = 2.0
    max_rounds: int = 60
    max_passes: int = 5

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense (ValueError)."""
        check_numbers(self)
        if self.growth <= 1.0:
            raise ValueError(f"growth must be above 1, got {self.growth:g}")


class Robust(NamedTuple):
    """Poses (n, 3) at the minimum over the accepted edges, and which those are (m,)."""

    poses: Array
    accepted: Flags


def settle(
    problem: Problem,
    start: Array,
    layout: sparse.Pattern,
    trusted: Flags,
    believed: Flags,
    *,
    options: RobustOptions,
) -> Robust:
    """Find the edges that fit together.

    Args:
        problem: all edges.
        start: (n, 3) poses.
        layout: pattern of the problem.
        trusted: (m,) edges that always count fully.
        believed: (m,) edges that count at the start; all others start at nothing.
        options: limits.
    """
    wanted = trusted | believed
    poses = _begun(problem.of(wanted), start, _on(layout, problem, wanted))
    best, lowest = Robust(poses, trusted), np.inf
    for _ in range(options.max_passes):
        candidates = wanted | plausible(problem, poses, wanted, options.limit)
        if lowest < np.inf:  # later passes start from everything that is plausible by then
            poses = minimise(problem.of(candidates), poses, _on(layout, problem, candidates)).poses
        poses = _graduated(problem, poses, layout, trusted, candidates & ~trusted, options=options)
        found = _final(problem, poses, layout, trusted, options)
        cost = truncated(problem, found, options.limit)
        if cost >= lowest * (1.0 - SAME):
            break
        best, lowest = found, cost
        poses, wanted = found
    return best


def _begun(some: Problem, start: Array, layout: sparse.Pattern) -> Array:
    """Return the minimum over the believed edges, from the chordal start where that is better.

    Long trajectories chained end to end lie far from where their loops and overlaps put them. A few
    steps are enough: wrong edges among the believed ones can make the way to the minimum long.
    """
    fill = sparse.filling(layout, 3)
    begin = chordal(some, layout, fill)
    if chi2(some, begin.poses) < chi2(some, start):
        return minimise(some, begin.poses, layout, ROUGH, fill=fill, known=begin.factor).poses
    return minimise(some, start, layout, ROUGH, fill=fill).poses


def truncated(problem: Problem, found: Robust, limit: float) -> float:
    """Return the truncated cost: chi2 of accepted edges, and the limit for each one turned down."""
    error = chi2_per_edge(problem, found.poses)
    return float(np.where(found.accepted, error, limit).sum())


def plausible(problem: Problem, poses: Array, believed: Flags, limit: float) -> Flags:
    """Return whether each edge's error is within `limit` of its own and the believed edges' noise.

    The noise between two poses is that along the best-tied path of a spanning tree, which is never
    less than that of the whole graph, so no right edge is kept out.
    """
    some = problem.of(believed)
    covariance = planar.inverted(problem.information)
    forest = spanning_forest(some, np.trace(covariance[believed], axis1=1, axis2=2))
    together = forest.part[problem.a] == forest.part[problem.b]
    a, b = problem.a[together], problem.b[together]
    to_b = planar.adjoint(planar.inverse(forest.poses[b]))
    noise = covariance[together] + planar.carried(to_b, forest.between(a, b))
    error = residuals(problem.of(together), poses)
    flags = np.zeros(len(problem), dtype=bool)
    flags[together] = planar.mahalanobis2(error, noise) <= limit
    return flags


def _graduated(
    problem: Problem,
    poses: Array,
    layout: sparse.Pattern,
    trusted: Flags,
    candidates: Flags,
    *,
    options: RobustOptions,
) -> Array:
    """Tighten the loss from nearly quadratic to truncated, one Gauss-Newton step per round."""
    error = chi2_per_edge(problem, poses)
    worst = float(error[candidates].max(initial=0.0))
    control = options.limit / max(worst - options.limit, 1e-9 * options.limit)
    fill = sparse.filling(layout, 3)
    known = None
    for _ in range(options.max_rounds):
        weights = np.where(candidates, _weights(error, control, options.limit), trusted * 1.0)
        if np.all((weights < 1e-3) | (weights > 1.0 - 1e-3)):
            break
        fine = COARSE * float(weights @ error)
        step = gauss_newton_step(
            problem.weighted(weights), poses, layout, RIDGE, fill, known=known, fine=fine
        )
        known = step.factor
        poses = planar.compose(poses, planar.exp(step.tangent))
        error = chi2_per_edge(problem, poses)
        control *= options.growth
    return poses


def _final(
    problem: Problem, poses: Array, layout: sparse.Pattern, trusted: Flags, options: RobustOptions
) -> Robust:
    """Solve over the accepted edges until they stay the same."""
    accepted = trusted | (chi2_per_edge(problem, poses) <= options.limit)
    for _ in range(options.max_rounds):
        poses = minimise(problem.of(accepted), poses, _on(layout, problem, accepted)).poses
        again = trusted | (chi2_per_edge(problem, poses) <= options.limit)
        if np.array_equal(again, accepted):
            break
        accepted = again
    return Robust(poses, accepted)


def _on(layout: sparse.Pattern, problem: Problem, chosen: Flags) -> sparse.Pattern:
    """Return the pattern of the chosen edges; a new one where they leave a part without gauge."""
    some = problem.of(chosen)
    if components(some).max(initial=0) + 1 == problem.num_poses - layout.size:
        return layout.of(some.a, some.b)
    return layout_of(some)


def _weights(error: Array, control: float, limit: float) -> Array:
    """Return the weights of truncated least squares at this control parameter."""
    lower, upper = control / (control + 1.0) * limit, (control + 1.0) / control * limit
    middle = np.sqrt(limit * control * (control + 1.0) / np.maximum(error, 1e-12 * limit)) - control
    weights: Array = np.where(error <= lower, 1.0, np.where(error >= upper, 0.0, middle))
    return weights
