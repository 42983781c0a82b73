"""Upright boxes and cylinders on the floor, met by rays (slabs and the quadratic of a circle)."""

import functools
import math
from dataclasses import dataclass

import numpy as np

from groundfuse.backend.measurement import Se2
from groundfuse.frontend.arrays import Floats, Picture32, Points
from groundfuse.tools.noise import Rect, octaves

LIGHT = np.array([0.8, 0.6])
DARKEST_SIDE = 0.45
TEXTURE_CELLS = 511
CELLS_PER_SIZE = 160.0


@dataclass(frozen=True, slots=True)
class Obstacle:
    """An upright solid standing on the floor.

    Attributes:
        world_from_solid: where its middle stands.
        half_x_m: half its length; the radius of a cylinder.
        half_y_m: half its width; the radius of a cylinder.
        height_m: over the floor.
        colour: blue, green, red of the top in full light, 0 to 255.
        is_round: a cylinder, else a box.
        seed: of its surface.
    """

    world_from_solid: Se2
    half_x_m: float
    half_y_m: float
    height_m: float
    colour: tuple[float, float, float]
    is_round: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        """Refuse a solid without size (ValueError)."""
        smallest = min(self.half_x_m, self.half_y_m, self.height_m)
        if not smallest > 0.0:
            raise ValueError(f"an obstacle needs positive sizes, got {smallest:g} m")

    @property
    def radius_m(self) -> float:
        """Radius of the circle around its base."""
        if self.is_round:
            return self.half_x_m
        return math.hypot(self.half_x_m, self.half_y_m)

    def corners(self) -> Points:
        """Return the (8, 3) corners of the box around it, in the world."""
        half = np.array([self.half_x_m, self.half_y_m])
        flat = self.world_from_solid.apply(
            np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, 1.0], [1.0, -1.0]]) * half
        )
        bottom, top = np.zeros((4, 1)), np.full((4, 1), self.height_m)
        return np.vstack([np.hstack([flat, bottom]), np.hstack([flat, top])])


@dataclass(frozen=True, slots=True, eq=False)
class Hit:
    """Where rays meet a solid: distance along the ray (inf for a miss), colour (n, 3)."""

    along: Floats
    colour: Picture32


@functools.lru_cache(maxsize=64)
def _texture(seed: int) -> Picture32:
    side = TEXTURE_CELLS + 1
    return octaves((seed, 77), Rect(0, 0, side, side), {32: 0.08, 8: 0.06, 2: 0.05})


def _surface(obstacle: Obstacle, u_m: Floats, v_m: Floats, face: Floats) -> Floats:
    """Brightness factor (n,) of the surface at face coordinates, bilinear."""
    texture = _texture(obstacle.seed)
    size = max(obstacle.half_x_m, obstacle.half_y_m, obstacle.height_m)
    scale = CELLS_PER_SIZE / (2.0 * size)
    x = (u_m * scale + 61.0 * face) % TEXTURE_CELLS
    y = (v_m * scale + 97.0 * face) % TEXTURE_CELLS
    column, row = x.astype(int), y.astype(int)
    x, y = x - column, y - row
    upper = texture[row, column] * (1 - x) + texture[row, column + 1] * x
    lower = texture[row + 1, column] * (1 - x) + texture[row + 1, column + 1] * x
    factor: Floats = np.clip(1.0 + upper * (1 - y) + lower * y, 0.3, 1.5)
    return factor


def _box(obstacle: Obstacle, origin: Floats, rays: Floats) -> tuple[Floats, Floats, Floats]:
    """Distance, outward normal (n, 2; zero on top) and face index (n,) in the box's frame."""
    half = np.array([obstacle.half_x_m, obstacle.half_y_m, obstacle.height_m / 2.0])
    centred = origin - np.array([0.0, 0.0, half[2]])
    safe = np.where(np.abs(rays) < 1e-12, 1e-12, rays)
    near = (-np.sign(safe) * half - centred) / safe
    far = (np.sign(safe) * half - centred) / safe
    axis = near.argmax(axis=1)
    enter = near.max(axis=1)
    hit = (enter < far.min(axis=1)) & (enter > 0.0)
    normal = np.zeros((len(rays), 2))
    for k in (0, 1):
        normal[axis == k, k] = -np.sign(safe[axis == k, k])
    return np.where(hit, enter, np.inf), normal, axis.astype(np.float64)


def _cylinder(obstacle: Obstacle, origin: Floats, rays: Floats) -> tuple[Floats, Floats, Floats]:
    """Distance, outward normal (n, 2; zero on top) and face index (n,) in its frame."""
    a = np.maximum((rays[:, :2] ** 2).sum(axis=1), 1e-18)
    b = rays[:, :2] @ origin[:2]
    c = float(origin[:2] @ origin[:2]) - obstacle.half_x_m**2
    inside = b * b - a * c
    side = np.where(inside > 0.0, (-b - np.sqrt(np.maximum(inside, 0.0))) / a, np.inf)
    level = origin[2] + np.where(np.isfinite(side), side, 0.0) * rays[:, 2]
    side = np.where((side > 0.0) & (level >= 0.0) & (level <= obstacle.height_m), side, np.inf)
    down = np.where(rays[:, 2] < 0.0, rays[:, 2], np.nan)
    top = (obstacle.height_m - origin[2]) / down
    reach = np.hypot(origin[0] + top * rays[:, 0], origin[1] + top * rays[:, 1])
    top = np.where((top > 0.0) & (reach <= obstacle.half_x_m), top, np.inf)
    is_top = top < side
    along = np.minimum(top, side)
    met = origin[:2] + np.where(np.isfinite(along), along, 0.0)[:, None] * rays[:, :2]
    normal = np.where(is_top[:, None], 0.0, met / obstacle.half_x_m)
    return along, normal, np.where(is_top, 2.0, 0.0)


def meet(obstacle: Obstacle, origin_m: Floats, rays: Floats) -> Hit:
    """Meet rays with a solid.

    Args:
        obstacle: the solid.
        origin_m: (3,) the camera in the world.
        rays: (n, 3) directions in the world, any length; `Hit.along` counts in that length.
    """
    solid_from_world = obstacle.world_from_solid.inverse()
    turn = Se2(0.0, 0.0, solid_from_world.theta_rad)
    origin = np.append(solid_from_world.apply(origin_m[None, :2])[0], origin_m[2])
    local = np.column_stack([turn.apply(rays[:, :2]), rays[:, 2]])
    shape = _cylinder if obstacle.is_round else _box
    along, normal, face = shape(obstacle, origin, local)
    hit = np.isfinite(along)
    met, normal = origin + along[hit, None] * local[hit], normal[hit]
    on_top = ~normal.any(axis=1)
    around = met[:, 0] * normal[:, 1] - met[:, 1] * normal[:, 0]
    if obstacle.is_round:
        around = np.arctan2(met[:, 1], met[:, 0]) * obstacle.half_x_m
    u, v = np.where(on_top, met[:, 0], around), np.where(on_top, met[:, 1], met[:, 2])
    shade = 1.0 - (1.0 - DARKEST_SIDE) * (~on_top) * (
        0.75 - 0.25 * (turn.inverse().apply(normal) @ LIGHT)
    )
    bright = shade * _surface(obstacle, u, v, face[hit])
    colour = np.zeros((len(rays), 3), dtype=np.float32)
    colour[hit] = np.clip(bright[:, None] * np.array(obstacle.colour), 0.0, 255.0)
    return Hit(along, colour)
