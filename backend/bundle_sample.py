"""Part of the correspondences, or of the floor points, drawn so that no order or name matters.

Chance comes from the keypoints' own bits: the same pictures give the same part, however frames are
numbered and pairs are listed.
"""

import numpy as np
from numpy.typing import NDArray

from groundfuse.backend.bundle_tracks import (
    Integers,
    Keys,
    Links,
    Mask,
    Sightings,
    mixed_keys,
    renumbered,
)

Array = NDArray[np.float64]


def _chance(keys: Keys) -> Array:
    """Turn keys into numbers from 0 to 1."""
    number: Array = (keys >> np.uint64(11)).astype(np.float64) / 2.0**53
    return number


def _keys(sightings: Sightings) -> Keys:
    return mixed_keys(np.zeros(len(sightings), dtype=np.int64), sightings.ray)


def thinned(links: Links, sightings: Sightings, most: int) -> Mask:
    """Keep about `most` links per frame, evenly over its pairs.

    A pair keeps what the needier of its frames asks for.
    """
    count = np.bincount(links.edge)
    pairs = np.flatnonzero(count)
    first = (np.cumsum(count) - count)[pairs]
    ends = np.stack([sightings.frame[links.a[first]], sightings.frame[links.b[first]]])
    pairs_of_frame = np.bincount(ends.ravel())
    share = np.zeros(len(count))
    share[pairs] = most / pairs_of_frame[ends].min(axis=0) / count[pairs]
    keys = _keys(sightings)
    kept: Mask = _chance(keys[links.a] + keys[links.b]) < share[links.edge]
    return kept


def sampled(
    used: Integers, point: Integers, sightings: Sightings, most: int
) -> tuple[Integers, Integers]:
    """Keep some floor points whole, so that each frame has about `most` sightings or all it had.

    A point is as likely kept as the neediest of its frames asks for.
    """
    frame = sightings.frame[used]
    share = np.minimum(most / np.maximum(np.bincount(frame), 1), 1.0)
    wanted, keys = np.zeros(int(point.max()) + 1), np.zeros(int(point.max()) + 1, dtype=np.uint64)
    np.maximum.at(wanted, point, share[frame])
    np.add.at(keys, point, _keys(sightings)[used])
    inside = (_chance(keys) < wanted)[point]
    return used[inside], renumbered(point[inside])
