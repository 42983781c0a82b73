"""The runs that `bench_scale.py` measures."""

import contextlib
import io
import resource
import shutil
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from groundfuse.backend.drift import accuracy
from groundfuse.backend.measurement import FrameId
from groundfuse.frontend.features import FeatureOptions, detect
from groundfuse.frontend.mosaic import MosaicOptions
from groundfuse.frontend.retrieval import (
    RetrievalOptions,
    described,
    learned,
    stacked,
    votes,
)
from groundfuse.tools import bench_frontend, fuse_team
from groundfuse.tools.bench_scale_fleets import NAMES, TwiceMown, fleet_path
from groundfuse.tools.errors import DataError
from groundfuse.tools.frame_look import Looked
from groundfuse.tools.front_end import run_front_end
from groundfuse.tools.front_end_options import FrontEndOptions, Matcher, with_matcher
from groundfuse.tools.pair_verdict import Spot, compare, look
from groundfuse.tools.pictures import write_mosaics
from groundfuse.tools.pipeline import PipelineOptions, Stopwatch, fuse_robots
from groundfuse.tools.render_files import picture_name
from groundfuse.tools.robot import Frame, Robot
from groundfuse.tools.robot_folder import IMAGES
from groundfuse.tools.store import Store
from groundfuse.tools.workers import Threads, silent

SAME_FLOOR = 0.3
"""Overlap from which a guess counts as right."""
ASKED = 0.45
"""Frames whose best partner shares less than this are not asked for one."""


@dataclass(frozen=True, slots=True)
class Growth:
    """What one fleet took; `peak_gb` is of the process so far, so let fleets grow."""

    num_frames: int
    num_tried: int
    num_accepted: int
    num_parts: int
    seconds: dict[str, float]
    peak_gb: float
    ate_mm: float

    @property
    def total_s(self) -> float:
        """All stages."""
        return sum(self.seconds.values())


def grown(robots: Sequence[Robot], num_workers: int) -> Growth:
    """Run everything from pictures to mosaic.

    Raises:
        TeamError: as `fuse_team.py`.
    """
    watch = Stopwatch()
    with tempfile.TemporaryDirectory() as temporary:
        out = Path(temporary)
        with Store(out / "store.sqlite") as store:
            fused = fuse_robots(robots, PipelineOptions(), num_workers, silent, watch, store=store)
            options = MosaicOptions()
            write_mosaics(out, fused, options, num_workers, watch, quiet=True, store=store)
    truth = {frame: pose for robot in robots for frame, pose in (robot.truth or {}).items()}
    best = fused.best
    largest = {f: pose for f, pose in best.team_from_base.items() if best.component_of[f] == 0}
    score = accuracy(largest, truth)
    found = fused.front_end
    return Growth(
        len(best.team_from_base),
        len(found.edges) + len(found.rejected),
        len(found.edges),
        len(set(best.component_of.values())),
        watch.seconds,
        resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9,
        float("nan") if score is None else 1e3 * score.ate_m,
    )


@dataclass(frozen=True, slots=True)
class Recalls:
    """How often one of a frame's best guesses of the other robot shows the same floor."""

    num_asked: int
    at_1: float
    at_5: float
    ms_per_frame: float


def recalls(team: TwiceMown, kind: str) -> Recalls:
    """Retrieve among all frames of two robots and look at the guesses of the other robot."""
    options, features = RetrievalOptions(), []
    for frame in team.frames:
        camera = frame.view.camera
        mount = camera.mount
        chosen = FeatureOptions(kind=kind)
        features.append(detect(frame.image, camera, mount.attitude, mount.sigma, chosen))
    begin = time.perf_counter()
    sample = features[:: max(1, len(features) // options.num_sample)][: options.num_sample]
    known = learned(sample, options)
    if known is None:
        raise DataError("no frame has features")
    short, glances = stacked(described(frame, known, options) for frame in features)
    robots = np.zeros(len(features), dtype=np.int64)
    robots[team.num_first :] = 1
    _, found = votes(short, glances, options, robots)
    seconds = time.perf_counter() - begin
    table = np.zeros((len(features), len(features)))
    table[tuple(found.pairs.T)] = found.weight
    table += table.T
    first, overlap = team.num_first, team.overlap
    hits = [*_hits(table[:first, first:], overlap), *_hits(table[first:, :first], overlap.T)]
    at_1, at_5 = np.mean(hits, axis=0).tolist() if hits else (float("nan"), float("nan"))
    return Recalls(len(hits), at_1, at_5, 1e3 * seconds / len(features))


def _hits(votes_of: np.ndarray, overlap: np.ndarray) -> Iterator[tuple[bool, bool]]:
    for row, shares in zip(votes_of, overlap, strict=True):
        if shares.max() >= ASKED:
            guesses = shares[np.argsort(-row, kind="stable")[:5]] >= SAME_FLOOR
            yield bool(guesses[0]), bool(guesses.any())


def speeds(floor: str, seed: int, matcher: Matcher) -> tuple[list[float], list[float]]:
    """Return a core's seconds per frame of 640 x 480, and per pair without photometric stage."""
    options = with_matcher(FrontEndOptions(), matcher)
    team = bench_frontend.clustered_team(floor, seed)
    frames: list[float] = []
    seen: list[tuple[Spot, Looked]] = []
    for rendered in team.robots:
        robot, mount = Robot(rendered.name, rendered.camera, ()), rendered.camera.mount
        for frame in rendered.frames:
            known = Frame(frame.id, Path(), 0.0, mount.attitude, mount.sigma)
            with _timed(frames):
                spot, found = look(frame.image, robot, known, options)
            seen.append((spot, replace(found, grey=None)))
    pairs: list[float] = []
    for k, a in enumerate(seen):
        for b in seen[k + 1 :]:
            with _timed(pairs):
                compare(a, b, options)
    return frames, pairs


@contextmanager
def _timed(into: list[float]) -> Iterator[None]:
    begin = time.thread_time()
    yield
    into.append(time.thread_time() - begin)


def matching_s(robots: Sequence[Robot], num_threads: int) -> dict[str, float]:
    """Return seconds of each stage of the front-end."""
    watch = Stopwatch()
    options, workers = FrontEndOptions(), Threads(num_threads)
    run_front_end(robots, options, workers, Store(), silent, watch.stage)
    return watch.seconds


def reruns(folder: Path, num_frames: int, seed: int, num_workers: int) -> dict[str, float]:
    """Return seconds of the command without a fleet's last picture, again, and with it.

    And those of three robots of the four, and of the same store with the fourth.

    Raises:
        TeamError: as `fuse_team.py`.
    """
    found: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as temporary:
        team = Path(temporary) / "team"
        shutil.copytree(fleet_path(folder, num_frames, seed), team)
        name_of_last = picture_name(FrameId(NAMES[-1], num_frames // len(NAMES) - 1))
        last = team / NAMES[-1] / IMAGES / name_of_last
        aside = last.rename(Path(temporary) / last.name)
        for name in ("first run", "nothing changed", "one picture added"):
            if name == "one picture added":
                aside.rename(last)
            found[name] = _fused_s(team, Path(temporary) / "out", NAMES, num_workers)
        for name, robots in (("three robots of four", NAMES[:-1]), ("the fourth added", NAMES)):
            found[name] = _fused_s(team, Path(temporary) / "others", robots, num_workers)
    return found


def _fused_s(team: Path, out: Path, robots: Sequence[str], num_workers: int) -> float:
    """Return seconds of the command.

    Raises:
        DataError: it refused.
    """
    folders = ["--team", str(team), "--out", str(out), "--robots", *robots]
    begin = time.perf_counter()
    with contextlib.redirect_stdout(io.StringIO()):
        code = fuse_team.main([*folders, "--quiet", "--workers", str(num_workers)])
    if code != 0:
        raise DataError(f"{team}: could not be fused")
    return time.perf_counter() - begin
