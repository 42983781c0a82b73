"""Keypoints made exact: a floor point's pictures are laid on each other, patch on patch.

A detector places a keypoint to a third of a pixel, and differently under each view. What a
small patch around it looks like says more: least squares matching (Foerstner 1982, Gruen 1985)
moves the keypoint, in every picture but one, to where the patch looks as it does in that one, the
finest. In between lies the homography of the floor, with each lens quadratic over the patch: taken
for linear, it moves a keypoint by hundredths of a pixel far out, as another focal length would.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from groundfuse.backend.measurement import Attitude, Se2
from groundfuse.backend.option_checks import check_numbers
from groundfuse.backend.ordering import stable_order
from groundfuse.frontend.arrays import Floats, Image, Mask, Picture32, Points
from groundfuse.frontend.camera import Camera, Intrinsics
from groundfuse.frontend.patches_compiled import fill_templates, lay_on
from groundfuse.frontend.sight import cam_from_team

Integers = NDArray[np.int64]
MOST_HALVINGS = 3
"""A picture eight times as fine as another is read from its last halving."""
LATER = 0.25
"""A picture is halved where it is 1.7 times as fine as the other, not 1.4: reading blurs, too."""
WAYS = ((1.0, 0.0), (0.0, 1.0))
REACH = 0.5
"""Where in a patch a lens is asked how it goes on, in radii."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PatchOptions:
    """Options of the keypoints' alignment.

    Attributes:
        use: whether keypoints are aligned before the bundle.
        radius_px: of a patch: it has 2 radius + 1 pixels a side.
        blur_px: Gaussian that pictures are smoothed with.
        steps: of a patch at most, until it rests.
        max_move_px: farthest from where the detector saw it.
        min_correlation: of the two patches where they rest; anything less is not the same floor.
        least_residual: smallest deviation between two patches, of one each, that a keypoint's own
            deviation is worked out from.
        noise: a keypoint's deviation, as a multiple of what it would be if all of its patch were
            one pixel; terrazzo, gravel, wood and concrete ask for 0.05 to 0.11, and the bundle
            estimates what is left.
        min_links: correspondences that a pair must keep; one with fewer keeps its own as they are.
        cache_bytes: pictures held in memory at once, and as much for patches, bytes.
    """

    use: bool = True
    radius_px: int = 7
    blur_px: float = 0.7
    steps: int = 15
    max_move_px: float = 2.0
    min_correlation: float = 0.7
    least_residual: float = 0.1
    noise: float = 0.07
    min_links: int = 12
    cache_bytes: int = 256 * 2**20

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense (ValueError)."""
        check_numbers(self)


@dataclass(frozen=True, slots=True, eq=False)
class PatchView:
    """A picture and the best that is known of its place.

    Attributes:
        camera: lens and used rows.
        attitude: of this picture.
        team_from_foot: floor point below the camera, heading along the camera's.
        load: reads the picture, (rows, columns, 3) BGR uint8.
    """

    camera: Camera
    attitude: Attitude
    team_from_foot: Se2
    load: Callable[[], Image]


@dataclass(frozen=True, slots=True, eq=False)
class Keypoints:
    """Keypoints of floor points.

    Attributes:
        view: (n,) number of each one's view.
        rays: (n, 2) without distortion.
        floor: (n, 2) where they are on the floor, as far as is known, m.
        fineness: (n,) pixels per area of the floor, to compare.
        finest: (n,) number of the keypoint of the same point that the others are laid on.
    """

    view: Integers
    rays: Points
    floor: Points
    fineness: Floats
    finest: Integers


def keypoints_of(
    views: Sequence[PatchView], view: Integers, rays: Points, point: Integers
) -> Keypoints:
    """Find each floor point's finest keypoint.

    Args:
        views: the pictures.
        view: (n,) each keypoint's.
        rays: (n, 2) of the keypoints, without distortion.
        point: (n,) floor point of each, numbered from 0, none left out.
    """
    cam_from_floor = _cam_from_floor(views)
    x, y, z = _mapped(_inverse(cam_from_floor), view, rays)
    floor = np.column_stack([x / z, y / z])
    # A homography's area grows with its determinant over depth cubed; the lens adds its own.
    depth = _mapped(cam_from_floor, view, floor)[2]
    fineness = np.abs(np.linalg.det(cam_from_floor))[view] / np.abs(depth) ** 3
    fineness *= np.abs(_areas_by_ray(views, view, rays))
    return Keypoints(view, rays, floor, fineness, _largest(fineness, point)[point])


def _mapped(maps: Floats, which: Integers, points: Points) -> tuple[Floats, Floats, Floats]:
    """Return what maps (views, 3, 3) make of points (n, 2), homogeneous: each has one of them."""
    x, y = points.T
    some = maps.reshape(-1, 9)[which].T
    return (
        some[0] * x + some[1] * y + some[2],
        some[3] * x + some[4] * y + some[5],
        some[6] * x + some[7] * y + some[8],
    )


def _largest(value: Floats, group: Integers) -> Integers:
    """Return the place of the largest value of each group, of equal ones the first."""
    order = stable_order(group)
    begins = np.flatnonzero(np.diff(group[order], prepend=-1))
    most = np.maximum.reduceat(value[order], begins)[group[order]]
    largest = order[value[order] == most]
    found: Integers = largest[np.flatnonzero(np.diff(group[largest], prepend=-1))]
    return found


@dataclass(frozen=True, slots=True, eq=False)
class PatchPlan:
    """How the patches of keypoints look in their points' finest pictures.

    Attributes:
        views: the pictures.
        view: (m,) number of each keypoint's.
        rays: (m, 2) of the keypoints.
        place: (m, 2) the keypoints, px.
        ray_by_px: (m, 2, 2) how a keypoint's ray moves with it.
        finest_view: (m,) number of the finest's view.
        finest_place: (m, 2) the finest, px.
        map: (m, 3, 3) from pixels (x, y) off a keypoint to pixels off its finest, homogeneous; as
            if the lenses bent nothing there.
        bend: (m, 2, 3) what they add to that, px: of x x, x y and y y.
        halvings: (m,) of the finest's picture that leave it about as fine as the keypoint's own.
    """

    views: Sequence[PatchView]
    view: Integers
    rays: Points
    place: Points
    ray_by_px: Floats
    finest_view: Integers
    finest_place: Points
    map: Floats
    bend: Floats
    halvings: Integers


def patch_plan(
    views: Sequence[PatchView], known: Keypoints, which: Integers, options: PatchOptions
) -> PatchPlan:
    """Plan the alignment of some keypoints.

    Args:
        views: the pictures.
        known: all keypoints.
        which: (m,) numbers of those that are to be aligned.
        options: see there.
    """
    cam_from_floor, finest = _cam_from_floor(views), known.finest[which]
    view, rays, there = known.view[which], known.rays[which], known.view[finest]
    reach_px = REACH * options.radius_px
    lens = _through_lenses(views, view, rays, reach_px)
    other = _through_lenses(views, there, known.rays[finest], reach_px)
    times = np.sqrt(known.fineness[finest] / known.fineness[which])
    halvings = np.clip(np.round(np.log2(times) - LATER), 0, MOST_HALVINGS).astype(np.int64)
    ray_by_px = _inverse(lens.by_ray)
    from_px = _affine(ray_by_px, rays)
    eye = np.broadcast_to(np.eye(2), lens.by_ray.shape)
    shift = _affine(eye, known.floor[finest] - known.floor[which])
    to_px = _affine(other.by_ray, -_times(other.by_ray, known.rays[finest]))
    floor_from_cam = np.linalg.inv(cam_from_floor)
    carried = to_px @ cam_from_floor[there] @ shift @ floor_from_cam[view] @ from_px
    # In the middle the map is 0: its derivative is that of the numerator.
    linear = carried[:, :2, :2] / carried[:, 2:, 2:]
    # The lens behind takes its bend off the pixel first; the one ahead adds its own at the end.
    bend = other.bend_of(_inverse(other.by_ray) @ linear) - linear @ lens.bend_of(ray_by_px)
    return PatchPlan(
        views, view, rays, lens.place, ray_by_px, there, other.place, carried, bend, halvings
    )


def _cam_from_floor(views: Sequence[PatchView]) -> Floats:
    return np.stack([cam_from_team(v.attitude, v.team_from_foot) for v in views])


def _inverse(matrices: Floats) -> Floats:
    inverse: Floats = np.linalg.inv(matrices).astype(np.float64)
    return inverse


def _times(matrices: Floats, vectors: Floats) -> Floats:
    """Multiply matrices (n, 2, 2) by vectors (n, 2)."""
    product: Floats = (matrices @ vectors[:, :, None])[:, :, 0]
    return product


def _affine(linear: Floats, offset: Points) -> Floats:
    """Return maps (n, 3, 3) of homogeneous points."""
    maps = np.zeros((len(offset), 3, 3))
    maps[:, :2, :2], maps[:, :2, 2], maps[:, 2, 2] = linear, offset, 1.0
    return maps


class _Lens(NamedTuple):
    """What a lens does to rays and to what is around them, to the second order.

    Attributes:
        place: (n, 2) pixels of the rays.
        by_ray: (n, 2, 2) how they move with their rays.
        bend: (n, 2, 3) and what is added, of steps (a, b) of the ray: of a a, a b and b b.
    """

    place: Points
    by_ray: Floats
    bend: Floats

    def bend_of(self, by: Floats) -> Floats:
        """Return the bend (n, 2, 3) of other steps (x, y), by which the rays move so (n, 2, 2)."""
        a_x, a_y, b_x, b_y = (by[:, None, i, j] for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)))
        aa, ab, bb = np.moveaxis(self.bend, 2, 0)
        xx = aa * a_x * a_x + ab * a_x * b_x + bb * b_x * b_x
        xy = 2.0 * aa * a_x * a_y + ab * (a_x * b_y + a_y * b_x) + 2.0 * bb * b_x * b_y
        yy = aa * a_y * a_y + ab * a_y * b_y + bb * b_y * b_y
        return np.stack([xx, xy, yy], axis=2)


def _areas_by_ray(views: Sequence[PatchView], view: Integers, rays: Points) -> Floats:
    """Return how many square pixels the lenses make of what is around rays (n, 2), per unit."""
    area = np.empty(len(rays))
    for lens, mine in _by_lens(views, view):
        step = 1.0 / lens.focal_px
        (a_x, a_y), (b_x, b_y) = (_around(lens, rays[mine], step, way)[0].T for way in WAYS)
        area[mine] = a_x * b_y - a_y * b_x
    return area


def _through_lenses(
    views: Sequence[PatchView], view: Integers, rays: Points, reach_px: float
) -> _Lens:
    """Send rays (n, 2) through lenses, with others at some pixels around them."""
    size = len(rays)
    found = _Lens(np.empty((size, 2)), np.empty((size, 2, 2)), np.empty((size, 2, 3)))
    for lens, mine in _by_lens(views, view):
        for whole, part in zip(found, _through(lens, rays[mine], reach_px), strict=True):
            whole[mine] = part
    return found


def _by_lens(views: Sequence[PatchView], view: Integers) -> Iterator[tuple[Intrinsics, Mask]]:
    """Yield every lens and which of the rays (n,) go through it."""
    lenses = [v.camera.intrinsics for v in views]
    number = {lens: k for k, lens in enumerate(dict.fromkeys(lenses))}
    which = np.array([number[lens] for lens in lenses])[view]
    for lens, k in number.items():
        yield lens, which == k


def _around(
    lens: Intrinsics, rays: Points, step: float, way: tuple[float, float]
) -> tuple[Points, Points]:
    """Return how places (n, 2) move with their rays along a direction, and the ends' mean."""
    off = step * np.array(way)
    ahead, behind = lens.px_from_rays(rays + off), lens.px_from_rays(rays - off)
    return (ahead - behind) / (2.0 * step), (ahead + behind) / 2.0


def _through(lens: Intrinsics, rays: Points, reach_px: float) -> _Lens:
    place, step = lens.px_from_rays(rays), reach_px / lens.focal_px

    def bent(way: tuple[float, float]) -> tuple[Points, Points]:
        """Return the slope along a direction, and half the curvature."""
        slope, mean = _around(lens, rays, step, way)
        return slope, (mean - place) / step**2

    (by_a, aa), (by_b, bb), (_, both) = bent(WAYS[0]), bent(WAYS[1]), bent((1.0, 1.0))
    return _Lens(place, np.stack([by_a, by_b], axis=2), np.stack([aa, both - aa - bb, bb], axis=2))


@dataclass(frozen=True, slots=True, eq=False)
class Aligned:
    """Keypoints after their alignment.

    Attributes:
        rays: (n, 2) where they are now; nan where they do not fit.
        sigma: (n,) one-axis standard deviation of `rays`; nan likewise.
    """

    rays: Points
    sigma: Floats


@dataclass(frozen=True, slots=True, eq=False)
class GreyPicture:
    """A picture, grey and smooth, and its halvings; halving a place gives its place in each.

    Attributes:
        levels: the picture, half of it, and so on.
    """

    levels: tuple[Image, ...]

    @property
    def nbytes(self) -> int:
        """Memory held."""
        return sum(level.nbytes for level in self.levels)


def grey_picture(view: PatchView, options: PatchOptions) -> GreyPicture:
    """Load a view's picture."""
    grey = cv2.cvtColor(view.load(), cv2.COLOR_BGR2GRAY)
    levels = [np.asarray(cv2.GaussianBlur(grey, (0, 0), options.blur_px), dtype=np.uint8)]
    while len(levels) <= MOST_HALVINGS:
        levels.append(np.asarray(cv2.pyrDown(levels[-1]), dtype=np.uint8))
    return GreyPicture(tuple(levels))


def empty_templates(count: int, options: PatchOptions) -> Picture32:
    """Return room for the patches of so many keypoints."""
    side = 2 * options.radius_px + 3  # slopes need a border
    return np.zeros((count, side, side), np.float32)


def fill_from(plan: PatchPlan, which: Integers, picture: GreyPicture, templates: Picture32) -> None:
    """Read patches from the view that their finest are in.

    Args:
        plan: see there.
        which: (k,) numbers of the plan's keypoints: the finest of all of them are in one view.
        picture: that view's; see `grey_picture`.
        templates: (m, ...) of the plan's keypoints, to fill.
    """
    rows = np.array(plan.views[int(plan.finest_view[which[0]])].camera.used_rows)
    for level, halved in enumerate(picture.levels):
        some = which[plan.halvings[which] == level]
        share = 0.5**level
        first, last = np.ceil(rows[0] * share), np.floor(rows[1] * share)
        maps = plan.map[some] * np.array([share, share, 1.0])[:, None]
        middle = plan.finest_place[some] * share
        how = maps, plan.bend[some] * share
        fill_templates(halved, (int(first), int(last)), some, middle, how, templates)


def aligned(
    plan: PatchPlan,
    which: Integers,
    picture: GreyPicture,
    templates: Picture32,
    options: PatchOptions,
) -> Aligned:
    """Align keypoints of one view to their finest.

    Args:
        plan: see there.
        which: (k,) numbers of the plan's keypoints: all of one view.
        picture: the view's; see `grey_picture`.
        templates: (m, ...) of the plan's keypoints, filled.
        options: see there.
    """
    begin, found = plan.place[which], np.empty((len(which), 4))
    rows = plan.views[int(plan.view[which[0]])].camera.used_rows
    most = options.steps, options.max_move_px
    weight = _weight(2 * options.radius_px + 1)
    lay_on(picture.levels[0], rows, begin, templates[which], weight, most, found)
    return _judged(found, begin, plan.ray_by_px[which], plan.rays[which], options)


def _weight(side: int) -> Floats:
    """Return weights (side, side) of sum one that fall off towards the border."""
    line = np.exp(-0.5 * (np.linspace(-1.5, 1.5, side)) ** 2)
    weight: Floats = np.outer(line, line) / line.sum() ** 2
    return weight


def _judged(
    found: Floats, begin: Points, ray_by_px: Floats, rays: Points, options: PatchOptions
) -> Aligned:
    """Turn places into rays with their deviation; the lens is linear over so short a way."""
    moved = _times(ray_by_px, found[:, :2] - begin)
    # Standardised patches: their squared difference is what their correlation lacks, twice.
    residual = np.sqrt(np.maximum(2.0 * (1.0 - found[:, 2]), options.least_residual**2))
    sigma_px = options.noise * residual * found[:, 3]
    sigma = sigma_px * np.sqrt(np.abs(np.linalg.det(ray_by_px)))
    fits = found[:, 2] >= options.min_correlation
    return Aligned(np.where(fits[:, None], rays + moved, np.nan), np.where(fits, sigma, np.nan))
