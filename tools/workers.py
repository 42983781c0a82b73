"""Who does the work: threads of this process, and what stands in their place on a cluster."""

from collections.abc import Generator, Iterable, Sequence
from typing import Protocol

from groundfuse.frontend.ahead import Result, in_threads
from groundfuse.tools.frame_look import LookJob, look_done, picture_of
from groundfuse.tools.front_end_options import FrontEndOptions
from groundfuse.tools.pair_verdict import PairJob, pair_done
from groundfuse.tools.shelf import Shelf


class Progress(Protocol):
    """Passes items on while it shows how many of them are done."""

    def __call__(self, items: Iterable[Result], total: int, title: str) -> Iterable[Result]:
        """Return the items."""
        ...


def silent(items: Iterable[Result], total: int, title: str) -> Iterable[Result]:  # noqa: ARG001
    """Show no progress."""
    return items


class Workers(Protocol):
    """Carry out work orders; whoever does it, the bytes are the same."""

    @property
    def num_threads(self) -> int:
        """Threads of this process, for the work that is not given away."""
        ...

    def look(
        self, jobs: Sequence[LookJob], options: FrontEndOptions
    ) -> Generator[tuple[LookJob, bytes], None, None]:
        """Yield each order with what was found, packed, in any order, as it comes."""
        ...

    def compare(
        self, jobs: Sequence[PairJob], shelf: Shelf, options: FrontEndOptions
    ) -> Generator[tuple[PairJob, bytes], None, None]:
        """Yield each order with its verdict, packed, in any order, as it comes."""
        ...


class Threads:
    """Threads of this process: OpenCV and numpy let go of the interpreter's lock."""

    def __init__(self, num_threads: int) -> None:
        self.num_threads = num_threads

    def look(
        self, jobs: Sequence[LookJob], options: FrontEndOptions
    ) -> Generator[tuple[LookJob, bytes], None, None]:
        """Look at pictures."""
        return in_threads(
            lambda job: (job, look_done(picture_of(job), job, options)), jobs, self.num_threads
        )

    def compare(
        self, jobs: Sequence[PairJob], shelf: Shelf, options: FrontEndOptions
    ) -> Generator[tuple[PairJob, bytes], None, None]:
        """Compare pairs."""

        def done(job: PairJob) -> tuple[PairJob, bytes]:
            a, b = (shelf.looked(key) for key in job.looks)
            return job, pair_done(job, a, b, options)

        return in_threads(done, jobs, self.num_threads)
