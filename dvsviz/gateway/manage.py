"""What the page changes: runs that are started, sessions that are tried again, renamed, tagged, resumed, deleted."""

from __future__ import annotations

import base64
import threading
from pathlib import Path
from typing import Any

from dvsviz.errors import DvsvizError
from dvsviz.events.filters import FilterConfig
from dvsviz.events.recording import Recording
from dvsviz.gateway import wishes
from dvsviz.gateway.estimate import estimate
from dvsviz.gateway.library import BRANCHES, Library
from dvsviz.gateway.orders import RunOrder
from dvsviz.gateway.recordings import Reading, Recordings
from dvsviz.gateway.runs import Runs
from dvsviz.pipeline.branch import config_at
from dvsviz.session.store import check_name, delete, rename, set_tags
from dvsviz.view.shown import ShownSession
from dvsviz.view.trial import fit

_NAME_KEPT = 100


class Manager:
    """Carries out what the page asks for; every name and number is looked up, none becomes part of a path unchecked.

    Args:
        library: the sessions.
        runs: where runs are queued.
        recordings: what runs can be started on.
    """

    def __init__(self, library: Library, runs: Runs, recordings: Recordings) -> None:
        self._library, self._runs, self._recordings = library, runs, recordings
        # Two requests at once do not get the same name.
        self._lock = threading.Lock()

    def offer(self) -> dict[str, Any]:
        """Return the recordings that can be tracked and the settings that there are."""
        return {"recordings": self._recordings.list(self._library.recordings()), "config": wishes.config_fields()}

    def describe(self, number: str) -> dict[str, Any]:
        """Return what is known of a recording, or how far its reading is.

        Raises:
            KeyError: no recording has this number.
            DvsvizError: it cannot be opened.
        """
        recording = self._recordings.open(number)
        if isinstance(recording, Reading):
            return {"state": "reading", "share": recording.share}
        camera = recording.camera
        return {
            "state": "ready",
            "name": self._library.free_name(recording.name[:_NAME_KEPT]),
            "format": recording.format,
            "width": camera.width,
            "height": camera.height,
            "events": recording.events.count,
            "duration_s": recording.duration_s,
            "ground_truth": recording.ground_truth is not None,
            "warnings": list(recording.warnings),
            "camera": {
                **{name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy", "is_guess")},
                "distortion": list(camera.distortion),
            },
            "estimate": estimate(recording, self._library.entries(), self._library.folder),
        }

    def start(self, body: dict[str, Any]) -> str:
        """Queue a run of a recording and return its session's name.

        Raises:
            KeyError: no recording has this number.
            ValueError, DvsvizError: a value makes no sense, the name is taken or cannot be one.
        """
        number = wishes.text_from(body.get("recording"), "recording")
        recording = self._recordings.open(number)
        if isinstance(recording, Reading):
            raise DvsvizError("the recording is still being read", hint="wait a moment")
        start_s = wishes.seconds_from(body.get("start_s"), "start_s")
        end_s = wishes.seconds_from(body.get("end_s"), "end_s")
        if (start_s or 0.0) >= min(end_s if end_s is not None else float("inf"), recording.duration_s):
            raise ValueError(f"start_s, end_s: expected start before end, within {recording.duration_s:.3f} s")
        name = wishes.text_from(body.get("name"), "name").strip()
        check_name(name)
        with self._lock:
            if not self._library.is_free(name):
                raise DvsvizError(f"{name} is the name of a session already", hint="choose another")
            order = RunOrder(
                recording=self._recordings.path(number),
                out=self._library.folder / f"{name}.h5",
                config=wishes.config_from(body.get("config", {})),
                camera=wishes.camera_from(body.get("camera"), recording.camera),
                filters=wishes.filters_from(body.get("filters")),
                start_s=start_s,
                end_s=end_s,
            )
            self._library.add_recording(order.recording)
            self._runs.add(order)
        return name

    def try_again(self, shown: ShownSession, body: dict[str, Any]) -> str:
        """Queue a branch of a session and return its name.

        Raises:
            ValueError, DvsvizError: a value makes no sense, or the recording is gone.
        """
        header, window = shown.session.header, wishes.whole_from(body.get("window"), "window")
        if not 0 <= window < shown.window_count:
            raise ValueError(f"window: expected 0 to {shown.window_count - 1}, got {window}")
        pose = wishes.pose_from(body.get("pose"))
        if pose is not None and shown.session.map_at(window - 1) is None:
            raise ValueError("there is no map yet at this window: a pose can be given once there is one")
        config = wishes.config_from(body.get("config", {}), config_at(header, window))
        with self._lock:
            name = self._library.free_name(f"{shown.name[:_NAME_KEPT]} try")
            order = RunOrder(
                recording=self._recording_of(shown).path,
                out=self._library.folder / BRANCHES / f"{name}.h5",
                config=config,
                filters=None if header.filters_json is None else FilterConfig.from_json(header.filters_json),
                branch_of=shown.session.path,
                window=window,
                T_world_camera=pose,
            )
            self._runs.add(order)
        return name

    def resume(self, shown: ShownSession) -> None:
        """Queue the rest of a session that was interrupted.

        Raises:
            DvsvizError: it is complete, being written, or its recording is gone.
        """
        header = shown.session.header
        shown.refresh()
        if shown.session.complete:
            raise DvsvizError(f"{shown.name} is complete, there is nothing to resume")
        if shown.session.is_live:
            raise DvsvizError(f"{shown.name} is being written", hint="wait until that run has ended")
        filters = None if header.filters_json is None else FilterConfig.from_json(header.filters_json)
        recording = self._recording_of(shown)
        self._runs.add(RunOrder(recording=recording.path, out=shown.session.path, resume=True, filters=filters))

    def change(self, name: str, body: dict[str, Any]) -> str | None:
        """Carry out one change of a session: `{"do": "rename", "keep", "tag", "resume" or "delete", …}`.

        Returns:
            The session's name then, None where it is gone.

        Raises:
            KeyError: there is no such session.
            ValueError, DvsvizError: it cannot be done.
        """
        match body.get("do"):
            case "rename":
                return self.rename(name, wishes.text_from(body.get("name"), "name"))
            case "keep":
                return self.keep(name, wishes.text_from(body.get("name"), "name"))
            case "tag":
                self.tag(self._library.open(name), wishes.tags_from(body.get("tags")))
                return name
            case "resume":
                self.resume(self._library.open(name))
                return name
            case "delete":
                # Said again, so that a request that was meant for another session deletes nothing.
                if body.get("name") != name:
                    raise ValueError("name: expected the session's name, to delete it")
                self.delete(name)
                return None
        raise ValueError("do: expected one of rename, keep, tag, resume, delete")

    def preview(self, shown: ShownSession, body: dict[str, Any]) -> dict[str, Any]:
        """Return a window's events on the map as they would lie from another pose.

        Raises:
            ValueError: there is no such window, no such pose, or no map yet.
            DvsvizError: the recording is gone.
        """
        window, pose = wishes.whole_from(body.get("window"), "window"), wishes.pose_from(body.get("pose"))
        if pose is None:
            raise ValueError("pose: expected one")
        seen = fit(shown, window, pose)
        return {"png": base64.b64encode(seen.picture.png()).decode(), "explained": seen.explained}

    def rename(self, name: str, wanted: str) -> str:
        """Give a session another name and return it.

        Raises:
            KeyError: there is no such session.
            DvsvizError: the name cannot be one or is taken, or the session is being written.
        """
        path, wanted = self._rested(name), wanted.strip()
        return name if wanted == name else self._moved(name, path, wanted, path.parent)

    def keep(self, name: str, wanted: str) -> str:
        """Make a branch a session like the others, and return its name.

        Raises:
            KeyError: there is no such session.
            DvsvizError: it is kept already, the name cannot be one or is taken, or it is being written.
        """
        path = self._rested(name)
        if path.parent != self._library.folder / BRANCHES:
            raise DvsvizError(f"{name} is kept already")
        return self._moved(name, path, wanted.strip(), self._library.folder)

    def tag(self, shown: ShownSession, tags: tuple[str, ...]) -> None:
        """Replace a session's tags.

        Raises:
            DvsvizError: it is being written.
        """
        self._rested(shown.name)
        set_tags(shown.session.path, tags)
        shown.refresh()

    def delete(self, name: str) -> None:
        """Delete a session's file, or forget a run that failed; no recording is deleted.

        Raises:
            KeyError: there is no such session.
            DvsvizError: it is being written, or a branch is being made of it.
        """
        run = self._runs.get(name)
        try:
            path = self._rested(name)
        except KeyError:
            if run is None:
                raise
            self._runs.forget(name)
            return
        delete(path)
        self._runs.forget(name)
        self._library.drop(name)

    def _rested(self, name: str) -> Path:
        """Return the file of a session that nobody writes or waits for."""
        run = self._runs.get(name)
        if run is not None and run.is_open:
            words = "waits for its turn" if not run.is_active else "is being tracked"
            raise DvsvizError(f"{name} {words}", hint="stop that run first")
        try:
            path = self._library.path(name)
        except KeyError:
            raise KeyError("there is no session of this name") from None
        for other in self._runs.all_open():
            if other.order.branch_of is not None and other.order.branch_of == path:
                raise DvsvizError(
                    f"{other.order.name} is being made of {name}", hint="wait until that run has ended"
                )
        return path

    def _moved(self, name: str, path: Path, wanted: str, folder: Path) -> str:
        check_name(wanted)
        with self._lock:
            if wanted != name and not self._library.is_free(wanted):
                raise DvsvizError(f"{wanted} is the name of a session already", hint="choose another")
            moved = rename(path, wanted, folder=folder)
            is_elsewhere = moved.resolve().parent not in (
                self._library.folder.resolve(),
                (self._library.folder / BRANCHES).resolve(),
            )
            self._runs.forget(name)
            self._library.drop(name)
            return self._library.add_session(moved) if is_elsewhere else wanted

    def _recording_of(self, shown: ShownSession) -> Recording:
        if shown.recording is None:
            raise DvsvizError(shown.missing or "the recording is not there any more")
        return shown.recording
