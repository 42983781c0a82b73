"""Which pairs to try once poses are known roughly: views that share floor where the graph is weak.

What a picture shows is predicted from its pose. Two views that share much of it, but that only a
long way through the graph connects, close a loop that retrieval did not find; a view with hardly
any pair of its own needs another. Where the graph is dense already, one more pair tells little.
"""

import functools
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import KDTree

from groundfuse.backend.measurement import Attitude, FrameId, Se2
from groundfuse.backend.option_checks import check_numbers
from groundfuse.frontend.arrays import Points
from groundfuse.frontend.camera import Camera
from groundfuse.frontend.footprint import footprint
from groundfuse.frontend.overhead_view import OverheadOptions, raster_cell_m

Pair = tuple[FrameId, FrameId]
Frames = set[FrameId]
Graph = dict[FrameId, Frames]
Around = Callable[[FrameId], Frames]
BALLS_KEPT = 4096
"""Frames whose surroundings in the graph are remembered: some kilobytes each."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictedOptions:
    """Options of the second round.

    Attributes:
        num_frames: most pairs of it per frame; 0 leaves it out.
        least_overlap: share of the smaller view's useful floor that two views have in common.
        near_edges: views within so many accepted pairs of each other are held together well.
        least_pairs: a view with fewer accepted pairs is held badly.
    """

    num_frames: int = 3
    least_overlap: float = 0.5
    near_edges: int = 4
    least_pairs: int = 3

    def __post_init__(self) -> None:
        """Refuse an overlap that is none, and ways that can't be searched (ValueError)."""
        if not 0.0 < self.least_overlap <= 1.0:
            raise ValueError(f"least_overlap must lie within 0 to 1, got {self.least_overlap:g}")
        if self.near_edges < 0 or self.near_edges % 2:
            raise ValueError(f"near_edges must be even and not negative, got {self.near_edges}")
        check_numbers(self, may_be_zero=("num_frames", "near_edges", "least_pairs"))


def floor_outline(
    camera: Camera, attitude: Attitude, team_from_foot: Se2, overhead: OverheadOptions
) -> Points:
    """Return the convex outline (n, 2) of the floor that features come from, m; empty for none."""
    found = footprint(camera, attitude, team_from_foot)
    limit_m = overhead.max_footprint_cells * raster_cell_m(camera, overhead)
    with np.errstate(invalid="ignore"):
        useful = found.m_per_px <= limit_m
    if np.count_nonzero(useful) < 3:
        return np.zeros((0, 2))
    hull = cv2.convexHull(found.floor_m[useful].astype(np.float32))
    return np.asarray(hull[:, 0], dtype=np.float64)


def predicted_pairs(
    outlines: Mapping[FrameId, Points],
    component_of: Mapping[FrameId, int],
    accepted: Collection[Pair],
    tried: Collection[Pair],
    options: PredictedOptions,
) -> list[Pair]:
    """Return the pairs of views that share floor where the graph is weak, most overlap first.

    Args:
        outlines: convex, of the floor that each frame shows, in its component's frame, m.
        component_of: each frame's component; poses of two of them say nothing of each other.
        accepted: the pairs that the graph rests on.
        tried: pairs that need no second try.
        options: see `PredictedOptions`.
    """
    graph: Graph = {frame: set() for frame in outlines}
    for a, b in accepted:
        if a in graph and b in graph:
            graph[a].add(b)
            graph[b].add(a)
    known, least = set(tried), options.least_overlap

    def around(frame: FrameId) -> Frames:
        return _ball(graph, frame, options)

    once = functools.lru_cache(BALLS_KEPT)(around)
    # Edges are only ever added: what is held well now is held well later.
    weak = [
        pair
        for pair in _close_by(outlines, component_of)
        if pair not in known and not _held(graph, *pair, once, options)
    ]
    shares = [(_overlap(outlines[a], outlines[b]), a, b) for a, b in weak]
    shared = [(-share, a, b) for share, a, b in shares if share >= least]
    chosen: list[Pair] = []
    of_frame = dict.fromkeys(outlines, 0)
    for _, a, b in sorted(shared):
        full = max(of_frame[a], of_frame[b]) >= options.num_frames
        if full or _held(graph, a, b, around, options):
            continue
        chosen.append((a, b))
        for one, other in ((a, b), (b, a)):
            graph[one].add(other)  # as if it were accepted: its neighbours need no other
            of_frame[one] += 1
    return chosen


def _close_by(
    outlines: Mapping[FrameId, Points], component_of: Mapping[FrameId, int]
) -> list[Pair]:
    """Return the pairs of one component whose floors may touch: the circles around them do."""
    frames = [f for f in sorted(outlines) if len(outlines[f]) >= 3 and f in component_of]
    if len(frames) < 2:
        return []
    middle = np.array([outlines[frame].mean(axis=0) for frame in frames])
    reach = np.array(
        [np.hypot(*(outlines[f] - m).T).max() for f, m in zip(frames, middle, strict=True)]
    )
    component = np.array([component_of[frame] for frame in frames])
    pairs = KDTree(middle).query_pairs(2.0 * float(reach.max()), output_type="ndarray")
    i, j = pairs[np.lexsort(pairs.T[::-1])].T
    apart_m = np.hypot(*(middle[i] - middle[j]).T)
    kept = (apart_m < reach[i] + reach[j]) & (component[i] == component[j])
    return [(frames[k], frames[m]) for k, m in zip(i[kept], j[kept], strict=True)]


def _overlap(a: Points, b: Points) -> float:
    """Share of the smaller of two convex outlines that both have in common."""
    middle = a.mean(axis=0)  # float32 loses centimetres far from the origin
    one, other = ((outline - middle).astype(np.float32) for outline in (a, b))
    smaller = min(abs(cv2.contourArea(one)), abs(cv2.contourArea(other)))
    return cv2.intersectConvexConvex(one, other)[0] / smaller if smaller > 0.0 else 0.0


def _held(graph: Graph, a: FrameId, b: FrameId, around: Around, options: PredictedOptions) -> bool:
    """Whether two views have pairs enough, and a short way leads from one to the other."""
    few = min(len(graph[a]), len(graph[b])) < options.least_pairs
    return not few and not around(a).isdisjoint(around(b))


def _ball(graph: Graph, middle: FrameId, options: PredictedOptions) -> Frames:
    """Frames within half of `near_edges` edges: two such balls meet where the way is short."""
    found, rim = {middle}, {middle}
    for _ in range(options.near_edges // 2):
        rim = set().union(*(graph[frame] for frame in rim)) - found
        found |= rim
    return found
