"""`dvsviz track` and `dvsviz batch`."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dvsviz.cli.arguments import Batch, Track, Tracking, UsageError
from dvsviz.cli.console import Interrupts, note, print_fields, print_json, read_recording, sessions_folder
from dvsviz.config import TrackerConfig
from dvsviz.errors import ConfigError, DvsvizError, RunCancelled, SessionError

if TYPE_CHECKING:
    from dvsviz.events.recording import Recording
    from dvsviz.pipeline import Progress

# The tracker is imported after the recording was read: what is wrong with a file is said without waiting for it.

_SHOW_EVERY_S = 0.1


def track(command: Track) -> int:
    """Track one recording."""
    if command.live is not None:
        from dvsviz.cli.live import track_live

        return track_live(command)
    if command.recording is None or command.record is not None:
        hint = "name a RECORDING, or a stream with --live (and --record, if it is to be kept)"
        raise UsageError("nothing to track" if command.recording is None else "--record is for --live", hint=hint)
    recording = _read(command.recording, command)
    out = command.out or sessions_folder() / f"{recording.name}.h5"
    if command.resume and command.force:
        raise ConfigError("--resume continues a session and --force replaces it", hint="say one of them")
    if command.rerun is not None and command.rerun.exists() and not command.force:
        raise SessionError("already exists", path=command.rerun, hint="replace it with --force")
    from dvsviz import pipeline

    with Interrupts() as interrupts, _bar(out.stem, interrupts) as show:
        summary = pipeline.track(
            recording,
            _resumed_config(command, out) if command.resume else config_of(command),
            out,
            force=command.force,
            resume=command.resume,
            progress=show,
            cancel=interrupts.cancel,
            rerun=command.rerun,
        )
    if command.json:
        print_json(summary)
    else:
        print_summary(summary)
    return 0


def batch(command: Batch) -> int:
    """Track several recordings; one that fails does not stop the others."""
    config, folder = config_of(command), sessions_folder(command.sessions)
    runs: list[dict[str, Any]] = []
    failed: list[dict[str, str]] = []
    taken: set[Path] = set()
    for path in command.recordings:
        try:
            recording = _read(path, command)
            out = folder / f"{recording.name}.h5"
            if out in taken:
                raise SessionError("is the session of another recording of this batch", path=out, hint="rename one")
            taken.add(out)
            from dvsviz import pipeline

            with Interrupts() as interrupts, _bar(out.stem, interrupts) as show:
                runs.append(
                    pipeline.track(
                        recording, config, out, force=command.force, progress=show, cancel=interrupts.cancel
                    )
                )
        except RunCancelled:
            raise
        except DvsvizError as error:
            note(f"error: {error}")
            failed.append({"recording": str(path), "error": str(error)})
    if command.json:
        print_json({"runs": runs, "failed": failed})
    elif runs:
        print(_table(runs))
    return 2 if failed else 0


def _read(path: Path, command: Tracking) -> Recording:
    """Return the recording that is named, and say what is asked of it that it has not."""
    recording = read_recording(path, command)
    if command.imu == "auto" and recording.imu is None:
        note(f"warning: {path}: there is no gyroscope in it, it is tracked without")
    return recording


def config_of(command: Tracking) -> TrackerConfig:
    """Return the tracker's settings that were said."""
    return TrackerConfig(
        motion=command.motion or "planar",
        mode=command.mode or "map",
        objective=command.objective or "variance",
        window=command.window,
        plane_distance=command.plane_distance,
        imu=command.imu or "off",
    )


def _resumed_config(command: Track, out: Path) -> TrackerConfig | None:
    """Return the session's own settings with those that were said; a difference is refused by the pipeline."""
    from dvsviz.session.store import open_session

    with open_session(out) as session:
        stored = TrackerConfig.from_json(session.header.config_json)
    return TrackerConfig(
        motion=command.motion or stored.motion,
        mode=command.mode or stored.mode,
        objective=command.objective or stored.objective,
        window=command.window or stored.window,
        max_window_ms=stored.max_window_ms,
        plane_distance=command.plane_distance or stored.plane_distance,
        imu=command.imu or stored.imu,
        seed=stored.seed,
    )


@contextmanager
def _bar(name: str, interrupts: Interrupts) -> Iterator[Callable[[Progress], None]]:
    """Give the progress callback of a run: a bar on a terminal, and the point from which Ctrl-C waits for a window."""
    if not sys.stderr.isatty():
        yield lambda progress: interrupts.begin()
        return
    from rich.console import Console
    from rich.progress import BarColumn, TaskProgressColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as Bars

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TextColumn("{task.fields[state]}"),
        TimeRemainingColumn(),
    )
    with Bars(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(name, total=1.0, state="preparing")
        shown = 0.0

        def show(progress: Progress) -> None:
            nonlocal shown
            interrupts.begin()
            now = time.monotonic()
            if now - shown < _SHOW_EVERY_S and progress.share < 1:
                return
            shown = now
            state = (
                f"window {progress.window}  {progress.status}  {progress.events_per_second / 1e6:.2f} Mev/s"
                f"  {progress.real_time_factor:.2f}x real time"
            )
            bar.update(task, completed=progress.share, state=state)

        yield show


def print_summary(summary: dict[str, Any]) -> None:
    """Print a run's summary for people."""
    print_fields(
        {
            "session": summary["session"],
            "recording": summary["recording"],
            "motion": summary["motion"],
            "windows": f"{summary['windows']:,d}",
            "tracked": f"{summary['tracked_share']:.1%}, lost {summary['losses']} times",
            "events": f"{summary['events']:,d} in {summary['duration_s']:.2f} s",
            "speed": f"{summary['wall_s']:.2f} s, {summary['events_per_second'] / 1e6:.2f} million events per second, "
            f"real-time factor {summary['real_time_factor']:.2f} (kernels compiled in {summary['compile_s']:.1f} s)",
        }
    )
    if "live" in summary:
        live = summary["live"]
        print(
            f"live: {live['used_share']:.1%} of {live['received']:,d} events used, left out {live['skips']} times, "
            f"pose {live['latency_median_ms']:.0f} ms after the event at the median, "
            f"{live['latency_p95_ms']:.0f} ms at 95 %, {live['latency_max_ms']:.0f} ms at most, "
            f"opened again {live['reconnects']} times"
        )
    if "events_kept_share" in summary:
        print(f"events kept by the filters: {summary['events_kept_share']:.1%}")
    scale = summary.get("metric_scale", {})
    if "metres_per_unit" in scale:
        print(
            f"a unit of length is {scale['metres_per_unit']:.4g} m (standard deviation {scale['deviation']:.1%}), "
            "by the accelerometer"
        )
    if summary["evaluation"] is not None:
        from dvsviz.evaluate.evaluate import Evaluation
        from dvsviz.evaluate.tables import evaluation_table

        print(f"\n{evaluation_table(Evaluation(**summary['evaluation']))}")


def _table(runs: list[dict[str, Any]]) -> str:
    """Return one row a run."""
    from dvsviz.evaluate.tables import figure, table

    columns = (
        "session",
        "windows",
        "tracked",
        "losses",
        "position %",
        "rotation deg",
        "duration s",
        "real-time factor",
    )
    rows = []
    for run in runs:
        found = run["evaluation"] or {}
        rows.append(
            {
                "session": Path(run["session"]).stem,
                "windows": f"{run['windows']:,d}",
                "tracked": f"{run['tracked_share']:.1%}",
                "losses": str(run["losses"]),
                "position %": figure(found.get("position_rmse_percent_of_distance"), ".2f", ""),
                "rotation deg": figure(found.get("rotation_rmse_deg"), ".2f", ""),
                "duration s": f"{run['duration_s']:.1f}",
                "real-time factor": f"{run['real_time_factor']:.2f}",
            }
        )
    return table(columns, rows)
