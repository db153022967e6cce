"""Who writes a session: a lock on the file that ends with the process that holds it, however it ends.

Linux's locks of an open file (F_OFD_SETLK) fit: other than `flock` they do not meet HDF5's own, and other than
POSIX locks they are not lost when a reader of the same process closes the file. Where they are missing there is no
lock, and a session counts as being written while its file was changed within the last seconds.
"""

from __future__ import annotations

import os
import struct
import time
from pathlib import Path

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None

# A byte far behind any file's end: the lock is about the file, not about its bytes.
_BYTE = 1 << 61
_FLOCK = "hhqqi4x"
_SETLK = getattr(fcntl, "F_OFD_SETLK", None)
_GETLK = getattr(fcntl, "F_OFD_GETLK", None)
_RECENT_S = 2.0


class WriterLock:
    """The right to write one session file, held until `release`."""

    def __init__(self, path: Path) -> None:
        """Take the lock.

        Raises:
            BlockingIOError: another writer holds it.
        """
        self._descriptor = os.open(path, os.O_RDWR)
        if fcntl is None or _SETLK is None:
            return
        try:
            fcntl.fcntl(self._descriptor, _SETLK, struct.pack(_FLOCK, fcntl.F_WRLCK, os.SEEK_SET, _BYTE, 1, 0))
        except OSError as error:
            os.close(self._descriptor)
            raise BlockingIOError(str(error)) from error

    def holds(self, path: Path) -> bool:
        """Return whether `path` still names the locked file."""
        try:
            return os.path.samestat(os.fstat(self._descriptor), path.stat())
        except FileNotFoundError:
            return False

    def release(self) -> None:
        """Give the lock back; a second call does nothing."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


def has_writer(path: Path) -> bool:
    """Return whether a process is writing the session file; False where there is no file."""
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except OSError:
        return False
    try:
        if fcntl is None or _GETLK is None:
            return time.time() - os.fstat(descriptor).st_mtime < _RECENT_S
        asked = struct.pack(_FLOCK, fcntl.F_WRLCK, os.SEEK_SET, _BYTE, 1, 0)
        answer = struct.unpack(_FLOCK, fcntl.fcntl(descriptor, _GETLK, asked))
        return answer[0] != fcntl.F_UNLCK
    finally:
        os.close(descriptor)
