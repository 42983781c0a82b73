"""Measure the back-end: optima, certificates, time beside other solvers, wrong overlaps, teams.

    bench_backend.py                           everything, some ten minutes
    bench_backend.py --only optima peers       some parts
    bench_backend.py --seeds 5                 fewer seeds
    bench_backend.py --graphs FOLDER           public graphs (manhattan.g2o, CSAIL.g2o, ...)

Times are wall-clock; run it on an idle machine. g2opy and open3d are used where installed. Options
were chosen with seeds from 100 on, and the tables are of seeds from 0 on.
"""

import argparse
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

from groundfuse.tools import bench_backend_graphs, bench_backend_teams, bench_backend_times

Part = Callable[[argparse.Namespace], Iterator[str]]

PARTS: dict[str, Part] = {
    "optima": lambda args: bench_backend_graphs.optima(args.graphs),
    "peers": lambda args: bench_backend_times.peers(args.graphs, slow=not args.quick),
    "growth": lambda _: bench_backend_times.growth(),
    "random": lambda args: bench_backend_teams.random_overlaps(args.seeds),
    "consistent": lambda args: bench_backend_teams.consistent_overlaps(args.seeds),
    "two": lambda args: bench_backend_teams.two_robots(args.seeds),
    "csail": lambda args: bench_backend_teams.csail(args.graphs),
    "team": lambda _: bench_backend_teams.large_team(),
    "covariance": lambda _: bench_backend_teams.covariances(),
}


def parser() -> argparse.ArgumentParser:
    """Return the command line."""
    described = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    described.add_argument("--only", nargs="+", choices=sorted(PARTS), default=list(PARTS))
    described.add_argument("--graphs", type=Path, default=Path("../shared/real/graphs"))
    described.add_argument("--seeds", type=int, default=20, help="teams per row")
    described.add_argument("--quick", action="store_true", help="leave the slowest peers out")
    return described


def main(words: Sequence[str] | None = None) -> int:
    """Print the tables that are asked for."""
    args = parser().parse_args(words)
    for name in args.only:
        print(f"\n## {name}\n")
        for line in PARTS[name](args):
            print(line, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
