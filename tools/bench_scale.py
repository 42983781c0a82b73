"""Measure how the main job grows: growing fleets, retrieval, speed per frame and pair, reruns.

    bench_scale.py --frames 250 500 1000 2000     seconds per stage of four robots that mow a field
    bench_scale.py --retrieval 200                two robots of different tilt mow the same field
    bench_scale.py --speed --workers-gain 100     ms per frame and pair; one thread against two
    bench_scale.py --rerun 400                    nothing changed; a picture, a robot added

Fleets are pictures of 320 x 240, rendered on the fly into a folder that is removed at the end, or
kept and used again with `--keep FOLDER`. Run it on an idle machine.
"""

import argparse
import math
import os
import statistics
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np

from groundfuse.tools.bench_scale_fleets import fleet, twice_mown
from groundfuse.tools.bench_scale_runs import Growth, grown, matching_s, recalls, reruns, speeds
from groundfuse.tools.errors import TeamError
from groundfuse.tools.front_end_options import Matcher
from groundfuse.tools.memory import keep_freed

STAGES = ("features", "retrieval", "pairs", "graphs", "patches", "bundle", "mosaic")
WARMING = 2
"""Pictures of each robot that are looked at before time is taken."""
TURNS = 5
"""Times that one thread and two do the same work."""


def exponent(frames: Sequence[int], seconds: Sequence[float]) -> float:
    """Return b of the least-squares fit seconds = a * frames ** b; nan for one size."""
    if len(set(frames)) < 2 or min(seconds) <= 0.0:
        return float("nan")
    slope = np.polyfit(np.log(frames), np.log(seconds), 1)[0]
    return float(slope)


def growth_table(rows: Sequence[Growth]) -> str:
    """Return the table of growing fleets, with exponents where there are several."""
    names = [*STAGES, "total"]
    head = "".join(f"{name:>10}" for name in names)
    lines = [f"{'frames':>8}{'tried':>8}{'used':>8}{'parts':>6}{head}{'GB':>7}{'ATE mm':>8}"]
    for row in rows:
        cells = "".join(f"{row.seconds.get(name, 0.0):10.2f}" for name in STAGES)
        counts = f"{row.num_frames:8d}{row.num_tried:8d}{row.num_accepted:8d}{row.num_parts:6d}"
        lines.append(f"{counts}{cells}{row.total_s:10.2f}{row.peak_gb:7.2f}{row.ate_mm:8.2f}")
    if len(rows) > 1:
        frames = [row.num_frames for row in rows]
        tried = exponent(frames, [float(row.num_tried) for row in rows])
        slopes = [exponent(frames, [row.seconds.get(name, 0.0) for row in rows]) for name in STAGES]
        slopes.append(exponent(frames, [row.total_s for row in rows]))
        cells = "".join(f"{slope:10.2f}" for slope in slopes)
        lines.append(f"{'exponent':>8}{tried:8.2f}{'':14}{cells}")
    return "\n".join(lines)


def bench_growth(sizes: Sequence[int], seed: int, num_workers: int, folder: Path) -> None:
    """Print seconds per stage for growing fleets."""
    rows = []
    for size in sizes:
        robots = fleet(folder, size, seed)
        rows.append(grown(robots, num_workers))
        print(growth_table(rows[-1:]), flush=True)
    if len(rows) > 1:
        print(growth_table(rows))


def bench_retrieval(views: int, floor: str, seed: int) -> None:
    """Print how often a frame's best guesses of the other robot show the same floor."""
    print(f"{'floor':<12}{'match':<7}{'views':>9}{'asked':>7}{'@1':>8}{'@5':>8}{'ms/frame':>10}")
    team = twice_mown(floor, seed, views)
    for kind in ("sift", "orb"):
        found = recalls(team, kind)
        print(
            f"{floor:<12}{kind:<7}{f'2 x {views}':>9}{found.num_asked:7d}{found.at_1:8.4f}"
            f"{found.at_5:8.4f}{found.ms_per_frame:10.2f}",
            flush=True,
        )


def bench_speed(floor: str, seed: int) -> None:
    """Print medians of one core's busy time on pictures of 640 x 480."""
    print(f"{'match':<7}{'frames':>8}{'ms/frame':>10}{'pairs':>8}{'ms/pair':>10}  (no photometric)")
    for matcher in (Matcher.SIFT, Matcher.FAST):
        frames, pairs = speeds(floor, seed, matcher)
        print(
            f"{matcher.value:<7}{len(frames):8d}{1e3 * float(np.median(frames)):10.1f}"
            f"{len(pairs):8d}{1e3 * float(np.median(pairs)):10.1f}",
            flush=True,
        )


def bench_gain(size: int, seed: int, folder: Path) -> None:
    """Print what a second thread is worth, with code loaded before.

    The machine's speed may change from one run to the next, so it is the median of the turns'
    ratios, not a ratio of medians.
    """
    robots = fleet(folder, size, seed)
    matching_s([replace(robot, frames=robot.frames[:WARMING]) for robot in robots], 1)
    turns = [[matching_s(robots, threads) for threads in (1, 2)] for _ in range(TURNS)]
    for stage in ("features", "pairs"):
        seconds = [[turn[k].get(stage, math.nan) for k in (0, 1)] for turn in turns]
        one, two = (statistics.median(column) for column in zip(*seconds, strict=True))
        gains = sorted(alone / both for alone, both in seconds)
        print(
            f"{size} frames, {stage}: {one:.1f} s with 1 thread, {two:.1f} s with 2:"
            f" {statistics.median(gains):.2f} times as fast ({gains[0]:.2f} to {gains[-1]:.2f})",
            flush=True,
        )


def bench_reruns(size: int, seed: int, num_workers: int, folder: Path) -> None:
    """Print seconds of a run, the same run again, with one picture more, with one robot more."""
    fleet(folder, size, seed)
    for name, seconds in reruns(folder, size, seed, num_workers).items():
        print(f"{size} frames, {name}: {seconds:.1f} s", flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables that are asked for; 2 after one line about what is wrong."""
    command = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    command.add_argument("--frames", nargs="*", type=int, default=[], help="sizes of fleets")
    command.add_argument("--retrieval", nargs="*", type=int, default=[], help="views per robot")
    command.add_argument("--floors", nargs="+", default=["terrazzo"], help="of --retrieval")
    command.add_argument("--speed", action="store_true", help="ms per frame and pair")
    command.add_argument("--workers-gain", type=int, metavar="FRAMES", help="one thread or two")
    command.add_argument(
        "--rerun", type=int, metavar="FRAMES", help="again, one more picture, one more robot"
    )
    command.add_argument("--seed", type=int, default=1)
    command.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    command.add_argument("--keep", type=Path, help="folder of rendered fleets")
    asked = command.parse_args(arguments)
    cv2.setNumThreads(1)
    keep_freed()  # as the command does
    try:
        with tempfile.TemporaryDirectory() as temporary:
            folder = asked.keep or Path(temporary)
            for views in asked.retrieval:
                for floor in asked.floors:
                    bench_retrieval(views, floor, asked.seed)
            if asked.speed:
                bench_speed("terrazzo", asked.seed)
            if asked.workers_gain:
                bench_gain(asked.workers_gain, asked.seed, folder)
            if asked.rerun:
                bench_reruns(asked.rerun, asked.seed, asked.workers, folder)
            if asked.frames:
                bench_growth(asked.frames, asked.seed, asked.workers, folder)
    except TeamError as error:
        print(f"bench_scale.py: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
