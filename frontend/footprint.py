"""Which floor a picture shows, and how finely: the lattice behind a mosaic's extent and cell."""

import functools
import math
from dataclasses import dataclass

import numpy as np

from groundfuse.backend.measurement import Attitude, Se2
from groundfuse.frontend.arrays import Floats, Points
from groundfuse.frontend.camera import Camera
from groundfuse.frontend.footprint_compiled import fill_bounds, fill_seen_floor
from groundfuse.frontend.overhead import foot_from_cam

LATTICE_COLUMNS = 33
LATTICE_ROWS = 49
OUTWARDS = 1.2
OUTWARD_STEPS = 241
BEYOND = 1.5
"""A lattice point past the limit still counts for the extent when its neighbour is within it and
it is at most this many times too coarse: the limit itself lies between the two."""


@dataclass(frozen=True, slots=True, eq=False)
class Footprint:
    """The floor under a lattice of pixels over the used rows.

    Attributes:
        floor_m: (LATTICE_ROWS, LATTICE_COLUMNS, 2) in the team's frame; nan above the horizon.
        m_per_px: (LATTICE_ROWS, LATTICE_COLUMNS) length of one pixel on the floor, the longer way.
    """

    floor_m: Floats
    m_per_px: Floats

    def finest_m_per_px(self, share: float) -> float:
        """Return the length that this share of the pixels stays below; inf above the horizon."""
        on_floor = self.m_per_px[np.isfinite(self.m_per_px)]
        if not on_floor.size:
            return math.inf
        rest, before = math.modf(share * (on_floor.size - 1))
        first, after = int(before), min(int(before) + 1, on_floor.size - 1)
        ordered = np.partition(on_floor, (first, after))
        return float(ordered[first] + rest * (ordered[after] - ordered[first]))

    def bounds(self, limit_m: float) -> tuple[Points, Points] | None:
        """Return the lowest and highest (x, y) of the floor resolved within the limit, or None."""
        found = np.array([[math.inf, math.inf], [-math.inf, -math.inf]])
        fill_bounds(self.floor_m, self.m_per_px, (limit_m, limit_m * BEYOND), found)
        return None if np.isinf(found[0, 0]) else (found[0], found[1])


@functools.lru_cache(maxsize=64)
def _lattice(camera: Camera) -> tuple[Points, Floats, Floats]:
    """Rays (n, 2) of a camera's lattice, and its rows and columns in pixels."""
    first, last = camera.used_rows
    u = np.linspace(0.0, camera.intrinsics.width_px - 1.0, LATTICE_COLUMNS)
    v = np.linspace(first, last, LATTICE_ROWS)
    px = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    return camera.intrinsics.rays_from_px(px), v, u


@functools.lru_cache(maxsize=64)
def widest_ray(camera: Camera) -> float:
    """Return the length up to which rays grow outwards in the picture; wider ones may fold back.

    A little over the picture's own widest ray where the lens allows: what lies just outside is
    needed to interpolate at the corners.
    """
    if camera.intrinsics.is_pinhole:
        return math.inf
    rays, _, _ = _lattice(camera)
    length = np.nan_to_num(np.hypot(rays[:, 0], rays[:, 1]))
    shares = np.linspace(0.0, OUTWARDS, OUTWARD_STEPS)
    ray = rays[np.argmax(length)]
    px = camera.intrinsics.px_from_rays(shares[:, None] * ray)
    steps = np.diff(np.hypot(*(px - px[0]).T))
    growing = int(np.argmin(np.append(steps, -np.inf) > 0.0))  # the first step that does not
    return float(length.max() * shares[growing])


def footprint(camera: Camera, attitude: Attitude, team_from_foot: Se2) -> Footprint:
    """Return the floor that a picture shows."""
    lattice, longest = _seen_floor(camera, attitude)
    return Footprint(team_from_foot.apply(lattice.reshape(-1, 2)).reshape(lattice.shape), longest)


@functools.lru_cache(maxsize=64)
def _seen_floor(camera: Camera, attitude: Attitude) -> tuple[Floats, Floats]:
    """Return the floor as its foot sees it and the length of pixels there, as in `Footprint`.

    Before a bundle all frames of a robot that stands level share one attitude.
    """
    rays, v, u = _lattice(camera)
    lattice, longest = np.empty((len(v), len(u), 2)), np.empty((len(v), len(u)))
    turn = foot_from_cam(attitude.tilt_rad, attitude.roll_rad)
    steps_px = float(v[1] - v[0]), float(u[1] - u[0])
    every = rays.reshape(lattice.shape)
    fill_seen_floor(every, turn, attitude.height_m, steps_px, (lattice, longest))
    for shared in (lattice, longest):
        shared.flags.writeable = False
    return lattice, longest
