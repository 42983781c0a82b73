"""How far trajectories drift: the paper's closing error, and errors against ground truth; numpy.

Errors against truth are taken per component, because components have frames of their own.
"""

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from groundfuse.backend import planar
from groundfuse.backend.measurement import FrameId, RelativePose, Se2
from groundfuse.backend.problem import Array

Poses = Mapping[FrameId, Se2]

MAX_FRAMES = 1500


class Closing(NamedTuple):
    """The closing error of section 5.1: the last view measured directly from the first.

    Attributes:
        first: frame at the beginning.
        last: frame that was also measured from it.
        error_m: distance between the two positions of `last`, d = |r1 - r2|.
        error_rad: difference of its two headings.
        path_m: length of the path from first to last.
        percent: 100 error_m / path_m.
    """

    first: FrameId
    last: FrameId
    error_m: float
    error_rad: float
    path_m: float
    percent: float


class Accuracy(NamedTuple):
    """Errors against ground truth.

    Attributes:
        num_frames: frames compared.
        path_m: length of the true path (of all robots together).
        ate_m: root mean square position error after the best rigid alignment.
        ate_percent: 100 ate_m / path_m.
        heading_rad: root mean square heading error after the same alignment.
        ate_scaled_m: root mean square position error after the best similarity alignment.
        scale: of that alignment: truth is `scale` times the estimate.
        rpe_m_per_m: root mean square over neighbours in time of relative position error, over the
            root mean square of their true distance.
        rpe_rad_per_m: the same for the heading.
    """

    num_frames: int
    path_m: float
    ate_m: float
    ate_percent: float
    heading_rad: float
    ate_scaled_m: float
    scale: float
    rpe_m_per_m: float
    rpe_rad_per_m: float


class BetweenRobots(NamedTuple):
    """Relative pose errors over all pairs of frames of different robots.

    Attributes:
        num_pairs: pairs compared.
        rms_m: root mean square of the relative position error, seen from the first frame.
        rms_rad: root mean square of the relative heading error.
    """

    num_pairs: int
    rms_m: float
    rms_rad: float


def path_length_m(poses: Poses) -> float:
    """Return the distance driven, frame by frame, summed over robots."""
    order = sorted(poses)
    steps = pairwise(order)
    return sum(_distance_m(poses[a], poses[b]) for a, b in steps if a.robot == b.robot)


def _distance_m(one: Se2, two: Se2) -> float:
    return math.hypot(one.x_m - two.x_m, one.y_m - two.y_m)


def closing(poses: Poses, edges: Sequence[RelativePose], robot: str) -> Closing | None:
    """Return the closing error over the longest loop measured directly, or None without any.

    Args:
        poses: estimated poses in one frame; edges to other frames are ignored.
        edges: measured pairs; of those within `robot`, the one whose frames are furthest apart in
            time is taken: first against last where that pair was measured.
        robot: whose loop.
    """
    loops = [
        e if e.a < e.b else e.reversed()
        for e in edges
        if e.a.robot == e.b.robot == robot and e.a in poses and e.b in poses
    ]
    loops = [e for e in loops if e.b.index - e.a.index > 1]
    if not loops:
        return None
    widest = max(loops, key=lambda e: (e.b.index - e.a.index, -e.a.index))
    return closing_of(poses, widest)


def closing_of(poses: Poses, edge: RelativePose) -> Closing:
    """Return the closing error over one measured pair a, b of the same robot, a before b."""
    predicted = poses[edge.a].inverse() @ poses[edge.b]
    inner = {f: p for f, p in poses.items() if f.robot == edge.a.robot and edge.a <= f <= edge.b}
    path_m = path_length_m(inner)
    error_m = _distance_m(predicted, edge.a_from_b)
    error_rad = abs((edge.a_from_b.inverse() @ predicted).theta_rad)
    percent = 100.0 * error_m / path_m if path_m > 0.0 else math.inf
    return Closing(edge.a, edge.b, error_m, error_rad, path_m, percent)


def accuracy(poses: Poses, truth: Poses) -> Accuracy | None:
    """Compare poses of one component with the truth; None with fewer than two common frames."""
    common = sorted(set(poses) & set(truth))
    if len(common) < 2:
        return None
    estimated, true = (planar.stacked([p[f] for f in common]) for p in (poses, truth))
    turn_rad, _ = _alignment(estimated, true)
    rigid, similar = _aligned(estimated, true, scaled=False), _aligned(estimated, true, scaled=True)
    scale = _alignment(estimated, true)[1]
    heading = planar.wrapped(estimated[:, 2] + turn_rad - true[:, 2])
    path_m = path_length_m({f: truth[f] for f in common})
    ate_m = _rms(rigid - true[:, :2])
    rpe_m, rpe_rad = _per_metre(common, estimated, true)
    return Accuracy(
        num_frames=len(common),
        path_m=path_m,
        ate_m=ate_m,
        ate_percent=100.0 * ate_m / path_m if path_m > 0.0 else math.inf,
        heading_rad=_rms(heading[:, None]),
        ate_scaled_m=_rms(similar - true[:, :2]),
        scale=scale,
        rpe_m_per_m=rpe_m,
        rpe_rad_per_m=rpe_rad,
    )


def _rms(vectors: Array) -> float:
    """Return the root mean square length of the rows."""
    return float(np.sqrt((vectors**2).sum(axis=1).mean())) if len(vectors) else 0.0


def _alignment(estimated: Array, true: Array) -> tuple[float, float]:
    """Return turn and scale that best take centred estimated positions to true ones (Umeyama)."""
    e = estimated[:, :2] - estimated[:, :2].mean(axis=0)
    t = true[:, :2] - true[:, :2].mean(axis=0)
    inner = complex(np.sum((e[:, 0] - 1j * e[:, 1]) * (t[:, 0] + 1j * t[:, 1])))
    spread = float((e**2).sum())
    return math.atan2(inner.imag, inner.real), abs(inner) / spread if spread > 0.0 else 1.0


def _aligned(estimated: Array, true: Array, *, scaled: bool) -> Array:
    turn_rad, scale = _alignment(estimated, true)
    centred = estimated[:, :2] - estimated[:, :2].mean(axis=0)
    turned = planar.rotated(centred, np.full(len(centred), turn_rad))
    aligned: Array = turned * (scale if scaled else 1.0) + true[:, :2].mean(axis=0)
    return aligned


def _per_metre(common: Sequence[FrameId], estimated: Array, true: Array) -> tuple[float, float]:
    """Return relative errors of neighbours in time, over the true distance between them."""
    neighbours = [k for k in range(len(common) - 1) if common[k].robot == common[k + 1].robot]
    low, high = np.array(neighbours, dtype=np.int64), np.array(neighbours, dtype=np.int64) + 1
    if not neighbours:
        return 0.0, 0.0
    step = planar.between(true[low], true[high])
    error = planar.between(step, planar.between(estimated[low], estimated[high]))
    distance_m = _rms(step[:, :2])
    if distance_m == 0.0:
        return math.inf, math.inf
    return _rms(error[:, :2]) / distance_m, _rms(error[:, 2:]) / distance_m


def between_robots(poses: Poses, truth: Poses) -> BetweenRobots | None:
    """Compare relative poses of frames of different robots in one component; None without any.

    This is the error of the anchors as it shows in the map. Of more than MAX_FRAMES frames every
    k-th is taken.
    """
    common = sorted(set(poses) & set(truth))
    common = common[:: -(-len(common) // MAX_FRAMES) or 1]
    names = np.array([f.robot for f in common])
    low, high = np.triu_indices(len(common), 1)
    apart = names[low] != names[high] if common else np.zeros(0, dtype=bool)
    if not apart.any():
        return None
    low, high = low[apart], high[apart]
    estimated, true = (planar.stacked([p[f] for f in common]) for p in (poses, truth))
    found, wanted = (
        planar.between(estimated[low], estimated[high]),
        planar.between(true[low], true[high]),
    )
    turn = planar.wrapped(found[:, 2] - wanted[:, 2])
    return BetweenRobots(len(low), _rms(found[:, :2] - wanted[:, :2]), _rms(turn[:, None]))
