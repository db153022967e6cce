"""A session as it is shown: its columns, pictures and numbers, safe to ask from several threads."""

from __future__ import annotations

import itertools
import threading
import time
from collections import OrderedDict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import DvsvizError
from dvsviz.evaluate.evaluate import WindowErrors, window_errors
from dvsviz.events.recording import Recording
from dvsviz.events.windows import EventWindow, make_window
from dvsviz.formats.hdf5_growing import GrowingEvents
from dvsviz.geometry import se3
from dvsviz.geometry.trajectory import Trajectory
from dvsviz.session.records import MapRevision, WindowResult
from dvsviz.session.registration import read_registration
from dvsviz.session.store import Session, StoredKeyframe
from dvsviz.view.captions import captions
from dvsviz.view.moving import true_motion

_AXES = (
    "rotation about x",
    "rotation about y",
    "rotation about z",
    "motion along x",
    "motion along y",
    "motion along z",
)
_MAPS_KEPT = 6
_ERRORS_EVERY_S = 2.0


class ShownSession:
    """One open session with its recording, where that is still there.

    Args:
        session: open.
        recording: what it was made of, or None.
        missing: why there is no recording, one sentence for people.
        name: what it is called here; its file's stem unless said.
    """

    _generations = itertools.count()

    def __init__(self, session: Session, recording: Recording | None, missing: str = "", *, name: str = "") -> None:
        self.name = name or session.name
        self.session = session
        self.recording = recording
        self.missing = missing
        self._lock = threading.RLock()
        # Frames that were registered: such a session has no events.
        is_frames = session.header.recording_format == "frames"
        self.registration = read_registration(session.path) if is_frames else None
        self._forget()
        self._look_up()

    def _forget(self) -> None:
        """Begin anew: the file is another one."""
        self.generation = next(self._generations)
        self._created = self.session.header.created
        self._has_truth = False
        self._revisions: list[tuple[int, int]] = []
        self._faces: list[tuple[NDArray[np.float64], int]] = []
        self._keyframes: tuple[StoredKeyframe, ...] = ()
        self._maps: OrderedDict[int, MapRevision] = OrderedDict()
        self._errors: WindowErrors | None = None
        self._errors_at = (-1, False, 0.0)
        self._window: EventWindow | None = None
        self._several: tuple[tuple[int, int, float], tuple[EventWindow, ...]] | None = None

    @property
    def window_count(self) -> int:
        """Windows that can be shown now."""
        return self.session.window_count

    def refresh(self) -> bool:
        """Read what was written since; return True where there are more windows or the session has ended."""
        with self._lock:
            before = (self.session.window_count, self.session.complete)
            self.session.refresh()
            replaced = self.session.header.created != self._created
            if replaced:
                self._forget()
            changed = replaced or before != (self.session.window_count, self.session.complete)
            if changed:
                self._look_up()
            return changed

    def set_recording(self, recording: Recording) -> None:
        """Give the recording, which was not there before: what was drawn without it is drawn again."""
        with self._lock:
            self.recording, self.missing = recording, ""
            self.generation = next(self._generations)

    def _look_up(self) -> None:
        """Keep what every picture asks for: which map holds from which window on, and the keyframes."""
        self._has_truth = self._has_truth or self.session.ground_truth is not None
        revisions = self.session.map_revisions
        self._revisions = [(m.window, m.revision) for m in revisions]
        # A face of a panorama keeps its plane; a plane that is refined is another one, and only the newest holds.
        is_panorama = '"motion": "rotation"' in self.session.header.config_json
        newest = {tuple(m.normal_world.tolist()): m for m in revisions} if is_panorama else {}
        self._faces = [(m.normal_world, m.revision) for m in newest.values()]
        self._keyframes = self.session.keyframes

    @property
    def has_truth(self) -> bool:
        """True where the session has ground truth."""
        return self._has_truth

    @property
    def keyframes(self) -> tuple[StoredKeyframe, ...]:
        """Keyframes in the order they were made; an image is read when it is asked for."""
        return self._keyframes

    def errors(self) -> WindowErrors:
        """Return the errors of the windows against ground truth; of a growing session, two seconds old at most."""
        with self._lock:
            count, complete, at = self._errors_at
            now = (self.session.window_count, self.session.complete)
            stale = (count, complete) != now and (now[1] or time.monotonic() - at > _ERRORS_EVERY_S)
            if self._errors is None or stale:
                self._errors = window_errors(self.session)
                self._errors_at = (*now, time.monotonic())
            return self._errors

    def plotted(self, start: int) -> dict[str, NDArray[Any]]:
        """Return the curves of windows from `start` on, by the names and kinds of the dashboard's protocol."""
        with self._lock:
            columns = self.session.columns()
            errors = self.errors() if self._has_truth else None
            first_us = self.session.header.first_us
        part = {name: np.asarray(values[start:]) for name, values in columns.items()}
        count = len(part["start_us"])

        def error(values: NDArray[np.float64] | None) -> NDArray[np.float32]:
            out = np.full(count, np.nan, dtype=np.float32)
            if values is not None:
                known = values[start : start + count]
                out[: len(known)] = known
            return out

        duration_us = np.maximum(1, part["end_us"] - part["start_us"])
        with np.errstate(divide="ignore", invalid="ignore"):
            gain = np.where(part["contrast_before"] > 0, part["contrast_after"] / part["contrast_before"], np.nan)
        return {
            "t_s": (part["start_us"] - first_us) * 1e-6,
            "status": part["status"].astype(np.uint8),
            "contrast_gain": gain.astype(np.float32),
            "overlap": part["overlap"].astype(np.float32),
            "event_rate_hz": ((part["end_event"] - part["first_event"]) * 1e6 / duration_us).astype(np.float32),
            "error_percent": error(errors.position_percent if errors else None),
            "error_deg": error(errors.rotation_deg if errors else None),
            "confidence": part["confidence"].astype(np.float32),
            "score": part["score"].astype(np.float32),
        }

    def poses(self) -> NDArray[np.float64]:
        """Return `Ts_world_camera` (N, 4, 4), refined where they were."""
        return self.session.Ts_world_camera(refined=True)

    def quaternions(self) -> NDArray[np.float64]:
        """Return the quaternions wxyz (N, 4) of `poses`."""
        return se3.quaternion_from_rotation(self.poses()[:, :3, :3])

    def statuses(self) -> NDArray[np.uint8]:
        """Return the windows' statuses (N,) as indices into `STATUSES`."""
        return self.session.column("status")

    def result(self, window: int) -> WindowResult:
        """Return the stored result of a window."""
        return self.session.result(window)

    def map_number(self, window: int) -> int:
        """Return the number of the map revision that held at a window; -1 before there is one."""
        return next((number for at, number in reversed(self._revisions) if at <= window), -1)

    def map_at(self, window: int) -> MapRevision | None:
        """Return the map that held at a window; the last few are kept."""
        number = self.map_number(window)
        return None if number < 0 else self._map(number)

    def _map(self, number: int) -> MapRevision:
        with self._lock:
            if number not in self._maps:
                self._maps[number] = self.session.map_revision(number)
                while len(self._maps) > _MAPS_KEPT:
                    self._maps.popitem(last=False)
            self._maps.move_to_end(number)
            return self._maps[number]

    def events_of(self, result: WindowResult) -> EventWindow | None:
        """Return a window's events, or None where the recording is gone."""
        if self.recording is None or not self._is_written(result.end_event):
            return None
        with self._lock:
            if self._window is not None and self._window.index == result.window:
                return self._window
            events = self.recording.events.read(result.first_event, result.end_event)
            if len(events) == 0:
                return None
            self._window = make_window(
                self.session.header.camera,
                events,
                index=result.window,
                first_event=result.first_event,
                end_us=result.end_us,
            )
            return self._window

    def _is_written(self, end_event: int) -> bool:
        """Wait a moment, unlocked, for the events of a stream that are still on their way to its recording."""
        events = None if self.recording is None else self.recording.events
        return not isinstance(events, GrowingEvents) or events.wait(end_event)

    def map_now(self) -> int:
        """Return the number of the newest map revision, the one that belongs with the refined poses; -1 without."""
        return self._revisions[-1][1] if self._revisions else -1

    def newest_map(self, T_world_camera: NDArray[np.float64] | None = None) -> MapRevision | None:
        """Return the newest map: plane and texture fit the poses as they are known now.

        Args:
            T_world_camera: a pose (4, 4) that looks at it: of a panorama that face is taken.
        """
        number = self.map_now()
        if T_world_camera is not None and self._faces:
            number = self._faces[int(np.argmin([n @ T_world_camera[:3, 2] for n, _ in self._faces]))][1]
        return None if number < 0 else self._map(number)

    def faces(self) -> tuple[MapRevision, ...]:
        """Return the newest revision of each face of a panorama, in the order the faces were made; none of a plane."""
        return tuple(self.session.map_revision(number) for _, number in self._faces)

    def events_from(self, window: int, count: int, ms: float) -> tuple[EventWindow, ...]:
        """Return the events of `count` windows from one on, or of so many milliseconds; none where they are gone.

        Args:
            window: the first window.
            count: how many windows.
            ms: length in milliseconds instead; 0 for whole windows.
        """
        first = self.result(window)
        if self.recording is None:
            return ()
        if count == 1 and not ms:
            events = self.events_of(first)
            return () if events is None else (events,)
        self._is_written(int(self.session.column("end_event")[min(window + count, self.window_count) - 1]))
        with self._lock:
            if self._several is not None and self._several[0] == (window, count, ms):
                return self._several[1]
            columns = self.session.columns()
            starts, stop_us = columns["start_us"], int(first.start_us + 1000 * ms)
            last = int(np.searchsorted(starts, stop_us)) if ms else window + count
            parts: list[EventWindow] = []
            for number in range(window, min(max(last, window + 1), len(starts))):
                begin, end = (int(columns[name][number]) for name in ("first_event", "end_event"))
                events = self.recording.events.read(begin, end)
                end_us = int(columns["end_us"][number])
                if ms:
                    events = events[: int(np.searchsorted(events.t_us, stop_us))]
                    end_us = min(end_us, stop_us)
                if len(events):
                    camera = self.session.header.camera
                    parts.append(make_window(camera, events, index=number, first_event=begin, end_us=end_us))
            self._several = ((window, count, ms), tuple(parts))
            return self._several[1]

    def values(self, window: int) -> dict[str, Any]:
        """Return the numbers beside a window's images, ready for JSON (None where one is not known).

        The pose is the refined one, that of the evaluation, the trajectory and the picture on the map.
        """
        r = self.result(window)
        T = self.poses()[window]
        with self._lock:
            truth = self.errors() if self._has_truth else None
            first_us = self.session.header.first_us
        known = truth is not None and window < len(truth.position_percent)
        return {
            "status": str(r.status),
            "t_s": (r.start_us - first_us) * 1e-6,
            **_pose_values(T),
            "refined": not np.array_equal(T, r.T_world_camera),
            "omega": _numbers(r.omega),
            "velocity": _numbers(r.velocity),
            "truth": _truth_values(truth.truth_world, r.start_us, r.end_us) if truth else None,
            "events": r.end_event - r.first_event,
            "event_rate_hz": _number(r.event_rate_hz),
            "contrast_before": _number(r.contrast_before),
            "contrast_after": _number(r.contrast_after),
            "overlap": _number(r.overlap),
            "score": _number(r.score),
            "confidence": _number(r.confidence),
            "condition": _number(r.condition),
            "weak": weak_words(r.weak_direction),
            "duration_ms": (r.end_us - r.start_us) * 1e-3,
            "error_percent": _number(truth.position_percent[window]) if truth and known else None,
            "error_deg": _number(truth.rotation_deg[window]) if truth and known else None,
            "keyframe": r.keyframe,
            "map_revision": r.map_revision,
            "note": r.note if self.recording is not None else self.missing,
            **({} if self.registration is None else captions(self.registration, window)),
        }


def check_recording(session: Session, recording: Recording) -> None:
    """Refuse a recording that is not the one a session was made of.

    Raises:
        DvsvizError: sensor size or number of events differ.
    """
    camera = session.header.camera
    if (recording.camera.width, recording.camera.height) != (camera.width, camera.height):
        raise DvsvizError("the recording has another sensor size than the session", path=recording.path)
    count, header = recording.events.count, session.header
    # A stream may have gone on after its last window.
    same = count == header.events
    if header.is_stream:
        same = count >= session.extent[0] and recording.first_us == header.first_us
    if not same:
        raise DvsvizError("the recording has changed since it was tracked", path=recording.path)


def weak_words(direction: NDArray[np.float64]) -> str:
    """Return the direction that the texture shows least in words, "" where none is known.

    Args:
        direction: unit vector (6,) over (omega, v).
    """
    size = np.abs(direction)
    if not np.all(np.isfinite(size)) or size.max() < 1e-6:
        return ""
    # Axes with half the strength of the strongest belong to it: such a direction is usually a pair that trades off.
    order = [int(i) for i in np.argsort(size)[::-1] if size[i] >= 0.5 * size.max()]
    return " and ".join(_AXES[i] for i in order[:2])


def _pose_values(T_world_camera: NDArray[np.float64]) -> dict[str, Any]:
    return {
        "position": _numbers(T_world_camera[:3, 3]),
        "quaternion_wxyz": _numbers(se3.quaternion_from_rotation(T_world_camera[:3, :3])),
    }


def _truth_values(truth: Trajectory | None, start_us: int, end_us: int) -> dict[str, Any] | None:
    """Return the true pose in the session's world, and the true velocities over the window in the camera frame."""
    motion = None if truth is None else true_motion(truth, start_us, end_us)
    if motion is None:
        return None
    T, omega, velocity = motion
    return _pose_values(T) | {"omega": _numbers(omega), "velocity": _numbers(velocity)}


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _numbers(values: NDArray[np.float64]) -> list[float | None]:
    return [_number(v) for v in values]
