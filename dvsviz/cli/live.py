"""`dvsviz replay`, and `dvsviz track --live`."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

from dvsviz.cli.arguments import Replay, Track, UsageError
from dvsviz.cli.console import Interrupts, note, print_json, read_recording, sessions_folder, share_bar
from dvsviz.cli.runs import config_of, print_summary
from dvsviz.errors import DvsvizError, SessionError


def replay(command: Replay) -> int:
    """Serve a recording as a stream once a client is there, and end with it."""
    from dvsviz.live.server import EventServer
    from dvsviz.live.server import replay as run

    if not 0 < command.speed < float("inf"):
        raise UsageError(f"--speed: expected a number above 0, got {command.speed}")
    recording = read_recording(command.recording, command)
    camera = recording.camera
    with EventServer(command.host, command.listen, width=camera.width, height=camera.height) as server:
        print(f"aedat4+tcp://{command.host}:{server.port}", flush=True)
        server.wait_for_client()
        with share_bar(f"sending {recording.name}") as show:
            late_s = run(recording, server, speed=command.speed, progress=show)
    note(f"sent {recording.events.count:,d} events, at most {late_s * 1e3:.0f} ms late")
    return 0


def track_live(command: Track) -> int:
    """Track a stream until it ends or Ctrl-C is pressed; both end the session well."""
    if command.recording is not None or command.resume:
        raise UsageError("--live takes neither a recording nor --resume", hint="leave them away")
    out = command.out or sessions_folder() / "live.h5"
    for path in (out, command.record):
        if path is not None and path.exists() and not command.force:
            raise SessionError("already exists", path=path, hint="replace it with --force")
    from dvsviz import pipeline
    from dvsviz.events.recording import Recording
    from dvsviz.formats.calibration import read_calibration
    from dvsviz.formats.hdf5 import RecordingWriter
    from dvsviz.geometry.camera import Camera
    from dvsviz.live.receiver import connect
    from dvsviz.live.source import LiveEvents
    from dvsviz.tracking.warm_up import warm_up

    where, config = str(command.live), config_of(command)
    # The kernels first: what a stream sends while they are compiled would be lost to the tracker.
    warm_up(config)
    first = connect(where)
    calibration = None if command.calibration is None else read_calibration(command.calibration)
    camera = Camera.guess(*first.size) if calibration is None else calibration.camera(*first.size)
    if camera.is_guess:
        note("warning: no calibration: the focal length is guessed; give one with --calibration")
    opened = [first]
    with ExitStack() as stack:
        writer = None
        if command.record is not None:
            writer = stack.enter_context(RecordingWriter(command.record, camera=camera))
        interrupts = stack.enter_context(Interrupts())
        interrupts.begin()
        events = LiveEvents(
            lambda: opened.pop() if opened else connect(where),
            record=None if writer is None else writer.append,
            stop=interrupts.cancel,
            report=note,
        )
        try:
            if not events.wait_for_first():
                raise DvsvizError("the stream ended without an event", path=Path(where))
            recording = Recording(
                path=command.record or Path(where),
                name=out.stem,
                format="live stream",
                camera=camera,
                events=events,
            )
            summary = pipeline.track(recording, config, out, force=command.force)
        finally:
            events.close()
    if command.json:
        print_json(summary)
    else:
        print_summary(summary)
    return 0
