"""Another look with better camera files: where pictures contradict a file, match them again.

A wrong file costs more than its own error: right correspondences that do not fit it are turned
down, and those that remain are the ones that resemble it, so that an estimate of the file's error
from them is too small. Pairs measured with the corrected files do not have that bias. The bundle
is still told what the files say, so that all it states is said about them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from groundfuse.backend.bundle_estimate import FocalGains, MountEstimate
from groundfuse.backend.bundle_tracks import gain_at
from groundfuse.backend.measurement import Array, Correspondences, RelativePose
from groundfuse.tools.calibration_file import (
    calibrated_attitude,
    calibrated_camera,
    correction,
)
from groundfuse.tools.focal_gain import focal_gains
from groundfuse.tools.robot import Robot

WORTH_WOBBLE = 0.5
"""A mount this far off, in its pictures' own wobble, is worth another look."""
WORTH_SIGMA = 1.0
"""A lens is, where this much of its own sigma is still wrong,"""
WORTH_LENS = 3e-4
"""and this much of its focal length: 0.1 px far out, a third of a keypoint's error in a pair."""


def is_worth_it(
    robots: Sequence[Robot], assumed: Sequence[MountEstimate], found: Sequence[MountEstimate]
) -> bool:
    """Whether the cameras that the pairs were measured with are off by enough to have cost pairs.

    Args:
        robots: as filed.
        assumed: what the last look took them for; nothing means the files.
        found: what the bundle says now.
    """
    before = {mount.robot: _numbers(mount) for mount in assumed}
    wobble = {robot.name: robot.camera.mount for robot in robots}
    for mount in found:
        change = np.abs(_numbers(mount) - before.get(mount.robot, np.zeros(5)))
        of = wobble[mount.robot]
        own = of.sigma.tilt_rad, of.sigma.roll_rad, of.sigma.height_m / of.attitude.height_m
        if np.any(change[:3] > WORTH_WOBBLE * np.array(own)):
            return True
        lens = [0.0 if f is None else f.sigma for f in (mount.focal, mount.distortion)]
        if np.any(change[3:] > np.maximum(WORTH_SIGMA * np.array(lens), WORTH_LENS)):
            return True
    return False


def _numbers(found: MountEstimate) -> Array:
    """Corrections (5,) of tilt, roll, height, focal length and distortion."""
    kinds = (found.tilt_rad, found.roll_rad, found.height, found.focal, found.distortion)
    return np.array([correction(kind) for kind in kinds])


def corrected(robots: Sequence[Robot], mounts: Sequence[MountEstimate]) -> tuple[Robot, ...]:
    """Return the robots with the cameras that the bundle found; frames move with their mount."""
    of = {found.robot: found for found in mounts}
    return tuple(
        _corrected(robot, of[robot.name]) if robot.name in of else robot for robot in robots
    )


def _corrected(robot: Robot, found: MountEstimate) -> Robot:
    frames = tuple(
        replace(frame, attitude=calibrated_attitude(frame.attitude, found))
        for frame in robot.frames
    )
    return replace(robot, camera=calibrated_camera(robot.camera, found), frames=frames)


def as_filed(
    edges: Sequence[RelativePose], robots: Sequence[Robot], mounts: Sequence[MountEstimate]
) -> tuple[RelativePose, ...]:
    """Return the edges with their rays as the lenses of the files (`robots`) would have them.

    The rays are those of corrected cameras; the bundle's model of a lens takes them back, so that
    another bundle tells of the same files.
    """
    lenses = {robot.name: Lens(0.0, 0.0, focal_gains(robot.camera.intrinsics)) for robot in robots}
    for found in mounts:
        lenses[found.robot] = replace(
            lenses[found.robot],
            focal=correction(found.focal),
            distortion=correction(found.distortion),
        )
    return tuple(_edge_as_filed(edge, lenses) for edge in edges)


@dataclass(frozen=True, slots=True)
class Lens:
    """How far a lens is off its file, and what a ray makes of a longer focal length."""

    focal: float
    distortion: float
    gains: FocalGains


def _edge_as_filed(edge: RelativePose, lenses: Mapping[str, Lens]) -> RelativePose:
    of_a, of_b = lenses[edge.a.robot], lenses[edge.b.robot]
    points = edge.correspondences
    if points is None or not any((of_a.focal, of_a.distortion, of_b.focal, of_b.distortion)):
        return edge
    filed = Correspondences(
        _bent(points.rays_a, of_a),
        _bent(points.rays_b, of_b),
        points.sigma_a * (1.0 + of_a.focal),
        points.sigma_b * (1.0 + of_b.focal),
    )
    return replace(edge, correspondences=filed)


def _bent(rays: Array, lens: Lens) -> Array:
    """Apply the bundle's lens to rays (n, 2); equal rays stay equal to the bit."""
    longer = 1.0 + lens.focal * gain_at(rays, lens.gains)
    bulge = 1.0 + lens.distortion * np.sum(rays**2, axis=1)
    bent: Array = rays * (longer * bulge)[:, None]
    return bent
