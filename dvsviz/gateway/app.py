"""The dashboard's server: `serve` runs it until Ctrl-C, `Dashboard` runs it beside other things."""

from __future__ import annotations

import errno
import logging
import os
import socket
import sys
import threading
import webbrowser
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import uvicorn

import dvsviz
from dvsviz.errors import DvsvizError
from dvsviz.formats.open import open_recording
from dvsviz.gateway.demo import demo_path
from dvsviz.gateway.exports import Exports
from dvsviz.gateway.library import Library
from dvsviz.gateway.manage import Manager
from dvsviz.gateway.orders import RunOrder, RunState
from dvsviz.gateway.recordings import Recordings
from dvsviz.gateway.routes import Routes
from dvsviz.gateway.runs import Run, Runs
from dvsviz.gateway.security import Keys
from dvsviz.gateway.tabs import Tabs
from dvsviz.gateway.watch import Watch
from dvsviz.session.recognise import is_session
from dvsviz.session.store import open_session
from dvsviz.view.cache import ImageCache

_log = logging.getLogger(__name__)

DEFAULT_PORT = 8765
# 5,000 windows of 240x180 with three images each are about 80 MB.
_CACHE_BYTES = 96 * 1024 * 1024
_STOP_S = 3


def serve(
    paths: Sequence[Path] = (),
    *,
    sessions_dir: Path,
    host: str = "127.0.0.1",
    port: int = DEFAULT_PORT,
    open_browser: bool = True,
    demo: bool = False,
    ready: Callable[[str], None] | None = None,
    told: Callable[[Run], None] | None = None,
    recordings: Sequence[Path] = (),
    live: RunOrder | None = None,
    rerun_port: int | None = None,
) -> None:
    """Show sessions in the browser until Ctrl-C; recordings among the paths are tracked live.

    Args:
        paths: recordings, sessions, or folders of sessions.
        sessions_dir: where sessions are listed and written.
        host: address to listen at.
        port: port to listen at; 0 takes any.
        open_browser: open the page in the browser where there is one.
        demo: track the demo recording anew, so that there is something to see.
        ready: called with the address, token and all, once the server listens.
        told: called with a run whenever it told how far it is, from another thread.
        recordings: folders whose recordings can be tracked from the page, besides those of the sessions' folder.
        live: a stream that is tracked.
        rerun_port: where a rerun viewer of this machine listens that runs are streamed to.

    Raises:
        DvsvizError: the port is in use, or a path is neither recording nor session.
    """
    dashboard = Dashboard(
        paths,
        sessions_dir=sessions_dir,
        host=host,
        port=port,
        demo=demo,
        told=told,
        recordings=recordings,
        live=live,
        rerun_port=rerun_port,
    )
    try:
        if ready is not None:
            ready(dashboard.address)
        if open_browser and _has_browser():
            threading.Thread(target=webbrowser.open, args=(dashboard.address,), daemon=True).start()
        dashboard.run()
    except KeyboardInterrupt:
        _log.info("stopped by Ctrl-C")
    finally:
        dashboard.close()


class Dashboard:
    """A server that listens as soon as it is made and answers while `run` runs.

    Args:
        paths: recordings, sessions, or folders of sessions.
        sessions_dir: where sessions are listed and written.
        host: address to listen at.
        port: port to listen at; 0 takes any.
        demo: track the demo recording anew; it is simulated the first time.
        told: called with a run whenever it told how far it is, from another thread.
        recordings: folders whose recordings can be tracked from the page, besides those of the sessions' folder.
        live: a stream that is tracked.
        rerun_port: where a rerun viewer of this machine listens that runs are streamed to.

    Raises:
        DvsvizError: the port is in use, or a path is neither recording nor session.
    """

    def __init__(
        self,
        paths: Sequence[Path] = (),
        *,
        sessions_dir: Path,
        host: str = "127.0.0.1",
        port: int = DEFAULT_PORT,
        demo: bool = False,
        told: Callable[[Run], None] | None = None,
        recordings: Sequence[Path] = (),
        live: RunOrder | None = None,
        rerun_port: int | None = None,
    ) -> None:
        self._socket = _listen(host, port)
        try:
            sessions_dir.mkdir(parents=True, exist_ok=True)
            for folder in recordings:
                if not folder.is_dir():
                    raise DvsvizError("is not a folder", path=folder, hint="name a folder with --recordings")
            orders, sessions = _sorted(paths, sessions_dir)
            if demo:
                orders.append(_demo_order(sessions_dir))
            if live is not None:
                orders.append(live)
        except BaseException:
            self._socket.close()
            raise
        bound = self._socket.getsockname()[1]
        self._keys = Keys(bound)
        shown_host = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, f"[{host}]" if ":" in host else host)
        self.address = f"http://{shown_host}:{bound}/#token={self._keys.token}"
        self.runs = Runs(self._run_changed, told, rerun_port, self._posed)
        self._library = Library(sessions_dir, self.runs)
        self._tabs = Tabs(self._library, ImageCache(_CACHE_BYTES))
        self._exports = Exports()
        self._recordings = Recordings([sessions_dir, *recordings])
        for path in sessions:
            self._library.add_session(path)
        self._watch = Watch(self._library, self._tabs)
        for order in orders:
            self._library.add_recording(order.recording)
        for order in orders:
            self.runs.add(order)
        self._watch.refresh_list()
        self._routes = Routes(
            keys=self._keys,
            library=self._library,
            runs=self.runs,
            tabs=self._tabs,
            watch=self._watch,
            exports=self._exports,
            manager=Manager(self._library, self.runs, self._recordings),
            static=static_folder(),
        )
        config = uvicorn.Config(
            self._routes.app(host),
            log_config=None,
            access_log=False,
            server_header=False,
            http="h11",
            loop="asyncio",
            ws="websockets-sansio",
            # Images are compressed already, and viser's messages are large and local.
            ws_per_message_deflate=False,
            timeout_graceful_shutdown=_STOP_S,
        )
        self._server = uvicorn.Server(config)
        self._closed = False

    def run(self) -> None:
        """Answer until `stop`, or in the main thread until Ctrl-C."""
        self._watch.start()
        self._server.run(sockets=[self._socket])

    def stop(self) -> None:
        """Make `run` return soon; from any thread."""
        self._server.should_exit = True

    def close(self) -> None:
        """Stop runs, scenes and exports; after `run` has returned, or instead of it."""
        if self._closed:
            return
        self._closed = True
        self._socket.close()
        if self._watch.is_alive():
            self._watch.stop()
        self.runs.close()
        self._tabs.close()
        self._exports.close()
        self._recordings.close()

    def _posed(self, run: Run, pose: dict[str, Any]) -> None:
        name = run.order.name
        for tab in self._tabs.all():
            if tab.shown is not None and tab.shown.name == name:
                tab.tell({"type": "pose", "session": name, **pose}, f"pose {name}")

    def _run_changed(self, run: Run) -> None:
        self._watch.look()
        if run.state is RunState.FAILED:
            for tab in self._tabs.all():
                tab.tell({"type": "error", "text": f"tracking {run.order.name} stopped: {run.error}"}, "run error")


def static_folder() -> Path:
    """Return the folder of the page's files: in the installed package, or beside it in a checkout."""
    package = Path(dvsviz.__file__).parent
    for folder in (package / "static", package.parent / "static"):
        if (folder / "index.html").is_file():
            return folder
    raise DvsvizError("the page's files are missing", path=package / "static", hint="install dvsviz again")


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # asyncio sends at once (TCP_NODELAY) only where the protocol is named: else an answer of two parts takes 40 ms.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        if os.name == "posix":
            # Elsewhere the option lets two servers share a port.
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
        listener.listen(128)
    except (OSError, OverflowError) as error:
        listener.close()
        number = getattr(error, "errno", None)
        if number == errno.EADDRINUSE:
            message, hint = f"port {port} is in use", "choose another with --port, or --port 0 for any"
        elif number == errno.EACCES:
            message, hint = f"port {port} is not allowed", "choose one above 1023 with --port"
        else:
            message, hint = f"cannot listen at {host}:{port}: {error}", "check --host and --port"
        raise DvsvizError(message, hint=hint) from error
    return listener


def _sorted(paths: Sequence[Path], sessions_dir: Path) -> tuple[list[RunOrder], list[Path]]:
    """Return what is to be tracked and what is to be shown."""
    orders: list[RunOrder] = []
    sessions: list[Path] = []
    for path in paths:
        if path.is_file() and is_session(path):
            sessions.append(path)
        elif path.is_dir() and (inside := [file for file in sorted(path.glob("*.h5")) if is_session(file)]):
            sessions += inside
        else:
            recording = open_recording(path)
            out = sessions_dir / f"{recording.name}.h5"
            if not out.exists():
                orders.append(RunOrder(recording=path, out=out))
            elif not open_session(out).complete:
                orders.append(RunOrder(recording=path, out=out, resume=True))
            else:
                _log.warning("%s was tracked before; `dvsviz track --force` tracks it anew", recording.name)
    return orders, sessions


def _demo_order(sessions_dir: Path) -> RunOrder:
    recording = demo_path(sessions_dir)
    out = sessions_dir / f"{recording.stem}.h5"
    # The demo is there to be seen tracking: what an earlier start left would only be shown until it is overwritten.
    out.unlink(missing_ok=True)
    return RunOrder(recording=recording, out=out, force=True, demo=True)


def _has_browser() -> bool:
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return False  # a text browser would take the terminal
    try:
        webbrowser.get()
    except webbrowser.Error:
        return False
    return True
