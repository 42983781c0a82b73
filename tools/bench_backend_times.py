"""How long the solver takes beside others, and how it grows."""

import resource
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from groundfuse.backend import initial, solver
from groundfuse.backend.certificate import certificate
from groundfuse.backend.problem import Metric, Problem
from groundfuse.tools.bench_backend_graphs import GRID, read_problem, timed
from groundfuse.tools.bench_backend_peers import (
    Peer,
    g2o_gauss_newton,
    gtsam_gauss_newton,
    gtsam_levenberg,
    open3d_global,
    peer,
    scipy_least_squares,
)
from groundfuse.tools.errors import TeamError
from groundfuse.tools.simulate_grid import GridShape, simulate_grid

OURS = "**groundfuse**, with its start"
REPEATS = 7
GROWTH = ((10_000, 15_000), (30_000, 45_000), (100_000, 150_000))
MOST_FOR_OPEN3D = 500  # poses; its dense system takes gigabytes and minutes beyond


def peers(folder: Path, *, slow: bool) -> Iterator[str]:
    """Yield lines: whole solve beside gtsam and others from the same start, in the same run."""
    begin = "| graph | solver | start | build s | solve s | n"
    yield f"{begin} | to gtsam's GN | chi2 | in g2o's metric |"
    yield "| --- " * 9 + "|"
    grid, _ = simulate_grid(GRID, np.random.default_rng(0))
    ring, _ = read_problem(folder / "ring/originalDataset/ring.g2o")
    manhattan, _ = read_problem(folder / "manhattan.g2o")
    for name, problem in (("M3500", manhattan), ("10k / 20k grid", grid), ("ring", ring)):
        yield from _beside(name, problem, slow=slow)


def _beside(name: str, problem: Problem, *, slow: bool) -> Iterator[str]:
    layout = initial.layout_of(problem)
    chordal = initial.chordal(problem, layout).poses
    odometry = initial.spanning_tree(problem)
    plain = replace(problem, metric=Metric.PLAIN)
    ours: list[Peer] = []
    in_plain: list[Peer] = []
    theirs: list[Peer] = []
    for _ in range(REPEATS):  # in turns, so that a busy moment meets both
        seconds, end = timed(lambda: solver.optimum(problem))
        ours.append(peer(OURS, 0.0, seconds, problem, end.poses))
        seconds, end = timed(lambda: solver.optimum(plain))
        in_plain.append(peer(f"{OURS} in g2o's metric", 0.0, seconds, problem, end.poses))
        theirs.append(gtsam_gauss_newton(problem, chordal))
    found = [("none", ours), ("none", in_plain), ("our chordal", theirs)]
    others = [
        ("our chordal", chordal, g2o_gauss_newton),
        ("odometry", odometry, g2o_gauss_newton),
        ("odometry", odometry, gtsam_gauss_newton),
        ("our chordal", chordal, gtsam_levenberg),
        ("odometry", odometry, gtsam_levenberg),
    ]
    if slow:
        others.append(("our chordal", chordal, scipy_least_squares))
        if problem.num_poses <= MOST_FOR_OPEN3D:
            others.append(("our chordal", chordal, open3d_global))
    for start, poses, solve in others:
        try:
            found.append((start, [solve(problem, poses)]))
        except (ImportError, TeamError) as error:
            yield f"| {name} | {solve.__name__}: {error} |"
    base = float(np.median([p.solve_s for p in theirs]))
    for start, runs in found:
        yield _line(name, start, runs, base)


def _line(name: str, start: str, runs: list[Peer], base: float) -> str:
    build_s = float(np.median([p.build_s for p in runs]))
    solve_s = float(np.median([p.solve_s for p in runs]))
    cells = f"{start} | {build_s:.3f} | {solve_s:.3f} | {len(runs)} | {solve_s / base:.2f}"
    costs = f"{runs[-1].chi2:.5f} | {runs[-1].chi2_plain:.5f}"
    return f"| {name} | {runs[-1].name} | {cells} | {costs} |"


def growth(sizes: tuple[tuple[int, int], ...] = GROWTH) -> Iterator[str]:
    """Yield lines: solve, certificate and the process's largest memory as graphs grow."""
    yield "| poses / edges | solve s | certificate s | peak memory GB | chi2 per dof | status |"
    yield "| --- | --- | --- | --- | --- | --- |"
    for poses, edges in sizes:
        problem, _ = simulate_grid(GridShape(poses=poses, edges=edges), np.random.default_rng(0))
        begin = time.perf_counter()
        end = solver.optimum(problem)
        solved = time.perf_counter()
        found = certificate(problem, end.poses)
        proven = time.perf_counter()
        peak_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        ratio = end.chi2 / (3 * (edges - poses + 1))
        cells = f"{solved - begin:.2f} | {proven - solved:.2f} | {peak_gb:.2f} | {ratio:.4f}"
        yield f"| {poses} / {edges} | {cells} | {found.status} |"
