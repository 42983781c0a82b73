"""Run the front-end over a team: features of every frame, then every pair that is worth a try."""

import math
import zlib
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any, Protocol, TypeVar

import joblib
import numpy as np

from groundfuse.backend.measurement import FrameId, Reason, Rejected, RelativePose, Se2
from groundfuse.frontend import paper_matcher, sift_matcher
from groundfuse.frontend.arrays import Image
from groundfuse.frontend.consensus import Gate
from groundfuse.frontend.features import FeatureOptions, Features, detect
from groundfuse.frontend.fit import Prior
from groundfuse.frontend.motion import MotionOptions, View, relative_pose
from groundfuse.frontend.overhead_view import raster_cell_m
from groundfuse.frontend.pairs import (
    Pair,
    PairOptions,
    neighbour_pairs,
    retrieved_pairs,
    skip_pairs,
)
from groundfuse.frontend.photometric import GreyView, grey_view
from groundfuse.tools.robot import Frame, Robot
from groundfuse.tools.team_folder import load_image

Item = TypeVar("Item")
Result = TypeVar("Result")


class Progress(Protocol):
    """Passes items on while it shows how many of them are done."""

    def __call__(self, items: Iterable[Result], total: int, title: str) -> Iterable[Result]:
        """Return the items."""
        ...


Stage = Callable[[str], AbstractContextManager[None]]


class Matcher(StrEnum):
    """Matchers by name."""

    SIFT = "sift"
    FAST = "fast"
    PAPER = "paper"


@dataclass(frozen=True, slots=True, kw_only=True)
class FrontEndOptions:
    """Options of the front-end.

    Attributes:
        matcher: which matcher compares two frames.
        features: detection.
        match: the default matcher.
        paper: the paper's matcher.
        motion: when a fitted motion is believed.
        pairs: which pairs are tried.
        photometric: refine every accepted motion from grey values.
        odometry_gate_sigmas: a motion must lie within this many sigmas of the odometry, if any.
    """

    matcher: Matcher = Matcher.SIFT
    features: FeatureOptions = field(default_factory=FeatureOptions)
    match: sift_matcher.MatchOptions = field(default_factory=sift_matcher.MatchOptions)
    paper: paper_matcher.PaperOptions = field(default_factory=paper_matcher.PaperOptions)
    motion: MotionOptions = field(default_factory=MotionOptions)
    pairs: PairOptions = field(default_factory=PairOptions)
    photometric: bool = False
    odometry_gate_sigmas: float = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class FrontEndResult:
    """What the front-end found.

    Attributes:
        edges: accepted pairs, in order of frames.
        rejected: the other pairs that were tried.
        features: of every frame.
    """

    edges: tuple[RelativePose, ...]
    rejected: tuple[Rejected, ...]
    features: dict[FrameId, Features]


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """A frame as matching sees it.

    Attributes:
        frame: what is known beforehand.
        robot: whose frame it is.
        features: for retrieval and the default matcher.
        paper: for the paper's matcher, where that is asked for.
        grey: for the photometric stage, where that is asked for.
    """

    frame: Frame
    robot: Robot
    features: Features
    paper: paper_matcher.PaperFeatures | None
    grey: GreyView | None


def in_threads(
    work: Callable[[Item], Result],
    items: Sequence[Item],
    num_workers: int,
    progress: Progress,
    title: str,
) -> list[Result]:
    """Return `work` of each item, in the order of the items, whatever the number of workers."""
    pool: Any = joblib.Parallel(n_jobs=num_workers, prefer="threads", return_as="generator")
    results: Iterable[Result] = pool(joblib.delayed(work)(item) for item in items)
    found: list[Result] = list(progress(results, len(items), title))
    return found


def with_matcher(options: FrontEndOptions, matcher: Matcher) -> FrontEndOptions:
    """Return the options with a matcher and what goes with it: `fast` is ORB plus light."""
    if matcher is Matcher.FAST:
        features = replace(options.features, kind="orb")
        return replace(options, matcher=matcher, features=features, photometric=True)
    return replace(options, matcher=matcher)


def comparable(options: FrontEndOptions, robots: Sequence[Robot]) -> FrontEndOptions:
    """Give the paper's matcher one overhead cell for the whole team: it compares equal cells only.

    The coarsest camera's cell serves all; a cell that was asked for stays.
    """
    overhead = options.paper.overhead
    if options.matcher is not Matcher.PAPER or overhead.m_per_px is not None:
        return options
    cell_m = max(raster_cell_m(robot.camera, overhead) for robot in robots)
    return replace(
        options, paper=replace(options.paper, overhead=replace(overhead, m_per_px=cell_m))
    )


def run_front_end(
    robots: Sequence[Robot],
    options: FrontEndOptions,
    num_workers: int,
    progress: Progress,
    stage: Stage,
) -> FrontEndResult:
    """Detect, choose pairs, match, and bridge the places where a chain is cut."""
    options = comparable(options, robots)
    frames = [(robot, frame) for robot in robots for frame in robot.frames]
    with stage("features"):
        seen_list = in_threads(
            lambda item: look(load_image(item[1], item[0].camera), *item, options),
            frames,
            num_workers,
            progress,
            "features",
        )
    seen = {found.frame.id: found for found in seen_list}
    features = {frame: found.features for frame, found in seen.items()}
    tried: dict[Pair, RelativePose | Rejected] = {}

    def try_pairs(pairs: Iterable[Pair], title: str) -> None:
        todo = [pair for pair in dict.fromkeys(pairs) if pair not in tried]
        if todo:
            results = in_threads(
                lambda pair: compare(seen[pair[0]], seen[pair[1]], options),
                todo,
                num_workers,
                progress,
                title,
            )
            tried.update(zip(todo, results, strict=True))

    order = sorted(seen)
    with stage("retrieval"):
        similar = retrieved_pairs(features, options.pairs)
    with stage("pairs"):
        try_pairs([*neighbour_pairs(order), *similar], "pairs")
        for skip in range(2, options.pairs.max_skip + 1):
            joined = {pair for pair, found in tried.items() if isinstance(found, RelativePose)}
            try_pairs(skip_pairs(order, joined, skip), f"bridging {skip}")
    outcome = [tried[pair] for pair in sorted(tried)]
    return FrontEndResult(
        tuple(found for found in outcome if isinstance(found, RelativePose)),
        tuple(found for found in outcome if isinstance(found, Rejected)),
        features,
    )


def look(image: Image, robot: Robot, frame: Frame, options: FrontEndOptions) -> Seen:
    """Return everything that matching needs to know of one picture."""
    features = detect(image, robot.camera, frame.attitude, frame.sigma, options.features)
    paper = None
    if options.matcher is Matcher.PAPER:
        paper = paper_matcher.detect(image, robot.camera, frame.attitude, options.paper)
    grey = None
    if options.photometric:
        grey = grey_view(image, robot.camera, options.motion.photometric)
    return Seen(frame, robot, features, paper, grey)


def compare(a: Seen, b: Seen, options: FrontEndOptions) -> RelativePose | Rejected:
    """Match two frames and fit the motion between them."""
    rng = np.random.default_rng(_seed(a.frame.id, b.frame.id))
    gate = _odometry_gate(a, b, options)
    if a.paper is not None and b.paper is not None:
        found = paper_matcher.match(a.paper, b.paper, options.paper, rng)
    else:
        swayed = None if gate is None else _swayed(gate, a, b, options)
        found = sift_matcher.match(a.features, b.features, options.match, rng, swayed)
    result = relative_pose(_view(a), _view(b), found, options.motion)
    if isinstance(result, RelativePose) and gate is not None:
        off_m, off_rad = _off(_foot_motion(a, b, result.a_from_b), gate)
        if off_m > 2.0 * gate.radius_m or off_rad > 2.0 * gate.turn_rad:
            return Rejected(a.frame.id, b.frame.id, Reason.PRIOR, off_m, 2.0 * gate.radius_m)
    return result


def _view(seen: Seen) -> View:
    prior = Prior(seen.frame.attitude, seen.frame.sigma)
    return View(seen.frame.id, prior, seen.robot.camera.mount.base_from_foot, seen.grey)


def _seed(a: FrameId, b: FrameId) -> list[int]:
    """Seed that belongs to the pair, so that no order and no number of workers matters."""
    return [zlib.crc32(a.robot.encode()), a.index, zlib.crc32(b.robot.encode()), b.index]


def _odometry_gate(a: Seen, b: Seen, options: FrontEndOptions) -> Gate | None:
    """Where odometry allows frame b to be, seen from frame a of the same robot."""
    first, last = a.frame.odometry, b.frame.odometry
    if a.robot.name != b.robot.name or first is None or last is None:
        return None
    low, high = sorted((a.frame.id.index, b.frame.id.index))
    steps = [frame.odometry for frame in a.robot.frames[low + 1 : high + 1]]
    foot, turn2, place2 = last.map_from_base @ b.robot.camera.mount.base_from_foot, 0.0, 0.0
    for step in steps:
        if step is None:
            return None
        at, sigma = step.map_from_base, step.sigma
        # An error of a step's turn swings all that follows about the step's end.
        lever_m = math.hypot(foot.x_m - at.x_m, foot.y_m - at.y_m)
        turn2 += sigma.theta_rad**2
        place2 += sigma.x_m**2 + sigma.y_m**2 + (sigma.theta_rad * lever_m) ** 2
    motion = first.map_from_base.inverse() @ last.map_from_base
    turn_rad, radius_m = math.sqrt(turn2), math.sqrt(place2)
    gate = options.odometry_gate_sigmas
    return Gate(_foot_motion(a, b, motion), gate * radius_m, gate * turn_rad)


def _swayed(gate: Gate, a: Seen, b: Seen, options: FrontEndOptions) -> Gate:
    """Widen a gate by how far the wobble moves the floor in the middle of the views.

    Matching takes the cameras at their expected attitudes; only the fit knows better.
    """
    sway2 = 0.0
    for seen in (a, b):
        expected, sigma = seen.frame.attitude, seen.frame.sigma
        by_tilt = expected.height_m / math.cos(expected.tilt_rad) ** 2 * sigma.tilt_rad
        by_height = math.tan(expected.tilt_rad) * sigma.height_m
        sway2 += by_tilt**2 + (expected.height_m * sigma.roll_rad) ** 2 + by_height**2
    sway_m = options.odometry_gate_sigmas * math.sqrt(sway2)
    return gate._replace(radius_m=math.hypot(gate.radius_m, sway_m))


def _foot_motion(a: Seen, b: Seen, a_from_b: Se2) -> Se2:
    """Turn a motion of bases into one of camera feet."""
    mount_a, mount_b = a.robot.camera.mount, b.robot.camera.mount
    return mount_a.base_from_foot.inverse() @ a_from_b @ mount_b.base_from_foot


def _off(motion: Se2, gate: Gate) -> tuple[float, float]:
    error = gate.a_from_b.inverse() @ motion
    return math.hypot(error.x_m, error.y_m), abs(error.theta_rad)
