"""`dvsviz replay`, and `dvsviz track --live`."""

from __future__ import annotations

from pathlib import Path

from dvsviz.cli.arguments import Replay, Track, UsageError
from dvsviz.cli.console import Interrupts, note, print_json, read_recording, sessions_folder, share_bar
from dvsviz.cli.runs import config_of, print_summary
from dvsviz.errors import SessionError


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


def save_interrupted(record: Path | None) -> None:
    """Save what a killed run had recorded under this name, and say so."""
    from dvsviz.formats.hdf5_rescue import rescue

    if record is not None and (count := rescue(record)) is not None:
        note(f"{record}: saved the {count:,d} events that an interrupted run had recorded; it can be tracked")


def track_live(command: Track) -> int:
    """Track a stream until it ends or Ctrl-C is pressed; both end the session well."""
    if command.recording is not None or command.resume:
        raise UsageError("--live takes neither a recording nor --resume", hint="leave them away")
    out = command.out or sessions_folder() / "live.h5"
    save_interrupted(command.record)
    for path in (out, command.record):
        if path is not None and path.exists() and not command.force:
            raise SessionError("already exists", path=path, hint="replace it with --force")
    from dvsviz import pipeline

    where, config = str(command.live), config_of(command)
    with Interrupts() as interrupts:
        summary = pipeline.track_stream(
            where,
            config,
            out,
            stop=interrupts.cancel,
            report=note,
            opened=lambda _: interrupts.begin(),
            calibration=command.calibration,
            record=command.record,
            force=command.force,
        )
    if command.json:
        print_json(summary)
    else:
        print_summary(summary)
    return 0
