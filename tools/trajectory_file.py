"""Trajectories as text in the form of the TUM benchmark: `time x y z qx qy qz qw` a line.

Poses are those of the robot's base in the world, z up. `evo` and many others read these files.
"""

import math
from collections.abc import Iterable
from pathlib import Path

from groundfuse.backend.measurement import Se2
from groundfuse.tools.checks import finite_number
from groundfuse.tools.errors import DataError
from groundfuse.tools.files import read_text

NAMES = ("time_s", "x", "y", "z", "qx", "qy", "qz", "qw")
NORM_TOLERANCE = 0.01


def read_trajectory(path: Path) -> tuple[tuple[float, Se2], ...]:
    """Return (time_s, pose) per line, in the file's order; height and lean are left out.

    The heading is that of the x axis on the floor. Empty lines and those that begin with # are
    skipped.

    Raises:
        DataError: unreadable, a line that isn't eight finite numbers or whose quaternion isn't of
            length 1, or times that don't increase; with the line's number.
    """
    poses: list[tuple[float, Se2]] = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            time_s, pose = _pose(line.replace(",", " ").split())
            if poses and time_s <= poses[-1][0]:
                raise ValueError(f"time must increase, got {time_s:.9g} after {poses[-1][0]:.9g}")  # noqa: TRY301
        except ValueError as error:
            raise DataError(f"{path}: line {number}: {error}") from error
        poses.append((time_s, pose))
    return tuple(poses)


def trajectory_text(poses: Iterable[tuple[float, Se2]]) -> str:
    """Return the text of poses on the plane z = 0, from which `read_trajectory` gives them back."""
    lines = ["# time_s x y z qx qy qz qw"]
    for time_s, pose in poses:
        half = pose.theta_rad / 2.0
        numbers = (time_s, pose.x_m, pose.y_m, 0.0, 0.0, 0.0, math.sin(half), math.cos(half))
        lines.append(" ".join(map(repr, map(float, numbers))))
    return "\n".join(lines) + "\n"


def _pose(cells: list[str]) -> tuple[float, Se2]:
    if len(cells) != len(NAMES):
        raise ValueError(f"needs 8 numbers ({' '.join(NAMES)}), got {len(cells)}")
    time_s, x, y, _, *quaternion = map(finite_number, cells, NAMES)
    norm = math.hypot(*quaternion)
    if abs(norm - 1.0) > NORM_TOLERANCE:
        raise ValueError(f"the quaternion must have length 1, got {norm:.3g}")
    qx, qy, qz, qw = (value / norm for value in quaternion)
    heading = math.atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))
    return time_s, Se2(x, y, heading)
