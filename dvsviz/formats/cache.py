"""Recordings converted once: foreign formats are read into our own, kept in the user's cache folder.

The name of a cached file tells the source's path, its state (size and time of change) and the options it was read
with; a source that changed is converted again and what was made of its older state is removed.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py

from dvsviz.errors import FormatError
from dvsviz.events.recording import Recording
from dvsviz.formats.hdf5 import GUESS_WARNING, read_recording
from dvsviz.formats.options import OpenOptions
from dvsviz.formats.sink import FORMAT_NOTE, TRIGGERS_NOTE, WARNINGS_NOTE

# Raise it when a reader changes what it makes of the same file.
_CONVERSION = 3


def cache_folder() -> Path:
    """Return where converted recordings are kept: DVSVIZ_CACHE, else `dvsviz` in the user's cache folder."""
    if chosen := os.environ.get("DVSVIZ_CACHE"):
        return Path(chosen)
    base = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA")
    return (Path(base) if base else Path.home() / ".cache") / "dvsviz"


def cached(
    source: Path,
    files: list[Path],
    options: OpenOptions,
    convert: Callable[[Path], None],
    *,
    kind: str,
    purpose: str = "",
) -> Recording:
    """Return the converted recording of a source, from the cache or made now.

    Args:
        source: the file or folder the user named.
        files: the files whose change makes a new conversion needed.
        options: of reading.
        convert: writes the recording to the path it is given.
        kind: name of the reader, part of the key.
        purpose: copies of one source for different purposes do not replace each other.

    Raises:
        FormatError: the source cannot be converted, or the cache folder cannot be written.
    """
    where = _digest(str(source.resolve()) + purpose)
    stats = [(file.name, file.stat().st_size, file.stat().st_mtime_ns) for file in files if file.exists()]
    state = _digest(json.dumps(stats))
    how = _digest(json.dumps([_CONVERSION, kind, options.size, options.repair, options.topic, options.truth_topic]))
    target = cache_folder() / f"{source.stem[:60]}-{where}-{state}-{how}.h5"
    if target.is_file():
        try:
            return _opened(target, source)
        except FormatError:
            # Cut short by a full disk or damaged: a cache is only ever a copy.
            target.unlink(missing_ok=True)
    convert(target)
    for old in target.parent.glob(f"*-{where}-*.h5"):
        if f"-{where}-{state}-" not in old.name:
            old.unlink(missing_ok=True)
    return _opened(target, source)


def _opened(target: Path, source: Path) -> Recording:
    recording = read_recording(target)
    with h5py.File(target, "r") as file:
        name, warnings = file.attrs.get(FORMAT_NOTE), file.attrs.get(WARNINGS_NOTE)
        triggers = file.attrs.get(TRIGGERS_NOTE)
    if not isinstance(name, str) or not isinstance(warnings, str):
        raise FormatError("not a converted recording", path=target)
    return replace(
        recording,
        path=source,
        name=source.stem if source.is_file() else source.name,
        format=name,
        triggers=json.loads(triggers) if isinstance(triggers, str) else {},
        warnings=(*json.loads(warnings), *recording.warnings),
    )


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:12]


__all__ = ["GUESS_WARNING", "cache_folder", "cached"]
