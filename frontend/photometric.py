"""The photometric stage: the pair fit's nine parameters from grey values instead of features.

Lucas and Kanade's alignment (1981) on locally normalised pictures, from coarse blur to fine, with
the floor's transfer as warp and a gain and an offset beside the nine parameters. Any detector's
start within a pixel or two ends at the same place; without the local normalisation it would follow
the light instead of the floor.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from groundfuse.backend.measurement import Attitude, Se2
from groundfuse.backend.option_checks import check_numbers
from groundfuse.frontend.arrays import Floats, Image, Mask, Picture32, Points
from groundfuse.frontend.camera import Camera, Intrinsics
from groundfuse.frontend.fit import Prior
from groundfuse.frontend.fit_compiled import transfer_rows
from groundfuse.frontend.normalise import local_contrast
from groundfuse.frontend.normalise_compiled import halves

RAY_STEP = 1e-6
MAD_TO_SIGMA = 1.4826
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
    hessian, residual, contrast, points = np.eye(11), np.inf, 0.0, np.zeros((0, 2))
    for blur_px in options.blurs_px:
        blurred_a, blurred_b = (_blurred(view, blur_px) for view in (a, b))
        points = _points(blurred_a, a, b, pose, attitude, options)
        if len(points) < options.min_points:
            return None
        rays_a = a.camera.intrinsics.rays_from_px(points)
        wanted = _sampled(blurred_a, points)
        contrast = MAD_TO_SIGMA * float(np.median(np.abs(wanted - np.median(wanted))))
        slopes = [_slope(blurred_b, *axis) for axis in ((1, 0), (0, 1))]
        for _ in range(options.iterations):
            error, jacobian = _linearised(
                rays_a, wanted, blurred_b, slopes, b.camera.intrinsics, pose, attitude, light
            )
            residual = max(FAINTEST, MAD_TO_SIGMA * float(np.median(np.abs(error))))
            weight = 1.0 / (1.0 + (error / (options.cauchy_sigmas * residual)) ** 2) / residual**2
            hessian, step = _step(error, jacobian, weight, sigma, mean - attitude)
            pose = pose @ Se2(float(step[0]), float(step[1]), float(step[2]))
            attitude, light = attitude + step[3:9], light + step[9:]
            if step @ hessian @ step < 1e-4:
                break
    explained = abs(float(light[0])) * contrast
    # Only the data's part of the information is worth less for what points share.
    prior_part = np.diag(np.r_[np.zeros(3), 1.0 / sigma**2, np.zeros(2)])
    covariance = np.linalg.inv((hessian - prior_part) / options.correlation + prior_part)[:3, :3]
    return Alignment(
        pose,
        (covariance + covariance.T) / 2.0,
        Attitude(*map(float, attitude[:3])),
        Attitude(*map(float, attitude[3:])),
        len(points),
        residual / explained if explained > FAINTEST else np.inf,
    )


def _blurred(view: GreyView, blur_px: float) -> Picture32:
    blurred = cv2.GaussianBlur(view.normalised.astype(np.float32), (0, 0), blur_px)
    return np.asarray(blurred, dtype=np.float32)


def _joint(prior_a: Prior, prior_b: Prior) -> tuple[Floats, Floats]:
    mean = np.concatenate([_vector(prior_a.mean), _vector(prior_b.mean)])
    return mean, np.concatenate([_vector(prior_a.sigma), _vector(prior_b.sigma)])


def _vector(attitude: Attitude) -> Floats:
    return np.array([attitude.tilt_rad, attitude.roll_rad, attitude.height_m])


def _points(
    picture: Picture32,
    a: GreyView,
    b: GreyView,
    pose: Se2,
    attitude: Floats,
    options: PhotometricOptions,
) -> Points:
    """The steepest pixel of each cell of a that b shows too, at a similar resolution."""
    steep = _slope(picture, 1, 0) ** 2 + _slope(picture, 0, 1) ** 2
    cell = options.cell_px
    rows, columns = (side // cell for side in steep.shape)
    blocks = steep[: rows * cell, : columns * cell].reshape(rows, cell, columns, cell)
    place = blocks.transpose(0, 2, 1, 3).reshape(rows, columns, cell * cell).argmax(axis=2)
    v = np.arange(rows)[:, None] * cell + place // cell
    u = np.arange(columns)[None, :] * cell + place % cell
    points = np.column_stack([u.ravel(), v.ravel()]).astype(np.float64)
    inside = _inside(points, a.camera)
    points = points[inside]
    rays = a.camera.intrinsics.rays_from_px(points)
    rows = _rows(rays, pose, attitude)
    in_b = b.camera.intrinsics.px_from_rays(rows[:, :, 11])
    finest, coarsest = _stretches(rows[:, :, 9:11])
    ratio = b.camera.intrinsics.focal_px / a.camera.intrinsics.focal_px
    fits = (finest * ratio < options.max_stretch) & (coarsest * ratio > 1.0 / options.max_stretch)
    return points[fits & _inside(in_b, b.camera)]


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


def _slope(picture: Picture32, right: int, down: int) -> Picture32:
    """Grey values per pixel along one axis."""
    return np.asarray(cv2.Scharr(picture, cv2.CV_32F, right, down) / 32.0, dtype=np.float32)


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


def _sampled(picture: Picture32, points_px: Points) -> Floats:
    u, v = np.nan_to_num(points_px.T, nan=-1e4).astype(np.float32)
    values = cv2.remap(picture, u[None], v[None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    sampled: Floats = values[0].astype(np.float64)
    return sampled


def _linearised(
    rays_a: Points,
    wanted: Floats,
    picture_b: Picture32,
    slopes: list[Picture32],
    lens: Intrinsics,
    pose: Se2,
    attitude: Floats,
    light: Floats,
) -> tuple[Floats, Floats]:
    """Grey residuals (n,) and their Jacobian (n, 11): motion, attitudes, gain, offset."""
    rows = _rows(rays_a, pose, attitude)
    rays_b = rows[:, :, 11]
    px = lens.px_from_rays(rays_b)
    lost = ~np.isfinite(px).all(axis=1)
    by_ray = np.stack(
        [(lens.px_from_rays(rays_b + RAY_STEP * unit) - px) / RAY_STEP for unit in np.eye(2)],
        axis=2,
    )
    slope = np.stack([_sampled(s, px) for s in slopes], axis=1)
    by_light = np.stack([-wanted, -np.ones_like(wanted)], axis=1)
    along = np.einsum("ni,nij->nj", slope, by_ray)
    by_nine: Floats = np.einsum("ni,nij->nj", along, rows[:, :, :9])
    jacobian = np.column_stack([by_nine, by_light])
    error: Floats = _sampled(picture_b, px) - light[0] * wanted - light[1]
    error[lost], jacobian[lost] = 0.0, 0.0
    return error, jacobian


def _step(
    error: Floats, jacobian: Floats, weight: Floats, sigma: Floats, pull: Floats
) -> tuple[Floats, Floats]:
    hessian = (jacobian * weight[:, None]).T @ jacobian
    gradient = jacobian.T @ (weight * error)
    hessian[3:9, 3:9] += np.diag(1.0 / sigma**2)
    gradient[3:9] -= pull / sigma**2
    hessian[np.diag_indices(11)] += 1e-9
    step: Floats = -np.linalg.solve(hessian, gradient).astype(np.float64)
    return hessian, step
