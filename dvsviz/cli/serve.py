"""`dvsviz serve`: the dashboard."""

from __future__ import annotations

from dvsviz.cli.arguments import Serve
from dvsviz.cli.console import sessions_folder


def serve(command: Serve) -> int:
    """Serve the dashboard until it is stopped."""
    from dvsviz.gateway.app import serve as run

    run(
        command.paths,
        sessions_dir=sessions_folder(command.sessions),
        host=command.host,
        port=command.port,
        open_browser=not command.no_browser,
        recordings=command.recordings,
        ready=lambda address: print(address, flush=True),
    )
    return 0
