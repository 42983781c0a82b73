"""A team that exists as geometry only: floor points, wobbling cameras, keypoints with noise.

Truth by construction, through the front-end's own camera geometry and not the bundle's model.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

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
from groundfuse.frontend.overhead import rays_from_floor

MOUNTED = Se2(0.1, 0.02, 0.0)
WOBBLE = Attitude(math.radians(0.5), math.radians(0.15), 0.002)
START_SIGMA = (0.003, math.radians(0.1))
HALF_VIEW = np.array([0.5, 0.375])  # rays at the picture's edge: 640 x 480, focal length 640 px
FOCAL_PX = 640.0


@dataclass(frozen=True)
class World:
    """A simulated team: the bundle's input and the truth."""

    start: TeamEstimate
    edges: list
    prior: dict
    sigma: dict
    cameras: dict
    truth: dict
    attitude: dict

    @property
    def arguments(self):
        return self.start, self.edges, self.prior, self.sigma, self.cameras


@dataclass(frozen=True)
class Robot:
    """One robot's true camera and its path of (x, y, theta) base poses."""

    name: str
    path: np.ndarray
    tilt_deg: float = 33.0
    roll_deg: float = 0.0
    height_m: float = 0.55
    base_from_foot: Se2 = MOUNTED
    focal_factor: float = 1.0
    distortion: float = 0.0
    file_tilt_deg: float | None = None
    file_roll_deg: float | None = None
    file_height_m: float | None = None


def loop_path(count, centre=(0.0, 0.0), size=(1.2, 0.8), phase=0.0, turns=1.0):
    """An oval with headings along it."""
    angle = phase + 2 * math.pi * turns * np.arange(count) / count
    x, y = centre[0] + size[0] * np.cos(angle), centre[1] + size[1] * np.sin(angle)
    theta = np.arctan2(size[1] * np.cos(angle), -size[0] * np.sin(angle))
    return np.column_stack([x, y, theta])


def lawn_path(rows, columns, step=0.2, origin=(0.0, 0.0), row_step=0.35):
    """Back and forth in rows."""
    poses = []
    for row in range(rows):
        forward = row % 2 == 0
        along = np.arange(columns) * step
        heading, y = (0.0 if forward else math.pi), origin[1] + row * row_step
        poses += [(origin[0] + x, y, heading) for x in (along if forward else along[::-1])]
    return np.array(poses)


def pair_team():
    """The paper's team in shape: two robots of 13 views, tilts 33 and 45 degrees."""
    return (
        Robot("A", loop_path(13)),
        Robot("B", loop_path(13, (0.6, 0.3), phase=1.0), tilt_deg=45.0, height_m=0.6),
    )


def simulate(
    robots,
    rng,
    *,
    density=400.0,
    noise_px=0.4,
    wobble=WOBBLE,
    prior_sigma=None,
    wrong=0.0,
    start_sigma=START_SIGMA,
    min_common=25,
    detect=0.7,
    odometry=False,
    relief=None,
):
    """Simulate a team; keypoint noise belongs to a frame's keypoint and is shared by its pairs."""
    prior_sigma = prior_sigma or wobble
    paths = np.concatenate([robot.path[:, :2] for robot in robots])
    reach = 3.0 * max(robot.height_m for robot in robots)
    low, high = paths.min(axis=0) - reach, paths.max(axis=0) + reach
    floor = rng.uniform(low, high, (int(density * np.prod(high - low)), 2))
    tall = relief(floor, rng) if relief else np.zeros(len(floor))
    tree = cKDTree(floor)
    views, truth, attitude, prior = {}, {}, {}, {}
    for robot in robots:
        for index, pose in enumerate(robot.path):
            frame = FrameId(robot.name, index)
            truth[frame] = Se2(*pose)
            attitude[frame] = Attitude(
                math.radians(robot.tilt_deg) + rng.normal() * wobble.tilt_rad,
                math.radians(robot.roll_deg) + rng.normal() * wobble.roll_rad,
                robot.height_m + rng.normal() * wobble.height_m,
            )
            prior[frame] = nominal(robot)
            foot = truth[frame] @ robot.base_from_foot
            near = np.array(tree.query_ball_point([foot.x_m, foot.y_m], reach))
            in_foot = foot.inverse().apply(floor[near])
            rays = rays_over_relief(attitude[frame], in_foot, tall[near])
            rays = rays * robot.focal_factor * (1 + robot.distortion * (rays**2).sum(1))[:, None]
            seen = (np.abs(rays) < HALF_VIEW).all(axis=1) & (rng.random(len(rays)) < detect)
            rays = rays[seen] + rng.normal(0, noise_px / FOCAL_PX, (seen.sum(), 2))
            order = np.argsort(near[seen])
            views[frame] = near[seen][order], rays[order]
    edges = []
    frames = list(views)
    centres = np.array(
        [floor[views[f][0]].mean(axis=0) if len(views[f][0]) else (1e9, 0) for f in frames]
    )
    pairs = sorted(cKDTree(centres).query_pairs(reach))
    mount = {robot.name: robot.base_from_foot for robot in robots}
    for i, j in pairs:
        a, b = frames[i], frames[j]
        chance = {"rng": rng, "noise_px": noise_px, "wrong": wrong, "min_common": min_common}
        edge = make_edge(a, b, views, truth, **chance)
        if edge is not None:
            edges.append(edge)
    if odometry:
        edges += odometry_edges(robots, truth, rng)
    component_of = components(frames, edges)
    reference = {}
    for frame in frames:
        reference.setdefault(component_of[frame], frame)
    poses = {
        f: truth[f]
        if f in reference.values()
        else truth[f] @ Se2(*(rng.normal(size=2) * start_sigma[0]), rng.normal() * start_sigma[1])
        for f in frames
    }
    cov = {f: np.eye(3) * 1e-4 for f in frames if f not in reference.values()}
    anchors = tuple(
        Anchor(r.name, 0, component_of[FrameId(r.name, 0)], FrameId(r.name, 0),
               poses[FrameId(r.name, 0)], cov.get(FrameId(r.name, 0)), 1)
        for r in robots
    )  # fmt: skip
    start = TeamEstimate(poses, component_of, cov, anchors, (), 0.0, 0)
    cameras = {name: BundleCamera(m, FOCAL_PX) for name, m in mount.items()}
    return World(start, edges, prior, dict.fromkeys(frames, prior_sigma), cameras, truth, attitude)


def rays_over_relief(attitude, in_foot, tall_m):
    """Rays to points above the floor: a camera at height h sees them as one at h - z would."""
    shrunk = in_foot * (attitude.height_m / (attitude.height_m - tall_m))[:, None]
    return rays_from_floor(attitude, shrunk)


def nominal(robot):
    """The attitude that the robot's file states."""

    def either(stated, true):
        return true if stated is None else stated

    return Attitude(
        math.radians(either(robot.file_tilt_deg, robot.tilt_deg)),
        math.radians(either(robot.file_roll_deg, robot.roll_deg)),
        either(robot.file_height_m, robot.height_m),
    )


def make_edge(a, b, views, truth, *, rng, noise_px, wrong, min_common):
    """The pair's correspondences, some of them wrong by a few pixels, if there are enough."""
    _, in_a, in_b = np.intersect1d(views[a][0], views[b][0], return_indices=True)
    if len(in_a) < min_common:
        return None
    mixed = rng.random(len(in_a)) < wrong
    if mixed.any():  # a neighbouring keypoint of b instead of the right one
        _, others = cKDTree(views[b][1]).query(views[b][1][in_b[mixed]], k=3)
        in_b = in_b.copy()
        in_b[mixed] = others[:, 2]
    sigma = np.full(len(in_a), noise_px / FOCAL_PX)
    pair = Correspondences(views[a][1][in_a], views[b][1][in_b], sigma, sigma)
    spread = np.diag([1e-6, 1e-6, 4e-7])
    jitter = rng.multivariate_normal(np.zeros(3), spread)
    measured = truth[a].inverse() @ truth[b] @ Se2(*jitter)
    return RelativePose(a, b, measured, spread, len(in_a), 0.1, pair)


def odometry_edges(robots, truth, rng):
    """Edges without pictures between neighbours in time."""
    edges, spread = [], np.diag([1e-4, 1e-4, 1e-4])
    for robot in robots:
        for index in range(len(robot.path) - 1):
            a, b = FrameId(robot.name, index), FrameId(robot.name, index + 1)
            jitter = rng.multivariate_normal(np.zeros(3), spread)
            edges.append(RelativePose(a, b, truth[a].inverse() @ truth[b] @ Se2(*jitter), spread))
    return edges


def components(frames, edges):
    """Component of each frame; the one of the first frame is 0."""
    parent = {frame: frame for frame in frames}

    def root(frame):
        while parent[frame] != frame:
            frame = parent[frame]
        return frame

    for edge in edges:
        a, b = sorted((root(edge.a), root(edge.b)), key=frames.index)
        parent[b] = a
    roots = list(dict.fromkeys(root(frame) for frame in frames))
    return {frame: roots.index(root(frame)) for frame in frames}


def ate_m(poses, truth, *, scale=False):
    """Root mean square position error after the best rigid (or similarity) alignment."""
    frames = sorted(truth)
    found = np.array([[poses[f].x_m, poses[f].y_m] for f in frames])
    true = np.array([[truth[f].x_m, truth[f].y_m] for f in frames])
    found, true = found - found.mean(axis=0), true - true.mean(axis=0)
    z, w = found @ [1, 1j], true @ [1, 1j]
    factor = np.vdot(z, w) / (np.vdot(z, z).real if scale else abs(np.vdot(z, w)))
    return float(np.sqrt(np.mean(np.abs(z * factor - w) ** 2)))


def nees(poses, covariance, truth):
    """Normalised squared error of every pose relative to the reference frame."""
    values = []
    for frame, spread in covariance.items():
        error = (truth[frame].inverse() @ poses[frame]).vector()
        values.append(float(error @ np.linalg.solve(spread, error)))
    return np.array(values)
