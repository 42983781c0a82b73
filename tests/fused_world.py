"""Fused teams without any picture: known poses, edges made from them, and the real graphs."""

import itertools
from pathlib import Path

import numpy as np
from painted_team import Member, arc, make_camera

from groundfuse.backend.bundle_estimate import BundleEstimate
from groundfuse.backend.graph import robot_estimate
from groundfuse.backend.measurement import (
    IDENTITY,
    Correspondences,
    FrameId,
    Reason,
    Rejected,
    RelativePose,
    Se2,
)
from groundfuse.backend.team import fuse
from groundfuse.tools.front_end import FrontEndResult, Reused
from groundfuse.tools.pipeline import Fused
from groundfuse.tools.robot import Frame, Odometry, Robot
from groundfuse.tools.team_graphs import odometry_edges

SIGMA_M, SIGMA_RAD = 0.002, 0.001
A = [FrameId("A", k) for k in range(6)]
B = [FrameId("B", k) for k in range(4)]


def world():
    """True poses of two robots on arcs."""
    poses = dict(zip(A, arc(len(A), Se2(1.0, -2.0, 0.4)), strict=True))
    return poses | dict(zip(B, arc(len(B), Se2(1.3, -1.8, 1.1)), strict=True))


def edge(truth, a, b, error=IDENTITY, sigma=1.0, inliers=50):
    """The true motion, off by `error` in the tangent of b; correspondences are placeholders."""
    covariance = np.diag([SIGMA_M, SIGMA_M * 1.5, SIGMA_RAD]) ** 2 * sigma**2
    none = Correspondences(*(np.zeros((0, 2)),) * 2, *(np.zeros(0),) * 2)
    motion = truth[a].inverse() @ truth[b] @ error
    return RelativePose(a, b, motion, covariance, inliers, 0.25, none)


def chain(truth, frames, error=IDENTITY):
    return [edge(truth, a, b, error) for a, b in itertools.pairwise(frames)]


def rejected(a, b, reason=Reason.FEW_INLIERS, value=7.0, limit=12.0):
    return Rejected(a, b, reason, value, limit)


def robots_of(frames, truth=None, odometry=None, time_step_s=0.5):
    """Robots in the order of the frames; `odometry` gives a pose per frame that has one."""
    odometry = odometry or {}
    names = list(dict.fromkeys(f.robot for f in frames))
    robots = []
    for name in names:
        camera = make_camera(Member(()))
        made = tuple(
            Frame(
                f,
                Path(f"{name}/images/img_{f.index:02d}.png"),
                10.0 + time_step_s * f.index,
                camera.mount.attitude,
                camera.mount.sigma,
                odometry.get(f),
            )
            for f in frames
            if f.robot == name
        )
        known = None
        if truth is not None:
            known = {f.id: truth[f.id] for f in made if f.id in truth}
        robots.append(Robot(name, camera, made, known))
    return tuple(robots)


def odometry(pose, sigma_m=0.01, sigma_rad=0.005):
    return Odometry(pose, Se2(sigma_m, sigma_m, sigma_rad))


def fused_of(robots, edges, turned=(), repetition=0.1, bundled=None):
    """What the main job makes of edges, without a bundle."""
    frames = [f.id for robot in robots for f in robot.frames]
    repeats = repetition if isinstance(repetition, dict) else dict.fromkeys(frames, repetition)
    second = {f: repeats.get(f, 0.0) for f in frames}
    reused = Reused(0, len(frames), 0, len(edges) + len(turned))
    front_end = FrontEndResult(tuple(edges), tuple(turned), second, {}, reused, 0, b"")
    every = (*edges, *odometry_edges(robots))
    alone = {r.name: robot_estimate(r.name, frames, every) for r in robots}
    return Fused(robots, robots, front_end, every, alone, fuse(frames, every), bundled)


def bundle_of(team, *, poses=None, rejected=(), attitude=None, sigma=None, findings=()):
    """A bundle that moved the team to `poses` and turned pairs down."""
    from dataclasses import replace

    moved = team if poses is None else replace(team, team_from_base=dict(poses))
    return BundleEstimate(
        team=moved,
        attitude=attitude or {},
        attitude_sigma=sigma or {},
        mounts=(),
        scale_sigma=0.007,
        residual_px=0.123,
        noise_factor=1.0,
        num_points=42,
        num_observations=100,
        num_links=58,
        num_links_cut=2,
        rejected=tuple(rejected),
        findings=tuple(findings),
    )
