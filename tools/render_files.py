"""A rendered team as files: the team folder that `fuse_team.py` reads, and the truth beside it.

TEAM/<robot>/images/img_00.jpg ...    pictures in order
TEAM/<robot>/camera.yaml              intrinsics and mount
TEAM/<robot>/groundtruth.tum          true poses of the base; the time is the picture's index
TEAM/truth_attitude.csv               true tilt, roll and height of every picture
TEAM/truth_overlaps.csv               shared part of the smaller footprint of every pair
TEAM/truth_obstacles.csv              what stands on the floor
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import cv2

from groundfuse.backend.measurement import FrameId
from groundfuse.frontend.arrays import Image
from groundfuse.tools.camera_file import camera_text
from groundfuse.tools.errors import DataError
from groundfuse.tools.files import write_atomic
from groundfuse.tools.obstacles import Obstacle
from groundfuse.tools.overlap import View, all_overlaps
from groundfuse.tools.robot_folder import CAMERA, IMAGES, TRUTH
from groundfuse.tools.trajectory_file import trajectory_text
from groundfuse.tools.world import RobotSpec, Scene

ATTITUDES, OVERLAPS, OBSTACLES = (
    "truth_attitude.csv",
    "truth_overlaps.csv",
    "truth_obstacles.csv",
)


def picture_name(frame: FrameId) -> str:
    """Return the file name of a picture."""
    return f"img_{frame.index:02d}.jpg"


def write_picture(team: Path, frame: FrameId, image: Image, quality: int) -> None:
    """Write one picture as JPEG of a quality from 1 to 100.

    Raises:
        DataError: it can't be written.
    """
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    path = team / frame.robot / IMAGES / picture_name(frame)
    if not done:
        raise DataError(f"{path}: OpenCV could not encode the picture")
    write_atomic(path, data.tobytes())


def write_truth(team: Path, scene: Scene) -> None:
    """Write everything of a team folder but the pictures.

    Raises:
        DataError: a file can't be written.
    """
    for robot in scene.robots:
        write_atomic(team / robot.name / CAMERA, camera_text(robot.camera))
        write_atomic(team / robot.name / TRUTH, truth_text(robot))
    views = scene.by_frame()
    write_atomic(team / ATTITUDES, attitude_text(views))
    write_atomic(team / OVERLAPS, overlap_text(views))
    write_atomic(team / OBSTACLES, obstacle_text(scene.world.obstacles))


def truth_text(robot: RobotSpec) -> str:
    """Return the true poses as a TUM trajectory."""
    return trajectory_text((float(i), pose) for i, pose in enumerate(robot.world_from_base))


def attitude_text(views: Mapping[FrameId, View]) -> str:
    """Return the true attitudes as CSV, full precision."""
    rows = []
    for frame, view in views.items():
        true = view.attitude
        tilt, roll = math.degrees(true.tilt_rad), math.degrees(true.roll_rad)
        rows.append(f"{frame.robot},{picture_name(frame)},{tilt!r},{roll!r},{true.height_m!r}")
    return _csv("robot,image,tilt_deg,roll_deg,height_m", rows)


def overlap_text(views: Mapping[FrameId, View]) -> str:
    """Return the overlaps of all pairs that have any as CSV; frames by robot and index."""
    rows = [f"{a},{b},{share:.4f}" for (a, b), share in all_overlaps(views).items()]
    return _csv("a,b,overlap", rows)


def obstacle_text(obstacles: Sequence[Obstacle]) -> str:
    """Return the obstacles as CSV."""
    rows = []
    for solid in obstacles:
        kind, place = "cylinder" if solid.is_round else "box", solid.world_from_solid
        size = f"{solid.half_x_m!r},{solid.half_y_m!r},{solid.height_m!r}"
        rows.append(f"{kind},{place.x_m!r},{place.y_m!r},{math.degrees(place.theta_rad)!r},{size}")
    return _csv("kind,x_m,y_m,theta_deg,half_x_m,half_y_m,height_m", rows)


def _csv(head: str, rows: Iterable[str]) -> str:
    return "\n".join([head, *rows]) + "\n"
