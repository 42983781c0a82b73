"""Files that are there whole or not at all."""

import errno
import os
import secrets
from pathlib import Path

from groundfuse.tools.errors import DataError

HELP = {
    errno.EACCES: "no permission to write here",
    errno.EPERM: "no permission to write here",
    errno.EROFS: "this file system can only be read",
    errno.ENOSPC: "no space left on the disk",
    errno.EDQUOT: "the disk quota is used up",
    errno.ENOTDIR: "a file stands where a folder is needed",
    errno.EEXIST: "a file stands where a folder is needed",
    errno.EISDIR: "a folder stands where the file should go",
}
"""What a user can do something about, by error number."""


def refusal(path: Path, error: OSError) -> DataError:
    """Return the one line that says why `path` can't be written."""
    why = HELP.get(error.errno or 0, error.strerror or str(error))
    return DataError(f"{path}: cannot write: {why}")


def read_text(path: Path) -> str:
    """Return the text of a UTF-8 file, with or without a byte order mark.

    Raises:
        DataError: it can't be read, or isn't UTF-8.
    """
    try:
        return path.read_text("utf-8-sig")
    except OSError as error:
        raise DataError(f"{path}: cannot read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: not a text file in UTF-8 (byte {error.start})") from error


def make_folder(folder: Path) -> Path:
    """Return the folder, made with its parents where it was missing.

    Raises:
        DataError: it can't be made; the message says why.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise refusal(folder, error) from error
    return folder


def write_atomic(path: Path, data: bytes | str) -> None:
    """Write a file so that a reader, or a crash, sees the old content or the new, never a part.

    A temporary file in the same folder is filled, synced and renamed over `path`. The folder is
    made where it is missing. Text is written as UTF-8, line ends as they are.

    Raises:
        DataError: no permission, no space, or a file in the place of a folder.
    """
    content = data.encode() if isinstance(data, str) else data
    part = make_folder(path.parent) / f".{secrets.token_hex(8)}.part"
    try:
        with part.open("xb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        part.replace(path)
    except OSError as error:
        raise refusal(path, error) from error
    finally:
        part.unlink(missing_ok=True)
