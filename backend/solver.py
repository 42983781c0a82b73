"""Gauss-Newton on a planar pose graph that ends at the best point it has seen.

Full steps are taken even where the cost rises for a while (on graphs with large rotation residuals
the way from the chordal start leads over a hill); if it does not come down, the solver goes back to
the best point and takes damped steps, each of which must lower the cost.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.sparse import csc_array

from groundfuse.backend import planar, sparse
from groundfuse.backend.initial import chordal, layout_of
from groundfuse.backend.problem import Array, Problem, chi2, components, linearised


@dataclass(frozen=True, slots=True, kw_only=True)
class SolverOptions:
    """How far to go.

    Attributes:
        max_iterations: factorisations at most.
        relative_decrease: stop where the predicted decrease of chi2 is below this part of it.
        patience: full steps in a row that may fail to improve on the best point.
    """

    max_iterations: int = 100
    relative_decrease: float = 1e-8
    patience: int = 3


DEFAULTS = SolverOptions()
NO_DAMPING, FIRST_DAMPING, MAX_DAMPING = 1e-5, 1e-4, 1e8
NOTHING = 1e-18  # chi2 of exact data


class Solution(NamedTuple):
    """Where the solver ended.

    Attributes:
        poses: (n, 3).
        chi2: sum of squared Mahalanobis residuals there.
        iterations: factorisations done.
        converged: whether the predicted decrease fell below the tolerance.
    """

    poses: Array
    chi2: float
    iterations: int
    converged: bool


def optimum(
    problem: Problem, start: Array | None = None, options: SolverOptions = DEFAULTS
) -> Solution:
    """Return the best minimum found from the chordal start, or from `start` (n, 3) if better.

    A start above the minimum that the chordal start leads to is of no use and costs no time. The
    first pose of every connected part ends at the origin.
    """
    layout = layout_of(problem)
    best = minimise(problem, chordal(problem, layout), layout, options)
    if start is None or chi2(problem, start) >= best.chi2:
        return best
    part = components(problem)
    _, first = np.unique(part, return_index=True)
    return minimise(problem, planar.between(start[first[part]], start), layout, options)


class Step(NamedTuple):
    """A Gauss-Newton step (n, 3) and the decrease of chi2 that the linear model promises."""

    tangent: Array
    promised: float


def minimise(
    problem: Problem,
    start: Array,
    layout: sparse.Pattern | None = None,
    options: SolverOptions = DEFAULTS,
) -> Solution:
    """Return the local minimum below `start` (n, 3); the held poses of the layout stay."""
    layout = layout_of(problem) if layout is None else layout
    fill = sparse.filling(layout, 3)
    best, best_chi2 = start, chi2(problem, start)
    here, damping, waited, gain = best, 0.0, 0, 0.0
    for iteration in range(1, options.max_iterations + 1):
        step = gauss_newton_step(problem, here, layout, damping, fill)
        enough = options.relative_decrease * best_chi2 + NOTHING
        last = here is best and step.promised <= enough
        here = planar.compose(here, planar.exp(step.tangent))
        now = chi2(problem, here)
        if now <= best_chi2:
            before, gain = gain, best_chi2 - now
            best, best_chi2, waited = here, now, 0
            # Near the minimum gains shrink by a constant factor or faster: foresee the next one.
            last = last or (damping == 0.0 and 10.0 * gain**2 <= enough * before)
            damping = damping / 10.0 if damping > NO_DAMPING else 0.0
        if last:
            return Solution(best, best_chi2, iteration, converged=True)
        if here is best:
            continue
        waited, gain = waited + 1, 0.0
        if damping > 0.0 or waited > options.patience:
            here, damping = best, max(10.0 * damping, FIRST_DAMPING)
            if damping > MAX_DAMPING:
                return Solution(best, best_chi2, iteration, converged=False)
    return Solution(best, best_chi2, options.max_iterations, converged=False)


def gauss_newton_step(
    problem: Problem,
    poses: Array,
    layout: sparse.Pattern,
    damping: float = 0.0,
    fill: sparse.Filling | None = None,
) -> Step:
    """Solve the normal equations, their diagonal raised by the part `damping` of itself."""
    if not layout.size:
        return Step(np.zeros_like(poses), 0.0)
    matrix, gradient = normal_equations(problem, poses, layout, fill)
    if damping > 0.0:
        matrix.setdiag(matrix.diagonal() * (1.0 + damping))
    solved = sparse.factorised(matrix).solve(-gradient.ravel())
    promised = -float(solved @ gradient.ravel())
    return Step(sparse.spread(layout, solved.reshape(-1, 3)), promised)


def normal_equations(
    problem: Problem, poses: Array, layout: sparse.Pattern, fill: sparse.Filling | None = None
) -> tuple[csc_array, Array]:
    """Return the information matrix of the free poses and the gradient (size, 3) of chi2 / 2."""
    linear = linearised(problem, poses)
    left_a = np.swapaxes(linear.by_a, 1, 2) @ problem.information
    left_b = np.swapaxes(linear.by_b, 1, 2) @ problem.information
    matrix = sparse.assembled(
        fill or sparse.filling(layout, 3),
        left_a @ linear.by_a,
        left_a @ linear.by_b,
        left_b @ linear.by_b,
    )
    residual = linear.residual[:, :, None]
    gradient = sparse.gathered(layout, (left_a @ residual)[:, :, 0], (left_b @ residual)[:, :, 0])
    return matrix, gradient
