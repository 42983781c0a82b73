"""Whether the floor is flat; numpy only.

A flat floor fixes every camera's tilt, roll and height to a few thousandths; a floor that waves by
a millimetre makes the same bundle wrong by several and far too sure of it. So a trial on part of
the sightings frees the heights of the floor points, and keeps them where the residuals then fall by
more than the unknowns account for (an F test, Fisher 1922, on residuals clipped at the kernel).
Keypoints on obstacles are off any floor: a few of them pass that test by count alone, and the
robust kernel deals with them better than free heights for all do, so more is asked for.
"""

import math
from dataclasses import replace

import numpy as np

from groundfuse.backend.bundle_estimate import BundleOptions, Refine
from groundfuse.backend.bundle_rows import relief_rows
from groundfuse.backend.bundle_solve import Problem, Solution, minimise

GATE_SIGMA = 3.0
LEAST_GAIN = 0.05
"""Residuals must fall by so many sigmas of their own variance, and by this fraction besides where
the heights of a flat floor are freed. Simulated: waves of 0.4 mm below cameras at 0.55 m lower them
by 5 % and cost the poses as much as free heights do, obstacles under a third of the keypoints by 5
to 7 %, waves of 0.7 mm by 12 to 16 % and a third of the accuracy."""
LEAST_GAIN_ROUGHER = 0.01
"""The same where heights are free already and only get more room."""
ROOM = 0.1
"""A rougher floor is not tried where heights use less than this of the variance allowed."""


def misfit(problem: Problem, solution: Solution, clip: float) -> tuple[float, float]:
    """Mean square residual over the promise, each clipped, and its degrees of freedom."""
    total = float(np.minimum(solution.errors.chi2, clip).sum())
    freedom = 2.0 * len(problem.seen.frame) - float(solution.absorbed.sum())
    freedom -= 3.0 * problem.priors.num_frames
    return total / max(freedom, 1.0), max(freedom, 1.0)


def explains_more(
    flatter: tuple[Problem, Solution], rougher: tuple[Problem, Solution], width: float
) -> bool:
    """Whether the rougher floor lowers the residuals by more than its unknowns account for."""
    clip = (width * flatter[1].noise) ** 2
    before, _ = misfit(*flatter, clip)
    after, freedom = misfit(*rougher, clip)
    least = LEAST_GAIN if flatter[0].priors.relief == 0.0 else LEAST_GAIN_ROUGHER
    return before > after * (1.0 + least + GATE_SIGMA * math.sqrt(2.0 / freedom))


def settle_relief(
    problem: Problem, solution: Solution, options: BundleOptions, settled: float
) -> tuple[float, Solution]:
    """Return the relief that the sightings ask for, 0 if flat, and the solution with it."""
    if options.relief is Refine.NEVER:
        return 0.0, solution
    best = problem, solution
    levels = options.relief_levels
    for level in levels[-1:] if options.relief is Refine.ALWAYS else levels:
        rougher = replace(problem, priors=replace(problem.priors, relief=level))
        found = minimise(
            rougher,
            best[1].state,
            width=options.robust_sigma,
            iterations=options.iterations,
            settled=settled,
            noise=best[1].noise,
        )
        better = explains_more(best, (rougher, found), options.robust_sigma)
        if not better and options.relief is not Refine.ALWAYS:
            break
        best = rougher, found
        heights = relief_rows(problem.seen, found.state, rougher.priors)[0]
        if float(np.mean(heights**2)) < ROOM:
            break
    return best[0].priors.relief, best[1]
