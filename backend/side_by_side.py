"""Independent parts of a loop on all cores: compiled code leaves the interpreter's lock alone."""

import functools
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
    Nor may the work come here again: it would wait for its own thread.
    """
    num_threads = os.cpu_count() or 1
    if num_threads == 1 or count < least_items:
        work(slice(0, count))
        return
    bounds = [count * k // num_threads for k in range(num_threads + 1)]
    parts = list(map(slice, bounds[:-1], bounds[1:]))
    others = [_threads(num_threads).submit(work, part) for part in parts[1:]]
    try:
        work(parts[0])
    finally:
        found = [other.exception() for other in others]  # all have ended, whatever happens
    for error in found:
        if error is not None:
            raise error


@functools.cache
def _threads(number: int) -> ThreadPoolExecutor:
    """Return threads that stay: a bundle's step needs them twenty times."""
    return ThreadPoolExecutor(number)


os.register_at_fork(after_in_child=_threads.cache_clear)
