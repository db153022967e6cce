"""`dvsviz serve`: the dashboard."""

from __future__ import annotations

from dvsviz.cli.arguments import Serve
from dvsviz.cli.console import sessions_folder


def serve(command: Serve) -> int:
    """Serve the dashboard until it is stopped."""
    from dvsviz.gateway.app import serve as run

    run(
        list(command.paths),
        host=command.host,
        port=command.port,
        browser=not command.no_browser,
        sessions=sessions_folder(command.sessions),
    )
    return 0
