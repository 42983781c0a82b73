"""The words of `fuse_team.py`."""

import argparse
import os
from pathlib import Path

from groundfuse.tools.front_end_options import Matcher
from groundfuse.tools.one_line_parser import OneLineParser

SAMPLE = Path(__file__).resolve().parent.parent / "data" / "team"
EPILOG = """\
examples:
  fuse_team.py --robots A B                    the sample team of the project
  fuse_team.py --team my_team --out my_map     all robots of a folder
  fuse_team.py --robots A --matcher paper      one robot, the paper's matcher
  fuse_team.py --robots A B --set front_end.motion.max_ambiguity=0.5

a team folder holds a folder per robot: images/, camera.yaml and, if you have
them, frames.csv (times, attitudes, odometry) and groundtruth.tum (for scoring).
"""


def parser() -> argparse.ArgumentParser:
    """Return the command line."""
    command = OneLineParser(
        "fuse_team",
        "Fuse the photographs of a team of ground robots into one metric floor map.",
        EPILOG,
    )
    add = command.add_argument
    add("--robots", nargs="+", metavar="NAME", help="robots to fuse (default: all in the folder)")
    add("--team", type=Path, default=SAMPLE, metavar="FOLDER", help="team folder (the sample)")
    add("--out", type=Path, default=Path("out"), metavar="FOLDER", help="results (out)")
    add(
        "--matcher",
        choices=[str(m.value) for m in Matcher],
        default="sift",
        help="sift: the default; fast: ORB and photometric stage; paper: the published method",
    )
    cores = os.cpu_count() or 1
    add("--workers", type=int, default=cores, metavar="N", help="threads (all cores)")
    add("--scheduler", metavar="ADDRESS", help="work on a Dask cluster: tcp://HOST:PORT")
    add("--store", type=Path, metavar="FILE", help="what was computed (store.sqlite in the out)")
    add("--fresh", action="store_true", help="start over: empty the store first")
    add("--no-bundle", action="store_true", help="stop at the Pose2 graph")
    add("--no-mosaic", action="store_true", help="leave out mosaic, location graph and 3D file")
    add("--cell", type=float, metavar="METRES", help="side of a mosaic cell (from the pictures)")
    add("--overhead", action="store_true", help="write every picture's overhead view too")
    add("--check", action="store_true", help="second opinion: optimise the graph with Open3D too")
    add("--view", action="store_true", help="show the map in an Open3D window at the end")
    add(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="any option, by its name in options.json",
    )
    add("--quiet", action="store_true", help="no progress bars")
    return command
