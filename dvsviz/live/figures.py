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
        self._offset_s = float("inf")
        self._arrived_s = 0.0
        self._arrivals: deque[tuple[float, int]] = deque()
        self._passed, self._passed_used = 0, 0
        self._latencies: list[float] = []

    def arrived(self, count: int, last_us: int) -> None:
        """Take down that events came just now, the last one at a sensor time."""
        now = time.monotonic()
        with self._lock:
            self.received += count
            # The promptest packet tells how far the clocks are apart; they may drift by 100 ppm.
            self._offset_s = min(now - last_us * 1e-6, self._offset_s + 1e-4 * (now - self._arrived_s))
            self._arrived_s = now
            self._arrivals.append((now, count))
            while self._arrivals and now - self._arrivals[0][0] > _RATE_S:
                self._arrivals.popleft()

    def broke_off(self) -> None:
        """Take down that the stream was lost; its clock may come back as another one."""
        with self._lock:
            self.state = StreamState.LOST
            self._offset_s = float("inf")

    def posed(self, last_us: int, end_event: int) -> None:
        """Take down that the pose of a window is there; its latency is the time since its last event was due.

        An event is due when the promptest packet so far would have brought it: what holds it up on the way counts.

        Args:
            last_us: sensor time of the window's last event.
            end_event: number of events up to it, the ones left out too.
        """
        with self._lock:
            # Before a stream that was lost has brought anything there is no clock to measure with.
            if self._offset_s < float("inf"):
                self._latencies.append(max(0.0, time.monotonic() - (last_us * 1e-6 + self._offset_s)))
            self._passed, self._passed_used = end_event, self.used

    def now(self) -> dict[str, float | str | None]:
        """Return what is shown while the stream is tracked.

        `lag_s` is the age of the last pose when it was there, `latency_median_ms` and `latency_p95_ms` those of the
        last windows; `used_share` is of the events that came up to the last window; `events_per_second` came in the
        last two seconds.
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
