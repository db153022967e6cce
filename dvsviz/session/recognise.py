"""Telling session files from other files."""

from __future__ import annotations

from pathlib import Path

import h5py

from dvsviz.session import schema


def is_session(path: Path) -> bool:
    """Return whether a file is a session, of any version, finished or not; False where it cannot be opened."""
    if not path.is_file():
        return False
    try:
        with h5py.File(path, "r", libver="latest", swmr=True) as file:
            return file.attrs.get("format") == schema.FORMAT
    except OSError:
        return False
