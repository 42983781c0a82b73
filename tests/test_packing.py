"""Values become bytes and come back the same to the bit; nothing else comes out of bytes."""

import hashlib
import json
import math
import pickle
import struct
import zlib
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from groundfuse.backend.measurement import (
    Attitude,
    Correspondences,
    FrameId,
    Reason,
    Rejected,
    RelativePose,
    Se2,
)
from groundfuse.frontend.camera import Camera, Distortion, Intrinsics, Mount
from groundfuse.frontend.consensus import Gate
from groundfuse.tools import packing
from groundfuse.tools.packing import DamagedError, digest_of, is_whole, key_of, packed, unpacked

CAMERA = Camera(
    Intrinsics(640, 480, 500.0, 501.0, 320.1, 239.9, Distortion.EQUIDISTANT, (0.1, 0.0, -0.2, 0.0)),
    Mount(Attitude(0.5, 0.0, 0.55), Attitude(0.01, 0.01, 0.002), Se2(0.1, 0.0, 0.2)),
    10,
    470,
)
KINDS = ("<f8", "<f4", "<f2", "|u1", "<i8", "|b1")


def edge(seed=1):
    rng = np.random.default_rng(seed)
    points = Correspondences(*rng.normal(size=(2, 7, 2)), *rng.uniform(1, 2, size=(2, 7)))
    spread = np.diag([1e-6, 2e-6, 3e-6])
    return RelativePose(
        FrameId("A", 1), FrameId("B", 2), Se2(1.0, 2.0, 3.0), spread, 7, 0.25, points
    )


plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text() | st.binary(),
    lambda inner: st.lists(inner).map(tuple) | st.dictionaries(st.text(), inner),
    max_leaves=20,
)


@given(plain)
def test_plain_values_come_back(value):
    again = unpacked(packed(value))
    assert packed(again) == packed(value)
    assert repr(again) == repr(value)  # tells nan, -0.0 and True from their likes


@given(
    st.lists(st.integers(0, 4), max_size=3),
    st.sampled_from(KINDS),
    st.integers(0, 2**32 - 1),
    st.booleans(),
)
def test_arrays_come_back_to_the_bit(shape, kind, seed, turned):
    raw = np.random.default_rng(seed).bytes(math.prod(shape) * np.dtype(kind).itemsize)
    if kind == "|b1":
        raw = bytes(byte & 1 for byte in raw)
    array = np.frombuffer(raw, kind).reshape(shape)
    array = array.T if turned else array
    one, two = unpacked(packed((array, array[..., :1] if shape else array)))
    assert (one.dtype, one.shape, one.tobytes()) == (array.dtype, array.shape, array.tobytes())
    assert two.tobytes() == (array[..., :1] if shape else array).tobytes()
    assert one.flags.c_contiguous
    assert one.flags.writeable
    assert one.flags.owndata or one.base.flags.owndata


def test_our_own_values_come_back():
    gate = Gate(Se2(0.1, 0.2, 0.3), 0.05, 0.07)
    rejected = Rejected(FrameId("A", 1), FrameId("r1", 2), Reason.AMBIGUOUS, 0.9, 0.6)
    table = {FrameId("A", 0): Se2(1.0, 2.0, 3.0), FrameId("B", 0): Se2(0.0, 0.0, 0.0)}
    for value in (CAMERA, gate, rejected, table, Reason.PRIOR, None):
        again = unpacked(packed(value))
        assert again == value
        assert type(again) is type(value)
    again = unpacked(packed(edge()))
    assert packed(again) == packed(edge())
    assert (again.a, again.a_from_b, again.num_inliers) == (FrameId("A", 1), Se2(1.0, 2.0, 3.0), 7)
    np.testing.assert_array_equal(again.correspondences.rays_b, edge().correspondences.rays_b)


class Empty(NamedTuple):
    """A class of ours without parts (by the module it says it is of)."""


Empty.__module__ = "groundfuse.backend.measurement"


def test_many_of_a_class_lie_column_by_column_and_come_back_alike():
    frames = tuple(FrameId("AB"[k % 2], k) for k in range(9))
    turned = (Rejected(*frames[:2], Reason.PRIOR, 1.0, 2.0), Rejected(*frames[1:3], None, 3, 4.0))
    for value in (frames, turned, (turned, turned[:1]), dict.fromkeys(frames, turned), ((), ())):
        assert unpacked(packed(value)) == value
    many = packed(frames)
    assert many.count(b"FrameId") == 1
    edges = unpacked(packed(tuple(edge(seed) for seed in range(5))))
    assert [packed(again) for again in edges] == [packed(edge(seed)) for seed in range(5)]
    assert {type(again) for again in edges} == {RelativePose}
    nothing = (Empty(), Empty())  # no column tells how many
    assert key_of(nothing) != key_of((Empty(),))


def test_numbers_of_numpy_come_back_as_pythons():
    assert unpacked(packed((np.float64(0.1), np.int64(3), np.bool_(True)))) == (0.1, 3, True)  # noqa: FBT003


def test_every_byte_counts():
    """Any byte that is changed, and any cut, is found."""
    data = packed(edge())
    for k in range(0, len(data), 7):
        spoilt = bytearray(data)
        spoilt[k] ^= 1
        assert not is_whole(bytes(spoilt))
        with pytest.raises(DamagedError, match=r"^\d+ bytes with a wrong checksum$"):
            unpacked(bytes(spoilt))
    for cut in (data[:-1], data[:8], b"", data + b"x"):
        assert not is_whole(cut)
    for other in (None, 3, "text", pickle.dumps(edge())):
        assert not is_whole(other)


def sealed(outline):
    """Bytes with a right checksum around any outline."""
    text = json.dumps(outline).encode()
    body = struct.pack("<I", len(text)) + text
    return packing._checksum([body]) + body


@pytest.mark.parametrize(
    ("outline", "why"),
    [
        (["O", "tools.files:make_folder", "/x"], "tools.files:make_folder does not hold values"),
        (["O", "tools.store:Store"], "tools.store:Store does not hold values"),
        (["O", "nowhere:Thing"], "there is no nowhere:Thing"),
        (["O", "backend.measurement:Thing"], "there is no backend.measurement:Thing"),
        (["O", "backend.measurement:FrameId"], "missing 2 required positional arguments"),
        (["O", "backend.measurement:Se2", 1.0, 2.0], r"zip\(\) argument 2 is shorter"),
        (["O", "backend.measurement:Se2", 1.0, 2.0, 3.0, 4.0], r"zip\(\) argument 2 is longer"),
        (["A", "|O", [1], 0], r"arrays of \|O are not known"),
        (["A", "<f8", [9], 0], "buffer"),
        (["A", "<f8", [1], -8], "offset must be non-negative"),
        (["C", "backend.measurement:Se2", ["T", 1.0, 2.0], ["T", 1.0], ["T"]], "shorter"),
        (["C", "backend.measurement:FrameId", ["T", "A"]], "missing 1 required positional"),
        (["C", "tools.store:Store", ["T"]], "tools.store:Store does not hold values"),
        (["D", 1, 2, 3], "shorter"),
        (["X", 1], "there is no kind 'X'"),
    ],
)
def test_foreign_bytes_are_refused(outline, why):
    """No code runs but that of our own frozen values, whoever made the checksum."""
    with pytest.raises(DamagedError, match=why):
        unpacked(sealed(outline))


@dataclass
class Foreign:
    x: int = 0


@pytest.mark.parametrize("value", [Foreign(), object(), {1, 2}, range(3), print])
def test_what_is_not_ours_is_not_packed(value):
    with pytest.raises(TypeError, match=r"^a \w+ can't be packed$"):
        packed((1, value))


def test_keys_tell_values_apart():
    parts = [(1,), (1.0,), ("1",), (b"1",), (True,), (None,), ((1,),), (1, 1), ([],), ({},)]
    parts += [(0.0,), (-0.0,), (np.zeros(1),), (np.zeros(1, np.float32),), (np.zeros((1, 1)),)]
    parts += [("look", CAMERA), ("look", CAMERA.mount), (Reason.PRIOR,), (Se2(1.0, 2.0, 3.0),)]
    assert len({key_of(*these) for these in parts}) == len(parts)
    assert key_of("look", CAMERA) == key_of("look", unpacked(packed(CAMERA)))
    assert len(key_of()) == len(digest_of(b"")) == 20
    assert digest_of(b"a") != digest_of(b"b")


def test_keys_stay_as_they_are():
    """Else nothing would be found of what a store has."""
    found = key_of("look", (1, 2.5, None), np.arange(4.0), Se2(1.0, 2.0, 3.0))
    assert found.hex() == "f094c7dc0aa66a1e06d4d01b9850f6a710f6ac68"


def test_either_checksum_is_known_and_the_quick_one_is_written():
    body = packed(edge())[packing.CHECKSUM_BYTES :]
    assert packed(edge())[:8] == struct.pack("<II", zlib.crc32(body), len(body))
    digest = hashlib.blake2b(body, digest_size=8).digest()
    assert packed(unpacked(digest + body)) == packed(edge())
    assert not is_whole(digest + body[:-1] + bytes([body[-1] ^ 1]))
