"""Which pairs to try once poses are known roughly: views that share floor where the graph is weak.

What a picture shows is predicted from its pose. Two views that share much of it, but that only a
long way through the graph connects, close a loop that retrieval did not find; a view with hardly
any pair of its own needs another. Where the graph is dense already, one more pair tells little.
"""

import functools
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import KDTree

from groundfuse.backend.measurement import IDENTITY, Attitude, FrameId, Se2
from groundfuse.backend.option_checks import check_numbers
from groundfuse.frontend.arrays import Points
from groundfuse.frontend.camera import Camera
from groundfuse.frontend.footprint import footprint
from groundfuse.frontend.overhead_view import OverheadOptions, raster_cell_m

Pair = tuple[FrameId, FrameId]
Places = set[int]
Graph = list[Places]
Around = Callable[[int], Places]
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
    return team_from_foot.apply(_seen_outline(camera, attitude, overhead))


@functools.lru_cache(maxsize=64)
def _seen_outline(camera: Camera, attitude: Attitude, overhead: OverheadOptions) -> Points:
    """Return the outline as its foot sees it, which all frames of one attitude share."""
    found = footprint(camera, attitude, IDENTITY)
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
    frames = sorted(outlines)
    place = {frame: k for k, frame in enumerate(frames)}
    graph: Graph = [set() for _ in frames]
    for i, j in _numbered(accepted, place):
        graph[i].add(j)
        graph[j].add(i)
    known = set(_numbered(tried, place))

    def around(k: int) -> Places:
        return _ball(graph, k, options)

    once = functools.lru_cache(BALLS_KEPT)(around)
    shapes = [outlines[frame] for frame in frames]
    # Edges are only ever added: what is held well now is held well later.
    weak = [
        (i, j)
        for i, j in _close_by(shapes, [component_of.get(frame, -1) for frame in frames])
        if (i, j) not in known and not _held(graph, i, j, once, options)
    ]
    shares = [(_overlap(shapes[i], shapes[j]), i, j) for i, j in weak]
    shared = [(-share, i, j) for share, i, j in shares if share >= options.least_overlap]
    chosen: list[Pair] = []
    of_frame = [0] * len(frames)
    for _, i, j in sorted(shared):
        full = max(of_frame[i], of_frame[j]) >= options.num_frames
        if full or _held(graph, i, j, around, options):
            continue
        chosen.append((frames[i], frames[j]))
        for one, other in ((i, j), (j, i)):
            graph[one].add(other)  # as if it were accepted: its neighbours need no other
            of_frame[one] += 1
    return chosen


def _numbered(pairs: Collection[Pair], place: Mapping[FrameId, int]) -> Iterator[tuple[int, int]]:
    """Yield pairs as places, which are much quicker to look up; those of other frames are left."""
    for a, b in pairs:
        if a in place and b in place:
            yield place[a], place[b]


def _close_by(shapes: Sequence[Points], component_of: Sequence[int]) -> list[tuple[int, int]]:
    """Return the pairs of one component whose floors may touch: the circles around them do.

    Args:
        shapes: outlines of all frames.
        component_of: each frame's component, -1 for none.
    """
    seen = zip(shapes, component_of, strict=True)
    some = np.array([k for k, (shape, c) in enumerate(seen) if len(shape) >= 3 and c >= 0])
    if len(some) < 2:
        return []
    middle = np.array([shapes[k].mean(axis=0) for k in some])
    reach = np.array(
        [np.hypot(*(shapes[k] - m).T).max() for k, m in zip(some, middle, strict=True)]
    )
    component = np.array(component_of)[some]
    pairs = KDTree(middle).query_pairs(2.0 * float(reach.max()), output_type="ndarray")
    i, j = pairs[np.lexsort(pairs.T[::-1])].T
    apart_m = np.hypot(*(middle[i] - middle[j]).T)
    kept = (apart_m < reach[i] + reach[j]) & (component[i] == component[j])
    return list(zip(some[i[kept]].tolist(), some[j[kept]].tolist(), strict=True))


def _overlap(a: Points, b: Points) -> float:
    """Share of the smaller of two convex outlines that both have in common."""
    middle = a.mean(axis=0)  # float32 loses centimetres far from the origin
    one, other = ((outline - middle).astype(np.float32) for outline in (a, b))
    smaller = min(abs(cv2.contourArea(one)), abs(cv2.contourArea(other)))
    return cv2.intersectConvexConvex(one, other)[0] / smaller if smaller > 0.0 else 0.0


def _held(graph: Graph, i: int, j: int, around: Around, options: PredictedOptions) -> bool:
    """Whether two views have pairs enough, and a short way leads from one to the other."""
    few = min(len(graph[i]), len(graph[j])) < options.least_pairs
    return not few and not around(i).isdisjoint(around(j))


def _ball(graph: Graph, middle: int, options: PredictedOptions) -> Places:
    """Frames within half of `near_edges` edges: two such balls meet where the way is short."""
    found, rim = {middle}, {middle}
    for _ in range(options.near_edges // 2):
        rim = set().union(*(graph[k] for k in rim)) - found
        found |= rim
    return found
