"""What the command line prints: results on standard output, everything else on standard error."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from dvsviz.cli.arguments import Opening
from dvsviz.events.recording import Recording


def print_json(value: Mapping[str, Any]) -> None:
    """Print one JSON object on standard output."""
    print(json.dumps(value, indent=2, ensure_ascii=False))


def print_fields(rows: Mapping[str, str]) -> None:
    """Print names and values as two columns."""
    width = max((len(name) for name in rows), default=0)
    for name, value in rows.items():
        print(f"{name:<{width}}  {value}")


def note(text: str) -> None:
    """Print a line on standard error."""
    print(f"dvsviz: {' '.join(text.split())}", file=sys.stderr)


def sessions_folder(folder: Path | None = None) -> Path:
    """Return where sessions are kept: as said, else DVSVIZ_SESSIONS, else `sessions` in the current folder."""
    return folder or Path(os.environ.get("DVSVIZ_SESSIONS") or "sessions")


@contextmanager
def share_bar(title: str) -> Iterator[Callable[[float], None]]:
    """Give a function that shows a share, 0 to 1, as a bar on standard error; nothing where that is no terminal."""
    if not sys.stderr.isatty():
        yield lambda share: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(title, total=1.0)
        yield lambda share: bar.update(task, completed=share)


def options_of(opening: Opening, *, filtered: bool = True) -> dict[str, Any]:
    """Return how a recording is opened as arguments of `open_recording`."""
    filters = opening.filters()
    return {
        "size": opening.size,
        "calibration": opening.calibration,
        "repair": opening.repair,
        "topic": opening.topic,
        "ground_truth": opening.ground_truth,
        "gt_offset_s": opening.gt_offset,
        "filters": filters if filtered and filters.is_active else None,
    }


def read_recording(path: Path, opening: Opening, *, filtered: bool = True) -> Recording:
    """Return the recording that is named, with a bar while it is converted; warnings go to standard error."""
    from dvsviz.formats.open import open_recording

    with share_bar(f"reading {path.name}") as show:
        recording = open_recording(path, **options_of(opening, filtered=filtered), progress=show)
    for warning in recording.warnings:
        note(f"warning: {path}: {warning}")
    return recording


class Interrupts:
    """Ctrl-C and SIGTERM: the first asks the run to stop after its window, the second stops at once.

    Before `begin` was called there is nothing to keep, and the first stops at once.
    """

    def __init__(self) -> None:
        self.cancel = threading.Event()
        self._begun = False
        self._before: dict[int, Any] = {}

    def begin(self) -> None:
        """From here on there is a run that can be stopped between two windows."""
        self._begun = True

    def __enter__(self) -> Interrupts:
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if not self._begun or self.cancel.is_set():
            raise KeyboardInterrupt
        self.cancel.set()
