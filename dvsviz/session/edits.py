"""Changes to a session that is not being written: bookmarks, tags, its name, its end.

Each writes a new file and renames it over the old one: a kill leaves the one or the other, and readers of the old one
go on undisturbed. A session that is being written is changed by its writer only (`SessionWriter.add_bookmark`).
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

from dvsviz.errors import SessionError
from dvsviz.session import schema
from dvsviz.session.batch import Batch
from dvsviz.session.commits import Commit, write_commit
from dvsviz.session.lock import WriterLock
from dvsviz.session.reading import open_file, read_committed
from dvsviz.session.rebuild import copy_header, copy_rows, create_file, partial_name

# A name is a file's stem: no separators, nothing hidden, nothing that another system forbids.
_NAME = re.compile(r"[\w][\w .+=,@()-]{0,120}")


def add_bookmark(path: Path, window: int, text: str) -> int:
    """Store a bookmark and return its number.

    Raises:
        SessionError: the session is being written or cannot be; there is no such window.
    """
    number = -1

    def change(batch: Batch) -> None:
        nonlocal number
        windows = batch.counts[schema.WINDOWS.name]
        if not 0 <= window < windows:
            raise SessionError(f"there is no window {window}", path=path, hint=f"windows are 0 to {windows - 1}")
        number = batch.counts[schema.BOOKMARKS.name]
        batch.row(schema.BOOKMARKS, number, 0, window, *batch.text(text))

    _edit(path, change)
    return number


def delete_bookmark(path: Path, bookmark: int) -> None:
    """Delete a bookmark by its number; one that is not there is no error.

    Raises:
        SessionError: the session is being written or cannot be.
    """
    _edit(path, lambda batch: batch.row(schema.BOOKMARKS, bookmark, 1, 0, *batch.text("")))


def set_tags(path: Path, tags: tuple[str, ...]) -> None:
    """Replace a session's tags.

    Raises:
        SessionError: the session is being written or cannot be.
    """
    _edit(path, lambda batch: batch.row(schema.TAGS, *batch.text(json.dumps(list(tags)))))


def check_name(name: str) -> None:
    """Refuse what is not the name of a session's file.

    Raises:
        SessionError: it holds a separator, begins with a dot, is too long, or is no text at all.
    """
    if not _NAME.fullmatch(name) or name != name.strip():
        raise SessionError(
            f"{name[:130]!r} cannot be a session's name", hint="use letters, digits, . _ - and blanks"
        )


def delete(path: Path) -> None:
    """Delete a session's file; the recording it was made of is not touched.

    Raises:
        SessionError: it is not a session, is being written, or cannot be deleted.
    """
    lock = _lock(path)
    try:
        # Whatever else lies there is not deleted, above all no recording.
        with open_file(path):
            pass
        path.unlink()
    except OSError as error:
        raise SessionError(f"cannot be deleted: {error.strerror}", path=path, hint="check the folder") from error
    finally:
        lock.release()


def rename(path: Path, name: str, *, folder: Path | None = None) -> Path:
    """Give a session another name, its file's stem, and return its new path.

    Args:
        path: the session.
        name: its new name.
        folder: where it is moved to, on the same disk; it stays where it is unless said.

    Raises:
        SessionError: the name is not a file name or taken, the session is being written or not there.
    """
    check_name(name)
    target = (folder or path.parent) / (name + path.suffix)
    lock = _lock(path)
    try:
        if target.exists():
            raise SessionError("already exists", path=target, hint="choose another name")
        path.rename(target)
    except OSError as error:
        raise SessionError(f"cannot be renamed: {error.strerror}", path=path, hint="check the folder") from error
    finally:
        lock.release()
    return target


def _lock(path: Path) -> WriterLock:
    try:
        lock = WriterLock(path)
    except BlockingIOError as error:
        raise SessionError("is being written", path=path, hint="wait until the run has ended") from error
    except OSError as error:
        raise SessionError(f"cannot be written: {error.strerror}", path=path, hint="check the path") from error
    if not lock.holds(path):
        lock.release()
        raise SessionError("was replaced at this moment", path=path, hint="try again")
    return lock


def _edit(path: Path, change: Callable[[Batch], None]) -> None:
    lock = _lock(path)
    partial = partial_name(path)
    try:
        with open_file(path) as source:
            found = read_committed(source, path)
            chunk_rows = (schema.dataset(source, "windows/start_us").chunks or (schema.CHUNK_ROWS,))[0]
            file = create_file(partial, copy_header(source), Commit(), chunk_rows=chunk_rows)
            with file:
                copy_rows(source, file, found.counts)
                batch = Batch(found.counts)
                change(batch)
                batch.append_to(file)
                write_commit(file, Commit(sequence=1, complete=found.complete, counts=batch.counts))
        partial.replace(path)
    except OSError as error:
        raise SessionError(
            f"cannot be written: {' '.join(str(error).split())}",
            path=path,
            hint="check the folder and the free space",
        ) from error
    finally:
        partial.unlink(missing_ok=True)
        lock.release()
