"""Gauss-Newton on a planar pose graph that ends at the best point it has seen.

Full steps are taken even where the cost rises for a while (on graphs with large rotation residuals
the way from the chordal start leads over a hill); if it does not come down, the solver goes back to
the best point and takes damped steps, each of which must lower the cost.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import SuperLU

from groundfuse.backend import normal, planar, sparse
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
FINE = 1e-2  # part of a negligible decrease that an inexact step may miss


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
    fill = sparse.filling(layout, 3)
    begin = chordal(problem, layout, fill)
    best = minimise(problem, begin.poses, layout, options, fill=fill, known=begin.factor)
    if start is None or chi2(problem, start) >= best.chi2:
        return best
    part = components(problem)
    _, first = np.unique(part, return_index=True)
    moved = planar.between(start[first[part]], start)
    return minimise(problem, moved, layout, options, fill=fill)


class Step(NamedTuple):
    """A Gauss-Newton step.

    Attributes:
        tangent: (n, 3).
        promised: decrease of chi2 according to the linear model.
        factor: that the step was solved with.
    """

    tangent: Array
    promised: float
    factor: SuperLU | None


def minimise(
    problem: Problem,
    start: Array,
    layout: sparse.Pattern | None = None,
    options: SolverOptions = DEFAULTS,
    *,
    fill: sparse.Filling | None = None,
    known: SuperLU | None = None,
) -> Solution:
    """Return the local minimum below `start`.

    Args:
        problem: what to minimise.
        start: (n, 3) poses; the held ones of the layout stay.
        layout: of the problem.
        options: how far to go.
        fill: that of 3 x 3 blocks in the layout.
        known: factor of normal equations in the same layout and near those of the start.
    """
    layout = layout_of(problem) if layout is None else layout
    fill = sparse.filling(layout, 3) if fill is None else fill
    best, best_chi2 = start, chi2(problem, start)
    here, damping, waited, gain = best, 0.0, 0, 0.0
    for iteration in range(1, options.max_iterations + 1):
        enough = options.relative_decrease * best_chi2 + NOTHING
        fine = FINE * enough
        usable = None if damping > 0.0 else known
        step = gauss_newton_step(problem, here, layout, damping, fill, known=usable, fine=fine)
        known = step.factor
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
    *,
    known: SuperLU | None = None,
    fine: float = 0.0,
) -> Step:
    """Solve the normal equations, their diagonal raised by the part `damping` of itself.

    A `known` factor of similar ones is used where it leads within `fine` of the promised chi2.
    """
    if not layout.size:
        return Step(np.zeros_like(poses), 0.0, None)
    matrix, gradient = normal_equations(problem, poses, layout, fill)
    right = -gradient.ravel()
    solved = None
    if damping > 0.0:
        matrix.setdiag(matrix.diagonal() * (1.0 + damping))
    if known is not None:
        solved = normal.by_known_factor(matrix, right, known, fine)
    if solved is None:
        factor = known = sparse.factorised(matrix)
        solved = factor.solve(right)
    promised = float(solved @ right)
    return Step(sparse.spread(layout, solved.reshape(-1, 3)), promised, known)


def normal_equations(
    problem: Problem, poses: Array, layout: sparse.Pattern, fill: sparse.Filling | None = None
) -> tuple[csc_array, Array]:
    """Return the information matrix of the free poses and the gradient (size, 3) of chi2 / 2."""
    return normal.of_linear(linearised(problem, poses), problem.information, layout, fill)
