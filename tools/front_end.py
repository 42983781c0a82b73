"""Run the front-end over a team: features of every frame, then every pair that is worth a try.

A second round tries views that share floor by what their poses say, where the graph is weak. What
the store knows already is not done again.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, closing
from dataclasses import dataclass

import numpy as np

from groundfuse.backend.measurement import FrameId, Rejected, RelativePose
from groundfuse.frontend.ahead import in_threads
from groundfuse.frontend.pairs import Pair, neighbour_pairs, skip_pairs
from groundfuse.tools.frame_look import LookJob, look_job
from groundfuse.tools.front_end_options import FrontEndOptions, comparable
from groundfuse.tools.packing import key_of, unpacked
from groundfuse.tools.pair_verdict import PairJob, Spot, Verdict, named, pair_job
from groundfuse.tools.robot import Robot
from groundfuse.tools.shelf import AllFeatures, Shelf
from groundfuse.tools.similar import similar_pairs
from groundfuse.tools.store import Store
from groundfuse.tools.workers import Progress, Workers

Stage = Callable[[str], AbstractContextManager[None]]
READERS = 4
"""Threads that read files: more than cores, as disks answer late."""


@dataclass(frozen=True, slots=True)
class Reused:
    """How much the store knew: pictures and pairs, of all that were asked for."""

    num_looks: int
    num_frames: int
    num_verdicts: int
    num_pairs: int

    def line(self) -> str:
        """Return it as a sentence, empty where nothing was known."""
        if self.num_looks == self.num_verdicts == 0:
            return ""
        pictures = f"{self.num_looks} of {self.num_frames} pictures"
        return f"from the store: {pictures}, {self.num_verdicts} of {self.num_pairs} pairs"


@dataclass(frozen=True, slots=True, eq=False)
class FrontEndResult:
    """What the front-end found.

    Attributes:
        edges: accepted pairs, in order of frames.
        rejected: the other pairs that were tried.
        repetition: of every frame's floor; see `frontend/repetition.py`.
        pictures: digest of every frame's file.
        reused: what the store knew.
        num_further: pairs of the second round.
        key: digest of all that this depends on.
    """

    edges: tuple[RelativePose, ...]
    rejected: tuple[Rejected, ...]
    repetition: dict[FrameId, float]
    pictures: dict[FrameId, bytes]
    reused: Reused
    num_further: int
    key: bytes


class FrontEnd:
    """The front-end at work: a first round at once, others when they are asked for.

    Args:
        robots: the team.
        options: see there.
        workers: do the work.
        store: what is known.
        progress: shows how far it is.
        stage: takes the time of each stage.

    Raises:
        DataError: a picture can't be read, or the store can't be written.
    """

    def __init__(
        self,
        robots: Sequence[Robot],
        options: FrontEndOptions,
        workers: Workers,
        store: Store,
        progress: Progress,
        stage: Stage,
    ) -> None:
        options = comparable(options, robots)
        placed = [(robot, frame) for robot in robots for frame in robot.frames]
        with stage("features"):
            jobs = list(in_threads(lambda rf: look_job(*rf, options), placed, READERS))
            shelf = Shelf(store, {job.key: job for job in jobs}, options)
            self._num_looks = _look(jobs, shelf, workers, options, store, progress)
            self._repetition = _repetition(jobs, shelf, store)
        self._pictures = {job.frame.id: job.picture for job in jobs}
        spots = {
            job.frame.id: Spot(job.frame, robot, job.key)
            for (robot, _), job in zip(placed, jobs, strict=True)
        }
        self._stage = stage
        self._order = sorted(spots)
        self._tried = _Pairs(spots, shelf, workers, options, store, progress)
        self._num_further = 0
        with stage("retrieval"):
            looks = {frame: spots[frame].key for frame in self._order}
            seen, how = AllFeatures(shelf, looks), options.pairs.retrieval
            similar = similar_pairs(looks, seen, how, store, workers.num_threads)
        with stage("pairs"):
            self._tried.add([*neighbour_pairs(self._order), *similar], "pairs")
            for skip in range(2, options.pairs.max_skip + 1):
                further = skip_pairs(self._order, self._tried.joined(), skip)
                self._tried.add(further, f"bridging {skip}")

    @property
    def tried(self) -> set[Pair]:
        """All pairs that were tried."""
        return set(self._tried.found)

    def try_further(self, pairs: Sequence[Pair]) -> None:
        """Try pairs of a second round.

        Raises:
            DataError: the store can't be written.
        """
        before = len(self._tried.found)
        with self._stage("pairs"):
            self._tried.add(pairs, "second round")
        self._num_further += len(self._tried.found) - before

    def result(self) -> FrontEndResult:
        """Return what was found so far."""
        tried, place = self._tried, {frame: k for k, frame in enumerate(self._order)}
        pairs = sorted((place[a], place[b]) for a, b in tried.found)
        named = [(self._order[i], self._order[j]) for i, j in pairs]
        outcome = [tried.found[pair] for pair in named]
        keys = b"".join(tried.keys[pair] for pair in named)
        return FrontEndResult(
            tuple(found for found in outcome if isinstance(found, RelativePose)),
            tuple(found for found in outcome if isinstance(found, Rejected)),
            self._repetition,
            self._pictures,
            Reused(self._num_looks, len(self._order), tried.num_known, len(tried.found)),
            self._num_further,
            key_of("front end", self._order, np.array(pairs, dtype=np.int64), keys),
        )


def run_front_end(
    robots: Sequence[Robot],
    options: FrontEndOptions,
    workers: Workers,
    store: Store,
    progress: Progress,
    stage: Stage,
) -> FrontEndResult:
    """Detect, choose pairs, match, and bridge the places where a chain is cut.

    Raises:
        DataError: a picture can't be read, or the store can't be written.
    """
    return FrontEnd(robots, options, workers, store, progress, stage).result()


def _look(
    jobs: Sequence[LookJob],
    shelf: Shelf,
    workers: Workers,
    options: FrontEndOptions,
    store: Store,
    progress: Progress,
) -> int:
    """Look at the pictures that the store does not know; return how many it does."""
    known = store.known(job.key for job in jobs)
    todo = list({job.key: job for job in jobs if job.key not in known}.values())
    if todo:
        with closing(workers.look(todo, options)) as found:
            for job, data in progress(found, len(todo), "features"):
                shelf.put(job, data)
    return sum(job.key in known for job in jobs)


def _repetition(jobs: Sequence[LookJob], shelf: Shelf, store: Store) -> dict[FrameId, float]:
    """Return one number of each frame's features without fetching all of them each time."""

    def works(places: Sequence[int]) -> Iterator[float]:
        return (shelf.looked(jobs[k].key).features.repetition for k in places)

    names, keys = [str(job.frame.id) for job in jobs], [key_of("repetition", j.key) for j in jobs]
    found = store.kept_each("repetition", names, keys, works)
    return {job.frame.id: value for job, value in zip(jobs, found, strict=True)}


class _Pairs:
    """The pairs that were tried so far."""

    def __init__(
        self,
        spots: dict[FrameId, Spot],
        shelf: Shelf,
        workers: Workers,
        options: FrontEndOptions,
        store: Store,
        progress: Progress,
    ) -> None:
        self.found: dict[Pair, Verdict] = {}
        self.keys: dict[Pair, bytes] = {}
        self.num_known = 0
        self._spots = spots
        self._shelf = shelf
        self._workers = workers
        self._options = options
        self._store = store
        self._progress = progress

    def joined(self) -> set[Pair]:
        """Return the accepted ones."""
        return {pair for pair, found in self.found.items() if isinstance(found, RelativePose)}

    def add(self, pairs: Iterable[Pair], title: str) -> None:
        """Try pairs, each once."""
        new = [(a, b) for a, b in dict.fromkeys(pairs) if (a, b) not in self.found]
        jobs = [pair_job(self._spots[a], self._spots[b], self._options) for a, b in new]
        todo: list[PairJob] = []
        known: Verdict | None
        verdicts = self._store.load_all(job.key for job in jobs)
        for (a, b), job, known in zip(new, jobs, verdicts, strict=True):
            self.keys[a, b] = job.key
            if known is None:
                todo.append(job)
            else:
                self.num_known += 1
                self.found[a, b] = named(known, a, b)
        if not todo:
            return
        with closing(self._workers.compare(todo, self._shelf, self._options)) as found:
            for job, data in self._progress(found, len(todo), title):
                self._keep(job, data)

    def _keep(self, job: PairJob, data: bytes) -> None:
        a, b = job.a.id, job.b.id
        self._store.save(job.key, "pair", f"{a}-{b}", data)
        self.found[a, b] = named(unpacked(data), a, b)
