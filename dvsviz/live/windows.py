"""Windows of a live stream, with the rule that keeps the lag bounded."""

from __future__ import annotations

import statistics
import time
from collections import deque
from collections.abc import Callable, Iterator

import numpy as np

from dvsviz.events.recording import Recording
from dvsviz.events.windows import EventWindow, make_window
from dvsviz.live.source import LiveEvents

MAX_STRETCH = 2.0
"""How much larger windows become where they are waiting: on slider_depth and shapes without any loss of accuracy."""
MAX_LAG_US = 2_000_000
"""A window that starts so long before the newest event is left out, whatever the tracker's speed."""
SLOW_LAG_US = 100_000
"""The same where the last windows took longer than they lasted, so that no lag could be worked off."""
RESUMED_LAG_US = 30_000
"""How long before the newest event the window starts that is made instead."""
# The median of so many steps: a refinement, which takes as long as many windows, does not make a tracker a slow one.
_STEPS = 31


class LiveWindows:
    """The windows of a live recording.

    A tracker that keeps up gets windows as it wants them. Where more events wait than one window takes, windows
    become up to `MAX_STRETCH` times as large: they cost about the same. A lag that can be worked off so, as after the
    refinement of the map, is worked off, and nothing is lost. One that cannot, or that is beyond `MAX_LAG_US`, is cut:
    events are left out up to `RESUMED_LAG_US` before the newest. So the lag is bounded, and the tracker sees whole
    windows with a gap in time rather than thinned ones.

    Args:
        recording: one whose events are `LiveEvents`.
        count: events that the next window should have.
        max_duration_us: longest window.
        stretch: told before `count` is asked how much larger the window may be; None to leave windows as they are.
    """

    def __init__(
        self,
        recording: Recording,
        count: Callable[[], int],
        *,
        max_duration_us: int,
        stretch: Callable[[float], None] | None = None,
    ) -> None:
        if not isinstance(recording.events, LiveEvents):
            raise ValueError("recording: expected one that is received live")
        self._recording, self._events = recording, recording.events
        self._count, self._stretch, self._max_duration_us = count, stretch, max_duration_us
        self._slowness: deque[float] = deque(maxlen=_STEPS)

    def __iter__(self) -> Iterator[EventWindow]:
        """Yield windows until the stream ends; asking for the next one says that the last one's pose is there."""
        source, figures, first, index = self._events, self._events.figures, 0, 0
        while True:
            if source.index_at(source.newest_us - self._most_us()) > first and not source.is_ended:
                first = source.index_at(source.newest_us - RESUMED_LAG_US)
                figures.skips += 1
            count = self._size(first)
            events = source.read(first, first + count + 1)
            if len(events) == 0:
                return
            end_of_time_us = int(events.t_us[0]) + self._max_duration_us
            n = min(count, max(1, int(np.searchsorted(events.t_us, end_of_time_us))))
            end_us = min(int(events.t_us[n]), end_of_time_us) if n < len(events) else int(events.t_us[-1]) + 1
            figures.used += n
            window = make_window(
                self._recording.camera,
                events[:n],
                index=index,
                first_event=first,
                end_us=max(end_us, int(events.t_us[n - 1]) + 1) if n == len(events) else end_us,
            )
            began = time.monotonic()
            yield window
            self._slowness.append((time.monotonic() - began) / max(1e-3, window.duration_s))
            first, index = first + n, index + 1
            figures.posed(first)

    def _most_us(self) -> int:
        """Return the lag beyond which events are left out."""
        is_slow = len(self._slowness) >= _STEPS and statistics.median(self._slowness) > 1.0
        return SLOW_LAG_US if is_slow else MAX_LAG_US

    def _size(self, first: int) -> int:
        """Return how many events the window that starts at `first` should have."""
        if self._stretch is None:
            return max(1, self._count())
        self._stretch(1.0)
        wanted = max(1, self._count())
        waiting = (self._events.count - first) / wanted
        if waiting > 1.0:
            self._stretch(min(MAX_STRETCH, waiting))
            wanted = max(wanted, self._count())
        return wanted

    def notes(self) -> list[str]:
        """Return what happened to the stream since it was last asked."""
        return self._events.figures.take_notes()

    def summary(self) -> dict[str, float]:
        """Return what came and what was used, and latencies in milliseconds."""
        return self._events.figures.summary()
