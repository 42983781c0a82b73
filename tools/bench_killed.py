"""Kill the main job at random moments, run it again, and compare every byte with a quiet run's.

    bench_killed.py --kills 20 --seed 100

Moments are drawn over what a quiet run stores, so that they fall on the work and not on the start.
"""

import argparse
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from groundfuse.tools.store import STORE

COMMAND = Path(__file__).resolve().parent / "fuse_team.py"
QUICK = (
    "front_end.features.per_square_height=150",
    "front_end.features.overhead.cell_per_height=0.006",
)
NEVER_EQUAL = {"report.txt", STORE, f"{STORE}.lock"}
"""Files that hold times."""


def start(out: Path) -> subprocess.Popen[bytes]:
    """Start the job on the sample team, coarser than usual, without its pictures."""
    words = [word for setting in QUICK for word in ("--set", setting)]
    command = [sys.executable, str(COMMAND), "--out", str(out), "--quiet", "--no-mosaic", *words]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL)  # noqa: S603


def content(out: Path) -> dict[str, bytes]:
    """Return what a run left, by name."""
    return {p.name: p.read_bytes() for p in out.iterdir() if p.name not in NEVER_EQUAL}


def stored_bytes(out: Path) -> int:
    """Return how much the store has taken in."""
    files = (out / f"{STORE}{suffix}" for suffix in ("", "-wal"))
    return sum(path.stat().st_size for path in files if path.exists())


def kill_at(out: Path, num_bytes: float) -> bool:
    """Kill a run as soon as it has stored so much; whether it was still running."""
    process = start(out)
    while process.poll() is None and stored_bytes(out) < num_bytes:
        time.sleep(0.001)
    process.send_signal(signal.SIGKILL)
    return process.wait() == -signal.SIGKILL


def main() -> None:
    """Run the trials and print how they end."""
    command = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    command.add_argument("--kills", type=int, default=20, metavar="N", help="trials (20)")
    command.add_argument("--seed", type=int, default=100, metavar="N", help="of the moments (100)")
    asked = command.parse_args()
    rng = random.Random(asked.seed)  # noqa: S311
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        start(folder / "quiet").wait()
        wanted, full = content(folder / "quiet"), stored_bytes(folder / "quiet")
        killed = same = 0
        for k in range(asked.kills):
            out = folder / str(k)
            killed += kill_at(out, full * rng.uniform(0.0, 0.98))
            start(out).wait()
            same += content(out) == wanted
            print(f"{k + 1} kills, {killed} at work, {same} ended with the same bytes", flush=True)


if __name__ == "__main__":
    main()
