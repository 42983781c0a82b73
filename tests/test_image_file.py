# ruff: noqa: E501 (messages stay whole)
"""Pictures come back as the sensor saw them, and none that was cut short goes unseen."""

import struct

import numpy as np
import pytest
from small_team import (
    HEIGHT,
    WIDTH,
    change,
    encoded,
    loaded,
    make_robot,
    picture,
    read,
    refusal,
    store,
)

from groundfuse.tools.errors import DataError
from groundfuse.tools.image_file import image_size
from groundfuse.tools.team_folder import load_image


@pytest.fixture
def robot(tmp_path):
    return make_robot(tmp_path / "team")


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_lossless_pictures_come_back_as_they_are(robot, suffix):
    assert np.array_equal(
        loaded(store(robot, f"x{suffix}", encoded(picture(5), suffix))), picture(5)
    )


def test_grey_16_bit_and_alpha_become_bgr(robot):
    bgr = picture(6)
    grey = bgr[:, :, 0]
    repeated = np.repeat(grey[:, :, None], 3, axis=2)
    assert np.array_equal(loaded(store(robot, "x.png", encoded(grey))), repeated)
    alpha = np.dstack([bgr, np.arange(WIDTH * HEIGHT, dtype=np.uint8).reshape(HEIGHT, WIDTH)])
    assert np.array_equal(loaded(store(robot, "x.png", encoded(alpha))), bgr)
    for suffix in (".png", ".tif"):
        # 257 = 65535 / 255; 128 more is just under half a step of 8 bits
        deep = encoded(
            np.minimum(bgr.astype(np.uint32) * 257 + 128, 65535).astype(np.uint16), suffix
        )
        assert np.array_equal(loaded(store(robot, f"x{suffix}", deep)), bgr)
        assert np.array_equal(
            loaded(store(robot, f"x{suffix}", encoded(grey.astype(np.uint16) * 257, suffix))),
            repeated,
        )


def test_float_pictures_are_refused(robot):
    store(robot, "x.tif", encoded(picture().astype(np.float32), ".tif"))
    with pytest.raises(DataError, match=r"x\.tif: needs 8 or 16 bits a channel, got float32$"):
        loaded(robot)


def test_exif_rotation_is_not_carried_out(robot):
    plain = encoded(picture(), ".jpg")
    exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"
    turned = plain[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + plain[2:]
    straight = loaded(store(robot, "x.jpg", plain))
    assert np.array_equal(loaded(store(robot, "x.jpg", turned)), straight)


def test_a_thumbnail_neither_hides_a_cut_nor_gives_the_size(robot):
    """A thumbnail is a whole JPEG, with a size and an end of its own, in front of the picture."""
    plain = encoded(picture(), ".jpg")
    small = encoded(picture()[:8, :8], ".jpg")
    segment = b"\xff\xe1" + (len(small) + 2).to_bytes(2, "big") + small
    whole = plain[:2] + segment + plain[2:]
    assert loaded(store(robot, "x.jpg", whole)).shape == (HEIGHT, WIDTH, 3)
    assert "cut short" in refusal(store(robot, "x.jpg", whole[:-300]))


def test_data_after_the_end_is_legal(robot):
    for suffix in (".jpg", ".png"):
        data = encoded(picture(), suffix) + bytes(100_000)
        assert loaded(store(robot, f"x{suffix}", data)).shape == (HEIGHT, WIDTH, 3)


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif"])
def test_no_cut_anywhere_goes_unseen(robot, suffix):
    """Every length shorter than the file is refused by the quick look, in one line."""
    data = encoded(picture(), suffix)
    path = robot / "images" / f"x{suffix}"
    for length in {*range(60), *range(60, len(data), 97), *range(len(data) - 20, len(data))}:
        path.write_bytes(data[:length])
        with pytest.raises(DataError, match=rf"x\{suffix}: not a whole picture: [^\n]+$"):
            image_size(path)
    path.write_bytes(data)
    assert image_size(path) == (WIDTH, HEIGHT)
    zeroed = data[: len(data) // 2] + bytes(len(data) - len(data) // 2)
    if suffix != ".tif":  # a TIFF says where its pixels are, not that they are there
        assert "cut short" in refusal(store(robot, f"x{suffix}", zeroed))


def tiff(order):
    """A TIFF with its directory first and its pixels last, as cameras write it."""
    strip = 8 + 2 + 12 * 9 + 4
    entries = [(256, 4, WIDTH), (257, 3, HEIGHT), (258, 3, 8), (259, 3, 1), (262, 3, 1)]
    entries += [(273, 4, strip), (277, 3, 1), (278, 3, HEIGHT), (279, 4, WIDTH * HEIGHT)]
    head = (b"II" if order == "<" else b"MM") + struct.pack(order + "HIH", 42, 8, len(entries))
    for tag, kind, value in entries:
        cell = struct.pack(order + ("HH" if kind == 3 else "I"), value, *[0] * (kind == 3))
        head += struct.pack(order + "HHI", tag, kind, 1) + cell
    return head + bytes(4) + picture()[:, :, 0].tobytes()


@pytest.mark.parametrize("order", ["<", ">"])
def test_a_tiff_with_its_pixels_last(robot, order):
    data = tiff(order)
    assert np.array_equal(loaded(store(robot, "x.tif", data))[:, :, 1], picture()[:, :, 0])
    for length in (*range(len(data) - WIDTH * HEIGHT + 1), len(data) - 500, len(data) - 1):
        (robot / "images" / "x.tif").write_bytes(data[:length])
        with pytest.raises(DataError, match=r"x\.tif: not a whole picture: "):
            image_size(robot / "images" / "x.tif")


def test_a_picture_whose_pixels_are_damaged_is_refused_when_loaded(robot):
    data = bytearray(encoded(picture()))
    middle = len(data) // 2
    data[middle : middle + 64] = bytes(64)
    store(robot, "x.png", bytes(data))
    with pytest.raises(DataError, match=r"x\.png: not a whole picture: it can't be decoded$"):
        loaded(robot)


def test_a_picture_that_changed_after_it_was_read_is_refused(robot):
    member = read(robot)
    path = member.frames[0].path
    path.write_bytes(encoded(picture()[:40]))
    with pytest.raises(DataError, match=r"is 64 x 40 px, its camera file is for 64 x 48$"):
        load_image(member.frames[0], member.camera)
    path.unlink()
    with pytest.raises(DataError, match=r"cannot read: No such file or directory$"):
        load_image(member.frames[0], member.camera)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "A/images/x.jpg: not a whole picture: the file is empty"),
        (b"GIF89a..", "A/images/x.jpg: not a whole picture: it begins with b'GIF89a..', like no JPEG, PNG or TIFF"),
        (b"\xff\xd8\xff\xe0", "A/images/x.jpg: not a whole picture: the head is cut short"),
        (b"\xff\xd8\xff\xe0\0\x02xxxx", "A/images/x.jpg: not a whole picture: its segments are damaged"),
        (b"\xff\xd8\xff\xda\0\x02\xff\xd9", "A/images/x.jpg: not a whole picture: a scan comes before the size"),
        (b"\x89PNG\r\n\x1a\n" + b"\0\0\0\x0dIDAT" + bytes(8), "A/images/x.jpg: not a whole picture: a PNG begins with IHDR, got b'IDAT'"),
        (b"\x89PNG\r\n\x1a\n" + b"\0\0\0\x0dIHDR" + bytes(8) + b"IEND\xaeB`\x82", "A/images/x.jpg: not a whole picture: its head says 0 x 0 px"),
        (b"II*\0\x08\0\0\0" + bytes(8), "A/images/x.jpg: not a whole picture: a TIFF without a size"),
    ],
)  # fmt: skip
def test_what_is_no_picture(robot, data, message):
    assert refusal(store(robot, "x.jpg", data)) == message


def test_a_folder_in_the_place_of_a_picture(robot):
    (robot / "images" / "img3.png").mkdir()
    assert refusal(robot) == "A/images/img3.png: cannot read: Is a directory"


def test_sizes(robot):
    big = robot / "images" / "img3.png"
    big.write_bytes(encoded(np.zeros((96, 128), np.uint8)))
    assert refusal(robot) == (
        "A/images: pictures of one camera need one size, "
        "found 3 of 64 x 48 (img1.png), 1 of 128 x 96 (img3.png)"
    )
    change(robot, "image_width: 64", "image_width: 128")
    big.unlink()
    assert refusal(robot) == "A/images/img1.png: is 64 x 48 px, camera.yaml is for 128 x 48"
