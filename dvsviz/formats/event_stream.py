"""Event Stream files (`.es`, version 2) of DVS and ATIS sensors; our own reader, the libraries for it being GPL."""

from __future__ import annotations

import struct
from pathlib import Path

import numba
import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import FormatError
from dvsviz.formats.sink import RecordingSink
from dvsviz.geometry.camera import Camera

MAGIC = b"Event Stream"
FORMAT_NAME = "Event Stream"
_DVS, _ATIS = 1, 2
_TYPES = {0: "generic events", _DVS: "DVS events", _ATIS: "ATIS events", 3: "display events", 4: "colour events"}
_HEADER_BYTES = 20
_BLOCK_BYTES = 1 << 20

# State between blocks: time, byte of the event (0 idle), low byte of x, x, low byte of y, polarity, is an exposure.
_STATE_SIZE = 7


@numba.njit(cache=True, nogil=True)
def _decode(data, is_atis, state, t_us, x_px, y_px, is_positive):
    """Return (events, exposure measurements left out) of the bytes, which may start and end inside an event."""
    n, exposures = 0, 0
    for i in range(len(data)):
        b = np.int64(data[i])
        step = state[1]
        if step == 0:
            if is_atis:
                if b & 0xFC == 0xFC:
                    state[0] += 63 * (b & 0x3)
                    continue
                state[0] += b >> 2
                state[5], state[6] = (b >> 1) & 1, b & 1
            else:
                if b == 0xFF:
                    state[0] += 127
                    continue
                if b == 0xFE:
                    continue
                state[0] += b >> 1
                state[5], state[6] = b & 1, 0
            state[1] = 1
        elif step == 1:
            state[2], state[1] = b, 2
        elif step == 2:
            state[3], state[1] = state[2] | (b << 8), 3
        elif step == 3:
            state[4], state[1] = b, 4
        else:
            state[1] = 0
            if state[6]:
                exposures += 1
            else:
                t_us[n], x_px[n], y_px[n] = state[0], state[3], state[4] | (b << 8)
                is_positive[n] = state[5] == 1
                n += 1
    return n, exposures


def convert_event_stream(path: Path, sink: RecordingSink) -> None:
    """Read a DVS or ATIS stream into a recording; exposure measurements of an ATIS are left out and counted.

    The format counts rows from the bottom of the sensor: they are turned over here.

    Raises:
        FormatError: another version or type of stream, or a file cut short inside an event.
    """
    with path.open("rb") as file:
        head = file.read(_HEADER_BYTES)
        if len(head) < _HEADER_BYTES:
            raise FormatError("the header is cut short", path=path, hint="copy it again")
        version, kind = head[12], head[15]
        if version != 2:
            hint = "only version 2 is known"
            raise FormatError(f"Event Stream version {version}", path=path, place="byte 12", hint=hint)
        if kind not in (_DVS, _ATIS):
            what = _TYPES.get(kind, f"type {kind}")
            hint = "only DVS and ATIS streams hold events of a camera"
            raise FormatError(f"a stream of {what}", path=path, place="byte 15", hint=hint)
        width, height = struct.unpack("<HH", head[16:20])
        if width == 0 or height == 0:
            raise FormatError(f"a sensor of {width}x{height}", path=path, place="byte 16", hint="copy it again")
        sink.start(Camera.guess(width, height))
        state, exposures, total = np.zeros(_STATE_SIZE, np.int64), 0, path.stat().st_size
        while data := file.read(_BLOCK_BYTES):
            t, x, y, p, skipped = _block(data, kind == _ATIS, state)
            exposures += skipped
            sink.add(t, x, height - 1 - y, p)
            sink.options.report(file.tell() / total)
    if state[1] != 0:
        if not sink.options.repair:
            hint = "copy it again, or read what is there with --repair"
            raise FormatError("cut short inside an event", path=path, place=f"byte {total}", hint=hint)
        sink.dropped(int(state[1]), "bytes of a last event that was cut short")
    if exposures:
        sink.warn(f"{exposures} exposure measurements left out")


def _block(
    data: bytes, is_atis: bool, state: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_], int]:
    rows = len(data) // 5 + 1
    t, x, y = (np.empty(rows, np.int64) for _ in range(3))
    p = np.empty(rows, np.bool_)
    n, exposures = _decode(np.frombuffer(data, np.uint8), is_atis, state, t, x, y, p)
    return t[:n], x[:n], y[:n], p[:n], int(exposures)
