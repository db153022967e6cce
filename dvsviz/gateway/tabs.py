"""Browser tabs: each has its own playhead, renderer and 3-D scene."""

from __future__ import annotations

import asyncio
import json
import logging
import re
import threading
import time
from concurrent.futures import CancelledError, Future
from typing import Any

from starlette.websockets import WebSocket, WebSocketDisconnect

from dvsviz.errors import DvsvizError
from dvsviz.gateway.library import Library
from dvsviz.gateway.messages import pack_images
from dvsviz.gateway.trial import KINDS, dragged, obey
from dvsviz.gateway.wishes import whole_or_none
from dvsviz.view.cache import ImageCache
from dvsviz.view.compare import lay
from dvsviz.view.images import LONGEST_MS, MOST_WINDOWS, ImageKind, ImageOptions
from dvsviz.view.landscape import LandscapeWish, LandscapeWorker, Objective
from dvsviz.view.moving import Polarities
from dvsviz.view.playback import Drawn, Renderer, Seek
from dvsviz.view.scene import TabScene
from dvsviz.view.shown import ShownSession

_log = logging.getLogger(__name__)

TAB_NAME = re.compile(r"[0-9a-f]{16}")
TAKEN = 4409
_MAX_TABS = 32
# A reload comes back to its scene; a tab that was closed does not.
_SCENE_KEPT_S = 30.0
_SEND_TIMEOUT_S = 10.0
_MAX_MESSAGE = 16 * 1024


class Tab:
    """One browser tab: what it shows and how it is told."""

    def __init__(self, name: str, library: Library, cache: ImageCache) -> None:
        self.name = name
        self.shown: ShownSession | None = None
        self.scene = TabScene(self._go_to, lambda position, wxyz: self.tell(dragged(position, wxyz), "gizmo"))
        self.gone_s = time.monotonic()
        # The last growth that the page was told, None where it was told nothing yet.
        self.told: object = None
        self.told_beside: object = None
        self._library, self._cache = library, cache
        self._loop: asyncio.AbstractEventLoop | None = None
        self._renderer: Renderer | None = None
        self._landscape: LandscapeWorker | None = None
        # What waits to be sent, by slot: a newer message takes the place of one that was not sent.
        self._slots: dict[str, str | bytes] = {}
        self._sent: dict[str, Future[None]] = {}
        self._wake = asyncio.Event()
        self._slots_lock = threading.Lock()

    @property
    def is_connected(self) -> bool:
        """True while a page holds the websocket."""
        return self._renderer is not None

    def shows_beside(self, shown: ShownSession) -> bool:
        """Return whether a session is drawn beside the one that is open."""
        return self.scene.trial.beside is shown

    def tell(self, message: dict[str, Any], slot: str) -> None:
        """Send a message, in place of one of the same slot that still waits; from any thread."""
        self._put(slot, json.dumps(message))

    async def serve(self, socket: WebSocket, hello: dict[str, Any]) -> None:
        """Talk with the page until it goes; `hello` is the first message."""
        self._loop, self._wake = asyncio.get_running_loop(), asyncio.Event()
        # Before the first await: from here on a second page of this name is refused.
        self._renderer = self._new_renderer()
        self.told = self.told_beside = None
        self.tell(hello, "sessions")
        sender: asyncio.Task[None] | None = None
        try:
            await socket.accept()
            sender = asyncio.create_task(self._send(socket))
            while True:
                await self._receive(await socket.receive_text())
        except (WebSocketDisconnect, KeyError):
            pass  # closed, or binary where text was expected
        finally:
            renderer, self._renderer = self._renderer, None
            if renderer is not None:
                renderer.mailbox.close()
            worker, self._landscape = self._landscape, None
            if worker is not None:
                worker.mailbox.close()
            if sender is not None:
                sender.cancel()
            with self._slots_lock:
                self._slots.clear()
                waiting = list(self._sent.values())
                self._sent.clear()
            for future in waiting:
                future.cancel()
            self.gone_s = time.monotonic()

    def stop(self) -> None:
        """Stop renderer and scene."""
        if (renderer := self._renderer) is not None:
            renderer.mailbox.close()
        self.scene.stop()

    def _new_renderer(self) -> Renderer:
        renderer = Renderer(f"tab {self.name}", self._cache, self._send_images, self._fail, self.scene)
        renderer.start()
        return renderer

    async def _receive(self, text: str) -> None:
        """Obey one message; what makes no sense is answered with an error."""
        request = None
        try:
            if len(text) > _MAX_MESSAGE:
                raise ValueError("too long")
            message = json.loads(text)
            kind, request = message["type"], whole_or_none(message.get("request"))
            if kind == "seek":
                await self._seek(message)
            elif kind == "open":
                await self._open(str(message["session"]))
            elif kind == "landscape":
                await self._wish_landscape(message)
            elif kind == "compare":
                await self._compare([str(name) for name in message["sessions"]], int(message.get("window", 0)))
            elif kind in KINDS:
                await obey(message, self.shown, self._library, self.scene.trial)
            elif kind == "layers":
                layers = {str(name): on is True for name, on in message["layers"].items()}
                await asyncio.to_thread(self.scene.set_layers, layers)
            else:
                raise ValueError(f"type {kind!r} is not known")
        except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
            self._fail(f"the page sent a message that makes no sense: {error!r}", request)
        except DvsvizError as error:
            self._fail(str(error), request)

    async def _open(self, name: str) -> ShownSession:
        shown = self._library.opened(name)
        if shown is None:
            try:
                shown = await asyncio.to_thread(self._library.open, name)
            except KeyError:
                raise DvsvizError(f"there is no session {name!r}", hint="choose one of the list") from None
        if self.shown is not shown:
            self.shown = shown
            await asyncio.to_thread(self.scene.open, shown)
        return shown

    async def _seek(self, message: dict[str, Any]) -> None:
        shown = await self._open(str(message["session"]))
        if shown.window_count == 0 or self._renderer is None:
            return
        options = message.get("options") or {}
        seek = Seek(
            shown=shown,
            window=min(max(0, int(message["window"])), shown.window_count - 1),
            request=int(message["request"]),
            kinds=tuple(dict.fromkeys(ImageKind(kind) for kind in message["kinds"])),
            options=ImageOptions(
                polarity=options.get("polarity", True) is True,
                scale=min(max(1, int(options.get("scale", 1))), 4),
                windows=min(max(1, int(options.get("windows", 1))), MOST_WINDOWS),
                ms=min(max(0.0, float(options.get("ms", 0))), LONGEST_MS),
                events=Polarities(options.get("events", "both")),
            ),
        )
        if not self._renderer.is_alive():
            # An error nobody thought of ended it: this tab goes on, and the traceback is in the log.
            self._renderer = self._new_renderer()
        if self._landscape is not None:
            self._landscape.moved(shown, seek.window)
        self._renderer.mailbox.put(seek)

    async def _compare(self, names: list[str], window: int) -> None:
        """Draw other sessions in the scene, laid into the world of the one that is shown."""
        base = self.shown
        others = [await asyncio.to_thread(self._library.open, name) for name in names]

        def draw() -> None:
            laid = [] if base is None else [(other, lay(other, base)) for other in others]
            at = None if base is None or not base.window_count else base.result(min(window, base.window_count - 1))
            self.scene.compared.show(laid, None if at is None else at.start_us)

        await asyncio.to_thread(draw)

    async def _wish_landscape(self, message: dict[str, Any]) -> None:
        """Have the landscape of a window computed in the background; the answer is a message of its own."""
        shown = await self._open(str(message["session"]))
        first, second = (int(axis) for axis in message["axes"])
        wish = LandscapeWish(
            shown=shown,
            window=min(max(0, int(message["window"])), shown.window_count - 1),
            request=int(message["request"]),
            objective=Objective(message["objective"]),
            axes=(first, second),
            zoom=min(max(0.05, float(message.get("zoom", 1.0))), 20.0),
        )
        if self._landscape is None or not self._landscape.is_alive():
            self._landscape = LandscapeWorker(
                f"landscape {self.name}",
                lambda answer: self.tell({"type": "landscape", **answer}, "landscape"),
            )
            self._landscape.start()
        self._landscape.want(wish)

    def _send_images(self, drawn: Drawn) -> None:
        """Send images and wait until they are handed to the network; from the renderer's thread."""
        future = self._put("images", pack_images(drawn))
        try:
            future.result(_SEND_TIMEOUT_S)
        except (TimeoutError, CancelledError):
            return  # a page that takes nothing, or that is gone

    def _fail(self, text: str, request: int | None = None) -> None:
        self.tell({"type": "error", "text": text, "request": request}, "error")

    def _go_to(self, window: int) -> None:
        if self.shown is not None:
            self.tell({"type": "goto", "session": self.shown.name, "window": window}, "goto")

    def _put(self, slot: str, data: str | bytes) -> Future[None]:
        future: Future[None] = Future()
        loop = self._loop
        if loop is None or not self.is_connected:
            future.cancel()
            return future
        with self._slots_lock:
            self._slots[slot] = data
            old = self._sent.pop(slot, None)
            self._sent[slot] = future
        if old is not None:
            old.cancel()
        try:
            loop.call_soon_threadsafe(self._wake.set)
        except RuntimeError:
            future.cancel()  # the server stops
        return future

    async def _send(self, socket: WebSocket) -> None:
        while True:
            await self._wake.wait()
            self._wake.clear()
            while True:
                with self._slots_lock:
                    if not self._slots:
                        break
                    # Images first: somebody waits for them.
                    slot = "images" if "images" in self._slots else next(iter(self._slots))
                    data, future = self._slots.pop(slot), self._sent.pop(slot)
                try:
                    await (socket.send_bytes(data) if isinstance(data, bytes) else socket.send_text(data))
                except (WebSocketDisconnect, RuntimeError):
                    future.cancel()
                    return  # the page is gone: `serve` learns it too
                if not future.cancelled():
                    future.set_result(None)


class Tabs:
    """All tabs of a server, by their names."""

    def __init__(self, library: Library, cache: ImageCache) -> None:
        self._library, self._cache = library, cache
        self._tabs: dict[str, Tab] = {}
        self._lock = threading.Lock()

    def get(self, name: str) -> Tab:
        """Return a tab, made the first time it is asked for; blocks for some milliseconds then.

        Raises:
            KeyError: the name is not 16 hex digits.
            DvsvizError: too many tabs are open.
        """
        if not TAB_NAME.fullmatch(name):
            raise KeyError(name)
        with self._lock:
            tab = self._tabs.get(name)
            if tab is None:
                self._drop(0.0 if len(self._tabs) >= _MAX_TABS else _SCENE_KEPT_S)
                if len(self._tabs) >= _MAX_TABS:
                    raise DvsvizError(f"{_MAX_TABS} tabs are open", hint="close one")
                tab = self._tabs[name] = Tab(name, self._library, self._cache)
            return tab

    def all(self) -> list[Tab]:
        """Return the tabs whose page is there."""
        with self._lock:
            return [tab for tab in self._tabs.values() if tab.is_connected]

    def tidy(self) -> None:
        """Stop the scenes of tabs that were closed."""
        with self._lock:
            self._drop(_SCENE_KEPT_S)

    def close(self) -> None:
        """Stop all scenes."""
        with self._lock:
            for tab in self._tabs.values():
                tab.stop()
            self._tabs.clear()

    def _drop(self, older_s: float) -> None:
        now = time.monotonic()
        gone = [tab for tab in self._tabs.values() if not tab.is_connected and now - tab.gone_s > older_s]
        for tab in gone:
            del self._tabs[tab.name]
            tab.stop()
