"""Read one robot's folder: its camera file, its pictures and what is known of each."""

import logging
import math
import re
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from groundfuse.backend.measurement import Attitude, FrameId, Se2
from groundfuse.frontend.camera import Camera, Mount
from groundfuse.tools.camera_file import read_camera
from groundfuse.tools.checks import nearest
from groundfuse.tools.errors import DataError
from groundfuse.tools.frames_file import FrameRow, read_frames
from groundfuse.tools.horizon import border_rays, check_horizon, check_lens
from groundfuse.tools.image_file import SUFFIXES, image_size
from groundfuse.tools.robot import Frame, Odometry, Robot
from groundfuse.tools.trajectory_file import read_trajectory

IMAGES, CAMERA, FRAMES, TRUTH = "images", "camera.yaml", "frames.csv", "groundtruth.tum"
SAME_TIME_S = 0.01
log = logging.getLogger(__name__)


def read_robot(folder: Path, name: str) -> Robot:
    """Return a robot, with every file checked but no picture decoded.

    Raises:
        DataError: whatever is missing or wrong.
    """
    if not (folder / CAMERA).is_file():
        others = [
            entry.name for entry in visible_entries(folder) if entry.suffix in {".yaml", ".yml"}
        ]
        found = f", found {', '.join(sorted(others))}" if others else ""
        raise DataError(f"{folder / CAMERA}: no such file{found}")
    camera = read_camera(folder / CAMERA)
    rows = _listed(folder)
    pictures = [folder / IMAGES / row.image for row in rows]
    _check_sizes(pictures, camera, folder / CAMERA)
    frames = tuple(
        _frame(FrameId(name, i), path, row, camera.mount)
        for i, (path, row) in enumerate(zip(pictures, rows, strict=True))
    )
    _check_view(camera, frames, folder)
    return Robot(name, camera, frames, _truth(folder / TRUTH, frames))


def _listed(folder: Path) -> tuple[FrameRow, ...]:
    """Return one row per picture: of `frames.csv`, or in natural order where there is none."""
    entries = [entry.name for entry in visible_entries(folder / IMAGES)]
    names = {name for name in entries if Path(name).suffix.casefold() in SUFFIXES}
    if not names:
        kinds = sorted({Path(name).suffix or name for name in entries})
        found = f", found {', '.join(kinds)}" if kinds else ", the folder is empty"
        raise DataError(f"{folder / IMAGES}: no pictures (jpg, png, tif){found}")
    if not (folder / FRAMES).exists():
        return tuple(FrameRow(name) for name in sorted(names, key=natural_order))
    rows = read_frames(folder / FRAMES)
    for row in rows:
        if row.image not in names:
            hint = nearest(row.image, names)
            raise DataError(f"{folder / FRAMES}: no picture {row.image!r} in {IMAGES}/{hint}")
    if len(rows) < len(names):
        omitted = len(names) - len(rows)
        log.warning(
            "%s: %d of %d pictures are not listed and stay out",
            folder / FRAMES,
            omitted,
            len(names),
        )
    return rows


def _check_sizes(pictures: Sequence[Path], camera: Camera, camera_path: Path) -> None:
    """Look into every picture's head; refuse mixed sizes, then a size that isn't the camera's."""
    sizes = [image_size(path) for path in pictures]
    counts = Counter(sizes).most_common()
    if len(counts) > 1:
        found = ", ".join(
            f"{count} of {w} x {h} ({pictures[sizes.index((w, h))].name})"
            for (w, h), count in counts
        )
        raise DataError(
            f"{pictures[0].parent}: pictures of one camera need one size, found {found}"
        )
    check_size(pictures[0], sizes[0], camera, camera_path.name)


def check_size(
    path: Path, size: tuple[int, int], camera: Camera, source: str = "its camera file"
) -> None:
    """Refuse a picture (width, height) that isn't of the camera's size (DataError)."""
    needed = (camera.intrinsics.width_px, camera.intrinsics.height_px)
    if size != needed:
        raise DataError(
            f"{path}: is {size[0]} x {size[1]} px, {source} is for {needed[0]} x {needed[1]}"
        )


def _frame(frame_id: FrameId, path: Path, row: FrameRow, mount: Mount) -> Frame:
    """Fill what the row leaves open from the mount."""
    nominal, wobble = mount.attitude, mount.sigma
    attitude = Attitude(
        _radians(row.tilt_deg, nominal.tilt_rad),
        _radians(row.roll_deg, nominal.roll_rad),
        nominal.height_m if row.height_m is None else row.height_m,
    )
    sigma = Attitude(
        _radians(row.tilt_sigma_deg, wobble.tilt_rad),
        _radians(row.roll_sigma_deg, wobble.roll_rad),
        wobble.height_m if row.height_sigma_m is None else row.height_sigma_m,
    )
    time_s = float(frame_id.index) if row.time_s is None else row.time_s
    return Frame(frame_id, path, time_s, attitude, sigma, _odometry(row))


def _radians(angle_deg: float | None, default_rad: float) -> float:
    return default_rad if angle_deg is None else math.radians(angle_deg)


def _odometry(row: FrameRow) -> Odometry | None:
    if row.odom_x_m is None or row.odom_y_m is None or row.odom_sigma_m is None:
        return None
    sigma_m, sigma_rad = row.odom_sigma_m, _radians(row.odom_sigma_deg, 0.0)
    pose = Se2(row.odom_x_m, row.odom_y_m, _radians(row.odom_theta_deg, 0.0))
    return Odometry(pose, Se2(sigma_m, sigma_m, sigma_rad))


def _check_view(camera: Camera, frames: Sequence[Frame], folder: Path) -> None:
    """Refuse a frame that isn't above the floor or sees the sky; the mount counts as well."""
    border = border_rays(camera)
    try:
        check_lens(camera)
        check_horizon(camera, camera.mount.attitude, border)
    except ValueError as error:
        raise DataError(f"{folder / CAMERA}: {error}") from error
    for frame in frames:
        if (frame.attitude, frame.sigma) == (camera.mount.attitude, camera.mount.sigma):
            continue
        try:
            Mount(frame.attitude, frame.sigma)
            check_horizon(camera, frame.attitude, border)
        except ValueError as error:
            raise DataError(f"{folder / FRAMES}: {frame.path.name}: {error}") from error


def _truth(path: Path, frames: Sequence[Frame]) -> dict[FrameId, Se2] | None:
    """Match true poses to frames by time, within `SAME_TIME_S`."""
    if not path.exists():
        return None
    poses = read_trajectory(path)
    times = [time_s for time_s, _ in poses]
    truth = {}
    for frame in frames:
        i = bisect_left(times, frame.time_s - SAME_TIME_S)
        near = poses[i : bisect_right(times, frame.time_s + SAME_TIME_S)]
        if near:
            truth[frame.id] = min(near, key=lambda pose: abs(pose[0] - frame.time_s))[1]
    if not truth:
        found = f"it covers {times[0]:.9g} to {times[-1]:.9g} s" if times else "it is empty"
        first, last = frames[0].time_s, frames[-1].time_s
        raise DataError(f"{path}: {found}, no time of a frame ({first:.9g} to {last:.9g} s)")
    return truth


def natural_order(name: str) -> tuple[list[tuple[int, int, str]], str]:
    """Return a key that sorts img2 before img10, and Img3 between them."""
    parts = re.findall(r"\d+|\D+", name.casefold())
    return [(0, int(p), "") if p.isdecimal() else (1, 0, p) for p in parts], name


def visible_entries(folder: Path) -> list[Path]:
    """Return a folder's content without hidden files (some systems add a `._x.jpg` to `x.jpg`)."""
    try:
        return [entry for entry in folder.iterdir() if not entry.name.startswith(".")]
    except OSError as error:
        raise DataError(f"{folder}: cannot read: {error.strerror}") from error
