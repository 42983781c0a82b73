"""Read a team folder."""

from collections.abc import Sequence
from pathlib import Path

from groundfuse.frontend.arrays import Image
from groundfuse.frontend.camera import Camera
from groundfuse.tools.robot import Frame, Odometry, Robot

__all__ = ["Frame", "Odometry", "Robot", "list_robots", "load_image", "read_team"]


def list_robots(folder: Path) -> tuple[str, ...]:
    """Return the names of the robots of a team folder, in natural order."""
    raise NotImplementedError(folder)


def read_team(folder: Path, robots: Sequence[str]) -> tuple[Robot, ...]:
    """Read and check the named robots of a team folder."""
    raise NotImplementedError(folder, robots)


def load_image(frame: Frame, camera: Camera) -> Image:
    """Load a picture as BGR uint8."""
    raise NotImplementedError(frame, camera)
