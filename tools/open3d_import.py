"""Open3D where it can be had; it is large and needs system libraries, so only on demand."""

import importlib
import os
import sys
import warnings
from typing import Any

from groundfuse.tools.errors import TeamError

LIBRARIES = "libegl1 libgl1 libx11-6 libusb-1.0-0"


def import_open3d() -> Any:  # noqa: ANN401 - it has no type stubs
    """Return the module `open3d`; takes over a second at first.

    Raises:
        TeamError: it isn't installed, or the system lacks a library that it needs.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # those of the packages that it brings
            return importlib.import_module("open3d")
    except ModuleNotFoundError as error:
        if error.name not in {"open3d", None}:
            raise TeamError(f"Open3D needs the package {error.name!r}, which is missing") from error
        raise TeamError("Open3D is not installed: pip install 'groundfuse[view]'") from error
    except (ImportError, OSError) as error:
        raise TeamError(
            f"Open3D cannot start ({error}); on Debian: apt-get install {LIBRARIES}"
        ) from error


def need_display() -> None:
    """Refuse to open a window where there is no screen.

    Raises:
        TeamError: neither DISPLAY nor WAYLAND_DISPLAY is set on Linux.
    """
    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        raise TeamError(
            "the 3D view needs a screen, but neither DISPLAY nor WAYLAND_DISPLAY is set"
        )
