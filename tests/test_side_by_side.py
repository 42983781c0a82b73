"""Slices cover every item once, whatever the number of cores, and errors come out."""

import os

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


def test_an_error_of_a_slice_is_the_callers():
    def work(part):
        if part.stop == 2 * LEAST_ITEMS:
            raise ValueError("the last slice")

    with pytest.raises(ValueError, match=r"^the last slice$"):
        side_by_side(work, 2 * LEAST_ITEMS)
