"""What the bundle knows besides sightings: wobble, mounts, odometry, gauges; numpy only."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from groundfuse.backend.bundle_model import State
from groundfuse.backend.bundle_plan import BLOCK
from groundfuse.backend.bundle_tracks import Integers
from groundfuse.backend.measurement import Se2

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SCALE_GAUGE_SIGMA = 1e-6
"""The robots' mean height correction is 0 by definition (their common part is the map's scale)."""


@dataclass(frozen=True, slots=True, eq=False)
class Priors:
    """What is known before the pictures.

    Attributes:
        attitude: (frames, 3) tilt, roll, height of the files.
        sigma: (frames, 3) their wobble.
        shared_sigma: (6,) of the robots' unknowns.
        robot_of: (frames,) robot of each frame.
        fixed: (frames,) whether a frame is the reference of its component.
        group_of: (robots,) robots of the same number share a scale.
        free_mount: (robots, 3) whether offsets of tilt, roll, height are unknowns.
        free_lens: (robots, 2) whether focal length and distortion are unknowns.
        relief: standard deviation of the floor points' heights as a fraction of the height of the
            first camera that sees them (so that no scale is better than another); 0 if flat.
    """

    attitude: Array
    sigma: Array
    shared_sigma: Array
    robot_of: Integers
    fixed: Mask
    group_of: Integers
    free_mount: Mask
    free_lens: Mask
    relief: float

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return len(self.attitude)

    @property
    def num_robots(self) -> int:
        """Number of robots."""
        return len(self.group_of)

    @property
    def num_nodes(self) -> int:
        """Frames and robots: the nodes of the reduced system."""
        return self.num_frames + self.num_robots


@dataclass(frozen=True, slots=True, eq=False)
class Between:
    """Relative poses without usable correspondences, foot to foot: odometry, poorly seen pairs.

    Attributes:
        i: (n,) frame a.
        j: (n,) frame b.
        pose: (n, 3) of foot b in foot a.
        whitener: (n, 3, 3) W with W'W the information, tangent at b.
    """

    i: Integers
    j: Integers
    pose: Array
    whitener: Array


@dataclass(frozen=True, slots=True, eq=False)
class Pattern:
    """Rows and columns of all blocks of the reduced system, and where each kind stands.

    The order is: diagonal, pairs of frames, frames with robots, robots with robots.

    Attributes:
        rows: (n,) block row.
        columns: (n,) block column.
        pair_at: place of each pair of frames that share floor points.
        between_at: place of each relative pose.
        border_at: first block of frames with robots (frames x robots).
        shared_at: first block of robots with robots (upper triangle).
    """

    rows: Integers
    columns: Integers
    pair_at: Integers
    between_at: Integers
    border_at: int
    shared_at: int


def pattern_of(pair_key: Integers, between: Between, priors: Priors) -> Pattern:
    """List the blocks; `pair_key` is i * frames + j (i < j) of frames that share points."""
    num_frames, num_robots = priors.num_frames, priors.num_robots
    low, high = np.minimum(between.i, between.j), np.maximum(between.i, between.j)
    between_key = low * num_frames + high
    keys = np.union1d(pair_key, between_key)
    nodes = np.arange(priors.num_nodes)
    frames, robots = nodes[:num_frames], nodes[num_frames:]
    first, second = np.triu_indices(num_robots, 1)
    border_at = len(nodes) + len(keys)
    return Pattern(
        np.concatenate([nodes, keys // num_frames, np.repeat(frames, num_robots), robots[first]]),
        np.concatenate([nodes, keys % num_frames, np.tile(robots, num_frames), robots[second]]),
        len(nodes) + np.searchsorted(keys, pair_key),
        len(nodes) + np.searchsorted(keys, between_key),
        border_at,
        border_at + num_frames * num_robots,
    )


def prior_residual(state: State, priors: Priors) -> Array:
    """Whitened prior minus attitude (frames, 3)."""
    offset = state.shared[priors.robot_of, :3] * _by_offset(priors)
    residual: Array = (priors.attitude - state.attitude) / priors.sigma + offset
    return residual


def _by_offset(priors: Priors) -> Array:
    """Derivative (frames, 3) of the whitened residual by the robot's offsets."""
    by_offset: Array = offset_units(priors) / priors.sigma * priors.free_mount[priors.robot_of]
    return by_offset


def offset_units(priors: Priors) -> Array:
    """What a mount's offset of 1 adds to each attitude (frames, 3): a height's is a fraction."""
    units = np.ones((priors.num_frames, 3))
    units[:, 2] = priors.attitude[:, 2]
    return units


def between_residual(state: State, between: Between) -> Array:
    """Whitened errors (n, 3) of relative poses, tangent at b."""
    errors, _ = _between_errors(state, between)
    whitened: Array = (between.whitener @ errors[:, :, None])[:, :, 0]
    return whitened


def _between_errors(state: State, between: Between) -> tuple[Array, Array]:
    """Errors b_from_a @ measured (n, 3), and adjoints (n, 3, 3) of b_from_a."""
    errors, adjoints = np.zeros((len(between.i), 3)), np.zeros((len(between.i), 3, 3))
    for count, (i, j) in enumerate(zip(between.i.tolist(), between.j.tolist(), strict=True)):
        b_from_a = Se2(*state.pose[j]).inverse() @ Se2(*state.pose[i])
        errors[count] = (b_from_a @ Se2(*between.pose[count])).vector()
        adjoints[count] = b_from_a.adjoint()
    return errors, adjoints


def prior_cost(state: State, priors: Priors, between: Between) -> float:
    """Sum of squares of everything but the sightings and the relief."""
    wobble, odometry = prior_residual(state, priors), between_residual(state, between)
    common = np.bincount(priors.group_of, state.shared[:, 2]) / SCALE_GAUGE_SIGMA
    parts = (wobble, odometry, common, state.shared / priors.shared_sigma)
    return float(sum(np.sum(part**2) for part in parts))


def prior_blocks(blocks: Array, priors: Priors, pattern: Pattern) -> None:
    """Add wobble, the robots' own priors and the gauges to the reduced system, in place."""
    num_frames, num_robots = priors.num_frames, priors.num_robots
    inverse, by_offset = 1.0 / priors.sigma, _by_offset(priors)
    frames, axes = np.arange(num_frames)[:, None], np.arange(3)
    robots = num_frames + priors.robot_of[:, None]
    blocks[frames, axes + 3, axes + 3] += inverse**2
    border = pattern.border_at + np.arange(num_frames) * num_robots + priors.robot_of
    blocks[border[:, None], axes + 3, axes] -= inverse * by_offset
    np.add.at(blocks, (robots, axes, axes), by_offset**2)
    nodes, all_axes = num_frames + np.arange(num_robots)[:, None], np.arange(BLOCK)
    blocks[nodes, all_axes, all_axes] += priors.shared_sigma**-2
    fixed = np.flatnonzero(priors.fixed)[:, None]
    blocks[fixed, axes, axes] += 1.0  # the sightings' part is zero there: a step of zero
    blocks[nodes[:, 0], 2, 2] += SCALE_GAUGE_SIGMA**-2
    first, second = np.triu_indices(num_robots, 1)
    same = np.flatnonzero(priors.group_of[first] == priors.group_of[second])
    blocks[pattern.shared_at + same, 2, 2] += SCALE_GAUGE_SIGMA**-2


def prior_right(state: State, priors: Priors) -> Array:
    """Right-hand side (frames + robots, 6) of the same."""
    right = np.zeros((priors.num_nodes, BLOCK))
    residual = prior_residual(state, priors)
    right[: priors.num_frames, 3:] = residual / priors.sigma
    own = right[priors.num_frames :]
    np.add.at(own[:, :3], priors.robot_of, -residual * _by_offset(priors))
    own -= state.shared / priors.shared_sigma**2
    common = np.bincount(priors.group_of, state.shared[:, 2])[priors.group_of]
    own[:, 2] -= common / SCALE_GAUGE_SIGMA**2
    return right


def between_blocks(
    blocks: Array, state: State, between: Between, priors: Priors, pattern: Pattern
) -> None:
    """Add relative poses without correspondences to the reduced system, in place."""
    by_a, by_b = _by_ends(state, between, priors)
    for node, by_node in ((between.i, by_a), (between.j, by_b)):
        np.add.at(blocks[:, :3, :3], node, by_node.transpose(0, 2, 1) @ by_node)
    cross = by_a.transpose(0, 2, 1) @ by_b
    in_order = (between.i < between.j)[:, None, None]
    cross = np.where(in_order, cross, cross.transpose(0, 2, 1))
    np.add.at(blocks[:, :3, :3], pattern.between_at, cross)


def between_right(state: State, between: Between, priors: Priors) -> Array:
    """Right-hand side (frames + robots, 6) of the same."""
    right = np.zeros((priors.num_nodes, BLOCK))
    errors = between_residual(state, between)[:, :, None]
    by_a, by_b = _by_ends(state, between, priors)
    for node, by_node in ((between.i, by_a), (between.j, by_b)):
        np.add.at(right[:, :3], node, -(by_node.transpose(0, 2, 1) @ errors)[:, :, 0])
    return right


def _by_ends(state: State, between: Between, priors: Priors) -> tuple[Array, Array]:
    """Derivatives (n, 3, 3) of the whitened errors by right steps of a and of b."""
    errors, adjoints = _between_errors(state, between)
    by_left = np.zeros_like(adjoints)  # of the error's coordinates by a step on its left
    by_left[:, [0, 1, 2], [0, 1, 2]] = 1.0
    by_left[:, 0, 2], by_left[:, 1, 2] = -errors[:, 1], errors[:, 0]
    by_left = between.whitener @ by_left
    by_a = by_left @ adjoints * ~priors.fixed[between.i, None, None]
    return by_a, -by_left * ~priors.fixed[between.j, None, None]
