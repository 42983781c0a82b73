"""Which pairs of frames to compare: neighbours in time, skips over failures, retrieved frames."""

import hashlib
import itertools
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from groundfuse.backend.measurement import FrameId
from groundfuse.backend.option_checks import check_numbers
from groundfuse.frontend.features import Features
from groundfuse.frontend.predicted import Pair, PredictedOptions
from groundfuse.frontend.retrieval import Memory, RetrievalOptions, retrieved

__all__ = ["Pair", "PairOptions", "neighbour_pairs", "retrieved_pairs", "sample_of", "skip_pairs"]


@dataclass(frozen=True, slots=True, kw_only=True)
class PairOptions:
    """Options of the choice of pairs.

    Attributes:
        retrieval: see `RetrievalOptions`.
        predicted: pairs of a second round; see `PredictedOptions`.
        max_skip: a failed neighbour is bridged over at most this many frames.
    """

    retrieval: RetrievalOptions = field(default_factory=RetrievalOptions)
    predicted: PredictedOptions = field(default_factory=PredictedOptions)
    max_skip: int = 3

    def __post_init__(self) -> None:
        """Refuse numbers that make no sense (ValueError)."""
        check_numbers(self, may_be_zero=("max_skip",))


def neighbour_pairs(frames: Sequence[FrameId]) -> list[Pair]:
    """Return consecutive frames of each robot."""
    order = sorted(frames)
    return [(a, b) for a, b in itertools.pairwise(order) if a.robot == b.robot]


def sample_of(frames: Iterable[FrameId], options: RetrievalOptions) -> list[FrameId]:
    """Return the frames that retrieval learns from, in order.

    The sample stays nearly the same when frames are added.
    """
    return sorted(sorted(frames, key=_lot)[: options.num_sample])


def retrieved_pairs(
    features: Mapping[FrameId, Features], options: RetrievalOptions, memory: Memory | None = None
) -> list[Pair]:
    """Return pairs that look alike, anywhere in the team.

    Args:
        features: of every frame.
        options: see there.
        memory: of what was worked out before for these frames in order.
    """
    order = sorted(features)
    names = sorted({frame.robot for frame in order})
    robots = np.array([names.index(frame.robot) for frame in order], dtype=np.int64)
    sample = (features[frame] for frame in sample_of(order, options))
    found = retrieved(_InOrder(features, order), sample, options, robots, memory)
    return [(order[i], order[j]) for i, j in found]


@dataclass(frozen=True, slots=True, eq=False)
class _InOrder:
    """The features of frames by their places."""

    features: Mapping[FrameId, Features]
    order: Sequence[FrameId]

    def __len__(self) -> int:
        return len(self.order)

    def __getitem__(self, place: int, /) -> Features:
        return self.features[self.order[place]]


def _lot(frame: FrameId) -> bytes:
    """Draw a frame's lot: by its name alone, whoever else is there."""
    return hashlib.blake2b(str(frame).encode(errors="surrogatepass"), digest_size=8).digest()


def skip_pairs(frames: Sequence[FrameId], joined: Collection[Pair], skip: int) -> list[Pair]:
    """Return pairs `skip` frames apart that would bridge a place where the chain is cut.

    The chain is cut between two consecutive frames if no accepted pair of the robot spans the gap.

    Args:
        frames: all frames.
        joined: accepted pairs so far.
        skip: distance in frames, at least 2.
    """
    by_robot: dict[str, list[FrameId]] = {}
    for frame in sorted(frames):
        by_robot.setdefault(frame.robot, []).append(frame)
    wanted: set[Pair] = set()
    for order in by_robot.values():
        place = {frame: k for k, frame in enumerate(order)}
        spanned = [False] * len(order)
        for a, b in joined:
            if a in place and b in place:
                first, last = sorted((place[a], place[b]))
                spanned[first:last] = [True] * (last - first)
        wanted.update(
            (order[start], order[start + skip])
            for start in range(len(order) - skip)
            if not all(spanned[start : start + skip])
        )
    return sorted(wanted.difference(joined))
