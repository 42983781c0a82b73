"""Freed memory is kept for the next piece, and goes back to the system after a long stage."""

import gc
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from groundfuse.tools import memory
from groundfuse.tools.memory import give_back, keep_freed
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


FAULTS = """
import resource, sys
import numpy as np
from groundfuse.tools.memory import keep_freed
if sys.argv[1] == "kept" and not keep_freed():
    sys.exit(3)
np.ones(2**24, np.uint8)  # what the first piece of a size teaches the library by itself
begin = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    pieces = [np.ones(2**22, np.uint8), np.ones(2**22, np.uint8), np.ones(2**22, np.uint8)]
    del pieces
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - begin)
"""


def test_freed_memory_is_kept_for_the_next_piece():
    ran = {
        how: subprocess.run(  # settings of the whole process, so in one of its own
            [sys.executable, "-c", FAULTS, how], capture_output=True, text=True, check=False
        )
        for how in ("kept", "usual")
    }
    if ran["kept"].returncode == 3:
        pytest.skip("this C library has no mallopt")
    faults = {how: int(done.stdout) for how, done in ran.items()}
    once = 3 * 2**22 // PAGE_BYTES
    assert faults["kept"] < 2 * once
    assert faults["usual"] > 5 * faults["kept"]


def test_another_c_library_is_left_alone(monkeypatch):
    memory._of_library.cache_clear()
    monkeypatch.setattr("ctypes.CDLL", lambda _: object())
    assert not give_back()
    assert not keep_freed()
    memory._of_library.cache_clear()
