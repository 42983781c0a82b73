"""Guided refinement to a homography between the original images (paper §3, eq. 6).

The isometry of the overhead views, carried back to the original images, tells where each corner
of a should lie in b. The closest detected corner in a W x W window whose invariant differs by
little is its match; the matches give a better homography; W shrinks. The isometry cannot follow
the wobble of tilt, roll and height between the two pictures, the homography can.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from groundfuse.backend.option_checks import check_numbers
from groundfuse.frontend.arrays import Floats, Matrix, Points

NEIGHBOURHOOD = 0.08
"""No part of a picture is farther from its corners than this, in focal lengths."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RefineOptions:
    """How the window shrinks."""

    first_window: float = 0.05
    """W of the first round, in focal lengths: what the wobble may move a corner."""
    last_window_px: float = 6.0
    """W of the last round, pixels of b."""
    num_rounds: int = 6
    """Rounds of matching and fitting; W shrinks by the same factor in each."""
    max_difference: float = 0.5
    """Largest Euclidean distance of the invariants of two matched corners."""
    num_looked_at: int = 8
    """Corners in a window that are looked at, closest first."""
    min_matches: int = 12
    """Fewest matches that a homography is fitted to."""

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense (ValueError)."""
        check_numbers(self, may_be_inf=("max_difference",))


class Guided(NamedTuple):
    """A homography and its matches.

    Attributes:
        b_from_a: rays of b from rays of a.
        index_a: (n,) corners of a.
        index_b: (n,) their matches in b, none twice.
    """

    b_from_a: Matrix
    index_a: np.ndarray
    index_b: np.ndarray


def transferred(b_from_a: Matrix, rays_a: Points) -> Points:
    """Map rays (n, 2) through a homography; nan where they fall behind camera b."""
    mapped = rays_a @ b_from_a[:, :2].T + b_from_a[:, 2]
    # The sign of a homography is free; most corners are in front of both cameras.
    depth = mapped[:, 2] * (1.0 if np.median(mapped[:, 2]) > 0.0 else -1.0)
    sign = np.where(depth > 0.0, mapped[:, 2], np.nan)
    rays_b: Points = mapped[:, :2] / sign[:, None]
    return rays_b


def fitted_homography(rays_a: Points, rays_b: Points) -> Matrix:
    """Return the homography from a to b by normalised DLT (Hartley 1997).

    Raises:
        ValueError: fewer than four points.
    """
    if len(rays_a) < 4:
        raise ValueError(f"a homography needs 4 points, got {len(rays_a)}")
    scale_a, scale_b = _normalisation(rays_a), _normalisation(rays_b)
    a = rays_a @ scale_a[:2, :2].T + scale_a[:2, 2]
    b = rays_b @ scale_b[:2, :2].T + scale_b[:2, 2]
    from_a = np.column_stack([a, np.ones(len(a))])
    none = np.zeros_like(from_a)
    rows_u = np.hstack([from_a, none, -b[:, :1] * from_a])
    rows_v = np.hstack([none, from_a, -b[:, 1:] * from_a])
    rows = np.vstack([rows_u, rows_v])
    _, vectors = np.linalg.eigh(rows.T @ rows)
    homography: Matrix = np.linalg.inv(scale_b) @ vectors[:, 0].reshape(3, 3) @ scale_a
    return homography


def guided_matches(
    b_from_a: Matrix,
    rays: tuple[Points, Points],
    invariants: tuple[Floats, Floats],
    window: float,
    options: RefineOptions,
) -> Guided:
    """Match each corner of a to the closest like corner of b in its window, one to one.

    Args:
        b_from_a: where to look.
        rays: (n, 2) and (m, 2) corners of a and b.
        invariants: (n, 6) and (m, 6) theirs.
        window: W as a difference of rays.
        options: see there.
    """
    expected = transferred(b_from_a, rays[0])
    lookable = np.flatnonzero(np.isfinite(expected).all(axis=1))
    count = min(options.num_looked_at, len(rays[1]))
    distance, near = KDTree(rays[1]).query(
        expected[lookable], k=count, p=np.inf, distance_upper_bound=window / 2.0
    )
    distance, near = np.reshape(distance, (-1, count)), np.reshape(near, (-1, count))
    found = np.isfinite(distance)
    near = np.where(found, near, 0)
    difference = invariants[0][lookable][:, None] - invariants[1][near]
    alike = found & (np.linalg.norm(difference, axis=2) < options.max_difference)
    which = np.flatnonzero(alike.any(axis=1))
    closest = np.argmax(alike[which], axis=1)
    index_a, index_b = lookable[which], near[which, closest]
    order = np.argsort(distance[which, closest], kind="stable")
    _, first = np.unique(index_b[order], return_index=True)
    kept = np.sort(order[first])
    return Guided(b_from_a, index_a[kept], index_b[kept])


def refined_homography(
    start: Matrix,
    rays: tuple[Points, Points],
    invariants: tuple[Floats, Floats],
    focal_px: float,
    options: RefineOptions | None = None,
) -> Guided:
    """Alternate guided matching and fitting while the window shrinks (paper §3).

    Args:
        start: rays of b from rays of a, from the isometry (eq. 6).
        rays: (n, 2) and (m, 2) corners of a and b.
        invariants: (n, 6) and (m, 6) theirs.
        focal_px: of camera b.
        options: see there.

    Returns the last homography and its matches; fewer than `min_matches` mean that it failed.
    """
    options = options or RefineOptions()
    last = options.last_window_px / focal_px
    windows = np.geomspace(max(options.first_window, last), last, options.num_rounds)
    homography = start
    for window in windows:
        found = guided_matches(homography, rays, invariants, float(window), options)
        if len(found.index_a) < options.min_matches:
            return found
        rays_a, rays_b = rays[0][found.index_a], rays[1][found.index_b]
        homography = fitted_homography(rays_a, rays_b)
    return guided_matches(homography, rays, invariants, last, options)


def num_in_common(b_from_a: Matrix, rays_a: Points, rays_b: Points) -> int:
    """Count the corners of a that fall where b has corners at all."""
    expected = transferred(b_from_a, rays_a)
    expected = expected[np.isfinite(expected).all(axis=1)]
    distance, _ = KDTree(rays_b).query(expected, distance_upper_bound=NEIGHBOURHOOD)
    return int(np.isfinite(distance).sum())


def _normalisation(points: Points) -> Matrix:
    """Similarity that moves points to mean 0 and root mean square radius sqrt(2)."""
    mean = points.mean(axis=0)
    spread = np.sqrt(((points - mean) ** 2).sum(axis=1).mean() / 2.0)
    scale = 1.0 / max(float(spread), 1e-12)
    matrix: Matrix = np.array(
        [[scale, 0.0, -scale * mean[0]], [0.0, scale, -scale * mean[1]], [0.0, 0.0, 1.0]]
    )
    return matrix
