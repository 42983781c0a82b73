"""Segment matching (paper §2, eq. 4-5) and the isometry that most matched segments agree on.

Two candidate matches span a segment in each overhead view. Overhead views differ by an isometry, so
right matches span segments of equal length with the same grey profile. Each pair of segments that
passes both tests determines one isometry and votes for it; least squares over all that pass, as the
print has it, would let the wrong ones spoil the fit.
"""

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial import KDTree

from groundfuse.backend.measurement import Se2
from groundfuse.backend.option_checks import check_numbers
from groundfuse.frontend.arrays import Floats, Picture32, Points

RANK_TABLE = 256
"""Entries of the first neighbour in the table that ranks are drawn from."""
FLAT_GREY = 1e-3
"""Profiles that vary less than this count as not correlated."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmentOptions:
    """How segments are drawn, tested and counted. Lengths are in camera heights."""

    num_neighbours: int = 10
    """Candidates of each point: the nearest by invariants, without ratio test."""
    num_draws: int = 500_000
    """Pairs of candidates that are drawn."""
    min_length: float = 0.12
    """Shortest segment: a shorter one tells too little about the turn."""
    max_length: float = 0.9
    """Longest segment: on a longer one the wobble bends the profile away."""
    length_tolerance_cells: float = 2.0
    """Part of the tolerance of equal length that the corners need, overhead cells."""
    length_tolerance_ratio: float = 0.015
    """Part that the wobble needs, over the length."""
    max_segments: int = 3000
    """Most matched segments that vote: the first ones drawn."""
    num_steps: int = 8
    """k: profiles are sampled at k + 1 points."""
    min_correlation: float = 0.8
    """Least correlation of two matched profiles (eq. 5)."""
    vote_tolerance: float = 0.03
    """Isometries this near at the middle of the view (and at lever 0.4) count as one."""
    distinct: float = 0.12
    """Isometries at least this far apart are rivals."""
    lever: float = 0.4
    """Turns are compared as the way of a point at this distance."""
    num_modes: int = 4
    """Distinct isometries that are looked for."""

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense (ValueError)."""
        check_numbers(
            self,
            may_be_zero=("length_tolerance_ratio",),
            may_be_inf=("max_length",),
            may_be_negative=("min_correlation",),
        )


class SegmentView(NamedTuple):
    """What the segment test needs of one view.

    Attributes:
        floor_m: (n, 2) points in `foot`.
        overhead_px: (n, 2) the same in the overhead view.
        grey: (rows, columns) smoothed overhead view.
        m_per_px: cell of the view.
    """

    floor_m: Points
    overhead_px: Points
    grey: Picture32
    m_per_px: float


class Candidates(NamedTuple):
    """Possible matches, point by point of a, nearest first.

    Attributes:
        a: (n,) points of a, each `num_ranks` times in a row.
        b: (n,) points of b.
        num_ranks: candidates per point of a.
    """

    a: np.ndarray
    b: np.ndarray
    num_ranks: int


class Scene(NamedTuple):
    """Two views and their candidates.

    Attributes:
        a: first view.
        b: second view.
        candidates: possible matches.
        height_m: the unit of the options' lengths.
    """

    a: SegmentView
    b: SegmentView
    candidates: Candidates
    height_m: float


class Vote(NamedTuple):
    """An isometry and how many matched segments agree on it; foot of b in the foot frame of a."""

    a_from_b: Se2
    num_segments: int


def nearest_candidates(invariants_a: Floats, invariants_b: Floats, count: int) -> Candidates:
    """Return the `count` points of b nearest to each point of a by Euclidean distance."""
    count = min(count, len(invariants_b))
    tree = KDTree(invariants_b)
    _, index_b = tree.query(invariants_a, k=count)
    return Candidates(np.repeat(np.arange(len(invariants_a)), count), np.ravel(index_b), count)


def profile(view: SegmentView, start: np.ndarray, end: np.ndarray, num_steps: int) -> Floats:
    """Return normalised grey profiles (n, num_steps + 1) from points `start` to points `end`.

    Each has mean 0 and length 1 (or 0 if it is flat), so products are correlations.
    """
    if len(start) == 0:
        return np.zeros((0, num_steps + 1))
    along = np.linspace(0.0, 1.0, num_steps + 1)[None, :, None]
    first, last = view.overhead_px[start][:, None], view.overhead_px[end][:, None]
    at = (first + along * (last - first)).astype(np.float32)
    # remap takes fewer than 32767 rows: lay the segments out in a wide picture.
    rows = min(len(at), 4096)
    columns = -(-len(at) // rows)
    padded = np.zeros((rows * columns, num_steps + 1, 2), np.float32)
    padded[: len(at)] = at
    laid_out = padded.reshape(rows, columns * (num_steps + 1), 2)
    map_u, map_v = cv2.split(laid_out)
    grey = cv2.remap(view.grey, map_u, map_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    values = np.asarray(grey, np.float64).reshape(-1, num_steps + 1)[: len(at)]
    values -= values.mean(axis=1, keepdims=True)
    length = np.linalg.norm(values, axis=1, keepdims=True)
    normalised: Floats = np.where(length > FLAT_GREY, values / np.maximum(length, FLAT_GREY), 0.0)
    return normalised


def matched_segments(scene: Scene, options: SegmentOptions, rng: np.random.Generator) -> np.ndarray:
    """Return (m, 2) indices of candidate pairs whose segments match in length and profile."""
    a, b, candidates, height_m = scene
    one, two = _drawn(candidates, options.num_draws, rng)
    length_a = _lengths(a.floor_m[candidates.a], one, two)
    length_b = _lengths(b.floor_m[candidates.b], one, two)
    tolerance_m = options.length_tolerance_cells * max(a.m_per_px, b.m_per_px)
    equal = np.abs(length_a - length_b) < options.length_tolerance_ratio * length_a + tolerance_m
    equal &= length_a > options.min_length * height_m
    equal &= length_a < options.max_length * height_m
    one, two = one[equal], two[equal]  # eq. 4
    profile_a = profile(a, candidates.a[one], candidates.a[two], options.num_steps)
    profile_b = profile(b, candidates.b[one], candidates.b[two], options.num_steps)
    alike = (profile_a * profile_b).sum(axis=1) > options.min_correlation  # eq. 5
    matched: np.ndarray = np.stack([one[alike], two[alike]], axis=1)
    return matched[: options.max_segments]


def _drawn(
    candidates: Candidates, num_draws: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw pairs of candidates: any two points of a, their nearer neighbours more often."""
    ranks = np.arange(candidates.num_ranks)
    table = np.repeat(ranks, np.ceil(RANK_TABLE / (1.0 + ranks)).astype(int)).astype(np.int32)
    num_points = len(candidates.a) // candidates.num_ranks
    points = rng.integers(num_points, size=(2, num_draws), dtype=np.int32)
    rank = table[rng.integers(len(table), size=(2, num_draws), dtype=np.int32)]
    one, two = points * candidates.num_ranks + rank
    return one, two


def _lengths(points: Points, one: np.ndarray, two: np.ndarray) -> Picture32:
    """Distances between two points each; single precision is exact to a ten-millionth of it."""
    x, y = points.T.astype(np.float32)
    along_x, along_y = x[two] - x[one], y[two] - y[one]
    lengths: Picture32 = np.sqrt(along_x * along_x + along_y * along_y)
    return lengths


def voted(scene: Scene, segments: np.ndarray, options: SegmentOptions) -> list[Vote]:
    """Return the isometries with most matched segments, mutually distinct, best first.

    Args:
        scene: views and candidates.
        segments: (m, 2) from `matched_segments`.
        options: see there.
    """
    if len(segments) == 0:
        return []
    centre = np.median(scene.b.floor_m, axis=0)
    places = _isometries(scene, segments, centre, options.lever * scene.height_m)
    tree = KDTree(places)
    radius = options.vote_tolerance * scene.height_m
    counts = np.asarray(tree.query_ball_point(places, radius, return_length=True))
    open_ = np.ones(len(places), dtype=bool)
    votes: list[Vote] = []
    while open_.any() and len(votes) < options.num_modes:
        best = int(np.argmax(np.where(open_, counts, -1)))
        mean = places[tree.query_ball_point(places[best], radius)].mean(axis=0)
        turn = Se2(0.0, 0.0, float(np.arctan2(mean[3], mean[2])))
        shift = mean[:2] - turn.apply(centre[None])[0]
        motion = Se2(float(shift[0]), float(shift[1]), turn.theta_rad)
        votes.append(Vote(motion, int(counts[best])))
        open_ &= np.linalg.norm(places - places[best], axis=1) > options.distinct * scene.height_m
    return votes


def _isometries(scene: Scene, segments: np.ndarray, centre: Floats, lever_m: float) -> Floats:
    """One isometry per matched segment, as where it takes the centre of b and a lever (m, 4)."""
    a, b, candidates, _ = scene
    one, two = segments.T
    start_a, end_a = a.floor_m[candidates.a[one]], a.floor_m[candidates.a[two]]
    start_b, end_b = b.floor_m[candidates.b[one]], b.floor_m[candidates.b[two]]
    along_a, along_b = end_a - start_a, end_b - start_b
    theta = np.arctan2(along_a[:, 1], along_a[:, 0]) - np.arctan2(along_b[:, 1], along_b[:, 0])
    c, s = np.cos(theta), np.sin(theta)
    off = centre - (start_b + end_b) / 2.0
    middle = (start_a + end_a) / 2.0
    x = middle[:, 0] + c * off[:, 0] - s * off[:, 1]
    y = middle[:, 1] + s * off[:, 0] + c * off[:, 1]
    places: Floats = np.stack([x, y, lever_m * c, lever_m * s], axis=1)
    return places
