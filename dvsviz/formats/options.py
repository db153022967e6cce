"""What a user may say about a recording when it is opened."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenOptions:
    """Options of reading events, whatever the format.

    Attributes:
        size: sensor (width, height), px, where the file does not say it.
        repair: drop and count what breaks the format instead of refusing the file.
        topic: which event topic of a bag.
        truth_topic: which topic of a bag holds the true poses.
        progress: called with the share done, 0 to 1, while a file is converted.
    """

    size: tuple[int, int] | None = None
    repair: bool = False
    topic: str | None = None
    truth_topic: str | None = None
    progress: Callable[[float], None] | None = None

    def report(self, share: float) -> None:
        """Tell the progress, if anybody asked for it."""
        if self.progress is not None:
            self.progress(min(1.0, max(0.0, share)))
