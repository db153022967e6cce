"""`dvsviz info`, `convert`, `evaluate` and `export`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from dvsviz.cli import arguments
from dvsviz.cli.console import note, options_of, print_fields, print_json, share_bar
from dvsviz.errors import DvsvizError, SessionError

if TYPE_CHECKING:
    pass


def info(command: arguments.Info) -> int:
    """Say what is in a recording or a session."""
    from dvsviz.session.recognise import is_session

    if is_session(command.file):
        found = _session_info(command.file)
    else:
        from dvsviz.formats.info import describe

        with share_bar(f"reading {command.file.name}") as show:
            found = describe(
                command.file,
                **options_of(command),
                progress=show,
            )
    if command.json:
        print_json(found)
    else:
        if "sparkline" in found:
            from dvsviz.cli.recording_info import fields

            print_fields(fields(found))
        else:
            print_fields({name.replace("_", " "): _words(value) for name, value in found.items()})
    return 0


def convert(command: arguments.Convert) -> int:
    """Write a recording in another format."""
    from dvsviz.cli.console import read_recording
    from dvsviz.formats.convert import Selection, target_of
    from dvsviz.formats.convert import convert as run

    if command.out.exists() and not command.force:
        raise DvsvizError("already exists", path=command.out, hint="replace it with --force")
    target_of(command.out, command.to)
    # Filters look at the whole recording here, and only a part of it may be wanted: they act while it is written.
    recording = read_recording(command.recording, command, filtered=False)
    selection = Selection(
        start_s=command.start or 0.0,
        end_s=command.end,
        roi=command.roi,
        stride=command.stride,
        filters=command.filters(),
    )
    with share_bar(f"writing {command.out.name}") as show:
        found = run(recording, command.out, target=command.to, selection=selection, progress=show)
    if command.json:
        print_json(found)
    elif found["target"] == "tum":
        note(f"wrote {command.out}")
    else:
        note(f"wrote {command.out}: {found['events_kept']:,d} of {found['events']:,d} events")
    return 0


def evaluate(command: arguments.Evaluate) -> int:
    """Compare a session or a trajectory with the truth."""
    from dvsviz.evaluate.evaluate import evaluate as run
    from dvsviz.evaluate.tables import evaluation_table
    from dvsviz.formats.ground_truth import read_ground_truth
    from dvsviz.geometry.tum import read_tum

    truth = None if command.truth is None else read_ground_truth(command.truth, offset_s=command.gt_offset)
    if _is_text(command.session):
        if truth is None:
            raise DvsvizError(
                "is no session, and as a trajectory it needs the truth",
                path=command.session,
                hint="name a file of true poses with --truth",
            )
        found = run(read_tum(command.session), truth, alignment=command.align)
    else:
        from dvsviz.session.store import open_session

        with open_session(command.session) as session:
            if not session.complete:
                note(f"warning: {command.session}: the session is incomplete, its first part is compared")
            found = run(session, truth, alignment=command.align, poses=command.poses)
    if command.json:
        print_json(found.to_dict())
    else:
        print(evaluation_table(found))
    return 0


def _session_info(path: Path) -> dict[str, Any]:
    """Return what a session holds; the keys of a recording's description come first."""
    import json

    from dvsviz.pipeline import evaluation_of, summarize
    from dvsviz.session.schema import FORMAT, VERSION
    from dvsviz.session.store import open_session

    with open_session(path) as session:
        header = session.header
        config: dict[str, Any] = json.loads(header.config_json)
        state = session.state()
        return {
            "format": FORMAT,
            "version": VERSION,
            "name": session.name,
            "state": state,
            "complete": session.complete,
            "events": session.extent[0],
            "duration_s": (session.extent[1] - header.first_us) * 1e-6,
            "width": header.camera.width,
            "height": header.camera.height,
            "recording": header.recording_path,
            "recording_format": header.recording_format,
            "recording_found": Path(header.recording_path).exists(),
            "motion": config.get("motion"),
            **summarize(session.column("status")),
            "keyframes": len(session.keyframes),
            "map_revisions": len(session.map_revisions),
            "failures": len(session.failures),
            "ground_truth": session.ground_truth is not None,
            "evaluation": evaluation_of(session),
            "config": config,
            "created": header.created,
            "program_version": header.program_version,
        }


def _is_text(path: Path) -> bool:
    """Return whether a file is there and is no HDF5 file, as a trajectory in TUM layout is not."""
    try:
        with path.open("rb") as file:
            return not file.read(4).startswith(b"\x89HDF")
    except IsADirectoryError:
        raise SessionError("is a folder", path=path, hint="name a session file") from None
    except FileNotFoundError:
        raise SessionError(
            "no such session", path=path, hint="check the path; `dvsviz track` makes sessions"
        ) from None


def _words(value: object) -> str:
    """Return a value for people."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,d}"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, dict):
        return ", ".join(f"{key} {_words(inner)}" for key, inner in value.items()) or "–"
    if isinstance(value, list | tuple):
        return ", ".join(_words(inner) for inner in value) or "–"
    return str(value)
