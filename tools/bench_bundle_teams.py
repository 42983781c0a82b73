"""Teams for the bundle's bench: matched once, bundled and scored against their truth."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from groundfuse.backend.bundle_estimate import BundleEstimate
from groundfuse.backend.drift import accuracy
from groundfuse.backend.measurement import Attitude, FrameId, Se2, TeamEstimate
from groundfuse.frontend.camera import Camera
from groundfuse.tools.errors import TeamError
from groundfuse.tools.pipeline import Fused, PipelineOptions, Stopwatch, fuse_robots
from groundfuse.tools.robot import Robot
from groundfuse.tools.team_graphs import accepted_edges
from groundfuse.tools.workers import silent


@dataclass(frozen=True, slots=True, kw_only=True)
class FileChange:
    """How far a robot's file is from its camera."""

    tilt_deg: float = 0.0
    roll_deg: float = 0.0
    height: float = 0.0
    focal: float = 0.0


FILES: Mapping[str, Mapping[str, FileChange]] = {
    "as filed": {},
    "mounts": {"A": FileChange(tilt_deg=1.0, roll_deg=0.5), "B": FileChange(height=0.01)},
    "focal": {"A": FileChange(focal=0.002), "B": FileChange(focal=0.002)},
}
"""Right files, and files that are wrong: nominal attitude of one robot and height of the other, and
both focal lengths by 0.2 %."""


@dataclass(frozen=True, slots=True)
class Measured:
    """One bundle's figures.

    Attributes:
        num_frames: that were compared with the truth.
        num_pairs: accepted pairs.
        path_m: true length of the ways.
        errors_m: of the Pose2 graph and of the bundle: rigid and similarity alignment.
        nees: mean over poses, relative to the reference frame, as they are and at the true scale;
            nan where the reference's truth is unknown.
        residual_px: root mean square reprojection residual.
        noise: residuals over their promise.
        relief: that was allowed for.
        seconds: of the bundle.
    """

    num_frames: int
    num_pairs: int
    path_m: float
    errors_m: tuple[tuple[float, float], tuple[float, float]]
    nees: tuple[float, float]
    residual_px: float
    noise: float
    relief: float
    seconds: float


def averages(some: Sequence[Measured]) -> Measured:
    """Return the mean of every figure."""

    def mean(values: Iterable[float]) -> float:
        return float(np.mean(list(values)))

    errors = np.mean([found.errors_m for found in some], axis=0).tolist()
    return Measured(
        round(mean(found.num_frames for found in some)),
        round(mean(found.num_pairs for found in some)),
        mean(found.path_m for found in some),
        ((errors[0][0], errors[0][1]), (errors[1][0], errors[1][1])),
        (mean(found.nees[0] for found in some), mean(found.nees[1] for found in some)),
        mean(found.residual_px for found in some),
        mean(found.noise for found in some),
        mean(found.relief for found in some),
        mean(found.seconds for found in some),
    )


def with_files(robots: Sequence[Robot], changes: Mapping[str, FileChange]) -> tuple[Robot, ...]:
    """Return the robots with other camera files; the pictures stay."""
    return tuple(
        _with_camera(robot, _changed(robot.camera, changes[robot.name]))
        if robot.name in changes
        else robot
        for robot in robots
    )


def _changed(camera: Camera, change: FileChange) -> Camera:
    filed, lens = camera.mount.attitude, camera.intrinsics
    attitude = Attitude(
        filed.tilt_rad + math.radians(change.tilt_deg),
        filed.roll_rad + math.radians(change.roll_deg),
        filed.height_m * (1.0 + change.height),
    )
    longer = 1.0 + change.focal
    lens = replace(lens, fx_px=lens.fx_px * longer, fy_px=lens.fy_px * longer)
    return replace(camera, intrinsics=lens, mount=replace(camera.mount, attitude=attitude))


def with_wobble(robots: Sequence[Robot], sigma: Attitude) -> tuple[Robot, ...]:
    """Return the robots with files that state another wobble; the pictures stay."""
    mounts = [replace(robot.camera.mount, sigma=sigma) for robot in robots]
    return tuple(
        _with_camera(robot, replace(robot.camera, mount=mount))
        for robot, mount in zip(robots, mounts, strict=True)
    )


def _with_camera(robot: Robot, camera: Camera) -> Robot:
    mount = camera.mount
    frames = [replace(f, attitude=mount.attitude, sigma=mount.sigma) for f in robot.frames]
    return replace(robot, camera=camera, frames=tuple(frames))


def fused(robots: Sequence[Robot], num_workers: int) -> tuple[Fused, float]:
    """Run the whole main job; with the seconds of its bundle."""
    watch = Stopwatch()
    team = fuse_robots(robots, PipelineOptions(), num_workers, silent, watch)
    return team, watch.seconds["bundle"]


def measured(team: Fused, seconds: float) -> tuple[Measured, BundleEstimate]:
    """Score the largest component; `seconds` were spent on the bundle.

    Positions are those of the cameras' feet: what stands between a camera and its robot's base does
    not stretch with the map, so bases would show a wrong scale even after a similarity.

    Raises:
        TeamError: the bundle refused, or there is no truth to score against.
    """
    found = team.bundled
    if not isinstance(found, BundleEstimate):
        raise TeamError(f"no bundle: {found.text if found else 'not asked for'}")
    feet = {robot.name: robot.camera.mount.base_from_foot for robot in team.robots}
    truth = {frame: pose for robot in team.robots for frame, pose in (robot.truth or {}).items()}
    true_feet = _at_feet(truth, feet)
    before, after = (
        accuracy(_at_feet(_largest(some), feet), true_feet) for some in (team.team, found.team)
    )
    if before is None or after is None:
        raise TeamError("a bench needs true poses of at least two frames")
    figures = Measured(
        after.num_frames,
        len(accepted_edges(team.team, team.edges)),
        after.path_m,
        ((before.ate_m, before.ate_scaled_m), (after.ate_m, after.ate_scaled_m)),
        (mean_nees(found.team, truth, feet, 1.0), mean_nees(found.team, truth, feet, after.scale)),
        found.residual_px,
        found.noise_factor,
        found.relief,
        seconds,
    )
    return figures, found


def _at_feet(poses: Mapping[FrameId, Se2], feet: Mapping[str, Se2]) -> dict[FrameId, Se2]:
    return {frame: pose @ feet[frame.robot] for frame, pose in poses.items()}


def _largest(team: TeamEstimate) -> dict[FrameId, Se2]:
    return {f: pose for f, pose in team.team_from_base.items() if team.component_of[f] == 0}


def mean_nees(
    team: TeamEstimate, truth: Mapping[FrameId, Se2], feet: Mapping[str, Se2], scale: float
) -> float:
    """Mean normalised squared error of poses relative to the reference; nan without its truth.

    `scale` stretches the estimate first: the covariances know of the heights' wobble, but not of a
    file whose height is wrong.
    """
    poses = _at_feet(_largest(team), feet)
    reference = next(f for f in sorted(poses) if f not in team.covariance)
    if reference not in truth:
        return math.nan
    true = _at_feet(truth, feet)
    values = []
    for frame in sorted(set(poses) & set(truth) & set(team.covariance)):
        seen = poses[reference].inverse() @ poses[frame]
        seen = Se2(scale * seen.x_m, scale * seen.y_m, seen.theta_rad)
        error = (true[frame].inverse() @ true[reference] @ seen).vector()
        by_foot = feet[frame.robot].inverse().adjoint()
        covariance = by_foot @ team.covariance[frame] @ by_foot.T
        values.append(float(error @ np.linalg.solve(covariance, error)))
    return float(np.mean(values)) if values else math.nan
