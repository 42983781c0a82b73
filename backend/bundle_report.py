"""From the bundle's solution to the answer: covariances, mounts, and what is observable."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from groundfuse.backend.bundle_cholesky import inverse_diagonal, solve
from groundfuse.backend.bundle_cut import Cut
from groundfuse.backend.bundle_estimate import (
    BundleCamera,
    BundleEstimate,
    BundleOptions,
    Estimated,
    MountEstimate,
)
from groundfuse.backend.bundle_files import FileTest
from groundfuse.backend.bundle_findings import findings_of, scale_finding
from groundfuse.backend.bundle_priors import prior_cost
from groundfuse.backend.bundle_setup import Team
from groundfuse.backend.bundle_solve import Problem, Solution
from groundfuse.backend.measurement import Attitude, Se2, TeamEstimate

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Ends:
    """What the caller gave, for the answer; and on how many frames floor and files were judged."""

    start: TeamEstimate
    team: Team
    cameras: Mapping[str, BundleCamera]
    options: BundleOptions
    settled_frames: int


def report(
    ends: Ends, problem: Problem, solution: Solution, clean: Cut, test: FileTest
) -> BundleEstimate:
    """Collect the answer from the solution."""
    priors, state, team = problem.priors, solution.state, ends.team
    diagonal = inverse_diagonal(test.factor)
    sigma = np.sqrt(np.einsum("nii->ni", diagonal)[: priors.num_frames, 3:])
    mounts = _mounts(ends, problem, test)
    scale_sigma = _scale_sigma(problem, solution, test)
    return BundleEstimate(
        team=_team_estimate(ends, problem, solution, diagonal),
        attitude={f: Attitude(*state.attitude[n].tolist()) for n, f in enumerate(team.frames)},
        attitude_sigma={f: Attitude(*sigma[n].tolist()) for n, f in enumerate(team.frames)},
        mounts=mounts,
        scale_sigma=scale_sigma,
        residual_px=_residual_px(ends, problem, solution),
        noise_factor=solution.noise,
        relief=priors.relief,
        settled_frames=ends.settled_frames,
        num_points=problem.seen.num_points,
        num_observations=len(problem.seen.frame),
        num_links=len(clean.links),
        num_links_cut=clean.num_wrong,
        rejected=clean.rejected,
        findings=(
            scale_finding(team.robots, scale_sigma),
            *findings_of(team, problem, solution, mounts, test),
        ),
    )


def _team_estimate(
    ends: Ends, problem: Problem, solution: Solution, diagonal: Array
) -> TeamEstimate:
    """Poses and covariances of the bases from those of the feet."""
    poses, covariances = {}, {}
    for index, frame in enumerate(ends.team.frames):
        base_from_foot = ends.cameras[frame.robot].base_from_foot
        if problem.priors.fixed[index]:
            poses[frame] = ends.start.team_from_base[frame]
            continue
        poses[frame] = Se2(*solution.state.pose[index].tolist()) @ base_from_foot.inverse()
        by_foot = base_from_foot.adjoint()
        covariance = by_foot @ diagonal[index, :3, :3] @ by_foot.T
        covariances[frame] = (covariance + covariance.T) / 2.0
    anchors = tuple(
        replace(anchor, team_from_map=poses[anchor.first], covariance=covariances.get(anchor.first))
        for anchor in ends.start.anchors
    )
    chi2, freedom = _chi2(problem, solution)
    return replace(
        ends.start,
        team_from_base=poses,
        covariance=covariances,
        anchors=anchors,
        chi2=chi2,
        degrees_of_freedom=freedom,
    )


def _chi2(problem: Problem, solution: Solution) -> tuple[float, int]:
    """Weighted chi-square at the noise found, and its degrees of freedom."""
    seen, priors = problem.seen, problem.priors
    chi2 = float(np.sum(solution.weight * solution.errors.chi2)) / solution.noise**2
    # Unknowns but the 3 of each pose and the 2 of each point have a prior each.
    unknown = 3 * (priors.num_frames - int(priors.fixed.sum())) + 2 * seen.num_points
    known = 2 * len(seen.frame) + 3 * len(problem.between.i)
    return chi2 + prior_cost(solution.state, priors, problem.between), known - unknown


def _residual_px(ends: Ends, problem: Problem, solution: Solution) -> float:
    """Root mean square length of the residuals, weighted by the kernel."""
    focal = np.array([ends.cameras[name].focal_px for name in ends.team.robots])
    per_ray = focal[problem.priors.robot_of[problem.seen.frame], None]
    square = np.sum((solution.errors.residual * per_ray) ** 2, axis=1)
    return float(np.sqrt(np.sum(solution.weight * square) / np.sum(solution.weight)))


def _mounts(ends: Ends, problem: Problem, test: FileTest) -> tuple[MountEstimate, ...]:
    """State what the pictures tell of every robot's camera."""
    priors = problem.priors
    used = np.hstack([priors.free_mount, priors.free_lens])

    def number(robot: int, axis: int) -> Estimated:
        sigma, prior = float(test.sigma[robot, axis]), float(priors.shared_sigma[axis])
        told = sigma < ends.options.observed_share * prior
        value = float(test.value[robot, axis]) if told else None
        return Estimated(value, sigma, prior, bool(used[robot, axis]))

    mounts = []
    for robot, name in enumerate(ends.team.robots):
        height = number(robot, 2)
        if int((priors.group_of == priors.group_of[robot]).sum()) == 1:
            # Alone, its height is the scale, which no picture tells.
            height = Estimated(None, height.prior_sigma, height.prior_sigma, used=False)
        focal, distortion = (
            number(robot, axis) if test.asked[robot, axis] else None for axis in (3, 4)
        )
        tilt, roll = number(robot, 0), number(robot, 1)
        mounts.append(MountEstimate(name, tilt, roll, height, focal, distortion))
    return tuple(mounts)


def _scale_sigma(problem: Problem, solution: Solution, test: FileTest) -> float:
    """Standard deviation of the map's scale: of the mounts' mean, and of the mean wobble."""
    priors, state = problem.priors, solution.state
    group = priors.group_of[priors.robot_of[np.flatnonzero(priors.fixed)[0]]]
    members = np.flatnonzero(priors.group_of[priors.robot_of] == group)
    mean = np.zeros((priors.num_nodes, 6))
    mean[members, 5] = 1.0 / (len(members) * state.attitude[members, 2])
    wobble = float(mean.ravel() @ solve(test.factor, mean.ravel()))
    mounts = float(priors.shared_sigma[2]) ** 2 / int((priors.group_of == group).sum())
    return math.sqrt(wobble + mounts)
