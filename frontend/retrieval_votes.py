"""Which frames look most like each, at a glance, and how many votes their features give those."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Short = NDArray[np.float32]
Indices = NDArray[np.int64]
Cast = NDArray[np.float64]
Kin = NDArray[np.float16]
"""(k, m) how like the nearest kin of each of a frame's features is in k others. A half's 11 bits
are finer than what descriptors of two pictures have in common, and much of this is kept."""
CHUNK = 256
"""Frames whose likeness to all others is held at a time."""
TOGETHER = 8
"""Candidates whose features are compared at a time: in memory that is used again, as threads that
ask for new memory wait for each other."""


@dataclass(frozen=True, slots=True, eq=False)
class Votes:
    """Votes between frames, each pair once, in order.

    Attributes:
        pairs: (m, 2) indices i < j.
        weight: (m,) above 0, of both directions.
        stranger: (n,) what each frame gives the lower quarter of its candidates; 0 where they are
            all there are and none was chosen.
    """

    pairs: Indices
    weight: NDArray[np.float64]
    stranger: NDArray[np.float64]


def candidates(glances: Short, most: int, robots: Indices | None = None) -> list[Indices]:
    """Return up to `most` frames that look most like each frame, in order, without itself.

    Args:
        glances: (n, d) of each frame, to unit length.
        most: how many.
        robots: (n,) whose each frame is; where they are given, only frames of other robots.
    """
    count = len(glances)
    own = np.arange(count) if robots is None else robots
    left = count - np.bincount(own, minlength=1)[own] if count else own
    if count and left.max() <= most:
        return [np.flatnonzero(own != own[i]) for i in range(count)]
    found: list[Indices] = []
    for start in range(0, count, CHUNK):
        likeness = glances[start : start + CHUNK] @ glances.T
        likeness[own[start : start + CHUNK, None] == own] = -np.inf
        for row, others in zip(likeness, left[start : start + CHUNK].tolist(), strict=True):
            kept = min(most, others)
            best = np.argpartition(-row, kept - 1)[:kept] if kept else np.zeros(0, np.int64)
            found.append(np.sort(best))
    return found


def nearest_kin(voter: Short, others: Short) -> Kin:
    """Return how like a frame's features (m, c) their nearest kin in others (k, m, c) are.

    Each of the others is compared on its own, so its row is the same whoever stands beside it.
    """
    count, size, _ = others.shape
    nearest = np.empty((count, size), np.float16)
    likeness = np.empty((min(TOGETHER, count), size, size), np.float32)
    for start in range(0, count, TOGETHER):
        some = others[start : start + TOGETHER]
        part = likeness[: len(some)]
        np.matmul(some, voter.T, out=part)
        nearest[start : start + TOGETHER] = part.max(axis=1)
    return nearest


def cast(nearest: Kin, num_votes: int) -> Cast:
    """Return the votes (k,) of one frame's features for its k candidates.

    A feature votes for the `num_votes` that hold its nearest kin (k, m), by how much nearer that is
    than the next: what looks like everything tells nothing.
    """
    count = len(nearest)
    value = np.maximum(np.ascontiguousarray(nearest.T, np.float32), 0.0) ** 2
    if count > num_votes:
        next_best = np.partition(value, count - 1 - num_votes, axis=1)[:, count - 1 - num_votes]
        value = np.maximum(value - next_best[:, None], 0.0)
    votes: Cast = value.sum(axis=0, dtype=np.float64)
    return votes


def counted(near: list[Indices], votes: list[Cast], num_candidates: int) -> Votes:
    """Add up the votes of every frame for its candidates `near`.

    Args:
        near: of each frame, in order.
        votes: of each frame, for those.
        num_candidates: so many were chosen where there were more.
    """
    stranger = np.zeros(len(near))
    chosen = [k for k, cast_votes in enumerate(votes) if len(cast_votes) == num_candidates]
    if chosen:
        stranger[chosen] = np.quantile(np.stack([votes[k] for k in chosen]), 0.25, axis=1)
    if not any(len(frames) for frames in near):
        return Votes(np.zeros((0, 2), np.int64), np.zeros(0), stranger)
    voter = np.repeat(np.arange(len(near)), [len(frames) for frames in near])
    ends, every = np.column_stack([voter, np.concatenate(near)]), np.concatenate(votes)
    pairs, weight = _summed(ends[every > 0.0], every[every > 0.0], len(near))
    return Votes(pairs, weight, stranger)


def _summed(ends: Indices, votes: Cast, num_frames: int) -> tuple[Indices, Cast]:
    """Add up both directions of each pair."""
    low, high = ends.min(axis=1), ends.max(axis=1)
    key, place = np.unique(low * num_frames + high, return_inverse=True)
    weight: Cast = np.bincount(place, votes, len(key)).astype(np.float64)
    return np.column_stack(np.divmod(key, num_frames)), weight


def most_similar(found: Votes, most: int, least: float = 0.0) -> set[tuple[int, int]]:
    """Return the pairs where one is among the `most` frames with most votes of the other.

    And with at least `least` times the votes that the other gives a stranger.
    """
    by, other = np.concatenate([found.pairs, found.pairs[:, ::-1]]).T
    order = np.lexsort((other, -np.tile(found.weight, 2), by))
    by, other = by[order], other[order]
    rank = np.arange(len(by)) - np.searchsorted(by, by)
    enough = np.tile(found.weight, 2)[order] >= least * found.stranger[by]
    ends = np.column_stack([by, other])[(rank < most) & enough]
    return {(min(i, j), max(i, j)) for i, j in ends.tolist()}
