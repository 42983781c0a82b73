"""Whether the pictures contradict the files' lenses, and the bundle with better ones; numpy only.

An unknown that the pictures hardly tell costs accuracy and gains nothing, so a focal length stays
as filed unless the first step of freeing it is significant for some robot.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from groundfuse.backend.bundle_cholesky import inverse_between
from groundfuse.backend.bundle_estimate import BundleOptions, Refine
from groundfuse.backend.bundle_solve import (
    Kernel,
    Problem,
    Solution,
    minimise,
    step_from,
    system_at,
)

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class LensTest:
    """What freeing the lenses would bring, (robots, 2) by focal length and distortion.

    Attributes:
        sigma: standard deviation of each; nan where it was not asked for.
        freed: whether it was estimated.
    """

    sigma: Array
    freed: NDArray[np.bool_]


def refine_lenses(
    problem: Problem, solution: Solution, options: BundleOptions, settled: float
) -> tuple[Problem, Solution, LensTest]:
    """Free the lenses that the options ask for and the pictures call for, and solve again."""
    priors = problem.priors
    shape = (priors.num_robots, 2)
    asked = np.array([options.focal, options.distortion])
    wanted = np.broadcast_to(asked != Refine.NEVER, shape).copy()
    if not wanted.any():
        return problem, solution, LensTest(np.full(shape, np.nan), wanted)
    trial = replace(problem, priors=replace(priors, free_lens=wanted))
    kernel = Kernel(options.robust_sigma, solution.noise)
    system = system_at(trial, solution.state, solution.errors, kernel, 0.0)
    _, step = step_from(trial, system, solution.state, solution.errors, kernel)
    robots = np.arange(priors.num_frames, priors.num_nodes)
    spread = np.sqrt(np.diag(inverse_between(system.factor, robots))).reshape(-1, 6)[:, 3:5]
    told = spread < options.observed_share * priors.shared_sigma[3:5]
    significant = np.abs(step[robots, 3:5]) > options.lens_gate_sigma * spread
    # Where one file is contradicted, the others are no better founded.
    contradicted = (wanted & told & significant).any(axis=0)
    freed = wanted & ((told & contradicted) | (asked == Refine.ALWAYS))
    sigma = np.where(wanted, spread, np.nan)
    if not freed.any():
        return problem, solution, LensTest(sigma, freed)
    free = replace(problem, priors=replace(priors, free_lens=freed))
    again = minimise(
        free,
        solution.state,
        width=options.robust_sigma,
        iterations=options.iterations,
        settled=settled,
    )
    return free, again, LensTest(sigma, freed)
