"""A stretch of a session as a video: VP8 in WebM, or MPEG-4 in MP4, by the encoders that OpenCV brings along.

Measured with OpenCV 5.0's wheel: VP8, VP9 and MPEG-4 part 2 are written; H.264 and AV1 are not. Browsers play VP8 in
WebM; MPEG-4 part 2 is for players on the desktop and slides.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np

from dvsviz.errors import DvsvizError
from dvsviz.export.video_frames import Frames
from dvsviz.view.shown import ShownSession

FRAMES_A_SECOND = 25
MOST_FRAMES = 45_000
"""Half an hour: more was hardly meant."""

_CODECS = {".webm": "VP80", ".mp4": "mp4v"}


def export_video(
    shown: ShownSession,
    out: Path,
    *,
    start_s: float | None = None,
    end_s: float | None = None,
    speed: float = 1.0,
    progress: Callable[[float], None] = lambda share: None,
) -> int:
    """Write the windows of a stretch of time as a video and return its number of frames.

    Each frame shows the window that holds its moment, so that the video keeps the sensor's time.

    Args:
        shown: the session with its recording.
        out: the .webm or .mp4 file; replaced where it exists.
        start_s: seconds after the first event; None for the first window.
        end_s: seconds after the first event, exclusive; None for the end of the last window.
        speed: recording seconds a second.
        progress: called with the share that is done, 0 to 1; what it raises ends the writing, and nothing is left.

    Raises:
        DvsvizError: there are no events or no windows in the stretch, or the file cannot be written.
    """
    codec = _CODECS.get(out.suffix.lower())
    if codec is None:
        raise DvsvizError(
            f"cannot write {out.suffix or 'a video without ending'}", path=out, hint="name x.webm or x.mp4"
        )
    if shown.recording is None:
        raise DvsvizError(
            "a video needs the recording's events",
            path=shown.session.path,
            hint="put the recording back where it was",
        )
    moments, windows = _moments(shown, start_s, end_s, speed)
    frames = Frames(shown, (int(windows[0]), int(windows[-1])))
    partial = out.with_name(f".{out.stem}.partial{out.suffix.lower()}")
    try:
        _write(partial, codec, frames, moments, windows, progress)
        partial.replace(out)
    except OSError as error:
        raise DvsvizError(f"cannot be written: {error.strerror}", path=out, hint="check the folder") from error
    finally:
        partial.unlink(missing_ok=True)
    progress(1.0)
    return len(moments)


def _moments(
    shown: ShownSession, start_s: float | None, end_s: float | None, speed: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the time (N,) of each frame, seconds after the first event, and its window (N,)."""
    count = shown.window_count
    if not speed > 0:
        raise DvsvizError(f"speed {speed:g} shows nothing", hint="say how many recording seconds a second takes")
    if count == 0:
        raise DvsvizError("has no windows", path=shown.session.path, hint="there is nothing to show")
    columns = shown.session.columns()
    first_us = shown.session.header.first_us
    t_s = (columns["start_us"][:count] - first_us) * 1e-6
    last_s = float(columns["end_us"][count - 1] - first_us) * 1e-6
    begin = float(t_s[0]) if start_s is None else max(start_s, float(t_s[0]))
    end = last_s if end_s is None else min(end_s, last_s)
    number = int(np.ceil((end - begin) * FRAMES_A_SECOND / speed - 1e-6))
    if not number > 0:
        raise DvsvizError(
            f"no windows from {begin:g} to {end:g} s",
            path=shown.session.path,
            hint=f"it has windows from {t_s[0]:g} to {last_s:g} s",
        )
    if number > MOST_FRAMES:
        raise DvsvizError(
            f"{number:,d} frames are more than {MOST_FRAMES:,d}",
            path=shown.session.path,
            hint="choose a shorter stretch, or a higher speed",
        )
    moments = begin + np.arange(number) * speed / FRAMES_A_SECOND
    return moments, np.maximum(0, np.searchsorted(t_s, moments + 1e-9, side="right") - 1)


def _write(
    partial: Path,
    codec: str,
    frames: Frames,
    moments: np.ndarray,
    windows: np.ndarray,
    progress: Callable[[float], None],
) -> None:
    # OpenCV only logs that it cannot open a file.
    partial.write_bytes(b"")
    size = (frames.width, frames.height)
    fourcc = cv2.VideoWriter.fourcc(*codec)
    with _without_remark():
        writer = cv2.VideoWriter(str(partial), cv2.CAP_FFMPEG, fourcc, FRAMES_A_SECOND, size)
    try:
        if not writer.isOpened():
            raise DvsvizError(f"this OpenCV has no encoder for {codec}", path=partial, hint="name x.webm or x.mp4")
        for k, (moment, window) in enumerate(zip(moments.tolist(), windows.tolist(), strict=True)):
            writer.write(frames.frame(window, moment)[..., ::-1])
            if k % 5 == 0:
                progress(min(0.99, k / len(moments)))
    finally:
        writer.release()
    if partial.stat().st_size == 0:
        raise DvsvizError("the video is empty", path=partial, hint="check the free space and try again")


@contextmanager
def _without_remark() -> Iterator[None]:
    """Keep standard error clean: OpenCV says of VP8 in WebM, from C, that it had to choose the tag itself."""
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
