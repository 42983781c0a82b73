"""Planar bundle: poses, attitudes and mounts of the whole team from all correspondences at once.

A camera that nods by half a degree moves the floor by a centimetre, and each pair absorbs that
differently; a frame's tilt, roll and height are shared by all its pairs, so the joint system knows
them. First stage: every correspondence a floor point of its own, thinned, so that a wrong one
harms nothing else. Then correspondences whose ends do not meet are cut, the rest are joined into
tracks, and the second stage solves for all of them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from groundfuse.backend.bundle_cholesky import NotPositiveDefiniteError
from groundfuse.backend.bundle_cut import Cut, cut, link_chi2
from groundfuse.backend.bundle_estimate import (
    BundleCamera,
    BundleEstimate,
    BundleOptions,
    BundleRefusal,
    Illposed,
)
from groundfuse.backend.bundle_files import (
    FileTest,
    judged_files,
    settled_files,
    with_better_files,
)
from groundfuse.backend.bundle_model import State
from groundfuse.backend.bundle_priors import Priors
from groundfuse.backend.bundle_relief import settle_relief
from groundfuse.backend.bundle_report import Ends, report
from groundfuse.backend.bundle_sample import sampled, thinned
from groundfuse.backend.bundle_setup import (
    Team,
    between_of,
    loose_frame,
    priors_of,
    start_state,
    team_of,
    with_points,
)
from groundfuse.backend.bundle_solve import Problem, Solution, minimise, problem_of
from groundfuse.backend.bundle_tracks import (
    Integers,
    Links,
    Sightings,
    observations,
    sightings_from_edges,
    single_links,
    tracks,
    with_gains,
)
from groundfuse.backend.measurement import Attitude, FrameId, RelativePose, TeamEstimate

Points = tuple[Integers, Integers]

LEAST_TRIAL, LEAST_SIGHTINGS = 60, 250
"""Sightings per frame that a large team keeps, in the trial and in the end."""
DEFAULT = BundleOptions()


@dataclass(frozen=True, slots=True)
class Goal:
    """How far to go and where to begin.

    Attributes:
        settled: chi-square of all poses together that the last step may still have.
        noise: first guess of the keypoints' noise over its promise.
    """

    settled: float
    noise: float = 1.0


START, LAST = Goal(1.0), Goal(0.04)
"""In the end a fifth of one sigma, in one direction of all."""


@dataclass(frozen=True, slots=True, eq=False)
class Job:
    """What all stages share.

    Attributes:
        team: frames and robots by number.
        cameras: by robot.
        sightings: keypoints.
        links: correspondences, right and wrong.
        edges: pairs, by the links' numbers.
        options: see there.
    """

    team: Team
    cameras: Mapping[str, BundleCamera]
    sightings: Sightings
    links: Links
    edges: Sequence[RelativePose]
    options: BundleOptions


def bundle(
    start: TeamEstimate,
    edges: Sequence[RelativePose],
    prior: Mapping[FrameId, Attitude],
    sigma: Mapping[FrameId, Attitude],
    cameras: Mapping[str, BundleCamera],
    options: BundleOptions = DEFAULT,
) -> BundleEstimate | BundleRefusal:
    """Refine the team's poses and find every frame's attitude and every robot's mount.

    Args:
        start: poses of the team graph; its components and reference frames are kept.
        edges: the accepted pairs, with the correspondences that support them. An edge without
            correspondences (odometry) counts as its relative pose.
        prior: tilt, roll and height of every frame of `start` as the files have them.
        sigma: standard deviations of their wobble.
        cameras: one per robot.
        options: see there.

    Raises:
        ValueError: a frame has no prior, or a sigma or height is not positive.
    """
    team = team_of(start)
    used = [
        edge
        for edge in edges
        if start.component_of.get(edge.a, -1) == start.component_of.get(edge.b, -2)
    ]
    priors = priors_of(team, prior, sigma, options)
    sightings, links = sightings_from_edges(used, team.index_of)
    tables = [cameras[name].focal_gains for name in team.robots]
    sightings = with_gains(sightings, team.robot_of, tables)
    state = start_state(team, start, priors, cameras)
    job = Job(team, cameras, sightings, links, used, options)
    try:
        found = _solved(job, priors, state)
    except NotPositiveDefiniteError:
        text = "the correspondences leave a pose or an attitude undetermined"
        return BundleRefusal(Illposed.SINGULAR, float(len(links)), float(len(links)), text)
    if isinstance(found, BundleRefusal):
        return found
    return report(Ends(start, team, cameras, options), *found)


def _solved(
    job: Job, priors: Priors, state: State
) -> tuple[Problem, Solution, Cut, FileTest] | BundleRefusal:
    """Cut wrong correspondences, see whether the floor is flat and the files hold, and solve."""
    options = job.options
    clean = cut(job.links, job.edges, np.zeros(len(job.links), dtype=np.bool_), options)
    thin = thinned(clean.links, job.sightings, options.start_sightings)
    first = _stage(job, clean, priors, state, single_links(clean.links.only(thin)), START)
    if isinstance(first, BundleRefusal):
        return first
    # Right correspondences contradict a wrong file: free its numbers before any of them are cut.
    priors, rough, state = settled_files(*first, options, START.settled)
    clean = _cleaned(job, priors, rough, state)
    joined = _joined(job, clean)
    num_frames = len(job.team.frames)
    most = max(options.trial_sightings // num_frames, LEAST_TRIAL)
    points = sampled(*joined, job.sightings, most)
    trial = _stage(job, clean, priors, state, points, replace(START, noise=rough.noise))
    if isinstance(trial, BundleRefusal):
        return trial
    relief, better = settle_relief(*trial, options, START.settled)
    state = better.state
    if relief > 0.0:
        priors, state = _judged_anew(trial[0], better, relief, options)
        clean = _cleaned(job, priors, better, state)
        joined = _joined(job, clean)
    most = max(options.most_sightings // num_frames, LEAST_SIGHTINGS)
    points = sampled(*joined, job.sightings, most)
    last = _stage(job, clean, priors, state, points, replace(LAST, noise=better.noise))
    if isinstance(last, BundleRefusal):
        return last
    problem, solution, test = with_better_files(*last, options, LAST.settled)
    return problem, solution, clean, test


def _judged_anew(
    problem: Problem, solution: Solution, relief: float, options: BundleOptions
) -> tuple[Priors, State]:
    """Free only what still contradicts a file where the floor has relief.

    Taken for flat, such a floor looks as a wrong lens does.
    """
    rough = replace(problem, priors=replace(problem.priors, relief=relief))
    return judged_files(rough, solution, options)


def _joined(job: Job, clean: Cut) -> Points:
    """Join correspondences into floor points."""
    return tracks(clean.links, job.sightings) if job.options.tracks else single_links(clean.links)


def _cleaned(job: Job, priors: Priors, rough: Solution, state: State) -> Cut:
    """Cut the correspondences that do not meet on the floor."""
    chi2 = link_chi2(job.links, job.sightings, state, priors, rough.noise)
    return cut(job.links, job.edges, chi2 > job.options.link_gate_sigma**2, job.options)


def _stage(
    job: Job, clean: Cut, priors: Priors, state: State, points: Points, goal: Goal
) -> tuple[Problem, Solution] | BundleRefusal:
    """Solve with some floor points."""
    options, used = job.options, len(clean.links)
    if used < options.min_links:
        text = f"{used} correspondences in all, {options.min_links} needed for a pair"
        return BundleRefusal(Illposed.NO_POINTS, float(used), float(options.min_links), text)
    seen = observations(job.sightings, *points, priors.num_frames)
    between = between_of(clean.weak, job.team, job.cameras)
    loose = loose_frame(seen.pair_key, between, job.team)
    if loose is not None:
        text = f"nothing that was kept ties frame {loose} to its component's reference"
        return BundleRefusal(Illposed.FALLS_APART, 0.0, 1.0, text)
    problem = problem_of(seen, priors, between)
    solution = minimise(
        problem,
        with_points(state, seen, priors.robot_of),
        width=options.robust_sigma,
        iterations=options.iterations,
        settled=goal.settled,
        noise=goal.noise,
    )
    return problem, solution
