"""The planar frames as team folders: two floors, six pictures of each, exact truth."""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from groundfuse.backend.measurement import Attitude, Se2
from groundfuse.frontend.camera import Camera, Intrinsics, Mount
from groundfuse.tools.files import read_text
from groundfuse.tools.frames_file import FrameRow
from groundfuse.tools.real_team import RealRobot

CAMERA = Camera(
    Intrinsics(1024, 768, 1422.22, 1422.22, 511.5, 383.5),
    Mount(Attitude(0.0, 0.0, 2.5), Attitude(math.radians(0.05), math.radians(0.05), 0.002)),
    name="planar",
)
HALVES = {"A": (1, 2, 3), "B": (4, 5, 6)}
WHOLE = {"A": (1, 2, 3, 4, 5, 6)}


def planar(source: Path, floor: str, split: Mapping[str, Sequence[int]]) -> tuple[RealRobot, ...]:
    """Return the robots of one floor; `split` says which pictures are whose.

    Args:
        source: the folder `planar_frames`.
        floor: `mosaic` or `floorplan`.
        split: numbers of pictures per robot.

    Raises:
        DataError: a file of the source is missing.
    """
    rows = {
        int(row["frame"]): row
        for row in csv.DictReader(io.StringIO(read_text(source / "gt.csv")))
        if row["set"] == f"test_{floor}"
    }
    folder = source / f"test_{floor}"
    return tuple(
        RealRobot(
            name,
            CAMERA,
            tuple(folder / f"frame_{number}.png" for number in numbers),
            tuple(FrameRow(f"frame_{number}.png") for number in numbers),
            tuple((float(i), world_from_base(rows[number])) for i, number in enumerate(numbers)),
        )
        for name, numbers in split.items()
    )


def world_from_base(row: dict[str, str]) -> Se2:
    """Return a true pose: at yaw 0 the picture's upward direction, our x, is the world's y."""
    return Se2(float(row["x_m"]), float(row["y_m"]), math.radians(float(row["yaw_deg"]) + 90.0))
