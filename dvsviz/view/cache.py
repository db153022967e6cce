"""Encoded images, kept while there is room."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Hashable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class EncodedImage:
    """One image of a window, ready to be sent.

    Attributes:
        kind: `raw`, `warped`, `map` or `texture`.
        mime: media type of `data`.
        data: the file's bytes.
        width: columns.
        height: rows.
    """

    kind: str
    mime: str
    data: bytes
    width: int
    height: int


class ImageCache:
    """Least recently used images, bounded in bytes, for any number of threads.

    Args:
        max_bytes: what all images together may hold.
    """

    def __init__(self, max_bytes: int) -> None:
        if max_bytes < 1:
            raise ValueError(f"max_bytes: expected at least 1, got {max_bytes}")
        self._max_bytes = max_bytes
        self._bytes = 0
        self._images: OrderedDict[Hashable, EncodedImage] = OrderedDict()
        self._lock = threading.Lock()

    @property
    def bytes_held(self) -> int:
        """Bytes of all images."""
        return self._bytes

    def __len__(self) -> int:
        return len(self._images)

    def __contains__(self, key: Hashable) -> bool:
        with self._lock:
            return key in self._images

    def get(self, key: Hashable) -> EncodedImage | None:
        """Return an image and mark it used, or None."""
        with self._lock:
            image = self._images.get(key)
            if image is not None:
                self._images.move_to_end(key)
            return image

    def put(self, key: Hashable, image: EncodedImage) -> None:
        """Keep an image; the least recently used go. One larger than the whole cache is not kept."""
        with self._lock:
            if (old := self._images.pop(key, None)) is not None:
                self._bytes -= len(old.data)
            if len(image.data) > self._max_bytes:
                return
            self._images[key] = image
            self._bytes += len(image.data)
            while self._bytes > self._max_bytes:
                _, gone = self._images.popitem(last=False)
                self._bytes -= len(gone.data)
