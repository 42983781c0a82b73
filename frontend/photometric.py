"""The photometric stage: the pair fit's nine parameters from grey values instead of features.

Lucas and Kanade's alignment (1981) on locally normalised pictures, from coarse blur to fine, with
the floor's transfer as warp and a gain and an offset beside the nine parameters. Any detector's
start within a pixel or two ends at the same place; without the local normalisation it would follow
the light instead of the floor.
"""

import functools
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from groundfuse.backend.measurement import Attitude, Se2
from groundfuse.backend.option_checks import check_numbers
from groundfuse.frontend.arrays import Floats, Image, Mask, Points
from groundfuse.frontend.camera import Camera, Intrinsics
from groundfuse.frontend.fit import Prior
from groundfuse.frontend.fit_compiled import transfer_rows
from groundfuse.frontend.middle import middle
from groundfuse.frontend.normalise import local_contrast
from groundfuse.frontend.normalise_compiled import halves
from groundfuse.frontend.photometric_compiled import Lens, Slopes, linearise, weigh

RAY_STEP = 1e-6
MAD_TO_SIGMA = 1.4826
SETTLED, NEARLY = 1e-4, 1e-2
"""Squared length of a step in sigmas that ends the last pass, and those before it."""
REMEMBERED = 64
"""Blurred pictures whose points are remembered: those of a few pictures, some 100 kB each."""
FAINTEST = 1e-3  # local standard deviations: below is the rounding of the normalised pictures


@dataclass(frozen=True, slots=True, kw_only=True)
class PhotometricOptions:
    """Options of the photometric stage; pixels are the picture's.

    Attributes:
        contrast_radius_px: neighbourhood of the contrast normalisation.
        contrast_floor_grey: smallest local standard deviation, grey values.
        blurs_px: Gaussian blur of each pass, coarse to fine.
        cell_px: one point, the one of steepest gradient, is taken from each cell.
        iterations: most steps per pass.
        max_stretch: points whose floor one picture resolves this much finer are left out.
        min_points: fewest points that both pictures show.
        cauchy_sigmas: width of the robust kernel.
        correlation: factor on the variance for what neighbouring points share.
        max_residual: largest residual deviation, as a share of the grey values' own; pictures that
            fit leave 0.15 to 0.35 (bare concrete), of grass from the air up to 1.3; pictures that
            do not fit leave 2.5 and more.
    """

    contrast_radius_px: float = 12.0
    contrast_floor_grey: float = 1.5
    blurs_px: tuple[float, ...] = (3.0, 1.5)
    cell_px: int = 9
    iterations: int = 12
    max_stretch: float = 3.0
    min_points: int = 60
    cauchy_sigmas: float = 2.0
    correlation: float = 2.0
    max_residual: float = 1.8

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense (ValueError)."""
        check_numbers(self, may_be_inf=("max_stretch", "max_residual"))


@dataclass(frozen=True, slots=True, eq=False)
class GreyView:
    """A picture made ready.

    Attributes:
        normalised: (rows, columns) float16 to halve the memory, locally of zero mean and unit
            deviation.
        camera: whose picture.
    """

    normalised: NDArray[np.float16]
    camera: Camera


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """The aligned pair.

    Attributes:
        a_from_b: pose of foot b in foot a.
        covariance: (3, 3), tangent at b, everything else marginalised.
        attitude_a: attitude of a.
        attitude_b: attitude of b.
        num_points: points used.
        residual: robust deviation of the grey residuals over that of the grey values they explain;
            infinite where they explain nothing.
    """

    a_from_b: Se2
    covariance: Floats
    attitude_a: Attitude
    attitude_b: Attitude
    num_points: int
    residual: float


def grey_view(image: Image, camera: Camera, options: PhotometricOptions) -> GreyView:
    """Normalise the used part of a picture."""
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    mask = np.zeros(grey.shape, dtype=np.bool_)
    first, last = camera.used_rows
    mask[first : last + 1] = True
    normalised = local_contrast(grey, mask, options.contrast_radius_px, options.contrast_floor_grey)
    return GreyView(halves(normalised).view(np.float16), camera)


def align(
    a: GreyView,
    b: GreyView,
    start: Se2,
    prior_a: Prior,
    prior_b: Prior,
    attitudes: tuple[Attitude, Attitude],
    options: PhotometricOptions,
) -> Alignment | None:
    """Align two pictures; None where they share too few points.

    Args:
        a: picture a.
        b: picture b.
        start: pose of foot b in foot a.
        prior_a: attitude of camera a.
        prior_b: attitude of camera b.
        attitudes: start of those of a and b.
        options: see `PhotometricOptions`.
    """
    mean, sigma = _joint(prior_a, prior_b)
    pose, attitude = start, np.concatenate([_vector(found) for found in attitudes])
    light = np.array([1.0, 0.0])
    hessian, residual, contrast, points = np.eye(11), np.inf, 0.0, _NO_POINTS
    for blur_px in options.blurs_px:
        points = _shared(_steepest(a, blur_px, options.cell_px), a, b, pose, attitude, options)
        if len(points.grey) < options.min_points:
            return None
        contrast = MAD_TO_SIGMA * float(np.median(np.abs(points.grey - np.median(points.grey))))
        pictured = _pictured(b, blur_px)
        lens = _lens(b.camera.intrinsics, _rows(points.rays, pose, attitude)[:, :, 11])
        for _ in range(options.iterations):
            error, jacobian = _linearised(points, pictured, lens, pose, attitude, light)
            residual = max(FAINTEST, MAD_TO_SIGMA * float(middle(np.abs(error))))
            hessian, gradient = _prior_part(sigma) + 1e-9 * np.eye(11), np.zeros(11)
            gradient[3:9] = (attitude - mean) / sigma**2
            weigh(error, jacobian, residual, options.cauchy_sigmas, (hessian, gradient))
            step: Floats = -np.linalg.solve(hessian, gradient).astype(np.float64)
            pose = pose @ Se2(float(step[0]), float(step[1]), float(step[2]))
            attitude, light = attitude + step[3:9], light + step[9:]
            if step @ hessian @ step < (SETTLED if blur_px == options.blurs_px[-1] else NEARLY):
                break
    explained = abs(float(light[0])) * contrast
    # Only the data's part of the information is worth less for what points share.
    prior_part = _prior_part(sigma)
    covariance = np.linalg.inv((hessian - prior_part) / options.correlation + prior_part)[:3, :3]
    return Alignment(
        pose,
        (covariance + covariance.T) / 2.0,
        Attitude(*map(float, attitude[:3])),
        Attitude(*map(float, attitude[3:])),
        len(points.grey),
        residual / explained if explained > FAINTEST else np.inf,
    )


def _joint(prior_a: Prior, prior_b: Prior) -> tuple[Floats, Floats]:
    mean = np.concatenate([_vector(prior_a.mean), _vector(prior_b.mean)])
    return mean, np.concatenate([_vector(prior_a.sigma), _vector(prior_b.sigma)])


def _vector(attitude: Attitude) -> Floats:
    return np.array([attitude.tilt_rad, attitude.roll_rad, attitude.height_m])


def _prior_part(sigma: Floats) -> Floats:
    """Return what the priors add to the normal equations (11, 11)."""
    return np.diag(np.concatenate([np.zeros(3), 1.0 / sigma**2, np.zeros(2)]))


class _Steep(NamedTuple):
    """Pixels (n, 2) of a blurred picture, their rays (n, 2) and grey values (n,)."""

    points_px: Points
    rays: Points
    grey: Floats


_NO_POINTS = _Steep(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))


@functools.lru_cache(maxsize=REMEMBERED)
def _steepest(view: GreyView, blur_px: float, cell_px: int) -> _Steep:
    """Return the steepest pixel of each cell; remembered, as a picture is part of many pairs."""
    picture, right, down = _pictured(view, blur_px)
    steep = right**2 + down**2
    rows, columns = (side // cell_px for side in steep.shape)
    blocks = steep[: rows * cell_px, : columns * cell_px].reshape(rows, cell_px, columns, cell_px)
    place = blocks.transpose(0, 2, 1, 3).reshape(rows, columns, cell_px**2).argmax(axis=2)
    v = (np.arange(rows)[:, None] * cell_px + place // cell_px).ravel()
    u = (np.arange(columns)[None, :] * cell_px + place % cell_px).ravel()
    points = np.column_stack([u, v]).astype(np.float64)
    inside = _inside(points, view.camera)
    rays = view.camera.intrinsics.rays_from_px(points[inside])
    return _Steep(points[inside], rays, picture[v, u][inside].astype(np.float64))


def _shared(
    steep: _Steep,
    a: GreyView,
    b: GreyView,
    pose: Se2,
    attitude: Floats,
    options: PhotometricOptions,
) -> _Steep:
    """Return those points of a that b shows too, at a similar resolution."""
    rows = _rows(steep.rays, pose, attitude)
    in_b = b.camera.intrinsics.px_from_rays(rows[:, :, 11])
    finest, coarsest = _stretches(rows[:, :, 9:11])
    ratio = b.camera.intrinsics.focal_px / a.camera.intrinsics.focal_px
    fits = (finest * ratio < options.max_stretch) & (coarsest * ratio > 1.0 / options.max_stretch)
    kept = fits & _inside(in_b, b.camera)
    return _Steep(steep.points_px[kept], steep.rays[kept], steep.grey[kept])


def _stretches(by_rays_a: Floats) -> tuple[Floats, Floats]:
    """Return the larger and the smaller singular value (n,) of matrices (n, 2, 2); nan stays."""
    (a, b), (c, d) = by_rays_a[:, 0].T, by_rays_a[:, 1].T
    turning, mirroring = np.hypot(a + d, c - b), np.hypot(a - d, c + b)
    return (turning + mirroring) / 2.0, np.abs(turning - mirroring) / 2.0


def _rows(rays_a: Points, pose: Se2, attitude: Floats) -> Floats:
    """Return rows (n, 2, 12) as the fit has them: by nine parameters, by the ray, the ray in b."""
    rows = np.empty((len(rays_a), 2, 12))
    transfer_rows(rays_a, np.concatenate([pose.vector(), attitude]), rows)
    return rows


def _pictured(view: GreyView, blur_px: float) -> Slopes:
    """Return the picture, blurred, and its grey values per pixel along both axes."""
    blurred = cv2.GaussianBlur(view.normalised.astype(np.float32), (0, 0), blur_px)
    slopes = (cv2.Scharr(blurred, cv2.CV_32F, *axis, scale=1 / 32.0) for axis in ((1, 0), (0, 1)))
    return Slopes(*(np.asarray(made, dtype=np.float32) for made in (blurred, *slopes)))


def _lens(intrinsics: Intrinsics, rays: Points) -> Lens:
    """Return the lens as it is near rays (n, 2): over a pixel or two it is linear to 0.01 px."""
    px, units = intrinsics.px_from_rays(rays), RAY_STEP * np.eye(2)
    beside = [intrinsics.px_from_rays(rays + unit) for unit in units]
    by_ray = np.stack([(moved - px) / RAY_STEP for moved in beside], axis=2)
    return Lens(rays.copy(), np.ascontiguousarray(px), by_ray)


def _inside(points_px: Points, camera: Camera) -> Mask:
    first, last = camera.used_rows
    border = 4.0
    with np.errstate(invalid="ignore"):
        inside: Mask = (
            (points_px[:, 0] >= border)
            & (points_px[:, 0] <= camera.intrinsics.width_px - 1 - border)
            & (points_px[:, 1] >= first + border)
            & (points_px[:, 1] <= last - border)
        )
    return inside


def _linearised(
    points: _Steep,
    pictured: Slopes,
    lens: Lens,
    pose: Se2,
    attitude: Floats,
    light: Floats,
) -> tuple[Floats, Floats]:
    """Grey residuals (n,) and their Jacobian (n, 11): motion, attitudes, gain, offset."""
    rows = _rows(points.rays, pose, attitude)
    error, jacobian = np.empty(len(rows)), np.empty((len(rows), 11))
    linearise(pictured, lens, rows, points.grey, light, error, jacobian)
    return error, jacobian
