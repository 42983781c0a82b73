"""Planar bundle: poses, attitudes and mounts of the whole team from all correspondences at once.

A camera that nods by half a degree moves the floor by a centimetre, and each pair absorbs that
differently; a frame's tilt, roll and height are shared by all its pairs, so the joint system knows
them. First stage: every correspondence a floor point of its own, thinned, so that a wrong one
harms nothing else. Then correspondences whose ends do not meet are cut, the rest are joined into
tracks, and the second stage solves for all of them. numpy and scipy only.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum, auto

import numpy as np
from numpy.typing import NDArray

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
    as_filed,
    contradicted,
    files_test,
    freed_priors,
    with_better_files,
)
from groundfuse.backend.bundle_model import State
from groundfuse.backend.bundle_priors import Priors
from groundfuse.backend.bundle_relief import settle_relief
from groundfuse.backend.bundle_report import Ends, report
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
    sampled,
    sightings_from_edges,
    single_links,
    thinned,
    tracks,
)
from groundfuse.backend.measurement import Attitude, FrameId, RelativePose, TeamEstimate

Mask = NDArray[np.bool_]

START_SETTLED, SETTLED = 10.0, 0.1
"""Chi-square that a last step may still gain: far below one sigma of anything in the end."""
DEFAULT = BundleOptions()


class Sample(Enum):
    """Which sightings a stage uses."""

    LINKS = auto()
    """A few correspondences, each a floor point of its own."""
    TRACKS = auto()
    """Some floor points with all their sightings."""
    ALL = auto()
    """Everything."""


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
    first = _stage(job, clean, priors, state, Sample.LINKS)
    if isinstance(first, BundleRefusal):
        return first
    _, rough = first
    free = contradicted(files_test(*first, options), priors, options)
    priors, state = freed_priors(priors, free), as_filed(rough.state, free)
    clean = _cleaned(job, priors, rough, rough.state)
    trial = _stage(job, clean, priors, state, Sample.TRACKS)
    if isinstance(trial, BundleRefusal):
        return trial
    relief, state = settle_relief(*trial, options, START_SETTLED)
    if relief > 0.0:
        priors = replace(priors, relief=relief)
        clean = _cleaned(job, priors, trial[1], state)
    last = _stage(job, clean, priors, state, Sample.ALL)
    if isinstance(last, BundleRefusal):
        return last
    problem, solution, test = with_better_files(*last, options, SETTLED)
    return problem, solution, clean, test


def _cleaned(job: Job, priors: Priors, rough: Solution, state: State) -> Cut:
    """Cut the correspondences that do not meet on the floor."""
    chi2 = link_chi2(job.links, job.sightings, state, priors, rough.noise)
    return cut(job.links, job.edges, chi2 > job.options.link_gate_sigma**2, job.options)


def _stage(
    job: Job, clean: Cut, priors: Priors, state: State, sample: Sample
) -> tuple[Problem, Solution] | BundleRefusal:
    """Solve with some of the sightings or all."""
    options = job.options
    if len(clean.links) < options.min_links:
        text = f"{len(clean.links)} correspondences in all, {options.min_links} needed for a pair"
        return BundleRefusal(
            Illposed.NO_POINTS, float(len(clean.links)), float(options.min_links), text
        )
    used, point = _sample(job, clean, sample)
    seen = observations(job.sightings, used, point, priors.num_frames)
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
        settled=SETTLED if sample is Sample.ALL else START_SETTLED,
    )
    return problem, solution


def _sample(job: Job, clean: Cut, sample: Sample) -> tuple[Integers, Integers]:
    """Sightings and floor points, (sighting, point) of every observation."""
    if sample is Sample.LINKS:
        thin = thinned(clean.links, job.sightings, job.options.start_sightings)
        return single_links(clean.links.only(thin))
    joined = tracks(clean.links, job.sightings) if job.options.tracks else single_links(clean.links)
    if sample is Sample.ALL:
        return joined
    return sampled(*joined, job.sightings, job.options.trial_sightings)
