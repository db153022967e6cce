"""`dvsviz register`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from dvsviz.cli.console import note, print_json, share_bar
from dvsviz.cli.registration_arguments import Register
from dvsviz.errors import DvsvizError

if TYPE_CHECKING:
    from dvsviz.registration.frames import FrameSequence
    from dvsviz.registration.study import StudyRow, StudyRun


def register(command: Register) -> int:
    """Register frames by all methods that are asked for and print their table."""
    from dvsviz.registration.methods import method_names
    from dvsviz.registration.records import RegistrationConfig
    from dvsviz.registration.study import study
    from dvsviz.registration.tables import format_table

    names = method_names(command.methods)
    config = RegistrationConfig(threshold_px=command.threshold)
    for path in (command.out, command.rerun, command.csv, command.latex):
        if path is not None and path.exists() and not command.force:
            raise DvsvizError("already exists", path=path, hint="replace it with --force")
    if command.rerun is not None and command.rerun.suffix.lower() != ".rrd":
        raise DvsvizError("cannot write this", path=command.rerun, hint="name x.rrd")
    sequence = _open(command)
    names = _possible(names, sequence, command)
    with share_bar(f"registering {command.path.name}") as show:
        try:
            runs = study(
                sequence,
                names,
                command.skips,
                features=command.features,
                keyframes=command.keyframes,
                loop_closure=command.loop_closure,
                speed=command.speed,
                config=config,
                progress=show,
            )
        except ValueError as error:
            raise DvsvizError(str(error), path=command.path, hint="choose smaller --skips") from error
    rows = [run.row for run in runs]
    if command.session is not None:
        from dvsviz.registration.events import session_rows

        rows += session_rows(command.session, sequence, runs)
    if command.json:
        print_json(
            {"path": str(command.path), "frames": len(sequence.t_us), "rows": [row.to_dict() for row in rows]}
        )
    else:
        print(format_table(rows))
    _explain(runs)
    _write(command, sequence, runs, rows)
    return 0


def _open(command: Register) -> FrameSequence:
    """Return the frames of a folder, or of an event recording."""
    from dvsviz.registration.frames import RecordingFrames, is_frame_folder, open_frames

    if not command.path.exists():
        raise DvsvizError(
            "no such file or folder", path=command.path, hint="name a folder of frames or a recording"
        )
    if command.path.is_dir() and is_frame_folder(command.path):
        frames = open_frames(
            command.path, calibration=command.calibration, depth_scale=command.depth_scale, rig=command.rig
        )
        for warning in frames.warnings:
            note(f"warning: {command.path}: {warning}")
        return frames
    from dvsviz.formats.open import open_recording

    with share_bar(f"reading {command.path.name}") as show:
        recording = open_recording(command.path, calibration=command.calibration, progress=show)
    for warning in recording.warnings:
        note(f"warning: {command.path}: {warning}")
    return RecordingFrames(recording)


def _possible(names: tuple[str, ...], sequence: FrameSequence, command: Register) -> tuple[str, ...]:
    """Return the methods that the frames allow; a group is cut down, a method that was named is refused."""
    from dvsviz.registration.methods import WITHOUT_DEPTH

    if sequence.read(0).depth is not None:
        return names
    possible = tuple(name for name in names if name in WITHOUT_DEPTH)
    groups = {word.strip() for word in command.methods.split(",")} & {"all", "source"}
    if (len(possible) < len(names) and not groups) or not possible:
        wrong = ", ".join(name for name in names if name not in WITHOUT_DEPTH)
        hint = f"without depth there are {', '.join(sorted(WITHOUT_DEPTH))}"
        raise DvsvizError(f"these frames have no depth, which {wrong} need", path=command.path, hint=hint)
    if len(possible) < len(names):
        note(f"these frames have no depth: only {', '.join(possible)} are run")
    return possible


def _explain(runs: Sequence[StudyRun]) -> None:
    """Say on standard error why steps failed and what the lengths mean."""
    for run in runs:
        reasons = [step.registration.reason for step in run.odometry.steps if not step.registration.is_found]
        if reasons:
            row = run.row
            note(f"{row.method}, skip {row.skip}: {len(reasons)} of {row.registered} failed, first: {reasons[0]}")
    if any(run.row.scale == "unit" and run.row.method != "none" for run in runs):
        note("scale unit: each step is 1 long, because neither depth nor --speed gives its length")


def _write(command: Register, sequence: FrameSequence, runs: list[StudyRun], rows: list[StudyRow]) -> None:
    """Write the files that are asked for."""
    from dvsviz.registration.tables import format_table

    if command.csv is not None:
        _write_text(command.csv, format_table(rows, "csv") + "\n")
    if command.latex is not None:
        _write_text(command.latex, format_table(rows, "latex") + "\n")
    if command.plots is not None:
        from dvsviz.registration.plots import write_plots

        written = write_plots(command.plots, sequence, runs, title=command.path.name)
        note(f"wrote {len(written)} plots to {command.plots}")
    if command.out is None and command.rerun is None:
        return
    from dvsviz.registration.keep import registration_record

    record = registration_record(sequence, runs, features=command.features, source=command.path)
    if command.out is not None:
        from dvsviz.session.registration import write_registration

        write_registration(command.out, record, force=command.force)
        note(f"wrote {command.out}: dvsviz serve {command.out}")
    if command.rerun is not None:
        from dvsviz.export.registration import export_registration

        with share_bar(f"writing {command.rerun.name}") as show:
            export_registration(record, command.rerun, progress=show)
        note(f"wrote {command.rerun}")


def _write_text(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise DvsvizError(f"cannot be written: {error.strerror}", path=path, hint="check the folder") from error
    note(f"wrote {path}")
