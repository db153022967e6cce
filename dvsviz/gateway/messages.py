"""The binary messages of `docs/dashboard-protocol.md`."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dvsviz.view.playback import Drawn

_TYPES = {"float64": "f64", "float32": "f32", "uint8": "u8"}


def pack_columns(start: int, columns: dict[str, NDArray[Any]]) -> bytes:
    """Return columns (N,) or (N, width) of windows from `start` on, one after the other, each padded to 8 bytes."""
    count = len(next(iter(columns.values())))
    listed = [
        {
            "name": name,
            "dtype": _TYPES[values.dtype.name],
            "width": 1 if values.ndim == 1 else values.shape[1],
            "unit": _unit(name),
        }
        for name, values in columns.items()
    ]
    header = json.dumps({"start": start, "count": count, "columns": listed}).encode()
    header += b" " * (-(4 + len(header)) % 8)
    parts = [struct.pack("<I", len(header)), header]
    for values in columns.values():
        data = np.ascontiguousarray(values).tobytes()
        parts += [data, bytes(-len(data) % 8)]
    return b"".join(parts)


def pack_images(drawn: Drawn) -> bytes:
    """Return the images and numbers of one window."""
    header = {
        "type": "images",
        "session": drawn.seek.shown.name,
        "window": drawn.seek.window,
        "request": drawn.seek.request,
        "images": [
            {"kind": i.kind, "mime": i.mime, "bytes": len(i.data), "width": i.width, "height": i.height}
            for i in drawn.images
        ],
        "values": drawn.values,
    }
    text = json.dumps(header, allow_nan=False).encode()
    return b"".join([struct.pack("<I", len(text)), text, *(image.data for image in drawn.images)])


def _unit(name: str) -> str:
    for ending, unit in (("_hz", "Hz"), ("_deg", "deg"), ("_percent", "%"), ("_s", "s")):
        if name.endswith(ending):
            return unit
    return ""
