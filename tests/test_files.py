"""Files are there whole or not at all, and whoever can't write is told why."""

import errno
import os
import stat
from pathlib import Path

import pytest

from groundfuse.tools import files
from groundfuse.tools.errors import DataError, TeamError
from groundfuse.tools.files import make_folder, read_text, write_atomic


def names(folder):
    return sorted(entry.name for entry in folder.iterdir())


def test_text_and_bytes_are_written_and_folders_made(tmp_path):
    path = tmp_path / "new folder" / "deep" / "ü.txt"
    write_atomic(path, "grün\n")
    assert path.read_bytes() == "grün\n".encode()
    write_atomic(path, b"\x00\xff")
    assert path.read_bytes() == b"\x00\xff"
    assert names(path.parent) == ["ü.txt"]


def test_a_written_file_has_the_usual_rights(tmp_path):
    (tmp_path / "usual").write_bytes(b"")
    write_atomic(tmp_path / "ours", b"")
    usual, ours = ((tmp_path / name).stat().st_mode for name in ("usual", "ours"))
    assert stat.S_IMODE(ours) == stat.S_IMODE(usual)


@pytest.mark.parametrize(
    ("number", "why"),
    [
        (errno.ENOSPC, "no space left on the disk"),
        (errno.EACCES, "no permission to write here"),
        (errno.EROFS, "this file system can only be read"),
        (errno.EDQUOT, "the disk quota is used up"),
        (errno.EIO, os.strerror(errno.EIO)),
    ],
)
def test_a_failed_write_leaves_the_old_file_and_no_other(tmp_path, monkeypatch, number, why):
    path = tmp_path / "map.png"
    write_atomic(path, "old")

    def full(_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(DataError, match=rf"^{path}: cannot write: {why}$"):
        write_atomic(path, "new")
    assert path.read_text() == "old"
    assert names(tmp_path) == ["map.png"]


def test_a_crash_while_writing_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "map.png"
    write_atomic(path, "old")

    def crash(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "replace", crash)
    with pytest.raises(KeyboardInterrupt):
        write_atomic(path, "new")
    assert path.read_text() == "old"
    assert names(tmp_path) == ["map.png"]


def test_files_and_folders_in_each_others_place(tmp_path):
    (tmp_path / "file").write_text("x")
    (tmp_path / "folder").mkdir()
    in_the_way = r": cannot write: a file stands where a folder is needed$"
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(DataError, match=rf"^{folder}{in_the_way}"):
            make_folder(folder)
        with pytest.raises(DataError, match=rf"^{folder}{in_the_way}"):
            write_atomic(folder / "a.txt", "x")
    with pytest.raises(TeamError, match=r"cannot write: a folder stands where the file should go$"):
        write_atomic(tmp_path / "folder", "x")
    assert names(tmp_path) == ["file", "folder"]


def test_text_is_read_with_or_without_a_byte_order_mark(tmp_path):
    path = tmp_path / "a.txt"
    path.write_bytes(b"\xef\xbb\xbfx")
    assert read_text(path) == "x"
    path.write_bytes(b"x\xff")
    with pytest.raises(DataError, match=rf"^{path}: not a text file in UTF-8 \(byte 1\)$"):
        read_text(path)
    with pytest.raises(DataError, match=r": cannot read: No such file or directory$"):
        read_text(tmp_path / "b.txt")
