"""Render a team folder with known truth: `render_team.py --out FOLDER --robots A:33 B:45`."""

import argparse
import math
import os
import re
import sys
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

# Small products only: threads inside numpy would get in each other's way.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from tqdm import tqdm

from groundfuse.backend.measurement import Attitude, Se2
from groundfuse.frontend.camera import Camera, Distortion, Intrinsics, Mount
from groundfuse.tools.checks import finite_number
from groundfuse.tools.errors import DataError, TeamError
from groundfuse.tools.floors import FLOORS
from groundfuse.tools.horizon import border_rays, check_horizon
from groundfuse.tools.lawn import plan_lawn
from groundfuse.tools.one_line_parser import INTERRUPTED, OneLineParser
from groundfuse.tools.overlap import View
from groundfuse.tools.photometry import Photometry
from groundfuse.tools.render_files import write_picture, write_truth
from groundfuse.tools.robot_folder import IMAGES
from groundfuse.tools.trajectories import count_places, meetings, plan_team
from groundfuse.tools.world import Scene, photographs, set_scene

WIDTH = 640
LENSES = (
    Intrinsics(WIDTH, 480, 525.0, 524.0, 321.5, 238.2, Distortion.PLUMB_BOB,
               (-0.105, 0.041, 0.0006, -0.0004, 0.0)),
    Intrinsics(WIDTH, 480, 548.0, 549.5, 316.8, 243.0, Distortion.EQUIDISTANT,
               (0.012, -0.004, 0.001, 0.0)),
    Intrinsics(WIDTH, 480, 500.0, 500.0, 319.5, 239.5, Distortion.PLUMB_BOB,
               (-0.21, 0.08, 0.0, 0.0, 0.0)),
    Intrinsics(WIDTH, 480, 580.0, 579.0, 324.1, 236.4),
)  # fmt: skip
"""Lenses dealt out to the robots in turn."""
LEAST_WIDTH = 80
WAYS = {"loop": plan_team, "lawn": plan_lawn}
PLACES = ((0.15, 0.0, 0.0), (0.22, -0.07, -4.0), (-0.1, 0.1, 7.0), (0.0, 0.0, 0.0))
"""Where the camera sits on its robot in turn: x and y in camera heights, yaw in degrees."""
SIGMA_PER_HEIGHT = 2e-3 / 0.55
ROLLS_DEG = (0.4, -0.6, 0.0, 0.2)
DEFAULTS = ("A:33", "B:45")
EPILOG = """\
examples:
  render_team.py --out team --seed 3
  render_team.py --out team --floor concrete --robots A:33 B:45 C:20 --views 26
  render_team.py --out field --floor grass --robots drone:0:70 --obstacles 0
  render_team.py --out fleet --way lawn --width 320 --robots A:33 B:45 C:33 D:45 --views 250
"""


def parser() -> argparse.ArgumentParser:
    """Return the command line."""
    command = OneLineParser(
        "render_team",
        "Photograph an invented floor with a team of robots; every truth is written.",
        EPILOG,
        says="render_team.py",
    )
    add = command.add_argument
    add("--out", type=Path, required=True, metavar="FOLDER", help="team folder to write")
    add("--floor", default="terrazzo", metavar="NAME", help=", ".join(FLOORS) + " (terrazzo)")
    add("--seed", type=int, default=1, metavar="N", help="all chance follows from it (1)")
    add(
        "--robots",
        nargs="+",
        default=list(DEFAULTS),
        metavar="NAME:TILT[:HEIGHT]",
        help="tilt from nadir in degrees, height in metres (A:33 B:45)",
    )
    add("--views", type=int, default=13, metavar="N", help="pictures of each robot (13)")
    add("--height", type=float, default=0.55, metavar="METRES", help="of cameras (0.55)")
    add("--way", choices=list(WAYS), default="loop", help="loops that meet, or rows (loop)")
    add("--width", type=int, default=WIDTH, metavar="PX", help="of the pictures (640)")
    add("--step", type=float, metavar="METRES", help="way between pictures (0.48 heights)")
    add("--obstacles", type=int, default=8, metavar="N", help="boxes and cylinders (8)")
    add("--tilt-sigma", type=float, default=0.5, metavar="DEG", help="wobble (0.5)")
    add("--roll-sigma", type=float, default=0.15, metavar="DEG", help="wobble (0.15)")
    add("--height-sigma", type=float, metavar="METRES", help="wobble (2 mm at 0.55 m)")
    add("--noise", type=float, default=1.5, metavar="GREY", help="of the sensor at mid-grey (1.5)")
    add("--quality", type=int, default=90, metavar="1-100", help="of the JPEG pictures (90)")
    cores = os.cpu_count() or 1
    add("--workers", type=int, default=cores, metavar="N", help="threads (all cores)")
    return command


def robot_camera(word: str, index: int, args: argparse.Namespace) -> tuple[str, Camera]:
    """Return name and camera of the `index`-th robot from `NAME:TILT[:HEIGHT]`.

    Raises:
        ValueError: not of this form, or a camera that can't be.
    """
    name, *numbers = word.split(":")
    if not re.fullmatch(r"[A-Za-z0-9_-]+", name) or len(numbers) not in (1, 2):
        raise ValueError(f"a robot is NAME:TILT or NAME:TILT:HEIGHT, like A:33, got {word!r}")
    tilt = finite_number(numbers[0], f"tilt of {name}")
    height = finite_number(numbers[1], f"height of {name}") if len(numbers) > 1 else args.height
    wobble = SIGMA_PER_HEIGHT * height if args.height_sigma is None else args.height_sigma
    roll, (x, y, yaw) = ROLLS_DEG[index % len(ROLLS_DEG)], PLACES[index % len(PLACES)]
    mount = Mount(
        Attitude(math.radians(tilt), math.radians(roll), height),
        Attitude(math.radians(args.tilt_sigma), math.radians(args.roll_sigma), wobble),
        Se2(round(x * height, 6), round(y * height, 6), math.radians(yaw)),
    )
    lens = resized(LENSES[index % len(LENSES)], args.width)
    camera = Camera(lens, mount, name=f"camera_{name}")
    border = border_rays(camera)
    farthest = replace(
        mount.attitude, tilt_rad=mount.attitude.tilt_rad + 4.0 * mount.sigma.tilt_rad
    )
    try:
        check_horizon(camera, farthest, border)
    except ValueError:
        raise ValueError(f"robot {name}: tilt {tilt:g} deg looks over the horizon") from None
    return name, camera


def resized(lens: Intrinsics, width_px: int) -> Intrinsics:
    """Return a lens for a sensor with another number of pixels: the same view, coarser or finer."""
    scale = width_px / lens.width_px
    return replace(
        lens,
        width_px=width_px,
        height_px=round(lens.height_px * scale),
        fx_px=lens.fx_px * scale,
        fy_px=lens.fy_px * scale,
        cx_px=(lens.cx_px + 0.5) * scale - 0.5,
        cy_px=(lens.cy_px + 0.5) * scale - 0.5,
    )


def plan_scene(args: argparse.Namespace) -> Scene:
    """Return the floor, the obstacles and every view that the command line asks for.

    Raises:
        ValueError: what can't be.
    """
    for name, least in (
        ("views", 1),
        ("obstacles", 0),
        ("quality", 1),
        ("seed", 0),
        ("width", LEAST_WIDTH),
        ("workers", 1),
    ):
        if getattr(args, name) < least:
            raise ValueError(f"--{name} must be at least {least}, got {getattr(args, name)}")
    if args.quality > 100:
        raise ValueError(f"--quality must be at most 100, got {args.quality}")
    if args.step is not None and not args.step > 0.0:
        raise ValueError(f"--step must be positive, got {args.step:g}")
    cameras = [robot_camera(word, k, args) for k, word in enumerate(args.robots)]
    for name, count in Counter(name for name, _ in cameras).items():
        if count > 1:
            raise ValueError(f"robot {name!r} is named {count} times")
    rng = np.random.default_rng([args.seed, 99])
    robots = WAYS[args.way](cameras, args.views, rng, args.step)
    grain = max(1.0, WIDTH / args.width)  # stones of the same number of pixels
    return set_scene(args.floor, args.seed, robots, args.obstacles, grain)


def render(args: argparse.Namespace) -> None:
    """Do the command's work.

    Raises:
        TeamError: what can't be rendered or written.
    """
    try:
        scene, photometry = plan_scene(args), Photometry(noise=args.noise)
    except ValueError as error:
        raise TeamError(str(error)) from error
    for robot in scene.robots:
        images = args.out / robot.name / IMAGES
        if images.exists():
            raise DataError(f"{images}: there already, choose a new folder or remove it")
    write_truth(args.out, scene)
    number = len(scene.by_frame())
    with closing(photographs(scene, photometry, args.workers)) as frames:
        for frame in tqdm(frames, total=number, unit="view", disable=None):
            write_picture(args.out, frame.id, frame.image, args.quality)
    print(f"{args.out}: {number} pictures of {args.floor}, seed {args.seed}")
    _print_meetings(scene)


def _print_meetings(scene: Scene) -> None:
    views: dict[str, Sequence[View]] = {
        robot.name: of_robot for robot, of_robot in zip(scene.robots, scene.views, strict=True)
    }
    names = list(views)
    for k, a in enumerate(names):
        for b in names[k + 1 :]:
            pairs = meetings(views[a], views[b])
            places = count_places(pairs, (len(views[a]), len(views[b])))
            print(f"{a} and {b}: {len(pairs)} pairs share 40 % or more; places: {places}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 when all went well, 2 after one line about what is wrong."""
    try:
        render(parser().parse_args(arguments))
    except TeamError as error:
        print(f"render_team.py: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("render_team.py: interrupted", file=sys.stderr)
        return INTERRUPTED
    return 0


if __name__ == "__main__":
    sys.exit(main())
