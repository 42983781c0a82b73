"""Harris corners of the original picture (paper §2), at one scale on the floor.

A corner is found again in another picture only if both looked at the same size of floor detail, so
the Gaussian of the derivatives follows the floor: wide near the foot, narrow far ahead. Reference:
C. Harris and M. Stephens, A combined corner and edge detector, 1988.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from groundfuse.backend.measurement import Attitude
from groundfuse.backend.option_checks import check_numbers
from groundfuse.frontend.area_remap import singular_values
from groundfuse.frontend.arrays import Floats, Image, Mask, Picture32, Points
from groundfuse.frontend.camera import Camera
from groundfuse.frontend.overhead import floor_from_rays
from groundfuse.frontend.overhead_view import OverheadGrid

LATTICE_PX = 8
MIN_SIGMA_PX = 0.7
STEPS_PER_OCTAVE = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class CornerOptions:
    """What counts as a corner."""

    scale_cells: float = 1.1
    """Sigma of the derivatives' Gaussian on the floor, overhead cells."""
    window_ratio: float = 1.3
    """Sigma of the window that sums the derivatives, over the derivatives' own."""
    harris_k: float = 0.06
    """Weight of the squared trace."""
    spacing_px: int = 3
    """A corner is the strongest within this distance."""
    per_square_height: float = 350.0
    """Corners per squared camera height of useful floor, strongest first."""
    min_corners: int = 300
    """Corners of a camera that sees too little floor for that many, if there are so many."""
    max_corners: int = 900
    """Most corners of one picture."""
    sigma_ratio: float = 0.16
    """Localisation noise of a corner over the sigma it was found at."""

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense (ValueError)."""
        check_numbers(self, may_be_zero=("harris_k", "min_corners"))


class Corners(NamedTuple):
    """Corners, strongest first.

    Attributes:
        px: (n, 2) in the original picture.
        sigma_px: (n,) one-axis localisation noise.
    """

    px: Points
    sigma_px: Floats


def find_corners(
    grey: Image,
    camera: Camera,
    attitude: Attitude,
    grid: OverheadGrid,
    options: CornerOptions | None = None,
) -> Corners:
    """Return the corners of the useful floor of a grey picture (rows, columns)."""
    options = options or CornerOptions()
    length_m, useful = _footprint(camera, attitude, grid)
    octave = np.full(useful.shape, np.nan)
    wanted_px = options.scale_cells * grid.m_per_px / length_m[useful]
    octave[useful] = np.log2(np.maximum(wanted_px, MIN_SIGMA_PX))
    found = [
        _level(
            grey,
            np.rint(octave * STEPS_PER_OCTAVE) == step,
            2.0 ** (step / STEPS_PER_OCTAVE),
            options,
        )
        for step in _steps(octave[useful])
    ]
    px, strength, sigma_px = (np.concatenate(part) for part in zip(*found, strict=True))
    order = np.argsort(-strength, kind="stable")
    lengths = length_m[useful].astype(np.float64) / camera.mount.attitude.height_m
    count = round(options.per_square_height * float(lengths @ lengths))
    kept = order[: min(max(count, options.min_corners), options.max_corners)]
    return Corners(px[kept], sigma_px[kept] * options.sigma_ratio)


def _steps(octaves: Floats) -> Iterator[int]:
    low, high = octaves.min() * STEPS_PER_OCTAVE, octaves.max() * STEPS_PER_OCTAVE
    yield from range(round(float(low)), round(float(high)) + 1)


def _footprint(camera: Camera, attitude: Attitude, grid: OverheadGrid) -> tuple[Picture32, Mask]:
    """Mean length of a pixel on the floor, m, and the pixels that show useful floor."""
    lens, (first, last) = camera.intrinsics, camera.used_rows
    u = np.arange(0.0, lens.width_px + LATTICE_PX, LATTICE_PX)
    v = np.arange(0.0, lens.height_px + LATTICE_PX, LATTICE_PX)
    px = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    floor = floor_from_rays(attitude, lens.rays_from_px(px)).reshape(len(v), len(u), 2)
    by_v = np.asarray(np.gradient(floor, v, axis=0), dtype=np.float64)
    by_u = np.asarray(np.gradient(floor, u, axis=1), dtype=np.float64)
    most, least = singular_values(by_u, by_v)
    distance = np.hypot(floor[..., 0], floor[..., 1])
    both = np.stack([np.sqrt(most * least), distance], axis=-1).astype(np.float32)
    size = (len(u) * LATTICE_PX, len(v) * LATTICE_PX)
    # Resizing puts lattice point k at pixel (k + 1/2) LATTICE_PX - 1/2: cut so that it lies at 8 k.
    offset = LATTICE_PX // 2
    resized = cv2.resize(both, size, interpolation=cv2.INTER_LINEAR)
    dense = np.asarray(resized, dtype=np.float32)[offset:, offset:]
    dense = dense[: lens.height_px, : lens.width_px]
    useful = dense[..., 1] <= grid.far_m
    useful[:first], useful[last + 1 :] = False, False
    return dense[..., 0], useful


def _level(
    grey: Image, wanted: Mask, sigma_px: float, options: CornerOptions
) -> tuple[Points, Floats, Floats]:
    """Corners among the wanted pixels at one scale: places, strengths, scales."""
    rows = np.flatnonzero(wanted.any(axis=1))
    if len(rows) == 0:
        return np.zeros((0, 2)), np.zeros(0), np.zeros(0)
    halvings = max(0, math.floor(math.log2(sigma_px)))
    factor = 2**halvings
    margin = math.ceil(8 * sigma_px)
    top = max(0, (rows[0] - margin) // factor * factor)
    strip = grey[top : rows[-1] + margin + 1]
    for _ in range(halvings):
        strip = np.asarray(cv2.pyrDown(strip), dtype=np.uint8)
    response = _harris(strip, sigma_px / factor, halvings, options)
    near = np.ones((2 * options.spacing_px + 1,) * 2, np.uint8)
    peak = (response == cv2.dilate(response, near)) & (response > 0.0)
    peak[:2], peak[-2:], peak[:, :2], peak[:, -2:] = False, False, False, False
    v, u = np.nonzero(peak)
    inside = wanted[
        np.minimum(v * factor + top, len(wanted) - 1), np.minimum(u * factor, wanted.shape[1] - 1)
    ]
    v, u = v[inside], u[inside]
    px = _refined(response, u, v) * factor + np.array([0.0, top])
    return px, response[v, u].astype(np.float64), np.full(len(u), sigma_px)


def _harris(strip: Image, sigma_px: float, halvings: int, options: CornerOptions) -> Picture32:
    """Scale-normalised response; each halving has blurred by a sigma of 1 before it."""
    blurred_already = (1.0 - 0.25**halvings) / 3.0
    sigma_left = math.sqrt(max(sigma_px**2 - blurred_already, 0.25))
    smooth = cv2.GaussianBlur(strip.astype(np.float32), (0, 0), sigma_left)
    by_u = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=sigma_px / 8.0)
    by_v = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=sigma_px / 8.0)
    window = options.window_ratio * sigma_px
    uu, vv, uv = (
        cv2.GaussianBlur(product, (0, 0), window)
        for product in (by_u * by_u, by_v * by_v, by_u * by_v)
    )
    response: Picture32 = np.asarray(
        uu * vv - uv * uv - options.harris_k * (uu + vv) ** 2, dtype=np.float32
    )
    return response


def _refined(response: Picture32, u: np.ndarray, v: np.ndarray) -> Points:
    """Peaks to a fraction of a pixel: a parabola along each axis."""
    centre = response[v, u]
    offsets = []
    for before, after in (
        (response[v, u - 1], response[v, u + 1]),
        (response[v - 1, u], response[v + 1, u]),
    ):
        curvature = np.maximum(2.0 * centre - before - after, 1e-30)
        offsets.append(np.clip((after - before) / (2.0 * curvature), -0.5, 0.5))
    px: Points = np.stack([u + offsets[0], v + offsets[1]], axis=1).astype(np.float64)
    return px
