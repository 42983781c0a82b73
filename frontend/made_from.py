"""What a part of a mosaic was made from, and whether today it would be made from the same.

A team that grows by a picture moves all others by a little, most by thousandths of a cell. What is
compared is always what a part was really rendered with, so small changes can't add up.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import compress

import numpy as np
from numpy.typing import NDArray

from groundfuse.backend.measurement import Attitude, Se2
from groundfuse.frontend.arrays import Floats, Mask, Matrix
from groundfuse.frontend.camera import Intrinsics
from groundfuse.frontend.gains import Exposure
from groundfuse.frontend.gains_compiled import POWERS
from groundfuse.frontend.mosaic_options import MosaicOptions
from groundfuse.frontend.mosaic_plan import MosaicPlan
from groundfuse.frontend.sight import cam_from_team

MIDDLE_GREY = 128.0
"""Level at which a change of a gain is told in levels."""
RADII2 = np.linspace(0.0, 1.0, 5)
"""Where falloffs are compared: squared distances from the middle, half diagonals."""
LENS_PLACES = 9
"""A side of the lattice on which lenses are compared."""

Lens = tuple[Intrinsics, int, int]
"""Projection, first and last used row."""


@dataclass(frozen=True, slots=True, eq=False)
class MadeFrom:
    """Everything that a part's colours depend on, view by view in their order.

    Attributes:
        settings: what must be the same.
        who: frame and picture of each view, in words; must be the same.
        lenses: of the views.
        lens_of_view: (n,) numbers of the lenses.
        place: (n, 6) x, y, theta of the floor point below the camera, tilt, roll, height; m, rad.
        limit_m: (n,) longest useful footprint of a pixel; must be the same.
        colour: (n, 6) logarithms of the gains and coefficients of the falloff.
        noise_levels: see `Exposure`.
    """

    settings: tuple[object, ...]
    who: tuple[str, ...]
    lenses: tuple[Lens, ...]
    lens_of_view: NDArray[np.int64]
    place: Floats
    limit_m: Floats
    colour: Floats
    noise_levels: float


def every_view(plan: MosaicPlan) -> MadeFrom:
    """Describe all views of a plan, as a part that shows them all, without light or settings."""
    lenses = [(view.camera.intrinsics, *view.camera.used_rows) for view in plan.views]
    number = {lens: k for k, lens in enumerate(dict.fromkeys(lenses))}
    feet = [(view.team_from_foot, view.attitude) for view in plan.views]
    place = [
        (foot.x_m, foot.y_m, foot.theta_rad, seen.tilt_rad, seen.roll_rad, seen.height_m)
        for foot, seen in feet
    ]
    return MadeFrom(
        (),
        tuple(f"{v.frame.robot} {v.frame.index} {v.digest.hex()}" for v in plan.views),
        tuple(number),
        np.array([number[lens] for lens in lenses]),
        np.array(place),
        np.array(plan.limit_m),
        np.zeros((len(lenses), 6)),
        0.0,
    )


def made_from(
    every: MadeFrom, views: Sequence[int], exposure: Exposure, settings: tuple[object, ...]
) -> MadeFrom:
    """Describe what a part is made from today.

    Args:
        every: see `every_view`.
        views: numbers of those that the part shows.
        exposure: of all views.
        settings: what else the part depends on.
    """
    chosen = list(views)
    lenses, lens_of_view = np.unique(every.lens_of_view[chosen], return_inverse=True)
    return MadeFrom(
        settings,
        tuple(every.who[k] for k in chosen),
        tuple(every.lenses[k] for k in lenses),
        lens_of_view,
        every.place[chosen],
        every.limit_m[chosen],
        np.hstack([exposure.log_gain[chosen], exposure.falloff[chosen]]),
        exposure.noise_levels,
    )


def stacked(records: Sequence[MadeFrom]) -> MadeFrom:
    """Return several records of one view each, all with the same settings and noise, as one."""
    return MadeFrom(
        records[0].settings,
        tuple(record.who[0] for record in records),
        tuple(record.lenses[0] for record in records),
        np.arange(len(records)),
        np.concatenate([record.place for record in records]),
        np.concatenate([record.limit_m for record in records]),
        np.concatenate([record.colour for record in records]),
        records[0].noise_levels,
    )


def taking_part(kept: MadeFrom, today: MadeFrom) -> Mask | None:
    """Tell (n,) which of today's views took part, or None where one that did is gone."""
    before = set(kept.who)
    there = np.array([who in before for who in today.who], bool)
    return there if tuple(compress(today.who, there)) == kept.who else None


def only(record: MadeFrom, views: Mask) -> MadeFrom:
    """Describe a part as if only those (n,) of its views had taken part."""
    return replace(
        record,
        who=tuple(compress(record.who, views)),
        lens_of_view=record.lens_of_view[views],
        place=record.place[views],
        limit_m=record.limit_m[views],
        colour=record.colour[views],
    )


def is_same(
    kept: MadeFrom, today: MadeFrom, corners_m: Floats, cell_m: float, options: MosaicOptions
) -> bool:
    """Tell whether what was made from `kept` may stay where `today` is asked for.

    Args:
        kept: what the part was rendered with.
        today: what it would be rendered with.
        corners_m: (n, 4, 2) corners of what each view shows of the part.
        cell_m: side of a cell.
        options: how much may change.
    """
    sigmas = options.num_sigmas if np.isfinite(options.num_sigmas) else 0.0
    noise = abs(today.noise_levels - kept.noise_levels) * sigmas
    return (
        kept.settings == today.settings
        and kept.who == today.who
        and noise <= options.keep_within_levels
        and bool(same_views(kept, today, corners_m, cell_m, options).all())
    )


def same_views(
    kept: MadeFrom, today: MadeFrom, corners_m: Floats, cell_m: float, options: MosaicOptions
) -> Mask:
    """Tell (n,) which views, one by one, may stay; see `is_same`."""
    same: Mask = np.array([a == b for a, b in zip(kept.who, today.who, strict=True)], bool)
    same &= kept.limit_m == today.limit_m
    if same.any():
        same &= _is_same_place(kept, today, corners_m, options.keep_within_cells * cell_m)
        same &= _is_same_colour(kept, today, options.keep_within_levels)
    return same


def _is_same_place(kept: MadeFrom, today: MadeFrom, corners_m: Floats, allowed_m: float) -> Mask:
    pairs = list(zip(kept.lens_of_view.tolist(), today.lens_of_view.tolist(), strict=True))
    shift_px = {(a, b): _lens_shift_px(kept.lenses[a], today.lenses[b]) for a, b in set(pairs)}
    bent_px = np.array([shift_px[pair] for pair in pairs])
    still: Mask = (kept.place == today.place).all(axis=1) & (bent_px == 0.0)
    if still.all() or allowed_m == 0.0:
        return still
    moved_m = floor_shift_m(kept.place, today.place, corners_m) + bent_px * today.limit_m
    near: Mask = still | (moved_m <= allowed_m)
    return near


def _is_same_colour(kept: MadeFrom, today: MadeFrom, allowed_levels: float) -> Mask:
    powers = RADII2[:, None] ** np.arange(1, POWERS + 1)
    gain, falloff = np.hsplit(today.colour - kept.colour, [3])
    change = np.abs(gain[:, None, :] + (falloff @ powers.T)[:, :, None]).max(axis=(1, 2))
    near: Mask = change * MIDDLE_GREY <= allowed_levels
    return near


def floor_shift_m(kept: Floats, today: Floats, points_m: Floats) -> Floats:
    """Return how far (n,) points of the floor (n, m, 2) move at most between two placings.

    What one placing shows at a point, the other shows where the same ray meets the floor: a
    homography near the identity.

    Args:
        kept: (n, 6) see `MadeFrom`.
        today: likewise.
        points_m: in the team's frame.
    """
    homogeneous = np.concatenate([points_m, np.ones((*points_m.shape[:2], 1))], axis=2)
    rays = homogeneous @ _cams_from_team(kept).transpose(0, 2, 1)
    found = np.linalg.solve(_cams_from_team(today), rays.transpose(0, 2, 1)).transpose(0, 2, 1)
    moved = found[..., :2] / found[..., 2:] - points_m
    farthest: Floats = np.hypot(moved[..., 0], moved[..., 1]).max(axis=1)
    return farthest


def _cams_from_team(places: Floats) -> Floats:
    matrices: Floats = np.stack([_cam_from_team(*place) for place in places.tolist()])
    return matrices


@functools.lru_cache(maxsize=16_384)
def _cam_from_team(
    x_m: float, y_m: float, theta_rad: float, tilt_rad: float, roll_rad: float, height_m: float
) -> Matrix:
    """Each view takes part in many tiles."""
    return cam_from_team(Attitude(tilt_rad, roll_rad, height_m), Se2(x_m, y_m, theta_rad))


@functools.lru_cache(maxsize=256)
def _lens_shift_px(kept: Lens, today: Lens) -> float:
    """Return how far a ray's pixel moves at most; inf where the lenses differ in more than that."""
    (old, *old_rows), (new, *new_rows) = kept, today
    size = old.width_px, old.height_px
    if kept == today:
        return 0.0
    if old_rows != new_rows or size != (new.width_px, new.height_px) or old.model != new.model:
        return float("inf")
    u = np.linspace(0.0, old.width_px - 1.0, LENS_PLACES)
    v = np.linspace(old_rows[0], old_rows[1], LENS_PLACES)
    px = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    shift = np.hypot(*(new.px_from_rays(old.rays_from_px(px)) - px).T)
    return float(shift.max()) if np.isfinite(shift).all() else float("inf")
