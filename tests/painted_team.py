"""Small team folders of a painted floor, quick to make and to fuse: for the tests of the command.

The floor is a raster of noise that never repeats; a picture reads it at four rays a pixel, through
the tilt, roll and height that were drawn for it, so that poses and attitudes are known exactly.
"""

import atexit
import functools
import math
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from groundfuse.backend.measurement import IDENTITY, Attitude, Se2
from groundfuse.frontend.camera import Camera, Intrinsics, Mount
from groundfuse.frontend.overhead import floor_from_rays
from groundfuse.tools.camera_file import camera_text
from groundfuse.tools.trajectory_file import trajectory_text

CELL_M = 0.0025
SIDE_M = 5.0
HEIGHT_M = 0.55
SIGMA = Attitude(math.radians(0.3), math.radians(0.1), 0.001)
FINE = 2  # rays a pixel, along each side
QUICK = (
    "front_end.features.per_square_height=150",
    "front_end.features.overhead.cell_per_height=0.006",
    "mosaic.m_per_px=0.01",
)
"""Settings with which a picture of a painted team takes a tenth of a second."""


@dataclass(frozen=True)
class Member:
    """A robot and its true poses."""

    poses: tuple[Se2, ...]
    tilt_deg: float = 33.0
    offset: Se2 = IDENTITY


def arc(count, start=IDENTITY, step_m=0.2, turn_rad=0.15):
    """Poses along an arc, `step_m` apart."""
    poses = [start]
    for _ in range(count - 1):
        poses.append(poses[-1] @ Se2(step_m, 0.0, turn_rad))
    return tuple(poses)


PAIR = {
    "A": Member(arc(4), offset=Se2(0.1, 0.02, 0.05)),
    "B": Member(arc(3, Se2(0.3, 0.2, 0.9)), tilt_deg=40.0),
}
"""Two robots whose every view shows floor that another one shows."""


@functools.cache
def painted_floor(seed):
    """Raster (rows, columns, 3) of colours, the world's origin in its middle."""
    rng, side = np.random.default_rng(seed), round(SIDE_M / CELL_M)
    floor = np.full((side, side, 3), 128.0, dtype=np.float32)
    for grain in (2, 4, 8, 16, 64):
        coarse = rng.normal(0.0, 22.0, (side // grain, side // grain, 3)).astype(np.float32)
        floor += cv2.resize(coarse, (side, side), interpolation=cv2.INTER_CUBIC)
    return np.clip(floor, 0, 255)


def make_camera(member):
    lens = Intrinsics(240, 180, 190.0, 191.0, 118.2, 91.1)
    mount = Mount(Attitude(math.radians(member.tilt_deg), 0.0, HEIGHT_M), SIGMA, member.offset)
    return Camera(lens, mount)


def picture(floor, camera, attitude, world_from_base):
    """What the camera sees, BGR uint8."""
    lens = camera.intrinsics
    v, u = np.mgrid[0 : lens.height_px * FINE, 0 : lens.width_px * FINE]
    px = (np.column_stack([u.ravel(), v.ravel()]) + 0.5) / FINE - 0.5
    seen = floor_from_rays(attitude, lens.rays_from_px(px))
    at = (world_from_base @ camera.mount.base_from_foot).apply(seen) / CELL_M + floor.shape[0] / 2
    maps = at.astype(np.float32).reshape(*u.shape, 2)
    read = cv2.remap(floor, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    mean = cv2.resize(read, (lens.width_px, lens.height_px), interpolation=cv2.INTER_AREA)
    return np.clip(np.rint(mean), 0, 255).astype(np.uint8)


def paint_team(folder: Path, members=PAIR, seed=1) -> Path:
    """Write a team folder with ground truth."""
    floor = painted_floor(seed)
    for number, (name, member) in enumerate(members.items()):
        rng, camera = np.random.default_rng([seed, number]), make_camera(member)
        images = folder / name / "images"
        images.mkdir(parents=True)
        for index, pose in enumerate(member.poses):
            tilt, roll, height = rng.standard_normal(3).tolist()
            attitude = Attitude(
                camera.mount.attitude.tilt_rad + tilt * SIGMA.tilt_rad,
                roll * SIGMA.roll_rad,
                HEIGHT_M + height * SIGMA.height_m,
            )
            image = picture(floor, camera, attitude, pose)
            assert cv2.imwrite(str(images / f"img_{index:02d}.png"), image)
        (folder / name / "camera.yaml").write_text(camera_text(camera))
        truth = trajectory_text((float(i), pose) for i, pose in enumerate(member.poses))
        (folder / name / "groundtruth.tum").write_text(truth)
    return folder


@functools.cache
def painted_pair() -> Path:
    """The team `PAIR`, made once; not to be changed."""
    folder = Path(tempfile.mkdtemp(prefix="painted"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return paint_team(folder)


def copied_pair(folder: Path) -> Path:
    """A copy of `PAIR` to spoil."""
    shutil.copytree(painted_pair(), folder)
    return folder
