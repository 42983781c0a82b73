"""Slices cover every item once, whatever the number of cores, and errors come out."""

import os
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

from groundfuse.backend.side_by_side import LEAST_ITEMS, side_by_side


@pytest.mark.parametrize("num_cores", [None, 1, 2, 7])
@pytest.mark.parametrize("count", [0, 1, LEAST_ITEMS - 1, LEAST_ITEMS, 3 * LEAST_ITEMS + 1])
def test_every_item_is_done_once(monkeypatch, num_cores, count):
    monkeypatch.setattr(os, "cpu_count", lambda: num_cores)
    done, slices = np.zeros(count, dtype=int), []

    def work(part):
        slices.append(part)
        done[part] += 1

    side_by_side(work, count)
    assert (done == 1).all()
    few = count < LEAST_ITEMS or num_cores in (None, 1)
    assert len(slices) == (1 if few else num_cores)


@pytest.mark.parametrize("number", [0, 1, 2])
def test_an_error_of_a_slice_is_the_callers_when_all_have_ended(monkeypatch, number):
    monkeypatch.setattr(os, "cpu_count", lambda: 3)
    ended = []

    def work(part):
        if part.start == number * LEAST_ITEMS:
            raise ValueError(f"slice {number}")
        time.sleep(0.05)
        ended.append(part)

    with pytest.raises(ValueError, match=rf"^slice {number}$"):
        side_by_side(work, 3 * LEAST_ITEMS)
    assert len(ended) == 2


def test_callers_in_several_threads_share_the_threads():
    done = np.zeros((8, 2 * LEAST_ITEMS), dtype=int)

    def call(row):
        def work(part):
            done[row, part] += 1

        side_by_side(work, done.shape[1])

    callers = [threading.Thread(target=call, args=(row,)) for row in range(len(done))]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert (done == 1).all()


FORK = """
import os
import signal
import sys
import time
from groundfuse.backend.side_by_side import LEAST_ITEMS, side_by_side

os.cpu_count = lambda: 3
done = []


def work(part):
    time.sleep(0.05)  # long enough for each slice to get a thread
    done.append(part)


side_by_side(work, LEAST_ITEMS)
time.sleep(0.05)  # and for each thread to wait for more
child = os.fork()
signal.alarm(15)  # whoever waits for ever ends
side_by_side(work, LEAST_ITEMS)
assert len(done) == 6
sys.exit(0 if child == 0 else os.waitpid(child, 0)[1])
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system knows no fork")
def test_a_forked_process_has_threads_of_its_own():
    """Those of its parent did not come with it, and it would wait for them for ever."""
    subprocess.run([sys.executable, "-W", "ignore", "-c", FORK], check=True, timeout=20)
