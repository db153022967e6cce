"""Events that arrive while they are tracked: a network stream or a camera, read by a thread of its own."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Protocol

import numpy as np

from dvsviz.errors import DvsvizError
from dvsviz.events.events import Events, joined
from dvsviz.live.figures import LiveFigures, StreamState

# Unread events older than this cannot be wanted any more: the rule of `live.windows` jumps over them long before.
_KEPT_US = 5_000_000
_POLL_S = 0.004
_RETRY_EVERY_S = 0.5


class Connection(Protocol):
    """What is read: an open stream of events."""

    @property
    def size(self) -> tuple[int, int]:
        """Sensor (width, height), px."""
        ...

    @property
    def arrived_s(self) -> float:
        """When the events read last arrived, on the monotonic clock (the same for all processes)."""
        ...

    def read(self) -> Events | None:
        """Return the next events, or None where none are there yet.

        Raises:
            ConnectionError: the stream has ended or was lost.
        """
        ...

    def close(self) -> None:
        """Let go of the stream."""
        ...


class LiveEvents:
    """An `EventSource` that grows; index 0 is the first event that was received.

    Reading waits for events that are still to come. A stream that breaks off is opened again; times that then
    start anew are carried on, so that there is a gap and no step back.

    Args:
        connect: opens the stream; called again where it broke off.
        retry_s: how long a lost stream is waited for before the recording ends.
        max_wait_us: a read returns with fewer events than wanted where those there span so much time.
        record: given every event that arrives, in order.
        stop: ends the stream when set.
        report: told in a sentence what happens to the stream.

    Attributes:
        figures: what came, and what became of it.
        newest_us: time of the newest event.
    """

    def __init__(
        self,
        connect: Callable[[], Connection],
        *,
        retry_s: float = 10.0,
        max_wait_us: int = 100_000,
        record: Callable[[Events], None] | None = None,
        stop: threading.Event | None = None,
        report: Callable[[str], None] | None = None,
    ) -> None:
        self._connect, self._retry_s, self._max_wait_us = connect, retry_s, max_wait_us
        self._record, self._told = record, report or (lambda text: None)
        self.stop = stop or threading.Event()
        self.figures = LiveFigures()
        self.received, self.newest_us = 0, 0
        self._chunks: deque[tuple[int, Events]] = deque()
        self._first: Events | None = None
        self._read_to = 0
        self._shift_us = 0
        self._ended, self._error = False, None
        self._changed = threading.Condition()
        self._connection: Connection | None = connect()
        self.size = self._connection.size
        self._arrived_s = time.monotonic()
        self._thread = threading.Thread(target=self._work, name="live events", daemon=True)
        self._thread.start()

    @property
    def count(self) -> int:
        """Number of events received so far."""
        return self.received

    @property
    def is_ended(self) -> bool:
        """Whether no more events will come."""
        return self._ended

    def wait_for_first(self) -> bool:
        """Wait for the first event; False where the stream ended without one."""
        with self._changed:
            self._changed.wait_for(lambda: self.received > 0 or self._ended)
        self._raise()
        return self.received > 0

    def read(self, first: int, end: int) -> Events:
        """Return events `[first, end)`, fewer where the stream has ended or they span the longest wait.

        Raises:
            DvsvizError: what was received could not be recorded.
            ValueError: they are not kept any more.
        """
        if end <= 1 and self._first is not None:
            return self._first[max(0, first) : end]
        with self._changed:
            # Events come at least every some milliseconds while anything moves; where nothing does, time alone tells.
            began = time.monotonic()
            while not (self._ended or self.received >= end or self._spans(first, began)):
                self._changed.wait(0.02)
            self._raise()
            self._read_to = max(self._read_to, first)
            parts = [
                chunk[max(0, first - at) : max(0, end - at)]
                for at, chunk in self._chunks
                if at < end and at + len(chunk) > first
            ]
            oldest = self._chunks[0][0] if self._chunks else self.received
        if first < oldest:
            raise ValueError(f"first: expected at least {oldest}, the oldest event that is kept, got {first}")
        return joined(parts)

    def index_at(self, t_us: int) -> int:
        """Return the index of the first event that is kept at or after a time, `count` where there is none yet."""
        with self._changed:
            for at, chunk in self._chunks:
                if chunk.t_us[-1] >= t_us:
                    return at + int(np.searchsorted(chunk.t_us, t_us))
            return self.received

    def close(self) -> None:
        """Stop receiving."""
        self.stop.set()
        self._thread.join(5.0)

    def _spans(self, first: int, began: float) -> bool:
        """Tell whether the events from `first` on span the longest wait, in their time or on the clock."""
        if self.received <= first:
            return False
        start_us = next(int(chunk.t_us[first - at]) for at, chunk in self._chunks if at + len(chunk) > first)
        return self.newest_us - start_us >= self._max_wait_us or time.monotonic() - began > 2e-6 * self._max_wait_us

    def _raise(self) -> None:
        if self._error is not None:
            raise self._error

    def _work(self) -> None:
        try:
            while not self.stop.is_set():
                try:
                    if self._connection is None:
                        self._connection = self._again()
                    if self._connection is None:
                        break
                    events = self._connection.read()
                except ConnectionError as error:
                    self.figures.state = StreamState.LOST
                    self._report(f"the stream was lost ({error}); trying again for {self._retry_s:g} s")
                    self._let_go()
                    continue
                if events is None:
                    self.stop.wait(_POLL_S)
                elif len(events):
                    self._take(events)
        except DvsvizError as error:
            self._error = error
        finally:
            self._let_go()
            with self._changed:
                self._ended = True
                self.figures.state = StreamState.ENDED
                self._changed.notify_all()

    def _report(self, text: str) -> None:
        self.figures.note(text)
        self._told(text)

    def _let_go(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def _again(self) -> Connection | None:
        """Return the stream, opened again, or None where it does not come back in time."""
        deadline = time.monotonic() + self._retry_s
        while not self.stop.wait(_RETRY_EVERY_S) and time.monotonic() < deadline:
            try:
                connection = self._connect()
            except DvsvizError:
                continue
            if connection.size != self.size:
                connection.close()
                self._report(f"the stream came back with a sensor of {connection.size}, and is left")
                return None
            self.figures.reconnects += 1
            self.figures.state = StreamState.RECEIVING
            self._report("the stream is there again")
            return connection
        self._report("the stream did not come back")
        return None

    def _take(self, events: Events) -> None:
        width, height = self.size
        now = time.monotonic()
        t = events.t_us + self._shift_us
        if self.received and int(t[0]) < self.newest_us - 1_000_000:
            # The sensor's clock was started anew: the pause is as long as it was here.
            shift = self.newest_us + round((now - self._arrived_s) * 1e6) - int(t[0])
            self._shift_us += shift
            t = t + shift
        self._arrived_s = now
        before = self.newest_us if self.received else int(t[0])
        latest = np.maximum.accumulate(np.concatenate([[before], t]))[:-1]
        keep = (events.x_px < width) & (events.y_px < height) & (t >= latest)
        self.figures.dropped += int(len(t) - np.count_nonzero(keep))
        if not keep.any():
            return
        kept = Events(
            t_us=t[keep], x_px=events.x_px[keep], y_px=events.y_px[keep], is_positive=events.is_positive[keep]
        )
        if self._record is not None:
            self._record(kept)
        with self._changed:
            if self._first is None:
                self._first = kept[:1]
            self._chunks.append((self.received, kept))
            self.received += len(kept)
            self.newest_us = int(kept.t_us[-1])
            self.figures.arrived(len(kept), now if self._connection is None else self._connection.arrived_s)
            while len(self._chunks) > 1 and self._is_past(*self._chunks[0]):
                self._chunks.popleft()
            self._changed.notify_all()

    def _is_past(self, at: int, chunk: Events) -> bool:
        return at + len(chunk) <= self._read_to or int(chunk.t_us[-1]) < self.newest_us - _KEPT_US
