"""Planar bundle: poses, attitudes and mounts of the whole team from all correspondences at once.

A camera that nods by half a degree moves the floor by a centimetre, and each pair absorbs that
differently; a frame's tilt, roll and height are shared by all its pairs, so the joint system knows
them. First stage: every correspondence a floor point of its own, thinned, so that a wrong one
harms nothing else. Then correspondences whose ends do not meet are cut, the rest are joined into
tracks, and the second stage solves for all of them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np

from groundfuse.backend.bundle_again import Warm, going_on
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
from groundfuse.backend.bundle_place import agrees, noise_of, placed_among_known
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
    Matched,
    Sightings,
    matched,
    observations,
    single_links,
    tracks,
    with_gains,
)
from groundfuse.backend.measurement import Attitude, FrameId, RelativePose, TeamEstimate

Points = tuple[Integers, Integers]
Solved = tuple[Problem, Solution, Cut, FileTest]

LEAST_TRIAL, LEAST_SIGHTINGS = 60, 250
"""Sightings per frame that a large team keeps, in the trial and in the end."""
DEFAULT = BundleOptions()


SETTLED_TRIAL, SETTLED = 0.05, 0.04
"""Chi-square that the last step may have: in trials of each frame, in the end of all of them
together (a fifth of one sigma, in one direction of all)."""


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

    @property
    def settled_trial(self) -> float:
        """Chi-square that the last step of a trial may still have."""
        return max(1.0, SETTLED_TRIAL * len(self.team.frames))


def bundle(
    start: TeamEstimate,
    edges: Sequence[RelativePose],
    prior: Mapping[FrameId, Attitude],
    sigma: Mapping[FrameId, Attitude],
    cameras: Mapping[str, BundleCamera],
    options: BundleOptions = DEFAULT,
    earlier: BundleEstimate | None = None,
    seen: Matched | None = None,
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
        earlier: what a bundle of most of these frames found, with the same files and options; it
            saves time where it fits, see `bundle_again`.
        seen: the correspondences of `edges` where these have better ones elsewhere; frames are
            numbered in their order, edges as here.

    Raises:
        ValueError: a frame has no prior, or a sigma or height is not positive.
    """
    team = team_of(start)
    home = start.component_of
    inside = np.array([home.get(e.a, -1) == home.get(e.b, -2) for e in edges], dtype=np.bool_)
    used = list(compress(edges, inside))
    priors = priors_of(team, prior, sigma, options)
    seen = matched(used, team.index_of) if seen is None else seen.only_edges(inside)
    tables = [cameras[name].focal_gains for name in team.robots]
    sightings = with_gains(seen.sightings, team.robot_of, tables)
    state = start_state(team, start, priors, cameras)
    job = Job(team, cameras, sightings, seen.links, used, options)
    warm = None if earlier is None else going_on(earlier, start, team, priors, cameras)
    try:
        if earlier is not None and warm is not None:
            again = _gone_on(job, warm)
            if again is not None:
                return report(Ends(start, team, cameras, options, earlier.settled_frames), *again)
        found = _solved(job, priors, state)
    except NotPositiveDefiniteError:
        text = "the correspondences leave a pose or an attitude undetermined"
        return BundleRefusal(Illposed.SINGULAR, float(len(job.links)), float(len(job.links)), text)
    if isinstance(found, BundleRefusal):
        return found
    return report(Ends(start, team, cameras, options, len(team.frames)), *found)


def _solved(job: Job, priors: Priors, state: State) -> Solved | BundleRefusal:
    """Cut wrong correspondences, see whether the floor is flat and the files hold, and solve."""
    options = job.options
    first = _rough(job, priors, state, noise=1.0)
    if isinstance(first, BundleRefusal):
        return first
    # Right correspondences contradict a wrong file: free its numbers before any of them are cut.
    priors, rough, state = settled_files(*first, options, job.settled_trial)
    clean = _cleaned(job, priors, rough.noise, state)
    joined = _joined(job, clean)
    num_frames = len(job.team.frames)
    most = max(options.trial_sightings // num_frames, LEAST_TRIAL)
    points = sampled(*joined, job.sightings, most)
    trial = _stage(job, clean, priors, state, points, job.settled_trial)
    if isinstance(trial, BundleRefusal):
        return trial
    relief, better = settle_relief(*trial, options, job.settled_trial)
    state = better.state
    if relief > 0.0:
        priors, state = _judged_anew(trial[0], better, relief, options)
        clean = _cleaned(job, priors, better.noise, state)
        joined = _joined(job, clean)
    last = _last(job, clean, priors, state, joined)
    if isinstance(last, BundleRefusal):
        return last
    problem, solution, test = with_better_files(*last, options, SETTLED)
    return problem, solution, clean, test


def _gone_on(job: Job, warm: Warm) -> Solved | None:
    """Take in what is new; None where what was judged before no longer holds."""
    priors, found = warm.priors, _placed(job, warm)
    if found is None:
        first = _rough(job, priors, warm.state)
        if isinstance(first, BundleRefusal):
            return None
        state, noise = first[1].state, first[1].noise
        found = state, _cleaned(job, priors, noise, state)
    state, clean = found
    last = _last(job, clean, priors, state, _joined(job, clean))
    if isinstance(last, BundleRefusal):
        return None
    problem, solution, test = with_better_files(*last, job.options, SETTLED)
    return (problem, solution, clean, test) if problem is last[0] else None


def _placed(job: Job, warm: Warm) -> tuple[State, Cut] | None:
    """Place the new frames among the known and cut; None where these have to move for that."""
    priors, links, seen = warm.priors, job.links, job.sightings
    if priors.relief > 0.0:
        return None
    state = placed_among_known(links, seen, warm.state, priors, warm.known, job.options)
    if state is None:
        return None
    chi2 = link_chi2(links, seen, state, priors, 1.0)
    # Where much contradicts what was known, the noise seems larger, and nothing wrong.
    noise = min(noise_of(chi2), warm.noise)
    wrong = chi2 > (job.options.link_gate_sigma * noise) ** 2
    if not agrees(links, wrong, job.edges, warm.rejected):
        return None
    return state, cut(links, job.edges, wrong, job.options)


def _rough(
    job: Job, priors: Priors, state: State, noise: float | None = None
) -> tuple[Problem, Solution] | BundleRefusal:
    """Solve with some correspondences, right and wrong, each a floor point of its own."""
    every = cut(job.links, job.edges, np.zeros(len(job.links), dtype=np.bool_), job.options)
    thin = thinned(every.links, job.sightings, job.options.start_sightings)
    points = single_links(every.links.only(thin))
    return _stage(job, every, priors, state, points, job.settled_trial, noise)


def _last(
    job: Job, clean: Cut, priors: Priors, state: State, joined: Points
) -> tuple[Problem, Solution] | BundleRefusal:
    """Solve with as many sightings as take part."""
    most = max(job.options.most_sightings // len(job.team.frames), LEAST_SIGHTINGS)
    points = sampled(*joined, job.sightings, most)
    return _stage(job, clean, priors, state, points, SETTLED)


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


def _cleaned(job: Job, priors: Priors, noise: float, state: State) -> Cut:
    """Cut the correspondences that do not meet on the floor."""
    chi2 = link_chi2(job.links, job.sightings, state, priors, noise)
    return cut(job.links, job.edges, chi2 > job.options.link_gate_sigma**2, job.options)


def _stage(
    job: Job,
    clean: Cut,
    priors: Priors,
    state: State,
    points: Points,
    settled: float,
    noise: float | None = None,
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
        settled=settled,
        noise=noise,
    )
    return problem, solution
