"""The dashboard: `python app.py [RECORDING or SESSION …]`. Without arguments it tracks a simulated demo live."""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path
from typing import ClassVar

from rich.console import Console
from rich.progress import Progress, TaskID

from dvsviz.errors import DvsvizError
from dvsviz.gateway.app import DEFAULT_PORT, serve
from dvsviz.gateway.runs import Run, Stage

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
    bar = _Bar()
    try:
        serve(
            options.paths,
            sessions_dir=options.sessions,
            host=options.host,
            port=options.port,
            open_browser=not options.no_browser,
            demo=not options.paths,
            ready=_show,
            told=bar.show,
        )
    except DvsvizError as error:
        _errors.print(f"[red]error[/red] {error}", highlight=False, soft_wrap=True)
        return 2
    except KeyboardInterrupt:
        return 130
    finally:
        bar.stop()
    return 0


def _show(address: str) -> None:
    """Print the one line of standard output."""
    sys.stdout.write(f"{address}\n")
    sys.stdout.flush()


class _Bar:
    """What the terminal shows until a run tracks; from then on the page is where to look."""

    _TEXTS: ClassVar = {
        Stage.SIMULATING: "Simulating a 10 s demo recording, once",
        Stage.READING: "Reading the recording (other formats are converted once)",
        Stage.COMPILING: "Getting the tracker ready (kernels are compiled the first time)",
    }

    def __init__(self) -> None:
        self._progress = Progress(console=_errors, transient=True)
        self._task: TaskID | None = None

    def show(self, run: Run) -> None:
        """Show how far a run is; from any thread."""
        if run.stage is Stage.TRACKING:
            return self.stop()
        if self._task is None:
            self._task = self._progress.add_task("")
            self._progress.start()
        share = run.progress.get("share")
        total = None if share is None else 1.0
        self._progress.update(self._task, description=self._TEXTS[run.stage], total=total, completed=share or 0.0)

    def stop(self) -> None:
        """Take the bar away."""
        if self._task is not None:
            self._task = None
            self._progress.stop()


if __name__ == "__main__":
    sys.exit(main())
