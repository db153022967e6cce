"""A session as it is shown: its columns, pictures and numbers, safe to ask from several threads."""

from __future__ import annotations

import itertools
import threading
import time
from collections import OrderedDict
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import DvsvizError
from dvsviz.evaluate.evaluate import WindowErrors, window_errors
from dvsviz.events.recording import Recording
from dvsviz.events.windows import EventWindow, make_window
from dvsviz.geometry import se3
from dvsviz.geometry.trajectory import Trajectory
from dvsviz.session.records import MapRevision, WindowResult
from dvsviz.session.store import Session, StoredKeyframe
from dvsviz.view import images
from dvsviz.view.images import ImageOptions
from dvsviz.view.picture import Picture

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
_TRUTH_STEP_US = 20_000


class ImageKind(StrEnum):
    """What can be drawn of a window."""

    RAW = "raw"
    WARPED = "warped"
    MAP = "map"
    TEXTURE = "texture"


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
        self._forget()
        self._look_up()

    def _forget(self) -> None:
        """Begin anew: the file is another one."""
        self.generation = next(self._generations)
        self._created = self.session.header.created
        self._has_truth = False
        self._revisions: list[tuple[int, int]] = []
        self._keyframes: tuple[StoredKeyframe, ...] = ()
        self._maps: OrderedDict[int, MapRevision] = OrderedDict()
        self._errors: WindowErrors | None = None
        self._errors_at = (-1, False, 0.0)
        self._window: EventWindow | None = None

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

    def _look_up(self) -> None:
        """Keep what every picture asks for: which map holds from which window on, and the keyframes."""
        self._has_truth = self._has_truth or self.session.ground_truth is not None
        self._revisions = [(m.window, m.revision) for m in self.session.map_revisions]
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
        if self.recording is None:
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

    def map_now(self) -> int:
        """Return the number of the newest map revision, the one that belongs with the refined poses; -1 without."""
        return self._revisions[-1][1] if self._revisions else -1

    def newest_map(self) -> MapRevision | None:
        """Return the newest map: plane and texture fit the poses as they are known now."""
        number = self.map_now()
        return None if number < 0 else self._map(number)

    def picture(self, window: int, kind: ImageKind, options: ImageOptions) -> Picture | None:
        """Return one picture of a window, or None where it cannot be drawn."""
        if kind is ImageKind.TEXTURE:
            revision = self.map_at(window)
            return None if revision is None else images.texture_picture(revision)
        result = self.result(window)
        camera = self.session.header.camera
        events = self.events_of(result)
        if events is None:
            return self._keyframe_picture(result) if kind is ImageKind.WARPED else None
        match kind:
            case ImageKind.RAW:
                return images.raw_picture(events, camera, options)
            case ImageKind.WARPED:
                return images.warped_picture(events, result, camera, options)
            case ImageKind.MAP:
                # An older map lies on an older plane, and lacks what was seen since.
                T = self.poses()[window]
                return images.overlay_picture(events, result, self.newest_map(), T, camera, options)

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
        }

    def _keyframe_picture(self, result: WindowResult) -> Picture | None:
        image = next((k.image for k in self._keyframes if k.window == result.window), None)
        return None if image is None else images.keyframe_picture(image)


def check_recording(session: Session, recording: Recording) -> None:
    """Refuse a recording that is not the one a session was made of.

    Raises:
        DvsvizError: sensor size or number of events differ.
    """
    camera = session.header.camera
    if (recording.camera.width, recording.camera.height) != (camera.width, camera.height):
        raise DvsvizError("the recording has another sensor size than the session", path=recording.path)
    if session.header.events and recording.events.count != session.header.events:
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
    if truth is None:
        return None
    at = np.array([start_us], dtype=np.int64)
    if not truth.covers(at)[0]:
        return None
    values = _pose_values(truth.at(at).Ts_world_camera[0]) | {"omega": None, "velocity": None}
    # A window of a millisecond holds no two poses of the truth: it is made wider, within what is known.
    wider_us = max(0, _TRUTH_STEP_US - (end_us - start_us)) // 2
    ends = np.clip(
        np.array([start_us - wider_us, end_us + wider_us], dtype=np.int64), truth.t_us[0], truth.t_us[-1]
    )
    if ends[1] > ends[0]:
        before, after = truth.at(ends).Ts_world_camera
        seconds = (ends[1] - ends[0]) * 1e-6
        values["omega"] = _numbers(se3.log_so3(before[:3, :3].T @ after[:3, :3]) / seconds)
        values["velocity"] = _numbers(before[:3, :3].T @ (after[:3, 3] - before[:3, 3]) / seconds)
    return values


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _numbers(values: NDArray[np.float64]) -> list[float | None]:
    return [_number(v) for v in values]
