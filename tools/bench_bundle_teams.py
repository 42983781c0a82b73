"""Teams for the bundle's bench: matched once, bundled and scored against their truth."""

import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from groundfuse.backend.bundle import bundle
from groundfuse.backend.bundle_estimate import (
    BundleCamera,
    BundleEstimate,
    BundleOptions,
    BundleRefusal,
)
from groundfuse.backend.drift import accuracy
from groundfuse.backend.measurement import Attitude, FrameId, Se2, TeamEstimate
from groundfuse.frontend.camera import Camera
from groundfuse.tools.errors import TeamError
from groundfuse.tools.front_end import Result
from groundfuse.tools.pipeline import (
    Fused,
    PipelineOptions,
    Stopwatch,
    accepted_edges,
    fuse_robots,
)
from groundfuse.tools.robot import Robot


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
        nees: mean over poses, relative to the reference frame; nan where its truth is unknown.
        residual_px: root mean square reprojection residual.
        noise: residuals over their promise.
        relief: that was allowed for.
        seconds: of the bundle.
    """

    num_frames: int
    num_pairs: int
    path_m: float
    errors_m: tuple[tuple[float, float], tuple[float, float]]
    nees: float
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
        mean(found.nees for found in some),
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


def _with_camera(robot: Robot, camera: Camera) -> Robot:
    frames = [replace(frame, attitude=camera.mount.attitude) for frame in robot.frames]
    return replace(robot, camera=camera, frames=tuple(frames))


def _quiet(items: Iterable[Result], total: int, title: str) -> Iterable[Result]:  # noqa: ARG001
    return items


def matched(robots: Sequence[Robot], num_workers: int) -> Fused:
    """Run the front-end and the Pose2 graph."""
    return fuse_robots(robots, PipelineOptions(), num_workers, _quiet, Stopwatch(), bundled=False)


def inputs(team: Fused) -> tuple[Any, ...]:
    """Return the bundle's arguments."""
    known = {frame: found for frame, (_, found) in team.frames.items()}
    cameras = {
        robot.name: BundleCamera(
            robot.camera.mount.base_from_foot, robot.camera.intrinsics.focal_px
        )
        for robot in team.robots
    }
    return (
        team.team,
        accepted_edges(team.team, team.edges),
        {frame: found.attitude for frame, found in known.items()},
        {frame: found.sigma for frame, found in known.items()},
        cameras,
    )


def measured(team: Fused, options: BundleOptions) -> tuple[Measured, BundleEstimate]:
    """Bundle and score the largest component.

    Raises:
        TeamError: the bundle refuses, or there is no truth to score against.
    """
    start, edges, prior, sigma, cameras = inputs(team)
    begin = time.perf_counter()
    found = bundle(start, edges, prior, sigma, cameras, options)
    seconds = time.perf_counter() - begin
    if isinstance(found, BundleRefusal):
        raise TeamError(f"no bundle ({found.reason.value}): {found.text}")
    truth = {frame: pose for robot in team.robots for frame, pose in (robot.truth or {}).items()}
    before, after = (accuracy(_largest(some), truth) for some in (team.team, found.team))
    if before is None or after is None:
        raise TeamError("a bench needs true poses of at least two frames")
    figures = Measured(
        after.num_frames,
        len(edges),
        after.path_m,
        ((before.ate_m, before.ate_scaled_m), (after.ate_m, after.ate_scaled_m)),
        mean_nees(found.team, truth),
        found.residual_px,
        found.noise_factor,
        found.relief,
        seconds,
    )
    return figures, found


def _largest(team: TeamEstimate) -> dict[FrameId, Se2]:
    return {f: pose for f, pose in team.team_from_base.items() if team.component_of[f] == 0}


def mean_nees(team: TeamEstimate, truth: Mapping[FrameId, Se2]) -> float:
    """Mean normalised squared error of poses relative to the reference; nan without its truth."""
    poses = _largest(team)
    reference = next(f for f in sorted(poses) if f not in team.covariance)
    if reference not in truth:
        return math.nan
    team_from_world = poses[reference] @ truth[reference].inverse()
    values = []
    for frame in sorted(set(poses) & set(truth) & set(team.covariance)):
        error = ((team_from_world @ truth[frame]).inverse() @ poses[frame]).vector()
        values.append(float(error @ np.linalg.solve(team.covariance[frame], error)))
    return float(np.mean(values)) if values else math.nan
