"""Whether the pictures contradict the camera files, and the bundle with better numbers; numpy only.

An unknown that the pictures hardly tell costs accuracy and gains nothing, so a mount and a lens
stay as filed unless the first step of freeing them is significant. The step also tells what the
numbers would be, with their sigmas, whether they are used or not.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from groundfuse.backend.bundle_cholesky import Factor, inverse_between, with_held
from groundfuse.backend.bundle_estimate import BundleOptions, Refine
from groundfuse.backend.bundle_kernel import Kernel
from groundfuse.backend.bundle_model import State
from groundfuse.backend.bundle_plan import BLOCK
from groundfuse.backend.bundle_priors import Priors
from groundfuse.backend.bundle_solve import (
    Problem,
    Solution,
    System,
    minimise,
    step_from,
    system_at,
)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

TOLD_WIDTH = 3.0
"""Width of the kernel where sigmas are told and one step is taken. A narrow kernel is the more
robust estimate, but its weights understate what good sightings tell, and its steps fall short."""
MOUNT, LENS = slice(0, 3), slice(3, 5)


@dataclass(frozen=True, slots=True, eq=False)
class FileTest:
    """What the pictures tell of mounts and lenses, with all of them free.

    Attributes:
        value: (robots, 6) corrections of the files, as in `State.shared`.
        covariance: (6 robots, 6 robots) of them.
        asked: (robots, 5) which were asked for.
        factor: of the system with only those free that the solution has free.
    """

    value: Array
    covariance: Array
    asked: Mask
    factor: Factor

    @property
    def sigma(self) -> Array:
        """Standard deviations (robots, 6)."""
        return np.sqrt(np.diag(self.covariance)).reshape(-1, 6)


def files_test(problem: Problem, solution: Solution, options: BundleOptions) -> FileTest:
    """Take one step with everything free that was asked for."""
    priors = problem.priors
    lens = np.array([options.focal, options.distortion]) != Refine.NEVER
    asked = np.tile(np.concatenate([[True] * 3, lens]), (priors.num_robots, 1))
    trial = replace(problem, priors=freed_priors(priors, asked))
    kernel = Kernel(max(options.robust_sigma, TOLD_WIDTH), solution.noise, solution.noise)
    system = system_at(trial, solution.state, solution.errors, kernel, 0.0)
    _, step, _ = step_from(trial, system, solution.state, solution.errors, kernel)
    robots = np.arange(priors.num_frames, priors.num_nodes)
    value = solution.state.shared + step[robots]
    covariance = inverse_between(system.factor, robots)
    return FileTest(value, covariance, asked, _held_factor(problem, system, asked))


def _held_factor(problem: Problem, system: System, asked: Mask) -> Factor:
    """Return the factor with the numbers held that were free only for the test."""
    held = asked & ~np.hstack([problem.priors.free_mount, problem.priors.free_lens])
    if not held.any():
        return system.factor
    robot, axis = np.nonzero(held)
    return with_held(system.factor, BLOCK * (problem.priors.num_frames + robot) + axis)


def freed_priors(priors: Priors, free: Mask) -> Priors:
    """Return priors with the numbers `free` (robots, 5) unknown."""
    return replace(priors, free_mount=free[:, MOUNT], free_lens=free[:, LENS])


def contradicted(test: FileTest, priors: Priors, options: BundleOptions) -> Mask:
    """Which numbers (robots, 5) to estimate.

    Where one mount is contradicted all are freed, for the others are no better founded; a kind of
    lens number likewise, where it is told.
    """
    sigma, value = test.sigma[:, :5], test.value[:, :5]
    told = sigma < options.observed_share * priors.shared_sigma[:5]
    significant = test.asked & told & (np.abs(value) > options.file_gate_sigma * sigma)
    free = np.zeros_like(test.asked)
    free[:, MOUNT] = significant[:, MOUNT].any()
    free[:, LENS] = told[:, LENS] & significant[:, LENS].any(axis=0)
    always = np.array([options.focal, options.distortion]) == Refine.ALWAYS
    free[:, LENS] |= always
    return free & test.asked


def as_filed(state: State, free: Mask) -> State:
    """Put the numbers that are not `free` (robots, 5) back to the files'."""
    shared = np.where(np.pad(free, ((0, 0), (0, 1))), state.shared, 0.0)
    return State(state.pose, state.attitude, shared, state.point)


def settled_files(
    problem: Problem, solution: Solution, options: BundleOptions, settled: float
) -> tuple[Priors, Solution, State]:
    """Keep free only what the pictures contradict: the priors, a solution and its state for them.

    The problem has all mounts free and no lens. Numbers that are contradicted and were not free
    are solved for, because the residuals of a wrong lens look like wrong correspondences.
    """
    priors, state = judged_files(problem, solution, options)
    if priors.free_lens.any():
        solution = _solved(replace(problem, priors=priors), solution, options, settled)
        state = as_filed(solution.state, np.hstack([priors.free_mount, priors.free_lens]))
    return priors, solution, state


def judged_files(
    problem: Problem, solution: Solution, options: BundleOptions
) -> tuple[Priors, State]:
    """Return priors that free only what the pictures contradict, and the state as filed else."""
    free = contradicted(files_test(problem, solution, options), problem.priors, options)
    return freed_priors(problem.priors, free), as_filed(solution.state, free)


def _solved(
    problem: Problem, solution: Solution, options: BundleOptions, settled: float
) -> Solution:
    """Go on from a solution with other priors."""
    return minimise(
        problem,
        solution.state,
        width=options.robust_sigma,
        iterations=options.iterations,
        settled=settled,
        noise=solution.noise,
    )


def with_better_files(
    problem: Problem, solution: Solution, options: BundleOptions, settled: float
) -> tuple[Problem, Solution, FileTest]:
    """Free what the pictures contradict, solve again, and tell what all of them would be."""
    test = files_test(problem, solution, options)
    priors = problem.priors
    already = np.hstack([priors.free_mount, priors.free_lens])
    free = already | contradicted(test, priors, options)
    if (free == already).all():
        return problem, solution, test
    problem = replace(problem, priors=freed_priors(priors, free))
    solution = _solved(problem, solution, options, settled)
    return problem, solution, files_test(problem, solution, options)
