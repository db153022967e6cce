"""What is known of a live stream while it is tracked: what came, what was used, how old poses are."""

from __future__ import annotations

import threading
import time
from collections import deque
from enum import StrEnum

import numpy as np

# A window takes some 40 ms: about the last minute.
_LATENCIES = 1500
_RATE_S = 2.0


class StreamState(StrEnum):
    """Where a stream stands."""

    RECEIVING = "receiving"
    LOST = "lost"
    ENDED = "ended"


class LiveFigures:
    """Figures of one live stream; written by the receiver and by the windows, read from anywhere.

    Attributes:
        received: events received.
        dropped: events dropped for lying outside the sensor or running backwards.
        reconnects: how often the stream was opened again.
        used: events in the windows made.
        skips: how often events were left out.
        state: whether events come.
    """

    def __init__(self) -> None:
        self.received, self.dropped, self.reconnects = 0, 0, 0
        self.used, self.skips = 0, 0
        self.state = StreamState.RECEIVING
        self._lock = threading.Lock()
        self._unposed: deque[tuple[int, float]] = deque()
        self._arrivals: deque[tuple[float, int]] = deque()
        self._passed, self._passed_used = 0, 0
        self._latencies: list[float] = []
        self._notes: deque[str] = deque()

    def note(self, text: str) -> None:
        """Take down what happened to the stream."""
        self._notes.append(text)

    def take_notes(self) -> list[str]:
        """Return what was taken down since the last call."""
        return [self._notes.popleft() for _ in range(len(self._notes))]

    def arrived(self, count: int, at_s: float) -> None:
        """Take down that events arrived at a time of the monotonic clock."""
        with self._lock:
            self.received += count
            self._unposed.append((self.received, at_s))
            self._arrivals.append((at_s, count))
            while at_s - self._arrivals[0][0] > _RATE_S:
                self._arrivals.popleft()

    def posed(self, end_event: int) -> None:
        """Take down that the pose of a window is there, whose last event is number `end_event` - 1.

        Its latency is the time since that event arrived.
        """
        now = time.monotonic()
        with self._lock:
            while self._unposed and self._unposed[0][0] < end_event:
                self._unposed.popleft()
            if self._unposed:
                self._latencies.append(now - self._unposed[0][1])
            self._passed, self._passed_used = end_event, self.used

    def now(self) -> dict[str, float | str | None]:
        """Return what is shown while the stream is tracked.

        `lag_s` is the time from the arrival of the last window's last event to its pose, `latency_median_ms` and
        `latency_p95_ms` those of the last windows; `used_share` is of the events up to the last window;
        `events_per_second` are those that arrived in the last two seconds.
        """
        now = time.monotonic()
        with self._lock:
            latencies = np.array(self._latencies[-_LATENCIES:])
            recent = sum(count for at, count in self._arrivals if now - at <= _RATE_S)
            return {
                "lag_s": float(latencies[-1]) if len(latencies) else None,
                "events_per_second": recent / _RATE_S,
                "used_share": self._passed_used / self._passed if self._passed else None,
                "latency_median_ms": 1e3 * float(np.median(latencies)) if len(latencies) else None,
                "latency_p95_ms": 1e3 * float(np.percentile(latencies, 95)) if len(latencies) else None,
                "stream": str(self.state),
            }

    def summary(self) -> dict[str, float]:
        """Return what came and what was used of the whole stream, latencies in milliseconds."""
        with self._lock:
            ms = 1e3 * np.array(self._latencies or [0.0])
            return {
                "received": self.received,
                "used_share": self.used / max(1, self.received),
                "skips": self.skips,
                "reconnects": self.reconnects,
                "dropped": self.dropped,
                "latency_median_ms": float(np.median(ms)),
                "latency_p95_ms": float(np.percentile(ms, 95)),
                "latency_max_ms": float(ms.max()),
            }
