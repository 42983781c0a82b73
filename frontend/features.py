"""Features of one picture: found in its overhead view, kept per square metre of floor.

Overhead views of robots with different tilts look alike up to a rotation, which SIFT takes in its
stride; the local contrast normalisation makes low-contrast floors usable; a density per floor area
keeps the near, finely resolved part of the picture from taking all features.
"""

from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np

from groundfuse.backend.measurement import Attitude
from groundfuse.backend.option_checks import check_numbers
from groundfuse.frontend.arrays import Floats, Image, Mask, Picture32, Points
from groundfuse.frontend.camera import Camera
from groundfuse.frontend.keypoints import Keypoints, blobs, corners
from groundfuse.frontend.normalise import local_contrast
from groundfuse.frontend.overhead import floor_from_rays, rays_from_floor
from groundfuse.frontend.overhead_view import (
    OverheadGrid,
    OverheadOptions,
    overhead_grid,
    overhead_view,
)
from groundfuse.frontend.repetition import repetition

INNER = np.ones((9, 9), np.uint8)
"""Features keep half of this away from the end of the floor."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FeatureOptions:
    """Options of detection.

    Attributes:
        overhead: raster of the overhead view.
        kind: "sift" or "orb".
        per_square_height: features kept per squared camera height of floor.
        max_features: most features kept of one frame.
        contrast_radius_px: neighbourhood of the contrast normalisation, overhead pixels.
        contrast_floor_grey: smallest local standard deviation, grey values.
        contrast_gain_grey: grey values per local standard deviation, for ORB.
        contrast_threshold: SIFT's, local standard deviations that a blob stands out at least.
        sigma_overhead_px: localisation noise of a feature in the overhead view.
        sigma_image_px: localisation noise that the picture itself adds.
        cell_px: side of the cells over which the features are spread, overhead pixels.
    """

    overhead: OverheadOptions = field(default_factory=OverheadOptions)
    kind: str = "sift"
    per_square_height: float = 400.0
    max_features: int = 600
    contrast_radius_px: float = 12.0
    contrast_floor_grey: float = 1.5
    contrast_gain_grey: float = 40.0
    contrast_threshold: float = 0.0425
    sigma_overhead_px: float = 0.15
    sigma_image_px: float = 0.15
    cell_px: int = 48

    def __post_init__(self) -> None:
        """Refuse a kind that there is not, and numbers that make no sense (ValueError)."""
        check_numbers(self, may_be_zero=("contrast_threshold", "sigma_image_px"))
        if self.kind not in {"sift", "orb"}:
            raise ValueError(f"kind must be sift or orb, got {self.kind!r}")


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """Features of one frame.

    Attributes:
        floor_m: (n, 2) at the nominal attitude, metres in `foot`.
        rays: (n, 2) undistorted rays.
        sigma: (n,) standard deviation of the rays.
        log_size: (n,) log of the feature's diameter on the floor.
        angle_rad: (n,) orientation in `foot`, counter-clockwise from x.
        descriptors: (n, 128) float32 RootSIFT of unit length, or (n, 32) uint8 bits.
        grid: raster of the overhead view.
        height_m: nominal camera height.
        wobble_m: distance that the mount's wobble moves floor points, after the best isometry.
        wobble_scaled_m: the same after the best similarity.
        log_scale: standard deviation of the log scale due to wobble.
        repetition: second peak of the view's autocorrelation; see `repetition.py`.
    """

    floor_m: Points
    rays: Points
    sigma: Floats
    log_size: Floats
    angle_rad: Floats
    descriptors: np.ndarray[Any, Any]
    grid: OverheadGrid
    height_m: float
    wobble_m: float
    wobble_scaled_m: float
    log_scale: float
    repetition: float

    def __len__(self) -> int:
        return len(self.floor_m)


def detect(
    image: Image, camera: Camera, attitude: Attitude, sigma: Attitude, options: FeatureOptions
) -> Features:
    """Return the features of a BGR picture of a camera at an attitude known to within sigma."""
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
    grid = overhead_grid(camera, attitude, options.overhead)
    view, mask = overhead_view(np.asarray(grey, dtype=np.uint8), camera, attitude, grid)
    normalised = local_contrast(view, mask, options.contrast_radius_px, options.contrast_floor_grey)
    wanted = _wanted(mask, grid, camera.mount.attitude.height_m, options)
    found = _found(normalised, mask, wanted, options)
    floor = grid.floor_from_overhead(found.points_px)
    rays = rays_from_floor(attitude, floor)
    wobble = _wobble(attitude, sigma, floor, rays)
    return Features(
        floor,
        rays,
        _sigma(attitude, floor, grid, camera, options),
        np.log(found.size_px * grid.m_per_px),
        -found.angle_rad - np.pi / 2.0,  # clockwise from "right" = -y; foot x is "up"
        found.descriptors,
        grid,
        attitude.height_m,
        *wobble,
        repetition(normalised, mask),
    )


def _wanted(mask: Mask, grid: OverheadGrid, height_m: float, options: FeatureOptions) -> int:
    area_heights = float(mask.sum()) * (grid.m_per_px / height_m) ** 2
    return min(options.max_features, round(options.per_square_height * area_heights))


def _found(normalised: Picture32, mask: Mask, wanted: int, options: FeatureOptions) -> Keypoints:
    """Detect, spread over the floor, describe."""
    inner = np.asarray(cv2.erode(mask.astype(np.uint8), INNER, borderValue=0), dtype=np.bool_)
    if options.kind == "sift":
        return blobs(normalised, inner, wanted, options.contrast_threshold, options.cell_px)
    flat = np.clip(128.0 + options.contrast_gain_grey * normalised, 0, 255).astype(np.uint8)
    # An arc that differs by less than a local standard deviation is hardly ever among the best.
    return corners(flat, inner, wanted, options.contrast_gain_grey, options.cell_px)


def _sigma(
    attitude: Attitude, floor: Points, grid: OverheadGrid, camera: Camera, options: FeatureOptions
) -> Floats:
    """Standard deviation of the rays: overhead localisation seen from the camera, plus its own."""
    across = np.array([[0.0, 1e-4 * attitude.height_m]])
    along = across[:, ::-1]
    here = rays_from_floor(attitude, floor)
    du = (rays_from_floor(attitude, floor + across) - here) / 1e-4 / attitude.height_m
    dv = (rays_from_floor(attitude, floor + along) - here) / 1e-4 / attitude.height_m
    area = np.abs(du[:, 0] * dv[:, 1] - du[:, 1] * dv[:, 0])
    by_overhead = np.sqrt(area) * grid.m_per_px * options.sigma_overhead_px
    sigma: Floats = np.hypot(by_overhead, options.sigma_image_px / camera.intrinsics.focal_px)
    return sigma


def _wobble(
    attitude: Attitude, sigma: Attitude, floor: Points, rays: Points
) -> tuple[float, float, float]:
    """Root mean square floor motion by wobble: after isometry, after similarity; log scale."""
    if len(floor) < 3:
        return 0.0, 0.0, 0.0
    rigid = stretched = log_scale = 0.0
    centred = floor - floor.mean(axis=0)
    spread = float((centred**2).sum())
    for k in range(3):
        unit = [0.0, 0.0, 0.0]
        unit[k] = (sigma.tilt_rad, sigma.roll_rad, sigma.height_m)[k] * 0.1
        moved = floor_from_rays(
            Attitude(
                attitude.tilt_rad + unit[0],
                attitude.roll_rad + unit[1],
                attitude.height_m + unit[2],
            ),
            rays,
        )
        shift = (moved - floor) / 0.1
        shift = shift[np.isfinite(shift).all(axis=1)]
        if len(shift) != len(floor):
            continue
        shift = shift - shift.mean(axis=0)
        turn = float((centred[:, 0] * shift[:, 1] - centred[:, 1] * shift[:, 0]).sum()) / spread
        scale = float((centred * shift).sum()) / spread
        rest = shift - turn * np.stack([-centred[:, 1], centred[:, 0]], axis=1)
        rigid += float((rest**2).sum(axis=1).mean())
        stretched += float(((rest - scale * centred) ** 2).sum(axis=1).mean())
        log_scale += scale**2
    return rigid**0.5, stretched**0.5, log_scale**0.5
