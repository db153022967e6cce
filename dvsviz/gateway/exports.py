"""Exports that the page asks for: made one after the other by one worker, fetched by a number nobody can guess."""

from __future__ import annotations

import logging
import secrets
import tempfile
import threading
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dvsviz.errors import DvsvizError, RunCancelled
from dvsviz.export.writers import Kind, Part, write
from dvsviz.view.shown import ShownSession

_log = logging.getLogger(__name__)

_KEPT = 20
_REMEMBERED = 100


@dataclass(frozen=True, slots=True, kw_only=True)
class Export:
    """A finished export.

    Attributes:
        path: the file.
        name: what it is called when it is saved.
    """

    path: Path
    name: str


class Exports:
    """Files on their way out; the last few are kept until the server stops."""

    def __init__(self) -> None:
        # A folder that only this user can read.
        self._folder = tempfile.TemporaryDirectory(prefix="dvsviz-export-")
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="export")
        self._done: OrderedDict[str, Export] = OrderedDict()
        self._stops: dict[str, threading.Event] = {}
        self._told: OrderedDict[str, dict[str, Any]] = OrderedDict()
        self._made_of: dict[str, tuple[Path, Kind, int]] = {}
        self._lock = threading.Lock()
        self._closed = False

    def start(
        self, shown: ShownSession, kind: Kind, tell: Callable[[dict[str, Any]], None], part: Part | None = None
    ) -> str:
        """Queue an export and return its number.

        Args:
            shown: the session.
            kind: what is written.
            tell: called with `export` messages of the dashboard's protocol.
            part: of a video, which part of the time.
        """
        number = secrets.token_urlsafe(16)
        if part in (None, Part()):
            self._made_of[number] = _made_of(shown, kind)
        tell = self._remembering(number, tell)
        name = f"{shown.name}{kind.ending}"
        message = {"type": "export", "id": number, "share": 0.0, "done": False, "name": name, "error": ""}
        stop = self._stops[number] = threading.Event()
        tell(message)

        def ended(job: Future[None]) -> None:
            """Say that it failed, whatever the reason: the page would wait for ever."""
            self._stops.pop(number, None)
            if job.cancelled() or (error := job.exception()) is None:
                return
            if isinstance(error, RunCancelled):
                tell(message | {"error": str(error)})
                return
            expected = isinstance(error, (DvsvizError, OSError))
            _log.warning("export of %s: %s", name, error, exc_info=None if expected else error)
            tell(message | {"error": str(error) if expected else f"the export failed: {error!r}"})

        def progress(share: float) -> None:
            if stop.is_set() or self._closed:
                raise RunCancelled("stopped")
            tell(message | {"share": float(share)})

        path = self.folder / f"{number}{kind.ending}"
        job = self._worker.submit(self._make, shown, kind, path, part, message, tell, progress)
        job.add_done_callback(ended)
        return number

    def stop(self, number: str) -> None:
        """Stop an export that waits or is being made; one that has ended stays.

        Raises:
            KeyError: there is no such export.
        """
        stop = self._stops.get(number)
        if stop is not None:
            stop.set()
        elif self.get(number) is None:
            raise KeyError("there is no such export; make it again")

    def told(self, number: str) -> dict[str, Any]:
        """Return the last `export` message of an export: how far it is, and why it failed.

        Raises:
            KeyError: there is no such export.
        """
        with self._lock:
            if number not in self._told:
                raise KeyError("there is no such export; make it again")
            return self._told[number]

    def same(self, shown: ShownSession, kind: Kind) -> str | None:
        """Return the number of a finished export of the whole session as it is now, or None."""
        wanted = _made_of(shown, kind)
        with self._lock:
            return next((n for n in reversed(self._done) if self._made_of.get(n) == wanted), None)

    def get(self, number: str) -> Export | None:
        """Return a finished export, or None."""
        with self._lock:
            return self._done.get(number)

    @property
    def folder(self) -> Path:
        """Where the files are until the server stops; only this user can read it."""
        return Path(self._folder.name)

    def close(self) -> None:
        """Stop and delete the files."""
        self._closed = True
        self._worker.shutdown(wait=True, cancel_futures=True)
        self._folder.cleanup()

    def _remembering(self, number: str, tell: Callable[[dict[str, Any]], None]) -> Callable[[dict[str, Any]], None]:
        def told(message: dict[str, Any]) -> None:
            with self._lock:
                self._told[number] = message
                while len(self._told) > _REMEMBERED:
                    self._told.popitem(last=False)
            tell(message)

        return told

    def _make(
        self,
        shown: ShownSession,
        kind: Kind,
        path: Path,
        part: Part | None,
        message: dict[str, Any],
        tell: Callable[[dict[str, Any]], None],
        progress: Callable[[float], None],
    ) -> None:
        progress(0.0)
        write(shown, kind, path, part, progress)
        with self._lock:
            self._done[message["id"]] = Export(path=path, name=message["name"])
            while len(self._done) > _KEPT:
                gone, old = self._done.popitem(last=False)
                self._made_of.pop(gone, None)
                old.path.unlink(missing_ok=True)
        tell(message | {"share": 1.0, "done": True})


def _made_of(shown: ShownSession, kind: Kind) -> tuple[Path, Kind, int]:
    """Return what an export of a whole session depends on: the file, and when it was last written (ns)."""
    return shown.session.path, kind, shown.session.path.stat().st_mtime_ns
