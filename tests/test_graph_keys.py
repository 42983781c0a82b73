"""Ids: gtsam's symbols, letters in text, offsets."""

import gtsam
import pytest
from hypothesis import given
from hypothesis import strategies as st

from groundfuse.backend.graph_keys import (
    LETTERS,
    MAX_INDEX,
    KeyKind,
    KeyScheme,
    key_of_symbol,
    letter_of_key,
    named_frame,
    parsed_scheme,
    robot_name,
    symbol_name,
)
from groundfuse.backend.graph_lines import parsed_id
from groundfuse.backend.measurement import FrameId

GTSAM = KeyScheme(KeyKind.GTSAM)
letters, indices = st.sampled_from(LETTERS), st.integers(0, MAX_INDEX)


@given(letters, indices)
def test_keys_are_gtsams(letter, index):
    key = key_of_symbol(letter, index)
    assert key == gtsam.Symbol(letter, index).key()
    assert named_frame(key, GTSAM) == named_frame(key, KeyScheme()) == FrameId(letter, index)


@given(letters, st.integers(0, 10**16))
def test_a_letter_and_a_number_is_a_key(letter, index):
    key = key_of_symbol(letter, index)
    assert parsed_id(f"{letter}{index}") == key
    assert parsed_id(symbol_name(key)) == key


@given(st.integers(0, 2**64 - 1))
def test_every_id_survives_its_name(key):
    assert parsed_id(symbol_name(key)) == parsed_id(str(key)) == key


def test_plain_ids_name_no_robot():
    assert named_frame(12, KeyScheme()) is None
    assert named_frame(12, KeyScheme(KeyKind.PLAIN)) is None
    assert named_frame(key_of_symbol("a", 1), KeyScheme(KeyKind.PLAIN)) is None
    assert letter_of_key(32 << 56) is None
    assert letter_of_key(1 << 56) is None
    with pytest.raises(ValueError, match=r"^id 12 has no robot's letter in its top byte$"):
        named_frame(12, GTSAM)


@given(st.integers(1, 10**6), st.integers(0, 200), st.integers(0, 10**6))
def test_offsets_divide(offset, robot, index):
    scheme = parsed_scheme(f"offset={offset}")
    if index < offset:
        frame = named_frame(robot * offset + index, scheme)
        assert frame == FrameId(robot_name(robot), index)


def test_schemes_are_read():
    assert [parsed_scheme(w).kind.value for w in ("auto", "gtsam", "plain")] == [
        *("auto", "gtsam", "plain")
    ]
    assert parsed_scheme("offset=1000").offset == 1000


@pytest.mark.parametrize("word", ["", "offset", "offset=", "offset=0", "offset=-1", "plain=1", "x"])
def test_other_schemes_are_refused(word):
    with pytest.raises(
        ValueError, match=r"keys are auto, gtsam, plain or offset=N .*, got " + word
    ):
        parsed_scheme(word)


@pytest.mark.parametrize(
    ("letter", "index", "message"),
    [
        ("AB", 0, "a symbol needs a single letter, got 'AB'"),
        ("", 0, "a symbol needs a single letter, got ''"),
        ("A", 2**56, "the index of a symbol must be below 2.56, got 72057594037927936"),
        ("A", -1, "the index of a symbol must be below 2.56, got -1"),
    ],
)
def test_what_is_no_symbol_is_refused(letter, index, message):
    with pytest.raises(ValueError, match=message):
        key_of_symbol(letter, index)


@pytest.mark.parametrize("word", ["-1", "1.0", "AB1", "A", "1A", "A-1", "\u0663", "x" * 5])
def test_what_is_no_id_is_refused(word):
    with pytest.raises(
        ValueError, match=r"^an id must be a whole number from 0, or like A12, got "
    ):
        parsed_id(word)


@pytest.mark.parametrize("word", [str(2**64), "9" * 30, "9" * 5000])
def test_ids_above_64_bits_are_refused(word):
    with pytest.raises(ValueError, match=r"^an id must be below 2.64, got 99|1844"):
        parsed_id(word)


def test_names_of_robots_are_distinct():
    names = [robot_name(k) for k in range(120)]
    assert len(set(names)) == 120
    assert (names[0], names[25], names[26]) == ("A", "Z", "R26")
