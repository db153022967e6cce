"""Where live events come from: an AEDAT4 network stream or an attached camera, both read with dv-processing.

`dvsviz.live.receiver` runs this in a process of its own.
"""

from __future__ import annotations

import re
import socket
import time
from typing import Any

import numpy as np

from dvsviz.events.events import Events
from dvsviz.live.server import LiveError
from dvsviz.live.source import Connection

_ANSWER_S = 3.0
_MOST_EVENTS = 100_000
_CAMERA_HINT = "connect an iniVation camera; on Linux its udev rules are needed, too"
_ADDRESS = re.compile(r"(?:aedat4\+)?tcp://(\[[0-9a-fA-F:.]+\]|[^:/]+):(\d{1,5})/?")


def open_stream(where: str) -> Connection:
    """Open `aedat4+tcp://HOST:PORT` or `camera` in this process.

    Raises:
        LiveError: no such stream or camera, or dv-processing is not installed.
    """
    dv = _library()
    if where == "camera":
        return _Reader(_camera(dv), where)
    host, port = parse_address(where)
    try:
        reader = dv.io.NetworkReader(host, port)
    except (RuntimeError, ValueError, OSError) as error:
        reason = " ".join(str(error).split())[:120]
        hint = f"start the stream, for example with `dvsviz replay FILE --listen {port}`"
        raise LiveError(f"nothing answers at {where} ({reason})", hint=hint) from error
    if not reader.isEventStreamAvailable():
        raise LiveError(f"{where} sends something else than events", hint="choose the stream of events")
    return _Reader(reader, where)


def look(where: str) -> None:
    """Look whether a stream or camera is there: dv-processing would wait for a stream without end.

    Raises:
        LiveError: it is no address, nothing answers there, or no camera is connected.
    """
    if where == "camera":
        if not _library().io.camera.discover():
            raise LiveError("no camera is connected", hint=_CAMERA_HINT)
        return
    host, port = parse_address(where)
    try:
        with socket.create_connection((host, port), timeout=_ANSWER_S) as probe:
            head = probe.recv(12)
    except OSError as error:
        reason = error.strerror or str(error)
        hint = f"start the stream, for example with `dvsviz replay FILE --listen {port}`"
        raise LiveError(f"nothing answers at {where} ({reason})", hint=hint) from error
    if head[8:12] != b"IOHE":
        raise LiveError(f"what answers at {where} is no AEDAT4 stream", hint="check host and port")


def _library() -> Any:
    try:
        import dv_processing as dv
    except ImportError as error:
        hint = "pip install dv-processing (Linux on x86_64)"
        raise LiveError("dv-processing, which reads streams and cameras, is not installed", hint=hint) from error
    return dv


def parse_address(where: str) -> tuple[str, int]:
    """Return host and port of `aedat4+tcp://HOST:PORT`.

    Raises:
        LiveError: it is none.
    """
    found = _ADDRESS.fullmatch(where)
    if found is None or not 1 <= int(found[2]) <= 65_535:
        raise LiveError(f"{where!r} is no stream", hint="expected aedat4+tcp://HOST:PORT, or camera")
    return found[1].strip("[]"), int(found[2])


def _camera(dv: Any) -> Any:
    try:
        return dv.io.camera.open()
    except (RuntimeError, IndexError, OSError) as error:
        raise LiveError(
            f"the camera cannot be opened ({' '.join(str(error).split())[:120]})", hint=_CAMERA_HINT
        ) from error


class _Reader:
    def __init__(self, reader: Any, where: str) -> None:
        self._reader, self._where = reader, where
        width, height = reader.getEventResolution() or (0, 0)
        if min(width, height) < 1:
            raise LiveError(f"{where} does not say its sensor's size", hint="choose another stream")
        self.size = (int(width), int(height))
        self.arrived_s = 0.0

    def read(self) -> Events | None:
        try:
            # Asked first: what arrived before the end is still there after it.
            running = self._reader.isRunning()
            parts, size = [], 0
            # A packet is a millisecond: one by one, recording them costs more than that.
            while size < _MOST_EVENTS and (batch := self._reader.getNextEventBatch()) is not None:
                parts.append(batch.numpy())
                size += len(parts[-1])
            if not parts:
                if not running:
                    raise ConnectionError("it ended")
                return None
            self.arrived_s = time.monotonic()
            rows = np.concatenate(parts)
        except RuntimeError as error:
            raise ConnectionError(" ".join(str(error).split())[:120]) from error
        # Pixels are signed there: below zero becomes a number beyond every sensor, and is dropped.
        return Events(
            t_us=rows["timestamp"].astype(np.int64),
            x_px=rows["x"].astype(np.uint16),
            y_px=rows["y"].astype(np.uint16),
            is_positive=rows["polarity"] != 0,
        )

    def close(self) -> None:
        """Let go of the stream: the library closes what is not used any more."""
        del self._reader
