"""The map in 3D: a coloured PLY file of floor and trajectories, and a window to look at it.

    python -m groundfuse.tools.view3d OUT/team.ply

opens the window. The file needs nothing but numpy, and Open3D, CloudCompare and MeshLab open it;
only the window needs Open3D.
"""

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from groundfuse.backend.measurement import TeamEstimate
from groundfuse.frontend.mosaic import Mosaic
from groundfuse.tools.errors import DataError, TeamError
from groundfuse.tools.files import write_atomic
from groundfuse.tools.map_points import MOST_POINTS, map_points
from groundfuse.tools.open3d_import import import_open3d, need_display
from groundfuse.tools.ply_file import ply_bytes


def write_ply(
    path: Path,
    mosaic: Mosaic,
    estimate: TeamEstimate,
    component: int = 0,
    most_points: int = MOST_POINTS,
) -> None:
    """Write floor and trajectories of one component.

    Raises:
        DataError: the file can't be written.
    """
    found = map_points(mosaic, estimate, component, most_points)
    content = ply_bytes(found.points, found.colours, found.edges, found.edge_colours)
    write_atomic(path, content)


def view_ply(path: Path) -> None:
    """Show a file in a window until it is closed.

    In a process of its own: a graphics driver that fails can end a process without a word, and no
    result of the caller's shall go with it.

    Raises:
        TeamError: no screen, no Open3D, or the window failed.
    """
    need_display()
    import_open3d()
    command = [sys.executable, "-m", "groundfuse.tools.view3d", str(path)]
    done = subprocess.run(command, check=False)  # noqa: S603 - our own module
    if done.returncode != 0:
        raise TeamError(f"the 3D view ended with code {done.returncode}; {path} is there to open")


def open_window(path: Path) -> None:
    """Show a file with Open3D in this process.

    Raises:
        TeamError: no screen, no Open3D, or no window.
        DataError: the file holds no points.
    """
    need_display()
    open3d = import_open3d()
    cloud = open3d.io.read_point_cloud(str(path))
    if not cloud.has_points():
        raise DataError(f"{path}: no points to show")
    window = open3d.visualization.Visualizer()
    if not window.create_window(window_name=path.name):
        raise TeamError("the 3D view could not open a window")
    for shape in (cloud, open3d.io.read_line_set(str(path))):
        window.add_geometry(shape)
    window.run()
    window.destroy_window()


def main(arguments: Sequence[str] | None = None) -> int:
    """Show the file that is named on the command line; return the exit code."""
    names = list(sys.argv[1:] if arguments is None else arguments)
    if len(names) != 1 or names[0].startswith("-"):
        print("usage: python -m groundfuse.tools.view3d FILE.ply", file=sys.stderr)
        return 2
    try:
        open_window(Path(names[0]))
    except TeamError as error:
        print(f"view3d: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
