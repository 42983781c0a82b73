"""Measure the front-end on floors with known truth: pairs, chains and fused teams.

`bench_frontend.py --floors terrazzo concrete tiles --seeds 1 2 3` prints a table of pairs for every
floor and matcher, and one of teams of 2 x 13 views. The options were chosen with seeds 100 and up.
"""

import argparse
import itertools
import math
import os
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np

from groundfuse.backend.measurement import Attitude, RelativePose, Se2
from groundfuse.frontend.camera import Camera, Intrinsics, Mount
from groundfuse.frontend.repetition import REPEATS
from groundfuse.tools import render_team
from groundfuse.tools.drift_table import drift_record
from groundfuse.tools.frame_look import Looked
from groundfuse.tools.front_end_options import FrontEndOptions, Matcher, with_matcher
from groundfuse.tools.pair_verdict import Spot, compare, look
from groundfuse.tools.pipeline import PipelineOptions, Stopwatch, fuse_robots
from groundfuse.tools.robot import Frame, Robot
from groundfuse.tools.team_folder import read_team
from groundfuse.tools.workers import silent
from groundfuse.tools.world import RenderedFrame, RenderedTeam, RobotSpec, make_team

RIGHT_M, RIGHT_RAD = 0.030, math.radians(3.0)
HEIGHT_M = 0.55
TILTS_DEG = {"A": 33.0, "B": 45.0}
VIEWS_PER_ROBOT = 6
SPREAD_M = 0.35
OVERLAPS = (0.45, 0.3)


@dataclass(frozen=True, slots=True)
class Scored:
    """One tried pair against the truth; errors are nan where it was rejected."""

    overlap: float
    accepted: bool
    error_m: float
    error_rad: float
    nees: float

    @property
    def right(self) -> bool:
        """Whether the accepted motion is the true one."""
        return self.accepted and self.error_m < RIGHT_M and self.error_rad < RIGHT_RAD


def camera(tilt_deg: float) -> Camera:
    """Return the bench's camera: 640 x 480, 525 px, wobble as on a small robot."""
    nominal = Attitude(math.radians(tilt_deg), 0.0, HEIGHT_M)
    wobble = Attitude(math.radians(0.5), math.radians(0.15), 0.002)
    return Camera(Intrinsics(640, 480, 525.0, 525.0, 319.5, 239.5), Mount(nominal, wobble))


def clustered_team(floor: str, seed: int) -> RenderedTeam:
    """Render views that look at one spot: half of them along one heading, half anyhow."""
    rng = np.random.default_rng([seed, 1])
    along_rad = rng.uniform(-math.pi, math.pi)
    robots = []
    for name, tilt_deg in TILTS_DEG.items():
        poses = []
        for k in range(VIEWS_PER_ROBOT):
            heading = float(
                rng.uniform(-math.pi, math.pi) if k % 2 else along_rad + 0.1 * rng.standard_normal()
            )
            spot = rng.uniform(-SPREAD_M, SPREAD_M, 2)
            ahead_m = HEIGHT_M * math.tan(math.radians(tilt_deg))
            x_m = float(spot[0]) - ahead_m * math.cos(heading)
            y_m = float(spot[1]) - ahead_m * math.sin(heading)
            poses.append(Se2(x_m, y_m, heading))
        robots.append(RobotSpec(name, camera(tilt_deg), tuple(poses)))
    return make_team(floor, seed, robots, num_obstacles=3)


def _seen(
    team: RenderedTeam, options: FrontEndOptions
) -> Iterator[tuple[RenderedFrame, tuple[Spot, Looked]]]:
    for robot in team.robots:
        known = Robot(robot.name, robot.camera, ())
        mount = robot.camera.mount
        for frame in robot.frames:
            blank = Frame(frame.id, Path(), 0.0, mount.attitude, mount.sigma)
            yield frame, look(frame.image, known, blank, options)


def _score(team: RenderedTeam, a: RenderedFrame, b: RenderedFrame, found: object) -> Scored:
    overlap = team.true_overlap(a.id, b.id)
    if not isinstance(found, RelativePose):
        return Scored(overlap, accepted=False, error_m=math.nan, error_rad=math.nan, nees=math.nan)
    error = (found.a_from_b.inverse() @ team.true_motion(a.id, b.id)).vector()
    nees = float(error @ np.linalg.solve(found.covariance, error))
    length = float(np.hypot(*error[:2]))
    return Scored(overlap, accepted=True, error_m=length, error_rad=abs(float(error[2])), nees=nees)


def bench_pairs(floor: str, seeds: Sequence[int], options: FrontEndOptions) -> list[str]:
    """Try every pair of every seed's cluster; return the table's lines."""
    scored: list[Scored] = []
    look_s, compare_s, repeating = [], [], []
    for seed in seeds:
        team = clustered_team(floor, seed)
        begin = time.perf_counter()
        views = list(_seen(team, options))
        look_s.append((time.perf_counter() - begin) / len(views))
        repeating += [seen.features.repetition > REPEATS for _, (_, seen) in views]
        for (frame_a, a), (frame_b, b) in itertools.combinations(views, 2):
            begin = time.perf_counter()
            found = compare(a, b, options)
            compare_s.append(time.perf_counter() - begin)
            scored.append(_score(team, frame_a, frame_b, found))
    lines = []
    for least in OVERLAPS:
        some = [s for s in scored if s.overlap >= least]
        right = [s for s in some if s.right]
        cells = [f"{len(some):5d}{100.0 * len(right) / max(1, len(some)):8.1f}"]
        if right:
            turn_deg = math.degrees(median(s.error_rad for s in right))
            cells.append(f"{median(s.error_m for s in right) * 1e3:8.2f}{turn_deg:8.3f}")
            cells.append(f"{sum(s.nees for s in right) / len(right):7.2f}")
        else:
            cells.append(f"{'-':>8}{'-':>8}{'-':>7}")
        lines.append(f"{floor:<13}{options.matcher.value:<7}{least:5.2f}" + "".join(cells))
    accepted = [s for s in scored if s.accepted]
    wrong = sum(not s.right for s in accepted)
    lines[0] += f"{wrong:6d} of {len(accepted):<5d}"
    lines[0] += f"{100.0 * sum(repeating) / len(repeating):6.0f}"
    lines[0] += f"{median(look_s) * 1e3:8.0f}{median(compare_s) * 1e3:8.0f}"
    return lines


def bench_team(floor: str, seed: int, options: FrontEndOptions, num_workers: int) -> str:
    """Render and fuse 2 x 13 views; return the table's line."""
    with tempfile.TemporaryDirectory() as folder:
        words = ["--out", folder, "--floor", floor, "--seed", str(seed)]
        if render_team.main(words) != 0:
            raise SystemExit(2)
        robots = read_team(Path(folder), ("A", "B"))
        watch = Stopwatch()
        fused = fuse_robots(robots, PipelineOptions(front_end=options), num_workers, silent, watch)
    record = drift_record(fused)
    cells = []
    for name in ("A", "B"):
        row = record["robots"][name]["chained"]
        score = row["against_truth"]
        closing = row["closing"]
        cells.append(f"{score['ate_percent']:8.4f}")
        cells.append(f"{closing['percent']:8.4f}" if closing else f"{'-':>8}")
    for stage in ("optimised", "bundled"):
        row = record["team"].get(stage)
        cells.append(f"{row['against_truth']['ate_percent']:11.4f}" if row else f"{'-':>11}")
    seconds = sum(watch.seconds.values())
    return f"{floor:<13}{options.matcher.value:<7}{seed:5d}" + "".join(cells) + f"{seconds:9.1f}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables."""
    command = argparse.ArgumentParser(description=__doc__)
    command.add_argument("--floors", nargs="+", default=["terrazzo", "concrete", "tiles"])
    command.add_argument(
        "--matchers", nargs="+", default=["sift"], choices=[str(m) for m in Matcher]
    )
    command.add_argument("--seeds", nargs="+", type=int, default=[1, 2, 3])
    command.add_argument("--teams", nargs="*", default=["terrazzo"], help="floors of fused teams")
    command.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    asked = command.parse_args(arguments)
    cv2.setNumThreads(1)
    base = FrontEndOptions()
    chosen = [with_matcher(base, Matcher(name)) for name in asked.matchers]
    print(f"pairs: {2 * VIEWS_PER_ROBOT} views per seed, seeds {asked.seeds}")
    print(
        f"{'floor':<13}{'match':<7}{'least':>5}{'n':>5}{'right %':>8}{'mm':>8}{'deg':>8}{'NEES':>7}"
        f"{'wrong':>6} {'accepted':<8}{'rep %':>6}{'ms/view':>8}{'ms/pair':>8}"
    )
    for floor, options in itertools.product(asked.floors, chosen):
        print("\n".join(bench_pairs(floor, asked.seeds, options)), flush=True)
    print("teams of 2 x 13 views: ATE and closing error chained, ATE of the team, % of the path")
    print(
        f"{'floor':<13}{'match':<7}{'seed':>5}{'A ATE':>8}{'closing':>8}{'B ATE':>8}{'closing':>8}"
        f"{'optimised':>11}{'bundled':>11}{'seconds':>9}"
    )
    for floor, options, seed in itertools.product(asked.teams, chosen, asked.seeds):
        print(bench_team(floor, seed, options, asked.workers), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
