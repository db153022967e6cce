"""Windows of a live stream, with the rule that keeps the lag bounded."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from dvsviz.events.recording import Recording
from dvsviz.events.windows import EventWindow, make_window
from dvsviz.live.source import LiveEvents

MAX_LAG_US = 100_000
"""A window that starts so long before the newest event is left out."""
RESUMED_LAG_US = 30_000
"""How long before the newest event the window starts that is made instead."""


class LiveWindows:
    """The windows of a live recording.

    Where the next window would start more than `MAX_LAG_US` before the newest event, events are left out up to
    `RESUMED_LAG_US` before it. So the lag never grows beyond the limit and the time of one step, and the tracker
    sees whole windows with a gap in time rather than thinned ones.

    Attributes:
        used: events in the windows made.
        skips: how often events were left out.
        lags_us: for each window, how long before the newest event it began when it was made.
    """

    def __init__(self, recording: Recording, count: Callable[[], int], *, max_duration_us: int) -> None:
        if not isinstance(recording.events, LiveEvents):
            raise ValueError("recording: expected one that is received live")
        self._recording, self._events = recording, recording.events
        self._count, self._max_duration_us = count, max_duration_us
        self.used, self.skips = 0, 0
        self.lags_us: list[int] = []

    def __iter__(self) -> Iterator[EventWindow]:
        """Yield windows until the stream ends."""
        source, first, index = self._events, 0, 0
        while True:
            limit_us = source.newest_us - MAX_LAG_US
            # Where compiling took long, the first events are gone already.
            if source.index_at(limit_us) > first and not source.is_ended:
                first = source.index_at(source.newest_us - RESUMED_LAG_US)
                self.skips += 1
            count = max(1, self._count())
            events = source.read(first, first + count + 1)
            if len(events) == 0:
                return
            end_of_time_us = int(events.t_us[0]) + self._max_duration_us
            n = min(count, max(1, int(np.searchsorted(events.t_us, end_of_time_us))))
            end_us = min(int(events.t_us[n]), end_of_time_us) if n < len(events) else int(events.t_us[-1]) + 1
            self.lags_us.append(source.newest_us - int(events.t_us[0]))
            self.used += n
            yield make_window(
                self._recording.camera,
                events[:n],
                index=index,
                first_event=first,
                end_us=max(end_us, int(events.t_us[n - 1]) + 1) if n == len(events) else end_us,
            )
            first, index = first + n, index + 1

    def summary(self) -> dict[str, float]:
        """Return what came and what was used: counts, the share, and lags in milliseconds."""
        lags = np.array(self.lags_us or [0]) * 1e-3
        return {
            "received": self._events.received,
            "used_share": self.used / max(1, self._events.received),
            "skips": self.skips,
            "reconnects": self._events.reconnects,
            "dropped": self._events.dropped,
            "lag_median_ms": float(np.median(lags)),
            "lag_max_ms": float(lags.max()),
        }
