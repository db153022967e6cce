"""Images and tracker states as bytes, and back, with limits that a hostile file cannot exceed."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

# Level 1 packs a checkpoint about ten times faster than level 6 and is a few percent larger.
_LEVEL = 1
# Larger than any sensor or map: refuses an image of which one row would fill the memory.
_MAX_PIXELS = 1 << 28
_MAX_STATE_BYTES = 1 << 32


def encode_png(image: NDArray[np.uint8]) -> bytes:
    """Return a grey image (rows, columns) as PNG; an empty image gives no bytes."""
    if image.size == 0:
        return b""
    if image.ndim != 2 or image.dtype != np.uint8:
        raise ValueError(f"image: expected (rows, columns) uint8, got {image.shape} {image.dtype}")
    return cv2.imencode(".png", image)[1].tobytes()


def decode_png(data: bytes, *, place: str) -> NDArray[np.uint8]:
    """Return the grey image (rows, columns) of a PNG, (0, 0) for no bytes.

    Raises:
        ValueError: not a grey PNG that OpenCV can read, or too large; it names `place`.
    """
    if not data:
        return np.zeros((0, 0), np.uint8)
    # The header is checked first: the decoder allocates what it says.
    if len(data) < 33 or data[:8] != b"\x89PNG\r\n\x1a\n" or data[12:16] != b"IHDR":
        raise ValueError(f"{place}: not a PNG image")
    columns, rows = struct.unpack(">II", data[16:24])
    if rows * columns > _MAX_PIXELS:
        raise ValueError(f"{place}: an image of {columns}x{rows} is too large")
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise ValueError(f"{place}: the image cannot be decoded")
    return np.asarray(image, dtype=np.uint8)


def pack_state(state: Mapping[str, NDArray]) -> tuple[bytes, int]:
    """Return named arrays as compressed bytes, and how many bytes they are uncompressed.

    Raises:
        ValueError: an array holds Python objects.
    """
    arrays = {name: np.ascontiguousarray(value).reshape(np.shape(value)) for name, value in state.items()}
    for name, array in arrays.items():
        if array.dtype.hasobject or array.dtype.kind not in "biufUS":
            raise ValueError(f"state {name!r}: expected numbers or text, got {array.dtype}")
    head = json.dumps([[name, array.dtype.str, array.shape] for name, array in arrays.items()]).encode()
    raw = struct.pack("<I", len(head)) + head + b"".join(array.tobytes() for array in arrays.values())
    return zlib.compress(raw, _LEVEL), len(raw)


def unpack_state(data: bytes, unpacked_count: int, *, place: str) -> dict[str, NDArray]:
    """Return the named arrays of `pack_state`.

    Raises:
        ValueError: the bytes are not such arrays; it names `place`.
    """
    if not 4 <= unpacked_count <= _MAX_STATE_BYTES:
        raise ValueError(f"{place}: expected 4 to {_MAX_STATE_BYTES} bytes, got {unpacked_count}")
    try:
        raw = zlib.decompressobj().decompress(data, unpacked_count)
    except zlib.error as error:
        raise ValueError(f"{place}: cannot be decompressed") from error
    if len(raw) != unpacked_count:
        raise ValueError(f"{place}: expected {unpacked_count} bytes, got {len(raw)}")
    start = 4 + struct.unpack_from("<I", raw)[0]
    out: dict[str, NDArray] = {}
    for name, kind, shape in json.loads(raw[4:start]):
        dtype = np.dtype(str(kind))
        if dtype.hasobject or any(int(n) < 0 for n in shape):
            raise ValueError(f"{place}: expected numbers or text, got {dtype} {shape}")
        count = int(np.prod(shape, dtype=object)) if shape else 1
        if start + count * dtype.itemsize > len(raw):
            raise ValueError(f"{place}: array {name!r} is cut off")
        out[str(name)] = np.frombuffer(raw, dtype, count, start).reshape(shape).copy()
        start += count * dtype.itemsize
    return out
