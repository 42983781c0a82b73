"""Where rays meet the floor, and what follows of it, compiled: a loop each.

Rays have a place of their own in what is written, so that threads may share a list; sums over the
sightings of a floor point run in their order.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from groundfuse.backend.bundle_rows_compiled import Placed
from groundfuse.backend.compiled import compiled

Array = NDArray[np.float64]
Integers = NDArray[np.int64]


class Landing(NamedTuple):
    """Where rays meet the flat floor, in the component's frame.

    Attributes:
        point: (n, 2) m; nan above the horizon.
        by_ray: (n, 2, 2) its derivative by the ray; nan likewise.
        slope: (n, 2) horizontal way of the ray per height; nan likewise.
    """

    point: Array
    by_ray: Array
    slope: Array


@compiled
def land(
    frame: Integers, ray: Array, gain: Array, at: Placed, near: float, landing: Landing
) -> None:
    """Send rays to the floor; see `bundle_model`.

    Args:
        frame: (n,) of each.
        ray: (n, 2) as the file has it.
        gain: (n,) the focal length's.
        at: frames.
        near: least fall of a ray, in heights.
        landing: written.
    """
    for s in range(len(frame)):
        f = frame[s]
        turn_c, turn_s, tilt_c, tilt_s, roll_c, roll_s = at.turn[f]
        radius2 = ray[s, 0] * ray[s, 0] + ray[s, 1] * ray[s, 1]
        factor = (1.0 + at.lens[f, 0] * gain[s]) * (1.0 + at.lens[f, 1] * radius2)
        x, y = ray[s, 0] / factor, ray[s, 1] / factor
        lean = tilt_s * y + tilt_c
        fall = roll_s * x + roll_c * lean
        per = 1.0 / fall if fall > near else np.nan
        qx, qy = (tilt_s - tilt_c * y) * per, (roll_s * lean - roll_c * x) * per  # in heights
        scale = at.height[f] * per
        xx, yx = -qx * roll_s * scale, (-roll_c - qy * roll_s) * scale
        xy = (-tilt_c - qx * roll_c * tilt_s) * scale
        yy = (roll_s * tilt_s - qy * roll_c * tilt_s) * scale
        landing.slope[s, 0] = turn_c * qx - turn_s * qy
        landing.slope[s, 1] = turn_s * qx + turn_c * qy
        landing.point[s, 0] = landing.slope[s, 0] * at.height[f] + at.pose[f, 0]
        landing.point[s, 1] = landing.slope[s, 1] * at.height[f] + at.pose[f, 1]
        landing.by_ray[s, 0, 0] = turn_c * xx - turn_s * yx
        landing.by_ray[s, 1, 0] = turn_s * xx + turn_c * yx
        landing.by_ray[s, 0, 1] = turn_c * xy - turn_s * yy
        landing.by_ray[s, 1, 1] = turn_s * xy + turn_c * yy


@compiled
def weighted_places(point: Integers, sigma: Array, landing: Landing, places: Array) -> None:
    """Write each floor point's place by the precision of its rays there.

    Args:
        point: (n,) floor point of each ray.
        sigma: (n,) one-axis standard deviation of each.
        landing: of the rays; those that do not land do not count.
        places: (points, 3) written; 0 where no ray lands, and so are the heights.
    """
    sums = np.zeros((len(places), 5))
    for s in range(len(point)):
        x, y = landing.point[s, 0], landing.point[s, 1]
        if np.isnan(x):
            continue
        j = landing.by_ray[s]
        determinant = (j[0, 0] * j[1, 1] - j[0, 1] * j[1, 0]) * sigma[s]
        one = 1.0 / (determinant * determinant)
        xx = (j[1, 0] * j[1, 0] + j[1, 1] * j[1, 1]) * one
        xy = -(j[0, 0] * j[1, 0] + j[0, 1] * j[1, 1]) * one
        yy = (j[0, 0] * j[0, 0] + j[0, 1] * j[0, 1]) * one
        total = sums[point[s]]
        total[0] += xx
        total[1] += xy
        total[2] += yy
        total[3] += xx * x + xy * y
        total[4] += xy * x + yy * y
    for p in range(len(places)):
        xx, xy, yy, x, y = sums[p]
        places[p, 0] = places[p, 1] = places[p, 2] = 0.0
        if xx > 0.0:
            determinant = xx * yy - xy * xy
            places[p, 0] = (yy * x - xy * y) / determinant
            places[p, 1] = (xx * y - xy * x) / determinant


@compiled
def meeting_chi2(
    ends: tuple[Integers, Integers],
    landing: Landing,
    sigma: Array,
    relief_m: Array,
    chi2: Array,
) -> None:
    """Squared distances on the floor over their variance; inf where a ray meets no floor.

    Args:
        ends: sightings (n,) of both ends of each correspondence.
        landing: of the sightings (m,).
        sigma: (m,) one-axis standard deviation of their rays.
        relief_m: (m,) deviation of the floor's heights where each sighting is; 0 if flat.
        chi2: (n,) written.
    """
    one, other = ends
    for n in range(len(one)):
        a, b = one[n], other[n]
        x = landing.point[a, 0] - landing.point[b, 0]
        y = landing.point[a, 1] - landing.point[b, 1]
        px = relief_m[a] * (landing.slope[a, 0] - landing.slope[b, 0])
        py = relief_m[a] * (landing.slope[a, 1] - landing.slope[b, 1])
        xx, xy, yy = px * px, px * py, py * py
        for end in (a, b):
            j, square = landing.by_ray[end], sigma[end] * sigma[end]
            xx += (j[0, 0] * j[0, 0] + j[0, 1] * j[0, 1]) * square
            xy += (j[0, 0] * j[1, 0] + j[0, 1] * j[1, 1]) * square
            yy += (j[1, 0] * j[1, 0] + j[1, 1] * j[1, 1]) * square
        found = (yy * x * x - 2.0 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)
        chi2[n] = found if np.isfinite(found) else np.inf
