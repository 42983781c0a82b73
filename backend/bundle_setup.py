"""From the team's poses, accepted pairs and files to the bundle's problem; numpy only."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from groundfuse.backend.bundle_estimate import BundleCamera, BundleOptions
from groundfuse.backend.bundle_landing_compiled import weighted_places
from groundfuse.backend.bundle_model import State, floor_points
from groundfuse.backend.bundle_priors import Between, Priors
from groundfuse.backend.bundle_tracks import Integers, Observations
from groundfuse.backend.measurement import Attitude, FrameId, RelativePose, TeamEstimate

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Team:
    """Frames and robots by number.

    Attributes:
        frames: all frames, sorted.
        robots: names, sorted.
        index_of: number of each frame.
        robot_of: (frames,) robot of each.
        component_of: (frames,) component of each.
        reference: frame number of each component's reference, by component.
    """

    frames: tuple[FrameId, ...]
    robots: tuple[str, ...]
    index_of: dict[FrameId, int]
    robot_of: Integers
    component_of: Integers
    reference: dict[int, int]


def team_of(start: TeamEstimate) -> Team:
    """Number the frames; a component's reference is its first frame without a covariance."""
    frames = tuple(sorted(start.team_from_base))
    robots = tuple(sorted({frame.robot for frame in frames}))
    robot_of = np.array([robots.index(frame.robot) for frame in frames])
    component_of = np.array([start.component_of[frame] for frame in frames])
    reference: dict[int, int] = {}
    for component in sorted(set(component_of.tolist())):
        members = np.flatnonzero(component_of == component).tolist()
        bare = [index for index in members if frames[index] not in start.covariance]
        reference[component] = (bare or members)[0]
    index_of = {frame: index for index, frame in enumerate(frames)}
    return Team(frames, robots, index_of, robot_of, component_of, reference)


def _table(attitudes: Mapping[FrameId, Attitude], team: Team, what: str) -> Array:
    """Collect attitudes (frames, 3).

    Raises:
        ValueError: a frame has none.
    """
    rows = []
    for frame in team.frames:
        if frame not in attitudes:
            raise ValueError(f"frame {frame} has no {what} of its attitude")
        found = attitudes[frame]
        rows.append((found.tilt_rad, found.roll_rad, found.height_m))
    return np.array(rows).reshape(-1, 3)


def priors_of(
    team: Team,
    prior: Mapping[FrameId, Attitude],
    sigma: Mapping[FrameId, Attitude],
    options: BundleOptions,
) -> Priors:
    """Collect what the files say.

    Raises:
        ValueError: a frame has no prior; a sigma or a height is not positive.
    """
    attitude, spread = _table(prior, team, "prior"), _table(sigma, team, "sigma")
    if not (spread > 0.0).all():
        worst = team.frames[int(np.argmin(spread.min(axis=1)))]
        raise ValueError(f"attitude sigmas of frame {worst} must be positive, got {spread.min():g}")
    if not (attitude[:, 2] > 0.0).all():
        worst = team.frames[int(np.argmin(attitude[:, 2]))]
        raise ValueError(f"frame {worst} must be above the floor, got {attitude[:, 2].min():g} m")
    shared_sigma = np.array(
        [
            math.radians(options.mount_tilt_sigma_deg),
            math.radians(options.mount_roll_sigma_deg),
            options.mount_height_sigma,
            options.focal_sigma,
            options.distortion_sigma,
            1.0,
        ]
    )
    fixed = np.zeros(len(team.frames), dtype=np.bool_)
    fixed[list(team.reference.values())] = True
    return Priors(
        attitude,
        spread,
        shared_sigma,
        team.robot_of,
        fixed,
        _scale_groups(team),
        np.ones((len(team.robots), 3), dtype=np.bool_),
        np.zeros((len(team.robots), 2), dtype=np.bool_),
        0.0,
    )


def _scale_groups(team: Team) -> Integers:
    """Robots (n,) by the group that shares a scale: those that meet in a component."""
    count, size = len(team.robots), int(team.component_of.max()) + 1
    ones = np.ones(len(team.frames), dtype=np.int8)
    graph = coo_matrix(
        (ones, (team.robot_of, count + team.component_of)), shape=(count + size, count + size)
    )
    _, label = connected_components(graph, directed=False)
    groups: Integers = np.unique(label[:count], return_inverse=True)[1]
    return groups


def start_state(
    team: Team, start: TeamEstimate, priors: Priors, cameras: Mapping[str, BundleCamera]
) -> State:
    """Begin at the team graph's poses and the files' attitudes, without floor points yet."""
    feet = [
        (start.team_from_base[frame] @ cameras[frame.robot].base_from_foot).vector()
        for frame in team.frames
    ]
    return State(
        np.array(feet).reshape(-1, 3),
        priors.attitude.copy(),
        np.zeros((priors.num_robots, 6)),
        np.zeros((0, 3)),
    )


def with_points(state: State, seen: Observations, robot_of: Integers) -> State:
    """Put each floor point where its sightings meet the floor, by the precision of each there."""
    landing = floor_points(seen.frame, seen.ray, seen.gain, state, robot_of)
    points = np.empty((seen.num_points, 3))
    weighted_places(seen.point, seen.sigma, landing, points)
    return State(state.pose, state.attitude, state.shared, points)


def between_of(
    edges: Sequence[RelativePose], team: Team, cameras: Mapping[str, BundleCamera]
) -> Between:
    """Turn edges between robot bases into relative poses of their cameras' feet."""
    poses, whiteners = [], []
    for edge in edges:
        in_a = cameras[edge.a.robot].base_from_foot
        in_b = cameras[edge.b.robot].base_from_foot
        poses.append((in_a.inverse() @ edge.a_from_b @ in_b).vector())
        by_base = in_b.inverse().adjoint()
        covariance = by_base @ edge.covariance @ by_base.T
        whiteners.append(np.linalg.inv(np.linalg.cholesky(covariance)))
    return Between(
        np.array([team.index_of[edge.a] for edge in edges], dtype=np.int64),
        np.array([team.index_of[edge.b] for edge in edges], dtype=np.int64),
        np.array(poses).reshape(-1, 3),
        np.array(whiteners).reshape(-1, 3, 3),
    )


def loose_frame(pair_key: Integers, between: Between, team: Team) -> FrameId | None:
    """Return a frame that nothing ties to its component's reference, or None."""
    count = len(team.frames)
    i = np.concatenate([pair_key // count, between.i])
    j = np.concatenate([pair_key % count, between.j])
    ones = np.ones(len(i), dtype=np.int8)
    graph = coo_matrix((ones, (i, j)), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    home = np.array([label[team.reference[c]] for c in team.component_of.tolist()])
    lost = np.flatnonzero(label != home)
    return team.frames[int(lost[0])] if len(lost) else None
