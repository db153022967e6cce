"""`/rerun/`: rerun's web viewer in a tab of its own, opened at a session's window.

The page is ours (`static/rerun.html`); the viewer's program is that of the installed rerun; what it shows is an export.
"""

from __future__ import annotations

import asyncio
import threading
from pathlib import Path

from starlette.requests import Request
from starlette.responses import FileResponse, Response

from dvsviz.gateway.exports import Exports

_FILE_TYPES = {".js": "text/javascript", ".wasm": "application/wasm"}


class RerunPage:
    """Answers what the viewer's tab asks for.

    Args:
        static: the folder of the page's files.
        exports: where recordings for rerun are made.
    """

    def __init__(self, static: Path, exports: Exports) -> None:
        self._static, self._exports = static, exports
        self._lock = threading.Lock()

    async def page(self, request: Request) -> Response:
        """Return the page that starts the viewer."""
        return FileResponse(self._static / "rerun.html")

    async def program(self, request: Request) -> Response:
        """Return a file of the viewer's program."""
        name = request.path_params["name"]
        path = (await asyncio.to_thread(self._program)).get(name)
        if path is None:
            raise KeyError("rerun's viewer has no such file")
        # Of one server they never change: a second tab has them at once.
        headers = {"Cache-Control": "private, max-age=86400"}
        return FileResponse(path, media_type=_FILE_TYPES[path.suffix], headers=headers)

    def _program(self) -> dict[str, Path]:
        # rerun takes 0.4 s to import, and most sessions are never shown in it.
        from dvsviz.export.rerun_web import FILES, write_web_viewer

        with self._lock:
            write_web_viewer(self._exports.folder)
        return {name: self._exports.folder / name for name in FILES}
