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

from dvsviz.errors import DvsvizError
from dvsviz.view.figures import figures_csv, map_png
from dvsviz.view.shown import ShownSession

_log = logging.getLogger(__name__)

FORMATS = ("rrd", "tum", "csv", "png")
_KEPT = 20


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
        self._lock = threading.Lock()
        self._closed = False

    def start(self, shown: ShownSession, to: str, tell: Callable[[dict[str, Any]], None]) -> str:
        """Queue an export and return its number.

        Args:
            shown: the session.
            to: one of `FORMATS`.
            tell: called with `export` messages of the dashboard's protocol.
        """
        number = secrets.token_urlsafe(16)
        name = f"{shown.name}.{to}"
        message = {"type": "export", "id": number, "share": 0.0, "done": False, "name": name, "error": ""}

        def ended(job: Future[None]) -> None:
            """Say that it failed, whatever the reason: the page would wait for ever."""
            if job.cancelled() or (error := job.exception()) is None:
                return
            expected = isinstance(error, (DvsvizError, OSError))
            _log.warning("export of %s: %s", name, error, exc_info=None if expected else error)
            tell(message | {"error": str(error) if expected else f"the export failed: {error!r}"})

        self._worker.submit(self._make, number, shown, to, message, tell).add_done_callback(ended)
        return number

    def get(self, number: str) -> Export | None:
        """Return a finished export, or None."""
        with self._lock:
            return self._done.get(number)

    def close(self) -> None:
        """Stop and delete the files."""
        self._closed = True
        self._worker.shutdown(wait=True, cancel_futures=True)
        self._folder.cleanup()

    def _make(
        self,
        number: str,
        shown: ShownSession,
        to: str,
        message: dict[str, Any],
        tell: Callable[[dict[str, Any]], None],
    ) -> None:
        path = Path(self._folder.name) / f"{number}.{to}"
        tell(message)
        if to == "rrd":
            from dvsviz.export.rerun import export_rerun  # 0.4 s to import: not before somebody exports

            export_rerun(
                shown.session,
                path,
                recording=shown.recording,
                progress=lambda share: tell(message | {"share": float(share)}),
            )
        elif to == "tum":
            from dvsviz.export.tum import export_tum

            export_tum(shown.session, path)
        elif to == "csv":
            path.write_text(figures_csv(shown), encoding="utf-8")
        else:
            path.write_bytes(map_png(shown))
        with self._lock:
            self._done[number] = Export(path=path, name=message["name"])
            while len(self._done) > _KEPT:
                _, old = self._done.popitem(last=False)
                old.path.unlink(missing_ok=True)
        tell(message | {"share": 1.0, "done": True})
