"""Checks that every reader and writer of events shares."""

from __future__ import annotations

from pathlib import Path
from typing import NoReturn

import h5py
import numpy as np

from dvsviz.errors import FormatError
from dvsviz.events.events import Events
from dvsviz.geometry.camera import Camera

# The largest event sensors have 1280 columns. Images of 4096x4096 pixels still fit into the memory that is promised.
MAX_SIDE = 4096
# Deflate makes zeros a thousand times smaller, never more.
_MOST_PACKED = 1100


def check_sensor(width: int, height: int, path: Path) -> None:
    """Refuse a sensor that no camera has: a damaged header must not ask for gigabytes of memory.

    Raises:
        FormatError: a side is not 1 to 4096 pixels.
    """
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        hint = f"expected 1 to {MAX_SIDE} pixels a side: the header may be damaged, --size gives the right size"
        raise FormatError(f"a sensor of {width}x{height}", path=path, hint=hint)


def check_stored(dataset: h5py.Dataset, path: Path) -> None:
    """Refuse a dataset that claims more than its file can hold.

    Raises:
        FormatError: it has more bytes than the file unpacks to.
    """
    if dataset.nbytes > _MOST_PACKED * path.stat().st_size:
        place = str(dataset.name).strip("/")
        message = f"claims {dataset.nbytes:,d} bytes, more than the file can hold"
        raise FormatError(message, path=path, place=place, hint="copy or write it again")


def check_events(events: Events, camera: Camera, *, path: Path, first: int = 0, last_us: int | None = None) -> None:
    """Check that events are in time order and inside the sensor.

    Args:
        events: the events.
        camera: gives the sensor's size.
        path: named in the error.
        first: index of `events[0]` in its file, named in the error.
        last_us: time of the event before them, None where there is none.

    Raises:
        FormatError: with the index of the first event that is wrong.
    """
    if len(events) == 0:
        return
    t = events.t_us
    if last_us is not None and t[0] < last_us:
        _refuse_order(path, first, int(t[0]), last_us)
    back = t[1:] < t[:-1]
    if back.any():
        i = int(np.argmax(back)) + 1
        _refuse_order(path, first + i, int(t[i]), int(t[i - 1]))
    if int(events.x_px.max()) >= camera.width or int(events.y_px.max()) >= camera.height:
        i = int(np.argmax((events.x_px >= camera.width) | (events.y_px >= camera.height)))
        raise FormatError(
            f"pixel ({events.x_px[i]}, {events.y_px[i]}) lies outside the sensor of {camera.width}x{camera.height}",
            path=path,
            place=f"event {first + i}",
            hint="give the right size with --size WxH, or drop such events with --repair",
        )


def _refuse_order(path: Path, index: int, t_us: int, before_us: int) -> NoReturn:
    raise FormatError(
        f"time runs backwards, {t_us} us after {before_us} us",
        path=path,
        place=f"event {index}",
        hint="sort the events by time, or drop those that run backwards with --repair",
    )
