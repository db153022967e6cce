"""Sessions for the browser: a recording whose windows draw their own number as a bar code, stored by the real writers.

Window k holds 16 squares of events a row: in the upper row those of k's bits that are 1, in the lower row those that
are 0. What a canvas shows can so be decoded, and a picture mixed of two windows is noticed.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from dvsviz.events.events import Events
from dvsviz.formats.hdf5 import RecordingWriter
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.trajectory import Trajectory
from dvsviz.session.header import SessionHeader
from dvsviz.session.records import (
    Cause,
    Failure,
    Keyframe,
    LogEntry,
    MapRevision,
    Status,
    TrackerUpdates,
    WindowResult,
)
from dvsviz.session.store import SessionWriter

CAMERA = Camera(width=240, height=180, fx=200.0, fy=200.0, cx=119.5, cy=89.5)
FIRST_US = 1_700_000_000_000_000
WINDOW_US = 30_000
BITS, SQUARE, PITCH, LEFT, UPPER, LOWER = 16, 10, 14, 9, 20, 50
EVENTS = BITS * SQUARE * SQUARE
FAILURES = (
    Failure(
        cause=Cause.TOO_LITTLE_TEXTURE,
        start=100,
        end=112,
        worst=106,
        message="Too little texture: 61 edge pixels in view, on one line.",
    ),
    Failure(
        cause=Cause.TOO_FAST, start=200, end=206, worst=203, message="Faster than the search: 31 px in one window."
    ),
)


def events_of(window: int) -> Events:
    """The bar code of a window, its events in a fixed shuffled order over the window's time."""
    inside = np.stack(np.meshgrid(np.arange(SQUARE), np.arange(SQUARE)), -1).reshape(-1, 2)
    corners = [(LEFT + PITCH * bit, UPPER if window >> bit & 1 else LOWER) for bit in range(BITS)]
    xy = np.concatenate([inside + corner for corner in corners])
    xy = np.random.default_rng(1).permutation(xy)
    return Events(
        t_us=FIRST_US + WINDOW_US * window + np.arange(EVENTS, dtype=np.int64) * WINDOW_US // EVENTS,
        x_px=xy[:, 0].astype(np.uint16),
        y_px=xy[:, 1].astype(np.uint16),
        is_positive=np.arange(EVENTS) % 3 > 0,
    )


def pose(window: int) -> np.ndarray:
    s = 0.02 * window
    return se3.pose(
        se3.exp_so3([0.05 * np.sin(s), 0.08 * np.sin(0.7 * s), 0.02 * s]),
        [0.4 * np.sin(s), 0.2 * np.sin(2 * s), 0.0],
    )


def status(window: int) -> Status:
    if window < 3:
        return Status.INITIALIZING
    for failure in FAILURES:
        if failure.start <= window < failure.end:
            return {0: Status.WEAK, failure.end - failure.start - 1: Status.RELOCALIZING}.get(
                window - failure.start, Status.LOST
            )
    return Status.TRACKING


def result(window: int) -> WindowResult:
    is_lost = status(window) in (Status.LOST, Status.RELOCALIZING)
    starting = window < 3
    return WindowResult(
        window=window,
        start_us=FIRST_US + WINDOW_US * window,
        end_us=FIRST_US + WINDOW_US * (window + 1),
        first_event=EVENTS * window,
        end_event=EVENTS * (window + 1),
        status=status(window),
        T_world_camera=pose(window),
        omega=np.zeros(3),
        velocity=np.zeros(3),
        normal_world=np.array([0.0, 0.0, -1.0]),
        contrast_before=0.11,
        contrast_after=0.11 * (1.05 if is_lost else 1.6 + 0.1 * np.sin(0.2 * window)),
        overlap=float("nan") if starting else 0.4 if is_lost else 0.93 + 0.03 * np.sin(0.3 * window),
        score=float("nan") if starting else 0.1 if is_lost else 0.6 + 0.05 * np.sin(0.1 * window),
        confidence=0.1 if is_lost else 0.9,
        condition=31_000.0 if is_lost else 120.0,
        weak_direction=np.array([0.6, 0, 0, 0, 0.8, 0]),
        iterations=6,
        events_used=EVENTS,
        map_revision=-1 if starting else 0,
        keyframe=window // 30 if window % 30 == 3 else -1,
        time_spent_s=0.004,
        note="",
    )


def updates(window: int) -> TrackerUpdates:
    """A keyframe every 30 windows, a map at window 3, failures when they end."""
    keyframes = ()
    if window % 30 == 3:
        image = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
        of = events_of(window)
        image[of.y_px, of.x_px] = 255
        keyframes = (
            Keyframe(
                keyframe=window // 30,
                window=window,
                t_us=FIRST_US + WINDOW_US * window,
                T_world_camera=pose(window),
                image=image,
            ),
        )
    maps = ()
    if window == 3:
        y, x = np.mgrid[:180, :240]
        rings = np.hypot((x % 60) - 30, (y % 60) - 30)
        texture = np.where(np.abs(rings - 20) < 1.5, 230, 0).astype(np.uint8)
        maps = (
            MapRevision(
                revision=0,
                window=3,
                texture=texture,
                origin=np.array([-1.2, -0.9]),
                px_per_unit=100.0,
                normal_world=np.array([0.0, 0.0, -1.0]),
                distance=1.0,
            ),
        )
    failures = tuple(failure for failure in FAILURES if failure.end == window)
    log = tuple(
        LogEntry(window=window, level="warning", text=f"Found again on keyframe {f.start // 30}.") for f in failures
    )
    if keyframes:
        log += (LogEntry(window=window, level="info", text=f"Keyframe {window // 30}."),)
    return TrackerUpdates(keyframes=keyframes, map_revisions=maps, failures=failures, log=log)


def header(recording: Path, windows: int) -> SessionHeader:
    return SessionHeader(
        recording_path=str(recording),
        recording_name=recording.stem,
        recording_format="dvsviz-recording",
        events=EVENTS * windows,
        first_us=FIRST_US,
        last_us=FIRST_US + WINDOW_US * windows - WINDOW_US // EVENTS,
        camera=CAMERA,
        config_json='{"motion": "planar"}',
        program_version="0.1.0",
        created="2024-01-02T03:04:05+00:00",
        mean_plane_distance=1.0,
    )


def write_recording(path: Path, windows: int) -> Path:
    with RecordingWriter(path, camera=CAMERA) as writer:
        for window in range(windows):
            writer.append(events_of(window))
    return path


def truth(windows: int) -> Trajectory:
    """Near the estimate, in another world and twice as large."""
    k = np.arange(windows)
    Ts = np.stack([pose(int(i)) for i in k])
    Ts[:, 0, 3] += 0.004 * np.sin(0.3 * k)
    Ts[:, :3, 3] = 2 * Ts[:, :3, 3] + [1.0, 2.0, 3.0]
    return Trajectory(t_us=FIRST_US + WINDOW_US * k, Ts_world_camera=Ts)


def write_session(
    path: Path,
    recording: Path,
    windows: int,
    *,
    with_truth: bool = True,
    paced: Callable[[int], None] | None = None,
) -> None:
    """Store a session of so many windows; where it is to grow while it is watched, `paced` waits before each."""
    with SessionWriter.create(path, header(recording, windows)) as writer:
        if with_truth:
            writer.set_ground_truth(truth(windows))
        for window in range(windows):
            if paced is not None:
                writer.flush()
                paced(window)
            writer.append(result(window))
            writer.add(updates(window))
        writer.close({"windows": windows})
