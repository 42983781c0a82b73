"""Read pictures: a quick look at size and completeness, and the whole picture as BGR uint8.

The quick look reads only the head and the tail of a file. It finds files that were cut short, which
OpenCV would fill with grey without a word, but not bytes that were damaged in the middle. Paths may
hold any characters: the bytes are read here, `cv2.imread` never sees a name.
"""

import io
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np

from groundfuse.frontend.arrays import Image
from groundfuse.tools.errors import DataError
from groundfuse.tools.tiff_head import tiff_size

SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff"})
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
PNG_END = b"IEND\xaeB`\x82"
JPEG_END = b"\xff\xd9"
TAIL_BYTES = 65536
JPEG_ALONE = frozenset({0x01, *range(0xD0, 0xD8)})
JPEG_SIZES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
JPEG_SCAN = 0xDA
FULL_16_BIT = 65535.0


def image_size(path: Path) -> tuple[int, int]:
    """Return (width, height) in pixels from the head of a picture, without decoding it.

    Raises:
        DataError: not a readable JPEG, PNG or TIFF, or cut short.
    """
    try:
        with path.open("rb") as stream, _told(path):
            return _size(stream, path.stat().st_size)
    except OSError as error:
        raise DataError(f"{path}: cannot read: {error.strerror}") from error


@contextmanager
def _told(path: Path) -> Iterator[None]:
    try:
        yield
    except (ValueError, struct.error) as error:
        why = "the head is cut short" if isinstance(error, struct.error) else error
        raise DataError(f"{path}: not a whole picture: {why}") from error


def read_bytes(path: Path) -> bytes:
    """Return a file's bytes (DataError: unreadable)."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: cannot read: {error.strerror}") from error


def decoded_image(data: bytes, path: Path) -> Image:
    """Return the picture in a file's bytes as (rows, columns, 3) BGR uint8, as the sensor saw it.

    Grey is repeated, alpha dropped, 16 bits scaled to 8 over the full range (0..65535). A rotation
    in the EXIF data is not carried out: intrinsics belong to the sensor.

    Args:
        data: content of the file.
        path: its name, for messages.

    Raises:
        DataError: cut short, or neither 8 nor 16 bits a channel.
    """
    with _told(path):
        _size(io.BytesIO(data), len(data))
    decoded = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if decoded is None:
        raise DataError(f"{path}: not a whole picture: it can't be decoded")
    picture = np.asarray(decoded)
    if picture.dtype == np.uint16:
        picture = np.rint(picture * (255.0 / FULL_16_BIT)).astype(np.uint8)
    if picture.dtype != np.uint8:
        raise DataError(f"{path}: needs 8 or 16 bits a channel, got {picture.dtype}")
    return _bgr(picture.astype(np.uint8, copy=False))


def _bgr(picture: Image) -> Image:
    """Repeat grey, drop alpha."""
    if picture.ndim == 2 or picture.shape[2] <= 2:
        grey = picture.reshape(*picture.shape[:2], -1)[:, :, :1]
        return np.ascontiguousarray(np.repeat(grey, 3, axis=2))
    return np.ascontiguousarray(picture[:, :, :3])


def _size(stream: BinaryIO, num_bytes: int) -> tuple[int, int]:
    magic = stream.read(8)
    if not magic:
        raise ValueError("the file is empty")
    if magic == PNG_MAGIC:
        size = _png_size(stream)
        _need_end(stream, PNG_END, stream.tell(), num_bytes)
    elif magic[:3] == b"\xff\xd8\xff":
        size = _jpeg_size(stream)
        _need_end(stream, JPEG_END, stream.tell(), num_bytes)
    elif magic[:4] in {b"II*\0", b"MM\0*"}:
        size = tiff_size(stream, num_bytes)
    else:
        raise ValueError(f"it begins with {magic!r}, like no JPEG, PNG or TIFF")
    if min(size) < 1:
        raise ValueError(f"its head says {size[0]} x {size[1]} px")
    return size


def _png_size(stream: BinaryIO) -> tuple[int, int]:
    kind, width, height = struct.unpack(">4x4sII", stream.read(16))
    if kind != b"IHDR":
        raise ValueError(f"a PNG begins with IHDR, got {kind!r}")
    return width, height


def _jpeg_size(stream: BinaryIO) -> tuple[int, int]:
    """Walk the segments to the scan and leave the stream there; thumbnails lie before it."""
    stream.seek(2)
    size: tuple[int, int] | None = None
    while True:
        (lead, marker) = struct.unpack(">BB", stream.read(2))
        while lead == marker == 0xFF:  # fill bytes
            (marker,) = struct.unpack(">B", stream.read(1))
        if lead != 0xFF:
            raise ValueError("its segments are damaged")
        if marker in JPEG_ALONE:
            continue
        (length,) = struct.unpack(">H", stream.read(2))
        start = stream.tell()
        if marker in JPEG_SIZES:
            height, width = struct.unpack(">xHH", stream.read(5))
            size = (width, height)
        if marker == JPEG_SCAN:
            break
        stream.seek(start + length - 2)
    if size is None:
        raise ValueError("a scan comes before the size")
    return size


def _need_end(stream: BinaryIO, marker: bytes, start: int, num_bytes: int) -> None:
    """Look for the end mark in the tail, then, as some cameras append data, from `start` on."""
    for begin in (max(start, num_bytes - TAIL_BYTES), start):
        stream.seek(begin)
        if marker in stream.read():
            return
    raise ValueError(f"it is cut short after {num_bytes} bytes")
