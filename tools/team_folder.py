"""Read a team folder: one folder per robot, checked before any work begins.

    TEAM/<robot>/images/*.jpg|png|tif     pictures, in natural order (img2 before img10) or
    TEAM/<robot>/frames.csv               (optional) in the order of this list, with priors
    TEAM/<robot>/camera.yaml              ROS camera_info, and the mount
    TEAM/<robot>/groundtruth.tum          (optional) true poses of the base, for scoring only

Whatever is wrong ends as one `DataError` that names the file, what was found and what was needed.
"""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from groundfuse.frontend.arrays import Image
from groundfuse.frontend.camera import Camera
from groundfuse.tools.checks import nearest
from groundfuse.tools.errors import DataError
from groundfuse.tools.image_file import decoded_image, read_bytes
from groundfuse.tools.robot import Frame, Odometry, Robot
from groundfuse.tools.robot_folder import (
    IMAGES,
    check_size,
    natural_order,
    read_robot,
    visible_entries,
)

__all__ = ["Frame", "Odometry", "Robot", "image_of", "list_robots", "load_image", "read_team"]


def list_robots(folder: Path) -> tuple[str, ...]:
    """Return the names of a team folder's robots (folders with pictures), in natural order.

    Raises:
        DataError: there is no such folder.
    """
    if not folder.is_dir():
        found = "is a file" if folder.exists() else "no such folder"
        raise DataError(f"{folder}: {found}, needed a team folder")
    names = (entry.name for entry in visible_entries(folder) if (entry / IMAGES).is_dir())
    return tuple(sorted(names, key=natural_order))


def read_team(folder: Path, robots: Sequence[str]) -> tuple[Robot, ...]:
    """Return the named robots, with every file checked but no picture decoded.

    A slash after a name, as shells add it, doesn't matter.

    Raises:
        DataError: whatever is missing or wrong.
    """
    known = list_robots(folder)
    robots = [name.rstrip("/") or name for name in robots]
    if not robots:
        raise DataError(f"{folder}: no robot named, found {', '.join(known) or 'none'}")
    for name, count in Counter(robots).items():
        if count > 1:
            raise DataError(f"{folder}: robot {name!r} is named {count} times")
        if name not in known:
            raise DataError(f"{folder}: {_no_robot(folder, name, known)}")
    return tuple(read_robot(folder / name, name) for name in robots)


def load_image(frame: Frame, camera: Camera) -> Image:
    """Return a frame's picture as (rows, columns, 3) BGR uint8.

    Raises:
        DataError: unreadable, cut short, or not of the camera's size.
    """
    return image_of(read_bytes(frame.path), frame, camera)


def image_of(data: bytes, frame: Frame, camera: Camera) -> Image:
    """Return the picture of a frame from its file's bytes; see `load_image`."""
    picture = decoded_image(data, frame.path)
    rows, columns = picture.shape[:2]
    check_size(frame.path, (columns, rows), camera)
    return picture


def _no_robot(folder: Path, name: str, known: Sequence[str]) -> str:
    if (folder / IMAGES).is_dir():
        return f"this is a robot's folder, needed the folder above it ({folder.resolve().parent})"
    if name and (folder / name).is_dir():
        return f"robot {name!r} has no folder {IMAGES!r}"
    found = f"found {', '.join(known)}" if known else "found no folder that has images/"
    return f"no robot {name!r}{nearest(name, known)}, {found}"
