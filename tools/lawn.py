"""Robots that mow a field: rows back and forth in square blocks that share their borders.

For teams of any size: where a robot is depends on nothing but its number and the team's size, so
planning costs nothing. Every other robot mows across, and neighbours see each other's outer rows.
"""

import math
from collections.abc import Sequence

import numpy as np

from groundfuse.backend.measurement import Se2
from groundfuse.frontend.arrays import Floats
from groundfuse.frontend.camera import Camera
from groundfuse.tools.trajectories import HEADING_SIGMA_RAD, WAY_PER_HEIGHT
from groundfuse.tools.world import RobotSpec

ROW_PER_HEIGHT = 0.7
"""Distance of rows; with a field of view near 60 deg neighbours share about half."""
SHARED_ROWS = 2.0


def mown(num_views: int, length_m: float, row_m: float, step_m: float, swing_m: float) -> Floats:
    """Return poses (num_views, 3) along rows that begin at the origin, along x, joined by arcs.

    Args:
        num_views: of the robot.
        length_m: of a row, without its arcs.
        row_m: distance of the rows, to the left.
        step_m: how far the floor moves between two pictures.
        swing_m: how far ahead the camera looks: what a turn by 1 rad moves the floor.

    Raises:
        ValueError: no view, or a length, row or step without extent.
    """
    if num_views < 1 or not all(size > 0.0 for size in (length_m, row_m, step_m)):
        found = f"{num_views} views, length {length_m:g} m, row {row_m:g} m, step {step_m:g} m"
        raise ValueError(f"a lawn needs views and lengths above 0, got {found}")
    lap_m = length_m + turn_way_m(row_m, swing_m)
    way = np.arange(num_views) * step_m
    row, along = np.divmod(way, lap_m)
    turned = np.clip((along - length_m) / (lap_m - length_m), 0.0, 1.0) * math.pi
    radius = row_m / 2.0
    x = np.minimum(along, length_m) + radius * np.sin(turned)
    y = row * row_m + radius * (1.0 - np.cos(turned))
    back = row % 2 == 1  # odd rows lead back, and turn the other way round
    x = np.where(back, length_m - x, x)
    heading = np.where(back, math.pi - turned, turned)
    return np.column_stack([x, y, heading])


def turn_way_m(row_m: float, swing_m: float) -> float:
    """Return how far the floor moves in the picture on the arc from one row to the next."""
    return math.pi * math.hypot(row_m / 2.0, swing_m)


def side_m(num_views: int, row_m: float, step_m: float, swing_m: float) -> float:
    """Return the side of the square that the rows of so many views fill; see `mown`."""
    turn_m = turn_way_m(row_m, swing_m)
    # Rows and their arcs: side (side + turn) / row = all of the way.
    return (math.sqrt(turn_m**2 + 4.0 * num_views * step_m * row_m) - turn_m) / 2.0


def plan_lawn(
    cameras: Sequence[tuple[str, Camera]],
    num_views: int,
    rng: np.random.Generator,
    step_m: float | None = None,
) -> tuple[RobotSpec, ...]:
    """Plan a team that mows a field, one square block each.

    Args:
        cameras: names and cameras, in order.
        num_views: of each robot.
        rng: source of chance.
        step_m: way between pictures; by default WAY_PER_HEIGHT of the lowest camera's height.

    Raises:
        ValueError: as `mown`.
    """
    mounts = [camera.mount.attitude for _, camera in cameras]
    lowest = min((mount.height_m for mount in mounts), default=1.0)
    swing_m = max((m.height_m * math.tan(m.tilt_rad) for m in mounts), default=0.0)
    row_m, step = ROW_PER_HEIGHT * lowest, step_m or WAY_PER_HEIGHT * lowest
    length_m = side_m(num_views, row_m, step, swing_m)
    pitch_m = max(length_m - SHARED_ROWS * row_m, row_m)
    columns = math.ceil(math.sqrt(len(cameras)))
    team = []
    for k, (name, camera) in enumerate(cameras):
        block_row, block_column = divmod(k, columns)
        poses = mown(num_views, length_m, row_m, step, swing_m)
        poses[:, 2] += HEADING_SIGMA_RAD * rng.standard_normal(num_views)
        corner = Se2(block_column * pitch_m, block_row * pitch_m, 0.0)
        if (block_row + block_column) % 2:  # across: about the block's middle, to the other side
            corner = corner @ Se2(length_m, 0.0, math.pi / 2.0)
        team.append(
            RobotSpec(name, camera, tuple(corner @ Se2(*map(float, pose)) for pose in poses))
        )
    return tuple(team)
