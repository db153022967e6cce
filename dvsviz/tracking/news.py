"""News: what a tracker has to tell since it was last asked."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dvsviz.session.records import Failure, Keyframe, LogEntry, MapRevision, RefinedPoses, TrackerUpdates

Array = NDArray[np.float64]


class News:
    """Collects what is told, and hands it over once."""

    def __init__(self) -> None:
        self._keyframes: list[Keyframe] = []
        self._revisions: list[MapRevision] = []
        self._refined: list[RefinedPoses] = []
        self._log: list[LogEntry] = []
        self._failures: list[Failure] = []

    def log(self, window: int, level: str, text: str) -> None:
        """Add a line to the log of events."""
        self._log.append(LogEntry(window=window, level=level, text=text))

    def tell_keyframes(self, keyframes: Sequence[Keyframe]) -> None:
        """Hand over new keyframes."""
        self._keyframes.extend(keyframes)

    def tell_revision(self, revision: MapRevision) -> None:
        """Hand over a new revision of the map."""
        self._revisions.append(revision)

    def tell_refined(self, poses: Sequence[tuple[int, Array]]) -> None:
        """Hand over better poses (4, 4), at their windows' starts, of windows by their numbers."""
        if poses:
            self._refined.append(
                RefinedPoses(
                    windows=np.array([k for k, _ in poses], dtype=np.int64),
                    Ts_world_camera=np.stack([T for _, T in poses]),
                )
            )

    def tell(self, failure: Failure) -> None:
        """Hand over a failure that has ended."""
        self._failures.append(failure)

    def take_updates(self) -> TrackerUpdates:
        """Return and forget what is new."""
        updates = TrackerUpdates(
            keyframes=tuple(self._keyframes),
            map_revisions=tuple(self._revisions),
            refined=tuple(self._refined),
            log=tuple(self._log),
            failures=tuple(self._failures),
        )
        News.__init__(self)
        return updates
