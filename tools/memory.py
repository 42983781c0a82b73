"""Memory that the process has freed: kept while a stage lasts, given back to the system after it.

The C library asks the system for each larger piece and gives it back when it is freed. Pages come
empty, one fault each, and threads wait for each other meanwhile: every pair and picture needs some
megabytes in passing, and 400 pictures took 0.8 to 1.0 million faults, 2 to 3 of the processor's 47
seconds. So what is freed is kept. The library also keeps what is freed between other pieces: 2000
pictures take a quarter less memory where that goes back after each stage.
"""

import ctypes
import functools
from collections.abc import Callable
from typing import Any

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Numbers of glibc's malloc.h."""
LARGE_BYTES = 32 * 2**20
"""Pieces from here on go back at once; the most that glibc allows."""
FREE_BYTES = 256 * 2**20
"""More than this, free at the end of the heap, goes back at once."""


def keep_freed() -> bool:
    """Keep what is freed from now on; return whether this C library can (glibc's mallopt)."""
    mallopt = _of_library("mallopt")
    if mallopt is None:
        return False
    settings = ((M_MMAP_THRESHOLD, LARGE_BYTES), (M_TRIM_THRESHOLD, FREE_BYTES))
    done = [mallopt(name, value) for name, value in settings]
    return done == [1, 1]


def give_back() -> bool:
    """Give back what is free; return whether this C library can (glibc's malloc_trim)."""
    trim = _of_library("malloc_trim")
    if trim is None:
        return False
    trim(0)
    return True


@functools.cache
def _of_library(name: str) -> Callable[..., Any] | None:
    try:
        found: Callable[..., Any] = getattr(ctypes.CDLL(None), name)
    except (OSError, AttributeError, TypeError):  # another library, or none that can be asked
        return None
    return found
