"""The Seneca field as a team folder: one drone, two passes, so two robots.

The reference poses stem from structure from motion over all pictures. They are for scoring only:
they go into `groundtruth.tum` and `reference_attitude.csv`, which no estimate ever reads.
"""

import csv
import io
import json
import math
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from groundfuse.backend.measurement import Attitude, Se2
from groundfuse.frontend.arrays import Matrix
from groundfuse.frontend.camera import Camera, Distortion, Intrinsics, Mount
from groundfuse.tools.checks import finite_number
from groundfuse.tools.errors import DataError
from groundfuse.tools.files import read_text
from groundfuse.tools.frames_file import FrameRow
from groundfuse.tools.real_team import RealRobot

PASSES = {"A": range(73), "B": range(73, 161)}
"""Indices of `meta.csv`; the landing after them belongs to neither pass."""
HEIGHT_M = 65.0
MOUNT = Mount(
    Attitude(0.0, 0.0, HEIGHT_M), Attitude(math.radians(8.0), math.radians(8.0), 0.1 * HEIGHT_M)
)
"""A drone that banks and climbs: nadir, give or take 8 deg and 10 % of the height."""
GPS_HEIGHT_SIGMA_M = 6.0
GPS_STEP_SIGMA_M = 5.0
LOGGED_TURN_SIGMA_DEG = 20.0
"""Coarse, as the autopilot logged them: neither calibrated nor in step with the shutter."""


def seneca(source: Path, *, priors: bool) -> tuple[RealRobot, ...]:
    """Return the two robots; with `priors`, GPS heights and motion stand in the frame list.

    Raises:
        DataError: a file of the source is missing or isn't what it should be.
    """
    camera = Camera(_intrinsics(source / "ref_camera.json"), MOUNT, name="seneca")
    logged = _table(source / "meta.csv")
    reference = {row["file"]: row for row in _table(source / "ref_poses_colmap.csv")}
    robots = []
    for name, indices in PASSES.items():
        rows = [
            row
            for row in logged
            if int(row["index"]) in indices and (source / "images" / row["file"]).exists()
        ]
        frames = tuple(_frame(row, priors=priors) for row in rows)
        scored = [(row, reference[row["file"]]) for row in rows if row["file"] in reference]
        poses = [foot_pose(found) for _, found in scored]
        robots.append(
            RealRobot(
                name,
                camera,
                tuple(source / "images" / row["file"] for row in rows),
                frames,
                tuple(
                    (_time_s(row), pose) for (row, _), (pose, _) in zip(scored, poses, strict=True)
                ),
                tuple(
                    (row["file"], seen) for (row, _), (_, seen) in zip(scored, poses, strict=True)
                ),
            )
        )
    return tuple(robots)


def foot_pose(row: dict[str, str]) -> tuple[Se2, Attitude]:
    """Return the pose of `foot` in (east, north) and the attitude of a reference pose.

    `foot` is straight below the camera's centre, so it has the camera's east and north. The
    camera's axes in the world are W = Rz(heading) Rx(roll) B(tilt); its columns' vertical parts are
    -sin roll, -cos roll sin tilt, -cos roll cos tilt, and W[:, 0] = cos roll (sin heading,
    -cos heading). The heading so found is the one that a foot-to-foot motion turns by; where the
    camera leans both ways it differs from the picture's upward direction on the floor by
    atan(sin roll tan tilt).
    """
    quaternion = [finite_number(row[name], name) for name in ("qw_c2w", "qx", "qy", "qz")]
    W = _rotation(np.array(quaternion))
    roll = -math.asin(max(-1.0, min(1.0, W[2, 0])))
    tilt = math.atan2(-W[2, 1], -W[2, 2])
    heading = math.atan2(W[0, 0], -W[1, 0])
    east, north, height = (
        finite_number(row[name], name) for name in ("east_m", "north_m", "height_above_plane_m")
    )
    return Se2(east, north, heading), Attitude(tilt, roll, height)


def _rotation(quaternion: Matrix) -> Matrix:
    """Return the rotation of a quaternion (w, x, y, z)."""
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _intrinsics(path: Path) -> Intrinsics:
    """SIMPLE_RADIAL: f, cx, cy, k1, with the first pixel's centre at (0.5, 0.5); ours is at 0."""
    try:
        camera = json.loads(read_text(path))
        focal, cx, cy, k1 = camera["params"]
        size = camera["width"], camera["height"]
    except (ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path}: no camera with four params ({error})") from error
    return Intrinsics(
        *size, focal, focal, cx - 0.5, cy - 0.5, Distortion.PLUMB_BOB, (k1, 0.0, 0.0, 0.0, 0.0)
    )


def _table(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(read_text(path))))


def _time_s(row: dict[str, str]) -> float:
    return datetime.fromisoformat(row["utc"]).replace(tzinfo=UTC).timestamp()


def _frame(row: dict[str, str], *, priors: bool) -> FrameRow:
    if not priors:
        return FrameRow(row["file"], _time_s(row))
    return FrameRow(
        row["file"],
        _time_s(row),
        height_m=float(row["height_m"]),
        height_sigma_m=GPS_HEIGHT_SIGMA_M,
        odom_x_m=float(row["east_m"]),
        odom_y_m=float(row["north_m"]),
        odom_theta_deg=90.0 - float(row["heading_deg"]),
        odom_sigma_m=GPS_STEP_SIGMA_M,
        odom_sigma_deg=LOGGED_TURN_SIGMA_DEG,
    )
