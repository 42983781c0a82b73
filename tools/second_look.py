"""A second look with better camera files: where the pictures contradict a file, match them again.

A wrong file costs more than its own error: right correspondences that do not fit it are turned
down, and those that remain are the ones that resemble it, so that an estimate of the file's error
from them is too small. Pairs measured with the corrected files do not have that bias. The bundle
is still told what the files say, so that all it states is said about them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from groundfuse.backend.bundle_estimate import Estimated, MountEstimate
from groundfuse.backend.measurement import Array, Attitude, Correspondences, RelativePose
from groundfuse.tools.calibration_file import calibrated_camera
from groundfuse.tools.robot import Robot

WORTH_SIGMA = 0.5
"""A mount this far off, in its pictures' own wobble, is worth a second look; a lens always is."""


def is_worth_it(robots: Sequence[Robot], mounts: Sequence[MountEstimate]) -> bool:
    """Whether a file is off by enough to have cost pairs."""
    of = {robot.name: robot.camera.mount for robot in robots}
    for found in mounts:
        mount = of[found.robot]
        height = correction(found.height) * mount.attitude.height_m
        for value, sigma in (
            (correction(found.tilt_rad), mount.sigma.tilt_rad),
            (correction(found.roll_rad), mount.sigma.roll_rad),
            (height, mount.sigma.height_m),
        ):
            if abs(value) > WORTH_SIGMA * sigma:
                return True
        if correction(found.focal) != 0.0 or correction(found.distortion) != 0.0:
            return True
    return False


def correction(found: Estimated | None) -> float:
    """Return what the bundle adds to a file's number; 0 where it left it."""
    return found.value if found is not None and found.used and found.value is not None else 0.0


def corrected(robots: Sequence[Robot], mounts: Sequence[MountEstimate]) -> tuple[Robot, ...]:
    """Return the robots with the cameras that the bundle found; frames move with their mount."""
    of = {found.robot: found for found in mounts}
    return tuple(
        _corrected(robot, of[robot.name]) if robot.name in of else robot for robot in robots
    )


def _corrected(robot: Robot, found: MountEstimate) -> Robot:
    def moved(attitude: Attitude) -> Attitude:
        return Attitude(
            attitude.tilt_rad + correction(found.tilt_rad),
            attitude.roll_rad + correction(found.roll_rad),
            attitude.height_m * (1.0 + correction(found.height)),
        )

    frames = tuple(replace(frame, attitude=moved(frame.attitude)) for frame in robot.frames)
    return replace(robot, camera=calibrated_camera(robot.camera, found), frames=frames)


def as_filed(
    edges: Sequence[RelativePose], mounts: Sequence[MountEstimate]
) -> tuple[RelativePose, ...]:
    """Return the edges with their rays as the files' lenses would have them.

    The rays are those of corrected cameras; the bundle's model of a lens, filed = (1 + focal)
    (1 + term |ray|^2) ray, takes them back, so that a second bundle tells of the same files.
    """
    lenses = {
        found.robot: (correction(found.focal), correction(found.distortion)) for found in mounts
    }
    return tuple(_edge_as_filed(edge, lenses) for edge in edges)


def _edge_as_filed(edge: RelativePose, lenses: Mapping[str, tuple[float, float]]) -> RelativePose:
    of_a, of_b = lenses.get(edge.a.robot, (0.0, 0.0)), lenses.get(edge.b.robot, (0.0, 0.0))
    points = edge.correspondences
    if points is None or not (any(of_a) or any(of_b)):
        return edge
    filed = Correspondences(
        _bent(points.rays_a, *of_a),
        _bent(points.rays_b, *of_b),
        points.sigma_a * (1.0 + of_a[0]),
        points.sigma_b * (1.0 + of_b[0]),
    )
    return replace(edge, correspondences=filed)


def _bent(rays: Array, focal: float, term: float) -> Array:
    """Apply the bundle's lens to rays (n, 2); equal rays stay equal to the bit."""
    bent: Array = rays * ((1.0 + focal) * (1.0 + term * np.sum(rays**2, axis=1, keepdims=True)))
    return bent
