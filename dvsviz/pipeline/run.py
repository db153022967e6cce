"""One run: windows go to the tracker, results to the session; it is watched, stopped and continued."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2

from dvsviz import __version__
from dvsviz.config import TrackerConfig
from dvsviz.errors import ConfigError, RunCancelled, SessionError
from dvsviz.events.part import EventsUntil
from dvsviz.events.recording import Recording
from dvsviz.events.windows import EventWindow, windows
from dvsviz.live.source import LiveEvents
from dvsviz.live.windows import LiveWindows
from dvsviz.pipeline.checks import check_target, check_trackable
from dvsviz.pipeline.summary import evaluation_of, events_kept, metric_scale_of, summarize
from dvsviz.session.records import LogEntry, Status, WindowResult
from dvsviz.session.store import Session, SessionHeader, SessionWriter, open_session
from dvsviz.tracking.tracker import Tracker
from dvsviz.tracking.warm_up import warm_up

if TYPE_CHECKING:
    from dvsviz.export.rerun import RerunLogger
    from dvsviz.export.rerun_viewer import RerunViewer

CHECKPOINT_US = 5_000_000
"""A checkpoint at least this often in recording time."""
KEYFRAME_CHECKPOINT_US = 500_000
"""At a keyframe one if the last is older: a fast camera makes twenty a second, and each holds all windows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """How far a run is, told after each window.

    Attributes:
        window: number of the window just tracked.
        status: its status.
        position: of the camera at its start (x, y, z), world, plane distances.
        share: events done by events of the recording, 0 to 1.
        events_per_second: events tracked by wall second, of this run.
        real_time_factor: recording seconds by wall second, of this run.
        recording_s: seconds of the recording that are done.
    """

    window: int
    status: Status
    position: tuple[float, float, float]
    share: float
    events_per_second: float
    real_time_factor: float
    recording_s: float


def track(
    recording: Recording,
    config: TrackerConfig | None,
    out: Path,
    *,
    force: bool = False,
    resume: bool = False,
    progress: Callable[[Progress], None] | None = None,
    cancel: threading.Event | None = None,
    rerun: Path | RerunViewer | None = None,
    start_s: float | None = None,
    end_s: float | None = None,
) -> dict[str, Any]:
    """Track a recording into a session and return the run's summary, the object of `dvsviz track --json`.

    Args:
        recording: what is tracked.
        config: settings; None or defaults take those of the session with `resume`, which may not be changed.
        out: the session's file.
        force: replace a session that is there.
        resume: continue an interrupted session from its last checkpoint; windows after it are tracked again.
        progress: called after each window, in the thread that tracks; it may wait (to pause) but not raise.
        cancel: when set, the run stops after the current window and leaves an incomplete session.
        rerun: a rerun recording that is written besides, or a viewer that the run is streamed to.
        start_s: where to begin, seconds from the first event; a resumed session keeps its own.
        end_s: where to end, seconds from the first event; a resumed session keeps its own.

    Raises:
        RunCancelled: `cancel` was set; what was tracked is in the session.
        SessionError: the session exists, cannot be written, or is not one of this recording.
        ConfigError: `config` differs from the session that is resumed; no events between start and end.
        FormatError: the recording turned out to be damaged.
    """
    # Blurs of a sensor's size: OpenCV's threads cost more than they save, and the other core belongs to the viewer.
    cv2.setNumThreads(1)
    if recording.events.count == 0:
        raise SessionError("no events to track", path=recording.path, hint="check the recording with `dvsviz info`")
    check_trackable(recording)
    check_target(recording, out, force=force)
    if resume:
        run = Run.resumed(recording, config, out)
    else:
        part = _part(recording, start_s, end_s)
        run = Run.started(recording, config or TrackerConfig(), out, force=force, part=part)
    run.follow(progress, cancel, rerun)
    return run.end()


class Run:
    """One run: the tracker, the writer, the clock."""

    def __init__(
        self,
        recording: Recording,
        header: SessionHeader,
        writer: SessionWriter,
        tracker: Tracker,
        first_event: int,
        *,
        compile_s: float = 0.0,
    ) -> None:
        """Begin a run whose tracker and writer stand before one event.

        Args:
            recording: what is tracked, whole, with the camera of the header.
            header: of the session.
            writer: of the session.
            tracker: knows what came before `first_event`.
            first_event: where to go on.
            compile_s: seconds that getting ready took.
        """
        self._recording, self._header, self._writer, self._tracker = recording, header, writer, tracker
        self._config = tracker.config
        self._first_event, self._end_event = first_event, first_event
        self._part = part_events(recording, header)
        self._last_event = recording.events.count if self._part[1] is None else self._part[1]
        first_event = min(first_event, max(0, recording.events.count - 1))
        self._first_us = int(recording.events.read(first_event, first_event + 1).t_us[0])
        self._last_us = self._first_us
        self._checkpoint_us = self._first_us
        self._compile_s = compile_s
        self._started = 0.0
        self._live: LiveWindows | None = None

    @classmethod
    def started(
        cls,
        recording: Recording,
        config: TrackerConfig,
        out: Path,
        *,
        force: bool,
        part: tuple[int | None, int | None] = (None, None),
    ) -> Run:
        """Return a run from the recording's first event, or of a part of it (first and last time, us)."""
        compile_s = warm_up(config)
        header = replace(header_of(recording, config), start_us=part[0], end_us=part[1])
        first_event = part_events(recording, header)[0]
        writer = SessionWriter.create(out, header, force=force)
        try:
            tracker = Tracker(recording.camera, config, recording.imu)
            run = cls(recording, header, writer, tracker, first_event, compile_s=compile_s)
            if recording.ground_truth is not None and len(recording.ground_truth):
                writer.set_ground_truth(recording.ground_truth)
            for warning in recording.warnings:
                writer.note(LogEntry(window=0, level="warning", text=warning))
        except BaseException:
            writer.abandon()
            raise
        return run

    @classmethod
    def resumed(cls, recording: Recording, config: TrackerConfig | None, out: Path) -> Run:
        """Return a run that continues after the last checkpoint of a session."""
        with open_session(out) as session:
            check_same(recording, session)
            header = session.header
            stored = TrackerConfig.from_json(header.config_json)
            if config not in (None, TrackerConfig(), stored):
                raise ConfigError(
                    f"settings differ from those of {out}: {_difference(config, stored)}",
                    hint="resume without settings, or start again with --force",
                )
            # The calibration of the first part holds for the rest.
            recording = replace(recording, camera=header.camera)
            found = session.checkpoint_at(session.window_count - 1)
            first_event = session.result(found[0]).end_event if found else part_events(recording, header)[0]
        compile_s = warm_up(stored)
        tracker = Tracker(recording.camera, stored, recording.imu)
        if found:
            # Before anything of the session is changed.
            try:
                tracker = Tracker.restore(recording.camera, stored, found[1], recording.events, recording.imu)
            except ValueError as error:
                raise SessionError(
                    f"cannot be gone on with ({error})",
                    path=out,
                    place=f"checkpoint of window {found[0]}",
                    hint="it is damaged or of another version of dvsviz: what it holds can be seen; track it anew",
                ) from error
        writer = SessionWriter.resume(out, windows=found[0] + 1 if found else 0)
        try:
            return cls(recording, header, writer, tracker, first_event, compile_s=compile_s)
        except BaseException:
            writer.abandon()
            raise

    def follow(
        self,
        progress: Callable[[Progress], None] | None,
        cancel: threading.Event | None,
        rerun: Path | RerunViewer | None,
    ) -> None:
        """Track to the recording's end; whatever ends it before leaves the session incomplete and readable."""
        logger = _rerun_logger(rerun, self._header)
        try:
            self._started = time.perf_counter()
            for window in self._windows():
                result = self._tracker.step(window)
                updates = self._tracker.take_updates()
                self._writer.append(result, updates)
                for text in self._live.notes() if self._live is not None else ():
                    self._writer.note(LogEntry(window=result.window, level="warning", text=text))
                self._end_event, self._last_us = result.end_event, result.end_us
                if logger is not None:
                    logger.log(result, updates, window)
                stopped = cancel is not None and cancel.is_set()
                since_us = result.end_us - self._checkpoint_us
                due_us = KEYFRAME_CHECKPOINT_US if result.keyframe >= 0 else CHECKPOINT_US
                if stopped or since_us >= due_us or result.window == 0:
                    self._checkpoint_us = result.end_us
                    self._writer.checkpoint(result.window, self._tracker.checkpoint())
                if progress is not None:
                    progress(self._progress(result))
                if stopped:
                    raise RunCancelled(
                        f"stopped after window {result.window}",
                        path=self._writer.path,
                        hint="continue with --resume",
                    )
            self._writer.add(self._tracker.finish())
            if logger is not None:
                logger.close()
        except BaseException:
            if logger is not None:
                logger.abandon()
            self._writer.abandon()
            raise

    def _windows(self) -> Iterable[EventWindow]:
        limit_us = round(self._config.max_window_ms * 1000)
        if isinstance(self._recording.events, LiveEvents):
            self._tracker.hurry()
            self._live = LiveWindows(
                self._recording,
                lambda: self._tracker.window_size,
                max_duration_us=limit_us,
                stretch=lambda factor: setattr(self._tracker, "stretch", factor),
            )
            return self._live
        return windows(
            until(self._recording, self._part[1]),
            lambda: self._tracker.window_size,
            max_duration_us=limit_us,
            first_event=self._first_event,
            index=self._writer.window_count,
        )

    def end(self) -> dict[str, Any]:
        """Evaluate, close the session as complete and return the summary."""
        try:
            self._writer.flush()
            with open_session(self._writer.path) as session:
                figures = summarize(session.column("status"))
                evaluation = evaluation_of(session)
                scale = metric_scale_of(session, self._recording)
            wall_s = max(time.perf_counter() - self._started, 1e-9)
            summary = {
                "session": str(self._writer.path),
                "recording": str(self._recording.path),
                "motion": self._config.motion,
                **figures,
                "events": self._recording.events.count,
                "duration_s": self._recording.duration_s,
                "wall_s": wall_s,
                "events_per_second": (self._end_event - self._first_event) / wall_s,
                "real_time_factor": (self._last_us - self._first_us) * 1e-6 / wall_s,
                "compile_s": self._compile_s,
                "evaluation": evaluation,
                **events_kept(self._recording),
                **scale,
                **({} if self._live is None else {"live": self._live.summary()}),
            }
        except BaseException:
            self._writer.abandon()
            raise
        self._writer.close(summary)
        return summary

    def _progress(self, result: WindowResult) -> Progress:
        wall_s = max(time.perf_counter() - self._started, 1e-9)
        x, y, z = result.T_world_camera[:3, 3].tolist()
        return Progress(
            window=result.window,
            status=result.status,
            position=(x, y, z),
            share=(result.end_event - self._part[0]) / max(1, self._last_event - self._part[0]),
            events_per_second=(result.end_event - self._first_event) / wall_s,
            real_time_factor=(result.end_us - self._first_us) * 1e-6 / wall_s,
            recording_s=(result.end_us - self._recording.first_us) * 1e-6,
        )


def header_of(recording: Recording, config: TrackerConfig) -> SessionHeader:
    """Return the header of a session that is tracked with these settings."""
    return SessionHeader(
        # A stream that is not recorded has an address.
        recording_path=str(
            recording.path if isinstance(recording.events, LiveEvents) else recording.path.absolute()
        ),
        recording_name=recording.name,
        recording_format=recording.format,
        # Of a stream nobody knows yet: 0 says so.
        events=0 if isinstance(recording.events, LiveEvents) else recording.events.count,
        first_us=recording.first_us,
        last_us=recording.last_us,
        camera=recording.camera,
        config_json=config.to_json(),
        program_version=__version__,
        seed=config.seed,
        created=datetime.now().astimezone().isoformat(timespec="seconds"),
        mean_plane_distance=recording.mean_plane_distance,
        plane_normal_world=recording.plane_normal_world,
        plane_distance_world=recording.plane_distance_world,
        filters_json=None if recording.filters is None else recording.filters.to_json(),
    )


def _rerun_logger(out: Path | RerunViewer | None, header: SessionHeader) -> RerunLogger | None:
    if out is None:
        return None
    # Rerun takes half a second to import and most runs do without.
    from dvsviz.export.rerun import RerunLogger

    return RerunLogger(out, header)


def part_events(recording: Recording, header: SessionHeader) -> tuple[int, int | None]:
    """Return the first event that is tracked and the one after the last, None where the recording ends."""
    first = 0 if header.start_us is None else recording.events.index_at(header.start_us)
    return first, None if header.end_us is None else recording.events.index_at(header.end_us)


def until(recording: Recording, end_event: int | None) -> Recording:
    """Return a recording that ends before an event; None leaves it whole."""
    return recording if end_event is None else replace(recording, events=EventsUntil(recording.events, end_event))


def _part(recording: Recording, start_s: float | None, end_s: float | None) -> tuple[int | None, int | None]:
    """Return start and end of what is tracked in the recording's own time, us."""
    if start_s is None and end_s is None:
        return None, None
    start, end = ((None if s is None else recording.first_us + round(s * 1e6)) for s in (start_s, end_s))
    first = 0 if start is None else recording.events.index_at(start)
    last = recording.events.count if end is None else recording.events.index_at(end)
    if (start_s or 0.0) < 0 or last <= first:
        words = f"{start_s or 0:g} s to {recording.duration_s if end_s is None else end_s:g} s"
        raise ConfigError(f"no events from {words}", hint=f"the recording lasts {recording.duration_s:.3f} s")
    return start, end


def check_same(recording: Recording, session: Session) -> None:
    """Refuse a recording that is not the one of a session.

    Raises:
        SessionError: number of events or times differ.
    """
    header = session.header
    found = (recording.events.count, recording.first_us, recording.last_us)
    if header.is_stream and found[0] >= session.extent[0] and found[1] == header.first_us:
        return
    if found != (header.events, header.first_us, header.last_us):
        raise SessionError(
            f"is a session of {header.recording_path} with {header.events} events, not of {recording.path}",
            path=session.path,
            hint="use its own recording",
        )


def _difference(config: TrackerConfig, stored: TrackerConfig) -> str:
    a, b = asdict(config), asdict(stored)
    return ", ".join(f"{key} {a[key]} instead of {b[key]}" for key in a if a[key] != b[key])
