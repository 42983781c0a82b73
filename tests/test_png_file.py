"""PNG files, read back by OpenCV: other code than what wrote them."""

import struct
import zlib

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from groundfuse.tools import png_file
from groundfuse.tools.errors import DataError


def read(data):
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)


@given(st.integers(1, 40), st.integers(1, 40), st.sampled_from([(), (3,), (4,)]), st.integers(0, 9))
def test_every_picture_comes_back_to_the_bit(rows, columns, channels, seed):
    picture = np.random.default_rng(seed).integers(0, 256, (rows, columns, *channels), np.uint8)
    assert np.array_equal(read(png_file.png_bytes(picture)), picture)


@pytest.mark.parametrize("channels", [(), (3,), (4,)])
def test_bands_follow_each_other_where_a_picture_has_several(channels, monkeypatch):
    picture = np.random.default_rng(1).integers(0, 256, (37, 50, *channels), np.uint8)
    for band_bytes in (1, 1000, png_file.BAND_BYTES):  # a row, some rows, all at once
        monkeypatch.setattr(png_file, "BAND_BYTES", band_bytes)
        assert np.array_equal(read(png_file.png_bytes(picture)), picture)


def test_every_check_sum_is_right_and_the_deflated_stream_whole():
    data = png_file.png_bytes(np.full((30, 20), 7, np.uint8))
    assert data[:8] == png_file.SIGNATURE
    chunks, at = [], 8
    while at < len(data):
        length, kind = struct.unpack(">I4s", data[at : at + 8])
        body = data[at + 8 : at + 8 + length]
        at += 12 + length
        assert data[at - 4 : at] == struct.pack(">I", zlib.crc32(kind + body))
        chunks.append((kind, body))
    kinds = [kind for kind, _ in chunks]
    assert kinds == [b"IHDR", *[b"IDAT"] * (len(chunks) - 2), b"IEND"]
    rows = zlib.decompress(b"".join(body for kind, body in chunks if kind == b"IDAT"))
    assert rows == bytes([png_file.SUB, 7, *[0] * 19]) * 30  # its own check sum is right, too


def test_what_is_even_takes_little_room():
    assert len(png_file.png_bytes(np.full((1000, 1000, 3), 90, np.uint8))) < 20_000


def test_a_file_in_the_place_of_the_folder_is_refused(tmp_path):
    picture = np.zeros((5, 7, 3), np.uint8)
    png_file.write_png(tmp_path / "new" / "x.png", picture)
    assert np.array_equal(read((tmp_path / "new" / "x.png").read_bytes()), picture)
    (tmp_path / "file").write_text("x")
    with pytest.raises(DataError, match="a file stands where a folder is needed"):
        png_file.write_png(tmp_path / "file" / "x.png", picture)
