"""A live stream is tracked, and recorded where that is wanted."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dvsviz.config import TrackerConfig
from dvsviz.errors import DvsvizError
from dvsviz.events.recording import Recording
from dvsviz.formats.calibration import read_calibration
from dvsviz.formats.hdf5 import RecordingWriter
from dvsviz.geometry.camera import Camera
from dvsviz.live.figures import LiveFigures
from dvsviz.live.receiver import connect
from dvsviz.live.recorder import Recorder
from dvsviz.live.source import LiveEvents
from dvsviz.pipeline.run import Progress, track
from dvsviz.session.header import STREAM_FORMAT
from dvsviz.tracking.warm_up import warm_up

if TYPE_CHECKING:
    from dvsviz.export.rerun_viewer import RerunViewer

_SWITCH_S = 5e-4


def track_stream(
    where: str,
    config: TrackerConfig,
    out: Path,
    *,
    stop: threading.Event,
    report: Callable[[str], None],
    opened: Callable[[LiveFigures], None] | None = None,
    calibration: Path | None = None,
    record: Path | None = None,
    force: bool = False,
    progress: Callable[[Progress], None] | None = None,
    rerun: RerunViewer | None = None,
) -> dict[str, Any]:
    """Track a stream until it ends or is stopped, both of which end the session well, and return the run's summary.

    Args:
        where: `aedat4+tcp://HOST:PORT` or `camera`.
        config: settings of the tracker.
        out: the session's file.
        stop: ends the session when set.
        report: told in a sentence what happens to the stream, from another thread.
        opened: given the stream's figures, which stay true, once it is open.
        calibration: file with the camera's calibration; None guesses one, and says so.
        record: where every event that is received is recorded.
        force: replace a session that is there.
        progress: called after each window.
        rerun: a viewer that the run is streamed to.

    Raises:
        LiveError: there is no such stream or camera.
        DvsvizError: it ended without an event, or something cannot be written.
    """
    # A thread that receives or refines gives way to the tracker soon, not after 5 ms.
    sys.setswitchinterval(_SWITCH_S)
    # The kernels first: what a stream sends while they are compiled would come late.
    warm_up(config)
    first = connect(where)
    with ExitStack() as stack:
        unused = [first]
        stack.callback(lambda: [connection.close() for connection in unused])
        camera = Camera.guess(*first.size)
        if calibration is not None:
            camera = read_calibration(calibration).camera(*first.size)
        guessed = "no calibration: the focal length is guessed; give one with --calibration"
        if camera.is_guess:
            report(f"warning: {guessed}")
        recorder = None
        if record is not None:
            record.parent.mkdir(parents=True, exist_ok=True)
            writer = stack.enter_context(RecordingWriter(record, camera=camera, growing=True))
            recorder = stack.enter_context(Recorder(writer.append))
        events = LiveEvents(
            lambda: unused.pop() if unused else connect(where),
            record=None if recorder is None else recorder.put,
            stop=stop,
            report=report,
        )
        stack.callback(events.close)
        if opened is not None:
            opened(events.figures)
        if not events.wait_for_first():
            raise DvsvizError("the stream ended without an event", path=where)
        recording = Recording(
            path=Path(where) if record is None else record.absolute(),
            name=out.stem,
            format=STREAM_FORMAT,
            camera=camera,
            events=events,
            warnings=(guessed,) if camera.is_guess else (),
        )
        return track(recording, config, out, force=force, progress=progress, rerun=rerun)
