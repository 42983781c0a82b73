"""Which edges belong: graduated non-convexity for truncated least squares, from a voted start.

Yang et al., "Graduated non-convexity for robust spatial perception" (2020), with three changes: the
start is the solution over edges already believed, every round starts where the last one ended, and
an edge too far from the start to be plausible is not let in at all.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from groundfuse.backend import planar, sparse
from groundfuse.backend.consistency import Flags
from groundfuse.backend.initial import layout_of
from groundfuse.backend.problem import Array, Problem, chi2_per_edge, components
from groundfuse.backend.solver import gauss_newton_step, minimise

RIDGE = 1e-9  # keeps the system regular while all edges of a part have lost their weight


@dataclass(frozen=True, slots=True, kw_only=True)
class RobustOptions:
    """When an edge is turned down.

    Attributes:
        limit: chi2 (3 degrees of freedom) above which an edge is turned down.
        reach: an edge not believed at the start is considered up to `reach` times the limit.
        growth: factor of the control parameter per round.
        max_rounds: rounds at most.
    """

    limit: float = 16.27  # 99.9 %
    reach: float = 100.0
    growth: float = 2.0
    max_rounds: int = 60


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
    poses = minimise(
        problem.of(trusted | believed), start, _on(layout, problem, trusted | believed)
    ).poses
    error = chi2_per_edge(problem, poses)
    doubtful = ~trusted
    open_edges = doubtful & (believed | (error <= options.reach * options.limit))
    worst = float(error[open_edges].max(initial=0.0))
    control = options.limit / max(worst - options.limit, 1e-9 * options.limit)
    for _ in range(options.max_rounds):
        weights = np.where(open_edges, _weights(error, control, options.limit), trusted * 1.0)
        if np.all((weights < 1e-3) | (weights > 1.0 - 1e-3)):
            break
        step = gauss_newton_step(problem.weighted(weights), poses, layout, RIDGE)
        poses = planar.compose(poses, planar.exp(step.tangent))
        error = chi2_per_edge(problem, poses)
        control *= options.growth
    return _final(problem, poses, layout, trusted, options)


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
        return sparse.Pattern(layout.size, layout.rank, some.a, some.b)
    return layout_of(some)


def _weights(error: Array, control: float, limit: float) -> Array:
    """Return the weights of truncated least squares at this control parameter."""
    lower, upper = control / (control + 1.0) * limit, (control + 1.0) / control * limit
    middle = np.sqrt(limit * control * (control + 1.0) / np.maximum(error, 1e-12 * limit)) - control
    weights: Array = np.where(error <= lower, 1.0, np.where(error >= upper, 0.0, middle))
    return weights
