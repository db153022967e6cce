"""Tracking runs: one child process at a time, the others wait.

A run is a process of its own, so that a seek never waits for the tracker's share of the interpreter, and so that a
crash of one leaves the other. What it finds is read from the session file alone; the pipe carries commands out and
one closing word back (`docs/decisions/`).
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Literal

from dvsviz.config import TrackerConfig
from dvsviz.errors import DvsvizError, RunCancelled

_log = logging.getLogger(__name__)

Action = Literal["pause", "resume", "cancel"]

# The tracker gives way to seeks where a browser that draws in software takes the other core.
_NICE = 5
# A window takes some ten milliseconds, a refinement of many keyframes a second: what is not written then is lost.
_GRACE_S = 3.0
_LOOK_EVERY_S = 0.1
_TELL_EVERY_S = 0.2


class Stage(StrEnum):
    """What a running run is doing."""

    SIMULATING = "simulating"
    COMPILING = "compiling"
    TRACKING = "tracking"


class RunState(StrEnum):
    """Where a run stands."""

    QUEUED = "queued"
    RUNNING = "running"
    PAUSED = "paused"
    DONE = "done"
    CANCELLED = "cancelled"
    FAILED = "failed"


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOrder:
    """What is to be tracked.

    Attributes:
        recording: file or folder.
        out: the session that is written; its stem is the run's name.
        config: of the tracker.
        force: overwrite a session that is there.
        resume: go on with a session that was interrupted.
        demo: the recording is the demo's: it is simulated where it is not there yet.
    """

    recording: Path
    out: Path
    config: TrackerConfig = field(default_factory=TrackerConfig)
    force: bool = False
    resume: bool = False
    demo: bool = False

    @property
    def name(self) -> str:
        """The session's name."""
        return self.out.stem


class Run:
    """One run and where it stands; changed by the manager alone."""

    def __init__(self, order: RunOrder) -> None:
        self.order = order
        self.state = RunState.QUEUED
        self.error = ""
        self.stage = Stage.SIMULATING if order.demo else Stage.COMPILING
        self.is_cancelled = False
        self.progress: dict[str, float] = {}

    @property
    def is_active(self) -> bool:
        """True while a process works on it."""
        return self.state in (RunState.RUNNING, RunState.PAUSED)


class Runs:
    """All runs of a server, in order.

    Args:
        changed: called with a run whenever its state changed, from the manager's thread.
        told: called with a run whenever it told how far it is, from the manager's thread.
    """

    def __init__(self, changed: Callable[[Run], None], told: Callable[[Run], None] | None = None) -> None:
        self._changed, self._told = changed, told
        self._runs: dict[str, Run] = {}
        self._queue: deque[Run] = deque()
        self._condition = threading.Condition()
        self._pipe: Connection | None = None
        self._process: BaseProcess | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._work, name="runs", daemon=True)
        self._thread.start()

    def add(self, order: RunOrder) -> Run:
        """Queue a run and return it.

        Raises:
            DvsvizError: one of that name is queued or running.
        """
        with self._condition:
            old = self._runs.get(order.name)
            if old is not None and (old.is_active or old.state is RunState.QUEUED):
                raise DvsvizError(f"{order.name} is being tracked already", hint="cancel that run first")
            run = self._runs[order.name] = Run(order)
            self._queue.append(run)
            self._condition.notify_all()
        return run

    def get(self, name: str) -> Run | None:
        """Return the latest run of that name, or None."""
        return self._runs.get(name)

    def without_session(self) -> list[Run]:
        """Return the runs whose session is not there: they wait, begin, or failed before their first window."""
        with self._condition:
            runs = list(self._runs.values())
        done = (RunState.DONE, RunState.CANCELLED)
        return [run for run in runs if run.state not in done and not run.order.out.exists()]

    def act(self, name: str, action: Action) -> None:
        """Pause, resume or cancel a run.

        Raises:
            DvsvizError: no run of that name is queued or running.
        """
        with self._condition:
            run = self._runs.get(name)
            if run is not None and run.state is RunState.QUEUED and action == "cancel":
                self._queue.remove(run)
                run.state = RunState.CANCELLED
            elif run is not None and run.is_active and self._pipe is not None:
                self._send(action)
                if action == "cancel" and run.stage is not Stage.TRACKING and self._process is not None:
                    # There is nothing to keep, and a compiler does not listen.
                    run.is_cancelled = True
                    self._process.terminate()
                if action != "cancel":
                    run.state = RunState.PAUSED if action == "pause" else RunState.RUNNING
            else:
                raise DvsvizError(f"no run of {name} is going on")
        self._changed(run)

    def close(self) -> None:
        """Cancel everything and wait for the process to end."""
        with self._condition:
            self._closed = True
            self._queue.clear()
            self._send("cancel")
            self._condition.notify_all()
        self._thread.join(2 * _GRACE_S + 1)

    def _send(self, action: Action) -> None:
        if self._pipe is not None:
            with contextlib.suppress(OSError):  # the run has just ended
                self._pipe.send(action)

    def _work(self) -> None:
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._queue or self._closed)
                if self._closed:
                    return
                run = self._queue.popleft()
            self._carry_out(run)

    def _carry_out(self, run: Run) -> None:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(
            target=_track, args=(theirs, run.order), name=f"track {run.order.name}", daemon=True
        )
        process.start()
        theirs.close()
        with self._condition:
            self._pipe, self._process, run.state = ours, process, RunState.RUNNING
        self._changed(run)
        state, error = self._follow(run, ours)
        process.join(_GRACE_S)
        if process.is_alive():
            process.kill()
            process.join(_GRACE_S)
        if state is None and (run.is_cancelled or self._closed):
            state = RunState.CANCELLED
        elif state is None:
            state, error = RunState.FAILED, f"the run ended unexpectedly (exit code {process.exitcode})"
        with self._condition:
            self._pipe = self._process = None
            run.state, run.error = state, error
        ours.close()
        if run.error:
            _log.warning("tracking %s: %s", run.order.name, run.error)
        self._changed(run)

    def _follow(self, run: Run, pipe: Connection) -> tuple[RunState | None, str]:
        """Take what a run tells until it ends; None where it went without a word, or had to be stopped."""
        stopped_s = float("inf")
        try:
            while True:
                if self._closed:
                    stopped_s = min(stopped_s, time.monotonic())
                    late = time.monotonic() - stopped_s > _GRACE_S
                    if (late or run.stage is not Stage.TRACKING) and self._process is not None:
                        self._process.terminate()
                        return None, ""
                if not pipe.poll(_LOOK_EVERY_S):
                    continue
                told = pipe.recv()
                if not isinstance(told, dict):
                    return RunState(told[0]), told[1]
                run.stage = Stage(told.pop("stage"))
                run.progress = told
                if self._told is not None:
                    self._told(run)
        except (EOFError, OSError):
            return None, ""


def _track(pipe: Connection, order: RunOrder) -> None:
    """Track in this process; answer with the final state and an error sentence."""
    # Ctrl-C goes to the whole group of processes: the server tells the run when to stop.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _stop)
    sys.stdout = sys.stderr
    if hasattr(os, "nice"):
        os.nice(_NICE)
    from dvsviz.formats.open import open_recording
    from dvsviz.gateway.demo import demo_recording
    from dvsviz.pipeline import Progress, track

    cancel, going_on = threading.Event(), threading.Event()
    going_on.set()
    threading.Thread(target=_listen, args=(pipe, cancel, going_on), daemon=True).start()

    told_s = 0.0

    def tell(stage: Stage, told: dict[str, float], *, at_once: bool = False) -> None:
        nonlocal told_s
        if at_once or time.monotonic() - told_s > _TELL_EVERY_S:
            told_s = time.monotonic()
            with contextlib.suppress(OSError):  # the server is gone: `_listen` cancels
                pipe.send({"stage": str(stage), **told})

    def progress(now: Progress) -> None:
        behind_s = now.recording_s * (1 / now.real_time_factor - 1) if now.real_time_factor > 0 else 0.0
        told = {
            "share": now.share,
            "events_per_second": now.events_per_second,
            "lag_s": max(0.0, behind_s),
            "real_time_factor": now.real_time_factor,
        }
        tell(Stage.TRACKING, told)
        going_on.wait()

    try:
        if order.demo:
            demo_recording(order.recording, lambda share: tell(Stage.SIMULATING, {"share": share}))
        tell(Stage.COMPILING, {}, at_once=True)
        recording = open_recording(order.recording)
        order.out.parent.mkdir(parents=True, exist_ok=True)
        track(
            recording,
            order.config,
            order.out,
            force=order.force,
            resume=order.resume,
            progress=progress,
            cancel=cancel,
        )
        answer = (RunState.CANCELLED if cancel.is_set() else RunState.DONE, "")
    except RunCancelled:
        answer = (RunState.CANCELLED, "")
    except (DvsvizError, OSError, MemoryError, ValueError) as error:
        answer = (RunState.FAILED, str(error))
    try:
        pipe.send(answer)
    except OSError:
        return  # the server is gone; what was written stays


def _stop(*_: object) -> None:
    """End by an exception, so that files that were begun are taken away."""
    raise RunCancelled("stopped")


def _listen(pipe: Connection, cancel: threading.Event, going_on: threading.Event) -> None:
    """Obey commands; a server that is gone cancels."""
    while not cancel.is_set():
        try:
            action: Action = pipe.recv()
        except (EOFError, OSError):
            action = "cancel"
        if action == "pause":
            going_on.clear()
            continue
        if action == "cancel":
            cancel.set()
        going_on.set()
