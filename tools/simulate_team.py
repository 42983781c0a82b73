"""Simulate pose graphs of a team with known truth: `simulate_team.py --robots 3 --out team`."""

import argparse
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from groundfuse.backend import g2o, jrl, planar, toro
from groundfuse.backend.graph_keys import (
    KeyKind,
    KeyScheme,
    key_of_symbol,
    parsed_scheme,
    robot_name,
    symbol_name,
)
from groundfuse.backend.graph_lines import Graph
from groundfuse.backend.measurement import IDENTITY, EdgeKind, FrameId, RelativePose, Se2
from groundfuse.backend.team_jrl import dataset_of_team, letters_of
from groundfuse.tools.errors import TeamError
from groundfuse.tools.files import make_folder, write_atomic
from groundfuse.tools.graph_outputs import ENDING, Format
from groundfuse.tools.one_line_parser import INTERRUPTED, OneLineParser
from groundfuse.tools.outputs import csv_text
from groundfuse.tools.simulate_graphs import TeamGraphs, TeamShape, simulate

Names = Callable[[int], str]
WRONG_COLUMNS = ("a", "b", "kind")
EPILOG = """\
examples:
  simulate_team.py --robots 3 --frames 200 --wrong-overlaps 0.3 --out team
  fuse_graphs.py team/A.g2o team/B.g2o team/C.g2o --overlaps team/overlaps.g2o \\
    --truth team/truth.g2o

writes a file per robot with dead-reckoned poses, overlaps, truth, and
wrong_edges.csv; with --format jrl all of it in one file, team.jrl.
"""


def parser() -> argparse.ArgumentParser:
    """Return the command line."""
    plain = TeamShape()
    command = OneLineParser(
        "simulate_team",
        "Simulate the pose graphs of a team of robots, with known truth.",
        EPILOG,
    )
    add = command.add_argument
    add("--robots", type=int, default=plain.robots, metavar="N", help="how many (2)")
    add("--frames", type=int, default=plain.frames, metavar="N", help="per robot (100)")
    add("--world", choices=("free", "manhattan"), default=plain.world, help="paths (free)")
    add("--step", type=float, default=plain.step_m, metavar="M", help="between frames (1)")
    add("--area", type=float, default=0.0, metavar="M", help="side of the square (from the rest)")
    add("--loops", type=int, default=plain.loops, metavar="N", help="within each robot (20)")
    add("--overlaps", type=int, default=plain.overlaps, metavar="N", help="per two robots (20)")
    add("--reach", type=float, default=0.0, metavar="M", help="longest loop or overlap (2 steps)")
    add("--wrong-loops", type=float, default=0.0, metavar="SHARE", help="of the loops (0)")
    add("--wrong-overlaps", type=float, default=0.0, metavar="SHARE", help="of the overlaps (0)")
    kinds = ("random", "consistent")
    add("--kind", choices=kinds, default="random", help="whether wrong edges of a pair agree")
    add("--sigma-m", type=float, default=plain.sigma_m, metavar="M", help="noise (0.02)")
    degrees = round(math.degrees(plain.sigma_rad), 3)
    add("--sigma-deg", type=float, default=degrees, metavar="DEG", help=f"noise ({degrees})")
    add("--seed", type=int, default=1, metavar="N", help="of everything random (1)")
    forms = [form.value for form in Format]
    add("--format", choices=forms, default="g2o", help="of the files (g2o)")
    add(
        "--keys",
        default="symbols",
        metavar="SCHEME",
        help="symbols (A12), gtsam (the same as 64 bits), plain or offset=N (symbols)",
    )
    add("--out", type=Path, default=Path("team"), metavar="FOLDER", help="results (team)")
    return command


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 where a team was made, 2 where the options do not allow one."""
    asked = parser().parse_args(arguments)
    try:
        run(asked)
    except TeamError as error:
        print(f"simulate_team: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("simulate_team: interrupted", file=sys.stderr)
        return INTERRUPTED
    return 0


def run(asked: argparse.Namespace) -> TeamGraphs:
    """Do what the command line asks for."""
    shape, form = _shape(asked), Format(asked.format)
    try:
        key, name_of = _keys("plain" if form is Format.JRL else asked.keys, shape)
        world = simulate(shape, np.random.default_rng(asked.seed))
        text = _jrl_text(world) if form is Format.JRL else ""
    except ValueError as error:
        raise TeamError(str(error)) from error
    out = make_folder(asked.out)
    robots = {frame.robot: frame.robot for frame in world.frames}
    if form is Format.JRL:
        robots = letters_of(robots)
        write_atomic(out / "team.jrl", text)
    else:
        _write_graphs(out, world, key, name_of, form)
    _write_wrong(out, world, robots)
    wrong = sum(world.wrong)
    print(f"{shape.robots} robots x {shape.frames} frames, {len(world.edges)} edges, {wrong} wrong")
    asked_for = shape.robots * (shape.frames - 1 + shape.loops)
    asked_for += shape.overlaps * shape.robots * (shape.robots - 1) // 2
    if len(world.edges) < asked_for:
        fewer = asked_for - len(world.edges)
        print(f"{fewer} loops fewer than asked for: paths come back too seldom")
    print(f"everything is in {out}")
    return world


def _shape(asked: argparse.Namespace) -> TeamShape:
    lengths = {"--step": asked.step, "--sigma-m": asked.sigma_m, "--sigma-deg": asked.sigma_deg}
    for name, value in lengths.items():
        if not 0.0 < value < math.inf:
            raise TeamError(f"{name} must be positive, got {value:g}")
    counts = {"--loops": asked.loops, "--overlaps": asked.overlaps, "--seed": asked.seed}
    for name, value in (counts | {"--area": asked.area, "--reach": asked.reach}).items():
        if not 0 <= value < math.inf:
            raise TeamError(f"{name} must be 0 or more, got {value:g}")
    return TeamShape(
        robots=asked.robots,
        frames=asked.frames,
        world=asked.world,
        step_m=asked.step,
        area_m=asked.area,
        loops=asked.loops,
        overlaps=asked.overlaps,
        reach_m=asked.reach,
        wrong_loops=asked.wrong_loops,
        wrong_overlaps=asked.wrong_overlaps,
        consistent=asked.kind == "consistent",
        sigma_m=asked.sigma_m,
        sigma_rad=math.radians(asked.sigma_deg),
    )


def _keys(word: str, shape: TeamShape) -> tuple[Callable[[FrameId], int], Names]:
    """Return the id of a frame, and how ids are written.

    Raises:
        ValueError: no such scheme, robots without a letter, or an offset below the frames.
    """
    number = {robot_name(k): k for k in range(shape.robots)}
    scheme = KeyScheme(KeyKind.GTSAM) if word == "symbols" else parsed_scheme(word)
    if scheme.kind in {KeyKind.GTSAM, KeyKind.AUTO}:
        if shape.robots > 26:
            raise ValueError(f"letters name 26 robots, got {shape.robots}: --keys plain")
        write = symbol_name if word == "symbols" else str
        return lambda frame: key_of_symbol(frame.robot, frame.index), write
    offset = scheme.offset or shape.frames
    if offset < shape.frames:
        raise ValueError(f"--keys offset={offset}: is below the frames per robot, {shape.frames}")
    return lambda frame: number[frame.robot] * offset + frame.index, str


def dead_reckoned(world: TeamGraphs) -> dict[FrameId, Se2]:
    """Return every robot's poses in its own map, by its steps alone."""
    step = {(e.a, e.b): e.a_from_b for e in world.edges if _is_step(e)}
    poses: dict[FrameId, Se2] = {}
    for frame in world.frames:
        before = FrameId(frame.robot, frame.index - 1)
        poses[frame] = poses[before] @ step[before, frame] if before in poses else IDENTITY
    return poses


def _is_step(edge: RelativePose) -> bool:
    return edge.a.robot == edge.b.robot and edge.b.index == edge.a.index + 1


def _write_graphs(
    out: Path, world: TeamGraphs, key: Callable[[FrameId], int], name_of: Names, form: Format
) -> None:
    """Write a graph per robot, the overlaps, and the truth."""
    key_of = {frame: key(frame) for frame in world.frames}
    poses = dead_reckoned(world)
    truth = {frame: planar.pose(pose) for frame, pose in world.truth.items()}
    inner = [e for e in world.edges if e.a.robot == e.b.robot]
    outer = [e for e in world.edges if e.a.robot != e.b.robot]
    graphs = {"truth": g2o.keyed(key_of, truth, [])}
    graphs["overlaps"] = Graph({}, g2o.keyed(key_of, poses, outer).edges)
    for robot in dict.fromkeys(frame.robot for frame in world.frames):
        own = {frame: pose for frame, pose in poses.items() if frame.robot == robot}
        graphs[robot] = g2o.keyed(key_of, own, [e for e in inner if e.a.robot == robot])
    write = toro.text_of if form is Format.TORO else g2o.text_of
    for stem, graph in graphs.items():
        write_atomic(out / f"{stem}{ENDING[form]}", write(graph, name_of))


def _jrl_text(world: TeamGraphs) -> str:
    letter = letters_of(frame.robot for frame in world.frames)
    truth = {frame: planar.pose(pose) for frame, pose in world.truth.items()}
    possible = [not _is_step(edge) for edge in world.edges]
    poses = dead_reckoned(world)
    return jrl.text_of(
        dataset_of_team("simulated", poses, world.edges, letter, truth, world.wrong, possible)
    )


def _write_wrong(out: Path, world: TeamGraphs, name_of: Mapping[str, str]) -> None:
    """Write who is wrong."""
    rows = []
    for edge, wrong in zip(world.edges, world.wrong, strict=True):
        if wrong:
            kind = EdgeKind.LOOP if edge.a.robot == edge.b.robot else EdgeKind.OVERLAP
            ends = [FrameId(name_of[end.robot], end.index) for end in (edge.a, edge.b)]
            rows.append([*ends, kind.value])
    write_atomic(out / "wrong_edges.csv", csv_text(WRONG_COLUMNS, rows))


if __name__ == "__main__":
    sys.exit(main())
