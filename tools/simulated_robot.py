"""A simulated robot: its true camera, what its file says of it, and its way."""

import math
from dataclasses import dataclass

import numpy as np

from groundfuse.backend.measurement import Attitude, Se2
from groundfuse.frontend.arrays import Floats

MOUNTED = Se2(0.1, 0.02, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedRobot:
    """A robot's true camera, what its file says where that is wrong, and its path.

    Attributes:
        name: of the robot.
        path: (n, 3) true x m, y m, theta rad of the base.
        tilt_deg: of the mount.
        roll_deg: of the mount.
        height_m: of the mount.
        base_from_foot: of the mount.
        focal_factor: true focal length over the file's.
        distortion: true first distortion term minus the file's.
        file_tilt_deg: what the file says; None for the truth.
        file_roll_deg: likewise.
        file_height_m: likewise.
    """

    name: str
    path: Floats
    tilt_deg: float = 33.0
    roll_deg: float = 0.0
    height_m: float = 0.55
    base_from_foot: Se2 = MOUNTED
    focal_factor: float = 1.0
    distortion: float = 0.0
    file_tilt_deg: float | None = None
    file_roll_deg: float | None = None
    file_height_m: float | None = None

    def filed(self) -> Attitude:
        """Return the attitude that the file states."""
        tilt_deg = self.tilt_deg if self.file_tilt_deg is None else self.file_tilt_deg
        roll_deg = self.roll_deg if self.file_roll_deg is None else self.file_roll_deg
        height_m = self.height_m if self.file_height_m is None else self.file_height_m
        return Attitude(math.radians(tilt_deg), math.radians(roll_deg), height_m)


def loop_path(
    count: int,
    centre: tuple[float, float] = (0.0, 0.0),
    size: tuple[float, float] = (1.2, 0.8),
    phase: float = 0.0,
    turns: float = 1.0,
) -> Floats:
    """Return an oval (count, 3) with headings along it."""
    angle = phase + 2 * math.pi * turns * np.arange(count) / count
    x, y = centre[0] + size[0] * np.cos(angle), centre[1] + size[1] * np.sin(angle)
    theta = np.arctan2(size[1] * np.cos(angle), -size[0] * np.sin(angle))
    return np.column_stack([x, y, theta])


def lawn_path(rows: int, columns: int, step_m: float = 0.2, row_step_m: float = 0.35) -> Floats:
    """Return a way (rows columns, 3) back and forth in rows."""
    poses: list[tuple[float, float, float]] = []
    for row in range(rows):
        along = (np.arange(columns) * step_m).tolist()
        heading, order = (0.0, along) if row % 2 == 0 else (math.pi, along[::-1])
        poses += [(x, row * row_step_m, heading) for x in order]
    return np.array(poses)
