"""Robust damped Gauss-Newton over the bundle's unknowns; numpy only."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from groundfuse.backend.bundle_cholesky import (
    BLOCK,
    Factor,
    Front,
    NotPositiveDefiniteError,
    factorise,
    plan,
    solve,
)
from groundfuse.backend.bundle_model import State, moved, residuals
from groundfuse.backend.bundle_normal import (
    Reduced,
    point_steps,
    reduce_rows,
    relief_rows,
    right_side,
    whitened_rows,
)
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
from groundfuse.backend.bundle_tracks import Observations

Array = NDArray[np.float64]

LEAST_DAMPING, FIRST_DAMPING, MOST_DAMPING = 1e-10, 1e-6, 1e6
UNSEEN_RATIO = 1e4
"""A sighting behind the camera costs as much as one a hundred kernel widths off."""
CHORD_GAIN = 0.3
"""A step that gains more than this share of the one before asks for new derivatives."""
LEAST_FREEDOM = 0.9
"""Points with fewer degrees of freedom say nothing about the noise."""
NOISE_CHANGE = 0.02
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
class Errors:
    """How far the sightings are from the model.

    Attributes:
        residual: (n, 2) measured minus predicted rays; 0 where unseen.
        unseen: (n,) whether the point is behind the camera.
        chi2: (n,) squared residual over the promised variance; 0 where unseen.
    """

    residual: Array
    unseen: NDArray[np.bool_]
    chi2: Array


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
        factor: of the reduced system near there, without damping.
        noise: residuals over the promised sigmas, robust.
        absorbed: (points,) how many residuals each floor point takes.
        steps: accepted steps.
        settled: whether the cost stopped falling.
    """

    state: State
    errors: Errors
    weight: Array
    factor: Factor
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


def errors_of(problem: Problem, state: State) -> Errors:
    """Compare all sightings with the model."""
    seen = problem.seen
    residual, unseen = residuals(seen, state, problem.priors.robot_of)
    residual[unseen] = 0.0
    chi2 = (residual[:, 0] ** 2 + residual[:, 1] ** 2) / seen.sigma**2
    return Errors(residual, unseen, chi2)


def noise_factor(seen: Observations, errors: Errors, absorbed: Array) -> float:
    """Median residual of the floor points over what the sigmas promise.

    A point seen k times has 2 k residuals and absorbs 2 of them, or up to 3 where the floor has
    relief (`absorbed`, (points,)), which leaves chi-square with v = 2 k - absorbed degrees of
    freedom; its median is near v (1 - 2 / 9 v)^3 (Wilson and Hilferty 1931).
    """
    total = np.bincount(seen.point, errors.chi2, seen.num_points)
    freedom = 2.0 * np.bincount(seen.point, ~errors.unseen, seen.num_points) - absorbed
    several = freedom > LEAST_FREEDOM
    total, freedom = total[several], freedom[several]
    if len(total) == 0:
        return 1.0
    median = freedom * (1.0 - 2.0 / (9.0 * freedom)) ** 3
    taken = 3.0 * (len(seen.frame_start) - 1)  # each frame's pose absorbs as well
    left = max(freedom.sum() - taken, 1.0) / freedom.sum()
    return float(np.sqrt(np.median(total / median) / left))


def _absorbed(problem: Problem, system: "System") -> Array:
    """How many residuals each floor point absorbs: 2, and of its height what the prior leaves."""
    absorbed = np.full(problem.seen.num_points, 2.0)
    if problem.priors.relief > 0.0:
        absorbed += 1.0 - (system.reduced.rows.relief[1] / system.reduced.root[2, 2]) ** 2
    return absorbed


@dataclass(frozen=True, slots=True)
class Kernel:
    """Cauchy on whitened residuals: `width` sigmas of the promised noise times `noise`."""

    width: float
    noise: float

    def ratio(self, errors: Errors) -> Array:
        """Squared residuals over the squared width (n,)."""
        chi2 = errors.chi2 / (self.width * self.noise) ** 2
        return np.where(errors.unseen, UNSEEN_RATIO, chi2)

    def weight(self, errors: Errors) -> Array:
        """Weights (n,), 0 to 1."""
        return np.where(errors.unseen, 0.0, 1.0 / (1.0 + self.ratio(errors)))

    def cost(self, errors: Errors) -> float:
        """Twice the negative log likelihood."""
        return float(self.width**2 * np.sum(np.log1p(self.ratio(errors))))


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
    weight = kernel.weight(errors) / (kernel.noise * seen.sigma) ** 2
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
) -> tuple[State, Array]:
    """Return the state after a step and the nodes' step (frames + robots, 6).

    The gradient is the state's own; the system may be of an earlier one (a chord step).
    """
    seen, priors = problem.seen, problem.priors
    weight = kernel.weight(errors) / (kernel.noise * seen.sigma) ** 2
    root = np.sqrt(system.weight)
    scale = np.divide(weight, root, out=np.zeros_like(weight), where=root > 0.0)
    error = errors.residual * scale[:, None]
    relief = relief_rows(seen, state, priors)
    right, explained = right_side(seen, system.reduced, error, relief, priors)
    right += prior_right(state, priors) + between_right(state, problem.between, priors)
    step = solve(system.factor, right.ravel()).reshape(-1, BLOCK)
    points = point_steps(seen, system.reduced, explained, step, priors)
    return moved(state, step, points), step


def minimise(
    problem: Problem, state: State, *, width: float, iterations: int, settled: float
) -> Solution:
    """Minimise the robust cost until a step lowers it by less than `settled` (chi-square).

    The kernel's scale follows the residuals: wide while the start is rough, and in the end as wide
    as the noise that is there. Derivatives and factor are kept as long as steps with them converge
    quickly.

    Raises:
        NotPositiveDefiniteError: the unknowns are not determined.
    """
    errors, system, last_gain = errors_of(problem, state), None, np.inf
    absorbed = np.full(problem.seen.num_points, 2.0)
    damping, steps, done = 0.0, 0, False
    while True:
        kernel = Kernel(width, noise_factor(problem.seen, errors, absorbed))
        if system is None or abs(kernel.noise / system.noise - 1.0) > NOISE_CHANGE:
            system = _damped_system(problem, state, errors, kernel, damping)
            absorbed = _absorbed(problem, system)
        if done or steps == iterations:
            break
        tried, _ = step_from(problem, system, state, errors, kernel)
        tried_errors = errors_of(problem, tried)
        gain = _cost(problem, state, errors, kernel) - _cost(problem, tried, tried_errors, kernel)
        if gain > -settled:  # rounding may raise a settled cost
            state, errors, steps, done = tried, tried_errors, steps + 1, gain < settled
            damping = system.damping / 10.0 if system.damping > FIRST_DAMPING else 0.0
            slow = gain > CHORD_GAIN * last_gain and not done
            system, last_gain = (None, np.inf) if slow or damping else (system, gain)
        elif last_gain < np.inf:
            system, last_gain = None, np.inf
        elif system.damping < MOST_DAMPING:
            damping = max(system.damping * 100.0, FIRST_DAMPING)
            system = None
        else:
            done = True
    factor = _factor(problem, system.reduced, 0.0) if system.damping else system.factor
    weight = kernel.weight(errors)
    return Solution(state, errors, weight, factor, kernel.noise, absorbed, steps, done)


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
