"""Trying again: a session is tracked anew from one of its windows on, with other settings or from another pose.

    parent   ──checkpoint── … ──window w ───────────►
                   │ replayed with the parent's settings, stored nowhere: its windows are copied
    branch   ──────copied───────w ──(changes)───────►

So everything before window w is the parent's, to the bit, and what differs afterwards comes from the changes alone.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dvsviz.config import TrackerConfig
from dvsviz.errors import ConfigError, RunCancelled
from dvsviz.events.recording import Recording
from dvsviz.events.windows import make_window
from dvsviz.pipeline.run import Progress, Run, check_same, header_of, part_events
from dvsviz.session.records import Failure, LogEntry, TrackerUpdates
from dvsviz.session.store import Origin, Session, SessionHeader, SessionWriter, open_session
from dvsviz.tracking.tracker import Tracker
from dvsviz.tracking.warm_up import warm_up

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Branch:
    """What is tried.

    Attributes:
        window: the first window that is tracked anew.
        config: settings from there on.
        T_world_camera: pose (4, 4) to start that window from, in the session's world; None keeps the tracker's own.
    """

    window: int
    config: TrackerConfig
    T_world_camera: NDArray[np.float64] | None = None


def branch(
    recording: Recording,
    parent: Path,
    out: Path,
    wanted: Branch,
    *,
    progress: Callable[[Progress], None] | None = None,
    cancel: threading.Event | None = None,
    replayed: Callable[[float], None] | None = None,
) -> dict[str, Any]:
    """Track a session anew from one window on, into a session of its own, and return the run's summary.

    Args:
        recording: the session's recording, opened with the session's filters.
        parent: the session; it is not changed.
        out: the new session.
        wanted: from where, and what is different.
        progress: called after each new window, in the thread that tracks; it may wait (to pause) but not raise.
        cancel: when set, the run stops after the current window and leaves an incomplete session.
        replayed: called with the share (0 to 1) of the windows that are replayed first.

    Raises:
        RunCancelled: `cancel` was set; what was tracked is in the session.
        SessionError: the parent cannot be read or is not of this recording; the new session exists.
        ConfigError: there is no such window; a pose is none, lies behind the plane, or there is no map yet.
    """
    cv2.setNumThreads(1)
    with open_session(parent) as session:
        check_same(recording, session)
        header = _branched(recording, session, wanted)
        recording = replace(recording, camera=session.header.camera)
        compile_s = warm_up(wanted.config)
        tracker, first_event = _tracker_before(recording, session, wanted.window, cancel, replayed)
        failure = _failure_until(session, wanted.window)
    tracker = _changed(recording, tracker, wanted)
    writer = SessionWriter.branch(parent, out, header, windows=wanted.window)
    try:
        if failure is not None:
            writer.add(TrackerUpdates(failures=(failure,)))
        writer.note(LogEntry(window=wanted.window, level="info", text=_sentence(header)))
        if wanted.window > 0:
            writer.checkpoint(wanted.window - 1, tracker.checkpoint())
        run = Run(recording, header, writer, tracker, first_event, compile_s=compile_s)
    except BaseException:
        writer.abandon()
        raise
    run.follow(progress, cancel, None)
    return run.end()


def config_at(header: SessionHeader, window: int) -> TrackerConfig:
    """Return the settings that a window of a session was tracked with: before its branching, those of its origin."""
    text, origin = header.config_json, header.origin
    while origin is not None and window < origin.window:
        text, origin = origin.config_json, origin.origin
    return TrackerConfig.from_json(text)


def _branched(recording: Recording, session: Session, wanted: Branch) -> SessionHeader:
    """Return the header of the branch."""
    before = session.header
    if not 0 <= wanted.window < session.window_count:
        raise ConfigError(f"window: expected 0 to {session.window_count - 1}, got {wanted.window}")
    if wanted.T_world_camera is not None and session.map_at(wanted.window - 1) is None:
        raise ConfigError("there is no map yet at this window", hint="a pose can be given once there is a map")
    new, old = asdict(wanted.config), asdict(config_at(before, wanted.window))
    origin = Origin(
        session=session.name,
        created=before.created,
        window=wanted.window,
        config_json=before.config_json,
        changes={name: (old[name], new[name]) for name in new if new[name] != old[name]},
        T_world_camera=wanted.T_world_camera,
        origin=before.origin,
    )
    part = {"start_us": before.start_us, "end_us": before.end_us, "camera": before.camera}
    return replace(header_of(recording, wanted.config), origin=origin, **part)


def _tracker_before(
    recording: Recording,
    session: Session,
    window: int,
    cancel: threading.Event | None,
    replayed: Callable[[float], None] | None,
) -> tuple[Tracker, int]:
    """Return the tracker as it was before a window, and the window's first event."""
    tracker, first = _restored(recording, session, window)
    for index in range(first, window):
        if cancel is not None and cancel.is_set():
            raise RunCancelled("stopped before its first window", path=session.path)
        # The windows that were stored, so that a later program that would choose others meets the same ones.
        stored = session.result(index)
        events = recording.events.read(stored.first_event, stored.end_event)
        tracker.step(
            make_window(recording.camera, events, index=index, first_event=stored.first_event, end_us=stored.end_us)
        )
        tracker.take_updates()
        if replayed is not None:
            replayed((index + 1 - first) / (window - first))
    if window > 0:
        return tracker, session.result(window - 1).end_event
    return tracker, part_events(recording, session.header)[0]


def _restored(recording: Recording, session: Session, window: int) -> tuple[Tracker, int]:
    """Return a tracker at the last checkpoint before a window, and the first window it has not seen."""
    config = config_at(session.header, window - 1)
    found = session.checkpoint_at(window - 1) if window > 0 else None
    if found is not None:
        try:
            return Tracker.restore(recording.camera, config, found[1], recording.events, recording.imu), found[
                0
            ] + 1
        except ValueError as error:
            # Of another version of the program: what led there is tracked again.
            _log.info("checkpoint of window %d of %s: %s", found[0], session.name, error)
    origin = session.header.origin
    if origin is not None and found is not None and found[0] >= origin.window - 1:
        raise ConfigError(
            f"{session.name} was tried by another version of dvsviz, which cannot be gone on with",
            hint="try its origin again",
        )
    return Tracker(recording.camera, config, recording.imu), 0


def _changed(recording: Recording, tracker: Tracker, wanted: Branch) -> Tracker:
    """Return a tracker with the state of another one, and what is wanted differently."""
    config = wanted.config
    if wanted.window > 0:
        state = tracker.checkpoint()
        tracker = Tracker.restore(recording.camera, config, state, recording.events, recording.imu)
    else:
        tracker = Tracker(recording.camera, config, recording.imu)
    if wanted.T_world_camera is not None:
        try:
            tracker.place(wanted.T_world_camera)
        except ValueError as error:
            raise ConfigError(str(error), hint="give another pose, or none") from error
    return tracker


def _failure_until(session: Session, window: int) -> Failure | None:
    """Return the failure that a window lies in the middle of, up to this window."""
    for failure in session.failures:
        if failure.start < window < failure.end:
            scores = session.column("score")[failure.start : window]
            worst = failure.worst
            if worst >= window:
                worst = failure.start + (int(np.nanargmin(scores)) if np.isfinite(scores).any() else 0)
            return replace(failure, end=window, worst=worst)
    return None


def _sentence(header: SessionHeader) -> str:
    """Return what a branch tries, in words."""
    origin = header.origin
    if origin is None:
        return ""
    changes = [
        f"{name} {_word(after)} instead of {_word(before)}" for name, (before, after) in origin.changes.items()
    ]
    if origin.T_world_camera is not None:
        changes.append("a pose given by hand")
    return (
        f"Tried again from window {origin.window} of {origin.session}: {', '.join(changes) or 'nothing changed'}."
    )


def _word(value: Any) -> str:
    return "automatic" if value is None else str(value)
