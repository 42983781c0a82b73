"""The public pose graphs, and what our solver and its certificate make of them from any start."""

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from groundfuse.backend import g2o, initial, planar, solver
from groundfuse.backend.certificate import certificate
from groundfuse.backend.problem import Array, Metric, Problem
from groundfuse.tools.simulate_grid import GridShape, simulate_grid

PUBLISHED = {  # file, metric: chi2 that several solvers agree on to the digits given
    ("manhattan.g2o", Metric.LOG): 3549.04107,
    ("CSAIL.g2o", Metric.LOG): 40.550884,
    ("intel.g2o", Metric.LOG): 45.004234,
    ("MIT.g2o", Metric.LOG): 41.206948,
    ("MIT.g2o", Metric.PLAIN): 41.163269,
    ("ring/originalDataset/ring.g2o", Metric.LOG): 11.163102,
    ("ringCity/originalDataset/ringCity.g2o", Metric.LOG): 262.817893,
}
T = TypeVar("T")
GRID = GridShape(poses=10_000, edges=20_000)


def read_problem(path: Path) -> tuple[Problem, Array | None]:
    """Read a graph's edges, and its vertices (n, 3) where it has any."""
    graph = g2o.parsed(path.read_text())
    keys = sorted({key for e in graph.edges for key in (e.a, e.b)})
    number = {key: k for k, key in enumerate(keys)}
    problem = Problem(
        len(keys),
        np.array([number[e.a] for e in graph.edges], dtype=np.int64),
        np.array([number[e.b] for e in graph.edges], dtype=np.int64),
        planar.stacked([e.a_from_b for e in graph.edges]),
        np.array([g2o.matrix(e.information) for e in graph.edges]),
    )
    if not graph.vertices:
        return problem, None
    return problem, planar.stacked([graph.vertices[key] for key in keys])


def starts(problem: Problem, filed: Array | None, seed: int = 0) -> dict[str, Array]:
    """Return the starts that the bar names, and one that is nothing but noise."""
    noise = np.random.default_rng(seed).uniform(-3.0, 3.0, (problem.num_poses, 3))
    odometry = initial.spanning_tree(problem)
    return {
        "file" if filed is not None else "file (none: odometry)": odometry
        if filed is None
        else filed,
        "odometry": odometry,
        "zero": np.zeros((problem.num_poses, 3)),
        "random": noise,
    }


def timed(work: Callable[[], T]) -> tuple[float, T]:
    """Return the seconds that it took and its result."""
    begin = time.perf_counter()
    result = work()
    return time.perf_counter() - begin, result


def optima(folder: Path) -> Iterator[str]:
    """Yield lines: the optimum from every start against the published one, certificate stated."""
    begin = "| graph | poses / edges | metric | published chi2 |"
    yield f"{begin} file | odometry | zero | random | certificate |"
    yield "| --- " * 9 + "|"
    for (name, metric), published in PUBLISHED.items():
        read, filed = read_problem(folder / name)
        problem = replace(read, metric=metric)
        yield _row(Path(name).stem, problem, filed, published)
    grid, _ = simulate_grid(GRID, np.random.default_rng(0))
    yield _row("simulated city", grid, None, None)


def _row(name: str, problem: Problem, filed: Array | None, published: float | None) -> str:
    ends = {key: solver.optimum(problem, s) for key, s in starts(problem, filed).items()}
    best = min(ends.values(), key=lambda end: end.chi2)
    against = published or best.chi2
    cells = [f"{end.chi2 / against - 1.0:+.0e}" for end in ends.values()]
    found = certificate(problem, best.poses)
    stated = f"{found.status}, bound {found.lower_bound:.6g}, d = {found.distance_m:.2g} m"
    size = f"{problem.num_poses} / {len(problem)}"
    number = f"{against:.8g}"
    return f"| {name} | {size} | {problem.metric} | {number} | {' | '.join(cells)} | {stated} |"
