"""What a run will take: disk space and time, from the sessions that were made on this machine."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

from dvsviz.events.recording import Recording
from dvsviz.formats.cache import cache_folder

# Where nothing was tracked yet. A session of 240x180, handheld over shapes, two cores: 5.3 MB for 10 s, 0.25 Mev/s.
_BYTES_PER_S = 531_000.0
_EVENTS_PER_S = 250_000.0
_PIXELS = 240 * 180
# A filtered copy holds time, column, row and polarity of each event.
_COPY_BYTES_PER_EVENT = 13
_LATEST = 8
_LEAST_S = 0.5


def estimate(recording: Recording, entries: Sequence[dict[str, Any]], sessions_dir: Path) -> dict[str, Any]:
    """Return what a run of the whole recording is expected to take, ready for JSON.

    Args:
        recording: what is to be tracked.
        entries: the list of sessions, newest first; finished ones of the same sensor size are the measure.
        sessions_dir: where the session is written.
    """
    camera = recording.camera
    ended = [
        e for e in entries if e["state"] == "complete" and e["tracked_s"] > _LEAST_S and e["events_per_second"]
    ]
    same = [e for e in ended if (e["width"], e["height"]) == (camera.width, camera.height)][:_LATEST]
    bytes_per_s = (
        median(e["bytes"] / e["tracked_s"] for e in same)
        if same
        else _BYTES_PER_S * camera.width * camera.height / _PIXELS
    )
    speeds = [e["events_per_second"] for e in (same or ended[:_LATEST])]
    return {
        "bytes_per_s": bytes_per_s,
        "events_per_second": median(speeds) if speeds else _EVENTS_PER_S,
        "measured_on": len(same or speeds),
        "copy_bytes": _COPY_BYTES_PER_EVENT * recording.events.count,
        "free_bytes": free_bytes(sessions_dir),
        "free_copy_bytes": free_bytes(cache_folder()),
    }


def free_bytes(folder: Path) -> int | None:
    """Return the free space of the disk that a folder is on, or will be; None where it cannot be told."""
    for place in (folder, *folder.absolute().parents):
        if place.exists():
            try:
                return shutil.disk_usage(place).free
            except OSError:
                return None
    return None
