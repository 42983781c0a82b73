"""The paper's matcher (§2 to §4): corners, invariants, segments, homography, closed form.

It is kept as the paper has it where the text is clear. Where it is not, or where the print fails on
real input, see `corners.py` (one scale on the floor), `invariants.py` (mu and t0), `segments.py`
(votes) and `decomposition.py` (errata).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from groundfuse.backend.measurement import Attitude, Correspondences, Reason
from groundfuse.backend.option_checks import check_numbers
from groundfuse.frontend.arrays import Floats, Image, Picture32, Points
from groundfuse.frontend.camera import Camera
from groundfuse.frontend.corners import CornerOptions, find_corners
from groundfuse.frontend.decomposition import DecompositionOptions, decompose, floor_homography
from groundfuse.frontend.invariants import InvariantOptions, invariants
from groundfuse.frontend.matches import Matches, Miss
from groundfuse.frontend.overhead import floor_from_rays
from groundfuse.frontend.overhead_view import OverheadOptions, overhead_grid, overhead_view
from groundfuse.frontend.refine import Guided, RefineOptions, num_in_common, refined_homography
from groundfuse.frontend.segments import (
    Scene,
    SegmentOptions,
    SegmentView,
    matched_segments,
    nearest_candidates,
    voted,
)

LEAST_IN_COMMON = 1.0 / 3.0
"""A rival with less of the best motion's corners in common is too small to count."""
MOST_SHARED = 0.3
"""A rival that shares more of its matches with the best motion is the same motion."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperOptions:
    """Options of the paper's matcher, stage by stage."""

    overhead: OverheadOptions = field(default_factory=OverheadOptions)
    """Raster of the overhead view; views are comparable only with equal cells."""
    corners: CornerOptions = field(default_factory=CornerOptions)
    """Detection."""
    invariants: InvariantOptions = field(default_factory=InvariantOptions)
    """Description."""
    segments: SegmentOptions = field(default_factory=SegmentOptions)
    """Consensus isometry."""
    refine: RefineOptions = field(default_factory=RefineOptions)
    """Homography."""
    decomposition: DecompositionOptions = field(default_factory=DecompositionOptions)
    """Closed form."""
    profile_sigma_cells: float = 1.5
    """Smoothing of the view before profiles are taken, overhead cells."""
    min_features: int = 20
    """Fewest corners of a frame."""
    min_segments: int = 3
    """Fewest matched segments that agree on an isometry."""
    min_inliers: int = 24
    """Fewest corners that agree on the homography."""
    min_inlier_ratio: float = 0.08
    """Fewest over the corners of the frame that has fewer: chance alone gives up to 0.06."""

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense (ValueError)."""
        check_numbers(self, may_be_zero=("min_inlier_ratio",), shares=("min_inlier_ratio",))


@dataclass(frozen=True, slots=True, eq=False)
class PaperFeatures:
    """Corners of one frame with what the matcher needs of its picture.

    Attributes:
        rays: (n, 2) undistorted rays.
        sigma: (n,) standard deviation of the rays.
        floor_m: (n, 2) at the nominal attitude, in `foot`.
        overhead_px: (n, 2) in the overhead view.
        invariants: (n, 6).
        grey: (rows, columns) smoothed overhead view.
        m_per_px: cell of the overhead view.
        attitude: nominal.
        focal_px: of the camera.
    """

    rays: Points
    sigma: Floats
    floor_m: Points
    overhead_px: Points
    invariants: Floats
    grey: Picture32
    m_per_px: float
    attitude: Attitude
    focal_px: float

    def __len__(self) -> int:
        return len(self.rays)


def detect(
    image: Image, camera: Camera, attitude: Attitude, options: PaperOptions | None = None
) -> PaperFeatures:
    """Find and describe the corners of a BGR picture (paper §2).

    Raises:
        ValueError: no floor is resolved, or the picture is not of the camera's size.
    """
    options = options or PaperOptions()
    grid = overhead_grid(camera, attitude, options.overhead)
    view, mask = overhead_view(image, camera, attitude, grid)
    corners = find_corners(_grey(image), camera, attitude, grid, options.corners)
    rays = camera.intrinsics.rays_from_px(corners.px)
    on_floor = np.isfinite(floor_from_rays(attitude, rays)).all(axis=1)
    rays, sigma_px = rays[on_floor], corners.sigma_px[on_floor]
    floor_m = floor_from_rays(attitude, rays)
    overhead_px = grid.overhead_from_floor(floor_m)
    smooth = cv2.GaussianBlur(_grey(view).astype(np.float32), (0, 0), options.profile_sigma_cells)
    return PaperFeatures(
        rays,
        sigma_px / camera.intrinsics.focal_px,
        floor_m,
        overhead_px,
        invariants(view, mask, overhead_px, options.invariants),
        np.asarray(smooth, dtype=np.float32),
        grid.m_per_px,
        attitude,
        camera.intrinsics.focal_px,
    )


def match(
    a: PaperFeatures,
    b: PaperFeatures,
    options: PaperOptions | None = None,
    rng: np.random.Generator | None = None,
) -> Matches | Miss:
    """Return what two frames have in common (paper §2 to §4).

    Raises:
        ValueError: the cells of the two overhead views differ by more than a tenth.
    """
    options = options or PaperOptions()
    rng = rng or np.random.default_rng(0)
    _check_cells(a, b)
    fewest = min(len(a), len(b))
    if fewest < options.min_features:
        return Miss(Reason.FEW_FEATURES, float(fewest), float(options.min_features))
    height_m = min(a.attitude.height_m, b.attitude.height_m)
    candidates = nearest_candidates(a.invariants, b.invariants, options.segments.num_neighbours)
    scene = Scene(_segment_view(a), _segment_view(b), candidates, height_m)
    votes = voted(scene, matched_segments(scene, options.segments, rng), options.segments)
    most = votes[0].num_segments if votes else 0
    if most < options.min_segments:
        return Miss(Reason.FEW_CANDIDATES, float(most), float(options.min_segments))
    start = [floor_homography(a.attitude, vote.a_from_b, b.attitude) for vote in votes]
    rays, described = (a.rays, b.rays), (a.invariants, b.invariants)
    found = [refined_homography(h, rays, described, b.focal_px, options.refine) for h in start]
    found.sort(key=lambda guided: -len(guided.index_a))
    best, count = found[0], len(found[0].index_a)
    needed = max(options.min_inliers, math.ceil(options.min_inlier_ratio * fewest))
    if count < needed:
        return Miss(Reason.FEW_INLIERS, float(count), float(needed))
    motion = decompose(best.b_from_a, a.attitude, b.attitude, options.decomposition)
    return Matches(_correspondences(a, b, best), motion.a_from_b, ambiguity(found, rays))


def ambiguity(found: Sequence[Guided], rays: tuple[Points, Points]) -> float:
    """Return how well the best rival does: its agreement over that of the first, at most 1.

    The agreement is the share of the corners in common that match, not their number: on a floor
    that repeats, a motion with less floor in common is as good an explanation as any. Rivals with
    much less in common say nothing. So does one that was drawn to the matches of the first.
    """
    best, *rivals = found
    in_common = num_in_common(best.b_from_a, *rays)
    own = set(zip(best.index_a.tolist(), best.index_b.tolist(), strict=True))
    worst = 0.0
    for rival in rivals:
        pairs = set(zip(rival.index_a.tolist(), rival.index_b.tolist(), strict=True))
        common = num_in_common(rival.b_from_a, *rays)
        if common > in_common * LEAST_IN_COMMON and len(pairs & own) < MOST_SHARED * len(pairs):
            worst = max(worst, len(pairs) / common * in_common / len(own))
    return min(worst, 1.0)


def _correspondences(a: PaperFeatures, b: PaperFeatures, found: Guided) -> Correspondences:
    return Correspondences(
        a.rays[found.index_a],
        b.rays[found.index_b],
        a.sigma[found.index_a],
        b.sigma[found.index_b],
    )


def _segment_view(features: PaperFeatures) -> SegmentView:
    return SegmentView(features.floor_m, features.overhead_px, features.grey, features.m_per_px)


def _grey(image: Image) -> Image:
    if image.ndim == 2:
        return image
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def _check_cells(a: PaperFeatures, b: PaperFeatures) -> None:
    if abs(a.m_per_px / b.m_per_px - 1.0) > 0.1:
        raise ValueError(
            f"overhead views have cells of {a.m_per_px:.4g} m and {b.m_per_px:.4g} m: "
            "detect both with the same m_per_px"
        )
