"""`dvsviz export` and `dvsviz report`: a session as a file to take along."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from dvsviz.cli.console import note, print_json, share_bar
from dvsviz.cli.export_arguments import Export, Report
from dvsviz.errors import DvsvizError

if TYPE_CHECKING:
    from dvsviz.view.shown import ShownSession


def export(command: Export) -> int:
    """Write a session as another file."""
    from dvsviz.export.tum import export_tum
    from dvsviz.export.writers import Kind, Part, write

    ending = command.to.suffix.lower()
    kinds = {kind.ending: kind for kind in Kind if kind is not Kind.REPORT} | {".html": Kind.SCENE}
    if ending not in kinds:
        raise DvsvizError(
            f"cannot write {ending or 'a file without ending'}",
            path=command.to,
            hint="name x.rrd, x.tum, x.csv, x.parquet, x.png, x.webm, x.mp4 or x.html",
        )
    kind = kinds[ending]
    if not kind.is_video and command.speed != 1.0:
        raise DvsvizError(f"--speed is for videos, not {ending}", path=command.to)
    if not kind.has_part and (command.start, command.end) != (None, None):
        raise DvsvizError(f"--start and --end are for videos and rerun recordings, not {ending}", path=command.to)
    if command.metres and kind is not Kind.TUM:
        raise DvsvizError(f"--metres is for trajectories, not {ending}", path=command.to, hint="name x.tum")
    _check_free(command.to, force=command.force)
    with _shown(command.session, "written", needs_recording=kind.shows_events) as shown:
        if kind is Kind.TUM:
            export_tum(shown.session, command.to, poses=command.poses, metres=command.metres)
        else:
            part = Part(start_s=command.start, end_s=command.end, speed=command.speed)
            with share_bar(f"writing {command.to.name}") as show:
                write(shown, kind, command.to, part, show)
    note(f"wrote {command.to}")
    return 0


def report(command: Report) -> int:
    """Write a session's report."""
    from dvsviz.export.report import write_report

    out = command.out or Path(f"{command.session.stem}.report.html")
    if out.suffix.lower() not in (".html", ".htm"):
        raise DvsvizError("is no name of a page", path=out, hint="name x.html")
    _check_free(out, force=command.force)
    with _shown(command.session, "reported") as shown, share_bar(f"writing {out.name}") as show:
        write_report(shown, out, show)
        figures = {"windows": shown.window_count, "failures": len(shown.session.failures)}
    if command.json:
        print_json({"report": str(out.absolute()), "bytes": out.stat().st_size, **figures})
    else:
        note(f"wrote {out}")
    return 0


def _check_free(out: Path, *, force: bool) -> None:
    if out.exists() and not force:
        raise DvsvizError("already exists", path=out, hint="replace it with --force")


@contextmanager
def _shown(path: Path, done: str, *, needs_recording: bool = True) -> Iterator[ShownSession]:
    """Give a session with its recording; where that is gone a line says so, and images of keyframes are left."""
    from dvsviz.events.filters import FilterConfig
    from dvsviz.formats.open import open_recording
    from dvsviz.session.store import open_session
    from dvsviz.view.shown import ShownSession, check_recording

    with open_session(path) as session:
        if not session.complete:
            note(f"warning: {path}: the session is incomplete, its first part is {done}")
        header, recording, missing = session.header, None, ""
        if needs_recording and header.recording_format != "frames":
            try:
                recording = open_recording(
                    Path(header.recording_path),
                    size=(header.camera.width, header.camera.height),
                    filters=None if header.filters_json is None else FilterConfig.from_json(header.filters_json),
                )
                check_recording(session, recording)
            except DvsvizError as error:
                recording = None
                missing = "The recording is not there any more: only the images of keyframes can be shown."
                note(f"warning: {error}; only the images of the keyframes are {done}")
        yield ShownSession(session, recording, missing)
