"""From accepted pairs to floor points and their sightings: joining, cutting, listing; numpy only.

A keypoint that several pairs use appears in all of them with the same ray, to the bit. Joining by
it makes one floor point of it, so that its noise counts once and not once per pair.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from groundfuse.backend.bundle_estimate import FocalGains
from groundfuse.backend.measurement import FrameId, RelativePose
from groundfuse.backend.ordering import stable_order

Array = NDArray[np.float64]
Integers = NDArray[np.int64]
Mask = NDArray[np.bool_]
Keys = NDArray[np.uint64]

# Odd constants of 64 bits mix frame and ray bits into one key; two keypoints among a million share
# one by accident with probability 3e-8, and would then only make one wrong correspondence.
MIX = tuple(
    np.uint64(number)
    for number in (0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9, 0xD6E8FEB86659FD93)
)


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """Keypoints.

    Attributes:
        frame: (n,) of each.
        ray: (n, 2) without distortion, as the file has it.
        sigma: (n,) one-axis standard deviation.
        gain: (n,) by what multiple of its length a ray grows with the focal length's fraction; None
            for pinholes: once.
    """

    frame: Integers
    ray: Array
    sigma: Array
    gain: Array | None = None

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(frozen=True, slots=True, eq=False)
class Links:
    """Correspondences: the sightings a and b (n,) and the pair `edge` (n,) they come from."""

    a: Integers
    b: Integers
    edge: Integers

    def __len__(self) -> int:
        return len(self.a)

    def only(self, kept: Mask) -> "Links":
        """Return some of the links."""
        return Links(self.a[kept], self.b[kept], self.edge[kept])


@dataclass(frozen=True, slots=True, eq=False)
class Matched:
    """The correspondences of edges: keypoints, each of them once, and which of them are linked.

    Attributes:
        sightings: keypoints; some may have no link.
        links: sorted by edge.
    """

    sightings: Sightings
    links: Links

    def only_edges(self, kept: Mask) -> "Matched":
        """Return the correspondences of some of the edges, which are numbered anew."""
        links, number = self.links.only(kept[self.links.edge]), np.cumsum(kept) - 1
        return Matched(self.sightings, Links(links.a, links.b, number[links.edge]))


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Sightings of floor points, sorted by frame; and all pairs of sightings of the same point.

    Attributes:
        frame: (n,) frame of each.
        point: (n,) floor point of each.
        first: (points,) the first observation of each floor point.
        ray: (n, 2) measured ray.
        sigma: (n,) one-axis standard deviation.
        gain: (n,) of focal lengths, see `Sightings`.
        num_points: floor points.
        frame_start: (frames + 1,) first observation of each frame.
        pair_i: (m,) first observation of each pair, sorted by the frames of both.
        pair_j: (m,) second observation.
        pair_key: (k,) frame_i * frames + frame_j of each pair of frames that share points.
        pair_start: (k + 1,) first pair of each.
    """

    frame: Integers
    point: Integers
    first: Integers
    ray: Array
    sigma: Array
    gain: Array
    num_points: int
    frame_start: Integers
    pair_i: Integers
    pair_j: Integers
    pair_key: Integers
    pair_start: Integers


def mixed_keys(number: Integers, ray: Array) -> Keys:
    """Mix a number and the bits of a ray (n, 2) into one key (n,)."""
    bits = np.ascontiguousarray(ray + 0.0).view(np.uint64)  # + 0.0: one zero, not two
    mixed = (number.astype(np.uint64) + np.uint64(1)) * MIX[0]
    for axis, factor in enumerate(MIX[1:3]):
        mixed = (mixed ^ (bits[:, axis] * factor)) * MIX[3]
        mixed ^= mixed >> np.uint64(32)
    return mixed


def matched(edges: Sequence[RelativePose], index_of: Mapping[FrameId, int]) -> Matched:
    """Collect the correspondences of all edges; a keypoint of several edges is one sighting."""
    frames, rays, sigmas, counts = [], [], [], []
    for edge in edges:
        pair = edge.correspondences
        counts.append(0 if pair is None else len(pair))
        if pair is not None:
            frames += [index_of[edge.a], index_of[edge.b]]
            rays += [pair.rays_a, pair.rays_b]
            sigmas += [pair.sigma_a, pair.sigma_b]
    if sum(counts) == 0:
        none = np.zeros(0, dtype=np.int64)
        return Matched(Sightings(none, np.zeros((0, 2)), np.zeros(0)), Links(none, none, none))
    ray, sigma = np.concatenate(rays), np.concatenate(sigmas)
    frame = np.repeat(np.array(frames), [len(part) for part in sigmas])
    first, which = _each_once(mixed_keys(frame, ray))
    # The start of each pair's two runs: a comes first, b follows.
    size = np.array(counts)
    edge_of = np.repeat(np.arange(len(edges)), size)
    start = np.repeat(np.cumsum(2 * size) - 2 * size, size)
    within = np.arange(len(edge_of)) - np.repeat(np.cumsum(size) - size, size)
    links = Links(which[start + within], which[start + size[edge_of] + within], edge_of)
    # Every pair has an estimate of its own of how noisy its keypoints are.
    mean_square = np.bincount(which, sigma**2) / np.bincount(which)
    return Matched(Sightings(frame[first], ray[first], np.sqrt(mean_square)), links)


def _each_once(keys: Keys) -> tuple[Integers, Integers]:
    """Return where each key is (one of its places), ascending, and the number of each of `keys`.

    What is equal here is equal to the bit, so that any of its places will do, and the order need
    not be stable: numpy.unique takes several times as long.
    """
    order = np.argsort(keys)
    begins = np.diff(keys[order], prepend=~keys[order[:1]]) != 0
    which = np.empty(len(keys), dtype=np.int64)
    which[order] = np.cumsum(begins) - 1
    return order[begins], which


def with_gains(sightings: Sightings, robot_of: Integers, tables: Sequence[FocalGains]) -> Sightings:
    """Look up what each ray makes of a longer focal length; `robot_of` (frames,), `tables` each."""
    gain, robot = np.ones(len(sightings)), robot_of[sightings.frame]
    for index, table in enumerate(tables):
        mine = robot == index
        gain[mine] = gain_at(sightings.ray[mine], table)
    return replace(sightings, gain=gain)


def gain_at(ray: Array, table: FocalGains) -> Array:
    """Interpolate a table at rays (n, 2)."""
    if not table:
        return np.ones(len(ray))
    radius, gain = np.array(table).T
    found: Array = np.interp(np.sqrt(np.sum(ray * ray, axis=1)), radius, gain)
    return found


def tracks(links: Links, sightings: Sightings) -> tuple[Integers, Integers]:
    """Join links into floor points: (sighting, point) of every observation.

    Where a floor point would be seen twice by one frame, those sightings are contradictory and are
    left out.
    """
    count = len(sightings)
    ones = np.ones(len(links), dtype=np.int8)
    graph = coo_matrix((ones, (links.a, links.b)), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    linked = np.zeros(count, dtype=np.bool_)
    linked[links.a] = linked[links.b] = True
    used = np.flatnonzero(linked)
    place = label[used].astype(np.int64) * (sightings.frame.max() + 1) + sightings.frame[used]
    order = stable_order(place)
    same = np.diff(place[order]) == 0
    twice = np.zeros(len(used), dtype=np.bool_)
    twice[order[1:][same]] = twice[order[:-1][same]] = True
    used = used[~twice]
    several = np.bincount(label[used])[label[used]] > 1
    return used[several], renumbered(label[used[several]])


def renumbered(number: Integers) -> Integers:
    """Number the numbers that occur from 0 on, in their order."""
    if len(number) == 0:
        return number.astype(np.int64)
    occurs = np.bincount(number) > 0
    found: Integers = (np.cumsum(occurs) - 1)[number]
    return found


def single_links(links: Links) -> tuple[Integers, Integers]:
    """Make every link a floor point of its own: (sighting, point) of every observation."""
    point = np.arange(len(links))
    return np.concatenate([links.a, links.b]), np.concatenate([point, point])


def observations(
    sightings: Sightings, used: Integers, point: Integers, num_frames: int
) -> Observations:
    """List the sightings by frame, with all pairs of sightings of a common floor point."""
    size = np.bincount(point)
    order = stable_order(sightings.frame[used] * len(size) + point)
    used, point = used[order], point[order]
    frame, by_point = sightings.frame[used], stable_order(point)
    pair_i, pair_j = _pairs_within(by_point, size)
    key = frame[pair_i] * num_frames + frame[pair_j]
    by_key = stable_order(key)
    key = key[by_key]
    start = np.flatnonzero(np.diff(key, prepend=-1))
    pair_start, frame_start = (
        np.append(start, len(key)),
        np.searchsorted(frame, np.arange(num_frames + 1)),
    )
    return Observations(
        frame,
        point,
        by_point[np.cumsum(size) - size],
        sightings.ray[used],
        sightings.sigma[used],
        np.ones(len(used)) if sightings.gain is None else sightings.gain[used],
        len(size),
        frame_start,
        pair_i[by_key],
        pair_j[by_key],
        key[start],
        pair_start,
    )


def _pairs_within(by_point: Integers, size: Integers) -> tuple[Integers, Integers]:
    """All pairs i < j of observations of the same point, from those of each point in turn."""
    first = np.cumsum(size) - size
    some_i, some_j = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    for length in np.flatnonzero(np.bincount(size)).tolist():
        i, j = np.triu_indices(length, 1)
        start = first[size == length][:, None]
        some_i.append(by_point[start + i].ravel())
        some_j.append(by_point[start + j].ravel())
    return np.concatenate(some_i), np.concatenate(some_j)
