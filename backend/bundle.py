"""Planar bundle: poses, attitudes and mounts of the whole team from all correspondences at once.

A camera that nods by half a degree moves the floor by a centimetre, and each pair absorbs that
differently; a frame's tilt, roll and height are shared by all its pairs, so the joint system knows
them. First stage: every correspondence a floor point of its own, thinned, so that a wrong one
harms nothing else. Then correspondences whose ends do not meet are cut, the rest are joined into
tracks, and the second stage solves for all of them. numpy and scipy only.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

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
from groundfuse.backend.bundle_lens import refine_lenses
from groundfuse.backend.bundle_model import State
from groundfuse.backend.bundle_priors import Priors
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
    Sightings,
    observations,
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


@dataclass(frozen=True, slots=True, eq=False)
class Job:
    """What both stages share."""

    team: Team
    priors: Priors
    cameras: Mapping[str, BundleCamera]
    sightings: Sightings
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
    job = Job(team, priors, cameras, sightings, options)
    state = start_state(team, start, priors, cameras)
    try:
        clean = cut(links, used, np.zeros(len(links), dtype=np.bool_), options)
        first = _stage(job, clean, state, thin=True)
        if isinstance(first, BundleRefusal):
            return first
        chi2 = link_chi2(links, sightings, first[1].state, priors.robot_of, first[1].noise)
        clean = cut(links, used, chi2 > options.link_gate_sigma**2, options)
        second = _stage(job, clean, first[1].state, thin=False)
    except NotPositiveDefiniteError:
        text = "the correspondences leave a pose or an attitude undetermined"
        return BundleRefusal(Illposed.SINGULAR, float(len(links)), float(len(links)), text)
    if isinstance(second, BundleRefusal):
        return second
    problem, solution, lens = refine_lenses(*second, options, SETTLED)
    ends = Ends(start, team, cameras, options)
    return report(ends, problem, solution, clean, lens)


def _stage(
    job: Job, clean: Cut, state: State, *, thin: bool
) -> tuple[Problem, Solution] | BundleRefusal:
    """Solve with thinned single links, or with all links joined into tracks."""
    options, priors = job.options, job.priors
    if len(clean.links) < options.min_links:
        text = f"{len(clean.links)} correspondences in all, {options.min_links} needed for a pair"
        return BundleRefusal(
            Illposed.NO_POINTS, float(len(clean.links)), float(options.min_links), text
        )
    if thin:
        used, point = single_links(
            clean.links.only(thinned(clean.links, job.sightings, options.start_sightings))
        )
    elif options.tracks:
        used, point = tracks(clean.links, job.sightings)
    else:
        used, point = single_links(clean.links)
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
        settled=START_SETTLED if thin else SETTLED,
    )
    return problem, solution
