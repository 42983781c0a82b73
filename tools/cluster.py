"""The same work on a `dask.distributed` cluster, whose machines need not share a disk with ours."""

import logging
import math
import time
from collections import OrderedDict
from collections.abc import Callable, Generator, Sequence
from itertools import islice
from types import TracebackType
from typing import Any, Self, TypeVar

from groundfuse.tools.cluster_check import connected, refusal_of
from groundfuse.tools.cluster_tasks import badge, hold_task, look_task, pair_task
from groundfuse.tools.errors import TeamError
from groundfuse.tools.frame_look import LookJob, picture_of
from groundfuse.tools.front_end_options import FrontEndOptions
from groundfuse.tools.pair_verdict import PairJob
from groundfuse.tools.shelf import Shelf

log = logging.getLogger(__name__)
Job = TypeVar("Job")
AHEAD = 3
"""Orders under way per thread of the cluster."""
POLL_S = 1.0
PATIENCE_S = 60.0
"""How long a cluster without workers is waited for."""
MOST_HELD_BYTES = 200_000_000
"""Looks that lie on the cluster for the pairs that need them."""


class Cluster:
    """A cluster that was found to compute what this machine would.

    Args:
        address: of its scheduler.
        num_threads: of this process, for the work that is not given away.
        patience_s: how long a cluster without workers is waited for.

    Raises:
        TeamError: no scheduler answers, or one of its machines is not fit for the work.
    """

    def __init__(
        self, address: str, *, num_threads: int = 1, patience_s: float = PATIENCE_S
    ) -> None:
        self.address = address
        self.num_threads = num_threads
        self._patience_s = patience_s
        self._client = connected(address)
        self._badge = badge()
        self._held: OrderedDict[bytes, tuple[Any, int]] = OrderedDict()
        self._alone_since_s: float | None = None
        self._num_theirs, self._counted_s = 0, -math.inf
        why: str | None = "the check did not end"
        try:
            why = refusal_of(self._client, self._badge)
        finally:
            if why is not None:
                self.close()
        if why is not None:
            raise TeamError(f"{address}: {why}")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Leave the cluster, which goes on without us."""
        self._held.clear()
        self._client.close(timeout=5)

    def look(
        self, jobs: Sequence[LookJob], options: FrontEndOptions
    ) -> Generator[tuple[LookJob, bytes], None, None]:
        """Look at pictures; their files' bytes are sent."""

        def submit(job: LookJob) -> Any:  # noqa: ANN401
            return self._submit(look_task, self._badge, picture_of(job), job, options)

        return self._results(jobs, submit)

    def compare(
        self, jobs: Sequence[PairJob], shelf: Shelf, options: FrontEndOptions
    ) -> Generator[tuple[PairJob, bytes], None, None]:
        """Compare pairs; what was seen is sent once and stays while there is room."""

        def submit(job: PairJob) -> Any:  # noqa: ANN401
            a, b = (self._hold(key, shelf) for key in job.looks)
            return self._submit(pair_task, self._badge, a, b, job, options)

        return self._results(jobs, submit)

    def _submit(self, task: Callable[..., bytes], *arguments: object) -> Any:  # noqa: ANN401
        return self._client.submit(task, *arguments, pure=False)

    def _hold(self, key: bytes, shelf: Shelf) -> Any:  # noqa: ANN401
        """Return what stands for a look on the cluster; the scheduler mends what workers lose."""
        if key not in self._held:
            data = shelf.packed(key)
            self._held[key] = (self._submit(hold_task, data), len(data))
        self._held.move_to_end(key)
        while sum(size for _, size in self._held.values()) > MOST_HELD_BYTES:
            self._held.popitem(last=False)
        return self._held[key][0]

    def _results(
        self, jobs: Sequence[Job], submit: Callable[[Job], Any]
    ) -> Generator[tuple[Job, bytes], None, None]:
        """Keep the cluster busy with few orders at a time, and yield as they are done."""
        under_way: dict[Any, Job] = {}
        todo = iter(jobs)
        try:
            while True:
                for job in islice(todo, max(self._room(len(under_way)), 0)):
                    under_way[submit(job)] = job
                if not under_way:
                    return
                for future, data in self._done(list(under_way)):
                    yield under_way.pop(future), data
        finally:
            if under_way and self._client.status == "running":
                self._client.cancel(list(under_way))

    def _done(self, futures: list[Any]) -> list[tuple[Any, bytes]]:
        """Return those that are done within a moment.

        Raises:
            TeamError: a worker refused, no worker is left for long, or the scheduler is gone.
        """
        from concurrent.futures import CancelledError  # noqa: PLC0415

        from distributed import wait  # noqa: PLC0415
        from distributed.scheduler import KilledWorker  # noqa: PLC0415

        try:
            with self._client.as_current():
                ended: Any = wait(futures, timeout=POLL_S, return_when="FIRST_COMPLETED")
            return [(future, future.result(timeout=self._patience_s)) for future in ended.done]
        except TimeoutError:
            self._check_alive()
            return []
        except KilledWorker as error:
            raise TeamError(f"{self.address}: the work kills its workers: {error}") from error
        except ImportError as error:
            raise TeamError(f"{self.address}: a worker that joined fails: {error}") from error
        except (CancelledError, OSError) as error:
            raise TeamError(self._lost()) from error

    def _lost(self) -> str:
        return f"{self.address}: the scheduler is lost; what was found is stored, run again"

    def _room(self, num_under_way: int) -> int:
        """Return how many orders more would keep the cluster busy; it is counted once a second."""
        if time.monotonic() - self._counted_s > 1.0:
            self._num_theirs, self._counted_s = self._count(), time.monotonic()
        return max(AHEAD * self._num_theirs, 1) - num_under_way

    def _count(self) -> int:
        try:
            return sum(self._client.nthreads().values())
        except OSError as error:
            raise TeamError(self._lost()) from error

    def _check_alive(self) -> None:
        """Wait for workers, with patience, where all are gone (TeamError)."""
        if self._client.status != "running":
            raise TeamError(self._lost())
        if self._count():
            self._alone_since_s = None
            return
        now_s = time.monotonic()
        if self._alone_since_s is None:
            self._alone_since_s = now_s
            log.warning("%s: no worker is left, waiting for one to join", self.address)
        if now_s - self._alone_since_s > self._patience_s:
            raise TeamError(
                f"{self.address}: no worker for {self._patience_s:g} s; "
                "what was found is stored, run again to go on"
            )
