"""The main job, stage by stage: pictures, pairs, robots' graphs, the team, the planar bundle."""

import logging
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

from groundfuse.backend.bundle_estimate import (
    BundleEstimate,
    BundleOptions,
    BundleRefusal,
    MountEstimate,
)
from groundfuse.backend.bundle_tracks import Matched
from groundfuse.backend.graph import RobotEstimate
from groundfuse.backend.measurement import (
    Attitude,
    FrameId,
    Rejected,
    RelativePose,
    TeamEstimate,
)
from groundfuse.backend.option_checks import check_numbers
from groundfuse.backend.team import TeamOptions
from groundfuse.frontend.patches import PatchOptions
from groundfuse.frontend.predicted import Pair, floor_outline, predicted_pairs
from groundfuse.frontend.repetition import REPEATS
from groundfuse.tools.aligned_keypoints import Desk, aligned_keypoints
from groundfuse.tools.code_version import code_of
from groundfuse.tools.front_end import FrontEnd, FrontEndResult
from groundfuse.tools.front_end_options import FrontEndOptions
from groundfuse.tools.memory import give_back
from groundfuse.tools.packing import key_of
from groundfuse.tools.robot import Frame, Robot
from groundfuse.tools.second_look import as_filed, corrected, is_worth_it
from groundfuse.tools.store import Store
from groundfuse.tools.team_bundle import kept_bundle
from groundfuse.tools.team_graphs import Graphs, accepted_edges, solved_graphs
from groundfuse.tools.workers import Progress, Threads, Workers

log = logging.getLogger(__name__)

LONG_S = 2.0
"""A stage that took longer leaves memory behind that is worth giving back."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PipelineOptions:
    """Options of the main job, stage by stage.

    Attributes:
        front_end: pictures to relative poses.
        team: relative poses to one map.
        patches: correspondences made exact before the bundle.
        bundle: attitudes, mounts and poses from all correspondences at once.
        more_looks: where the bundle finds a camera file wrong, match and fuse again with the
            corrected file, this often at most.
    """

    front_end: FrontEndOptions = field(default_factory=FrontEndOptions)
    team: TeamOptions = field(default_factory=TeamOptions)
    patches: PatchOptions = field(default_factory=PatchOptions)
    bundle: BundleOptions = field(default_factory=BundleOptions)
    more_looks: int = 2

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense (ValueError)."""
        check_numbers(self, may_be_zero=("more_looks",))


@dataclass(slots=True)
class Stopwatch:
    """Seconds per stage, in the order in which the stages ended.

    After one that took long, what is free of its memory goes back to the system.
    """

    seconds: dict[str, float] = field(default_factory=dict)
    _within_s: float = 0.0

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time of the block to a stage, but for that of other stages within it."""
        begin, before = time.perf_counter(), self._within_s
        self._within_s = 0.0
        try:
            yield
        finally:
            took = time.perf_counter() - begin
            self.seconds[name] = self.seconds.get(name, 0.0) + took - self._within_s
            self._within_s = before + took
            if took > LONG_S:
                give_back()


@dataclass(frozen=True, slots=True)
class Means:
    """What a run works with: who, with what is known already, and who is told about it."""

    workers: Workers
    store: Store
    progress: Progress
    watch: Stopwatch


@dataclass(frozen=True, slots=True, eq=False)
class Fused:
    """Everything the main job found.

    Attributes:
        robots: the input.
        cameras: the robots with the cameras that the pictures were looked at with: the input's, or
            corrected ones.
        front_end: edges, rejected pairs, features.
        edges: the edges that the graphs were given: the front-end's and odometry's.
        alone: every robot by itself: chained and optimised.
        team: the Pose2 graph of the team.
        bundled: the planar bundle, its refusal, or None where it was not asked for.
        key: digest of all that this depends on.
    """

    robots: tuple[Robot, ...]
    cameras: tuple[Robot, ...]
    front_end: FrontEndResult
    edges: tuple[RelativePose, ...]
    alone: dict[str, RobotEstimate]
    team: TeamEstimate
    bundled: BundleEstimate | BundleRefusal | None
    key: bytes = b""

    @property
    def best(self) -> TeamEstimate:
        """The bundled team where there is one, else the Pose2 graph's."""
        return self.bundled.team if isinstance(self.bundled, BundleEstimate) else self.team

    @property
    def frames(self) -> dict[FrameId, tuple[Robot, Frame]]:
        """All frames with their robots, at the best known cameras."""
        return {frame.id: (robot, frame) for robot in self.cameras for frame in robot.frames}

    def attitude(self, frame: FrameId) -> Attitude:
        """Return the best known attitude of a frame."""
        if isinstance(self.bundled, BundleEstimate) and frame in self.bundled.attitude:
            return self.bundled.attitude[frame]
        return self.frames[frame][1].attitude

    @property
    def repeating(self) -> list[FrameId]:
        """Frames whose floor repeats itself."""
        repetition = self.front_end.repetition
        return [frame for frame in sorted(repetition) if repetition[frame] > REPEATS]


def fuse_robots(
    robots: Sequence[Robot],
    options: PipelineOptions,
    num_workers: int,
    progress: Progress,
    watch: Stopwatch,
    *,
    bundled: bool = True,
    store: Store | None = None,
    workers: Workers | None = None,
) -> Fused:
    """Run the stages from pictures to the fused team, again where that mends a camera file.

    Args:
        robots: the team.
        options: see `PipelineOptions`.
        num_workers: threads.
        progress: shows how far it is.
        watch: takes the time of each stage.
        bundled: with the planar bundle.
        store: what was computed before, and takes what is computed now; memory where there is none.
        workers: what works instead of threads of this process.

    Raises:
        DataError: a picture can't be read, or the store can't be written.
    """
    robots = tuple(robots)
    means = Means(workers or Threads(num_workers), store or Store(), progress, watch)
    fused = _looked(robots, robots, (), options, means, bundled=bundled)
    assumed: Sequence[MountEstimate] = ()
    for _ in range(options.more_looks):
        found = fused.bundled
        if not isinstance(found, BundleEstimate) or not is_worth_it(robots, assumed, found.mounts):
            break
        log.info("the pictures contradict a camera file: matching again with what they say")
        assumed, better = found.mounts, corrected(robots, found.mounts)
        again = _looked(robots, better, assumed, options, means)
        if not isinstance(again.bundled, BundleEstimate):
            break
        fused = again
    if isinstance(fused.bundled, BundleEstimate):
        return replace(fused, cameras=corrected(robots, fused.bundled.mounts))
    return fused


def _looked(
    robots: tuple[Robot, ...],
    cameras: tuple[Robot, ...],
    mounts: Sequence[MountEstimate],
    options: PipelineOptions,
    means: Means,
    *,
    bundled: bool = True,
) -> Fused:
    """Match with these cameras, which are `mounts` off the files, and fuse."""
    store, watch = means.store, means.watch
    front = FrontEnd(cameras, options.front_end, means.workers, store, means.progress, watch.stage)
    found = front.result()
    graphs = _graphs(robots, found, options, means)
    further = _further_pairs(cameras, front.tried, graphs, options.front_end, means)
    if further:
        front.try_further(further)
        found = front.result()
        graphs = _graphs(robots, found, options, means)
    team, edges, rests_on = graphs.team, graphs.edges, graphs.rests_on
    known = [(r.camera, [(f.attitude, f.sigma) for f in r.frames]) for r in robots]
    refined: BundleEstimate | BundleRefusal | None = None
    if bundled:
        rests_on = (*rests_on, known, mounts, options.patches, options.bundle)

        def exact() -> tuple[Sequence[RelativePose], Matched]:
            accepted = as_filed(accepted_edges(team, edges), robots, mounts)
            with watch.stage("patches"):
                desk = Desk(
                    found.pictures,
                    store,
                    means.workers.num_threads,
                    means.progress,
                    options.bundle.most_sightings,
                )
                seen = aligned_keypoints(robots, cameras, team, accepted, options.patches, desk)
            return accepted, seen

        with watch.stage("bundle"):
            # A look with corrected cameras starts over: what made it necessary may explain more.
            refined = kept_bundle(
                robots, team, exact, options.bundle, store, rests_on, may_go_on=not mounts
            )
    code = code_of("groundfuse.tools.pipeline", rooms=("frontend", "backend", "tools"))
    key = key_of("fused", code, rests_on, known)
    return Fused(robots, cameras, found, edges, graphs.alone, team, refined, key)


def _graphs(
    robots: Sequence[Robot], found: FrontEndResult, options: PipelineOptions, means: Means
) -> Graphs:
    with means.watch.stage("graphs"):
        return solved_graphs(robots, found, options.team, means.store)


def _further_pairs(
    robots: Sequence[Robot],
    tried: set[Pair],
    graphs: Graphs,
    options: FrontEndOptions,
    means: Means,
) -> list[Pair]:
    """Return the pairs that the poses found so far say are worth a try."""
    chosen = options.pairs.predicted
    if chosen.num_frames == 0:
        return []
    team, placed = graphs.team, {f.id: (r.camera, f) for r in robots for f in r.frames}
    with means.watch.stage("retrieval"):
        outlines = {}
        for frame, pose in team.team_from_base.items():
            camera, seen = placed[frame]
            team_from_foot = pose @ camera.mount.base_from_foot
            outlines[frame] = floor_outline(
                camera, seen.attitude, team_from_foot, options.features.overhead
            )
        accepted = [(edge.a, edge.b) for edge in accepted_edges(team, graphs.edges)]
        return predicted_pairs(outlines, team.component_of, accepted, tried, chosen)


def turned_down(team: TeamEstimate) -> list[Rejected]:
    """Return the edges that the team graph turned down, as values."""
    return [
        Rejected(v.a, v.b, v.reason, v.chi2, v.limit)
        for v in team.verdicts
        if not v.accepted and v.reason is not None
    ]


def bundle_rejected(fused: Fused) -> tuple[Rejected, ...]:
    """Return the pairs that the graph accepted and the bundle turned down."""
    return fused.bundled.rejected if isinstance(fused.bundled, BundleEstimate) else ()


def used_edges(fused: Fused) -> list[RelativePose]:
    """Return the edges that the best solution rests on."""
    late = {(r.a, r.b) for r in bundle_rejected(fused)}
    accepted = accepted_edges(fused.team, fused.edges)
    return [e for e in accepted if e.correspondences is None or (e.a, e.b) not in late]
