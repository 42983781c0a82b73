"""Freed memory goes back to the system."""

import gc
from pathlib import Path

import numpy as np
import pytest

from groundfuse.tools import memory
from groundfuse.tools.memory import give_back
from groundfuse.tools.pipeline import Stopwatch

MEBIBYTE = 2**20
PAGE_BYTES = 4096


def held_bytes():
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE_BYTES


@pytest.fixture
def pieces():
    """Freed memory between what is held: 128 MiB in pieces too small to be mapped on their own."""
    if not give_back():
        pytest.skip("this C library has no malloc_trim")
    some = [np.ones(64 * 1024, np.uint8) for _ in range(2048)]
    kept = some[::256]
    del some
    gc.collect()
    return kept


def test_free_memory_between_what_is_held_goes_back(pieces):
    before = held_bytes()
    assert give_back()
    assert before - held_bytes() > 64 * MEBIBYTE
    assert all(piece.all() for piece in pieces)


@pytest.mark.parametrize(("seconds", "goes"), [(0.0, False), (60.0, True)])
def test_so_it_does_after_a_stage_that_took_long(pieces, seconds, goes, monkeypatch):
    now = iter([0.0, seconds])
    monkeypatch.setattr("time.perf_counter", lambda: next(now))
    before = held_bytes()
    with Stopwatch().stage("features"):
        pass
    assert (before - held_bytes() > 64 * MEBIBYTE) == goes
    assert len(pieces) == 8


def test_another_c_library_is_left_alone(monkeypatch):
    memory._trim.cache_clear()
    monkeypatch.setattr("ctypes.CDLL", lambda _: object())
    assert not give_back()
    memory._trim.cache_clear()
