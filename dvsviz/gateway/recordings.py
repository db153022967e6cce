"""The recordings that a run can be started on: those of certain folders, by a number that stands for the path.

A browser never names a path. It is shown what lies in the folders that the server was told of and is given a number
for each file; a number that is not known opens nothing.
"""

from __future__ import annotations

import hashlib
import logging
import threading
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dvsviz.errors import DvsvizError
from dvsviz.events.recording import Recording
from dvsviz.formats.open import open_recording
from dvsviz.session.recognise import is_session

_log = logging.getLogger(__name__)

_OWN = (".h5", ".hdf5", ".zip", ".npz", ".npy", ".txt", ".csv")
_SUFFIXES = frozenset((*_OWN, ".aedat", ".aedat4", ".raw", ".dat", ".bag", ".mcap", ".db3", ".mat", ".es"))
# Beside the events of a folder; never the events themselves.
_BESIDE = frozenset(("images.txt", "groundtruth.txt", "imu.txt", "calib.txt", "metadata.yaml"))
# Files that make a folder a recording.
_FOLDER_MARKS = ("events.txt", "events.npz", "metadata.yaml")
_DEPTH = 3
_MOST = 2000


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """A recording that is being read, or converted, which happens once.

    Attributes:
        share: how much of it was read, 0 to 1.
    """

    share: float


class Recordings:
    """What lies in the folders, looked up each time the list is asked for; opened by one worker.

    Args:
        folders: where recordings are looked for, some folders deep.
    """

    def __init__(self, folders: Sequence[Path]) -> None:
        self._folders = tuple(dict.fromkeys(folder.resolve() for folder in folders))
        self._known: dict[str, Path] = {}
        self._reading: dict[str, tuple[tuple[int, int], Future[Recording]]] = {}
        self._shares: dict[str, float] = {}
        self._lock = threading.Lock()
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="recordings")

    def list(self, others: Iterable[Path] = ()) -> list[dict[str, Any]]:
        """Return the recordings there are, by folder and name.

        Args:
            others: recordings that lie elsewhere: those of sessions that were opened.
        """
        found: dict[Path, Path] = {}
        for folder in self._folders:
            for path in _recordings_in(folder, _DEPTH):
                found.setdefault(path, folder)
                if len(found) >= _MOST:
                    break
        for path in others:
            if path.exists():
                found.setdefault(path.resolve(), path.resolve().parent)
        with self._lock:
            self._known = {_number(path): path for path in found}
        entries = [
            {
                "id": _number(path),
                "name": path.stem if path.is_file() else path.name,
                "file": path.name,
                "folder": str(Path(folder.name) / path.parent.relative_to(folder)),
                "bytes": _size(path),
            }
            for path, folder in found.items()
        ]
        return sorted(entries, key=lambda entry: (entry["folder"], entry["name"]))

    def path(self, number: str) -> Path:
        """Return where a recording lies.

        Raises:
            KeyError: no recording of the list has this number.
        """
        with self._lock:
            if number not in self._known:
                raise KeyError("there is no such recording; look at the list again")
            return self._known[number]

    def open(self, number: str) -> Recording | Reading:
        """Return a recording, or how far its reading is; ask again then.

        Raises:
            KeyError: no recording of the list has this number.
            DvsvizError: it cannot be opened.
        """
        path = self.path(number)
        state = _state(path)
        with self._lock:
            known = self._reading.get(number)
            if known is None or known[0] != state:
                known = self._reading[number] = (state, self._worker.submit(self._open, number, path))
        reading = known[1]
        if not reading.done():
            return Reading(share=self._shares.get(number, 0.0))
        if reading.exception() is not None:
            with self._lock:
                self._reading.pop(number, None)
        return reading.result()

    def close(self) -> None:
        """Stop the worker; a recording that is being read is read to its end first."""
        self._worker.shutdown(wait=False, cancel_futures=True)

    def _open(self, number: str, path: Path) -> Recording:
        def tell(share: float) -> None:
            self._shares[number] = share

        try:
            return open_recording(path, progress=tell)
        except OSError as error:
            raise DvsvizError(f"cannot be read: {error.strerror}", path=path) from error


def _recordings_in(folder: Path, depth: int) -> Iterator[Path]:
    """Yield the files and folders that look like recordings; hidden ones and sessions are left out."""
    try:
        children = sorted(folder.iterdir())
    except OSError as error:
        _log.info("not looked into: %s", error)
        return
    for child in children:
        if child.name.startswith(".") or child.is_symlink():
            continue  # a link may lead anywhere
        if child.is_dir():
            if any((child / mark).is_file() for mark in _FOLDER_MARKS):
                yield child
            elif depth > 0:
                yield from _recordings_in(child, depth - 1)
        elif child.suffix.lower() in _SUFFIXES and child.name not in _BESIDE and _holds_events(child):
            yield child


def _holds_events(path: Path) -> bool:
    """Return whether a file may hold events; whether it does is found out when it is opened."""
    if path.suffix.lower() not in (".txt", ".csv"):
        return not is_session(path)
    # A line of events has time, column, row and polarity; trajectories and the like have more, or fewer.
    try:
        with path.open("rb") as file:
            head = file.read(4096).replace(b",", b" ")
    except OSError:
        return False
    lines = [line.split() for line in head.splitlines() if line and line[:1] in b"0123456789"]
    return bool(lines) and len(lines[0]) == 4


def _number(path: Path) -> str:
    return hashlib.sha256(str(path).encode("utf-8", "surrogateescape")).hexdigest()[:16]


def _state(path: Path) -> tuple[int, int]:
    try:
        stat = path.stat()
    except OSError as error:
        raise DvsvizError(f"cannot be read: {error.strerror}", path=path, hint="is it still there?") from error
    return stat.st_mtime_ns, stat.st_size


def _size(path: Path) -> int:
    try:
        if path.is_file():
            return path.stat().st_size
        return sum(file.stat().st_size for file in path.iterdir() if file.is_file())
    except OSError:
        return 0
