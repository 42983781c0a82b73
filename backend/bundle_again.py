"""Going on from an earlier bundle of most of the same frames, instead of from the Pose2 graph.

What took the time is known then: whether the floor is flat, which camera files the pictures
contradict, and how poses and attitudes lie; a few steps take in what is new. The optimum is the
same, up to the last step's length; what was judged is judged again once the team has grown.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from groundfuse.backend.bundle_estimate import BundleCamera, BundleEstimate, MountEstimate
from groundfuse.backend.bundle_model import State
from groundfuse.backend.bundle_priors import Priors, offset_units
from groundfuse.backend.bundle_setup import Team
from groundfuse.backend.measurement import FrameId, Rejected, Se2, TeamEstimate

Array = NDArray[np.float64]

MOST_GROWTH = 1.5
"""A team this many times as large as when floor and files were judged last starts over."""


@dataclass(frozen=True, slots=True, eq=False)
class Warm:
    """Where an earlier bundle ended.

    Attributes:
        priors: with free what was free.
        state: without floor points; new frames lie nearly where they belong.
        known: (frames,) which frames it knows.
        rejected: pairs that it turned down.
        noise: see `noise_factor` of `BundleEstimate`.
    """

    priors: Priors
    state: State
    known: NDArray[np.bool_]
    rejected: tuple[Rejected, ...]
    noise: float


def going_on(
    earlier: BundleEstimate,
    start: TeamEstimate,
    team: Team,
    priors: Priors,
    cameras: Mapping[str, BundleCamera],
) -> Warm | None:
    """Return where an earlier bundle ended, or None where too much is new.

    A frame that it does not know is put where the Pose2 graph has it beside the nearest frame that
    it does.

    Args:
        earlier: of the same camera files and options.
        start: poses of the team graph.
        team: its frames and robots by number.
        priors: what the files say.
        cameras: by robot.
    """
    if len(team.frames) > MOST_GROWTH * earlier.settled_frames:
        return None
    poses = _known(earlier.team, start, team)
    if poses is None:
        return None
    is_known = np.array([f in poses and f in earlier.attitude for f in team.frames])
    poses |= _beside(poses, start)
    mounts = {mount.robot: mount for mount in earlier.mounts}
    shared = np.array([_shared(mounts.get(name)) for name in team.robots])
    attitude = priors.attitude + shared[priors.robot_of, :3] * offset_units(priors)
    for index, frame in enumerate(team.frames):
        if frame in earlier.attitude:
            known = earlier.attitude[frame]
            attitude[index] = known.tilt_rad, known.roll_rad, known.height_m
    feet = [(poses[f] @ cameras[f.robot].base_from_foot).vector() for f in team.frames]
    state = State(np.array(feet), attitude, shared, np.zeros((0, 3)))
    judged = _judged(priors, team, mounts, earlier.relief)
    return Warm(judged, state, is_known, earlier.rejected, earlier.noise_factor)


def _known(earlier: TeamEstimate, start: TeamEstimate, team: Team) -> dict[FrameId, Se2] | None:
    """Return earlier poses, moved with the references of today; None where one of those is new.

    Frames that were in another component than its reference are left out.
    """
    before, moves, home = earlier.team_from_base, dict[int, Se2](), dict[int, int]()
    for component, index in team.reference.items():
        reference = team.frames[index]
        if reference not in before:
            return None
        moves[component] = start.team_from_base[reference] @ before[reference].inverse()
        home[component] = earlier.component_of[reference]
    return {
        frame: moves[component] @ before[frame]
        for frame, component in start.component_of.items()
        if frame in before and earlier.component_of[frame] == home[component]
    }


def _beside(poses: Mapping[FrameId, Se2], start: TeamEstimate) -> dict[FrameId, Se2]:
    """Place the frames that have no pose yet beside the nearest of their component that has."""
    found: dict[FrameId, Se2] = {}
    for component in sorted(set(start.component_of.values())):
        members = sorted(f for f in start.team_from_base if start.component_of[f] == component)
        known = [frame for frame in members if frame in poses]
        new = [frame for frame in members if frame not in poses]
        if not new:
            continue
        places = [start.team_from_base[frame].vector()[:2] for frame in known]
        asked = [start.team_from_base[frame].vector()[:2] for frame in new]
        _, nearest = KDTree(np.array(places)).query(np.array(asked))
        for frame, place in zip(new, np.atleast_1d(nearest).tolist(), strict=True):
            beside = start.team_from_base[known[place]]
            found[frame] = poses[known[place]] @ beside.inverse() @ start.team_from_base[frame]
    return found


def _shared(mount: MountEstimate | None) -> Array:
    """Return what a robot's poses rested on (6,), as in `State.shared`."""
    shared = np.zeros(6)
    if mount is not None:
        numbers = (mount.tilt_rad, mount.roll_rad, mount.height, mount.focal, mount.distortion)
        for axis, found in enumerate(numbers):
            if found is not None and found.used and found.value is not None:
                shared[axis] = found.value
    return shared


def _judged(
    priors: Priors, team: Team, mounts: Mapping[str, MountEstimate], relief: float
) -> Priors:
    """Free what was free before; the mounts all or none."""
    any_mount = any(mount.tilt_rad.used for mount in mounts.values())
    lens = np.zeros_like(priors.free_lens)
    for index, name in enumerate(team.robots):
        if name in mounts:
            numbers = mounts[name].focal, mounts[name].distortion
            lens[index] = [number is not None and number.used for number in numbers]
    mount = np.full_like(priors.free_mount, any_mount)
    return replace(priors, free_mount=mount, free_lens=lens, relief=relief)
