"""The child process of a run: it tracks, tells how far it is, and obeys."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
import threading
import time
from dataclasses import replace
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any

from dvsviz.errors import DvsvizError, FormatError, RunCancelled
from dvsviz.gateway.orders import Action, RunOrder, RunState, Stage

if TYPE_CHECKING:
    from dvsviz.events.recording import Recording
    from dvsviz.export.rerun_viewer import RerunViewer
    from dvsviz.live.figures import LiveFigures
    from dvsviz.pipeline import Progress

_log = logging.getLogger(__name__)

# The tracker gives way to seeks where a browser that draws in software takes the other core.
_NICE = 5
_TELL_EVERY_S = 0.2


def carry_out(pipe: Connection, order: RunOrder) -> None:
    """Track in this process; answer with the final state and an error sentence."""
    # Ctrl-C goes to the whole group of processes: the server tells the run when to stop.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _stop)
    sys.stdout = sys.stderr
    if hasattr(os, "nice"):
        os.nice(_NICE)
    try:
        run = _Child(pipe, order)
        run.track()
        # A live stream is stopped well: nobody knows another end of it.
        stopped = run.cancel.is_set() and order.live is None
        answer = (RunState.CANCELLED if stopped else RunState.DONE, "")
    except RunCancelled:
        answer = (RunState.CANCELLED, "")
    except (DvsvizError, OSError, MemoryError, ValueError) as error:
        answer = (RunState.FAILED, str(error))
    with contextlib.suppress(OSError):  # the server is gone; what was written stays
        pipe.send(answer)


class _Child:
    """One order, the pipe to the server, and what came through it."""

    def __init__(self, pipe: Connection, order: RunOrder) -> None:
        self.cancel = threading.Event()
        self._pipe, self._order = pipe, order
        self._going_on = threading.Event()
        self._going_on.set()
        self._told_s, self._sending = 0.0, threading.Lock()
        self._began: tuple[float, float] | None = None
        threading.Thread(target=self._listen, daemon=True).start()

    def track(self) -> None:
        """Carry the order out."""
        from dvsviz import pipeline
        from dvsviz.gateway.demo import demo_recording

        order = self._order
        if order.live is not None:
            self._track_stream(order.live)
            return
        if order.demo:
            demo_recording(order.recording, lambda share: self._tell(Stage.SIMULATING, {"share": share}))
        self._tell(Stage.READING, {}, at_once=True)
        recording = self._recording()
        self._tell(Stage.COMPILING, {}, at_once=True)
        order.out.parent.mkdir(parents=True, exist_ok=True)
        if order.branch_of is not None:
            wanted = pipeline.Branch(window=order.window, config=order.config, T_world_camera=order.T_world_camera)
            pipeline.branch(
                recording,
                order.branch_of,
                order.out,
                wanted,
                progress=self._progress,
                cancel=self.cancel,
                replayed=lambda share: self._tell(Stage.COMPILING, {"share": share}),
            )
            return
        if order.camera is not None:
            recording = replace(recording, camera=order.camera)
        pipeline.track(
            recording,
            order.config,
            order.out,
            force=order.force,
            resume=order.resume,
            progress=self._progress,
            cancel=self.cancel,
            start_s=order.start_s,
            end_s=order.end_s,
            rerun=self._viewer(),
        )

    def _track_stream(self, where: str) -> None:
        from dvsviz import pipeline

        order, told = self._order, {}
        figures: LiveFigures | None = None

        def opened(found: LiveFigures) -> None:
            nonlocal figures
            figures = found

        def report(text: str) -> None:
            # While a stream is away there are no windows to tell of.
            if figures is not None:
                told.update(figures.now() | {"notice": text})
                self._tell(Stage.TRACKING, told, at_once=True)

        def progress(now: Progress) -> None:
            if figures is not None:
                told.update(figures.now() | {"real_time_factor": now.real_time_factor})
                self._tell(Stage.TRACKING, told)
            # Each pose at once: the session is written a few times a second only.
            pose = {"window": now.window, "status": str(now.status), "position": now.position}
            self._send({"pose": pose})
            self._going_on.wait()

        self._tell(Stage.COMPILING, {}, at_once=True)
        order.out.parent.mkdir(parents=True, exist_ok=True)
        pipeline.track_stream(
            where,
            order.config,
            order.out,
            stop=self.cancel,
            report=report,
            opened=opened,
            calibration=order.calibration,
            record=order.record,
            force=order.force,
            progress=progress,
            rerun=self._viewer(),
        )

    def _viewer(self) -> RerunViewer | None:
        """Return the rerun viewer to stream to; one that was closed since the server began ends no run."""
        if self._order.rerun_port is None:
            return None
        from dvsviz.export.rerun_viewer import RerunViewer

        viewer = RerunViewer(port=self._order.rerun_port)
        try:
            viewer.look()
        except DvsvizError as error:
            _log.warning("%s is tracked without it: %s", self._order.name, error)
            return None
        return viewer

    def _recording(self) -> Recording:
        from dvsviz.formats.open import open_recording

        def opened(repair: bool) -> Recording:
            return open_recording(
                self._order.recording,
                repair=repair,
                filters=self._order.filters,
                progress=lambda share: self._tell(Stage.READING, {"share": share}),
            )

        try:
            return opened(False)
        except FormatError:
            # A session that goes on was made of it once: what was repaired then is repaired again.
            if not self._order.resume and self._order.branch_of is None:
                raise
            return opened(True)

    def _progress(self, now: Progress) -> None:
        began_s, first_s = self._began = self._began or (time.monotonic(), now.recording_s)
        # A sensor that had begun with this run would be so far ahead.
        behind_s = (time.monotonic() - began_s) - (now.recording_s - first_s)
        told = {
            "share": now.share,
            "events_per_second": now.events_per_second,
            "lag_s": max(0.0, behind_s),
            "real_time_factor": now.real_time_factor,
        }
        self._tell(Stage.TRACKING, told)
        self._going_on.wait()

    def _tell(self, stage: Stage, told: dict[str, Any], *, at_once: bool = False) -> None:
        if at_once or time.monotonic() - self._told_s > _TELL_EVERY_S:
            self._told_s = time.monotonic()
            self._send({"stage": str(stage), **told})

    def _send(self, message: dict[str, Any]) -> None:
        with self._sending, contextlib.suppress(OSError):  # the server is gone: `_listen` cancels
            self._pipe.send(message)

    def _listen(self) -> None:
        """Obey commands; a server that is gone cancels."""
        while not self.cancel.is_set():
            try:
                action: Action = self._pipe.recv()
            except (EOFError, OSError):
                action = "cancel"
            if action == "pause":
                self._going_on.clear()
                continue
            if action == "cancel":
                self.cancel.set()
            self._going_on.set()


def _stop(*_: object) -> None:
    """End by an exception, so that files that were begun are taken away."""
    raise RunCancelled("stopped")
