"""What a ray makes of a longer focal length: a pinhole's grows with it, a fisheye's by far more."""

from dataclasses import replace

import numpy as np

from groundfuse.backend.bundle_estimate import FocalGains
from groundfuse.backend.measurement import Array
from groundfuse.frontend.camera import Intrinsics

GAIN_KNOTS, GAIN_STEP, LEAST_RADIUS = 64, 1e-3, 1e-3
"""Points of the table, relative step of the differences, and the shortest ray."""


def focal_gains(lens: Intrinsics) -> FocalGains:
    """Tabulate how much faster than a pinhole's a lens's rays grow with its focal length.

    Rays from the picture's centre to its farthest corner, along the x axis.
    """
    if lens.is_pinhole:
        return ()
    u, v = (0.0, lens.width_px - 1.0), (0.0, lens.height_px - 1.0)
    corners = lens.rays_from_px(np.array([(x, y) for x in u for y in v]))
    length = np.sqrt(np.sum(corners**2, axis=1))
    farthest = float(np.max(length[np.isfinite(length)], initial=LEAST_RADIUS))
    radius = np.linspace(LEAST_RADIUS, farthest, GAIN_KNOTS)
    rays = np.stack([radius, np.zeros(GAIN_KNOTS)], axis=1)

    def grown(by: float) -> Array:
        longer = replace(lens, fx_px=lens.fx_px * (1.0 + by), fy_px=lens.fy_px * (1.0 + by))
        found: Array = np.log(lens.rays_from_px(longer.px_from_rays(rays))[:, 0])
        return found

    gain = (grown(GAIN_STEP) - grown(-GAIN_STEP)) / (2.0 * GAIN_STEP)
    seen = np.isfinite(gain)
    return tuple(zip(radius[seen].tolist(), gain[seen].tolist(), strict=True))
