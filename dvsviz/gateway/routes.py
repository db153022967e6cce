"""The addresses of `docs/dashboard-protocol.md`."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, RedirectResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp
from starlette.websockets import WebSocket

from dvsviz.errors import DvsvizError
from dvsviz.export.writers import Kind
from dvsviz.gateway import wishes
from dvsviz.gateway.exports import Exports
from dvsviz.gateway.library import Library, bookmarks_of
from dvsviz.gateway.manage import Manager
from dvsviz.gateway.messages import pack_columns
from dvsviz.gateway.page import front_page
from dvsviz.gateway.proxy import SceneProxy
from dvsviz.gateway.rerun import RerunPage
from dvsviz.gateway.runs import Runs
from dvsviz.gateway.security import Guard, Keys
from dvsviz.gateway.tabs import TAKEN, Tabs
from dvsviz.gateway.watch import Watch
from dvsviz.session.store import add_bookmark, delete_bookmark
from dvsviz.view.compare import beside_curves, figures
from dvsviz.view.curves import OccupiedPixels, pose_curves
from dvsviz.view.shown import ShownSession

_LONGEST_NOTE = 2000
_MOST_COMPARED = 3
_ACTIONS = ("pause", "resume", "cancel")


class Routes:
    """Answers the page's calls."""

    def __init__(
        self,
        *,
        keys: Keys,
        library: Library,
        runs: Runs,
        tabs: Tabs,
        watch: Watch,
        exports: Exports,
        manager: Manager,
        static: Path,
    ) -> None:
        self._keys, self._library, self._runs = keys, library, runs
        self._tabs, self._watch, self._exports, self._static = tabs, watch, exports, static
        self._manager = manager
        self._occupied = OccupiedPixels()
        self._proxy = SceneProxy()
        self._rerun = RerunPage(static, exports)

    def app(self, host: str) -> ASGIApp:
        """Return the whole application, guarded.

        Args:
            host: the name the server listens at.
        """
        api = {
            "/api/login": (self.login, "POST"),
            "/api/sessions": (self.sessions, "GET"),
            "/api/sessions/{name}": (self.session, "GET"),
            "/api/sessions/{name}/columns": (self.columns, "GET"),
            "/api/sessions/{name}/compare": (self.compare, "GET"),
            "/api/sessions/{name}/export": (self.export, "POST"),
            "/api/sessions/{name}/bookmarks": (self.bookmarks, "POST"),
            "/api/exports/{number}": (self.exported, "GET"),
            "/api/exports/{number}/progress": (self.export_progress, "GET"),
            "/api/exports/{number}/stop": (self.stop_export, "POST"),
            "/api/sessions/{name}/change": (self.change, "POST"),
            "/api/sessions/{name}/branch": (self.branch, "POST"),
            "/api/sessions/{name}/preview": (self.preview, "POST"),
            "/api/recordings": (self.recordings, "GET"),
            "/api/recordings/{number}": (self.recording, "GET"),
            "/api/runs": (self.start, "POST"),
            "/api/runs/{name}": (self.run, "POST"),
        }
        routes = [
            Route("/", self.page),
            Route("/favicon.ico", lambda _: RedirectResponse("/static/icon.svg")),
            *(Route(path, _answered(call), methods=[method]) for path, (call, method) in api.items()),
            WebSocketRoute("/ws", self.tab),
            # viser's client leaves out the slash at the end.
            WebSocketRoute("/viser/{tab}", self.scene_socket),
            Route("/viser/{tab}/{path:path}", _answered(self.scene)),
            Route("/rerun/", self._rerun.page),
            Route("/rerun/{name}", _answered(self._rerun.program)),
            Mount("/static", StaticFiles(directory=self._static)),
        ]
        return Guard(Starlette(routes=routes, lifespan=self._lifespan), self._keys, host)

    @asynccontextmanager
    async def _lifespan(self, _: Starlette) -> AsyncIterator[None]:
        yield
        await self._proxy.close()

    async def page(self, request: Request) -> Response:
        """Return the front page."""
        return HTMLResponse(front_page(self._static), headers={"Cache-Control": "no-cache"})

    async def login(self, request: Request) -> Response:
        """Change the token for the cookie."""
        if not self._keys.opens((await _body(request)).get("token")):
            return JSONResponse({"error": "this is not the token that the server printed"}, status_code=403)
        return Response(status_code=204, headers={"Set-Cookie": self._keys.cookie_header()})

    async def sessions(self, request: Request) -> Response:
        """Return the list of sessions."""
        return JSONResponse(self._watch.list)

    async def session(self, request: Request) -> Response:
        """Return what the page needs to know about one session."""
        shown = await self._shown(request)
        described = await asyncio.to_thread(self._library.describe, shown)
        tab = request.query_params.get("tab", "")
        return JSONResponse(described | {"viser": f"/viser/{tab}/" if tab else None})

    async def columns(self, request: Request) -> Response:
        """Return the curves of the windows from `start` on."""
        shown = await self._shown(request)
        start = min(max(0, int(request.query_params.get("start", "0"))), shown.window_count)
        curves = {
            "state": shown.plotted,
            "pose": partial(pose_curves, shown),
            "pixels": partial(self._occupied.curve, shown),
        }
        if "in" in request.query_params:
            curves["beside"] = partial(beside_curves, shown, await self._named(request.query_params["in"]))
        chosen = request.query_params.get("set", "state")
        if chosen not in curves:
            raise ValueError(f"set: expected one of {', '.join(curves)}")
        data = await asyncio.to_thread(lambda: pack_columns(start, curves[chosen](start)))
        return Response(data, media_type="application/octet-stream")

    async def compare(self, request: Request) -> Response:
        """Return how sessions differ from this one: figures of each, this one first."""
        shown = await self._shown(request)
        names = request.query_params.getlist("with")[:_MOST_COMPARED]
        others = [shown, *[await self._named(name) for name in names]]
        table = await asyncio.to_thread(lambda: [figures(other, shown) for other in others])
        known = {entry["name"]: entry for entry in self._watch.list}
        for row in table:
            entry = known.get(row["name"], {})
            row |= {name: entry.get(name) for name in ("tracked_share", "losses", "state")}
        return JSONResponse({"sessions": table})

    async def export(self, request: Request) -> Response:
        """Begin an export."""
        shown, body = await self._shown(request), await _body(request)
        if body.get("to") not in tuple(Kind):
            raise ValueError(f"to: expected one of {', '.join(Kind)}")
        kind, part = Kind(body["to"]), wishes.part_from(body)
        if body.get("reuse") and (number := self._exports.same(shown, kind)):
            return JSONResponse({"id": number})

        def tell(message: dict[str, Any]) -> None:
            for tab in self._tabs.all():
                tab.tell(message, f"export {message['id']}")

        return JSONResponse({"id": self._exports.start(shown, kind, tell, part)})

    async def bookmarks(self, request: Request) -> Response:
        """Set a bookmark or take one away, in the session's file, and return those there are."""
        shown, body = await self._shown(request), await _body(request)
        if "delete" in body:
            change = partial(delete_bookmark, shown.session.path, int(body["delete"]))
        else:
            text = str(body.get("text", "")).strip()
            if len(text) > _LONGEST_NOTE:
                raise ValueError(f"text: expected at most {_LONGEST_NOTE} characters")
            change = partial(add_bookmark, shown.session.path, int(body.get("window", -1)), text)
        await asyncio.to_thread(change)
        await asyncio.to_thread(shown.refresh)
        return JSONResponse({"bookmarks": bookmarks_of(shown)})

    async def exported(self, request: Request) -> Response:
        """Return the file of a finished export."""
        export = self._exports.get(request.path_params["number"])
        if export is None:
            raise KeyError("there is no such export; make it again")
        return FileResponse(export.path, filename=export.name, media_type="application/octet-stream")

    async def export_progress(self, request: Request) -> Response:
        """Return how far an export is: the last `export` message."""
        return JSONResponse(self._exports.told(request.path_params["number"]))

    async def stop_export(self, request: Request) -> Response:
        """Stop an export."""
        self._exports.stop(request.path_params["number"])
        return Response(status_code=204)

    async def run(self, request: Request) -> Response:
        """Pause, resume or cancel a run."""
        action = (await _body(request)).get("action")
        if action not in _ACTIONS:
            raise ValueError(f"action: expected one of {', '.join(_ACTIONS)}")
        self._runs.act(request.path_params["name"], action)
        return Response(status_code=204)

    async def recordings(self, request: Request) -> Response:
        """Return what a run can be started on, and with which settings."""
        return JSONResponse(await asyncio.to_thread(self._manager.offer))

    async def recording(self, request: Request) -> Response:
        """Return what is known of a recording, or how far its reading is."""
        return JSONResponse(await asyncio.to_thread(self._manager.describe, request.path_params["number"]))

    async def start(self, request: Request) -> Response:
        """Queue a run of a recording."""
        name = await asyncio.to_thread(self._manager.start, await _body(request))
        await asyncio.to_thread(self._watch.refresh_list)
        return JSONResponse({"name": name})

    async def branch(self, request: Request) -> Response:
        """Queue a branch of a session."""
        shown = await self._shown(request)
        name = await asyncio.to_thread(self._manager.try_again, shown, await _body(request))
        await asyncio.to_thread(self._watch.refresh_list)
        return JSONResponse({"name": name})

    async def preview(self, request: Request) -> Response:
        """Return how a window would lie on the map from another pose."""
        shown, body = await self._shown(request), await _body(request)
        return JSONResponse(await asyncio.to_thread(self._manager.preview, shown, body))

    async def change(self, request: Request) -> Response:
        """Rename, tag, resume, keep or delete a session; the answer is its name then, null where it is gone."""
        name, body = request.path_params["name"], await _body(request)
        new = await asyncio.to_thread(self._manager.change, name, body)
        if new != name:
            for tab in self._tabs.all():
                tab.tell({"type": "renamed", "session": name, "name": new}, f"renamed {name}")
        await asyncio.to_thread(self._watch.refresh_list)
        return JSONResponse({"name": new})

    async def tab(self, socket: WebSocket) -> None:
        """Talk with a tab's page."""
        try:
            tab = await asyncio.to_thread(self._tabs.get, socket.query_params.get("tab", ""))
        except (KeyError, DvsvizError) as error:
            await socket.close(1008, str(error)[:100])
            return
        if tab.is_connected:
            await socket.accept()
            await socket.close(TAKEN, "another page has this name")
            return
        await tab.serve(socket, {"type": "sessions", "sessions": self._watch.list})

    async def scene(self, request: Request) -> Response:
        """Return a file of the 3-D scene's client."""
        tab = await asyncio.to_thread(self._tabs.get, request.path_params["tab"])
        return await self._proxy.http(request, tab.scene, request.path_params["path"])

    async def scene_socket(self, socket: WebSocket) -> None:
        """Join the 3-D scene's client with its server."""
        try:
            tab = await asyncio.to_thread(self._tabs.get, socket.path_params["tab"])
        except (KeyError, DvsvizError) as error:
            await socket.close(1008, str(error)[:100])
            return
        await self._proxy.websocket(socket, tab.scene)

    async def _shown(self, request: Request) -> ShownSession:
        return await self._named(request.path_params["name"])

    async def _named(self, name: str) -> ShownSession:
        try:
            return await asyncio.to_thread(self._library.open, name)
        except KeyError:
            raise KeyError("there is no session of this name") from None


def _answered(call: Callable[[Request], Awaitable[Response]]) -> Callable[[Request], Awaitable[Response]]:
    """Turn the errors of a call into answers that the page can show."""

    async def answered(request: Request) -> Response:
        try:
            return await call(request)
        except KeyError as error:
            return JSONResponse({"error": str(error.args[0])}, status_code=404)
        except (ValueError, OverflowError) as error:
            return JSONResponse({"error": str(error)}, status_code=400)
        except DvsvizError as error:
            return JSONResponse({"error": str(error)}, status_code=409)

    return answered


async def _body(request: Request) -> dict[str, Any]:
    try:
        body = json.loads(await request.body())
    except RecursionError:
        raise ValueError("expected a JSON object, got one that is nested too deeply") from None
    if not isinstance(body, dict):
        raise ValueError("expected a JSON object")
    return body
