"""What happens by itself: sessions grow, appear and end, and tabs are told."""

from __future__ import annotations

import logging
import threading
import time
from typing import Any

from dvsviz.errors import DvsvizError
from dvsviz.gateway.library import Library
from dvsviz.gateway.tabs import Tab, Tabs
from dvsviz.session.records import STATUSES
from dvsviz.view.shown import ShownSession

_log = logging.getLogger(__name__)

# Of an open session: how often it was replaced, its windows, its state and its run's progress.
_Told = tuple[int, int, str, dict[str, Any]]

_EVERY_S = 0.05
_LIST_EVERY_S = 1.0
_SCENE_EVERY_S = 0.5


class Watch(threading.Thread):
    """Looks for new windows twenty times a second, for new sessions once, and tells the tabs."""

    def __init__(self, library: Library, tabs: Tabs) -> None:
        super().__init__(name="watch", daemon=True)
        self.list: list[dict[str, Any]] = library.entries()
        self._library, self._tabs = library, tabs
        self._stop_now, self._look_now = threading.Event(), threading.Event()
        self._listing = threading.Lock()
        self._told: dict[str, _Told] = {}
        self._scene_at: dict[str, tuple[float, int]] = {}

    def run(self) -> None:
        """Watch until `stop`."""
        listed_s = 0.0
        while not self._stop_now.wait(_EVERY_S):
            for shown in self._library.all_open():
                try:
                    self._look_at(shown)
                except (DvsvizError, OSError, ValueError, IndexError, KeyError) as error:
                    # A session that is replaced by another has fewer windows than a moment ago.
                    _log.info("%s cannot be read: %s", shown.name, error)
            if self._look_now.is_set() or time.monotonic() - listed_s > _LIST_EVERY_S:
                self._look_now.clear()
                listed_s = time.monotonic()
                self.refresh_list()
                self._tabs.tidy()

    def refresh_list(self) -> None:
        """Look for sessions now, in this thread, and tell the tabs what is new."""
        # One at a time: what was read before a change must not replace what was read after it.
        with self._listing:
            self._library.scan()
            entries = self._library.entries()
            if entries == self.list:
                return
            self.list = entries
            for tab in self._tabs.all():
                tab.tell({"type": "sessions", "sessions": entries}, "sessions")

    def look(self) -> None:
        """Look for new sessions at once."""
        self._look_now.set()

    def stop(self) -> None:
        """End the thread."""
        self._stop_now.set()
        self.join(5.0)

    def _look_at(self, shown: ShownSession) -> None:
        known = self._told.get(shown.name)
        grew = shown.refresh()
        # The recording of a stream is whole when its run has ended, a moment after the session.
        grew = self._library.look_for_recording(shown) or grew
        if not grew and known is not None and known[2] == "complete":
            now = known
        else:
            state = self._library.state(shown)
            progress = self._library.progress(shown) if state == "live" else {}
            now = (shown.generation, shown.window_count, state, progress)
        # By tab: one that opened the session between two looks was never told what came meanwhile.
        behind = [tab for tab in self._tabs.all() if tab.shown is shown and tab.told != (shown.name, now)]
        if behind:
            self._tell_growth(shown, behind, now)
        beside = [
            tab for tab in self._tabs.all() if tab.shows_beside(shown) and tab.told_beside != (shown.name, now)
        ]
        if beside:
            self._tell_growth(shown, beside, now, beside=True)
        self._told[shown.name] = now
        if now is not known:
            self._grow_scenes(shown, ended=known is not None and now[2] != known[2])

    def _tell_growth(self, shown: ShownSession, tabs: list[Tab], now: _Told, *, beside: bool = False) -> None:
        _, _, state, progress = now
        statuses = shown.statuses()
        message = {
            "type": "grown",
            "session": shown.name,
            "windows": shown.window_count,
            "state": state,
            "status": str(STATUSES[statuses[-1]]) if len(statuses) else None,
            "progress": progress,
            "recording_found": shown.recording is not None,
        }
        for tab in tabs:
            if beside:
                tab.told_beside = (shown.name, now)
            else:
                tab.told = (shown.name, now)
            tab.tell(message, f"grown {shown.name}")

    def _grow_scenes(self, shown: ShownSession, *, ended: bool) -> None:
        at, count = self._scene_at.get(shown.name, (0.0, -1))
        if count == shown.window_count and not ended:
            return
        if time.monotonic() - at < _SCENE_EVERY_S and not ended:
            return
        for tab in self._tabs.all():
            if tab.shown is shown:
                tab.scene.grow(shown)
            elif tab.shows_beside(shown):
                tab.scene.trial.grow(shown)
        self._scene_at[shown.name] = (time.monotonic(), shown.window_count)
