"""Intensity frames from image files."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import NoReturn

import cv2
import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import FormatError

_PNG = b"\x89PNG\r\n\x1a\n"
_MAX_SIDE = 8192
MAX_IMAGE_BYTES = 64 << 20


def decode_image(data: bytes, path: Path) -> NDArray[np.uint8]:
    """Return the grey values (height, width) of an encoded image; `path` is named in errors.

    Raises:
        FormatError: not an image, a damaged one, or one of an absurd size.
    """
    if data.startswith(_PNG) and len(data) >= 24:
        # A png of a few bytes may claim gigabytes of pixels: its size is looked at before it is unpacked.
        width, height = struct.unpack(">II", data[16:24])
        if max(width, height) > _MAX_SIDE:
            _refuse(f"an image of {width}x{height}", path)
    if not data:
        _refuse("an empty image file", path)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    except cv2.error as error:
        raise FormatError("not an image that can be read", path=path, hint="copy it again") from error
    if image is None:
        _refuse("not an image that can be read", path)
    return np.ascontiguousarray(image, np.uint8)


def _refuse(message: str, path: Path) -> NoReturn:
    raise FormatError(message, path=path, hint="copy it again, or remove its line from images.txt")
