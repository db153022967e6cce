"""A recording that another process is still writing, as that of a stream: read while it grows."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path

import h5py
import numpy as np

from dvsviz.events.events import Events
from dvsviz.events.recording import Recording
from dvsviz.formats.hdf5_writer import growing_path
from dvsviz.geometry.camera import Camera

# What arrives is written every 0.3 s (`live.recorder`).
_WAIT_S = 0.8
_POLL_S = 0.03


class GrowingEvents:
    """An `EventSource` over the events that are written by now.

    Args:
        path: the file, written by `RecordingWriter` with `growing`.

    Raises:
        OSError, KeyError: there is no such file, or it holds no events.
    """

    def __init__(self, path: Path) -> None:
        self._file = h5py.File(path, "r", libver="latest", swmr=True)
        found = [self._file.get(f"events/{name}") for name in ("t", "x", "y", "p")]
        self._columns = [column for column in found if isinstance(column, h5py.Dataset)]
        if len(self._columns) != 4:
            self._file.close()
            raise KeyError("events")
        self._lock = threading.Lock()
        self._count = 0

    @property
    def count(self) -> int:
        """Number of events that are written by now."""
        with self._lock:
            for column in self._columns:
                column.refresh()
            self._count = min(len(column) for column in self._columns)
            return self._count

    def wait(self, end: int) -> bool:
        """Wait a moment for the events before `end`; return whether they are there."""
        until = time.monotonic() + _WAIT_S
        while self._count < end and self.count < end:
            if time.monotonic() > until:
                return False
            time.sleep(_POLL_S)
        return True

    def read(self, first: int, end: int) -> Events:
        """Return events `[first, end)`, clipped to those that are written."""
        if end > self._count:
            end = min(end, self.count)
        first = max(0, first)
        if end <= first:
            return Events.empty()
        with self._lock:
            t, x, y, p = (np.asarray(column[first:end]) for column in self._columns)
        return Events(t_us=t, x_px=x, y_px=y, is_positive=p > 0)

    def index_at(self, t_us: int) -> int:
        """Return the index of the first event at or after a time (`count` where there is none yet)."""
        low, high = 0, self.count
        while low < high:
            middle = (low + high) // 2
            if int(self.read(middle, middle + 1).t_us[0]) < t_us:
                low = middle + 1
            else:
                high = middle
        return low

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._file.close()


def open_growing(path: Path, camera: Camera) -> Recording | None:
    """Return the recording that is being written to get the name `path`, None where it cannot be read.

    A file that is open cannot get its name on Windows: there it is read when it is whole.
    """
    part = growing_path(path)
    if os.name == "nt" or not part.is_file():
        return None
    try:
        events = GrowingEvents(part)
    except (OSError, KeyError):
        return None
    return Recording(path=path, name=path.stem, format="growing", camera=camera, events=events)
