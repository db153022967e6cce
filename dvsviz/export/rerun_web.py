"""The program of rerun's web viewer, as the installed rerun brings it: what a browser needs to show a recording."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path

from dvsviz.errors import DvsvizError

FILES = ("re_viewer.js", "re_viewer_bg.wasm")
"""What rerun's own page loads; the second is the program, 43 MB in version 0.41."""

_WAIT_S = 30.0
_NO_PROXY = urllib.request.build_opener(urllib.request.ProxyHandler({}))


def write_web_viewer(folder: Path) -> None:
    """Write rerun's web viewer into a folder; nothing is done where it is there.

    rerun hands its files out only as a server, and the one that the Python package starts listens to the whole
    network and cannot be stopped: its program is started on loopback, asked for the files, and ended.

    Args:
        folder: where the `FILES` are put.

    Raises:
        DvsvizError: the program did not answer.
    """
    if all((folder / name).is_file() for name in FILES):
        return
    web, grpc = _free_ports()
    command = [sys.executable, "-m", "rerun_cli", "--serve-web", "--bind", "127.0.0.1"]
    command += ["--web-viewer-port", str(web), "--port", str(grpc)]
    program = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=os.name == "posix"
    )
    try:
        for name in FILES:
            _fetch(f"http://127.0.0.1:{web}/{name}", folder / name, program)
    finally:
        _end(program)


def _free_ports() -> tuple[int, int]:
    with socket.socket() as first, socket.socket() as second:
        first.bind(("127.0.0.1", 0))
        second.bind(("127.0.0.1", 0))
        return first.getsockname()[1], second.getsockname()[1]


def _fetch(address: str, out: Path, program: subprocess.Popen[bytes]) -> None:
    until = time.monotonic() + _WAIT_S
    partial = out.with_name(f".{out.name}.partial")
    while True:
        try:
            with _NO_PROXY.open(address, timeout=_WAIT_S) as answer, partial.open("wb") as file:
                shutil.copyfileobj(answer, file)
        except (urllib.error.URLError, ConnectionError) as error:
            if program.poll() is None and time.monotonic() < until:
                time.sleep(0.05)  # it does not listen yet
                continue
            raise DvsvizError(
                f"rerun's web viewer did not start: {error}",
                hint="see that `rerun --serve-web` works; the exported .rrd opens in rerun's own window too",
            ) from error
        partial.replace(out)
        return


def _end(program: subprocess.Popen[bytes]) -> None:
    """End the program: the module only starts it, so that the whole group is ended."""
    if os.name == "posix":
        os.killpg(program.pid, signal.SIGTERM)
    else:
        subprocess.run(["taskkill", "/PID", str(program.pid), "/T", "/F"], check=False, capture_output=True)
    program.wait()
