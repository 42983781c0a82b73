"""Robust damped Gauss-Newton over the bundle's unknowns; numpy only."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from groundfuse.backend.bundle_cholesky import Factor, NotPositiveDefiniteError, factorise, solve
from groundfuse.backend.bundle_kernel import Errors, Kernel, errors_of, noise_factor
from groundfuse.backend.bundle_model import State, moved
from groundfuse.backend.bundle_normal import Reduced, point_steps, reduce_rows, right_side
from groundfuse.backend.bundle_plan import BLOCK, Front, plan
from groundfuse.backend.bundle_priors import (
    Between,
    Pattern,
    Priors,
    between_blocks,
    between_right,
    pattern_of,
    prior_blocks,
    prior_cost,
    prior_right,
)
from groundfuse.backend.bundle_rows import relief_rows, whitened_rows
from groundfuse.backend.bundle_tracks import Observations

Array = NDArray[np.float64]

FIRST_DAMPING, MOST_DAMPING = 1e-6, 1e6
FRESH_GAIN = 0.5
"""Share of the last step's chi-square that a step with new derivatives has, about: weights that
follow the residuals keep it from less."""
SYSTEM_STEPS = 5.0
"""So many steps take as long as new derivatives and their factor."""
ROUNDING = 1e-7
"""Share of the cost by which it may rise in a step that is as good as none."""
NOISE_CHANGE = 0.1
"""So does a noise that has changed by this fraction."""


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """The sightings, everything else that is known, and the plan of the elimination."""

    seen: Observations
    priors: Priors
    between: Between
    pattern: Pattern
    fronts: tuple[Front, ...]


@dataclass(frozen=True, slots=True, eq=False)
class System:
    """The normal equations at some state, factorised.

    Attributes:
        reduced: rows and blocks.
        weight: (n,) kernel weights over variances, as in the rows.
        noise: of the kernel's scale.
        factor: of the damped blocks.
        damping: which.
    """

    reduced: Reduced
    weight: Array
    noise: float
    factor: Factor
    damping: float


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Where the iterations ended.

    Attributes:
        state: the unknowns.
        errors: the sightings there.
        weight: (n,) kernel weights, 0 to 1.
        noise: residuals over the promised sigmas, robust.
        absorbed: (points,) how many residuals each floor point takes.
        steps: accepted steps.
        settled: whether the cost stopped falling.
    """

    state: State
    errors: Errors
    weight: Array
    noise: float
    absorbed: Array
    steps: int
    settled: bool


def problem_of(seen: Observations, priors: Priors, between: Between) -> Problem:
    """Analyse the sparsity; robots are eliminated last."""
    pattern = pattern_of(seen.pair_key, between, priors)
    robots = np.arange(priors.num_frames, priors.num_nodes)
    fronts = plan(pattern.rows, pattern.columns, priors.num_nodes, robots)
    return Problem(seen, priors, between, pattern, fronts)


def _absorbed(problem: Problem, system: "System") -> Array:
    """How many residuals each floor point absorbs: 2, and of its height what the prior leaves."""
    absorbed = np.full(problem.seen.num_points, 2.0)
    if problem.priors.relief > 0.0:
        absorbed += 1.0 - (system.reduced.rows.relief[1] / system.reduced.root[2, 2]) ** 2
    return absorbed


def _cost(problem: Problem, state: State, errors: Errors, kernel: Kernel) -> float:
    relief = relief_rows(problem.seen, state, problem.priors)[0]
    priors = prior_cost(state, problem.priors, problem.between)
    return kernel.cost(errors) + priors + float(relief @ relief)


def system_at(
    problem: Problem, state: State, errors: Errors, kernel: Kernel, damping: float
) -> System:
    """Build and factorise the normal equations.

    Raises:
        NotPositiveDefiniteError: the unknowns are not determined.
    """
    seen, priors = problem.seen, problem.priors
    weight = kernel.information(errors, seen.sigma)
    rows = whitened_rows(seen, state, weight, priors)
    reduced = reduce_rows(seen, rows, problem.pattern, priors)
    prior_blocks(reduced.blocks, priors, problem.pattern)
    between_blocks(reduced.blocks, state, problem.between, priors, problem.pattern)
    return System(reduced, weight, kernel.noise, _factor(problem, reduced, damping), damping)


def _factor(problem: Problem, reduced: Reduced, damping: float) -> Factor:
    blocks, num_nodes = reduced.blocks, problem.priors.num_nodes
    if damping > 0.0:
        blocks = blocks.copy()
        nodes, axes = np.arange(num_nodes)[:, None], np.arange(BLOCK)
        blocks[nodes, axes, axes] *= 1.0 + damping
    return factorise(problem.fronts, blocks, num_nodes)


def step_from(
    problem: Problem, system: System, state: State, errors: Errors, kernel: Kernel
) -> tuple[State, Array, float]:
    """Return the state after a step, the nodes' step (frames + robots, 6), and its chi-square.

    The gradient is the state's own; the system may be of an earlier one (a chord step).
    """
    seen, priors = problem.seen, problem.priors
    weight = kernel.information(errors, seen.sigma)
    root = np.sqrt(system.weight)
    scale = np.divide(weight, root, out=np.zeros_like(weight), where=root > 0.0)
    error = errors.residual * scale[:, None]
    relief = relief_rows(seen, state, priors)
    right, explained = right_side(seen, system.reduced, error, relief, priors)
    right += prior_right(state, priors) + between_right(state, problem.between, priors)
    step = solve(system.factor, right.ravel()).reshape(-1, BLOCK)
    points = point_steps(seen, system.reduced, explained, step, priors)
    return moved(state, step, points), step, float(np.sum(step * right))


def minimise(
    problem: Problem,
    state: State,
    *,
    width: float,
    iterations: int,
    settled: float,
    noise: float | None = None,
) -> Solution:
    """Minimise the robust cost until a step moves frames and robots by less than `settled`.

    That is the step's chi-square after the floor points are eliminated: 0.01 is a tenth of a sigma
    in one direction. Points of wrong correspondences may go on drifting; they hold nothing.

    The kernel follows the residuals: wide while the start is rough, and in the end as wide as the
    noise that is there. `noise` is a first guess of that, over what is promised, for a start whose
    residuals come from its poses; a good start's own residuals tell it. Derivatives and factor are
    kept as long as steps with them converge quickly.

    Raises:
        NotPositiveDefiniteError: the unknowns are not determined.
    """
    errors, system, last_chi2 = (
        errors_of(problem.seen, state, problem.priors.robot_of),
        None,
        np.inf,
    )
    absorbed = np.full(problem.seen.num_points, 2.0)
    damping, steps, done = 0.0, 0, False
    while True:
        spread = noise_factor(problem.seen, errors, absorbed)
        kernel = Kernel(width, spread, spread if steps or noise is None else noise)
        if done or steps == iterations:
            break
        if system is None or abs(kernel.noise / system.noise - 1.0) > NOISE_CHANGE:
            system = _damped_system(problem, state, errors, kernel, damping)
            absorbed = _absorbed(problem, system)
        tried, _, chi2 = step_from(problem, system, state, errors, kernel)
        tried_errors = errors_of(problem.seen, tried, problem.priors.robot_of)
        before = _cost(problem, state, errors, kernel)
        if _cost(problem, tried, tried_errors, kernel) < before + settled + ROUNDING * before:
            state, errors, steps = tried, tried_errors, steps + 1
            gain = chi2 / last_chi2 if last_chi2 > 0.0 else 0.0
            # A short step after one that was hardly longer has as much before it again.
            done = chi2 < settled and system.damping == 0.0 and gain <= FRESH_GAIN
            damping = system.damping / 10.0 if system.damping > FIRST_DAMPING else 0.0
            slow = not done and _steps_left(chi2, settled, gain) > _steps_anew(chi2, settled)
            system, last_chi2 = (None, np.inf) if slow or damping else (system, chi2)
        elif last_chi2 < np.inf:
            system, last_chi2 = None, np.inf
        elif system.damping < MOST_DAMPING:
            damping = max(system.damping * 100.0, FIRST_DAMPING)
            system = None
        else:
            done = True
    return Solution(state, errors, kernel.weight(errors), kernel.noise, absorbed, steps, done)


def _steps_left(chi2: float, settled: float, gain: float) -> float:
    """Return how many steps it takes until their chi-square is settled, if each has this share."""
    if gain == 0.0:
        return 0.0
    if chi2 < settled or gain >= 1.0:  # the former is not done, or nobody would ask
        return math.inf
    return math.log(settled / chi2) / math.log(gain)


def _steps_anew(chi2: float, settled: float) -> float:
    """Return how many steps it takes with new derivatives, which take as long as some."""
    if chi2 <= settled:
        return SYSTEM_STEPS
    return SYSTEM_STEPS + math.log(settled / chi2) / math.log(FRESH_GAIN)


def _damped_system(
    problem: Problem, state: State, errors: Errors, kernel: Kernel, damping: float
) -> System:
    """Build the system, with more damping where it has no solution."""
    while True:
        try:
            return system_at(problem, state, errors, kernel, damping)
        except NotPositiveDefiniteError:
            if damping >= MOST_DAMPING:
                raise
            damping = max(damping * 100.0, FIRST_DAMPING)
