"""Curves of a session that are not asked for by every page: pose by axis beside the truth, occupied pixels."""

from __future__ import annotations

import threading
import time
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from dvsviz.contrast.kernels import occupied
from dvsviz.evaluate.associate import known_at
from dvsviz.view.shown import ShownSession

_AXES = ("x", "y", "z", "pitch", "yaw", "roll")
# Events read at once while occupied pixels are counted: 10 ms, so that a seek never waits long for the file.
_AT_ONCE = 200_000


def axis_angles(rotations: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return pitch about x, yaw about y and roll about z (N, 3) in degrees of rotations (N, 3, 3) = R_y R_x R_z."""
    R = rotations
    pitch = np.arcsin(np.clip(-R[:, 1, 2], -1, 1))
    yaw = np.arctan2(R[:, 0, 2], R[:, 2, 2])
    roll = np.arctan2(R[:, 1, 0], R[:, 1, 1])
    return np.degrees(np.stack([pitch, yaw, roll], axis=-1))


def pose_curves(shown: ShownSession, start: int) -> dict[str, NDArray[Any]]:
    """Return the pose of windows from `start` on by axis: position in plane distances, rotation in degrees.

    `true_…` is the truth laid into the session's world; NaN where it is not known. Angles do not jump at half a turn.
    """
    Ts = shown.poses()
    angles = axis_angles(Ts[:, :3, :3])
    whole = np.isfinite(angles).all(axis=1)
    angles[whole] = np.unwrap(angles[whole], period=360, axis=0)
    estimate = np.concatenate([Ts[:, :3, 3], angles], axis=1)
    truth = np.full_like(estimate, np.nan)
    trajectory = shown.errors().truth_world if shown.has_truth else None
    if trajectory is not None:
        t_us = np.asarray(shown.session.columns()["start_us"][: len(Ts)], dtype=np.int64)
        inside = known_at(trajectory, t_us)
        true_Ts = trajectory.at(t_us[inside]).Ts_world_camera
        truth[inside, :3] = true_Ts[:, :3, 3]
        # The turn nearest to the estimate's is meant.
        apart = axis_angles(true_Ts[:, :3, :3]) - angles[inside]
        truth[inside, 3:] = angles[inside] + (apart + 180) % 360 - 180
    curves = {name: estimate[start:, k].astype(np.float32) for k, name in enumerate(_AXES)}
    return curves | {f"true_{name}": truth[start:, k].astype(np.float32) for k, name in enumerate(_AXES)}


class OccupiedPixels:
    """Counts the pixels that have an event, window by window, as far as somebody looks."""

    def __init__(self) -> None:
        self._known: WeakKeyDictionary[ShownSession, tuple[int, NDArray[np.int64]]] = WeakKeyDictionary()
        self._lock = threading.Lock()

    def curve(self, shown: ShownSession, start: int, seconds: float = 0.25) -> dict[str, NDArray[Any]]:
        """Return the counts of windows from `start` on that are known after so many seconds of counting.

        Args:
            shown: the session.
            start: first window that is wanted.
            seconds: how long to count; the caller asks again for the rest.
        """
        until = time.monotonic() + seconds
        with self._lock:
            generation, counts = self._known.get(shown, (shown.generation, np.zeros(0, np.int64)))
            if generation != shown.generation:
                counts = np.zeros(0, np.int64)
            if shown.recording is None:
                counts = np.full(shown.window_count, -1)
            while len(counts) < shown.window_count:
                counts = np.concatenate([counts, _count(shown, len(counts))])
                if time.monotonic() > until:
                    break
            self._known[shown] = (shown.generation, counts)
        found = counts[start:].astype(np.float32)
        found[found < 0] = np.nan
        return {"occupied_px": found}


def _count(shown: ShownSession, first: int) -> NDArray[np.int64]:
    """Return the occupied pixels of some windows from one on, as many as hold `_AT_ONCE` events."""
    columns = shown.session.columns()
    begins, ends = columns["first_event"], columns["end_event"]
    last = max(first + 1, int(np.searchsorted(ends, begins[first] + _AT_ONCE)))
    last = min(last, shown.window_count, len(ends))
    recording, camera = shown.recording, shown.session.header.camera
    if recording is None:
        return np.full(last - first, -1)
    events = recording.events.read(int(begins[first]), int(ends[last - 1]))
    starts = np.append(begins[first:last], ends[last - 1]).astype(np.int64) - int(begins[first])
    out = np.empty(last - first, dtype=np.int64)
    occupied(events.x_px, events.y_px, starts, np.full((camera.height, camera.width), -1), out)
    return out
