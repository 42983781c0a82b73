"""One run at a time on a store: the operating system's lock, which ends with its process."""

import fcntl
import os
import socket
from pathlib import Path

from groundfuse.tools.errors import DataError
from groundfuse.tools.files import make_folder, refusal


class Lock:
    """Held from its making until `release`, or until the process ends in whatever way.

    Raises:
        DataError: another process holds it (the message says which), or the file can't be made.
    """

    def __init__(self, path: Path) -> None:
        make_folder(path.parent)
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        except OSError as error:
            raise refusal(path, error) from error
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = os.pread(self._file, 300, 0).decode(errors="replace").strip()
            os.close(self._file)
            who = holder or "another process"
            raise DataError(f"{path.with_suffix('')}: store is held by {who}") from error
        except OSError as error:
            os.close(self._file)
            raise refusal(path, error) from error
        os.ftruncate(self._file, 0)
        os.pwrite(self._file, f"process {os.getpid()} on {socket.gethostname()}\n".encode(), 0)

    def release(self) -> None:
        """Let others have it; the file stays, so that nobody locks one that is gone."""
        os.ftruncate(self._file, 0)
        os.close(self._file)
