"""The beginning of a recording's events, as if the rest had not been recorded."""

from __future__ import annotations

from dvsviz.events.events import Events
from dvsviz.events.recording import EventSource


class EventsUntil:
    """An `EventSource` that ends before event `end` of another one; indices stay those of the other."""

    def __init__(self, source: EventSource, end: int) -> None:
        self._source, self._end = source, end

    @property
    def count(self) -> int:
        """Number of events."""
        return min(self._source.count, self._end)

    def read(self, first: int, end: int) -> Events:
        """Return events `[first, end)`, clipped to those there are."""
        return self._source.read(first, max(first, min(end, self.count)))

    def index_at(self, t_us: int) -> int:
        """Return the index of the first event at or after a time."""
        return min(self._source.index_at(t_us), self.count)
