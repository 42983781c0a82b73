"""Which frames may show the same floor: a glance at all frames, then votes among the best few.

No prior knowledge of where anything is. Each frame speaks through its largest features, which other
cameras find again most reliably; their descriptors are reduced to leading principal components. The
sums of what a frame's features leave over beside their nearest words (VLAD: Jegou et al.,
Aggregating local descriptors into a compact image representation, 2010) pick candidates; then each
feature votes for those candidates that hold near kin. So the costly part of the work per frame does
not grow with the number of frames. Frames of other robots are asked apart: a robot that goes to and
fro sees its own floor in more frames than any list holds, and those look more alike.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from groundfuse.backend.option_checks import check_numbers
from groundfuse.frontend.features import Features
from groundfuse.frontend.retrieval_votes import (
    Cast,
    Indices,
    Kin,
    Short,
    Votes,
    candidates,
    cast,
    counted,
    most_similar,
    nearest_kin,
)

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
class Described:
    """What is kept of one frame, some 27 kB.

    Attributes:
        rows: (num_features, c) the largest features' components, zeros where it has fewer.
        glance: (k c,) what its features leave over beside the words, to unit length.
    """

    rows: Short
    glance: Short


Lists = tuple[Indices, ...]
"""Candidates of one frame: of all others, and of other robots where there are such."""
Casts = tuple[Cast, ...]
"""Its votes for those of each list."""
Compare = Callable[[int, Indices], Kin]
"""Compares a frame's features with some others'; see `nearest_kin`."""
Count = Callable[[Kin], Cast]


class Frames(Protocol):
    """Features of frames by their places, each fetched when it is asked for."""

    def __len__(self) -> int:
        """Return how many there are."""
        ...

    def __getitem__(self, place: int, /) -> Features:
        """Return those of a frame."""
        ...


class Memory(Protocol):
    """Gives what `work` gives, from before where it is known what that was."""

    def vocabulary(self, work: Callable[[], Vocabulary | None]) -> Vocabulary | None:
        """Return what the sample taught."""
        ...

    def described(self, work: Callable[[int], Described]) -> Iterable[Described]:
        """Return what is kept of every frame, which the vocabulary says too."""
        ...

    def cast(self, near: Sequence[Lists], kin: Compare, count: Count) -> Sequence[Casts]:
        """Return every frame's votes for its lists of candidates; see `cast_for`."""
        ...


@dataclass(frozen=True, slots=True)
class Forgetful:
    """Works everything out anew, for so many frames."""

    count: int

    def vocabulary(self, work: Callable[[], Vocabulary | None]) -> Vocabulary | None:
        """Learn it."""
        return work()

    def described(self, work: Callable[[int], Described]) -> Iterable[Described]:
        """Describe every frame."""
        return map(work, range(self.count))

    def cast(self, near: Sequence[Lists], kin: Compare, count: Count) -> list[Casts]:
        """Let every frame vote."""
        every = map(every_candidate, near)
        return [
            cast_for(lists, others, kin(k, others), count)
            for k, (lists, others) in enumerate(zip(near, every, strict=True))
        ]


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


def described(features: Features, known: Vocabulary, options: RetrievalOptions) -> Described:
    """Return what is kept of a frame: the largest features' components, and a glance at them."""
    rows = _padded(known.reduced(_largest(features, options.num_features)), options)
    return Described(rows, _glance(rows, known.words))


def votes(
    short: Short,
    glances: Short,
    options: RetrievalOptions,
    robots: Indices | None = None,
    memory: Memory | None = None,
) -> list[Votes]:
    """Let every frame's features vote: for all others, and for those of other robots.

    Args:
        short: (n, num_features, c) rows of all frames.
        glances: (n, k c) of all frames.
        options: see `RetrievalOptions`.
        robots: which robot each frame is of; None for one, and then there are no other votes.
        memory: of votes that were cast before.
    """
    asked = [None] if robots is None else [None, robots]
    lists = [candidates(glances, options.num_candidates, whose) for whose in asked]

    def kin(voter: int, others: Indices) -> Kin:
        return nearest_kin(short[voter], short[others])

    def count(nearest: Kin) -> Cast:
        return cast(nearest, options.num_votes)

    found = (memory or Forgetful(len(short))).cast(list(zip(*lists, strict=True)), kin, count)
    return [
        counted(near, [casts[k] for casts in found], options.num_candidates)
        for k, near in enumerate(lists)
    ]


def cast_for(lists: Lists, every: Indices, nearest: Kin, count: Count) -> Casts:
    """Return one frame's votes for each list of candidates, compared once with `every` of them."""
    return tuple(count(nearest[np.searchsorted(every, near)]) for near in lists)


def every_candidate(lists: Lists) -> Indices:
    """Return the frames on any list, each once, in order."""
    return np.unique(np.concatenate(lists))


def stacked(frames: Iterable[Described]) -> tuple[Short, Short]:
    """Return the rows (n, num_features, c) and the glances (n, k c) of frames."""
    every = list(frames)
    return np.stack([frame.rows for frame in every]), np.stack([frame.glance for frame in every])


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


def retrieved(
    frames: Frames,
    sample: Iterable[Features],
    options: RetrievalOptions,
    robots: Indices | None = None,
    memory: Memory | None = None,
) -> list[tuple[int, int]]:
    """Return pairs (i, j), i < j, where one is among the most similar frames of the other.

    Args:
        frames: all frames; each is read once, after the sample, where the memory has it not.
        sample: those to learn from.
        options: see `RetrievalOptions`.
        robots: (n,) which robot each frame is of; None for one robot.
        memory: of what was worked out before; nothing changes but the time it takes.
    """
    memory = memory or Forgetful(len(frames))
    known = memory.vocabulary(lambda: learned(sample, options))
    if known is None or not len(frames):
        return []
    short, glances = stacked(
        memory.described(lambda place: described(frames[place], known, options))
    )
    several = robots if robots is not None and len(np.unique(robots)) > 1 else None
    every, *others = votes(short, glances, options, several, memory)
    found = most_similar(every, options.num_frames)
    for some in others:
        found |= most_similar(some, options.num_others, options.least_votes)
    return sorted(found)
