"""Who may talk to the server.

The server shows what a person recorded, so neither another web page in the same browser nor another user of the same
machine may look in:

* a token, new at each start, is in the printed address's fragment, which browsers never send; the page changes it for
  a cookie (HttpOnly, SameSite=Strict) that everything but the page's own files needs;
* the Host must be an address, not a name somebody's DNS points at this machine (DNS rebinding);
* the Origin, which browsers send with every websocket and every POST, must be this server's;
* a Content-Security-Policy keeps scripts, frames and connections to this server.
"""

from __future__ import annotations

import ipaddress
import secrets
from http.cookies import CookieError, SimpleCookie
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

PAGE_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; worker-src 'self'; img-src 'self' blob: data:; "
    "font-src 'self'; connect-src 'self'; frame-src 'self'; form-action 'none'; base-uri 'none'; "
    "frame-ancestors 'none'"
)
# viser's client is one file that unpacks itself with WebAssembly and inline scripts, compiles functions from text and
# starts workers from blobs.
SCENE_POLICY = (
    "default-src 'none'; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; style-src 'self' 'unsafe-inline'; "
    "worker-src 'self' blob: data:; img-src 'self' blob: data:; font-src 'self' data:; connect-src 'self' blob: data:; "
    "form-action 'none'; base-uri 'none'; frame-ancestors 'self'"
)
# rerun's viewer is WebAssembly; whatever it would report to its makers is refused with all other foreign addresses.
RERUN_POLICY = (
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "worker-src 'self' blob:; img-src 'self' blob: data:; font-src 'self' data:; connect-src 'self'; "
    "form-action 'none'; base-uri 'none'; frame-ancestors 'none'"
)
_MAX_BODY = 64 * 1024
_OPEN_PATHS = ("/", "/favicon.ico", "/api/login")
_OPEN_FOLDER = "/static/"


class Keys:
    """The token of the printed address and the cookie it is changed for.

    Args:
        port: where the server listens. Cookies are shared by all ports of a host: each needs a name of its own.
    """

    def __init__(self, port: int) -> None:
        self.token = secrets.token_urlsafe(24)
        self._cookie = secrets.token_urlsafe(32)
        self.cookie_name = f"dvsviz_{port}"

    def opens(self, token: object) -> bool:
        """Return whether a token is the printed one."""
        return isinstance(token, str) and secrets.compare_digest(token.encode(), self.token.encode())

    def cookie_header(self) -> str:
        """Return the `Set-Cookie` that a right token is given."""
        return f"{self.cookie_name}={self._cookie}; Path=/; HttpOnly; SameSite=Strict"

    def knows(self, cookies: str) -> bool:
        """Return whether a `Cookie` header holds the cookie."""
        try:
            morsel = SimpleCookie(cookies).get(self.cookie_name)
        except CookieError:
            return False
        return morsel is not None and secrets.compare_digest(morsel.value.encode(), self._cookie.encode())


def host_is_allowed(host: str, extra: str = "") -> bool:
    """Return whether a Host header names this machine by address, as `localhost`, or as the `extra` name.

    A page of a foreign name that was re-pointed at this machine sends its own name.
    """
    try:
        name = urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return False
    if name == "localhost" or (extra and name == extra.lower()):
        return True
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


class Guard:
    """Refuses what is not allowed before anything else sees it, and adds the security headers.

    Args:
        app: what is guarded.
        keys: token and cookie.
        host: the name the server was told to listen at.
    """

    def __init__(self, app: ASGIApp, keys: Keys, host: str) -> None:
        self._app, self._keys, self._host = app, keys, host

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer or pass on one request (ASGI)."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        if (refusal := self._refusal(scope)) is not None:
            status, sentence = refusal
            if scope["type"] == "websocket":
                await send({"type": "websocket.close", "code": 1008, "reason": sentence})
            else:
                response = JSONResponse({"error": sentence}, status_code=status)
                await response(scope, receive, _with_headers(send, scope["path"]))
            return
        await self._app(scope, receive, _with_headers(send, scope["path"]))

    def _refusal(self, scope: Scope) -> tuple[int, str] | None:
        """Return why a request is refused, or None."""
        headers = Headers(scope=scope)
        host, origin = headers.get("host", ""), headers.get("origin")
        if not host_is_allowed(host, self._host):
            return 421, "this name is not one of this server's; open the printed address"
        is_socket = scope["type"] == "websocket"
        if origin is not None and origin not in (f"http://{host}", f"https://{host}"):
            return 403, "another page may not talk to this server"
        if is_socket and origin is None:
            return 403, "a websocket needs an Origin"
        length = headers.get("content-length", "0")
        if "transfer-encoding" in headers or not length.isdigit() or int(length) > _MAX_BODY:
            return 413, "the request is too large"
        path: str = scope["path"]
        is_open = not is_socket and (path in _OPEN_PATHS or path.startswith(_OPEN_FOLDER))
        if not is_open and not self._keys.knows(headers.get("cookie", "")):
            return 403, "not logged in; open the address that the server printed when it started"
        return None


def _with_headers(send: Send, path: str) -> Send:
    is_scene = path.startswith("/viser/")
    policy = SCENE_POLICY if is_scene else RERUN_POLICY if path.startswith("/rerun/") else PAGE_POLICY

    async def send_with_headers(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            headers["Content-Security-Policy"] = policy
            headers["X-Content-Type-Options"] = "nosniff"
            headers["Referrer-Policy"] = "no-referrer"
            headers["Cross-Origin-Opener-Policy"] = "same-origin"
            headers["Cross-Origin-Resource-Policy"] = "same-origin"
            headers["X-Frame-Options"] = "SAMEORIGIN" if is_scene else "DENY"
            if not path.startswith(_OPEN_FOLDER):
                headers.setdefault("Cache-Control", "no-store")
        await send(message)

    return send_with_headers
