"""How much floor two views share: the truth against which pairs are chosen and scored.

The counted floor of a view is what its used rows show within RANGE_PER_HEIGHT camera heights of
the foot, as if nothing stood on it. It is counted on a grid that is fixed to the world.
"""

import functools
import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from groundfuse.backend.measurement import Attitude, FrameId, Se2
from groundfuse.frontend.arrays import Mask, Points
from groundfuse.frontend.camera import Camera
from groundfuse.frontend.overhead import rays_from_floor

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
def _farthest_ray(camera: Camera) -> float:
    """Length of the longest ray of the used part's border."""
    lens = camera.intrinsics
    first, last = camera.used_rows
    u = np.linspace(-0.5, lens.width_px - 0.5, BORDER_POINTS)
    v = np.linspace(first - 0.5, last + 0.5, BORDER_POINTS)
    sides = [(u, np.full_like(u, row)) for row in (v[0], v[-1])]
    sides += [(np.full_like(v, column), v) for column in (u[0], u[-1])]
    rays = lens.rays_from_px(np.vstack([np.column_stack(side) for side in sides]))
    return float(np.nanmax(np.hypot(rays[:, 0], rays[:, 1])))


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
def counted_floor(view: View) -> Points:
    """Return the grid points (n, 2) of the world that a view shows, metres."""
    height = view.attitude.height_m
    step, foot = STEP_PER_HEIGHT * height, view.world_from_foot
    reach = RANGE_PER_HEIGHT * height
    x, y = (
        step * np.arange(math.ceil((at - reach) / step), math.floor((at + reach) / step) + 1)
        for at in (foot.x_m, foot.y_m)
    )
    grid: Points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2).astype(np.float64)
    return grid[in_view(view, grid)]


def _area_m2(view: View) -> float:
    return len(counted_floor(view)) * (STEP_PER_HEIGHT * view.attitude.height_m) ** 2


def true_overlap(a: View, b: View) -> float:
    """Return the floor that two views share over the smaller of both footprints, 0 to 1.

    The same either way round; counted on the grid of the lower camera.
    """
    apart = np.hypot(
        a.world_from_foot.x_m - b.world_from_foot.x_m, a.world_from_foot.y_m - b.world_from_foot.y_m
    )
    if apart >= RANGE_PER_HEIGHT * (a.attitude.height_m + b.attitude.height_m):
        return 0.0
    lower, higher = sorted((a, b), key=lambda view: view.attitude.height_m)
    smaller = min(_area_m2(a), _area_m2(b))
    if smaller == 0.0:
        return 0.0
    if _are_apart(counted_floor(lower), counted_floor(higher)):
        return 0.0
    step = STEP_PER_HEIGHT * lower.attitude.height_m
    shared = np.count_nonzero(in_view(higher, counted_floor(lower))) * step**2
    return min(1.0, float(shared) / smaller)


def _are_apart(a_m: Points, b_m: Points) -> bool:
    """Whether the boxes around two sets of points have a gap between them."""
    return bool((a_m.min(0) > b_m.max(0)).any() or (b_m.min(0) > a_m.max(0)).any())


def all_overlaps(views: Mapping[FrameId, View]) -> dict[tuple[FrameId, FrameId], float]:
    """Return the overlap of every pair of views that has any, each pair once, in order."""
    found = {(a, b): true_overlap(views[a], views[b]) for a, b in itertools.combinations(views, 2)}
    return {pair: share for pair, share in found.items() if share > 0.0}
