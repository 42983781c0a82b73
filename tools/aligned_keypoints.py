"""The bundle's correspondences, laid on each other patch by patch; what is known is kept.

The bundle joins keypoints of many pairs into floor points. Here each of those is aligned in all
its pictures at once, so that a keypoint of several pairs stays one keypoint.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from groundfuse.backend.bundle import LEAST_SIGHTINGS
from groundfuse.backend.bundle_sample import sampled
from groundfuse.backend.bundle_tracks import Links, Matched, Sightings, matched, mixed_keys, tracks
from groundfuse.backend.measurement import Array, FrameId, RelativePose, TeamEstimate
from groundfuse.backend.ordering import stable_order
from groundfuse.frontend.ahead import in_threads
from groundfuse.frontend.arrays import Image
from groundfuse.frontend.patches import (
    Aligned,
    GreyPicture,
    Integers,
    Keypoints,
    PatchOptions,
    PatchPlan,
    PatchView,
    aligned,
    empty_templates,
    fill_from,
    grey_picture,
    keypoints_of,
    patch_plan,
)
from groundfuse.frontend.picture_cache import Cache
from groundfuse.tools.code_version import code_of
from groundfuse.tools.packing import digest_of, key_of, packed
from groundfuse.tools.robot import Frame, Robot
from groundfuse.tools.store import Store
from groundfuse.tools.team_folder import load_image
from groundfuse.tools.workers import Progress

Keys = np.ndarray[tuple[int], np.dtype[np.uint64]]
KIND = "patches"
OTHER = np.uint64(0x9E3779B97F4A7C15)
"""Odd: makes what a keypoint is laid on count otherwise than the keypoint itself."""
LEAST_M = 1e-9
"""Width of a floor that has none."""


@dataclass(frozen=True, slots=True, eq=False)
class KnownAlignments:
    """Alignments that were made already.

    Attributes:
        keys: (n,) ascending: of two keypoints, their pictures and cameras, options and code.
        found: (n, 3) ray of the first laid on the second, and its deviation; nan: it does not fit.
    """

    keys: Keys
    found: Array


NOTHING_KNOWN = KnownAlignments(np.zeros(0, np.uint64), np.zeros((0, 3)))


@dataclass(frozen=True, slots=True)
class Desk:
    """What the alignment works with.

    Attributes:
        pictures: digest of every frame's picture.
        store: has the alignments of the last team, and takes these.
        num_threads: of this process.
        progress: shows how far it is.
        most_sightings: of all frames together, as the bundle takes part of a large team's.
    """

    pictures: Mapping[FrameId, bytes]
    store: Store
    num_threads: int
    progress: Progress
    most_sightings: int


def aligned_keypoints(
    robots: Sequence[Robot],
    placed: Sequence[Robot],
    team: TeamEstimate,
    edges: Sequence[RelativePose],
    options: PatchOptions,
    desk: Desk,
) -> Matched:
    """Return the edges' correspondences with aligned keypoints.

    Keypoints whose patches do not fit are left out; an edge that would keep fewer than
    `min_links` of its correspondences keeps them as they are. What was aligned for this team
    before is not aligned again, though its places may be better known by now: where a patch rests
    depends on where its picture was taken by less than a thousandth of a pixel a millimetre.

    Args:
        robots: with the lenses that the edges' rays are of.
        placed: the robots with the best known attitudes.
        team: the frames' places.
        edges: accepted ones.
        options: see there.
        desk: see there.

    Raises:
        DataError: a picture can't be read.
    """
    frames = sorted(team.team_from_base)
    seen = matched(edges, {frame: number for number, frame in enumerate(frames)})
    if not options.use or len(seen.links) == 0:
        return seen
    sightings, most = seen.sightings, max(desk.most_sightings // len(frames), LEAST_SIGHTINGS)
    used, point = sampled(*tracks(seen.links, sightings), sightings, most)
    if len(used) == 0:
        return seen
    views = _views(robots, placed, team, frames)
    points = keypoints_of(views, sightings.frame[used], sightings.ray[used], point)
    keys = _keys(_digests(robots, frames, options, desk), points)
    found = _known(keys, points, desk.store.latest(KIND) or NOTHING_KNOWN)
    left = np.flatnonzero(found[:, 3] == 0.0)
    if len(left):
        _align(views, points, left, found, options, desk)
        others = points.finest != np.arange(len(used))
        known = KnownAlignments(*_sorted(keys[others], found[others, :3]))
        desk.store.save(key_of(KIND, known.keys), KIND, "team", packed(known))
    return _replaced(seen, used, _with_finest(points, found), options.min_links)


def _views(
    robots: Sequence[Robot],
    placed: Sequence[Robot],
    team: TeamEstimate,
    frames: Sequence[FrameId],
) -> list[PatchView]:
    of = {
        frame.id: (robot, frame, best.attitude)
        for robot, there in zip(robots, placed, strict=True)
        for frame, best in zip(robot.frames, there.frames, strict=True)
    }

    def view(name: FrameId) -> PatchView:
        robot, frame, attitude = of[name]
        foot = team.team_from_base[name] @ robot.camera.mount.base_from_foot
        return PatchView(robot.camera, attitude, foot, lambda: _picture(frame, robot))

    return [view(name) for name in frames]


def _picture(frame: Frame, robot: Robot) -> Image:
    return load_image(frame, robot.camera)


def _digests(
    robots: Sequence[Robot], frames: Sequence[FrameId], options: PatchOptions, desk: Desk
) -> Integers:
    """Return a number for each frame: of its picture, its camera, the options and the code."""
    code = code_of("groundfuse.tools.aligned_keypoints", rooms=("frontend", "tools"))
    how = {robot.name: key_of("patches", code, options, robot.camera) for robot in robots}
    both = [digest_of(how[frame.robot] + desk.pictures[frame]) for frame in frames]
    return np.array([int.from_bytes(digest[:7], "little") for digest in both], np.int64)


def _keys(digests: Integers, points: Keypoints) -> Keys:
    """Return what stands for each keypoint and its finest, in their pictures."""
    own = mixed_keys(digests[points.view], points.rays)
    keys: Keys = own ^ (own[points.finest] * OTHER)
    return keys


def _known(keys: Keys, points: Keypoints, known: KnownAlignments) -> Array:
    """Return (n, 4): what is known of each alignment, and whether it is."""
    found = np.full((len(keys), 4), np.nan)
    found[:, 3] = 0.0
    if len(known.keys):
        place = np.minimum(np.searchsorted(known.keys, keys), len(known.keys) - 1)
        same = known.keys[place] == keys
        found[same, :3], found[same, 3] = known.found[place[same]], 1.0
    found[points.finest == np.arange(len(keys)), 3] = 1.0
    return found


def _align(
    views: Sequence[PatchView],
    points: Keypoints,
    left: Integers,
    found: Array,
    options: PatchOptions,
    desk: Desk,
) -> None:
    """Align what is left and write it down.

    As many keypoints at a time as there is room for read their patches, view by view of their
    finest, and are then laid on, view by view of their own. Those of one time lie near each other:
    however far apart two views of a place were taken, few pictures are read more than once.
    """
    pictures: Cache[GreyPicture] = Cache(
        lambda number: grey_picture(views[number], options), options.cache_bytes
    )
    most = max(1, options.cache_bytes // empty_templates(1, options).nbytes)
    parts = near_parts(left, points.floor[points.finest[left]], most)

    def steps() -> Iterator[None]:
        for part in parts:
            plan, some = patch_plan(views, points, part, options), np.empty((len(part), 3))
            yield from _align_part(plan, some, pictures.get, options, desk.num_threads)
            found[part, :3] = some

    total = sum(len(_by(points.view[n])) for part in parts for n in (part, points.finest[part]))
    for _ in desk.progress(steps(), total, "keypoints"):
        pass


def near_parts(which: Integers, floor: Array, most: int) -> list[Integers]:
    """Split numbers (n,) into parts of at most so many, each of a piece of floor.

    Args:
        which: the numbers.
        floor: (n, 2) where each lies, m.
        most: in a part.
    """
    num = -(-len(which) // most)
    if num > 1:
        low, high = floor.min(axis=0), floor.max(axis=0)
        num_strips = math.ceil(math.sqrt(num))  # so that parts are about as long as wide
        strip = np.floor((floor[:, 1] - low[1]) / max(high[1] - low[1], LEAST_M) * num_strips)
        back_and_forth = np.where(strip % 2.0 == 0.0, floor[:, 0], -floor[:, 0])
        which = which[np.lexsort((back_and_forth, strip))]
    return [which[first : first + most] for first in range(0, len(which), most)]


def _align_part(
    plan: PatchPlan,
    found: Array,
    picture: Callable[[int], GreyPicture],
    options: PatchOptions,
    num_threads: int,
) -> Iterator[None]:
    """Align a plan's keypoints; each view that patches are read from or laid on is a step."""
    templates = empty_templates(len(found), options)

    def fill(which: Integers) -> None:
        fill_from(plan, which, picture(int(plan.finest_view[which[0]])), templates)

    def lay(which: Integers) -> None:
        exact = aligned(plan, which, picture(int(plan.view[which[0]])), templates, options)
        found[which, :2], found[which, 2] = exact.rays, exact.sigma

    yield from in_threads(fill, _by(plan.finest_view), num_threads)
    yield from in_threads(lay, _by(plan.view), num_threads)


def _by(number: Integers) -> list[Integers]:
    """Return the places of each number that occurs, in the order of the numbers."""
    order = stable_order(number)
    return np.split(order, np.flatnonzero(np.diff(number[order])) + 1)


def _sorted(keys: Keys, found: Array) -> tuple[Keys, Array]:
    order = np.argsort(keys, kind="stable")
    return keys[order], found[order]


def _with_finest(points: Keypoints, found: Array) -> Aligned:
    """Let the finest stay where they are, if another fits; they are as exact as those on average.

    Laid on a patch with an error of its own, the others share that error, which is as if all
    pictures, the finest too, had errors of their own.
    """
    rays, own = points.rays, np.arange(len(found))
    fits = np.isfinite(found[:, 2]) & (points.finest != own)
    followers = np.bincount(points.finest[fits], minlength=len(rays))
    total = np.bincount(points.finest[fits], found[fits, 2], minlength=len(rays))
    exact, sigma = (
        np.where(fits[:, None], found[:, :2], np.nan),
        np.where(fits, found[:, 2], np.nan),
    )
    followed = followers > 0
    exact[followed], sigma[followed] = rays[followed], (total / np.maximum(followers, 1))[followed]
    return Aligned(exact, sigma)


def _replaced(seen: Matched, used: Integers, exact: Aligned, min_links: int) -> Matched:
    """Put in the keypoints that fit, where they are enough; other edges keep theirs, apart."""
    before, links, fitting = seen.sightings, seen.links, np.isfinite(exact.sigma)
    where = used[fitting]
    fits = np.zeros(len(before), dtype=np.bool_)
    fits[where] = True
    rays, sigma = before.ray.copy(), before.sigma.copy()
    rays[where], sigma[where] = exact.rays[fitting], exact.sigma[fitting]
    both = fits[links.a] & fits[links.b]
    stays = np.bincount(links.edge[both], minlength=int(links.edge.max()) + 1) < min_links
    old = stays[links.edge]
    own, place = np.unique([links.a[old], links.b[old]], return_inverse=True)
    a, b = links.a.copy(), links.b.copy()
    a[old], b[old] = len(before) + place.reshape(2, -1)
    merged = Sightings(
        np.concatenate([before.frame, before.frame[own]]),
        np.concatenate([rays, before.ray[own]]),
        np.concatenate([sigma, before.sigma[own]]),
    )
    return Matched(merged, Links(a, b, links.edge).only(both | old))
