"""A recording and a session whose every picture is known: window k has events at one pixel, which tells k."""

from __future__ import annotations

import json
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import numpy as np

from dvsviz.events.events import Events
from dvsviz.formats.hdf5_writer import RecordingWriter
from dvsviz.gateway.app import Dashboard
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.trajectory import Trajectory
from dvsviz.session.records import Keyframe, LogEntry, MapRevision, Status, TrackerUpdates, WindowResult
from dvsviz.session.store import SessionHeader, SessionWriter

CAMERA = Camera(width=48, height=32, fx=40.0, fy=41.0, cx=23.5, cy=15.5)
PER_WINDOW = 20
WINDOW_US = 10_000
TAB = "0123456789abcdef"


def pixel_of(window: int) -> tuple[int, int]:
    """Column and row of a window's events."""
    return window % CAMERA.width, window // CAMERA.width % CAMERA.height


def make_recording(path: Path, windows: int) -> Path:
    k = np.repeat(np.arange(windows), PER_WINDOW)
    t = k * WINDOW_US + np.tile(np.arange(PER_WINDOW) * 100, windows)
    with RecordingWriter(path, camera=CAMERA) as writer:
        writer.append(
            Events(
                t_us=t.astype(np.int64),
                x_px=(k % CAMERA.width).astype(np.uint16),
                y_px=(k // CAMERA.width % CAMERA.height).astype(np.uint16),
                is_positive=np.arange(len(k)) % 2 == 0,
            )
        )
    return path


def pose(window: int) -> np.ndarray:
    return se3.pose(se3.exp_so3([0.0, 0.001 * window, 0.0]), [0.002 * window, 0.0, 0.0])


def result(window: int) -> WindowResult:
    return WindowResult(
        window=window,
        start_us=window * WINDOW_US,
        end_us=(window + 1) * WINDOW_US,
        first_event=window * PER_WINDOW,
        end_event=(window + 1) * PER_WINDOW,
        status=Status.LOST if window % 10 == 9 else Status.TRACKING,
        T_world_camera=pose(window),
        omega=np.zeros(3),
        velocity=np.zeros(3),
        normal_world=np.array([0.0, 0.0, -1.0]),
        contrast_before=1.0,
        contrast_after=2.0,
        overlap=0.75,
        score=float("nan"),
        confidence=0.5,
        condition=12.0,
        weak_direction=np.array([0.0, 0.6, 0.0, 0.8, 0.0, 0.0]),
        iterations=3,
        events_used=PER_WINDOW,
        map_revision=0,
        keyframe=0 if window == 0 else -1,
        time_spent_s=0.001,
    )


def first_updates() -> TrackerUpdates:
    texture = np.zeros((60, 90), dtype=np.uint8)
    texture[:20, :30] = 255
    return TrackerUpdates(
        keyframes=(
            Keyframe(keyframe=0, window=0, t_us=0, T_world_camera=pose(0), image=np.full((32, 48), 99, np.uint8)),
        ),
        map_revisions=(
            MapRevision(
                revision=0,
                window=0,
                texture=texture,
                origin=np.array([-1.0, -0.7]),
                px_per_unit=45.0,
                normal_world=np.array([0.0, 0.0, -1.0]),
                distance=1.0,
            ),
        ),
        log=(LogEntry(window=0, level="info", text="initialized"),),
    )


def create_session(path: Path, recording: Path, windows: int) -> SessionWriter:
    header = SessionHeader(
        recording_path=str(recording),
        recording_name=recording.stem,
        recording_format="dvsviz-recording",
        events=windows * PER_WINDOW,
        first_us=0,
        last_us=windows * WINDOW_US,
        camera=CAMERA,
        created="2026-01-02T03:04:05+00:00",
    )
    writer = SessionWriter.create(path, header)
    t = np.arange(windows, dtype=np.int64) * WINDOW_US
    writer.set_ground_truth(Trajectory(t_us=t, Ts_world_camera=np.stack([pose(k) for k in range(windows)])))
    return writer


def make_session(path: Path, recording: Path, windows: int) -> Path:
    with create_session(path, recording, windows) as writer:
        for k in range(windows):
            writer.append(result(k))
            if k == 0:
                writer.add(first_updates())
        writer.close({"note": "made for tests"})
    return path


@contextmanager
def running(paths: tuple[Path, ...], sessions_dir: Path, recordings: tuple[Path, ...] = ()) -> Iterator[Dashboard]:
    """A real server on any port, in a thread of this process."""
    dashboard = Dashboard(paths, sessions_dir=sessions_dir, port=0, recordings=recordings)
    thread = threading.Thread(target=dashboard.run)
    thread.start()
    try:
        yield dashboard
    finally:
        dashboard.stop()
        thread.join(10)
        dashboard.close()
        assert not thread.is_alive()


def base_and_token(address: str) -> tuple[str, str]:
    base, _, token = address.partition("/#token=")
    return base, token


def logged_in(address: str) -> httpx.Client:
    base, token = base_and_token(address)
    client = httpx.Client(base_url=base, trust_env=False, timeout=20)
    assert client.post("/api/login", json={"token": token}).status_code == 204
    return client


def cookie_of(client: httpx.Client) -> str:
    return "; ".join(f"{cookie.name}={cookie.value}" for cookie in client.cookies.jar)


def unpack(message: bytes) -> tuple[dict, list[bytes]]:
    length = struct.unpack_from("<I", message)[0]
    header, offset, parts = json.loads(message[4 : 4 + length]), 4 + length, []
    for image in header["images"]:
        parts.append(message[offset : offset + image["bytes"]])
        offset += image["bytes"]
    assert offset == len(message)
    return header, parts
