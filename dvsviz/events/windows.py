"""Event windows: the unit of tracking.

A window is closed by its N-th event or after `max_duration_us`, whichever is first (the data-driven size of
seed 000, section 2.1, with a limit so that a slow scene still gets poses). An empty window is not made: where
nothing happens for longer, the next window starts at the next event.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dvsviz.events.events import Events
from dvsviz.events.recording import Recording
from dvsviz.geometry.camera import Camera

MAX_WINDOW_US = 100_000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EventWindow:
    """Consecutive events with their bearings.

    Attributes:
        index: number of the window, from 0.
        first_event: index of its first event in the recording.
        start_us: time of its first event.
        end_us: time at which the next window starts (half-open: `[start_us, end_us)`).
        events: the events.
        bearings: undistorted bearings (N, 2) float32, the x and y of (x, y, 1).
    """

    index: int
    first_event: int
    start_us: int
    end_us: int
    events: Events
    bearings: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.events)

    @property
    def end_event(self) -> int:
        """Index after its last event in the recording."""
        return self.first_event + len(self.events)

    @property
    def duration_s(self) -> float:
        """Seconds from start to end."""
        return (self.end_us - self.start_us) * 1e-6

    @property
    def t_s(self) -> NDArray[np.float64]:
        """Event times (N,) in seconds since `start_us`."""
        return np.asarray((self.events.t_us - self.start_us) * 1e-6, dtype=np.float64)


def make_window(
    camera: Camera, events: Events, *, index: int = 0, first_event: int = 0, end_us: int | None = None
) -> EventWindow:
    """Return a window of all the given events.

    Args:
        camera: gives the bearings.
        events: at least one event.
        index: number of the window.
        first_event: index of `events[0]` in its recording.
        end_us: when the window ends; one microsecond after its last event unless said.

    Raises:
        ValueError: no events, or an event outside the sensor.
    """
    if len(events) == 0:
        raise ValueError("events: expected at least one event, got none")
    if int(events.x_px.max()) >= camera.width or int(events.y_px.max()) >= camera.height:
        raise ValueError(
            f"events: expected pixels inside {camera.width}x{camera.height}, "
            f"got x up to {events.x_px.max()}, y up to {events.y_px.max()}"
        )
    # x and y of a bearing are taken as one number of 8 bytes: a third of the time.
    table = camera.bearing_table().reshape(-1).view(np.int64)
    pixel = events.y_px.astype(np.int64) * camera.width + events.x_px
    bearings = table.take(pixel).view(np.float32).reshape(-1, 2)
    return EventWindow(
        index=index,
        first_event=first_event,
        start_us=int(events.t_us[0]),
        end_us=int(events.t_us[-1]) + 1 if end_us is None else end_us,
        events=events,
        bearings=bearings,
    )


def read_window(
    recording: Recording,
    *,
    index: int,
    first_event: int,
    count: int,
    max_duration_us: int = MAX_WINDOW_US,
) -> EventWindow | None:
    """Return the window that starts at event `first_event`, or None at the end of the recording.

    Args:
        recording: where the events are read.
        index: number to give the window.
        first_event: index of its first event.
        count: events that close it, at least 1.
        max_duration_us: time that closes it.

    Raises:
        ValueError: `count` is below 1.
    """
    if count < 1:
        raise ValueError(f"count: expected at least 1, got {count}")
    # One event more tells when the next window starts.
    events = recording.events.read(first_event, first_event + count + 1)
    if len(events) == 0:
        return None
    limit_us = int(events.t_us[0]) + max_duration_us
    n = min(count, int(np.searchsorted(events.t_us, limit_us, side="left")))
    end_us = min(int(events.t_us[n]), limit_us) if n < len(events) else int(events.t_us[-1]) + 1
    return make_window(recording.camera, events[:n], index=index, first_event=first_event, end_us=end_us)


def windows(
    recording: Recording,
    count: int | Callable[[], int],
    *,
    max_duration_us: int = MAX_WINDOW_US,
    first_event: int = 0,
    index: int = 0,
) -> Iterator[EventWindow]:
    """Yield the windows of a recording, one after the other, each starting where the last one ended.

    Args:
        recording: where the events are read.
        count: events a window, or a function asked before each window (`tracker.window_size`).
        max_duration_us: a window also ends after this time.
        first_event: where to start.
        index: number of the first window.
    """
    while True:
        size = count() if callable(count) else count
        window = read_window(
            recording, index=index, first_event=first_event, count=size, max_duration_us=max_duration_us
        )
        if window is None:
            return
        yield window
        first_event, index = window.end_event, index + 1
