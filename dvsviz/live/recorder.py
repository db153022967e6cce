"""Recording what is received, beside the thread that receives it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import TracebackType
from typing import Self

from dvsviz.errors import DvsvizError
from dvsviz.events.events import Events, joined

# Writing 2,000 events costs as much as writing 20,000.
_EVERY_S = 0.3


class Recorder:
    """Writes events in a thread, a third of a second's at once; nothing is lost when it is left.

    Args:
        write: writes events that follow those before.
    """

    def __init__(self, write: Callable[[Events], None]) -> None:
        self._write = write
        self._waiting: list[Events] = []
        self._lock, self._end = threading.Lock(), threading.Event()
        self._error: DvsvizError | OSError | None = None
        self._thread = threading.Thread(target=self._work, name="recorder")
        self._thread.start()

    def put(self, events: Events) -> None:
        """Take events.

        Raises:
            DvsvizError: what came before could not be written.
        """
        self._raise()
        with self._lock:
            self._waiting.append(events)

    def close(self) -> None:
        """Write what waits.

        Raises:
            DvsvizError: it could not be written.
        """
        self._end.set()
        self._thread.join()
        self._raise()

    def _raise(self) -> None:
        if isinstance(self._error, DvsvizError):
            raise self._error
        if self._error is not None:
            raise DvsvizError(f"the recording cannot be written ({self._error})", hint="make room") from self._error

    def _work(self) -> None:
        ended = False
        while not ended and self._error is None:
            ended = self._end.wait(_EVERY_S)
            with self._lock:
                parts, self._waiting = self._waiting, []
            try:
                if parts:
                    self._write(joined(parts))
            except (DvsvizError, OSError) as error:
                self._error = error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None):
        if error is None:
            self.close()
        else:
            # What is already on its way is the error to tell.
            self._end.set()
            self._thread.join()
