"""The nearest columns are those of a stable sort."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from groundfuse.frontend.nearest_compiled import fewest_apart, most_similar


@given(st.integers(0, 2**16), st.integers(1, 8), st.booleans())
def test_the_most_similar_are_those_of_a_stable_sort(seed, count, tied):
    rng = np.random.default_rng(seed)
    shape = int(rng.integers(1, 6)), int(rng.integers(count, 40))
    similarity = rng.integers(-3, 3, shape) if tied else rng.standard_normal(shape)
    columns = np.empty((shape[0], count), dtype=np.int64)
    most_similar(similarity.astype(np.float32), columns)
    wanted = np.argsort(-similarity.astype(np.float32), axis=1, kind="stable")[:, :count]
    np.testing.assert_array_equal(columns, wanted)


@given(st.integers(0, 2**16), st.integers(1, 8), st.integers(1, 4), st.booleans())
def test_the_fewest_bits_apart_are_those_of_a_stable_sort(seed, count, num_words, tied):
    rng = np.random.default_rng(seed)
    shapes = [(n, 8 * num_words) for n in (int(rng.integers(1, 6)), int(rng.integers(count, 40)))]
    a, b = (rng.integers(254 if tied else 0, 256, shape, dtype=np.uint8) for shape in shapes)
    columns = np.empty((len(a), count), dtype=np.int64)
    fewest_apart(a.view(np.uint64), np.ascontiguousarray(b.view(np.uint64).T), columns)
    apart = np.unpackbits(a[:, None] ^ b[None], axis=2).sum(axis=2)
    wanted = np.argsort(apart, axis=1, kind="stable")[:, :count]
    np.testing.assert_array_equal(columns, wanted)


def test_what_has_no_order_is_still_a_column():
    columns = np.full((2, 3), -1, dtype=np.int64)
    most_similar(np.full((2, 5), np.nan, dtype=np.float32), columns)
    np.testing.assert_array_equal(columns, [[0, 1, 2], [0, 1, 2]])
