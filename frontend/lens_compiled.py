"""The loops that project rays through a lens, compiled; see `camera`."""

from typing import Any

import numpy as np

from groundfuse.backend.compiled import compiled


@compiled
def plumb_bob_px(rays: Any, scale: Any, coefficients: Any, px: Any) -> None:  # noqa: ANN401 - arrays, typed when compiled
    """Fill px (n, 2) of rays (n, 2) with the plumb bob's or the rational model.

    Args:
        rays: nan stays nan.
        scale: (4,) focal lengths and principal point, px.
        coefficients: (8,) k1, k2, p1, p2, k3 to k6, as OpenCV has them.
        px: to fill.
    """
    k1, k2, p1, p2 = coefficients[0], coefficients[1], coefficients[2], coefficients[3]
    k3, k4, k5, k6 = coefficients[4], coefficients[5], coefficients[6], coefficients[7]
    fx, fy, cx, cy = scale[0], scale[1], scale[2], scale[3]
    for k in range(len(rays)):
        x, y = rays[k, 0], rays[k, 1]
        r2 = x * x + y * y
        radial = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        u = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        v = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
        px[k, 0], px[k, 1] = fx * u + cx, fy * v + cy


@compiled
def fisheye_px(rays: Any, scale: Any, coefficients: Any, px: Any) -> None:  # noqa: ANN401
    """Fill px (n, 2) of rays (n, 2) with the equidistant model.

    Args:
        rays: nan stays nan.
        scale: (4,) focal lengths and principal point, px.
        coefficients: (8,) k1 to k4, as OpenCV has them, and zeros.
        px: to fill.
    """
    k1, k2, k3, k4 = coefficients[0], coefficients[1], coefficients[2], coefficients[3]
    fx, fy, cx, cy = scale[0], scale[1], scale[2], scale[3]
    for k in range(len(rays)):
        x, y = rays[k, 0], rays[k, 1]
        radius = np.sqrt(x * x + y * y)
        angle = np.arctan(radius)
        a2 = angle * angle
        factor = 1.0
        if radius > 0.0:
            factor = angle * (1.0 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4)))) / radius
        px[k, 0], px[k, 1] = x * factor * fx + cx, y * factor * fy + cy
