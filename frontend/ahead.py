"""Work in threads that never runs far ahead of what is taken."""

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")
AHEAD = 4
"""Items begun per thread before the first is taken."""


def in_order(
    threads: ThreadPoolExecutor,
    work: Callable[[Item], Result],
    items: Iterable[Item],
    ahead: int,
) -> Generator[Result, None, None]:
    """Yield `work` of each item in their order, at most `ahead` of them begun and not yet taken."""
    left = iter(items)
    begun: deque[Future[Result]] = deque(threads.submit(work, item) for item in islice(left, ahead))
    try:
        while begun:
            yield begun.popleft().result()
            begun.extend(threads.submit(work, item) for item in islice(left, 1))
    finally:
        for future in begun:
            future.cancel()


def in_threads(
    work: Callable[[Item], Result], items: Iterable[Item], num_threads: int
) -> Generator[Result, None, None]:
    """Yield `work` of each item, in the order of the items, whatever the number of threads.

    Few items are begun ahead of what is taken, and none after the last that is.
    """
    if num_threads == 1:
        yield from map(work, items)
        return
    with ThreadPoolExecutor(num_threads) as pool:
        yield from in_order(pool, work, items, AHEAD * num_threads)
