"""What a team folder holds once it is read: robots, their frames and what is known beforehand."""

from dataclasses import dataclass
from pathlib import Path

from groundfuse.backend.measurement import Attitude, FrameId, Se2
from groundfuse.frontend.camera import Camera


@dataclass(frozen=True, slots=True)
class Odometry:
    """Where the robot believed to be when it took a picture.

    Attributes:
        map_from_base: pose in the robot's own odometry frame, which drifts: only the motion from
            one frame to another means anything.
        sigma: standard deviations (m, m, rad) of the motion since the frame before.
    """

    map_from_base: Se2
    sigma: Se2


@dataclass(frozen=True, slots=True)
class Frame:
    """One picture and what is known about it before it is looked at.

    Attributes:
        id: robot and index in time, from 0.
        path: the picture.
        time_s: time stamp, or the index where the robot gave none.
        attitude: expected tilt, roll and height; the mount's where the robot gave none.
        sigma: standard deviations of the three.
        odometry: None where the robot gave none.
    """

    id: FrameId
    path: Path
    time_s: float
    attitude: Attitude
    sigma: Attitude
    odometry: Odometry | None = None


@dataclass(frozen=True, slots=True)
class Robot:
    """A member of the team.

    Attributes:
        name: of its folder.
        camera: intrinsics and mount.
        frames: in order of time; `frames[i].id.index == i`.
        truth: true poses of the base in one world for the whole team, for scoring only; None
            where the folder has none. A frame without a true pose is missing from it.
    """

    name: str
    camera: Camera
    frames: tuple[Frame, ...]
    truth: dict[FrameId, Se2] | None = None
