"""A process that does nothing but receive, so that a busy tracker never makes it late.

In the tracker's process it shares the interpreter: on a machine with too much to do, a stream of 0.4 million events a
second lost 3 % of its events.

    python -m dvsviz.live.receiver WHERE      messages on standard output, ends when standard input does

A message is a byte that says its kind, when its first event arrived, and the length of what follows: the sensor's
size, events, a stream's end or an error as JSON. Between events an empty message comes every 50 ms.
"""

from __future__ import annotations

import contextlib
import json
import os
import struct
import subprocess
import sys
import threading
from typing import BinaryIO

import numpy as np

from dvsviz.events.events import Events
from dvsviz.live.network import look, open_stream
from dvsviz.live.server import LiveError
from dvsviz.live.source import Connection

_HEAD = struct.Struct("<cdQ")
_SIZE, _EVENTS, _END, _ERROR = b"S", b"E", b"X", b"!"
_ROW = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "?")])
_POLL_S, _BEAT_S, _END_S = 0.002, 0.05, 3.0
# What may wait for a tracker that does not fetch it: 24 million events, 300 MB. Beyond, the stream is given up.
_MOST_WAITING = 24_000_000


def connect(where: str) -> Connection:
    """Open `aedat4+tcp://HOST:PORT` or `camera` in a process of its own.

    Raises:
        LiveError: no such stream or camera, or dv-processing is not installed.
    """
    # Quickly, while a lost stream is waited for.
    look(where)
    return _Received(where)


class _Received:
    """A stream received by another process."""

    def __init__(self, where: str) -> None:
        command = [sys.executable, "-m", "dvsviz.live.receiver", where]
        # A session of its own: Ctrl-C is for the tracker, which ends the receiver.
        self.arrived_s = 0.0
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
        )
        try:
            kind, body = self._message()
            if kind != _SIZE:
                said = json.loads(body)
                raise LiveError(said["message"], hint=said.get("hint"))
            width, height = json.loads(body)
            self.size: tuple[int, int] = (int(width), int(height))
        except ConnectionError as error:
            self.close()
            raise LiveError(f"the receiver of {where} ended", hint="look at what it printed") from error
        except BaseException:
            self.close()
            raise

    def read(self) -> Events | None:
        """Return the next events, or None where none came for a moment."""
        kind, body = self._message()
        if kind != _EVENTS:
            raise ConnectionError(json.loads(body)["message"])
        if not body:
            return None
        rows = np.frombuffer(body, _ROW)
        return Events(
            t_us=rows["t"].copy(), x_px=rows["x"].copy(), y_px=rows["y"].copy(), is_positive=rows["p"] != 0
        )

    def close(self) -> None:
        """End the process."""
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _message(self) -> tuple[bytes, bytes]:
        pipe = self._process.stdout
        if pipe is None:
            raise ConnectionError("the receiver has no output")
        head = pipe.read(_HEAD.size)
        if len(head) < _HEAD.size:
            raise ConnectionError("the receiver ended")
        kind, self.arrived_s, size = _HEAD.unpack(head)
        body = pipe.read(size)
        if len(body) < size:
            raise ConnectionError("the receiver ended")
        return kind, body


class _Outbox:
    """What was received and not sent yet; a thread sends all that waits as one message."""

    def __init__(self, out: BinaryIO, gone: threading.Event) -> None:
        self._out, self._gone = out, gone
        self._waiting: list[np.ndarray] = []
        self._count, self._since_s = 0, 0.0
        self._last: tuple[bytes, bytes] | None = None
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._work, name="outbox")
        self._thread.start()

    def put(self, rows: np.ndarray, arrived_s: float) -> None:
        with self._changed:
            if not self._waiting:
                self._since_s = arrived_s
            if self._count + len(rows) > _MOST_WAITING:
                raise ConnectionError("nobody fetches what is received")
            self._waiting.append(rows)
            self._count += len(rows)
            self._changed.notify()

    def end(self, kind: bytes, message: dict[str, str | None]) -> None:
        """Send what waits, then a last message."""
        with self._changed:
            self._last = (kind, json.dumps(message).encode())
            self._changed.notify()
        self._thread.join()

    def _work(self) -> None:
        try:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._waiting or self._last is not None, _BEAT_S)
                    rows, last, since_s = self._waiting, self._last, self._since_s
                    self._waiting, self._count = [], 0
                body = np.concatenate(rows).tobytes() if rows else b""
                if body or last is None:
                    _send(self._out, _EVENTS, body, since_s)
                if last is not None:
                    _send(self._out, *last)
                    return
        except OSError:  # the tracker has gone
            self._gone.set()


def _send(out: BinaryIO, kind: bytes, body: bytes, arrived_s: float = 0.0) -> None:
    out.write(_HEAD.pack(kind, arrived_s, len(body)))
    out.write(body)
    out.flush()


def _receive(where: str, out: BinaryIO, gone: threading.Event) -> None:
    """Receive until the stream ends or the tracker has gone."""
    try:
        stream = open_stream(where)
    except LiveError as error:
        _send(out, _ERROR, json.dumps({"message": error.message, "hint": error.hint}).encode())
        return
    _send(out, _SIZE, json.dumps(stream.size).encode())
    outbox = _Outbox(out, gone)
    reason = "the tracker has gone"
    try:
        while not gone.is_set():
            events = stream.read()
            if events is None:
                gone.wait(_POLL_S)
                continue
            rows = np.empty(len(events), _ROW)
            rows["t"], rows["x"], rows["y"], rows["p"] = events.t_us, events.x_px, events.y_px, events.is_positive
            outbox.put(rows, stream.arrived_s)
    except ConnectionError as error:
        reason = str(error)
    outbox.end(_END, {"message": reason})


def main() -> None:
    """Receive what the command line names."""
    # The library prints, too: the messages keep standard output to themselves.
    # Where the tracker has gone nobody is left to be told.
    with contextlib.suppress(BrokenPipeError), os.fdopen(os.dup(1), "wb") as out:
        os.dup2(2, 1)
        gone = threading.Event()

        def wait_for_end() -> None:
            os.read(0, 1)
            gone.set()

        threading.Thread(target=wait_for_end, name="end", daemon=True).start()
        _receive(sys.argv[1], out, gone)


if __name__ == "__main__":
    main()
