"""Whole numbers in order, equal ones as they come."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from groundfuse.backend.ordering import stable_order


@given(arrays.arrays(np.int64, st.integers(0, 200), elements=st.integers(0, 20)))
def test_the_order_is_that_of_a_stable_sort(numbers):
    assert stable_order(numbers).tolist() == np.argsort(numbers, kind="stable").tolist()


@given(st.lists(st.integers(2**63 - 5, 2**63 - 1), min_size=2, max_size=30))
def test_so_it_is_for_numbers_too_large_to_be_made_distinct(numbers):
    found = stable_order(np.array(numbers, np.int64))
    assert found.tolist() == sorted(range(len(numbers)), key=lambda k: numbers[k])
