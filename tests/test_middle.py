"""The quick median against numpy's."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from groundfuse.frontend.middle import middle


@given(st.integers(1, 40), st.integers(0, 999))
def test_it_is_the_median_and_of_two_the_higher(count, seed):
    values = np.random.default_rng(seed).integers(0, 20, (3, count)).astype(float)
    wanted = np.quantile(values, 0.5, axis=-1, method="higher")
    np.testing.assert_array_equal(middle(values), wanted)
    assert middle(values[0]) == wanted[0]
