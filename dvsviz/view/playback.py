"""From seeks to images: one slot that the latest seek wins, one thread that draws.

A seek that was not drawn before the next one came is never drawn: whoever drags over a thousand windows sees those
that could be drawn in time, and rests on the right one.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

from dvsviz.errors import DvsvizError
from dvsviz.view.cache import EncodedImage, ImageCache
from dvsviz.view.drawing import draw
from dvsviz.view.images import ImageKind, ImageOptions
from dvsviz.view.shown import ShownSession

_log = logging.getLogger(__name__)

# Windows drawn ahead of and behind a resting playhead: half a second of playback at 33 windows per second.
_AHEAD, _BEHIND = 16, 4

# Why a window cannot be drawn; a session that is replaced by another meanwhile has fewer windows than a moment ago.
_REASONS = (DvsvizError, OSError, ValueError, RuntimeError, IndexError, KeyError)

# A playhead that did not move for this long rests.
_REST_S = 0.07


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Seek:
    """A wish to see one window.

    Attributes:
        shown: the session.
        window: number of the window.
        request: the asker's number, given back with the images.
        kinds: images that are wanted.
        options: how they are drawn.
    """

    shown: ShownSession
    window: int
    request: int
    kinds: tuple[ImageKind, ...]
    options: ImageOptions


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drawn:
    """The images of one seek.

    Attributes:
        seek: what was asked for.
        images: those that could be drawn.
        values: the numbers beside them.
    """

    seek: Seek
    images: tuple[EncodedImage, ...]
    values: dict[str, Any]


Wish = TypeVar("Wish")


class Mailbox(Generic[Wish]):
    """One slot for a wish: putting replaces what was not taken yet."""

    def __init__(self) -> None:
        self._condition = threading.Condition()
        self._wish: Wish | None = None
        self._closed = False

    def put(self, wish: Wish) -> None:
        """Leave a wish; it replaces one that was not taken."""
        with self._condition:
            self._wish = wish
            self._condition.notify()

    def take(self, timeout_s: float | None = None) -> Wish | None:
        """Return the wish as soon as there is one; None after the timeout or when the box was closed."""
        with self._condition:
            self._condition.wait_for(lambda: self._wish is not None or self._closed, timeout_s)
            wish, self._wish = self._wish, None
            return wish

    @property
    def is_empty(self) -> bool:
        """True where no wish waits."""
        return self._wish is None

    def stays_empty(self, seconds: float) -> bool:
        """Wait, and return True where none came."""
        with self._condition:
            return not self._condition.wait_for(lambda: self._wish is not None or self._closed, seconds)

    @property
    def is_closed(self) -> bool:
        """True after `close`."""
        return self._closed

    def close(self) -> None:
        """Wake the taker for the last time."""
        with self._condition:
            self._closed = True
            self._condition.notify()


class Scene(Protocol):
    """What follows the playhead in 3-D."""

    def show(self, drawn: Drawn) -> None:
        """Move to the window."""
        ...

    def settle(self, drawn: Drawn) -> None:
        """Bring what is slow up to date: the playhead rests."""
        ...


class Renderer(threading.Thread):
    """Draws the seeks of one tab: images first, the 3-D scene after, neighbours of a resting playhead last.

    Args:
        name: of the thread.
        cache: shared by all tabs.
        send: gives images to the tab and returns once they are on their way; a slow tab so slows only itself.
        fail: gives a sentence to the tab, with the request that is not answered.
        scene: the tab's 3-D scene, or None.
    """

    def __init__(
        self,
        name: str,
        cache: ImageCache,
        send: Callable[[Drawn], None],
        fail: Callable[[str, int], None],
        scene: Scene | None,
    ) -> None:
        super().__init__(name=name, daemon=True)
        self.mailbox: Mailbox[Seek] = Mailbox()
        self._cache, self._send, self._fail, self._scene = cache, send, fail, scene
        self._last: Seek | None = None
        self._step = 1

    def run(self) -> None:
        """Draw until the mailbox is closed."""
        while not self.mailbox.is_closed:
            seek = self.mailbox.take()
            if seek is None:
                continue
            try:
                self._serve(seek)
            except _REASONS as error:
                _log.warning("window %d of %s could not be drawn: %r", seek.window, seek.shown.name, error)
                self._fail(f"window {seek.window} of {seek.shown.name} could not be drawn: {error}", seek.request)

    def draw(self, seek: Seek) -> Drawn:
        """Return the images and numbers of a seek."""
        found = (self.image(seek.shown, seek.window, kind, seek.options) for kind in seek.kinds)
        drawn = tuple(image for image in found if image is not None)
        return Drawn(seek=seek, images=drawn, values=seek.shown.values(seek.window))

    def image(
        self, shown: ShownSession, window: int, kind: ImageKind, options: ImageOptions
    ) -> EncodedImage | None:
        """Return one image, from the cache where it is there."""
        # A live session gets new maps after a window was drawn on an old one.
        on_map = -1
        if kind in (ImageKind.MAP, ImageKind.ALIGNED):
            on_map = shown.map_now()
        elif kind in (ImageKind.TEXTURE, ImageKind.RESIDUAL):
            on_map = shown.map_number(window)
        # All windows between two revisions share one texture.
        place = -1 if kind is ImageKind.TEXTURE and shown.registration is None else window
        key = (shown.generation, place, kind, options, on_map)
        image = self._cache.get(key)
        if image is None:
            picture = draw(shown, window, kind, options)
            if picture is None:
                return None
            image = EncodedImage(
                kind=kind, mime="image/png", data=picture.png(), width=picture.width, height=picture.height
            )
            self._cache.put(key, image)
        return image

    def _serve(self, seek: Seek) -> None:
        drawn = self.draw(seek)
        self._send(drawn)
        if self._last is not None and self._last.shown is seek.shown and self._last.window != seek.window:
            self._step = 1 if seek.window > self._last.window else -1
        self._last = seek
        if self._scene is not None and self.mailbox.is_empty:
            self._scene.show(drawn)
        self._prefetch(seek)
        if self._scene is not None and self.mailbox.stays_empty(_REST_S):
            self._scene.settle(drawn)

    def _prefetch(self, seek: Seek) -> None:
        """Draw the neighbours, nearest first, until the next seek comes."""
        steps = [*(k * self._step for k in range(1, _AHEAD + 1)), *(-k * self._step for k in range(1, _BEHIND + 1))]
        for window in (seek.window + step for step in steps):
            if not self.mailbox.is_empty or self.mailbox.is_closed:
                return
            if 0 <= window < seek.shown.window_count:
                for kind in seek.kinds:
                    self.image(seek.shown, window, kind, seek.options)
