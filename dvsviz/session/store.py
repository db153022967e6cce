"""Reading sessions that are finished, growing or were killed. The writer and the edits are offered here too."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from dvsviz.geometry.trajectory import Trajectory
from dvsviz.session import schema
from dvsviz.session.cache import SessionCache
from dvsviz.session.edits import add_bookmark, check_name, delete, delete_bookmark, rename, set_tags
from dvsviz.session.header import Origin, SessionHeader
from dvsviz.session.lock import has_writer
from dvsviz.session.packing import decode_png, unpack_state
from dvsviz.session.reading import damaged
from dvsviz.session.records import STATUSES, Failure, Keyframe, LogEntry, MapRevision, Status, WindowResult
from dvsviz.session.stored import Bookmark, StoredKeyframe, StoredMapRevision
from dvsviz.session.writer import SessionWriter

__all__ = [
    "Bookmark",
    "Origin",
    "Session",
    "SessionHeader",
    "SessionWriter",
    "StoredKeyframe",
    "StoredMapRevision",
    "add_bookmark",
    "check_name",
    "delete",
    "delete_bookmark",
    "open_session",
    "rename",
    "set_tags",
]

Poses = Literal["refined", "online"]
Choice = TypeVar("Choice")
_NO_POSE = tuple(STATUSES.index(status) for status in (Status.LOST, Status.RELOCALIZING))
# Follow from stored columns.
_DERIVED = ("window", "contrast_gain", "event_rate_hz")
_STORED = tuple(column.name for column in schema.WINDOWS.columns)


def open_session(path: Path | str) -> Session:
    """Return a session that is finished, being written by any thread or process, or was killed.

    Raises:
        SessionError: no such file, not a session, a later version, cut off or damaged.
    """
    return Session(Path(path))


class Session:
    """What was stored of one run, as of the last `refresh`; may be used from several threads."""

    def __init__(self, path: Path) -> None:
        """Read header and size of a session; `open_session` is the way to get one."""
        self.path = path
        self._cache = SessionCache(path)
        self._refined: tuple[int, int, NDArray[np.float64]] = (-1, 0, np.zeros((0, 4, 4)))

    def refresh(self) -> int:
        """Look for what was added since, by whomever, and return the number of windows.

        Raises:
            SessionError: the file is gone or damaged.
        """
        self._cache.refresh()
        return self.window_count

    def close(self) -> None:
        """Do nothing: the file is not held open between calls."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def name(self) -> str:
        """The file's stem."""
        return self.path.stem

    @property
    def header(self) -> SessionHeader:
        """What was run."""
        if self._cache.header is None:
            raise damaged(self.path, "no header")
        return self._cache.header

    @property
    def complete(self) -> bool:
        """True where the run ended and its writer closed the session."""
        return self._cache.commit.complete

    @property
    def is_live(self) -> bool:
        """True where a writer is at work: what is neither complete nor live was interrupted."""
        return not self.complete and has_writer(self.path)

    def state(self, refresh: Callable[[], object] | None = None) -> str:
        """Return `complete`, `live` or `incomplete`: before what is counted, for then all that an ended run left is.

        Args:
            refresh: how the session is read again; `self.refresh` unless said.
        """
        if not self.complete and not self.is_live:
            # Its writer may have closed it since it was last read.
            (refresh or self.refresh)()
        return "complete" if self.complete else "live" if self.is_live else "incomplete"

    @property
    def window_count(self) -> int:
        """Windows stored, as of the last refresh."""
        return self._cache.commit.counts[schema.WINDOWS.name]

    @property
    def extent(self) -> tuple[int, int]:
        """Events of the recording and its last time, us; of a stream, as far as its windows reach by now."""
        header = self.header
        if not header.is_stream or self.window_count == 0:
            return header.events, header.last_us
        return int(self.column("end_event")[-1]), int(self.column("end_us")[-1])

    @property
    def summary(self) -> dict[str, Any] | None:
        """What the run found, or None where it did not end or said nothing."""
        texts = self._cache.texts(schema.SUMMARIES) if self.complete else []
        return self._json(texts[-1], dict) if texts else None

    def column(self, name: str) -> NDArray:
        """Return one column (N, …) of `columns`, read-only; of the file only what it needs is read."""
        if name == "window":
            return np.arange(self.window_count)
        if name == "contrast_gain":
            rows = self._cache.rows(schema.WINDOWS, ("contrast_before", "contrast_after"))
            before, after = rows["contrast_before"], rows["contrast_after"]
            return np.divide(after, before, out=np.full(len(after), np.nan), where=before > 0)
        if name == "event_rate_hz":
            rows = self._cache.rows(schema.WINDOWS, ("first_event", "end_event", "start_us", "end_us"))
            duration_us = np.maximum(1, rows["end_us"] - rows["start_us"])
            return (rows["end_event"] - rows["first_event"]) * 1e6 / duration_us
        if name not in _STORED:
            raise ValueError(f"name: expected one of {', '.join(_STORED + _DERIVED)}, got {name!r}")
        return self._cache.rows(schema.WINDOWS, (name,))[name]

    def columns(self) -> dict[str, NDArray]:
        """Return every number of every window, by `WindowResult`'s names; arrays are read-only.

        `status` holds indices into `records.STATUSES`. Besides: `window`, `contrast_gain`, `event_rate_hz`.
        Called again it reads new rows only.
        """
        with self._cache.lock:
            return self._cache.rows(schema.WINDOWS) | {name: self.column(name) for name in _DERIVED}

    def result(self, window: int) -> WindowResult:
        """Return one window's result; its pose is the one known at the time.

        Raises:
            ValueError: there is no such window.
        """
        if not 0 <= window < self.window_count:
            raise ValueError(f"window: expected 0 to {self.window_count - 1}, got {window}")
        rows = self._cache.rows(schema.WINDOWS)
        values: dict[str, Any] = {
            name: array[window].item() if array.ndim == 1 else array[window] for name, array in rows.items()
        }
        values["status"] = self._choice(STATUSES, values["status"], "status")
        return WindowResult(window=window, note=self._note(window), **values)

    def _note(self, window: int) -> str:
        found = np.flatnonzero(self._cache.rows(schema.NOTES)["window"] == window)
        return self._cache.texts(schema.NOTES)[int(found[-1])] if len(found) else ""

    def Ts_world_camera(self, refined: bool = True) -> NDArray[np.float64]:
        """Return every window's pose (N, 4, 4): as last refined, or as known at the time; read-only."""
        with self._cache.lock:
            online = self.column("T_world_camera")
            if not refined:
                return online
            rows = self._cache.rows(schema.REFINED_POSES)
            generation, done, poses = self._refined
            if generation != self._cache.generation:
                done, poses = 0, np.zeros((0, 4, 4))
            if len(online) > len(poses) or len(rows["window"]) > done:
                poses = np.concatenate([poses, online[len(poses) :]])
                window, T = rows["window"][done:], rows["T_world_camera"][done:]
                if len(window) and not 0 <= window.min() <= window.max() < len(poses):
                    raise damaged(self.path, "a refined pose has no window")
                # Later rows win: assignment with repeated indices keeps the last.
                poses[window] = T
                poses.flags.writeable = False
                self._refined = (self._cache.generation, len(rows["window"]), poses)
            return poses

    def trajectory(self, poses: Poses = "refined", drop_lost: bool = True) -> Trajectory:
        """Return the poses over time, at the windows' starts.

        Args:
            poses: as last refined or as known at the time.
            drop_lost: leave out windows without a pose of their own: lost and relocalizing, unless a refinement gave
                them one afterwards, as where a second map was joined.
        """
        if poses not in ("refined", "online"):
            raise ValueError(f"poses: expected 'refined' or 'online', got {poses!r}")
        with self._cache.lock:
            t_us, Ts = self.column("start_us"), self.Ts_world_camera(refined=poses == "refined")
            keep = np.isfinite(Ts).all(axis=(1, 2))
            if drop_lost:
                lost = np.isin(self.column("status"), _NO_POSE)
                if poses == "refined":
                    lost[self._cache.rows(schema.REFINED_POSES)["window"]] = False
                keep &= ~lost
        t_us, Ts = t_us[keep], Ts[keep]
        # Windows that start in the same microsecond are one moment of a trajectory: the first is it.
        first = np.ones(len(t_us), bool)
        first[1:] = t_us[1:] > np.maximum.accumulate(t_us)[:-1]
        return Trajectory(t_us=t_us[first], Ts_world_camera=Ts[first])

    @property
    def keyframes(self) -> tuple[StoredKeyframe, ...]:
        """Keyframes in the order they were made; an image is read when it is asked for."""
        rows = self._cache.rows(schema.KEYFRAMES)
        return tuple(
            StoredKeyframe(
                keyframe=int(rows["keyframe"][i]),
                window=int(rows["window"][i]),
                t_us=int(rows["t_us"][i]),
                T_world_camera=rows["T_world_camera"][i],
                load=self._loader(f"keyframe {i}", int(rows["image_first"][i]), int(rows["image_count"][i])),
            )
            for i in range(len(rows["keyframe"]))
        )

    def keyframe(self, number: int) -> Keyframe:
        """Return a keyframe by its number, image and all.

        Raises:
            ValueError: there is no such keyframe.
        """
        found = next((k for k in self.keyframes if k.keyframe == number), None)
        if found is None:
            raise ValueError(f"number: there is no keyframe {number}")
        return Keyframe(
            keyframe=found.keyframe,
            window=found.window,
            t_us=found.t_us,
            T_world_camera=found.T_world_camera,
            image=found.image,
        )

    @property
    def map_revisions(self) -> tuple[StoredMapRevision, ...]:
        """Map revisions in the order they were made; a texture is read when it is asked for."""
        rows = self._cache.rows(schema.MAP_REVISIONS)
        return tuple(
            StoredMapRevision(
                revision=int(rows["revision"][i]),
                window=int(rows["window"][i]),
                rows=int(rows["rows"][i]),
                columns=int(rows["columns"][i]),
                origin=rows["origin"][i],
                px_per_unit=float(rows["px_per_unit"][i]),
                normal_world=rows["normal_world"][i],
                distance=float(rows["distance"][i]),
                place=(int(rows["image_first"][i]), int(rows["image_count"][i])),
                load=self._loader(f"map revision {i}", int(rows["image_first"][i]), int(rows["image_count"][i])),
            )
            for i in range(len(rows["revision"]))
        )

    def map_revision(self, number: int) -> MapRevision:
        """Return a map revision by its number, texture and all.

        Raises:
            ValueError: there is no such revision.
        """
        found = np.flatnonzero(self._cache.rows(schema.MAP_REVISIONS)["revision"] == number)
        if len(found) == 0:
            raise ValueError(f"number: there is no map revision {number}")
        return self._load_map(int(found[-1]))

    def map_at(self, window: int) -> MapRevision | None:
        """Return the map as it was after a window, or None before there was one."""
        found = np.flatnonzero(self._cache.rows(schema.MAP_REVISIONS)["window"] <= window)
        return self._load_map(int(found[-1])) if len(found) else None

    def _load_map(self, index: int) -> MapRevision:
        light = self.map_revisions[index]
        return MapRevision(
            revision=light.revision,
            window=light.window,
            texture=light.texture,
            origin=light.origin,
            px_per_unit=light.px_per_unit,
            normal_world=light.normal_world,
            distance=light.distance,
        )

    @property
    def failures(self) -> tuple[Failure, ...]:
        """Stretches of weak or lost windows that have ended."""
        rows, texts = self._cache.rows(schema.FAILURES), self._cache.texts(schema.FAILURES)
        return tuple(
            Failure(
                cause=self._choice(schema.CAUSES, int(rows["cause"][i]), "cause"),
                start=int(rows["start"][i]),
                end=int(rows["end"][i]),
                worst=int(rows["worst"][i]),
                message=text,
            )
            for i, text in enumerate(texts)
        )

    @property
    def log(self) -> tuple[LogEntry, ...]:
        """The log of events."""
        rows, texts = self._cache.rows(schema.LOG), self._cache.texts(schema.LOG)
        return tuple(
            LogEntry(
                window=int(rows["window"][i]),
                level=self._choice(schema.LEVELS, int(rows["level"][i]), "level"),
                text=text,
            )
            for i, text in enumerate(texts)
        )

    @property
    def bookmarks(self) -> tuple[Bookmark, ...]:
        """Bookmarks that were set and not deleted, by window."""
        rows, texts = self._cache.rows(schema.BOOKMARKS), self._cache.texts(schema.BOOKMARKS)
        found: dict[int, Bookmark] = {}
        for i, text in enumerate(texts):
            number = int(rows["bookmark"][i])
            if rows["deleted"][i]:
                found.pop(number, None)
            else:
                found[number] = Bookmark(bookmark=number, window=int(rows["window"][i]), text=text)
        return tuple(sorted(found.values(), key=lambda b: (b.window, b.bookmark)))

    @property
    def tags(self) -> tuple[str, ...]:
        """The session's tags."""
        texts = self._cache.texts(schema.TAGS)
        return tuple(str(tag) for tag in self._json(texts[-1], list)) if texts else ()

    @property
    def ground_truth(self) -> Trajectory | None:
        """The true trajectory in its own world, metres, or None."""
        rows = self._cache.rows(schema.GROUND_TRUTH)
        if len(rows["t_us"]) == 0:
            return None
        try:
            return Trajectory(t_us=rows["t_us"], Ts_world_camera=rows["T_world_camera"])
        except ValueError as error:
            raise damaged(self.path, f"ground truth: {error}") from error

    def checkpoint_at(self, window: int) -> tuple[int, dict[str, NDArray]] | None:
        """Return the last tracker state at or before a window, with its window, or None."""
        rows = self._cache.rows(schema.CHECKPOINTS)
        found = np.flatnonzero(rows["window"] <= window)
        if len(found) == 0:
            return None
        i = int(found[-1])
        data = self._cache.bytes("states", int(rows["state_first"][i]), int(rows["state_count"][i]))
        try:
            state = unpack_state(data, int(rows["unpacked_count"][i]), place=f"checkpoint {i}")
        except (ValueError, TypeError, KeyError) as error:
            raise damaged(self.path, str(error)) from error
        return int(rows["window"][i]), state

    def _loader(self, place: str, first: int, count: int):
        def load() -> NDArray[np.uint8]:
            try:
                return decode_png(self._cache.bytes("images", first, count), place=place)
            except ValueError as error:
                raise damaged(self.path, str(error)) from error

        return load

    def _json(self, text: str, kind: type[Choice]) -> Choice:
        try:
            value = json.loads(text)
        except ValueError as error:
            raise damaged(self.path, f"not JSON: {error}") from error
        if not isinstance(value, kind):
            raise damaged(self.path, f"expected a JSON {kind.__name__}, got {type(value).__name__}")
        return value

    def _choice(self, choices: tuple[Choice, ...], index: int, what: str) -> Choice:
        if index >= len(choices):
            raise damaged(self.path, f"{what} {index} is not known")
        return choices[index]
