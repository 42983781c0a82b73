"""Measure the planar bundle on rendered teams, real photographs and growing simulated teams.

    bench_bundle.py --teams 5                 2 x 13 views: as filed, files wrong, sharpness
    bench_bundle.py --teams 0 --large 7       2 x 200 views, 79 m
    bench_bundle.py --teams 0 --grow 200 400 800 1600
    bench_bundle.py --teams 0 --nadir 10          2 x 3 views straight down, files too careful
    bench_bundle.py --teams 0 --real out/real/seneca out/real/planar_mosaic

Rendered and real teams go through the whole front-end and the Pose2 graph first. Errors are root
mean square positions of the cameras' feet after the best rigid alignment and, behind the slash, the
best similarity: scale comes from the camera heights alone, and the mean of n heights that wobble by
0.36 % is known to 0.36 % / sqrt(n) whatever the method. NEES likewise, as it is and at true scale.
Seeds from 900 on were not used while building.
"""

import argparse
import math
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np

from groundfuse.backend.bundle import bundle
from groundfuse.backend.bundle_estimate import BundleRefusal
from groundfuse.backend.measurement import Attitude
from groundfuse.tools import render_team
from groundfuse.tools.bench_bundle_teams import (
    FILES,
    Measured,
    averages,
    fused,
    measured,
    with_files,
    with_wobble,
)
from groundfuse.tools.bench_sharpness import sharpness
from groundfuse.tools.errors import TeamError
from groundfuse.tools.robot import Robot
from groundfuse.tools.simulate_sightings import SightingOptions, simulate
from groundfuse.tools.simulated_robot import SimulatedRobot, lawn_path
from groundfuse.tools.team_folder import list_robots, read_team
from groundfuse.tools.world import Scene

FILED_DEG, FILED_HEIGHT = 0.05, 0.0008
"""Wobble of tilt and roll, and of the height as a fraction, that files of still cameras state."""
HEAD = (
    f"{'team':<22}{'frames':>7}{'pairs':>7}{'Pose2 mm':>16}{'bundle mm':>16}{'% path':>9}"
    f"{'NEES':>13}{'px':>7}{'noise':>7}{'relief':>8}{'s':>7}"
)


def rendered(
    folder: Path, floor: str, seed: int, words: Sequence[str] = ()
) -> tuple[tuple[Robot, ...], Scene]:
    """Render a team of robots A and B and read it; with the truth."""
    command = ["--out", str(folder), "--floor", floor, "--seed", str(seed), *words]
    if render_team.main(command) != 0:
        raise SystemExit(2)
    scene = render_team.plan_scene(render_team.parser().parse_args(command))
    return read_team(folder, ("A", "B")), scene


def row(name: str, found: Measured) -> str:
    """Format one line of the table."""
    pose2, after = (f"{rigid * 1e3:.3f}/{similar * 1e3:.3f}" for rigid, similar in found.errors_m)
    nees = "/".join(f"{value:.2f}" for value in found.nees)
    return (
        f"{name:<22}{found.num_frames:7d}{found.num_pairs:7d}{pose2:>16}{after:>16}"
        f"{100.0 * found.errors_m[1][0] / found.path_m:9.4f}{nees:>13}"
        f"{found.residual_px:7.3f}{found.noise:7.2f}{found.relief:8.2f}{found.seconds:7.2f}"
    )


def bench_teams(floor: str, seeds: Sequence[int], num_workers: int) -> None:
    """Print rendered teams of 2 x 13 views, with right files and with wrong ones."""
    print(HEAD)
    every: dict[str, list[Measured]] = {}
    sharp: list[tuple[float, float, float]] = []
    for seed in seeds:
        with tempfile.TemporaryDirectory() as folder:
            robots, scene = rendered(Path(folder) / "team", floor, seed)
            for files, change in FILES.items():
                team, seconds = fused(with_files(robots, change), num_workers)
                found, bundled = measured(team, seconds)
                every.setdefault(files, []).append(found)
                print(row(f"{floor} {seed} {files}", found), flush=True)
                if files == "as filed":
                    sharp.append(sharpness(team, bundled, scene))
                    values = ", ".join(f"{value:.3f}" for value in sharp[-1])
                    print(f"  sharpness of the mosaic: Pose2, bundle, true poses: {values}")
    for files, some in every.items():
        print(row(f"mean of {len(some)} {files}", averages(some)))
    if sharp:
        values = ", ".join(f"{value:.3f}" for value in np.mean(sharp, axis=0))
        print(f"mean sharpness of the mosaic: Pose2, bundle, true poses: {values}")


def bench_nadir(seeds: Sequence[int], num_workers: int) -> None:
    """Print teams of 2 x 3 views straight down: few pictures, of cameras that do not wobble.

    Their files state a wobble all the same, as those of a camera on a rail might.
    """
    print(HEAD)
    still = ["--tilt-sigma", "0.001", "--roll-sigma", "0.001", "--height-sigma", "0.00001"]
    words = ["--robots", "A:0", "B:0", "--views", "3", "--way", "lawn", "--obstacles", "0", *still]
    for floor in ("terrazzo", "wood"):
        some = []
        for seed in seeds:
            with tempfile.TemporaryDirectory() as folder:
                robots, _ = rendered(Path(folder) / "team", floor, seed, words)
                filed = robots[0].camera.mount.attitude.height_m * FILED_HEIGHT
                wobble = Attitude(math.radians(FILED_DEG), math.radians(FILED_DEG), filed)
                some.append(measured(*fused(with_wobble(robots, wobble), num_workers))[0])
        worse = sum(found.errors_m[1][0] > found.errors_m[0][0] for found in some)
        print(row(f"mean of {len(some)} {floor}", averages(some)))
        print(f"  bundled worse than the Pose2 graph, rigid: {worse} of {len(some)}", flush=True)


def bench_large(floor: str, seeds: Sequence[int], num_workers: int) -> None:
    """Print rendered teams of 2 x 200 views over 79 m."""
    print(HEAD)
    for seed in seeds:
        with tempfile.TemporaryDirectory() as folder:
            words = ["--views", "200", "--step", "0.2"]
            robots, _ = rendered(Path(folder) / "team", floor, seed, words)
            found, bundled = measured(*fused(robots, num_workers))
        print(row(f"{floor} {seed} 2 x 200", found), flush=True)
        for finding in bundled.findings:
            print(f"  {finding.text}")


def bench_growth(sizes: Sequence[int]) -> None:
    """Print seconds against frames for simulated teams that mow a lawn, 36 frames per row."""
    print(
        f"{'frames':>7}{'pairs':>8}{'sightings':>11}{'mm':>8}{'wall s':>8}{'CPU s':>8}"
        f"{'ms/frame':>10}"
    )
    for size in sizes:
        path = lawn_path(-(-size // 36), 18, 0.2, 0.35)[: size // 2]
        robots = (
            SimulatedRobot("A", path),
            SimulatedRobot("B", path + np.array([0.1, 0.17, 0.0]), tilt_deg=45.0, height_m=0.6),
        )
        team = simulate(robots, np.random.default_rng(size), SightingOptions(min_common=90))
        begin, begin_cpu = time.perf_counter(), time.process_time()
        found = bundle(*team.arguments)
        wall, cpu = time.perf_counter() - begin, time.process_time() - begin_cpu
        if isinstance(found, BundleRefusal):
            print(f"{size:7d} refused: {found.text}")
            continue
        error = np.array(
            [
                (team.truth[frame].inverse() @ pose).vector()[:2]
                for frame, pose in found.team.team_from_base.items()
            ]
        )
        rms_mm = 1e3 * float(np.sqrt(np.mean(np.sum(error**2, axis=1))))
        print(
            f"{size:7d}{len(team.edges):8d}{found.num_observations:11d}{rms_mm:8.2f}{wall:8.2f}"
            f"{cpu:8.2f}{1e3 * cpu / size:10.2f}",
            flush=True,
        )


def bench_real(folders: Sequence[Path], num_workers: int) -> None:
    """Print real teams against their reference poses."""
    print(HEAD)
    for folder in folders:
        found, bundled = measured(*fused(read_team(folder, list_robots(folder)), num_workers))
        print(row(folder.name, found), flush=True)
        for finding in bundled.findings:
            print(f"  {finding.text}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables that are asked for; 2 after one line about what is wrong."""
    command = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    command.add_argument("--floor", default="terrazzo")
    command.add_argument("--teams", type=int, default=5, help="rendered teams of 2 x 13 views")
    command.add_argument("--first-seed", type=int, default=900)
    command.add_argument("--large", nargs="*", type=int, default=[], help="seeds of 2 x 200 views")
    command.add_argument("--nadir", type=int, default=0, help="teams of 2 x 3 views straight down")
    command.add_argument("--grow", nargs="*", type=int, default=[], help="simulated frames")
    command.add_argument("--real", nargs="*", type=Path, default=[], help="team folders")
    command.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    asked = command.parse_args(arguments)
    cv2.setNumThreads(1)
    try:
        if asked.teams:
            seeds = range(asked.first_seed, asked.first_seed + asked.teams)
            bench_teams(asked.floor, seeds, asked.workers)
        if asked.nadir:
            seeds = range(asked.first_seed, asked.first_seed + asked.nadir)
            bench_nadir(seeds, asked.workers)
        if asked.large:
            bench_large(asked.floor, asked.large, asked.workers)
        if asked.grow:
            bench_growth(asked.grow)
        if asked.real:
            bench_real(asked.real, asked.workers)
    except TeamError as error:
        print(f"bench_bundle.py: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
