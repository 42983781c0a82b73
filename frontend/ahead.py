"""Work in threads that never runs far ahead of what is taken."""

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


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
