"""The loops of the photometric stage, compiled: grey residuals, their slopes, normal equations."""

import math
from typing import NamedTuple

from groundfuse.backend.compiled import compiled, part
from groundfuse.frontend.arrays import Floats, Picture32, Points


class Slopes(NamedTuple):
    """A blurred picture (rows, columns) and its grey values per pixel, rightwards and downwards."""

    picture: Picture32
    right: Picture32
    down: Picture32


class Lens(NamedTuple):
    """Rays (n, 2), their pixels (n, 2), and the pixels' derivatives by the rays (n, 2, 2)."""

    rays: Points
    places_px: Points
    by_ray: Floats


@part
def _read(picture: Picture32, u: float, v: float) -> float:
    """Return the grey value (bilinear) at a place; outside the border's own."""
    u, v = min(max(u, 0.0), picture.shape[1] - 1.0), min(max(v, 0.0), picture.shape[0] - 1.0)
    x, y = min(int(u), picture.shape[1] - 2), min(int(v), picture.shape[0] - 2)
    right, down = u - x, v - y
    upper = picture[y, x] + right * (picture[y, x + 1] - picture[y, x])
    lower = picture[y + 1, x] + right * (picture[y + 1, x + 1] - picture[y + 1, x])
    return float(upper + down * (lower - upper))


@compiled
def linearise(
    pictured: Slopes,
    lens: Lens,
    rows: Floats,
    wanted: Floats,
    light: Floats,
    error: Floats,
    jacobian: Floats,
) -> None:
    """Write grey residuals and their derivatives; both are 0 where a point is not seen.

    Args:
        pictured: the picture that is read.
        lens: what its lens makes of rays near by.
        rows: (n, 2, 12) as `fit_compiled` has them: rays by nine parameters, and in the end the
            rays themselves.
        wanted: (n,) grey values.
        light: (2,) gain and offset on them.
        error: (n,) is written.
        jacobian: (n, 11) by the nine, gain and offset, is written.
    """
    for i in range(len(wanted)):
        by_ray = lens.by_ray[i]
        dx, dy = rows[i, 0, 11] - lens.rays[i, 0], rows[i, 1, 11] - lens.rays[i, 1]
        u = lens.places_px[i, 0] + by_ray[0, 0] * dx + by_ray[0, 1] * dy
        v = lens.places_px[i, 1] + by_ray[1, 0] * dx + by_ray[1, 1] * dy
        error[i] = 0.0
        jacobian[i] = 0.0
        if not (math.isfinite(u) and math.isfinite(v)):
            continue
        by_u, by_v = _read(pictured.right, u, v), _read(pictured.down, u, v)
        across = by_u * by_ray[0, 0] + by_v * by_ray[1, 0]
        along = by_u * by_ray[0, 1] + by_v * by_ray[1, 1]
        for j in range(9):
            jacobian[i, j] = across * rows[i, 0, j] + along * rows[i, 1, j]
        jacobian[i, 9], jacobian[i, 10] = -wanted[i], -1.0
        error[i] = _read(pictured.picture, u, v) - light[0] * wanted[i] - light[1]


@compiled
def weigh(
    error: Floats, jacobian: Floats, residual: float, width: float, normal: tuple[Floats, Floats]
) -> None:
    """Add up the normal equations under Cauchy weights.

    Args:
        error: (n,) residuals.
        jacobian: (n, 11) their derivatives.
        residual: their standard deviation.
        width: of the kernel, in such.
        normal: (11, 11) and (11,), zero or what is known beforehand, are added to.
    """
    hessian, gradient = normal
    for i in range(len(error)):
        ratio = error[i] / (width * residual)
        weight = 1.0 / ((1.0 + ratio * ratio) * residual * residual)
        for p in range(11):
            weighted = weight * jacobian[i, p]
            gradient[p] += weighted * error[i]
            for q in range(p + 1):
                hessian[p, q] += weighted * jacobian[i, q]
    for p in range(11):
        for q in range(p):
            hessian[q, p] = hessian[p, q]
