"""Independent parts of a loop on all cores: compiled code leaves the interpreter's lock alone."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

LEAST_ITEMS = 256
"""Fewer are done sooner than a thread begins."""


def side_by_side(
    work: Callable[[slice], object], count: int, least_items: int = LEAST_ITEMS
) -> None:
    """Do `work` for all of `count` items, in slices, a thread each; for few in this thread.

    The slices must not depend on each other; then neither does the result on how many there are.
    """
    num_threads = os.cpu_count() or 1
    if num_threads == 1 or count < least_items:
        work(slice(0, count))
        return
    bounds = [count * k // num_threads for k in range(num_threads + 1)]
    with ThreadPoolExecutor(num_threads) as threads:
        list(threads.map(work, map(slice, bounds[:-1], bounds[1:])))
