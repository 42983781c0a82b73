"""A team that exists as geometry only: floor points, wobbling cameras, keypoints with noise.

For tests and benches of the planar bundle: truth by construction, through the front-end's own
camera geometry and not the bundle's model. A keypoint's noise is shared by all pairs that use it.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from groundfuse.backend.bundle_estimate import BundleCamera
from groundfuse.backend.measurement import (
    Anchor,
    Attitude,
    Correspondences,
    FrameId,
    RelativePose,
    Se2,
    TeamEstimate,
)
from groundfuse.frontend.arrays import Floats, Points
from groundfuse.frontend.overhead import rays_from_floor
from groundfuse.tools.simulated_robot import SimulatedRobot

WOBBLE = Attitude(math.radians(0.5), math.radians(0.15), 0.002)
FOCAL_PX = 640.0
HALF_VIEW = np.array([0.5, 0.375])
"""Rays at the edge of a picture of 640 x 480 pixels."""
REACH = 3.0
"""Floor is simulated as far as this from a camera's foot, in camera heights."""
EDGE_SPREAD = np.diag([1e-6, 1e-6, 4e-7])
ODOMETRY_SPREAD = np.diag([1e-4, 1e-4, 1e-4])

Relief = Callable[[Points, np.random.Generator], Floats]


@dataclass(frozen=True, slots=True, kw_only=True)
class SightingOptions:
    """How the team sees.

    Attributes:
        density: keypoints per square metre.
        noise_px: one-axis standard deviation of a keypoint.
        wobble: of every frame.
        prior_sigma: what the files say of it; None for the truth.
        wrong: share of correspondences that lead to a neighbouring keypoint.
        start_sigma_m: error of the start's positions.
        start_sigma_rad: error of the start's headings.
        min_common: pairs that share fewer keypoints are no edges.
        detect: probability that a frame has a keypoint that it could see.
        odometry: add edges without pictures between neighbours in time.
        relief: heights (n,) of floor points (n, 2); None for a flat floor.
    """

    density: float = 400.0
    noise_px: float = 0.4
    wobble: Attitude = WOBBLE
    prior_sigma: Attitude | None = None
    wrong: float = 0.0
    start_sigma_m: float = 0.003
    start_sigma_rad: float = math.radians(0.1)
    min_common: int = 25
    detect: float = 0.7
    odometry: bool = False
    relief: Relief | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedTeam:
    """The bundle's input and the truth."""

    start: TeamEstimate
    edges: list[RelativePose]
    prior: dict[FrameId, Attitude]
    sigma: dict[FrameId, Attitude]
    cameras: dict[str, BundleCamera]
    truth: dict[FrameId, Se2]
    attitude: dict[FrameId, Attitude]

    @property
    def arguments(self) -> tuple[Any, ...]:
        """Arguments of `bundle`."""
        return self.start, self.edges, self.prior, self.sigma, self.cameras


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """Keypoints of a frame, by the number of their floor point."""

    number: np.ndarray
    rays: Points
    middle: Floats


def simulate(
    robots: Sequence[SimulatedRobot], rng: np.random.Generator, options: SightingOptions
) -> SimulatedTeam:
    """Simulate a team and what it sees of its floor."""
    reach_m = REACH * max(robot.height_m for robot in robots)
    paths = np.concatenate([robot.path[:, :2] for robot in robots])
    low, high = paths.min(axis=0) - reach_m, paths.max(axis=0) + reach_m
    floor = rng.uniform(low, high, (int(options.density * np.prod(high - low)), 2))
    tall = options.relief(floor, rng) if options.relief else np.zeros(len(floor))
    tree = KDTree(floor)
    views: dict[FrameId, _View] = {}
    truth: dict[FrameId, Se2] = {}
    attitude: dict[FrameId, Attitude] = {}
    prior: dict[FrameId, Attitude] = {}
    for robot in robots:
        for index, (x, y, theta) in enumerate(robot.path.tolist()):
            frame = FrameId(robot.name, index)
            truth[frame], prior[frame] = Se2(x, y, theta), robot.filed()
            attitude[frame] = _wobbled(robot, options.wobble, rng)
            foot = truth[frame] @ robot.base_from_foot
            near = np.array(tree.query_ball_point([foot.x_m, foot.y_m], reach_m), dtype=np.int64)
            views[frame] = _seen(
                robot, attitude[frame], foot, near, floor[near], tall[near], rng, options
            )
    edges = _edges(views, truth, reach_m, rng, options)
    if options.odometry:
        edges += _odometry_edges(robots, truth, rng)
    start = _start(robots, truth, edges, rng, options)
    cameras = {robot.name: BundleCamera(robot.base_from_foot, FOCAL_PX) for robot in robots}
    sigma = dict.fromkeys(truth, options.prior_sigma or options.wobble)
    return SimulatedTeam(start, edges, prior, sigma, cameras, truth, attitude)


def _wobbled(robot: SimulatedRobot, wobble: Attitude, rng: np.random.Generator) -> Attitude:
    tilt, roll, height = rng.standard_normal(3).tolist()
    return Attitude(
        math.radians(robot.tilt_deg) + wobble.tilt_rad * tilt,
        math.radians(robot.roll_deg) + wobble.roll_rad * roll,
        robot.height_m + wobble.height_m * height,
    )


def _seen(
    robot: SimulatedRobot,
    attitude: Attitude,
    foot: Se2,
    near: np.ndarray,
    floor: Points,
    tall_m: Floats,
    rng: np.random.Generator,
    options: SightingOptions,
) -> _View:
    in_foot = foot.inverse().apply(floor)
    # A point above the floor looks as one on the floor does to a camera that much lower.
    shrunk = in_foot * (attitude.height_m / (attitude.height_m - tall_m))[:, None]
    rays = rays_from_floor(attitude, shrunk)
    bulge = 1.0 + robot.distortion * np.sum(rays**2, axis=1, keepdims=True)
    rays = robot.focal_factor * bulge * rays
    inside = (np.abs(rays) < HALF_VIEW).all(axis=1) & (rng.random(len(rays)) < options.detect)
    noise = rng.normal(0.0, options.noise_px / FOCAL_PX, (int(inside.sum()), 2))
    order = np.argsort(near[inside])
    middle = floor[inside].mean(axis=0) if inside.any() else np.full(2, 1e9)
    return _View(near[inside][order], (rays[inside] + noise)[order], middle)


def _edges(
    views: dict[FrameId, _View],
    truth: dict[FrameId, Se2],
    reach_m: float,
    rng: np.random.Generator,
    options: SightingOptions,
) -> list[RelativePose]:
    frames = list(views)
    tree = KDTree(np.array([views[frame].middle for frame in frames]))
    edges = []
    for i, j in sorted(tree.query_pairs(reach_m)):
        a, b = frames[i], frames[j]
        pair = _pair(views[a], views[b], rng, options)
        if pair is not None:
            jitter = rng.multivariate_normal(np.zeros(3), EDGE_SPREAD)
            measured = truth[a].inverse() @ truth[b] @ Se2(*jitter.tolist())
            edges.append(RelativePose(a, b, measured, EDGE_SPREAD, len(pair), 0.1, pair))
    return edges


def _pair(
    a: _View, b: _View, rng: np.random.Generator, options: SightingOptions
) -> Correspondences | None:
    _, in_a, in_b = np.intersect1d(a.number, b.number, return_indices=True)
    if len(in_a) < options.min_common:
        return None
    wrong = rng.random(len(in_a)) < options.wrong
    if wrong.any():  # a neighbouring keypoint of b instead of the right one
        others = np.asarray(KDTree(b.rays).query(b.rays[in_b[wrong]], k=3)[1])
        in_b = in_b.copy()
        in_b[wrong] = others[:, 2]
    sigma = np.full(len(in_a), options.noise_px / FOCAL_PX)
    return Correspondences(a.rays[in_a], b.rays[in_b], sigma, sigma)


def _odometry_edges(
    robots: Sequence[SimulatedRobot], truth: dict[FrameId, Se2], rng: np.random.Generator
) -> list[RelativePose]:
    edges = []
    for robot in robots:
        for index in range(len(robot.path) - 1):
            a, b = FrameId(robot.name, index), FrameId(robot.name, index + 1)
            jitter = Se2(*rng.multivariate_normal(np.zeros(3), ODOMETRY_SPREAD).tolist())
            measured = truth[a].inverse() @ truth[b] @ jitter
            edges.append(RelativePose(a, b, measured, ODOMETRY_SPREAD))
    return edges


def _start(
    robots: Sequence[SimulatedRobot],
    truth: dict[FrameId, Se2],
    edges: Sequence[RelativePose],
    rng: np.random.Generator,
    options: SightingOptions,
) -> TeamEstimate:
    """Truth with errors, except for the reference of each component."""
    component_of = components(list(truth), edges)
    references: dict[int, FrameId] = {}
    for frame, component in component_of.items():
        references.setdefault(component, frame)
    held = set(references.values())
    poses = {}
    for frame, pose in truth.items():
        x, y, theta = rng.standard_normal(3).tolist()
        error = Se2(
            options.start_sigma_m * x, options.start_sigma_m * y, options.start_sigma_rad * theta
        )
        poses[frame] = pose if frame in held else pose @ error
    spread = {frame: 1e-4 * np.eye(3) for frame in truth if frame not in held}
    anchors = []
    for robot in robots:
        first = FrameId(robot.name, 0)
        place = component_of[first], first, poses[first], spread.get(first)
        anchors.append(Anchor(robot.name, 0, *place, num_overlaps=1))
    return TeamEstimate(poses, component_of, spread, tuple(anchors), (), 0.0, 0)


def components(frames: list[FrameId], edges: Sequence[RelativePose]) -> dict[FrameId, int]:
    """Return the component of each frame; the one of the first frame is 0."""
    parent = {frame: frame for frame in frames}

    def root(frame: FrameId) -> FrameId:
        while parent[frame] != frame:
            frame = parent[frame]
        return frame

    for edge in edges:
        a, b = sorted((root(edge.a), root(edge.b)), key=frames.index)
        parent[b] = a
    roots = list(dict.fromkeys(root(frame) for frame in frames))
    return {frame: roots.index(root(frame)) for frame in frames}
