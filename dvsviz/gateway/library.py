"""The sessions there are, by name. A name that a browser sends is looked up here, never made part of a path.

Branches that were tried and are not kept lie in a folder of their own inside the sessions' folder.
"""

from __future__ import annotations

import json
import logging
import threading
import time
from collections import OrderedDict
from pathlib import Path
from typing import Any

from dvsviz.errors import DvsvizError, SessionError
from dvsviz.events.filters import FilterConfig
from dvsviz.events.recording import Recording
from dvsviz.formats.hdf5_growing import GrowingEvents, open_growing
from dvsviz.formats.hdf5_writer import growing_path
from dvsviz.formats.open import open_recording
from dvsviz.gateway.entries import origin_of, read_entry, rounded, waiting_entry
from dvsviz.gateway.runs import Runs
from dvsviz.session.records import STATUSES
from dvsviz.session.store import Session, open_session
from dvsviz.view.shown import ShownSession, check_recording

_log = logging.getLogger(__name__)

BRANCHES = "branches"

_KEPT_OPEN = 6
_LOOK_EVERY_S = 1.0


class Library:
    """Session files of one folder and single files beside it, opened when they are looked at.

    Args:
        sessions_dir: every session file in it is listed.
        runs: sessions that are being made.
    """

    def __init__(self, sessions_dir: Path, runs: Runs) -> None:
        self._folder, self._runs = sessions_dir, runs
        self._lock = threading.RLock()
        self._single: dict[str, Path] = {}
        self._paths: dict[str, Path] = {}
        self._entries: dict[Path, tuple[tuple[int, int, bool], dict[str, Any] | None]] = {}
        self._open: OrderedDict[str, ShownSession] = OrderedDict()
        self._opening: dict[str, threading.Lock] = {}
        self._recordings: list[Path] = []
        # When the recording of a stream was looked for, by session.
        self._looked_s: dict[str, float] = {}
        self.scan()

    @property
    def folder(self) -> Path:
        """Where sessions are listed and written."""
        return self._folder

    def path(self, name: str) -> Path:
        """Return the file of a session.

        Raises:
            KeyError: there is no session of that name.
        """
        with self._lock:
            if name not in self._paths:
                self.scan()
            return self._paths[name]

    def free_name(self, wanted: str) -> str:
        """Return a name that no session and no run has: the wanted one, or with a number behind it."""
        name, number = wanted, 2
        while not self.is_free(name):
            name, number = f"{wanted} {number}", number + 1
        return name

    def is_free(self, name: str) -> bool:
        """Return whether neither a session nor a run has a name."""
        with self._lock:
            self.scan()
            there = name in self._paths or any((place / f"{name}.h5").exists() for place in self._places())
        run = self._runs.get(name)
        return not there and (run is None or not run.is_open)

    def drop(self, name: str) -> None:
        """Forget an open session: its file is gone or has another name."""
        with self._lock:
            path = self._paths.get(name)
            self._open.pop(name, None)
            self._single = {key: value for key, value in self._single.items() if key != name}
            if path is not None:
                self._entries.pop(path, None)
            self.scan()

    def recordings(self) -> list[Path]:
        """Return where the recordings of the sessions and runs lie, as far as they are known."""
        with self._lock:
            entries = [entry for _, entry in self._entries.values() if entry is not None]
            return [*self._recordings, *(Path(entry["recording_path"]) for entry in entries)]

    def _places(self) -> tuple[Path, Path]:
        return self._folder, self._folder / BRANCHES

    def add_session(self, path: Path) -> str:
        """List a session file that lies somewhere else and return the name it got."""
        with self._lock:
            inside = path.resolve().parent == self._folder.resolve()
            name = path.stem
            number = 2
            while not inside and (name in self._single or (self._folder / f"{name}.h5").exists()):
                name, number = f"{path.stem}-{number}", number + 1
            if not inside:
                self._single[name] = path
            self.scan()
            return name

    def add_recording(self, path: Path) -> None:
        """Remember where a recording lies; sessions that were made of it elsewhere find it there."""
        self._recordings.append(path)

    def scan(self) -> None:
        """Look which files there are."""
        found: dict[str, Path] = {}
        for place in reversed(self._places()):  # a session before a branch of the same name
            found |= {path.stem: path for path in sorted(place.glob("*.h5"))} if place.is_dir() else {}
        with self._lock:
            self._paths = found | {name: path for name, path in self._single.items() if path.exists()}

    def entries(self) -> list[dict[str, Any]]:
        """Return what the list of sessions shows, newest first, queued runs last; other files are left out."""
        with self._lock:
            paths = dict(self._paths)
        found = ((name, self._entry(name, path)) for name, path in paths.items())
        entries = [entry | {"name": name, "run": self._run_of(name)} for name, entry in found if entry is not None]
        known = {entry["name"] for entry in entries}
        runs = [run for run in self._runs.without_session() if run.order.name not in known]
        waiting = [waiting_entry(run) | {"run": self._run_of(run.order.name)} for run in runs]
        return [*sorted(entries, key=lambda entry: entry["created"], reverse=True), *waiting]

    def open(self, name: str) -> ShownSession:
        """Return a session by its name; opened the first time.

        Raises:
            KeyError: there is no session of that name.
            SessionError: the file is damaged.
        """
        with self._lock:
            path = self._paths.get(name)
            if path is None:
                self.scan()
                path = self._paths[name]
            guard = self._opening.setdefault(name, threading.Lock())
        with guard:
            with self._lock:
                shown = self._open.get(name)
                if shown is not None:
                    self._open.move_to_end(name)
                    return shown
            shown = self._opened(name, path)
            with self._lock:
                self._open[name] = shown
                while len(self._open) > _KEPT_OPEN:
                    self._open.popitem(last=False)
            return shown

    def opened(self, name: str) -> ShownSession | None:
        """Return a session that is open, without waiting, or None."""
        return self._open.get(name)

    def all_open(self) -> list[ShownSession]:
        """Return the sessions that are open."""
        with self._lock:
            return list(self._open.values())

    def state(self, shown: ShownSession) -> str:
        """Return `complete`, `live` or `incomplete`."""
        return shown.session.state(shown.refresh)

    def progress(self, shown: ShownSession) -> dict[str, float | None]:
        """Return how far a growing session is: what its run tells, or what is stored where another program writes."""
        run = self._runs.get(shown.name)
        told: dict[str, float | None] = dict.fromkeys(("share", "events_per_second", "lag_s", "real_time_factor"))
        events = shown.session.header.events
        if events and shown.window_count:
            told["share"] = min(1.0, int(shown.session.column("end_event")[-1]) / events)
        return told | run.progress if run is not None and run.is_active else told

    def _run_of(self, name: str) -> dict[str, Any] | None:
        """Return where the run of a session stands, or None where none waits or is going on."""
        run = self._runs.get(name)
        if run is None or not run.is_open:
            return None
        told = {key: rounded(run.progress.get(key)) for key in ("share", "events_per_second", "lag_s")}
        return {"state": str(run.state), "stage": str(run.stage), "before": self._runs.place(run), **told}

    def describe(self, shown: ShownSession) -> dict[str, Any]:
        """Return what the page needs to know about an open session, once."""
        session = shown.session
        header = session.header
        # Before what it counts: a session that has ended is told whole.
        state = self.state(shown)
        events, last_us = session.extent
        return {
            "name": shown.name,
            "recording": header.recording_name,
            "format": header.recording_format,
            "windows": session.window_count,
            "state": state,
            "t0_us": header.first_us,
            "duration_s": (last_us - header.first_us) * 1e-6 if header.is_stream else header.part_s[1],
            "events": events,
            "width": header.camera.width,
            "height": header.camera.height,
            "camera": {
                name: getattr(header.camera, name) for name in ("fx", "fy", "cx", "cy", "distortion", "is_guess")
            },
            "statuses": [str(status) for status in STATUSES],
            "keyframes": [{"keyframe": k.keyframe, "window": k.window} for k in shown.keyframes],
            "failures": [
                {"cause": str(f.cause), "start": f.start, "end": f.end, "worst": f.worst, "message": f.message}
                for f in session.failures
            ],
            "log": [{"window": e.window, "level": e.level, "text": e.text} for e in session.log],
            "bookmarks": bookmarks_of(shown),
            "tags": list(session.tags),
            "map_revisions": [
                {"revision": m.revision, "window": m.window, "width": m.columns, "height": m.rows}
                for m in session.map_revisions
            ],
            "ground_truth": shown.has_truth,
            "recording_found": shown.recording is not None,
            "recording_path": header.recording_path,
            "recording_note": shown.missing,
            "config": json.loads(header.config_json),
            "filters": None if header.filters_json is None else json.loads(header.filters_json),
            "origin": origin_of(header),
            "run": self._run_of(shown.name),
            "seed": header.seed,
            "created": header.created,
            "program_version": header.program_version,
            "summary": session.summary,
            "evaluation": (session.summary or {}).get("evaluation"),
            "progress": self.progress(shown),
        }

    def _opened(self, name: str, path: Path) -> ShownSession:
        session = open_session(path)
        # Registered frames are kept in the session itself.
        is_frames = session.header.recording_format == "frames"
        recording, missing = (None, "") if is_frames else self._recording_of(session)
        return ShownSession(session, recording, missing, name=name)

    def look_for_recording(self, shown: ShownSession) -> bool:
        """Return whether the recording of a stream is another one now, once a second: it grows, then it is whole."""
        header = shown.session.header
        before = shown.recording
        if not header.is_stream or (before is not None and not isinstance(before.events, GrowingEvents)):
            return False
        if time.monotonic() - self._looked_s.get(shown.name, 0.0) < _LOOK_EVERY_S:
            return False
        self._looked_s[shown.name] = time.monotonic()
        if before is not None and shown.session.is_live:
            return False
        recording, why = self._recording_of(shown.session)
        if recording is None:
            # What could be read while it was written can be read on.
            shown.missing = why if before is None else ""
            return False
        shown.set_recording(recording)
        return True

    def _recording_of(self, session: Session) -> tuple[Recording | None, str]:
        """Return a session's recording, or None and why."""
        header = session.header
        stored = Path(header.recording_path)
        near = [session.path.parent / stored.name, *(p for p in self._recordings if p.name == stored.name)]
        why = f"the recording is not there any more (it was {stored}): images need its events"
        if header.is_stream and not stored.is_absolute():
            why = "the stream was not recorded (--record FILE): images need its events"
        elif header.is_stream and session.is_live:
            growing = open_growing(stored, header.camera)
            return growing, "" if growing else f"the stream is being recorded ({stored}): images come in the end"
        for path in dict.fromkeys([stored, *near]):
            is_there = path.exists() or growing_path(path).is_file()
            if not is_there or path.resolve() == session.path.resolve():
                continue
            for repair in (False, True):  # a recording that was repaired for tracking is repaired again
                try:
                    recording = open_recording(
                        path,
                        size=(header.camera.width, header.camera.height),
                        repair=repair,
                        filters=None
                        if header.filters_json is None
                        else FilterConfig.from_json(header.filters_json),
                    )
                    check_recording(session, recording)
                except (DvsvizError, OSError) as error:
                    why = str(error)
                else:
                    return recording, ""
        return None, why

    def _entry(self, name: str, path: Path) -> dict[str, Any] | None:
        try:
            stat = path.stat()
            run = self._runs.get(name)
            mark = (stat.st_mtime_ns, stat.st_size, run is not None and run.is_active)
            known = self._entries.get(path)
            # A session whose writer was killed does not change its file when it stops being live.
            if known is not None and known[0] == mark and (known[1] is None or known[1]["state"] != "live"):
                return known[1]
            entry = read_entry(name, path, kept=path.parent != self._folder / BRANCHES)
        except OSError:
            return None  # the file went away between listing and reading
        except SessionError as error:
            _log.info("not listed: %s", error)
            entry = None
        self._entries[path] = (mark, entry)
        return entry


def bookmarks_of(shown: ShownSession) -> list[dict[str, Any]]:
    """Return a session's bookmarks in the order of their windows."""
    found = sorted(shown.session.bookmarks, key=lambda mark: mark.window)
    return [{"bookmark": b.bookmark, "window": b.window, "text": b.text} for b in found]
