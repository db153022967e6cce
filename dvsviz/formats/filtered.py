"""A recording seen through event filters: filtered once, kept in the cache like any converted recording."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import FormatError
from dvsviz.events.filters import EventFilter, FilterConfig, count_pixels, hot_pixels
from dvsviz.events.recording import Recording
from dvsviz.formats.cache import cached
from dvsviz.formats.options import OpenOptions
from dvsviz.formats.sink import RecordingSink


def hot_mask(recording: Recording) -> NDArray[np.bool_]:
    """Return the mask (height, width) of a recording's hot pixels; all its events are read."""
    counts = np.zeros((recording.camera.height, recording.camera.width), np.int64)
    for events in recording.chunks():
        count_pixels(counts, events)
    return hot_pixels(counts)


def filtered(recording: Recording, config: FilterConfig, options: OpenOptions) -> Recording:
    """Return the recording with the events that the filters keep; everything beside the events is as before.

    Args:
        recording: an opened recording.
        config: which filters act.
        options: with which it was opened, part of the cached copy's name.

    Raises:
        FormatError: the filters keep no event, or the cache folder cannot be written.
    """
    if not config.is_active:
        return recording
    source = recording.path
    files = [source] if source.is_file() else sorted(path for path in source.iterdir() if path.is_file())

    def convert(target: Path) -> None:
        with RecordingSink(target, source, recording.format, replace(options, size=None, repair=False)) as sink:
            _filter(recording, config, sink, options.progress)

    found = cached(source, files, options, convert, kind=repr(config), purpose="filtered")
    return replace(
        recording,
        events=found.events,
        filters=config,
        events_before_filters=recording.events.count,
    )


def _filter(
    recording: Recording, config: FilterConfig, sink: RecordingSink, progress: Callable[[float], None] | None
) -> None:
    camera, total = recording.camera, recording.events.count
    act = EventFilter(camera.width, camera.height, config, hot_mask(recording) if config.hot_pixels else None)
    sink.start(camera)
    for events in recording.chunks():
        kept = act(events)
        sink.add(kept.t_us, kept.x_px, kept.y_px, kept.is_positive)
        if progress is not None:
            progress(act.seen / total)
    if sink.count == 0:
        message = f"the filters keep none of {total} events"
        raise FormatError(message, path=recording.path, hint="choose weaker filters")
