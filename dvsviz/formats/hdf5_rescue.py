"""What a recorder that was killed left: its events get the name that they were recorded for."""

from __future__ import annotations

import logging
from pathlib import Path

import h5py
import numpy as np

from dvsviz.errors import DvsvizError
from dvsviz.events.events import Events
from dvsviz.formats.hdf5 import read_camera
from dvsviz.formats.hdf5_writer import RecordingWriter, growing_path
from dvsviz.session.killed import ClosedView
from dvsviz.session.lock import has_writer
from dvsviz.session.schema import dataset

_log = logging.getLogger(__name__)
_BLOCK = 1 << 20
_UNREADABLE = (OSError, KeyError, ValueError, TypeError, RuntimeError, DvsvizError)


def rescue(path: Path) -> int | None:
    """Make the recording `path` of what a killed run left beside it; return its number of events, None for nothing.

    What is there under that name stays as it is, and so does what a run is still writing. The last third of a second
    may be missing: it was on its way to the disk.

    Args:
        path: the recording that was to be written.
    """
    part = growing_path(path)
    if path.exists() or not part.is_file() or has_writer(part):
        return None
    try:
        # Read as a finished file: a reader that expects a writer would wait for one where metadata is torn.
        with h5py.File(ClosedView(part), "r") as file:
            count = _copied(file, part, path)
    except _UNREADABLE as error:
        _log.warning("%s holds nothing that can be read: %s", part, error)
        return None
    if count == 0:
        return None
    part.unlink(missing_ok=True)
    _log.warning("%s: the run that recorded it was killed; %d events were saved", path, count)
    return count


def _copied(file: h5py.File, part: Path, path: Path) -> int:
    """Write the events of a file to the recording `path` and return how many there were."""
    columns = [dataset(file, f"events/{name}") for name in ("t", "x", "y", "p")]
    end = min(len(column) for column in columns)
    if end == 0:
        return 0
    camera, _ = read_camera(file, part)
    count, last_us = 0, int(columns[0][0])
    with RecordingWriter(path, camera=camera) as writer:
        while count < end:
            t, x, y, p = (np.asarray(column[count : min(end, count + _BLOCK)]) for column in columns)
            # Values that had not reached the disk are zeros: time runs back.
            torn = np.flatnonzero(np.diff(t, prepend=last_us) < 0)
            size = int(torn[0]) if len(torn) else len(t)
            writer.append(Events(t_us=t, x_px=x, y_px=y, is_positive=p > 0)[:size])
            count += size
            if len(torn):
                break
            last_us = int(t[-1])
    return count
