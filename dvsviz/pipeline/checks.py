"""What is looked at before a run: that the recording can be tracked, and that nothing of value is written over."""

from __future__ import annotations

from pathlib import Path

from dvsviz.errors import SessionError
from dvsviz.events.recording import Recording
from dvsviz.live.source import LiveEvents
from dvsviz.session.recognise import is_session

SMALLEST_SIDE = 16
"""Pixels of the shorter side of a sensor that can be tracked."""
LONGEST_US = 1 << 60
"""Microseconds from first to last event that are believed, 36,000 years."""


def check_trackable(recording: Recording) -> None:
    """Refuse what no camera records: a sensor of a few pixels, times that are ages apart.

    Raises:
        SessionError: it is so.
    """
    width, height = recording.camera.width, recording.camera.height
    if min(width, height) < SMALLEST_SIDE:
        raise SessionError(
            f"a sensor of {width}x{height} is too small to be tracked",
            path=recording.path,
            hint=f"expected at least {SMALLEST_SIDE} pixels a side: look with `dvsviz info`, or give --size",
        )
    if not isinstance(recording.events, LiveEvents) and recording.last_us - recording.first_us > LONGEST_US:
        years = (recording.last_us - recording.first_us) / 3.156e13
        raise SessionError(
            f"its events lie {years:,.0f} years apart",
            path=recording.path,
            hint="a time is wrong: drop it with --repair, or take a part with dvsviz convert",
        )


def check_target(recording: Recording, out: Path, *, force: bool) -> None:
    """Refuse to write over the recording, or over what is no session.

    Raises:
        SessionError: it is so.
    """
    if not out.exists():
        return
    if recording.path.exists() and out.samefile(recording.path):
        raise SessionError("is the recording itself", path=out, hint="name another file with --out")
    if force and not is_session(out):
        raise SessionError("is not a session and is not replaced", path=out, hint="name another file with --out")
