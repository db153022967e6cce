"""`dvsviz serve`: the dashboard."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from dvsviz.cli.arguments import Serve, UsageError
from dvsviz.cli.console import sessions_folder
from dvsviz.cli.live import save_interrupted
from dvsviz.errors import SessionError

if TYPE_CHECKING:
    from dvsviz.gateway.orders import RunOrder


def serve(command: Serve) -> int:
    """Serve the dashboard until it is stopped."""
    from dvsviz.gateway.app import serve as run

    sessions_dir = sessions_folder(command.sessions)
    if command.rerun:
        from dvsviz.export.rerun_viewer import RerunViewer

        RerunViewer(port=command.rerun_port).look()
    run(
        command.paths,
        sessions_dir=sessions_dir,
        host=command.host,
        port=command.port,
        open_browser=not command.no_browser,
        recordings=command.recordings,
        live=_live(command, sessions_dir),
        rerun_port=command.rerun_port if command.rerun else None,
        ready=lambda address: print(address, flush=True),
    )
    return 0


def _live(command: Serve, sessions_dir: Path) -> RunOrder | None:
    """Return the order to track a stream, once it is known to be there."""
    if command.live is None:
        if command.record or command.motion or command.calibration:
            raise UsageError("--record, --motion and --calibration are for --live", hint="say which stream")
        return None
    from dvsviz.config import TrackerConfig
    from dvsviz.formats.calibration import read_calibration
    from dvsviz.gateway.orders import RunOrder
    from dvsviz.live.network import look

    save_interrupted(command.record)
    if command.record is not None and command.record.exists():
        raise SessionError("already exists", path=command.record, hint="name another file with --record")
    if command.calibration is not None:
        read_calibration(command.calibration)
    look(command.live)
    name = f"live-{datetime.now():%Y%m%d-%H%M%S}"
    return RunOrder(
        recording=command.record or Path(name),
        out=sessions_dir / f"{name}.h5",
        config=TrackerConfig(motion=command.motion or "planar"),
        live=command.live,
        calibration=command.calibration,
        record=command.record,
    )
