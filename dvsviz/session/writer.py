"""The one writer of a session: appends while the run goes on, readable by others all the time, safe to kill."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import SessionError
from dvsviz.geometry.trajectory import Trajectory
from dvsviz.session import batch as rows
from dvsviz.session import schema
from dvsviz.session.batch import Batch
from dvsviz.session.commits import Commit, write_commit
from dvsviz.session.header import SessionHeader, write_header
from dvsviz.session.lock import WriterLock, has_writer
from dvsviz.session.reading import open_file, read_column, read_committed, read_table
from dvsviz.session.rebuild import copy_header, copy_rows, create_file, cut, partial_name
from dvsviz.session.records import LogEntry, TrackerUpdates, WindowResult

# What is not on disk is lost by a kill: at most this much time, plus that of one flush (about 10 ms).
FLUSH_SECONDS = 0.25


class SessionWriter:
    """Appends to one session file; every method may be called from any thread.

    Calls only queue; a thread of the writer's own encodes and writes every quarter of a second, so that the tracker
    never waits for the disk. An error of that thread is raised by the next call.
    """

    def __init__(self, path: Path, file: h5py.File, lock: WriterLock, commit: Commit) -> None:
        """Take over a file made by `create` or `resume`: those are the ways to get a writer."""
        self.path = path
        self._file, self._lock, self._commit = file, lock, commit
        self._windows = commit.counts[schema.WINDOWS.name]
        self._bookmarks = commit.counts[schema.BOOKMARKS.name]
        self._has_truth = commit.counts[schema.GROUND_TRUTH.name] > 0
        self._poses = np.zeros((max(1024, self._windows), 4, 4))
        self._queue: list[Any] = []
        self._queue_lock, self._io_lock = threading.Lock(), threading.Lock()
        self._map_images: dict[bytes, tuple[int, int]] = {}
        self._failure: Exception | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="session-writer", daemon=True)
        self._thread.start()

    @classmethod
    def create(
        cls, path: Path, header: SessionHeader, *, force: bool = False, chunk_rows: int = schema.CHUNK_ROWS
    ) -> Self:
        """Return the writer of a new session; the file appears under its name at once, ready to be read.

        Args:
            path: where it is written.
            header: what is run.
            force: replace a session that is there.
            chunk_rows: rows of a chunk; small ones make small files of short sessions.

        Raises:
            SessionError: the file exists, is being written, or the folder cannot be written.
        """
        if has_writer(path):
            raise SessionError("is being written by another run", path=path, hint="choose another name with --out")
        if path.exists() and not force:
            raise SessionError(
                "already exists", path=path, hint="replace it with --force, or continue it with --resume"
            )
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise _unwritable(path, error) from error
        partial = partial_name(path)
        try:
            commit = Commit()
            file = create_file(partial, lambda f: write_header(f, header), commit, chunk_rows=chunk_rows)
            lock = WriterLock(partial)
            partial.replace(path)
        except OSError as error:
            partial.unlink(missing_ok=True)
            raise _unwritable(path, error) from error
        return cls(path, file, lock, commit)

    @classmethod
    def resume(cls, path: Path, *, windows: int | None = None) -> Self:
        """Return a writer that continues a session which was interrupted; what was readable in it is kept.

        Args:
            path: the session.
            windows: keep the first so many windows and what was added with them, as when a tracker continues from
                a checkpoint (its window + 1); None keeps everything.

        Raises:
            SessionError: no such session, it is complete, being written or cannot be read.
        """
        if has_writer(path):
            raise SessionError("is being written by another run", path=path, hint="stop that run first")

        def begin(source: h5py.File) -> tuple[dict[str, int], Callable[[h5py.File], None]]:
            found = read_committed(source, path)
            if found.complete:
                raise SessionError(
                    "is complete, there is nothing to resume", path=path, hint="run it again with --force"
                )
            return cut(source, found, windows), copy_header(source)

        return cls._continued(path, path, begin)

    @classmethod
    def branch(cls, source: Path, path: Path, header: SessionHeader, *, windows: int) -> Self:
        """Return the writer of a new session that begins with the first windows of another one.

        What was stored with these windows is copied; bookmarks and tags are not: they belong to the other session.

        Args:
            source: the session that is copied from; it may be growing.
            path: the new session.
            header: of the new session.
            windows: how many are copied.

        Raises:
            SessionError: the new session exists, or one of the two cannot be read or written.
        """
        if path.exists():
            raise SessionError("already exists", path=path, hint="choose another name")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise _unwritable(path, error) from error

        def begin(before: h5py.File) -> tuple[dict[str, int], Callable[[h5py.File], None]]:
            counts = cut(before, read_committed(before, source), windows)
            counts |= dict.fromkeys((schema.BOOKMARKS.name, schema.TAGS.name, schema.SUMMARIES.name), 0)
            return counts, lambda file: write_header(file, header)

        return cls._continued(source, path, begin)

    @classmethod
    def _continued(
        cls,
        source: Path,
        path: Path,
        begin: Callable[[h5py.File], tuple[dict[str, int], Callable[[h5py.File], None]]],
    ) -> Self:
        """Return the writer of a file that begins with rows of another one.

        Args:
            source: the file that is copied from; it may be the one that is replaced.
            path: the file that is written.
            begin: given the source, returns how many rows of each table are copied, and what fills the head.

        Raises:
            SessionError: one of the two cannot be read or written.
        """
        partial = partial_name(path)
        try:
            with open_file(source) as before:
                counts, fill = begin(before)
                file = create_file(partial, fill, Commit())
                copy_rows(before, file, counts)
                poses = _current_poses(before, counts)
            commit = Commit(sequence=1, counts=counts)
            write_commit(file, commit)
            lock = WriterLock(partial)
            partial.replace(path)
        except OSError as error:
            partial.unlink(missing_ok=True)
            raise _unwritable(path, error) from error
        writer = cls(path, file, lock, commit)
        writer._poses = poses
        return writer

    @property
    def window_count(self) -> int:
        """Windows appended so far."""
        return self._windows

    def append(self, result: WindowResult, updates: TrackerUpdates | None = None) -> None:
        """Append one window, and in the same commit what was made with it.

        Raises:
            ValueError: it is not the next window.
            SessionError: the session cannot be written.
        """
        with self._queue_lock:
            if result.window != self._windows:
                raise ValueError(f"window: expected {self._windows}, got {result.window}")
            self._put(result)
            self._windows += 1
            if updates is not None:
                self._put_updates(updates)

    def add(self, updates: TrackerUpdates) -> None:
        """Append keyframes, map revisions, refined poses, failures and log lines, after the windows so far.

        Raises:
            ValueError: a refined pose has no window yet.
            SessionError: the session cannot be written.
        """
        with self._queue_lock:
            self._put_updates(updates)

    def _put_updates(self, updates: TrackerUpdates) -> None:
        for refined in updates.refined:
            windows = refined.windows
            if len(windows) and not 0 <= windows.min() <= windows.max() < self._windows:
                raise ValueError(
                    f"refined.windows: expected 0 to {self._windows - 1}, got {windows.min()} to {windows.max()}"
                )
        self._put((self._windows, updates))

    def note(self, entry: LogEntry) -> None:
        """Append one line to the log."""
        self.add(TrackerUpdates(log=(entry,)))

    def checkpoint(self, window: int, state: Mapping[str, NDArray]) -> None:
        """Append the tracker's state after a window."""
        with self._queue_lock:
            after = self._windows
            self._put(lambda batch: rows.add_checkpoint(batch, window, state, after))

    def set_ground_truth(self, trajectory: Trajectory) -> None:
        """Store the true trajectory, once, in its own world.

        Raises:
            ValueError: it is there already.
        """
        with self._queue_lock:
            if self._has_truth:
                raise ValueError("ground truth: expected none yet")
            self._has_truth = True

            def store(batch: Batch) -> None:
                for t, T in zip(trajectory.t_us.tolist(), trajectory.Ts_world_camera, strict=True):
                    batch.row(schema.GROUND_TRUTH, t, T)

            self._put(store)

    def add_bookmark(self, window: int, text: str) -> int:
        """Append a bookmark and return its number."""
        with self._queue_lock:
            bookmark, self._bookmarks = self._bookmarks, self._bookmarks + 1
            self._put(lambda batch: batch.row(schema.BOOKMARKS, bookmark, 0, window, *batch.text(text)))
        return bookmark

    def delete_bookmark(self, bookmark: int) -> None:
        """Delete a bookmark by its number."""
        with self._queue_lock:
            self._bookmarks += 1
            self._put(lambda batch: batch.row(schema.BOOKMARKS, bookmark, 1, 0, *batch.text("")))

    def set_tags(self, tags: tuple[str, ...]) -> None:
        """Replace the session's tags."""
        with self._queue_lock:
            self._put(lambda batch: batch.row(schema.TAGS, *batch.text(json.dumps(list(tags)))))

    def flush(self) -> None:
        """Write everything appended so far: afterwards every reader sees it and no kill loses it.

        Raises:
            SessionError: the session cannot be written.
        """
        with self._io_lock:
            self._write_queue()
        self._raise_failure()

    def close(self, summary: Mapping[str, Any] | None = None) -> None:
        """Mark the session complete and close it.

        Args:
            summary: what the run found, as JSON: the object of `dvsviz track --json`.

        Raises:
            SessionError: the session cannot be written.
        """
        if summary is not None:
            text = json.dumps(summary)
            with self._queue_lock:
                after = self._windows
                self._put(lambda batch: batch.row(schema.SUMMARIES, after, *batch.text(text)))
        self._end(complete=True)

    def abandon(self) -> None:
        """Close the session as incomplete: it can be read and resumed."""
        self._end(complete=False)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._closing.is_set():
            self._end(complete=error is None)

    def _put(self, item: Any) -> None:
        self._raise_failure()
        if self._closing.is_set():
            raise SessionError("is closed", path=self.path)
        self._queue.append(item)

    def _raise_failure(self) -> None:
        if self._failure is not None:
            raise _unwritable(self.path, self._failure) from self._failure

    def _run(self) -> None:
        while not self._closing.wait(FLUSH_SECONDS):
            with self._io_lock:
                self._write_queue()

    def _write_queue(self, *, complete: bool = False) -> None:
        """Write what is queued as one commit; the caller holds `_io_lock`."""
        with self._queue_lock:
            items, self._queue = self._queue, []
        if self._failure is not None or not (items or complete):
            return
        batch = Batch(self._commit.counts)
        try:
            for item in items:
                self._store(batch, item)
            batch.append_to(self._file)
            self._commit = Commit(sequence=self._commit.sequence + 1, complete=complete, counts=batch.counts)
            write_commit(self._file, self._commit)
        except (OSError, RuntimeError, ValueError) as error:
            # Raised by the next call: a thread has nobody to raise it to.
            self._failure = error

    def _store(self, batch: Batch, item: Any) -> None:
        if isinstance(item, WindowResult):
            if item.window >= len(self._poses):
                self._poses = np.concatenate([self._poses, np.zeros_like(self._poses)])
            self._poses[item.window] = item.T_world_camera
            rows.add_result(batch, item)
        elif isinstance(item, tuple):
            after, updates = item
            rows.add_updates(batch, updates, after, self._map_images)
            for refined in updates.refined:
                rows.add_refined(batch, refined, after, self._poses)
        else:
            item(batch)

    def _end(self, *, complete: bool) -> None:
        if self._closing.is_set():
            return
        self._closing.set()
        self._thread.join()
        with self._io_lock:
            self._write_queue(complete=complete)
            try:
                self._file.close()
            except (OSError, RuntimeError) as error:
                self._failure = self._failure or error
            self._lock.release()
        self._raise_failure()


def _current_poses(source: h5py.File, counts: dict[str, int]) -> NDArray[np.float64]:
    windows = counts[schema.WINDOWS.name]
    poses = np.zeros((max(1024, windows), 4, 4))
    poses[:windows] = read_column(source, schema.WINDOWS, "T_world_camera", 0, windows)
    refined = read_table(source, schema.REFINED_POSES, 0, counts[schema.REFINED_POSES.name])
    # Later rows win: assignment with repeated indices keeps the last.
    poses[refined["window"]] = refined["T_world_camera"]
    return poses


def _unwritable(path: Path, error: Exception) -> SessionError:
    return SessionError(
        f"cannot be written: {' '.join(str(error).split())}", path=path, hint="check the folder and the free space"
    )
