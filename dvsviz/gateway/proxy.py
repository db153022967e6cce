"""The way to the 3-D scenes: `/viser/TAB/…` is passed on to the viser server of that tab.

viser's client takes its websocket's address from the page's path, so nothing in what is passed has to be rewritten.
"""

from __future__ import annotations

import asyncio
import logging

import httpx
from starlette.requests import Request
from starlette.responses import Response
from starlette.websockets import WebSocket, WebSocketDisconnect
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidHandshake
from websockets.typing import Subprotocol

from dvsviz.view.scene import KEY_HEADER, TabScene

_log = logging.getLogger(__name__)

_PASSED_BACK = ("content-type", "content-encoding")
_TIMEOUT_S = 10.0


class SceneProxy:
    """Passes HTTP and websockets on to scenes on loopback ports."""

    def __init__(self) -> None:
        # Proxies of the environment are for other machines.
        self._client = httpx.AsyncClient(trust_env=False, timeout=_TIMEOUT_S)

    async def close(self) -> None:
        """Close the connections to the scenes."""
        await self._client.aclose()

    async def http(self, request: Request, scene: TabScene, path: str) -> Response:
        """Return viser's answer to a GET of `path` (without a leading slash)."""
        accepted = request.headers.get("accept-encoding", "identity")
        url = httpx.URL(scheme="http", host="127.0.0.1", port=scene.port, path=f"/{path}")
        try:
            async with self._client.stream("GET", url, headers={"accept-encoding": accepted}) as answer:
                body = b"".join([chunk async for chunk in answer.aiter_raw()])
        except httpx.HTTPError as error:
            _log.warning("the 3-D scene did not answer: %s", error)
            return Response("the 3-D scene did not answer", status_code=502)
        passed = {name: answer.headers[name] for name in _PASSED_BACK if name in answer.headers}
        return Response(body, status_code=answer.status_code, headers=passed)

    async def websocket(self, socket: WebSocket, scene: TabScene) -> None:
        """Join a browser's websocket with viser's until either ends."""
        offered = [Subprotocol(name) for name in socket.scope.get("subprotocols", [])]
        try:
            async with connect(
                f"ws://127.0.0.1:{scene.port}/",
                subprotocols=offered or None,
                additional_headers={KEY_HEADER: scene.key},
                compression=None,
                max_size=None,
                ping_interval=None,
                open_timeout=_TIMEOUT_S,
                proxy=None,
            ) as upstream:
                await socket.accept(subprotocol=upstream.subprotocol)
                pumps = [
                    asyncio.create_task(_outward(upstream, socket)),
                    asyncio.create_task(_inward(socket, upstream)),
                ]
                try:
                    await asyncio.wait(pumps, return_when=asyncio.FIRST_COMPLETED)
                finally:
                    for pump in pumps:
                        pump.cancel()
                    await asyncio.gather(*pumps, return_exceptions=True)
        except (OSError, InvalidHandshake, TimeoutError) as error:
            _log.warning("the 3-D scene did not answer: %s", error)
        await _close(socket)


async def _outward(upstream: ClientConnection, socket: WebSocket) -> None:
    try:
        async for message in upstream:
            if isinstance(message, bytes):
                await socket.send_bytes(message)
            else:
                await socket.send_text(message)
    except (ConnectionClosed, WebSocketDisconnect):
        return


async def _inward(socket: WebSocket, upstream: ClientConnection) -> None:
    try:
        while True:
            message = await socket.receive()
            if message["type"] != "websocket.receive":
                return
            data = message.get("bytes")
            await upstream.send(message.get("text", "") if data is None else data)
    except ConnectionClosed:
        return


async def _close(socket: WebSocket) -> None:
    try:
        await socket.close()
    except (RuntimeError, WebSocketDisconnect):
        return  # it had ended from the browser's side
