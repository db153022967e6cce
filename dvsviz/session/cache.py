"""What has been read of one session file: only rows that are new are read again."""

from __future__ import annotations

import threading
from contextlib import AbstractContextManager
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from dvsviz.session import schema
from dvsviz.session.commits import Commit
from dvsviz.session.growing import Growing
from dvsviz.session.header import SessionHeader, read_header
from dvsviz.session.reading import open_file, read_bytes, read_column, read_committed, read_flat


class SessionCache:
    """The committed rows of a session file, as of the last `refresh`.

    The file is open only while something is read: it may grow, be replaced or be edited meanwhile, and hundreds of
    sessions cost no file descriptors.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.lock = threading.RLock()
        self._clear()
        self.refresh()

    def _clear(self) -> None:
        self.header: SessionHeader | None = None
        self.commit = Commit()
        self.generation = getattr(self, "generation", -1) + 1
        self._file_id = ""
        self._stamp: tuple[int, int, int] | None = None
        self._columns = {
            table.name: {c.name: Growing(c.shape, c.dtype) for c in table.columns} for table in schema.TABLES
        }
        self._text = Growing((), np.uint8)

    def refresh(self) -> None:
        """Look for a newer commit; forget everything where the file was replaced by another.

        Raises:
            SessionError: the file is gone or damaged.
        """
        with self.lock:
            # Before opening: where the file is replaced in between, the next refresh sees it.
            stamp = self._stamp_of_file()
            if self.commit.complete and stamp is not None and stamp == self._stamp:
                return
            with open_file(self.path) as file:
                self._read_commit(file)
                self._stamp = stamp

    def _stamp_of_file(self) -> tuple[int, int, int] | None:
        try:
            found = self.path.stat()
        except OSError:
            return None
        return found.st_ino, found.st_mtime_ns, found.st_size

    def _read_commit(self, file: h5py.File) -> None:
        file_id = str(file.attrs["file_id"])
        if file_id != self._file_id:
            if self._file_id:
                self._clear()
            self.header = read_header(file)
            self._file_id = file_id
        self.commit = read_committed(file, self.path)

    def open(self) -> AbstractContextManager[h5py.File]:
        """Open the file for reading."""
        return open_file(self.path)

    def rows(self, table: schema.Table, names: tuple[str, ...] | None = None) -> dict[str, NDArray]:
        """Return columns of a table, all unless named, read-only."""
        names = tuple(column.name for column in table.columns) if names is None else names
        with self.lock:
            count, columns = self.commit.counts[table.name], self._columns[table.name]
            if any(len(columns[name]) < count for name in names):
                with self.open() as file:
                    if str(file.attrs["file_id"]) != self._file_id:
                        # Replaced since the last refresh: everything is read anew, from one file.
                        self._read_commit(file)
                        count, columns = self.commit.counts[table.name], self._columns[table.name]
                    for name in names:
                        column = columns[name]
                        column.append(read_column(file, table, name, len(column), count))
            return {name: columns[name].view() for name in names}

    def texts(self, table: schema.Table) -> list[str]:
        """Return the text of every row of a table."""
        with self.lock:
            rows = self.rows(table, ("text_first", "text_count"))
            count = self.commit.counts["text"]
            if len(rows["text_first"]) == 0:
                return []
            if len(self._text) < count:
                with self.open() as file:
                    self._text.append(read_flat(file, "text", len(self._text), count))
            text = self._text.view()
            places = zip(rows["text_first"].tolist(), rows["text_count"].tolist(), strict=True)
            return [text[first : first + n].tobytes().decode("utf-8", "replace") for first, n in places]

    def bytes(self, name: str, first: int, count: int) -> bytes:
        """Return bytes of a flat dataset."""
        with self.open() as file:
            return read_bytes(file, name, first, count)
