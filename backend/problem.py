"""A planar pose graph as arrays: residuals, derivatives, cost, connected parts; numpy and scipy.

The error of an edge is the motion a_from_b^-1 (pose_a^-1 pose_b). Its residual is the logarithm of
that, as in gtsam's BetweenFactorPose2, or its plain x, y, theta, as in g2o's EDGE_SE2, or x, y and
the chord 2 sin(theta / 2), as in SE-Sync; chi2 is the sum of residual' information residual (twice
gtsam's `error`, g2o's chi2, twice SE-Sync's objective).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from groundfuse.backend import planar
from groundfuse.backend.measurement import FrameId, RelativePose

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


class Metric(StrEnum):
    """What the residual of an edge is: its error's logarithm, x y theta, or x y chord."""

    LOG = "gtsam"
    PLAIN = "g2o"
    CHORD = "se-sync"


class Linear(NamedTuple):
    """Residuals (m, 3) and their derivatives (m, 3, 3) by right perturbations of both poses."""

    residual: Array
    by_a: Array
    by_b: Array


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Edges between poses 0 .. num_poses - 1.

    Attributes:
        num_poses: number of poses.
        a: (m,) reference pose of each edge.
        b: (m,) measured pose of each edge.
        a_from_b: (m, 3) measured x m, y m, theta rad.
        information: (m, 3, 3) inverse covariances, order x y theta.
        metric: what the residual of an edge is.
    """

    num_poses: int
    a: Indices
    b: Indices
    a_from_b: Array
    information: Array
    metric: Metric = Metric.LOG

    def __len__(self) -> int:
        return len(self.a)

    def of(self, chosen: NDArray[np.bool_] | Indices) -> Self:
        """Return the problem with only the chosen edges (mask or indices), all poses kept."""
        return replace(
            self,
            a=self.a[chosen],
            b=self.b[chosen],
            a_from_b=self.a_from_b[chosen],
            information=self.information[chosen],
        )

    def weighted(self, weights: Array) -> Self:
        """Return the problem with every information multiplied by its edge's weight."""
        return replace(self, information=self.information * weights[:, None, None])


def from_edges(index_of: Mapping[FrameId, int], edges: Sequence[RelativePose]) -> Problem:
    """Return the arrays of a list of edges between frames numbered by `index_of`."""
    covariance = np.array([e.covariance for e in edges]).reshape(-1, 3, 3)
    return Problem(
        num_poses=len(index_of),
        a=np.array([index_of[e.a] for e in edges], dtype=np.int64),
        b=np.array([index_of[e.b] for e in edges], dtype=np.int64),
        a_from_b=planar.stacked([e.a_from_b for e in edges]),
        information=planar.inverted(covariance),
    )


def residuals(problem: Problem, poses: Array) -> Array:
    """Return (m, 3) residuals at poses (n, 3)."""
    predicted = planar.between(poses[problem.a], poses[problem.b])
    return _residual(problem, predicted)


def _residual(problem: Problem, predicted: Array) -> Array:
    error = planar.between(problem.a_from_b, predicted)
    match problem.metric:
        case Metric.LOG:
            return planar.log(error)
        case Metric.PLAIN:
            return error
        case Metric.CHORD:
            error[:, 2] = 2.0 * np.sin(error[:, 2] / 2.0)
            return error


def _by_b(problem: Problem, residual: Array) -> Array:
    """Return the derivative of the residual by a right perturbation of pose b."""
    match problem.metric:
        case Metric.LOG:
            return planar.by_right(residual)
        case Metric.PLAIN:
            return planar.turn(residual)
        case Metric.CHORD:
            half = np.arcsin(np.clip(residual[:, 2] / 2.0, -1.0, 1.0))
            by_b = planar.turn(np.column_stack([residual[:, :2], 2.0 * half]))
            by_b[:, 2, 2] = np.cos(half)
            return by_b


def chi2_per_edge(problem: Problem, poses: Array) -> Array:
    """Return (m,) squared Mahalanobis residuals."""
    residual = residuals(problem, poses)
    squared: Array = np.einsum("ni,nij,nj->n", residual, problem.information, residual)
    return squared


def chi2(problem: Problem, poses: Array) -> float:
    """Return the sum of squared Mahalanobis residuals."""
    return float(chi2_per_edge(problem, poses).sum())


def linearised(problem: Problem, poses: Array) -> Linear:
    """Return residuals and derivatives at poses (n, 3)."""
    predicted = planar.between(poses[problem.a], poses[problem.b])
    residual = _residual(problem, predicted)
    by_b = _by_b(problem, residual)
    return Linear(residual, -by_b @ planar.adjoint(planar.inverse(predicted)), by_b)


def components(problem: Problem) -> Indices:
    """Return (n,) the connected part of every pose, numbered by first appearance."""
    links = sparse.coo_array(
        (np.ones(len(problem)), (problem.a, problem.b)), shape=(problem.num_poses,) * 2
    )
    _, labels = connected_components(links, directed=False)
    _, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    numbered: Indices = rank[inverse]
    return numbered
