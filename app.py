"""The dashboard: `python app.py [RECORDING or SESSION …]`. Without arguments it tracks a simulated demo live."""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from dvsviz.errors import DvsvizError
from dvsviz.gateway.app import DEFAULT_PORT, serve
from dvsviz.gateway.demo import demo_path, demo_recording

_errors = Console(stderr=True)


def main(arguments: list[str] | None = None) -> int:
    """Serve until Ctrl-C and return the exit code: 0, or 2 where something has to be done first."""
    parser = argparse.ArgumentParser(
        prog="app.py", description="Watch an event camera being tracked, in the browser."
    )
    parser.add_argument(
        "paths", nargs="*", type=Path, metavar="RECORDING or SESSION", help="a demo is made without"
    )
    parser.add_argument("--sessions", type=Path, default=Path("sessions"), help="where sessions are kept")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen at")
    parser.add_argument("--port", type=int, default=DEFAULT_PORT, help="port to listen at, 0 for any")
    parser.add_argument("--no-browser", action="store_true", help="print the address only")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(message)s", stream=sys.stderr)
    try:
        if not options.paths:
            _make_demo(options.sessions)
        serve(
            options.paths,
            sessions_dir=options.sessions,
            host=options.host,
            port=options.port,
            open_browser=not options.no_browser,
            demo=not options.paths,
            ready=_show,
        )
    except DvsvizError as error:
        _errors.print(f"[red]error[/red] {error}", highlight=False, soft_wrap=True)
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


def _show(address: str) -> None:
    """Print the one line of standard output."""
    sys.stdout.write(f"{address}\n")
    sys.stdout.flush()


def _make_demo(sessions: Path) -> None:
    """Simulate the demo recording with a progress bar, the first time."""
    if demo_path(sessions).exists():
        return
    with Progress(console=_errors, transient=True) as bar:
        task = bar.add_task("Simulating a 10 s demo recording, once", total=1.0)
        demo_recording(sessions, lambda share: bar.update(task, completed=share))


if __name__ == "__main__":
    sys.exit(main())
