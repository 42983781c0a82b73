"""Refuse cameras whose pictures show no floor finely enough, before any picture is decoded."""

import math
from collections.abc import Iterable

from groundfuse.backend.measurement import Attitude
from groundfuse.frontend.overhead_view import OverheadOptions, overhead_grid
from groundfuse.tools.errors import DataError
from groundfuse.tools.robot import Robot


def check_floor(robots: Iterable[Robot], options: OverheadOptions) -> None:
    """Try the overhead view of each robot's most tilted and of its highest frame.

    Raises:
        DataError: no floor is resolved there, or the raster would be too large.
    """
    for robot in robots:
        attitudes = [frame.attitude for frame in robot.frames]
        most_tilted = max(attitudes, key=lambda attitude: attitude.tilt_rad)
        highest = max(attitudes, key=lambda attitude: attitude.height_m)
        for attitude in dict.fromkeys((most_tilted, highest)):
            try:
                overhead_grid(robot.camera, attitude, options)
            except ValueError as error:
                raise DataError(f"robot {robot.name}, {_words(attitude)}: {error}") from error


def _words(attitude: Attitude) -> str:
    return f"tilt {math.degrees(attitude.tilt_rad):.4g} deg, height {attitude.height_m:.4g} m"
