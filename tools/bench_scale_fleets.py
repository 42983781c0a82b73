"""Teams of any size for `bench_scale.py`: rendered into folders, or in memory."""

import math
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from groundfuse.backend.measurement import Se2
from groundfuse.frontend.arrays import Floats
from groundfuse.tools import render_team
from groundfuse.tools.errors import DataError
from groundfuse.tools.lawn import ROW_PER_HEIGHT, mown, side_m
from groundfuse.tools.overlap import near_pairs, true_overlap
from groundfuse.tools.photometry import Photometry
from groundfuse.tools.robot import Robot
from groundfuse.tools.team_folder import read_team
from groundfuse.tools.trajectories import WAY_PER_HEIGHT
from groundfuse.tools.world import RenderedFrame, RobotSpec, photographs, set_scene

NAMES = ("A", "B", "C", "D")
ROBOTS = ("A:33", "B:45", "C:33", "D:45")
WIDTH = 320


def fleet_path(folder: Path, num_frames: int, seed: int) -> Path:
    """Return where a fleet is."""
    return folder / f"fleet_{num_frames}_{seed}"


def fleet(folder: Path, num_frames: int, seed: int) -> tuple[Robot, ...]:
    """Render four robots that mow a field, unless they are there, and read them.

    Raises:
        DataError: not a positive multiple of the robots, or what can't be rendered or read.
    """
    views, over = divmod(num_frames, len(NAMES))
    if views < 1 or over:
        raise DataError(f"a fleet needs a multiple of {len(NAMES)} frames, got {num_frames}")
    path = fleet_path(folder, num_frames, seed)
    if not path.exists():
        half = path.with_name(f"{path.name}.half")  # a bench that was stopped leaves no half fleet
        shutil.rmtree(half, ignore_errors=True)
        words = ["--out", str(half), "--way", "lawn", "--width", str(WIDTH), "--seed", str(seed)]
        if render_team.main([*words, "--robots", *ROBOTS, "--views", str(views)]) != 0:
            raise DataError(f"{path}: could not be rendered")
        half.rename(path)
    return read_team(path, NAMES)


@dataclass(frozen=True, slots=True, eq=False)
class TwiceMown:
    """Two robots that mowed the same field: pictures, and the overlaps between the robots.

    Attributes:
        frames: the pictures of the first robot, then those of the second.
        num_first: pictures of the first.
        overlap: (num_first, others) share of the smaller footprint.
    """

    frames: tuple[RenderedFrame, ...]
    num_first: int
    overlap: Floats


def twice_mown(floor: str, seed: int, num_views: int) -> TwiceMown:
    """Photograph a floor with two robots of tilts 33 and 45 deg, one along and one across.

    Raises:
        ValueError: an unknown floor, or no view.
    """
    words = render_team.parser().parse_args(["--out", "-", "--width", str(WIDTH)])
    cameras = [render_team.robot_camera(word, k, words) for k, word in enumerate(ROBOTS[:2])]
    height = words.height
    row, step = ROW_PER_HEIGHT * height, WAY_PER_HEIGHT * height
    length = side_m(num_views, row, step, height)
    poses = mown(num_views, length, row, step, height)
    rng = np.random.default_rng([seed, 99])
    corners = (Se2(0.0, 0.0, 0.0), Se2(length, 0.2 * height, math.pi / 2.0))
    robots = [
        RobotSpec(name, camera, _placed(corner, poses, rng))
        for (name, camera), corner in zip(cameras, corners, strict=True)
    ]
    scene = set_scene(floor, seed, robots, 8, render_team.WIDTH / WIDTH)
    overlap = np.zeros((num_views, num_views))
    a, b = scene.views
    for i, j in near_pairs(a, b):
        overlap[i, j] = true_overlap(a[i], b[j])
    return TwiceMown(tuple(photographs(scene, Photometry())), num_views, overlap)


def _placed(corner: Se2, poses: Floats, rng: np.random.Generator) -> tuple[Se2, ...]:
    sway = 0.03 * rng.standard_normal(len(poses))
    return tuple(
        corner @ Se2(*map(float, p)) @ Se2(0.0, 0.0, float(s))
        for p, s in zip(poses, sway, strict=True)
    )
