"""How much floor two views share: the truth against which pairs are chosen and scored.

The counted floor of a view is what its used rows show within RANGE_PER_HEIGHT camera heights of
the foot, as if nothing stood on it. It is counted on a grid that is fixed to the world.
"""

import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from groundfuse.backend.measurement import Attitude, FrameId, Se2
from groundfuse.frontend.arrays import Mask, Points
from groundfuse.frontend.camera import Camera
from groundfuse.frontend.overhead import floor_from_rays, rays_from_floor

RANGE_PER_HEIGHT = math.sqrt(5.0)
"""Farther floor does not count: from there on a pixel is over 1 + 5 = 6 times as long along the
ground as straight below, too coarse to be matched."""
STEP_PER_HEIGHT = 0.02
"""Spacing of the grid: a usual footprint holds some 4000 points and its area is good to 1 %."""
BORDER_POINTS = 33
BORDER_SLACK = 1.001


@dataclass(frozen=True, slots=True)
class View:
    """A camera at a place, as it truly stood."""

    camera: Camera
    attitude: Attitude
    world_from_base: Se2

    @property
    def world_from_foot(self) -> Se2:
        """The floor point below the camera, x along its heading."""
        return self.world_from_base @ self.camera.mount.base_from_foot


@functools.lru_cache(maxsize=64)
def _border_rays(camera: Camera) -> Points:
    """Rays (n, 2) of the border of the used part that have one."""
    lens = camera.intrinsics
    first, last = camera.used_rows
    u = np.linspace(-0.5, lens.width_px - 0.5, BORDER_POINTS)
    v = np.linspace(first - 0.5, last + 0.5, BORDER_POINTS)
    sides = [(u, np.full_like(u, row)) for row in (v[0], v[-1])]
    sides += [(np.full_like(v, column), v) for column in (u[0], u[-1])]
    rays = lens.rays_from_px(np.vstack([np.column_stack(side) for side in sides]))
    return rays[np.isfinite(rays).all(axis=1)]


@functools.lru_cache(maxsize=64)
def _farthest_ray(camera: Camera) -> float:
    return float(np.hypot(*_border_rays(camera).T).max())


@functools.lru_cache(maxsize=2**15)
def _box(view: View) -> tuple[Points, Points]:
    """Lowest and highest x, y (2,) of the world that a view may count."""
    reach = RANGE_PER_HEIGHT * view.attitude.height_m
    border = floor_from_rays(view.attitude, _border_rays(view.camera))
    foot = view.world_from_foot
    middle = np.array([foot.x_m, foot.y_m])
    if np.isnan(border).any() or len(border) < 4 * BORDER_POINTS:
        return middle - reach, middle + reach
    corners = foot.apply(border)
    slack = 0.05 * reach  # the border bulges between its points
    low, high = corners.min(axis=0) - slack, corners.max(axis=0) + slack
    return np.maximum(low, middle - reach), np.minimum(high, middle + reach)


def in_view(view: View, points_m: Points) -> Mask:
    """Return whether floor points (n, 2) of the world belong to the counted floor of a view."""
    foot = view.world_from_foot.inverse().apply(points_m)
    near = np.hypot(foot[:, 0], foot[:, 1]) <= RANGE_PER_HEIGHT * view.attitude.height_m
    rays = rays_from_floor(view.attitude, foot)
    # Rays far outside the picture may be folded back into it by the distortion's polynomial.
    length = np.nan_to_num(np.hypot(rays[:, 0], rays[:, 1]), nan=np.inf)
    near &= length <= BORDER_SLACK * _farthest_ray(view.camera)
    rays[~near] = 0.0
    pixels = view.camera.intrinsics.px_from_rays(rays)
    first, last = view.camera.used_rows
    low = np.array([-0.5, first - 0.5])
    high = np.array([view.camera.intrinsics.width_px - 0.5, last + 0.5])
    seen: Mask = near & ((pixels >= low) & (pixels <= high)).all(axis=1)
    return seen


@functools.lru_cache(maxsize=4096)
def counted_floor(view: View, step_per_height: float = STEP_PER_HEIGHT) -> Points:
    """Return the grid points (n, 2) of the world that a view shows, metres."""
    step = step_per_height * view.attitude.height_m
    low, high = _box(view)
    x, y = (
        step * np.arange(math.ceil(least / step), math.floor(most / step) + 1)
        for least, most in zip(low, high, strict=True)
    )
    grid: Points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2).astype(np.float64)
    return grid[in_view(view, grid)]


def true_overlap(a: View, b: View, step_per_height: float = STEP_PER_HEIGHT) -> float:
    """Return the floor that two views share over the smaller of both footprints, 0 to 1.

    The same either way round; counted on the grid of the lower camera.
    """
    (low_a, high_a), (low_b, high_b) = _box(a), _box(b)
    if (low_a > high_b).any() or (low_b > high_a).any():
        return 0.0
    lower, higher = sorted((a, b), key=lambda view: view.attitude.height_m)
    counted, other = (counted_floor(view, step_per_height) for view in (lower, higher))
    # In squares of the lower camera's grid:
    scale = (higher.attitude.height_m / lower.attitude.height_m) ** 2
    smaller = min(float(len(counted)), len(other) * scale)
    if smaller == 0.0:
        return 0.0
    low, high = _box(higher)
    x, y = counted.T
    meets = (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])
    return min(1.0, float(np.count_nonzero(in_view(higher, counted[meets]))) / smaller)


def near_pairs(a: Sequence[View], b: Sequence[View]) -> Iterator[tuple[int, int]]:
    """Yield the indices of views of a and of b that may share floor: their boxes meet."""
    if not a or not b:
        return
    low, high = (np.array(ends) for ends in zip(*(_box(view) for view in b), strict=True))
    for i, view in enumerate(a):
        least, most = _box(view)
        meets = ((low <= most) & (least <= high)).all(axis=1)
        yield from ((i, int(j)) for j in np.flatnonzero(meets))


def all_overlaps(views: Mapping[FrameId, View]) -> dict[tuple[FrameId, FrameId], float]:
    """Return the overlap of every pair of views that has any, each pair once, in order."""
    frames, every = list(views), list(views.values())
    shares = (
        (i, j, true_overlap(every[i], every[j])) for i, j in near_pairs(every, every) if i < j
    )
    return {(frames[i], frames[j]): share for i, j, share in shares if share > 0.0}
