"""Sessions as rerun recordings: exported when finished, or logged while a run goes on."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import SessionError
from dvsviz.evaluate.evaluate import window_errors
from dvsviz.events.recording import Recording
from dvsviz.events.windows import EventWindow
from dvsviz.export.blueprint import blueprint
from dvsviz.export.entities import Entities, Moments
from dvsviz.export.frames import event_window, grey_png, warped_png
from dvsviz.export.rerun_viewer import RerunViewer, ViewerStream
from dvsviz.export.rrd_file import RrdFile
from dvsviz.geometry.plane import Plane, map_to_world
from dvsviz.session.header import SessionHeader
from dvsviz.session.records import STATUSES, TrackerUpdates, WindowResult
from dvsviz.session.store import Session

MAX_FRAMES = 5000
"""Images of more windows than this are thinned out evenly: at 240x180 they take about 50 MB."""

_FRAMES_A_PORTION = 100
_FLUSH_SECONDS = 0.5


def export_rerun(
    session: Session,
    out: Path,
    recording: Recording | None = None,
    progress: Callable[[float], None] | None = None,
    windows: tuple[int, int] | None = None,
) -> None:
    """Write a session as a rerun recording, with refined poses.

    Args:
        session: what is written.
        out: the .rrd file; replaced where it exists.
        recording: gives the events of the images; without it the images stored with the keyframes are used.
        progress: called with the share that is done, 0 to 1.
        windows: first and last window that the viewer marks; rerun has no way to open at one.

    Raises:
        SessionError: the session has no windows.
        DvsvizError: the file cannot be written.
    """
    if session.window_count == 0:
        raise SessionError("has no windows", path=session.path, hint="there is nothing to write")
    columns = session.columns()
    Ts = session.Ts_world_camera()
    moments = Moments(window=columns["window"], t_us=columns["start_us"] - session.header.first_us)
    errors = window_errors(session)
    plots = {
        "contrast_gain": columns["contrast_gain"],
        "overlap": columns["overlap"],
        "event_rate": columns["event_rate_hz"],
    }
    if errors.truth_world is not None:
        plots["error"] = errors.position_percent
    target, reach = _scene(session, Ts)
    layout = blueprint(has_truth="error" in plots, target=target, reach=reach, windows=windows)
    file = RrdFile(out, layout, name=session.name)
    try:
        entities = Entities(file.stream, session.header.camera)
        entities.windows(moments, Ts, columns["status"], plots)
        if errors.truth_world is not None:
            entities.truth(errors.truth_world.positions)
        _send_updates(entities, session, moments)
        frames = _send_frames(entities, session, recording, moments, progress)
        file.finish({"world/camera": len(Ts), "world/trajectory": len(Ts), "world/camera/image": frames})
    except BaseException:
        file.abandon()
        raise
    if progress is not None:
        progress(1.0)


def _scene(session: Session, Ts: NDArray[np.float64]) -> tuple[tuple[float, float, float], float]:
    """Return the middle of path and map (x, y, z) and the distance from there to the farthest of both."""
    points = Ts[np.isfinite(Ts).all(axis=(1, 2)), :3, 3]
    if session.map_revisions:
        last = session.map_revisions[-1]
        corners = last.origin + np.array([[0, 0], [last.columns, last.rows]]) / last.px_per_unit
        plane = Plane(normal=last.normal_world, distance=last.distance)
        points = np.concatenate([points, map_to_world(corners, plane)])
    if len(points) == 0:
        return (0.0, 0.0, 0.7), 1.1
    # Percentiles: a lost pose far away must not shrink the rest to a dot.
    low, high = np.percentile(points, 2, axis=0), np.percentile(points, 98, axis=0)
    if session.map_revisions:
        low, high = np.minimum(low, points[-2:].min(axis=0)), np.maximum(high, points[-2:].max(axis=0))
    x, y, z = ((low + high) / 2).tolist()
    return (x, y, z), max(0.3, float(np.linalg.norm(high - low)) / 2)


def _send_updates(entities: Entities, session: Session, moments: Moments) -> None:
    def at(windows: list[int]) -> Moments:
        # What was made after the last stored window belongs to it.
        index = np.clip(np.array(windows, dtype=np.int64), 0, len(moments.window) - 1)
        return Moments(window=moments.window[index], t_us=moments.t_us[index])

    Ts = session.Ts_world_camera()
    keyframes = [k for k in session.keyframes if k.window < len(Ts)]
    positions = Ts[[k.window for k in keyframes], :3, 3] if keyframes else np.zeros((0, 3))
    entities.keyframes(at([k.window for k in keyframes]), positions, [k.keyframe for k in keyframes])
    for light in session.map_revisions:
        entities.map(at([light.window]), [session.map_revision(light.revision)])
    log = session.log
    entities.log(at([entry.window for entry in log]), log)


def _send_frames(
    entities: Entities,
    session: Session,
    recording: Recording | None,
    moments: Moments,
    progress: Callable[[float], None] | None,
) -> int:
    """Send images and return how many there were."""
    camera = session.header.camera
    if recording is None:
        kept = [k for k in session.keyframes if k.window < len(moments.window) and k.image.size]
        index = np.array([k.window for k in kept], dtype=np.int64)
        entities.frames(_pick(moments, index), [grey_png(k.image) for k in kept])
        return len(kept)
    n = len(moments.window)
    chosen = np.unique(np.linspace(0, n - 1, min(n, MAX_FRAMES)).round().astype(np.int64))
    sent = 0
    for start in range(0, len(chosen), _FRAMES_A_PORTION):
        windows: list[int] = []
        pngs: list[bytes] = []
        for k in chosen[start : start + _FRAMES_A_PORTION].tolist():
            result = session.result(k)
            window = event_window(recording, result, camera)
            if window is not None:
                windows.append(k)
                pngs.append(warped_png(window, result, camera))
        entities.frames(_pick(moments, np.array(windows, dtype=np.int64)), pngs)
        sent += len(windows)
        if progress is not None:
            progress(min(0.99, (start + _FRAMES_A_PORTION) / len(chosen)))
    return sent


def _pick(moments: Moments, index: NDArray[np.int64]) -> Moments:
    return Moments(window=moments.window[index], t_us=moments.t_us[index])


class RerunLogger:
    """Logs a run to rerun while it goes on: the entities of `export_rerun`, with poses as known at the time.

    Leaving the with-block by an exception deletes the unfinished file.
    """

    def __init__(self, out: Path | RerunViewer, header: SessionHeader) -> None:
        """Begin a recording.

        Args:
            out: the .rrd file, which has its name when the logger is closed; or the viewer that shows it at once.
            header: what is run.

        Raises:
            DvsvizError: the folder cannot be written, or there is no viewer.
        """
        self._header = header
        if isinstance(out, RerunViewer):
            self._file = ViewerStream(out, blueprint(has_truth=False, live=True), name=header.recording_name)
        else:
            self._file = RrdFile(out, blueprint(has_truth=False), name=out.stem)
        self._entities = Entities(self._file.stream, header.camera)
        self._pending: list[tuple[WindowResult, bytes | None]] = []
        self._rows, self._frames = 0, 0
        self._sent = time.monotonic()
        self._ended = False

    def log(self, result: WindowResult, updates: TrackerUpdates, window: EventWindow | None = None) -> None:
        """Log one window, what was made with it and, where its events are given, its image."""
        png = None if window is None else warped_png(window, result, self._header.camera)
        self._pending.append((result, png))
        here = self._moments([result])
        for revision in updates.map_revisions:
            self._entities.map(here, [revision])
        for keyframe in updates.keyframes:
            self._entities.keyframes(here, keyframe.T_world_camera[None, :3, 3], [keyframe.keyframe])
        for entry in updates.log:
            self._entities.log(here, [entry])
        if time.monotonic() - self._sent > _FLUSH_SECONDS:
            self._send()

    def close(self) -> None:
        """End the file, check it and give it its name.

        Raises:
            DvsvizError: it is not whole.
        """
        if self._ended:
            return
        self._send()
        self._ended = True
        self._file.finish(
            {"world/camera": self._rows, "world/trajectory": self._rows, "world/camera/image": self._frames}
        )

    def abandon(self) -> None:
        """End and delete the file."""
        if not self._ended:
            self._ended = True
            self._file.abandon()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
        else:
            self.abandon()

    def _moments(self, results: list[WindowResult]) -> Moments:
        return Moments(
            window=np.array([r.window for r in results], dtype=np.int64),
            t_us=np.array([r.start_us for r in results], dtype=np.int64) - self._header.first_us,
        )

    def _send(self) -> None:
        self._sent = time.monotonic()
        if not self._pending:
            return
        results = [result for result, _ in self._pending]
        self._entities.windows(
            self._moments(results),
            np.stack([r.T_world_camera for r in results]),
            np.array([STATUSES.index(r.status) for r in results], dtype=np.uint8),
            {
                "contrast_gain": np.array([r.contrast_gain for r in results]),
                "overlap": np.array([r.overlap for r in results]),
                "event_rate": np.array([r.event_rate_hz for r in results]),
            },
        )
        framed = [(result, png) for result, png in self._pending if png is not None]
        self._entities.frames(self._moments([r for r, _ in framed]), [png for _, png in framed])
        self._rows, self._frames = self._rows + len(results), self._frames + len(framed)
        self._pending = []
