"""Opening session files that may be finished, growing, killed, cut off, foreign or hostile."""

from __future__ import annotations

import errno
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import SessionError
from dvsviz.session import schema
from dvsviz.session.commits import Commit, read_commit
from dvsviz.session.killed import ClosedView
from dvsviz.session.lock import has_writer

# A reader that meets the writer in the middle of a flush tries again: a flush takes about 10 ms.
_TRIES = 20
_PAUSE_S = 0.02
_SIGNATURE = b"\x89HDF\r\n\x1a\n"
# Not about the file that is read: a copy of it is being written inside the block.
_NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_READ_ERRORS = (OSError, KeyError, ValueError, TypeError, RuntimeError, OverflowError, IndexError)


@contextmanager
def open_file(path: Path) -> Iterator[h5py.File]:
    """Open a session file for reading; also while it is written and after its writer was killed.

    Whatever is wrong inside the block with the file's content is raised as one line.

    Raises:
        SessionError: not there, not a session, of a later version, cut off or damaged.
    """
    file = _open(path)
    try:
        with file:
            _check_format(file, path)
            yield file
    except _READ_ERRORS as error:
        if isinstance(error, OSError) and error.errno in _NO_SPACE:
            raise
        raise damaged(path, str(error)) from error


def damaged(path: Path, what: str) -> SessionError:
    """Return the error for a session file whose content is not what the format says."""
    return SessionError(f"is damaged: {' '.join(what.split())[:200]}", path=path, hint="track the recording again")


def read_committed(file: h5py.File, path: Path) -> Commit:
    """Return the latest commit, checked against the datasets' true sizes.

    Raises:
        SessionError: no commit is whole.
        KeyError, TypeError, ValueError: a dataset is missing, of another type or too short.
    """
    commit = read_commit(file)
    for _ in range(_TRIES):
        if commit is not None:
            break
        time.sleep(_PAUSE_S)
        schema.dataset(file, "commit").refresh()
        commit = read_commit(file)
    if commit is None:
        raise damaged(path, "no commit is whole")
    return commit


def read_column(file: h5py.File, table: schema.Table, name: str, start: int, end: int) -> NDArray:
    """Return rows `[start, end)` of one column."""
    column = next(c for c in table.columns if c.name == name)
    return _read(file, f"{table.name}/{name}", np.dtype(column.dtype), column.shape, start, end)


def read_table(file: h5py.File, table: schema.Table, start: int, end: int) -> dict[str, NDArray]:
    """Return rows `[start, end)` of every column of a table."""
    return {column.name: read_column(file, table, column.name, start, end) for column in table.columns}


def read_bytes(file: h5py.File, name: str, first: int, count: int) -> bytes:
    """Return `count` bytes of a flat dataset from byte `first`."""
    if first < 0 or count < 0:
        raise ValueError(f"{name}: expected bytes at 0 or later, got {first}, {count}")
    return read_flat(file, name, first, first + count).tobytes()


def read_flat(file: h5py.File, name: str, first: int, end: int) -> NDArray[np.uint8]:
    """Return bytes `[first, end)` of a flat dataset."""
    return _read(file, name, np.dtype(np.uint8), (), first, end)


def _read(file: h5py.File, place: str, dtype: np.dtype, shape: tuple[int, ...], start: int, end: int) -> NDArray:
    """Return rows of a dataset that is what the format says and holds what it claims to."""
    dataset = schema.dataset(file, place)
    if dataset.dtype != dtype or dataset.shape[1:] != shape:
        raise ValueError(f"{place}: expected rows of {dtype} {shape}")
    # Data of other files, and filters, are not part of the format: neither is followed.
    if dataset.external or dataset.is_virtual or dataset.id.get_create_plist().get_nfilters():
        raise ValueError(f"{place}: expected plain data inside this file")
    if end > dataset.shape[0] or end * dtype.itemsize * int(np.prod(shape)) > dataset.id.get_storage_size():
        raise ValueError(f"{place}: expected {end} rows, the file is cut off")
    return dataset[start:end]


def _open(path: Path) -> h5py.File:
    if not path.is_file():
        raise SessionError("no such session", path=path, hint="check the path; `dvsviz track` makes sessions")
    try:
        with path.open("rb") as head:
            if head.read(len(_SIGNATURE)) != _SIGNATURE:
                raise SessionError("not a session file", path=path, hint="expected an HDF5 file of `dvsviz track`")
    except OSError as error:
        raise SessionError(f"cannot be read: {error.strerror}", path=path, hint="check its permissions") from error
    failure = ""
    for _ in range(_TRIES):
        live = has_writer(path)
        try:
            return h5py.File(path, "r", swmr=True) if live else _open_unwritten(path)
        except (OSError, RuntimeError) as error:
            failure = str(error)
        # A damaged file does not get better by waiting; one that is half flushed, or was just closed, does.
        if not live and not has_writer(path) and "unable to lock" not in failure:
            break
        time.sleep(_PAUSE_S)
    raise SessionError(
        f"cannot be opened: {' '.join(failure.split())[:200]}", path=path, hint="track the recording again"
    )


def _open_unwritten(path: Path) -> h5py.File:
    try:
        return h5py.File(path, "r")
    except OSError as error:
        # The second is left by a writer that could not write its last bytes.
        if not any(words in str(error) for words in ("already open for write", "truncated file")):
            raise
    return h5py.File(ClosedView(path), "r")


def _check_format(file: h5py.File, path: Path) -> None:
    found = file.attrs.get("format")
    if not isinstance(found, str) or found != schema.FORMAT:
        raise SessionError(
            "not a session file",
            path=path,
            hint="expected a file of `dvsviz track`; recordings open with `dvsviz info`",
        )
    version = int(file.attrs.get("version", 0))
    if not 1 <= version <= schema.VERSION:
        raise SessionError(
            f"session version {version} is not known",
            path=path,
            hint=f"this dvsviz reads 1 to {schema.VERSION}; update it",
        )
