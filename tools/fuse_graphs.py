"""Fuse pose graphs of a team: `fuse_graphs.py robot1.g2o robot2.g2o --overlaps overlaps.g2o`."""

import argparse
import logging
import os
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # sparse solvers work on small dense blocks
os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from groundfuse.backend.graph_keys import KeyScheme, parsed_scheme
from groundfuse.backend.measurement import FrameId, Se2, TeamEstimate
from groundfuse.backend.relative_covariance import relative_covariances
from groundfuse.backend.renamed import fuse_counted
from groundfuse.backend.team_graph import TeamGraph, poses_of
from groundfuse.backend.team_score import Score, score
from groundfuse.backend.team_solution import Solution, solutions
from groundfuse.tools.errors import DataError, TeamError
from groundfuse.tools.files import make_folder, write_atomic
from groundfuse.tools.graph_files import read_source, read_team_graph
from groundfuse.tools.graph_outputs import (
    Format,
    Relative,
    output_keys,
    write_components,
    write_relative,
    write_tables,
)
from groundfuse.tools.graph_report import GraphRun, report
from groundfuse.tools.one_line_parser import INTERRUPTED, OneLineParser
from groundfuse.tools.outputs import files_before
from groundfuse.tools.pipeline import Stopwatch

log = logging.getLogger(__name__)
EPILOG = """\
examples:
  fuse_graphs.py robot1.g2o robot2.g2o --overlaps overlaps.g2o
  fuse_graphs.py team.g2o --keys offset=10000 --out fused
  fuse_graphs.py team.jrl --format g2o
  fuse_graphs.py A.g2o B.g2o --overlaps overlaps.g2o --relative A12 B7 --truth truth.g2o

ids: auto takes 64-bit ids with a letter on top (gtsam, A12 in text) for that
robot's and plain ones for those of the file's robot, which is named as the file.
Beside X.g2o, a file X.ids.json may say which robot and frame every id is.
"""


def parser() -> argparse.ArgumentParser:
    """Return the command line."""
    command = OneLineParser(
        "fuse_graphs",
        "Fuse the pose graphs (g2o, TORO, JRL) of a team of robots into one.",
        EPILOG,
    )
    add = command.add_argument
    add("graphs", nargs="+", type=Path, metavar="FILE", help="one per robot, or one of all")
    add("--overlaps", nargs="+", type=Path, default=[], metavar="FILE", help="edges between them")
    add("--keys", default="auto", metavar="SCHEME", help="auto, gtsam, plain or offset=N (auto)")
    add("--out", type=Path, default=Path("out"), metavar="FOLDER", help="results (out)")
    forms = [form.value for form in Format]
    add("--format", choices=forms, default="g2o", help="of the fused graphs (g2o)")
    add(
        "--relative",
        nargs=2,
        action="append",
        default=[],
        metavar=("A12", "B7"),
        help="tell the pose of the second frame in the first with its covariance",
    )
    add("--truth", type=Path, metavar="FILE", help="true poses, with ids as in the graphs")
    return command


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 where a map was made, 2 where the input does not allow one."""
    asked = parser().parse_args(arguments)
    logging.basicConfig(format="%(levelname)s: %(message)s", level=logging.INFO)
    try:
        run(asked)
    except TeamError as error:
        print(f"fuse_graphs: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("fuse_graphs: interrupted", file=sys.stderr)
        return INTERRUPTED
    return 0


def run(asked: argparse.Namespace) -> GraphRun:
    """Do what the command line asks for."""
    form, scheme = Format(asked.format), _scheme(asked.keys)
    watch, begin_s = Stopwatch(), time.time()
    with watch.stage("reading"):
        team = read_team_graph(asked.graphs, asked.overlaps, scheme)
        output_keys(team, form)
        names = [_pair(team, a, b) for a, b in asked.relative]
        truth = _truth(asked.truth, team)
        out = make_folder(asked.out)
    with watch.stage("fusing"), _solvable():
        estimate = fused(team)
        parts = solutions(team.edges, estimate)
    with watch.stage("certifying"), _solvable():
        proofs = {p.component: p.certificate() for p in parts if len(p.frames) > 1}
    with watch.stage("covariances"), _solvable():
        relative = tuple(_relative(parts, estimate, a, b) for a, b in names)
    found = GraphRun(team, estimate, parts, proofs, relative, _score(team, estimate, truth))
    with watch.stage("writing"):
        write_tables(out, team, estimate)
        write_relative(out, relative)
        write_components(out, team, estimate, parts, form)
    table = report(found, watch.seconds)
    write_atomic(out / "report.txt", table)
    print(table, end="")
    print(f"everything is in {out}")
    others = files_before(out, begin_s)
    if others:
        log.warning("%s: not of this run: %s", out, ", ".join(others))
    return found


def _scheme(word: str) -> KeyScheme:
    try:
        return parsed_scheme(word)
    except ValueError as error:
        raise TeamError(f"--keys: {error}") from error


def fused(team: TeamGraph) -> TeamEstimate:
    """Fuse what was read."""
    return fuse_counted(team.frames, team.edges)


@contextmanager
def _solvable() -> Iterator[None]:
    """Tell in one line where numbers leave nothing to compute with (singular, overflow)."""
    try:
        with np.errstate(over="raise", invalid="raise"):
            yield
    except (RuntimeError, ArithmeticError, np.linalg.LinAlgError) as error:
        why = " ".join(str(error).split())[:100]
        raise TeamError(f"the numbers are too unlike each other to be solved: {why}") from error


def _frame(team: TeamGraph, name: str) -> FrameId:
    """Return the frame called A12, or that of the id 12 where one robot alone has it."""
    named = [frame for frame in team.frames if str(frame) == name]
    if not named and name.isdecimal():
        named = [frame for frame, key in team.key_of.items() if key == int(name)]
    if len(named) != 1:
        many = f"{len(named)} frames have this id" if named else "no frame has this name"
        raise TeamError(f"--relative {name}: {many}; they are called like {team.frames[-1]}")
    return named[0]


def _pair(team: TeamGraph, one: str, two: str) -> tuple[FrameId, FrameId]:
    a, b = _frame(team, one), _frame(team, two)
    if a == b:
        raise TeamError(f"--relative {one} {two}: needs two different frames")
    return a, b


def _relative(
    parts: Sequence[Solution], estimate: TeamEstimate, a: FrameId, b: FrameId
) -> Relative:
    if estimate.component_of[a] != estimate.component_of[b]:
        return Relative(a, b, None, None)
    part = parts[estimate.component_of[a]]
    pair = part.frames.index(a), part.frames.index(b)
    (covariance,) = relative_covariances(part.problem, part.poses, [pair])
    poses = estimate.team_from_base
    return Relative(a, b, poses[a].inverse() @ poses[b], covariance)


def _truth(path: Path | None, team: TeamGraph) -> Mapping[FrameId, Se2]:
    if path is None:
        return team.truth
    source = read_source(path, overlaps=True)
    try:
        truth = poses_of(source.truth or source.start, source, team.names)
    except ValueError as error:
        raise DataError(str(error)) from error
    if not truth:
        raise DataError(f"{path}: has no pose of a frame of the team")
    return truth


def _score(team: TeamGraph, estimate: TeamEstimate, truth: Mapping[FrameId, Se2]) -> Score | None:
    known = truth or any(label is not None for label in team.wrong)
    return score(team.edges, estimate, truth, team.wrong) if known else None


if __name__ == "__main__":
    sys.exit(main())
