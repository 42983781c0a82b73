"""Compare the main job with OpenCV's `Stitcher` in SCANS mode on the same rendered pictures.

    bench_stitcher.py --sizes 10 25 50 100 --seed 300

One robot drives over terrazzo; the first n pictures are given to both. The main job runs once
before the stitcher and once after it, and its times are the means of both: the speed of a machine
may change meanwhile. (The first of all also loads its compiled code.) The stitcher expects pictures
of something flat from straight above, so it gets the overhead views at each picture's filed
attitude, with their masks; making them is not counted. Both make a picture with cells of the same
size, that of the overhead views (with `--own-cell`, the main job makes the finer one that it makes
by itself). Positions of the camera's foot are compared with the truth after the best similarity
(the stitcher knows no scale), over the pictures that each of them kept. Run it on an otherwise idle
machine.
"""

import argparse
import contextlib
import csv
import io
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from groundfuse.backend.drift import accuracy
from groundfuse.backend.measurement import FrameId, Se2
from groundfuse.frontend.arrays import Image, Points
from groundfuse.frontend.overhead_view import overhead_grid, overhead_view
from groundfuse.tools import fuse_team, render_team
from groundfuse.tools.errors import TeamError
from groundfuse.tools.robot import Robot
from groundfuse.tools.team_folder import load_image, read_team

ROBOT = "A"


@dataclass(frozen=True, slots=True)
class Result:
    """What one program made of n pictures.

    Attributes:
        seconds: wall clock.
        cpu_s: of all threads, which other work on the machine hardly changes.
        kept: pictures that have a place.
        error_m: root mean square of the places; nan where fewer than three are kept.
    """

    seconds: float
    cpu_s: float
    kept: int
    error_m: float


def of_groundfuse(folder: Path, robot: Robot, cell_m: float | None) -> Result:
    """Run the main job, mosaic and all; with no cell asked for, with its own."""
    out = folder.with_name(f"{folder.name}_out")
    words = ["--team", str(folder), "--out", str(out), "--quiet", "--fresh"]
    words += [] if cell_m is None else ["--cell", str(cell_m)]
    begin, begin_cpu = time.perf_counter(), time.process_time()
    with contextlib.redirect_stdout(io.StringIO()):
        code = fuse_team.main(words)
    seconds, cpu_s = time.perf_counter() - begin, time.process_time() - begin_cpu
    if code != 0:
        raise TeamError(f"the main job ended with {code}")
    places: dict[FrameId, Points] = {}
    with (out / "poses.csv").open(newline="") as stream:
        for row in csv.DictReader(stream):
            if row["component"] == "0":
                base = Se2(
                    float(row["x_m"]), float(row["y_m"]), np.radians(float(row["theta_deg"]))
                )
                foot = base @ robot.camera.mount.base_from_foot
                places[FrameId(row["robot"], int(row["index"]))] = foot.vector()[:2]
    return Result(seconds, cpu_s, len(places), scaled_error_m(places, true_feet(robot)))


def mean_of(before: Result, after: Result) -> Result:
    """Return a result with the mean times of two runs, which find the same."""
    if (before.kept, before.error_m) != (after.kept, after.error_m):
        raise TeamError(f"two runs differ: {before} and {after}")
    seconds, cpu_s = (before.seconds + after.seconds) / 2.0, (before.cpu_s + after.cpu_s) / 2.0
    return replace(before, seconds=seconds, cpu_s=cpu_s)


def of_stitcher(robot: Robot) -> Result:
    """Stitch the overhead views; seconds are those of OpenCV alone."""
    views, masks, feet = overheads(robot)
    cv2.setNumThreads(os.cpu_count() or 1)  # the main job had set one for itself
    stitcher = cv2.Stitcher.create(cv2.Stitcher_SCANS)
    begin, begin_cpu = time.perf_counter(), time.process_time()
    status, _ = stitcher.stitch(views, masks)
    seconds, cpu_s = time.perf_counter() - begin, time.process_time() - begin_cpu
    if status != cv2.Stitcher_OK:
        return Result(seconds, cpu_s, 0, float("nan"))
    places: dict[FrameId, Points] = {}
    kept = [int(number) for number in np.ravel(stitcher.component())]
    for number, camera in zip(kept, stitcher.cameras(), strict=True):
        picture_from_pano = np.asarray(camera.R, dtype=np.float64)
        placed = np.linalg.solve(picture_from_pano, np.append(feet[number], 1.0))
        # Rows count downwards: turned over, so that a similarity can match the truth.
        places[robot.frames[number].id] = placed[:2] / placed[2] * np.array([1.0, -1.0])
    return Result(seconds, cpu_s, len(places), scaled_error_m(places, true_feet(robot)))


def overheads(robot: Robot) -> tuple[list[Image], list[Image], list[Points]]:
    """Overhead views, their masks (255 is floor), and the foot's place in each, pixels."""
    views, masks, feet = [], [], []
    for frame in robot.frames:
        grid = overhead_grid(robot.camera, frame.attitude)
        view, seen = overhead_view(
            load_image(frame, robot.camera), robot.camera, frame.attitude, grid
        )
        views.append(view)
        masks.append(np.where(seen, 255, 0).astype(np.uint8))
        feet.append(grid.overhead_from_floor(np.zeros((1, 2)))[0])
    return views, masks, feet


def true_feet(robot: Robot) -> dict[FrameId, Points]:
    """Return where every picture's camera truly was (2,), m."""
    foot = robot.camera.mount.base_from_foot
    return {frame: (pose @ foot).vector()[:2] for frame, pose in (robot.truth or {}).items()}


def scaled_error_m(places: dict[FrameId, Points], truth: dict[FrameId, Points]) -> float:
    """Root mean square distance (m) after the best similarity."""

    def poses(points: dict[FrameId, Points]) -> dict[FrameId, Se2]:
        return {frame: Se2(float(at[0]), float(at[1]), 0.0) for frame, at in points.items()}

    found = accuracy(poses(places), poses(truth)) if len(places) > 2 else None
    return float("nan") if found is None else found.ate_scaled_m


def first_pictures(team: Path, number: int, folder: Path) -> Path:
    """Copy a team's first pictures to a folder of their own."""
    source, target = team / ROBOT, folder / str(number) / ROBOT
    (target / "images").mkdir(parents=True)
    shutil.copy(source / "camera.yaml", target)
    lines = (source / "groundtruth.tum").read_text().splitlines(keepends=True)
    (target / "groundtruth.tum").write_text("".join(lines[: number + 1]))
    for path in sorted((source / "images").iterdir())[:number]:
        shutil.copy(path, target / "images")
    return target.parent


def compare(sizes: Sequence[int], seed: int, folder: Path, *, own_cell: bool) -> None:
    """Print one line for each number of pictures."""
    team, most = folder / "team", max(sizes)
    words = ["--out", str(team), "--robots", f"{ROBOT}:33", "--views", str(most)]
    if render_team.main([*words, "--seed", str(seed)]) != 0:
        raise TeamError("nothing rendered")
    print(f"{'':9}{'groundfuse':^36}{'OpenCV Stitcher, SCANS':^36}{'times':>14}")
    head = f"{'s':>8}{'CPU s':>8}{'kept':>8}{'error mm':>12}"
    print(f"{'pictures':>9}{head}{head}{'s':>7}{'CPU s':>7}", flush=True)
    for number in sizes:
        part = first_pictures(team, number, folder)
        (robot,) = read_team(part, [ROBOT])
        overhead = overhead_grid(robot.camera, robot.frames[0].attitude)
        cell_m = None if own_cell else overhead.m_per_px
        before, theirs = of_groundfuse(part, robot, cell_m), of_stitcher(robot)
        ours = mean_of(before, of_groundfuse(part, robot, cell_m))
        columns = [
            f"{r.seconds:8.1f}{r.cpu_s:8.1f}{r.kept:8d}{1e3 * r.error_m:12.2f}"
            for r in (ours, theirs)
        ]
        times = theirs.seconds / ours.seconds, theirs.cpu_s / ours.cpu_s
        print(f"{number:9d}{''.join(columns)}{times[0]:7.1f}{times[1]:7.1f}", flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; 2 after one line about what is wrong."""
    command = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    command.add_argument("--sizes", nargs="+", type=int, default=[10, 25, 50, 100])
    command.add_argument("--seed", type=int, default=300)
    command.add_argument("--own-cell", action="store_true", help="the main job's own, finer mosaic")
    asked = command.parse_args(arguments)
    try:
        with tempfile.TemporaryDirectory() as folder:
            compare(asked.sizes, asked.seed, Path(folder), own_cell=asked.own_cell)
    except TeamError as error:
        print(f"bench_stitcher.py: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
