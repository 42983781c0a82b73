"""Which pairs look alike, worked out for what is new only: piece by piece from the store.

What is kept of a frame depends on its look and on what the sample taught; the votes that it casts
on its candidates' looks besides. So one picture more costs its own description, a comparison with
those frames whose candidates it becomes, and a new count of their votes; no other frame's features
are fetched again.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice

import numpy as np

from groundfuse.backend.measurement import FrameId
from groundfuse.frontend.ahead import Result, in_threads
from groundfuse.frontend.arrays import Mask
from groundfuse.frontend.features import Features
from groundfuse.frontend.pairs import Pair, retrieved_pairs, sample_of
from groundfuse.frontend.retrieval import (
    Casts,
    Compare,
    Count,
    Described,
    Lists,
    RetrievalOptions,
    Vocabulary,
    cast_for,
    every_candidate,
)
from groundfuse.frontend.retrieval_votes import Kin
from groundfuse.tools.code_version import code_of
from groundfuse.tools.packing import key_of, packed
from groundfuse.tools.store import TOGETHER, Store


def similar_pairs(
    looks: Mapping[FrameId, bytes],
    features: Mapping[FrameId, Features],
    options: RetrievalOptions,
    store: Store,
    num_threads: int,
) -> list[Pair]:
    """Return the pairs that look alike; they depend on nothing but what was seen, and the order.

    Args:
        looks: keys of what was seen of every frame.
        features: of every frame, fetched where they are needed.
        options: of retrieval.
        store: what is known.
        num_threads: that vote.

    Raises:
        DataError: a picture can't be read again, or the store can't be written.
    """
    order = sorted(looks)
    place = {frame: k for k, frame in enumerate(order)}

    def work() -> list[tuple[int, int]]:
        memory = Pieces(store, {frame: looks[frame] for frame in order}, options, num_threads)
        pairs = retrieved_pairs(features, options, memory)
        return [(place[a], place[b]) for a, b in pairs]

    code, robots = code_of("groundfuse.frontend.pairs"), [frame.robot for frame in order]
    parts = (code, [looks[frame] for frame in order], robots, options)
    found: tuple[tuple[int, int], ...] = store.kept("retrieval", "team", parts, work)
    return [(order[i], order[j]) for i, j in found]


@dataclass(frozen=True, slots=True, eq=False)
class _Table:
    """How like a frame's features those of others are: the ones that it was last asked of.

    Attributes:
        looks: keys of the others' looks, one after the other: a hundred of them are read as one.
        nearest: (k, m) see `nearest_kin`.
    """

    looks: bytes
    nearest: Kin

    def row_of(self) -> dict[bytes, int]:
        """Return the row of each look."""
        size = len(self.looks) // max(len(self.nearest), 1)
        return {self.looks[k * size : (k + 1) * size]: k for k in range(len(self.nearest))}


class Pieces:
    """What retrieval works out, from the store where it was before; see `retrieval.Memory`.

    Args:
        store: where the pieces are.
        looks: keys of what was seen, of the frames in order.
        options: of retrieval.
        num_threads: that describe and vote.
    """

    def __init__(
        self,
        store: Store,
        looks: Mapping[FrameId, bytes],
        options: RetrievalOptions,
        num_threads: int,
    ) -> None:
        self._store = store
        self._names = [str(frame) for frame in looks]
        self._looks = list(looks.values())
        self._num_threads = num_threads
        self._code = code_of("groundfuse.tools.similar", rooms=("frontend", "tools"))
        sample = [looks[frame] for frame in sample_of(looks, options)]
        self._taught = key_of("taught", code_of("groundfuse.frontend.retrieval"), options, sample)

    def vocabulary(self, work: Callable[[], Vocabulary | None]) -> Vocabulary | None:
        """Return what the sample taught: it depends on the sample's looks in order."""
        found: Vocabulary | None = self._store.kept("vocabulary", "team", (self._taught,), work)
        return found

    def described(self, work: Callable[[int], Described]) -> list[Described]:
        """Return what is kept of every frame: it depends on its look and what was taught."""
        keys = [key_of("described", self._taught, look) for look in self._looks]
        return self._each("described", keys, work)

    def cast(self, near: Sequence[Lists], kin: Compare, count: Count) -> list[Casts]:
        """Return every frame's votes: they depend on the looks of its candidates, too."""
        keys = []
        for look, lists in zip(self._looks, near, strict=True):
            others = [b"".join(self._looks[k] for k in frames.tolist()) for frames in lists]
            keys.append(key_of("votes", self._taught, look, others))

        def vote(item: tuple[int, _Table | None]) -> tuple[Casts, bytes | None]:
            voter, kept = item
            every = every_candidate(near[voter])
            looks = [self._looks[k] for k in every.tolist()]
            table = _completed(kept, looks, lambda new: kin(voter, every[new]))
            casts = cast_for(near[voter], every, table.nearest, count)
            return casts, None if table is kept else packed(table)

        return self._store.kept_each("votes", self._names, keys, partial(self._voted, vote))

    def _voted(
        self,
        vote: Callable[[tuple[int, "_Table | None"]], tuple[Casts, bytes | None]],
        voters: Sequence[int],
    ) -> Iterator[Casts]:
        """Let frames vote, each with what it was compared with before, and write that down."""
        left = iter(voters)
        while some := list(islice(left, TOGETHER)):
            keys = [key_of("kin", self._code, self._taught, self._looks[k]) for k in some]
            items = zip(some, self._store.load_all(keys), strict=True)
            voted = list(in_threads(vote, items, self._num_threads))
            names = [self._names[k] for k in some]
            tables = zip(keys, names, (table for _, table in voted), strict=True)
            self._store.save_all("kin", [(k, n, data) for k, n, data in tables if data is not None])
            yield from (casts for casts, _ in voted)

    def _each(
        self, kind: str, keys: Sequence[bytes], work: Callable[[int], Result]
    ) -> list[Result]:
        def works(places: Sequence[int]) -> Iterable[Result]:
            return in_threads(work, places, self._num_threads)

        return self._store.kept_each(kind, self._names, keys, works)


def _completed(
    kept: _Table | None, looks: Sequence[bytes], compare: Callable[[Mask], Kin]
) -> _Table:
    """Return a frame's likeness to these looks, of which those are compared that are new."""
    joined = b"".join(looks)
    if kept is not None and kept.looks == joined:
        return kept
    row_of = {} if kept is None else kept.row_of()
    rows = np.array([row_of.get(look, -1) for look in looks], np.int64)
    new = rows < 0
    if kept is None or new.all():
        return _Table(joined, compare(new))
    nearest = kept.nearest[rows]
    if new.any():
        nearest[new] = compare(new)
    return _Table(joined, nearest)
