"""Fuse the photographs of a team of robots into one map: `fuse_team.py --robots A B`."""

import argparse
import gc
import logging
import math
import os
import signal
import sys
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

if __name__ == "__main__" and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C amid the imports: the end, no traceback

# Threads work on frames and pairs; a second layer of them inside numpy would only get in the way.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
from tqdm import tqdm

from groundfuse.backend.bundle_estimate import BundleEstimate
from groundfuse.frontend.ahead import Result
from groundfuse.frontend.mosaic import Mosaic, MosaicOptions
from groundfuse.tools.calibration_file import write_calibrations
from groundfuse.tools.closing_table import closing_table
from groundfuse.tools.code_version import code_of, libraries
from groundfuse.tools.command_line import parser
from groundfuse.tools.drift_table import drift_record
from groundfuse.tools.errors import TeamError
from groundfuse.tools.files import make_folder, write_atomic
from groundfuse.tools.finished import unless_finished
from groundfuse.tools.floor_check import check_floor
from groundfuse.tools.front_end_options import Matcher, with_matcher
from groundfuse.tools.memory import keep_freed
from groundfuse.tools.one_line_parser import INTERRUPTED
from groundfuse.tools.open3d_check import check_with_open3d
from groundfuse.tools.outputs import (
    check_names,
    clear_parts,
    component_name,
    files_before,
    write_attitudes,
    write_graphs,
    write_json,
    write_pairs,
    write_poses,
    write_trajectories,
)
from groundfuse.tools.pictures import (
    write_location_graph,
    write_mosaics,
    write_overheads,
)
from groundfuse.tools.pipeline import (
    Fused,
    PipelineOptions,
    Stopwatch,
    fuse_robots,
)
from groundfuse.tools.robot import Robot
from groundfuse.tools.settings import record, with_settings
from groundfuse.tools.store import STORE, Store
from groundfuse.tools.superseded import forget_superseded
from groundfuse.tools.team_folder import list_robots, read_team
from groundfuse.tools.view3d import view_ply, write_ply
from groundfuse.tools.workers import Threads, Workers

log = logging.getLogger(__name__)

MOSAIC_FILES = "*.png", "*.pgw", "*.tif", "*.ply"
"""What comes with a mosaic."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOptions(PipelineOptions):
    """What a run is asked for; written to the out folder as options.json.

    Attributes:
        mosaic: poses to a picture of the floor.
    """

    mosaic: MosaicOptions = field(default_factory=MosaicOptions)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; 0 where a map was made, 2 where the input allows none, 130 on Ctrl-C."""
    asked = parser().parse_args(arguments)
    logging.basicConfig(format="%(levelname)s: %(message)s", level=logging.INFO)
    cv2.setNumThreads(1)
    keep_freed()
    gc.freeze()  # what imports have made stays: no search for garbage goes through it again
    try:
        run(asked)
    except TeamError as error:
        print(f"fuse_team: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"fuse_team: {_interrupted(asked)}", file=sys.stderr)
        return INTERRUPTED
    return 0


def run(asked: argparse.Namespace) -> Fused:
    """Do what the command line asks for."""
    options = _options(asked)
    if asked.view and asked.no_mosaic:
        raise TeamError("--view shows the mosaic: leave out --no-mosaic")
    if asked.workers < 1:
        raise TeamError(f"--workers must be at least 1, got {asked.workers}")
    watch, begin_s = Stopwatch(), time.time()
    with watch.stage("reading"):
        robots = read_team(asked.team, asked.robots or list_robots(asked.team))
        check_names(robot.name for robot in robots)
        check_floor(robots, options.front_end.features.overhead)
        out = make_folder(asked.out)
    with Store(asked.store or out / STORE, fresh=asked.fresh) as store:
        clear_parts(out)
        write_json(out / "options.json", record(options))
        store.begin(record(options), libraries())
        desk = _Desk(asked, out, options, store, watch)
        with _workers(asked) as workers:
            fused, old = _fused(desk, robots, workers)
        forget_superseded(store)
    print(f"everything is in {out}")
    others = sorted({*files_before(out, begin_s)} - old)
    if others:
        log.warning("%s: not of this run: %s", out, ", ".join(others))
    if asked.view:
        view_ply(out / "team.ply")
    return fused


@dataclass(frozen=True, slots=True)
class _Desk:
    """What a run works with."""

    asked: argparse.Namespace
    out: Path
    options: RunOptions
    store: Store
    watch: Stopwatch


def _workers(asked: argparse.Namespace) -> AbstractContextManager[Workers]:
    """Return who does the front-end's work: threads, or a cluster."""
    if asked.scheduler is None:
        return nullcontext(Threads(asked.workers))
    from groundfuse.tools.cluster import Cluster  # noqa: PLC0415 - takes a second, seldom needed

    return Cluster(asked.scheduler, num_threads=asked.workers)


def _fused(desk: _Desk, robots: Sequence[Robot], workers: Workers) -> tuple[Fused, set[str]]:
    """Fuse and write everything down; return the files that stay from an earlier run, too."""
    asked, watch = desk.asked, desk.watch
    fused = fuse_robots(
        robots,
        desk.options,
        asked.workers,
        _Bar(asked.quiet),
        watch,
        bundled=not asked.no_bundle,
        store=desk.store,
        workers=workers,
    )
    notes = [fused.front_end.reused.line()]
    old: set[str] = set()
    with ThreadPoolExecutor(1) as beside:
        numbers = beside.submit(_write_numbers, desk.out, fused)
        try:
            old |= _write_pictures(desk, fused)
            if asked.check:
                with watch.stage("check"):
                    notes.append(_second_opinion(fused))
        finally:  # a picture that fails late doesn't cost the numbers
            with watch.stage("writing"):
                drift = numbers.result()
            table = closing_table(fused, drift, watch.seconds)
            table += "".join(f"{note}\n" for note in notes if note)
            write_atomic(desk.out / "report.txt", table)
            print(table, end="")
    return fused, old


def _interrupted(asked: argparse.Namespace) -> str:
    """Return what a run that was stopped leaves behind."""
    store = asked.store or asked.out / STORE
    if not store.exists():
        return "interrupted"
    same = "the same command without --fresh" if asked.fresh else "the same command"
    return f"interrupted; what was finished is in {store}, {same} goes on from there"


def _write_numbers(out: Path, fused: Fused) -> dict[str, Any]:
    """Write everything but pictures; return the record of the drift."""
    drift = drift_record(fused)
    write_pairs(out, fused)
    write_poses(out, fused)
    write_attitudes(out, fused)
    if isinstance(fused.bundled, BundleEstimate):
        write_calibrations(out, fused.robots, fused.bundled)
    write_graphs(out, fused)
    write_trajectories(out, fused)
    write_json(out / "drift.json", drift)
    return drift


def _write_pictures(desk: _Desk, fused: Fused) -> set[str]:
    """Write what is asked for and not there yet; return the names of what is."""
    asked, options = desk.asked, desk.options
    code = code_of("groundfuse.tools.fuse_team", rooms=("frontend", "backend", "tools"))
    rests_on: tuple[object, ...] = (code, fused.key, sorted(fused.front_end.pictures.items()))
    old: set[str] = set()

    def overheads() -> None:
        with desk.watch.stage("overhead"):
            write_overheads(desk.out, fused, options.front_end.features.overhead)

    if not asked.no_mosaic:
        old |= unless_finished(
            desk.store,
            desk.out,
            "mosaic",
            (*rests_on, options.mosaic),
            MOSAIC_FILES,
            lambda: _write_mosaics(desk, fused),
        )
    if asked.overhead:
        rests_on = (*rests_on, options.front_end.features.overhead)
        old |= unless_finished(
            desk.store, desk.out, "overhead", rests_on, ("overhead/*.png",), overheads
        )
    return old


def _write_mosaics(desk: _Desk, fused: Fused) -> None:
    """Write the mosaics, and over each its location graph and its points."""
    out, options = desk.out, desk.options.mosaic

    def draw(component: int, mosaic: Mosaic) -> None:
        write_location_graph(out, fused, component, mosaic)

    def put_down(component: int, mosaic: Mosaic) -> None:
        write_ply(out / f"{component_name('team', component)}.ply", mosaic, fused.best, component)

    write_mosaics(
        out,
        fused,
        options,
        desk.asked.workers,
        desk.watch,
        quiet=desk.asked.quiet,
        store=desk.store,
        longer=(draw,),
        shorter=(put_down,),
    )


def _second_opinion(fused: Fused) -> str:
    """Open3D's optimum of the largest component's Pose2 graph against ours."""
    largest = [frame for frame, part in sorted(fused.team.component_of.items()) if part == 0]
    if len(largest) < 2:
        return "no check: the largest component has a single frame"
    return check_with_open3d(largest, fused.edges, fused.team).line()


def _options(asked: argparse.Namespace) -> RunOptions:
    base = RunOptions()
    chosen = with_matcher(base.front_end, Matcher(asked.matcher))
    options = replace(base, front_end=chosen)
    if asked.cell is not None:
        if not 0.0 < asked.cell < math.inf:
            raise TeamError(f"--cell must be positive, got {asked.cell:g}")
        options = replace(options, mosaic=replace(options.mosaic, m_per_px=asked.cell))
    options = with_settings(options, asked.set)
    if options.front_end.matcher is not chosen.matcher:
        raise TeamError(
            "--set front_end.matcher: more goes with a matcher than its name, use --matcher"
        )
    return options


class _Bar:
    """Progress bars on the terminal."""

    def __init__(self, quiet: bool) -> None:  # noqa: FBT001
        self._quiet = quiet

    def __call__(self, items: Iterable[Result], total: int, title: str) -> Iterable[Result]:
        bar: Iterable[Result] = tqdm(
            items, total=total, desc=f"{title:<10}", disable=self._quiet or None, leave=False
        )
        return bar


if __name__ == "__main__":
    if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.exit(main())
