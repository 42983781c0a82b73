"""What a tilted camera sees of a floor with obstacles, anti-aliased and exact to the pixel centre.

Every pixel is the mean of SUPER x SUPER rays spread evenly over its square (pixel centres at
integers). Each ray reads the floor's pyramid at the level whose cells are as long as the longer
side of the ray's own share of the floor, blended between two levels: with SUPER rays across, a
footprint up to SUPER times longer than wide is filtered without blurring its short side.
"""

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from groundfuse.backend.measurement import Attitude, Se2
from groundfuse.frontend.arrays import Floats, Picture32, Points
from groundfuse.frontend.camera import Camera, Intrinsics
from groundfuse.frontend.overhead import foot_from_cam
from groundfuse.tools.floor_raster import LEVELS, FloorRaster
from groundfuse.tools.noise import Rect
from groundfuse.tools.obstacles import Obstacle, meet

SUPER = 3
BLOCK = 80  # pixels a side: a small block needs little of the floor around it
SPARSE = 8  # the level of detail varies slowly: it is computed at every 8th ray
HAZE_BEGINS = 5.0  # camera heights from the foot; beyond, the floor fades into its mean colour
HAZE_ENDS = 6.0


@dataclass(frozen=True, slots=True)
class World:
    """A floor and what stands on it."""

    floor: FloorRaster
    obstacles: tuple[Obstacle, ...] = ()


@functools.lru_cache(maxsize=8)
def _super_rays(intrinsics: Intrinsics) -> Picture32:
    """Rays (rows * SUPER, columns * SUPER, 2) of the sub-pixel squares' centres.

    Exact at pixel centres, linear in between: with plumb_bob k1 = -0.3 the worst error is
    k1 r f (1 px / f)**2 / 8 x 6 = 3e-4 px.
    """
    rows, columns = intrinsics.height_px + 2, intrinsics.width_px + 2
    v, u = np.mgrid[0:rows, 0:columns] - 1.0
    rays = intrinsics.rays_from_px(np.column_stack([u.ravel(), v.ravel()]))
    if not np.isfinite(rays).all():
        raise ValueError("the distortion model has no ray for some pixels of the picture")
    picture = rays.reshape(rows, columns, 2)
    finer = cv2.resize(picture, (columns * SUPER, rows * SUPER), interpolation=cv2.INTER_LINEAR)
    return finer[SUPER:-SUPER, SUPER:-SUPER].astype(np.float32)


def _directions(rays: Picture32, attitude: Attitude, heading_rad: float) -> Picture32:
    """Turn rays (rows, columns, 2) into world directions (rows, columns, 3)."""
    turn = Se2(0.0, 0.0, heading_rad).matrix()
    world_from_cam = turn @ foot_from_cam(attitude.tilt_rad, attitude.roll_rad)
    return np.asarray(cv2.transform(rays, world_from_cam), dtype=np.float32)


def _parts(side: int) -> list[slice]:
    edges = np.linspace(0, side, max(1, side // BLOCK) + 1).astype(int).tolist()
    return [slice(start, stop) for start, stop in itertools.pairwise(edges)]


def _finer(pixels: slice) -> slice:
    return slice(pixels.start * SUPER, pixels.stop * SUPER)


def _levels(x: Picture32, y: Picture32, cell_m: float) -> Picture32:
    """Level of the pyramid (rows, columns) of each ray from the spacing of floor points (m)."""
    sparse = (slice(None, None, SPARSE), slice(None, None, SPARSE))
    apart = [np.gradient(axis[sparse] / SPARSE) for axis in (x, y)]
    longer = np.maximum(*(np.hypot(apart[0][k], apart[1][k]) for k in (0, 1)))
    level = np.log2(np.maximum(longer, 1e-12) / cell_m)
    clipped = np.clip(level, 0.0, LEVELS - 1.0).astype(np.float32)
    return np.asarray(cv2.resize(clipped, x.shape[::-1]), dtype=np.float32)


def _read(floor: FloorRaster, x: Picture32, y: Picture32, foot: Se2, level: int) -> Picture32:
    """Read the floor at (x, y) metres from the foot: the mean of each SUPER x SUPER square."""
    cell = floor.cell_m * 2.0**level
    left, top = foot.x_m / cell - 0.5, foot.y_m / cell - 0.5
    x0, y0 = (int(np.floor(a.min() / cell + b)) for a, b in ((x, left), (y, top)))
    x1, y1 = (int(np.floor(a.max() / cell + b)) + 2 for a, b in ((x, left), (y, top)))
    source = floor.patch(Rect(x0, y0, x1 - x0, y1 - y0), level)
    columns = x * np.float32(1.0 / cell) + np.float32(left - x0)
    rows = y * np.float32(1.0 / cell) + np.float32(top - y0)
    read = cv2.remap(source, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return _squares(np.asarray(read))


def _squares(picture: Picture32 | Floats | np.ndarray) -> Picture32:
    """Mean of each SUPER x SUPER square."""
    size = (picture.shape[1] // SUPER, picture.shape[0] // SUPER)
    mean = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    return np.asarray(mean, dtype=np.float32)


def _floor_block(floor: FloorRaster, rays: Picture32, attitude: Attitude, foot: Se2) -> Picture32:
    """Colours (rows, columns, 3) of a block of pixels where nothing stands on the floor."""
    direction = _directions(rays, attitude, foot.theta_rad)
    # A ray near or over the horizon is cut off at the end of the haze, where the floor is not read.
    flat = np.maximum(np.hypot(direction[..., 0], direction[..., 1]), 1e-9)
    reach = np.where(direction[..., 2] < 0.0, -attitude.height_m / direction[..., 2], np.inf)
    farthest = HAZE_ENDS * attitude.height_m
    scale = np.minimum(reach, farthest / flat).astype(np.float32)
    x, y = direction[..., 0] * scale, direction[..., 1] * scale
    level = _levels(x, y, floor.cell_m)
    at_pixel = _squares(level)
    total = np.zeros((*at_pixel.shape, 3), dtype=np.float32)
    for k in range(int(level.min()), int(np.ceil(level.max())) + 1):
        weight = np.maximum(1.0 - np.abs(at_pixel - k), 0.0)
        used = np.flatnonzero(weight.any(axis=1))
        if len(used) > 0:
            part = slice(int(used[0]), int(used[-1]) + 1)
            finer = _finer(part)
            total[part] += weight[part, :, None] * _read(floor, x[finer], y[finer], foot, k)
    clear = np.clip(
        (HAZE_ENDS - flat * scale / attitude.height_m) / (HAZE_ENDS - HAZE_BEGINS), 0, 1
    )
    if clear.min() >= 1.0:
        return total
    share = _squares(clear.astype(np.float32))[..., None]
    return (share * total + (1.0 - share) * floor.mean_colour()).astype(np.float32)


def _extent(corners: Points, attitude: Attitude, foot: Se2, rays: Picture32) -> tuple[int, ...]:
    """Pixels (row0, row1, column0, column1) that can see a solid; empty where none can."""
    in_foot = foot.inverse().apply(corners[:, :2])
    below = np.column_stack([in_foot, corners[:, 2] - attitude.height_m])
    in_cam = below @ foot_from_cam(attitude.tilt_rad, attitude.roll_rad)
    rows, columns = rays.shape[0] // SUPER, rays.shape[1] // SUPER
    if (in_cam[:, 2] <= 0.0).all():
        return (0, 0, 0, 0)
    if (in_cam[:, 2] < 0.05 * attitude.height_m).any():
        return (0, rows, 0, columns)
    seen = in_cam[:, :2] / in_cam[:, 2:]
    centre = np.ascontiguousarray(rays[SUPER // 2 :: SUPER, SUPER // 2 :: SUPER])
    margin = 4.0 * float(np.abs(centre[0, 1] - centre[0, 0]).max())
    inside = ((centre >= seen.min(0) - margin) & (centre <= seen.max(0) + margin)).all(axis=2)
    if not inside.any():
        return (0, 0, 0, 0)
    in_rows, in_columns = np.flatnonzero(inside.any(1)), np.flatnonzero(inside.any(0))
    return (
        int(in_rows[0]), int(in_rows[-1]) + 1, int(in_columns[0]), int(in_columns[-1]) + 1
    )  # fmt: skip


def _draw_obstacles(
    picture: Picture32, obstacles: Sequence[Obstacle], rays: Picture32, view: tuple[Attitude, Se2]
) -> None:
    """Put solids into a picture in place, farthest first; edges by the share of rays that meet."""
    attitude, foot = view
    origin = np.array([foot.x_m, foot.y_m, attitude.height_m])

    def distance(obstacle: Obstacle) -> float:
        place = obstacle.world_from_solid
        return -float(np.hypot(place.x_m - foot.x_m, place.y_m - foot.y_m))

    for obstacle in sorted(obstacles, key=distance):
        r0, r1, c0, c1 = _extent(obstacle.corners(), attitude, foot, rays)
        if r1 <= r0 or c1 <= c0:
            continue
        part = rays[r0 * SUPER : r1 * SUPER, c0 * SUPER : c1 * SUPER]
        direction = _directions(part, attitude, foot.theta_rad)
        hit = meet(obstacle, origin, direction.reshape(-1, 3))
        met = np.isfinite(hit.along).astype(np.float32).reshape(part.shape[:2])
        colour = hit.colour.reshape(*part.shape[:2], 3) * met[..., None]
        share = _squares(met)[..., None]
        picture[r0:r1, c0:c1] = picture[r0:r1, c0:c1] * (1.0 - share) + _squares(colour)


def render_view(
    world: World, camera: Camera, attitude: Attitude, world_from_base: Se2
) -> Picture32:
    """Return what the camera sees: BGR (rows, columns, 3), 0 to 255, before the photometry.

    Args:
        world: the floor and the obstacles.
        camera: intrinsics and place on the robot; its nominal attitude is not used.
        attitude: the true tilt, roll and height of this picture.
        world_from_base: the robot.

    Raises:
        ValueError: the distortion model has no ray for a pixel.
    """
    foot = world_from_base @ camera.mount.base_from_foot
    rays = _super_rays(camera.intrinsics)
    picture = np.empty((rays.shape[0] // SUPER, rays.shape[1] // SUPER, 3), dtype=np.float32)
    for rows, columns in itertools.product(*(_parts(side) for side in picture.shape[:2])):
        finer = (_finer(rows), _finer(columns))
        picture[rows, columns] = _floor_block(world.floor, rays[finer], attitude, foot)
    _draw_obstacles(picture, world.obstacles, rays, (attitude, foot))
    return picture
