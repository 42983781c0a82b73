"""Upright boxes and cylinders on the floor, met by rays (slabs and the quadratic of a circle)."""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from groundfuse.backend.measurement import Se2
from groundfuse.frontend.arrays import Floats, Picture32, Points
from groundfuse.tools.noise import Rect, octaves

LIGHT = np.array([0.8, 0.6])
DARKEST_SIDE = 0.45
TEXTURE_CELLS = 511
CELLS_PER_SIZE = 160.0
TINY = 1e-12


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


Solved = tuple[Floats, Floats, Floats, Floats]
"""Distance, outward normal x and y (both 0 on top) and number of the face, each (n,)."""


def _box(obstacle: Obstacle, origin: Floats, rays: Sequence[Floats]) -> Solved:
    half = (obstacle.half_x_m, obstacle.half_y_m, obstacle.height_m / 2.0)
    centre = (origin[0], origin[1], origin[2] - half[2])
    near, far = [], []
    for ray, size, at in zip(rays, half, centre, strict=True):
        steep = np.where(np.abs(ray) < TINY, TINY, ray)
        middle, spread = -at / steep, size / np.abs(steep)
        near.append(middle - spread)
        far.append(middle + spread)
    enter = np.maximum(np.maximum(near[0], near[1]), near[2])
    leave = np.minimum(np.minimum(far[0], far[1]), far[2])
    face = np.where(enter == near[0], 0.0, np.where(enter == near[1], 1.0, 2.0))
    normal_x = np.where(face == 0.0, -np.sign(rays[0]), 0.0)
    normal_y = np.where(face == 1.0, -np.sign(rays[1]), 0.0)
    along = np.where((enter < leave) & (enter > 0.0), enter, np.inf)
    return along, normal_x, normal_y, face


def _cylinder(obstacle: Obstacle, origin: Floats, rays: Sequence[Floats]) -> Solved:
    radius, top_m = obstacle.half_x_m, obstacle.height_m
    x, y, z = rays
    a = np.maximum(x * x + y * y, TINY * TINY)
    b = x * origin[0] + y * origin[1]
    inside = b * b - a * (origin[0] ** 2 + origin[1] ** 2 - radius**2)
    side = (-b - np.sqrt(np.maximum(inside, 0.0))) / a
    level = origin[2] + side * z
    on_side = (inside > 0.0) & (side > 0.0) & (level >= 0.0) & (level <= top_m)
    top = (top_m - origin[2]) / np.where(np.abs(z) < TINY, TINY, z)
    top_x, top_y = origin[0] + top * x, origin[1] + top * y
    on_top = (top > 0.0) & (top_x * top_x + top_y * top_y <= radius * radius)
    side, top = np.where(on_side, side, np.inf), np.where(on_top, top, np.inf)
    face = np.where(top < side, 2.0, 0.0)
    reach = np.where(on_side & (face == 0.0), side, 0.0) / radius
    flat = on_side & (face == 0.0)
    normal_x = np.where(flat, origin[0] / radius + reach * x, 0.0)
    normal_y = np.where(flat, origin[1] / radius + reach * y, 0.0)
    return np.minimum(top, side), normal_x, normal_y, face


def meet(obstacle: Obstacle, origin_m: Floats, rays: Picture32) -> Hit:
    """Meet rays with a solid.

    Args:
        obstacle: the solid.
        origin_m: (3,) the camera in the world.
        rays: (n, 3) directions in the world, any length; `Hit.along` counts in that length.
    """
    solid_from_world = obstacle.world_from_solid.inverse()
    angle = solid_from_world.theta_rad
    c, s = math.cos(angle), math.sin(angle)
    origin = np.append(solid_from_world.apply(origin_m[None, :2])[0], origin_m[2])
    x, y, z = (rays[:, k].astype(np.float64) for k in range(3))
    local = (c * x - s * y, s * x + c * y, z)
    along, normal_x, normal_y, face = (_cylinder if obstacle.is_round else _box)(
        obstacle, origin, local
    )
    hit = np.flatnonzero(np.isfinite(along))
    colour = np.zeros((len(rays), 3), dtype=np.float32)
    met = [o + along[hit] * axis[hit] for o, axis in zip(origin, local, strict=True)]
    shine = _shine(obstacle, met, (normal_x[hit], normal_y[hit]), face[hit])
    colour[hit] = np.clip(shine[:, None] * np.array(obstacle.colour), 0.0, 255.0)
    return Hit(along, colour)


def _shine(
    obstacle: Obstacle, met: Sequence[Floats], normal: tuple[Floats, Floats], face: Floats
) -> Floats:
    """Brightness factor (n,) of met points, in the solid's frame: light from one side, texture."""
    on_top = face == 2.0
    if obstacle.is_round:
        around = np.arctan2(met[1], met[0]) * obstacle.half_x_m
    else:
        around = met[0] * normal[1] - met[1] * normal[0]
    u, v = np.where(on_top, met[0], around), np.where(on_top, met[1], met[2])
    light = Se2(0.0, 0.0, -obstacle.world_from_solid.theta_rad).apply(LIGHT[None, :])[0]
    facing = normal[0] * light[0] + normal[1] * light[1]
    side = 1.0 - (1.0 - DARKEST_SIDE) * (0.75 - 0.25 * facing)
    factor: Floats = np.where(on_top, 1.0, side) * _surface(obstacle, u, v, face)
    return factor
