"""The default matcher: nearest neighbours of overhead features, and the motion most agree on."""

from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from groundfuse.backend.measurement import Correspondences, Reason
from groundfuse.backend.option_checks import check_numbers
from groundfuse.frontend.candidates_compiled import of_like_size
from groundfuse.frontend.consensus import (
    Candidates,
    ConsensusOptions,
    Gate,
    Mode,
    find_modes,
)
from groundfuse.frontend.features import Features
from groundfuse.frontend.matches import Matches, Miss
from groundfuse.frontend.nearest_compiled import fewest_apart, most_similar


@dataclass(frozen=True, slots=True, kw_only=True)
class MatchOptions:
    """Options of matching.

    Attributes:
        consensus: the vote.
        num_neighbours: candidates per feature, without ratio test.
        min_features: fewest features of a frame.
        min_votes: fewest features that agree on the motion.
        tolerance_px: part of the vote's tolerance that the features need, overhead pixels.
        tolerance_sigmas: part of the vote's tolerance that the wobble needs, in its deviations.
        scale_sigmas: range of relative scales searched, where the model is a similarity.
        homography_tolerance_px: tolerance of the homography, overhead pixels below the camera.
        max_log_size: largest difference of two features' log size.
        rigid_tolerance_heights: the model is an isometry while the tolerance is below this many
            camera heights, and a similarity beyond.
    """

    consensus: ConsensusOptions = field(default_factory=ConsensusOptions)
    num_neighbours: int = 5
    min_features: int = 20
    min_votes: int = 12
    tolerance_px: float = 2.0
    tolerance_sigmas: float = 1.2
    scale_sigmas: float = 2.5
    homography_tolerance_px: float = 2.0
    max_log_size: float = 0.5
    rigid_tolerance_heights: float = 0.06

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense (ValueError)."""
        check_numbers(
            self,
            may_be_zero=("tolerance_sigmas", "scale_sigmas", "rigid_tolerance_heights"),
            may_be_inf=("max_log_size", "rigid_tolerance_heights"),
        )


def match(
    a: Features,
    b: Features,
    options: MatchOptions,
    rng: np.random.Generator,
    gate: Gate | None = None,
) -> Matches | Miss:
    """Return what two frames have in common."""
    fewest = min(len(a), len(b))
    if fewest < options.min_features:
        return Miss(Reason.FEW_FEATURES, float(fewest), float(options.min_features))
    found = candidates(a, b, options)
    tolerance_m, max_log_scale = _model(a, b, options)
    modes = find_modes(found, tolerance_m, max_log_scale, options.consensus, rng, gate)
    if max_log_scale > 0.0:
        modes = [found_by_homography(a, b, found, mode, options) for mode in modes]
        modes.sort(key=lambda mode: -mode.votes)
    votes = modes[0].votes if modes else 0
    if votes < options.min_votes:
        return Miss(Reason.FEW_INLIERS, float(votes), float(options.min_votes))
    best, rivals = modes[0], modes[1:]
    points = correspondences(a, b, found.index_a[best.voters], found.index_b[best.voters])
    return Matches(points, best.a_from_b, rivals[0].votes / votes if rivals else 0.0)


def found_by_homography(
    a: Features, b: Features, found: Candidates, mode: Mode, options: MatchOptions
) -> Mode:
    """Keep the voters that one homography explains: the model where attitudes wander widely."""
    voters = np.flatnonzero(mode.voters)
    if len(voters) < options.min_votes:
        return mode._replace(votes=0)
    rays_a, rays_b = a.rays[found.index_a[voters]], b.rays[found.index_b[voters]]
    tolerance = options.homography_tolerance_px * a.grid.m_per_px / a.height_m
    _, agrees = cv2.findHomography(rays_b, rays_a, cv2.USAC_ACCURATE, tolerance, maxIters=5000)
    if agrees is None:
        return mode._replace(votes=0)
    kept = np.zeros_like(mode.voters)
    kept[voters[agrees.ravel() > 0]] = True
    return mode._replace(voters=kept, votes=int(kept.sum()))


def _model(a: Features, b: Features, options: MatchOptions) -> tuple[float, float]:
    """Tolerance of the vote (m) and range of log scales; 0 for an isometry."""
    pixel = options.tolerance_px * max(a.grid.m_per_px, b.grid.m_per_px)
    height_m = min(a.height_m, b.height_m)
    rigid = float(np.hypot(pixel, options.tolerance_sigmas * np.hypot(a.wobble_m, b.wobble_m)))
    if rigid < options.rigid_tolerance_heights * height_m:
        return rigid, 0.0
    wobble = np.hypot(a.wobble_scaled_m, b.wobble_scaled_m)
    stretched = float(np.hypot(pixel, options.tolerance_sigmas * wobble))
    return stretched, options.scale_sigmas * float(np.hypot(a.log_scale, b.log_scale))


def candidates(a: Features, b: Features, options: MatchOptions) -> Candidates:
    """Return the nearest features of b for every feature of a."""
    count = min(options.num_neighbours, len(b))
    nearest = np.empty((len(a), count), dtype=np.int64)
    _find_nearest(a.descriptors, b.descriptors, nearest)
    sizes = a.log_size, b.log_size
    index_a, index_b, rank = of_like_size(nearest, *sizes, options.max_log_size)
    turn_rad = a.angle_rad[index_a] - b.angle_rad[index_b]
    places = a.floor_m.take(index_a, axis=0), b.floor_m.take(index_b, axis=0)
    return Candidates(*places, index_a, index_b, rank, turn_rad)


def _find_nearest(a: np.ndarray[Any, Any], b: np.ndarray[Any, Any], nearest: np.ndarray) -> None:
    """Write the rows of b at the least Euclidean or Hamming distance from each row of a."""
    if a.dtype == np.uint8:
        fewest_apart(a.view(np.uint64), np.ascontiguousarray(b.view(np.uint64).T), nearest)
    else:
        most_similar(a @ b.T, nearest)


def correspondences(
    a: Features, b: Features, index_a: np.ndarray, index_b: np.ndarray
) -> Correspondences:
    """Return the rays of matched features."""
    return Correspondences(a.rays[index_a], b.rays[index_b], a.sigma[index_a], b.sigma[index_b])
