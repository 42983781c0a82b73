"""Write pictures of others, and what is known of them, as team folders."""

import math
from dataclasses import dataclass
from pathlib import Path

from groundfuse.backend.measurement import Attitude, Se2
from groundfuse.frontend.camera import Camera
from groundfuse.tools.camera_file import camera_text
from groundfuse.tools.errors import DataError
from groundfuse.tools.files import write_atomic
from groundfuse.tools.frames_file import FrameRow, frames_text
from groundfuse.tools.trajectory_file import trajectory_text


@dataclass(frozen=True, slots=True)
class RealRobot:
    """What becomes a robot's folder.

    Attributes:
        name: of the robot.
        camera: goes to `camera.yaml`.
        pictures: where they are now.
        frames: go to `frames.csv`, one per picture.
        truth: (time_s, pose of the base), goes to `groundtruth.tum`.
        attitudes: (picture's name, true attitude), go to `reference_attitude.csv`; for scoring.
    """

    name: str
    camera: Camera
    pictures: tuple[Path, ...]
    frames: tuple[FrameRow, ...]
    truth: tuple[tuple[float, Se2], ...]
    attitudes: tuple[tuple[str, Attitude], ...] = ()


def write_team(folder: Path, robots: tuple[RealRobot, ...]) -> None:
    """Write a team folder, in place of one of the same name.

    Raises:
        DataError: a picture is missing, or the folder can't be written.
    """
    for robot in robots:
        home = folder / robot.name
        for picture in robot.pictures:
            try:
                data = picture.read_bytes()
            except OSError as error:
                raise DataError(f"{picture}: cannot read: {error.strerror}") from error
            write_atomic(home / "images" / picture.name, data)
        write_atomic(home / "camera.yaml", camera_text(robot.camera))
        write_atomic(home / "frames.csv", frames_text(robot.frames))
        write_atomic(home / "groundtruth.tum", trajectory_text(robot.truth))
        if robot.attitudes:
            write_atomic(home / "reference_attitude.csv", _attitudes_text(robot.attitudes))


def _attitudes_text(attitudes: tuple[tuple[str, Attitude], ...]) -> str:
    lines = ["image,tilt_deg,roll_deg,height_m"]
    for name, seen in attitudes:
        tilt, roll = math.degrees(seen.tilt_rad), math.degrees(seen.roll_rad)
        lines.append(f"{name},{tilt:.6f},{roll:.6f},{seen.height_m:.4f}")
    return "\n".join(lines) + "\n"
