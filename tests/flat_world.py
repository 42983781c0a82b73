"""A painted floor and its pictures: small and quick, for tests of the front-end's single parts."""

import functools

import cv2
import numpy as np

from groundfuse.frontend.overhead import floor_from_rays

CELL_M = 0.002
SIDE_PX = 1440


@functools.lru_cache(maxsize=4)
def painted_floor(seed, grain_px=2.0, contrast=45.0):
    """A BGR floor of 2.9 m with blobs of every colour; the world's origin is in the middle."""
    noise = np.random.default_rng(seed).random((SIDE_PX, SIDE_PX, 3), dtype=np.float32)
    smooth = cv2.GaussianBlur(noise - 0.5, (0, 0), grain_px)
    common = smooth.mean(axis=2, keepdims=True)
    mixed = common / common.std() + 0.7 * smooth / smooth.std()
    return np.clip(120.0 + contrast * mixed, 0, 255)


@functools.lru_cache(maxsize=16)
def rays_of(lens):
    """Rays of all pixels and of a border of one."""
    u, v = np.meshgrid(np.arange(-1, lens.width_px + 1), np.arange(-1, lens.height_px + 1))
    return lens.rays_from_px(np.stack([u, v], axis=-1).reshape(-1, 2).astype(float))


def photograph(floor, camera, attitude, world_from_foot, gain=(1.0, 1.0, 1.0), noise=0.0):
    """Picture of the floor, BGR; each pixel is the mean of 2 x 2 rays, linear in between."""
    lens = camera.intrinsics
    world = world_from_foot.apply(floor_from_rays(attitude, rays_of(lens)))
    # On the raster x runs up and y runs left.
    at = (np.nan_to_num(world[:, ::-1], nan=99.0) / -CELL_M + SIDE_PX / 2.0).astype(np.float32)
    coarse = at.reshape(lens.height_px + 2, lens.width_px + 2, 2)
    map_u, map_v = cv2.split(cv2.resize(coarse, None, fx=2, fy=2)[2:-2, 2:-2])
    fine = cv2.remap(floor, map_u, map_v, cv2.INTER_LINEAR)
    seen = cv2.resize(fine, (lens.width_px, lens.height_px), interpolation=cv2.INTER_AREA)
    grain = np.random.default_rng(0).normal(scale=noise, size=seen.shape) if noise else 0.0
    return np.clip(np.rint(seen * np.array(gain) + grain), 0, 255).astype(np.uint8)
