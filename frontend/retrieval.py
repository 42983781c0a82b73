"""Which frames may show the same floor: a glance at all frames, then votes among the best few.

No prior knowledge of where anything is. Each frame speaks through its largest features, which other
cameras find again most reliably; their descriptors are reduced to leading principal components. The
sums of what a frame's features leave over beside their nearest words (VLAD: Jegou et al.,
Aggregating local descriptors into a compact image representation, 2010) pick candidates; then each
feature votes for those candidates that hold near kin. So the costly part of the work per frame does
not grow with the number of frames. Frames of other robots are asked apart: a robot that goes to and
fro sees its own floor in more frames than any list holds, and those look more alike.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from groundfuse.backend.option_checks import check_numbers
from groundfuse.frontend.features import Features

Short = NDArray[np.float32]
Indices = NDArray[np.int64]
CHUNK = 256
"""Frames whose likeness to all others is held at a time."""
ROUNDS = 10
"""Of moving words to the middle of what is nearest to them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RetrievalOptions:
    """Options of retrieval.

    Attributes:
        num_features: features per frame that vote and are voted for, the largest.
        num_components: principal components kept.
        num_words: words that the glance counts.
        num_sample: frames that components and words are learned from.
        num_candidates: frames that each frame's features may vote for.
        num_votes: frames that each feature votes for.
        num_frames: frames returned per frame.
        num_others: frames of other robots returned per frame, whether among those or not.
        least_votes: fewest votes of such a frame, over what the lower quarter of the candidates
            gets. Strangers' best get 3.7 to 5, views that share 40 % or more nearly always over 6
            (two robots on terrazzo and concrete, both kinds of features, seed 100).
    """

    num_features: int = 150
    num_components: int = 32
    num_words: int = 64
    num_sample: int = 64
    num_candidates: int = 64
    num_votes: int = 10
    num_frames: int = 8
    num_others: int = 3
    least_votes: float = 4.5

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense (ValueError)."""
        check_numbers(self, may_be_zero=("num_frames", "num_others", "least_votes"))


@dataclass(frozen=True, slots=True, eq=False)
class Vocabulary:
    """What frames are described by, as learned from a sample of them.

    Attributes:
        mean: (d,) of descriptors.
        axes: (d, c) leading principal components.
        words: (k, c) unit rows.
    """

    mean: Short
    axes: Short
    words: Short

    def reduced(self, rows: Short) -> Short:
        """Project descriptors (n, d) on the components, to unit length (n, c)."""
        return _unit((rows - self.mean) @ self.axes)


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


def learned(sample: Iterable[Features], options: RetrievalOptions) -> Vocabulary | None:
    """Learn components and words from some frames; None where they hold no feature."""
    chosen = [rows for frame in sample if len(rows := _largest(frame, options.num_features))]
    if not chosen:
        return None
    stacked = np.concatenate(chosen)
    mean: Short = stacked.mean(axis=0)
    centred = stacked - mean
    _, axes = np.linalg.eigh(centred.T @ centred)
    leading: Short = axes[:, ::-1][:, : options.num_components].astype(np.float32)
    return Vocabulary(mean, leading, _words(_unit(centred @ leading), options.num_words))


def described(frames: Iterable[Features], known: Vocabulary, options: RetrievalOptions) -> Short:
    """Return what is kept of each frame: the largest features' components (n, num_features, c).

    Frames are read once, one after the other: they need not be in memory together; some 19 kB each.
    """
    kept = [_padded(known.reduced(_largest(f, options.num_features)), options) for f in frames]
    shape = (len(kept), options.num_features, known.words.shape[1])
    return np.array(kept, dtype=np.float32).reshape(shape)


def votes(
    short: Short, known: Vocabulary, options: RetrievalOptions, robots: Indices | None = None
) -> Votes:
    """Let every frame's features vote: for all others, or for those of other `robots` (n,)."""
    near = _candidates(short, known.words, options.num_candidates, robots)
    if not any(len(frames) for frames in near):
        return Votes(np.zeros((0, 2), np.int64), np.zeros(0), np.zeros(len(short)))
    cast = [_cast(short, i, near[i], options.num_votes) for i in range(len(short))]
    chosen = [len(votes) == options.num_candidates for votes in cast]
    stranger = [np.quantile(v, 0.25) if c else 0.0 for v, c in zip(cast, chosen, strict=True)]
    voter = np.repeat(np.arange(len(near)), [len(frames) for frames in near])
    ends, every = np.column_stack([voter, np.concatenate(near)]), np.concatenate(cast)
    pairs, weight = _summed(ends[every > 0.0], every[every > 0.0], len(short))
    return Votes(pairs, weight, np.array(stranger))


def _summed(
    ends: Indices, cast: NDArray[np.float64], num_frames: int
) -> tuple[Indices, NDArray[np.float64]]:
    """Add up both directions of each pair."""
    low, high = ends.min(axis=1), ends.max(axis=1)
    key, place = np.unique(low * num_frames + high, return_inverse=True)
    weight: NDArray[np.float64] = np.bincount(place, cast, len(key)).astype(np.float64)
    return np.column_stack(np.divmod(key, num_frames)), weight


def _largest(frame: Features, most: int) -> Short:
    """Descriptors of the largest features as unit rows; bits become -1 and 1."""
    rows = frame.descriptors[np.argsort(-frame.log_size, kind="stable")[:most]]
    if rows.dtype == np.uint8:
        rows = np.unpackbits(rows, axis=1).astype(np.float32) / 8.0 - 1.0 / 16.0
    return rows.astype(np.float32)


def _unit(rows: NDArray[np.floating]) -> Short:
    length = np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-9)
    unit: Short = (rows / length).astype(np.float32)
    return unit


def _words(rows: Short, most: int) -> Short:
    """Middles of clusters of unit rows (spherical k-means), from evenly chosen starts."""
    start = np.linspace(0, len(rows) - 1, min(most, len(rows))).round().astype(np.int64)
    words = rows[start]
    for _ in range(ROUNDS):
        nearest = np.argmax(rows @ words.T, axis=1)
        total = np.zeros_like(words)
        np.add.at(total, nearest, rows)
        used = np.bincount(nearest, minlength=len(words)) > 0
        words = np.where(used[:, None], _unit(total), words)
    return words


def _padded(rows: Short, options: RetrievalOptions) -> Short:
    """Bring a frame's rows to the common number; zeros are like nothing."""
    full = np.zeros((options.num_features, rows.shape[1]), np.float32)
    full[: len(rows)] = rows
    return full


def _glance(short: Short, words: Short) -> Short:
    """Sum of what a frame's features (n, c) leave over beside their words, to unit length."""
    rows = short[short.any(axis=1)]
    nearest = np.argmax(rows @ words.T, axis=1)
    total = np.zeros_like(words)
    np.add.at(total, nearest, rows - words[nearest])
    glance: Short = _unit(total.reshape(1, -1))[0]
    return glance


def _candidates(
    short: Short, words: Short, most: int, robots: Indices | None = None
) -> list[Indices]:
    """Return up to `most` frames that look most like each frame, in order, without itself.

    Where `robots` (n,) are given, only frames of other robots.
    """
    count = len(short)
    own = np.arange(count) if robots is None else robots
    left = count - np.bincount(own, minlength=1)[own] if count else own
    if count and left.max() <= most:
        return [np.flatnonzero(own != own[i]) for i in range(count)]
    glances = np.stack([_glance(frame, words) for frame in short]) if count else short
    found: list[Indices] = []
    for start in range(0, count, CHUNK):
        likeness = glances[start : start + CHUNK] @ glances.T
        likeness[own[start : start + CHUNK, None] == own] = -np.inf
        for row, others in zip(likeness, left[start : start + CHUNK].tolist(), strict=True):
            kept = min(most, others)
            best = np.argpartition(-row, kept - 1)[:kept] if kept else np.zeros(0, np.int64)
            found.append(np.sort(best))
    return found


def _cast(short: Short, voter: int, near: Indices, num_votes: int) -> NDArray[np.float64]:
    """Return the votes (k,) of one frame for its candidates `near` (k,).

    A feature finds its nearest kin in each candidate and votes for the `num_votes` nearest, by how
    much nearer they are than the next: what looks like everything tells nothing.
    """
    count, size = len(near), short.shape[1]
    others = short[near].reshape(count * size, -1)
    likeness = (short[voter] @ others.T).reshape(size, count, size).max(axis=2)
    value = np.maximum(likeness, 0.0) ** 2
    if count > num_votes:
        next_best = np.partition(value, count - 1 - num_votes, axis=1)[:, count - 1 - num_votes]
        value = np.maximum(value - next_best[:, None], 0.0)
    cast: NDArray[np.float64] = value.sum(axis=0, dtype=np.float64)
    return cast


def retrieved(
    frames: Iterable[Features],
    sample: Iterable[Features],
    options: RetrievalOptions,
    robots: Indices | None = None,
) -> list[tuple[int, int]]:
    """Return pairs (i, j), i < j, where one is among the most similar frames of the other.

    Args:
        frames: all frames; read after the sample.
        sample: those to learn from.
        options: see `RetrievalOptions`.
        robots: (n,) which robot each frame is of; None for one robot.
    """
    known = learned(sample, options)
    if known is None:
        return []
    short = described(frames, known, options)
    found = _most_similar(votes(short, known, options), options.num_frames)
    if robots is not None and len(np.unique(robots)) > 1:
        others = votes(short, known, options, robots)
        found |= _most_similar(others, options.num_others, options.least_votes)
    return sorted(found)


def _most_similar(found: Votes, most: int, least: float = 0.0) -> set[tuple[int, int]]:
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
