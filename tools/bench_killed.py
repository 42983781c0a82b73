"""Kill the main job at random moments, run it again, and compare every byte with a quiet run's.

    bench_killed.py --kills 20 --seed 100            first runs
    bench_killed.py --kills 20 --seed 100 --grown    a finished team with new pictures, and mosaics

The folders that it works in are temporary.
"""

import argparse
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from groundfuse.tools.robot_folder import IMAGES
from groundfuse.tools.store import STORE

COMMAND = Path(__file__).resolve().parent / "fuse_team.py"
SAMPLE = COMMAND.parents[1] / "data" / "team"
QUICK = (
    "front_end.features.per_square_height=150",
    "front_end.features.overhead.cell_per_height=0.006",
)
NEVER_EQUAL = {"report.txt", STORE, f"{STORE}.lock"}
"""Files that hold times."""


def start(out: Path, team: Path = SAMPLE, *, mosaic: bool = False) -> subprocess.Popen[bytes]:
    """Start the job on a team, coarser than usual, with or without its pictures."""
    words = [word for setting in QUICK for word in ("--set", setting)]
    words += [] if mosaic else ["--no-mosaic"]
    folders = ["--team", str(team), "--out", str(out)]
    command = [sys.executable, str(COMMAND), *folders, "--quiet", *words]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL)  # noqa: S603


def content(out: Path) -> dict[str, bytes]:
    """Return what a run left, by name."""
    return {p.name: p.read_bytes() for p in out.iterdir() if p.name not in NEVER_EQUAL}


def stored_bytes(out: Path) -> int:
    """Return how much the store has taken in."""
    files = (out / f"{STORE}{suffix}" for suffix in ("", "-wal"))
    return sum(path.stat().st_size for path in files if path.exists())


def killed_when(process: subprocess.Popen[bytes], due: Callable[[], bool]) -> bool:
    """Kill a run as soon as it is due; whether it was still running."""
    while process.poll() is None and not due():
        time.sleep(0.001)
    process.send_signal(signal.SIGKILL)
    return process.wait() == -signal.SIGKILL


def stored(out: Path, num_bytes: float) -> Callable[[], bool]:
    """Return what tells whether a store has taken in so much."""
    return lambda: stored_bytes(out) >= num_bytes


def late(end_s: float) -> Callable[[], bool]:
    """Return what tells whether it is so late, by `time.perf_counter`."""
    return lambda: time.perf_counter() >= end_s


def bench_new(num_kills: int, rng: random.Random, folder: Path) -> None:
    """Kill first runs; moments are drawn over what a quiet run stores."""
    start(folder / "quiet").wait()
    wanted, full = content(folder / "quiet"), stored_bytes(folder / "quiet")
    killed = same = 0
    for k in range(num_kills):
        out = folder / str(k)
        killed += killed_when(start(out), stored(out, full * rng.uniform(0.0, 0.98)))
        start(out).wait()
        same += content(out) == wanted
        print(f"{k + 1} kills, {killed} at work, {same} ended with the same bytes", flush=True)


def bench_grown(num_kills: int, rng: random.Random, folder: Path) -> None:
    """Kill runs of a finished team that got one picture more of each robot, with its mosaic."""
    team, before = folder / "team", folder / "before"
    shutil.copytree(SAMPLE, team)
    aside = {}
    for images in sorted(team.glob(f"*/{IMAGES}")):
        last = max(images.iterdir())
        aside[last] = last.rename(folder / f"{images.parent.name}_{last.name}")
    start(before, team, mosaic=True).wait()
    for last, kept in aside.items():
        kept.rename(last)
    shutil.copytree(before, folder / "quiet")
    begin_s = time.perf_counter()
    start(folder / "quiet", team, mosaic=True).wait()
    wanted, full_s = content(folder / "quiet"), time.perf_counter() - begin_s
    killed = same = 0
    for k in range(num_kills):
        out = folder / str(k)
        shutil.copytree(before, out)
        end_s = time.perf_counter() + full_s * rng.uniform(0.2, 1.0)  # before, it only loads code
        killed += killed_when(start(out, team, mosaic=True), late(end_s))
        start(out, team, mosaic=True).wait()
        same += content(out) == wanted
        print(f"{k + 1} kills, {killed} at work, {same} ended with the same bytes", flush=True)


def main() -> None:
    """Run the trials and print how they end."""
    command = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    command.add_argument("--kills", type=int, default=20, metavar="N", help="trials (20)")
    command.add_argument("--seed", type=int, default=100, metavar="N", help="of the moments (100)")
    command.add_argument("--grown", action="store_true", help="a finished team that has grown")
    asked = command.parse_args()
    rng = random.Random(asked.seed)  # noqa: S311
    with tempfile.TemporaryDirectory() as name:
        (bench_grown if asked.grown else bench_new)(asked.kills, rng, Path(name))


if __name__ == "__main__":
    main()
