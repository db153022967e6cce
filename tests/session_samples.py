"""Sessions made for tests: real store, invented tracking results with known values."""

from __future__ import annotations

from functools import cache

import numpy as np

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
    RefinedPoses,
    Status,
    TrackerUpdates,
    WindowResult,
)

CAMERA = Camera(width=24, height=18, fx=20.0, fy=21.0, cx=11.2, cy=8.7, distortion=(-0.1, 0.02, 0.001, -0.002, 0.0))
FIRST_US = 1_700_000_000_000_000
WINDOW_US = 10_000


def header(**changes: object) -> SessionHeader:
    values: dict = {
        "recording_path": "recordings/größe.h5",
        "recording_name": "größe",
        "recording_format": "dvsviz-recording",
        "events": 1_000_000,
        "first_us": FIRST_US,
        "last_us": FIRST_US + 3_000_000,
        "camera": CAMERA,
        "config_json": '{"motion": "planar"}',
        "program_version": "0.1.0",
        "seed": 7,
        "created": "2024-01-02T03:04:05+00:00",
        "mean_plane_distance": 1.25,
        "plane_normal_world": np.array([0.0, 0.6, -0.8]),
        "plane_distance_world": 1.5,
    }
    return SessionHeader(**(values | changes))


@cache
def pose(k: int) -> np.ndarray:
    s = 0.05 * k
    # Of several at once, by which the stored sample was made: one alone differs in the last bit.
    R = se3.exp_so3([[0.1 * np.sin(s), 0.2 * np.sin(0.7 * s), 0.05 * s]])[0]
    T = se3.pose(R, [np.sin(s), 0.3 * s, -0.1 * s])
    T.setflags(write=False)
    return T


def status(k: int) -> Status:
    if k < 3:
        return Status.INITIALIZING
    phase = k % 50
    return {40: Status.WEAK, 41: Status.LOST, 42: Status.RELOCALIZING}.get(phase, Status.TRACKING)


def result(k: int) -> WindowResult:
    """Window k: every number follows from k, so that a reader can be checked against it."""
    return WindowResult(
        window=k,
        start_us=FIRST_US + WINDOW_US * k,
        end_us=FIRST_US + WINDOW_US * (k + 1),
        first_event=1000 * k,
        end_event=1000 * (k + 1) + k % 7,
        status=status(k),
        T_world_camera=pose(k),
        omega=np.array([0.1, -0.2, 0.001 * k]),
        velocity=np.array([0.3, 0.1 * k, 1 / 3]),
        normal_world=np.array([0.0, 0.0, -1.0]),
        contrast_before=1.0 + 0.01 * k,
        contrast_after=2.5 + 0.02 * np.sin(k),
        overlap=float("nan") if k < 3 else 0.5 + 0.4 * np.sin(0.1 * k),
        score=float("nan") if k < 3 else 0.9,
        confidence=min(1.0, 0.01 * k),
        condition=10.0 + k,
        weak_direction=np.array([0, 1, 0, 0, 0, 0], dtype=float),
        iterations=5 + k % 3,
        events_used=990 + k,
        map_revision=-1 if k < 3 else k // 10,
        keyframe=k // 10 if k % 10 == 0 else -1,
        time_spent_s=0.001 * k,
        note=f"Fenster {k} schärfer" if k % 20 == 5 else "",
    )


def texture(revision: int) -> np.ndarray:
    rows, columns = 30 + revision % 3, 40
    y, x = np.mgrid[:rows, :columns]
    return (((x + 3 * revision) // 4 + y // 5) % 2 * 200).astype(np.uint8)


def map_revision(revision: int, window: int) -> MapRevision:
    return MapRevision(
        revision=revision,
        window=window,
        texture=texture(revision),
        origin=np.array([-1.0, -0.75]),
        px_per_unit=20.0,
        normal_world=np.array([0.0, 0.0, -1.0]),
        distance=1.0,
    )


def updates(k: int) -> TrackerUpdates:
    """What the tracker made with window k: at each tenth window a keyframe, a map and a refinement."""
    failures: tuple[Failure, ...] = ()
    log: tuple[LogEntry, ...] = ()
    if k % 50 == 43:
        failures = (
            Failure(cause=Cause.TOO_FAST, start=k - 3, end=k, worst=k - 2, message=f"too fast at window {k - 2}"),
        )
        log = (LogEntry(window=k, level="warning", text=f"found again at {k}"),)
    if k % 10:
        return TrackerUpdates(failures=failures, log=log)
    i = k // 10
    windows = np.arange(max(0, k - 15), k + 1)
    Ts = np.stack([pose(w) for w in windows])
    Ts[:, 0, 3] += 0.001 * (i + 1)
    return TrackerUpdates(
        keyframes=(
            Keyframe(
                keyframe=i,
                window=k,
                t_us=FIRST_US + WINDOW_US * k,
                T_world_camera=pose(k),
                image=np.full((CAMERA.height, CAMERA.width), i % 256, np.uint8),
            ),
        ),
        map_revisions=(map_revision(i, k),),
        refined=(RefinedPoses(windows=windows, Ts_world_camera=Ts),),
        log=(LogEntry(window=k, level="info", text=f"keyframe {i}"), *log),
        failures=failures,
    )


def refined_pose(window: int, windows: int) -> np.ndarray:
    """Window's pose as last refined in a session of so many windows (the rule of `updates`)."""
    T = pose(window).copy()
    for k in range(0, windows, 10):
        if k - 15 <= window <= k:
            T[0, 3] = pose(window)[0, 3] + 0.001 * (k // 10 + 1)
    return T


def truth(windows: int) -> Trajectory:
    """The same path in another world, twice as large."""
    k = np.arange(0, windows + 1)
    Ts = np.stack([pose(int(i)) for i in k])
    Ts[:, :3, 3] = 2 * Ts[:, :3, 3] + [1.0, 2.0, 3.0]
    return Trajectory(t_us=FIRST_US + WINDOW_US * k, Ts_world_camera=Ts)
