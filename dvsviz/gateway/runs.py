"""Tracking runs: one child process at a time, the others wait.

A run is a process of its own, so that a seek never waits for the tracker's share of the interpreter, and so that a
crash of one leaves the other. What it finds is read from the session file alone; the pipe carries commands out and
one closing word back (`docs/decisions/`).
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

from dvsviz.errors import DvsvizError
from dvsviz.gateway.child import carry_out
from dvsviz.gateway.orders import Action, RunOrder, RunState, Stage

_log = logging.getLogger(__name__)

# A window takes some ten milliseconds, a refinement of many keyframes a second: what is not written then is lost.
_GRACE_S = 3.0
_LOOK_EVERY_S = 0.1


class Run:
    """One run and where it stands; changed by the manager alone."""

    def __init__(self, order: RunOrder) -> None:
        self.order = order
        self.state = RunState.QUEUED
        self.error = ""
        self.stage = Stage.SIMULATING if order.demo else Stage.READING
        self.is_cancelled = False
        self.progress: dict[str, float] = {}

    @property
    def is_active(self) -> bool:
        """True while a process works on it."""
        return self.state in (RunState.RUNNING, RunState.PAUSED)

    @property
    def is_open(self) -> bool:
        """True while it waits or a process works on it."""
        return self.is_active or self.state is RunState.QUEUED


class Runs:
    """All runs of a server, in order.

    Args:
        changed: called with a run whenever its state changed, from the manager's thread.
        told: called with a run whenever it told how far it is, from the manager's thread.
        rerun_port: where a rerun viewer of this machine listens that every run is streamed to, or None.
        posed: called with a stream's run and the number, status and position of each window as soon as it is tracked,
            from the manager's thread.
    """

    def __init__(
        self,
        changed: Callable[[Run], None],
        told: Callable[[Run], None] | None = None,
        rerun_port: int | None = None,
        posed: Callable[[Run, dict[str, Any]], None] | None = None,
    ) -> None:
        self._changed, self._told, self._rerun_port, self._posed = changed, told, rerun_port, posed
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
            if old is not None and old.is_open:
                raise DvsvizError(f"{order.name} is being tracked already", hint="cancel that run first")
            run = self._runs[order.name] = Run(replace(order, rerun_port=self._rerun_port))
            self._queue.append(run)
            self._condition.notify_all()
        return run

    def get(self, name: str) -> Run | None:
        """Return the latest run of that name, or None."""
        return self._runs.get(name)

    def place(self, run: Run) -> int:
        """Return how many runs come before one that waits; 0 where it does not wait."""
        with self._condition:
            waiting = list(self._queue)
            return waiting.index(run) + (self._process is not None) if run in waiting else 0

    def forget(self, name: str) -> None:
        """Forget a run that has ended.

        Raises:
            DvsvizError: it waits or is going on.
        """
        with self._condition:
            run = self._runs.get(name)
            if run is not None and run.is_open:
                raise DvsvizError(f"{name} is being tracked", hint="stop that run first")
            self._runs.pop(name, None)

    def all_open(self) -> list[Run]:
        """Return the runs that wait or are going on."""
        with self._condition:
            return [run for run in self._runs.values() if run.is_open]

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
            target=carry_out, args=(theirs, run.order), name=f"track {run.order.name}", daemon=True
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
                if "pose" in told:
                    if self._posed is not None:
                        self._posed(run, told["pose"])
                    continue
                run.stage = Stage(told.pop("stage"))
                run.progress = told
                if self._told is not None:
                    self._told(run)
        except (EOFError, OSError):
            return None, ""
