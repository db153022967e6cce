"""A server of events: any recording as an AEDAT4 network stream, at the pace at which it was recorded."""

from __future__ import annotations

import array
import contextlib
import itertools
import queue
import socket
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING, Self

import numpy as np

from dvsviz.errors import DvsvizError
from dvsviz.events.events import Events
from dvsviz.live.packets import event_packet, stream_header

try:
    import fcntl
    import termios
except ImportError:  # not on Windows
    fcntl = termios = None

if TYPE_CHECKING:
    from dvsviz.events.recording import Recording

# A packet a millisecond is what cameras send; packets of this many events are cut.
_PACKET_US = 1000
_PACKET_EVENTS = 50_000
# Two seconds of a stream: a client that is later than that loses packets, the others do not wait for it.
_QUEUED_PACKETS = 2000
_GIVE_UP_S, _DRAIN_S = 2.0, 15.0
_POLL_S, _STAYS_S, _LINGER_S = 0.02, 0.3, 2.0


class LiveError(DvsvizError):
    """A stream or camera that cannot be opened or served."""


class EventServer:
    """Sends events to every client that is connected.

    Args:
        host: address to listen at.
        port: port to listen at; 0 for any free one (`port` says which).
        width: sensor columns.
        height: sensor rows.

    Attributes:
        port: the port it listens at.

    Raises:
        LiveError: the address cannot be listened at.
    """

    def __init__(self, host: str, port: int, *, width: int, height: int) -> None:
        self._header = stream_header(width, height)
        try:
            self._socket = socket.create_server((host, port))
        except OSError as error:
            reason = error.strerror or str(error)
            raise LiveError(f"cannot listen at {host}:{port} ({reason})", hint="choose another --listen") from error
        self.port = int(self._socket.getsockname()[1])
        self._clients: list[_Client] = []
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._accept, name="event server", daemon=True)
        self._thread.start()

    @property
    def clients(self) -> int:
        """How many clients are connected."""
        with self._lock:
            self._clients = [client for client in self._clients if client.is_there]
            return len(self._clients)

    def wait_for_client(self, stop: threading.Event | None = None) -> bool:
        """Wait until a client is there to stay; False where `stop` was set before.

        A client looks first whether anybody answers, and goes again: that is none to begin for.
        """
        stop = stop or threading.Event()
        while not stop.wait(_POLL_S):
            with self._lock:
                if any(client.is_there and time.monotonic() - client.since > _STAYS_S for client in self._clients):
                    return True
        return False

    def send(self, events: Events) -> None:
        """Send events to all clients; one that does not keep up loses them."""
        if len(events) == 0 or self.clients == 0:
            return
        data = event_packet(events)
        with self._lock:
            for client in self._clients:
                client.send(data)

    def close(self) -> None:
        """Send what is queued, and end."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        self._thread.join(_GIVE_UP_S)
        with self._lock:
            for client in self._clients:
                client.close()

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._socket.accept()
            except OSError:  # closed
                return
            with self._lock:
                self._clients.append(_Client(connection, self._header))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None):
        self.close()


class _Client:
    """One connection, with a thread that waits for it."""

    def __init__(self, connection: socket.socket, header: bytes) -> None:
        self._ended, self.lost, self.since = False, 0, time.monotonic()
        # A packet a millisecond is sent at once and not kept until the one before it was acknowledged.
        with contextlib.suppress(OSError):  # it has gone already: sending will tell
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket = connection
        self._queue: queue.Queue[bytes | None] = queue.Queue(_QUEUED_PACKETS)
        self._queue.put(header)
        self._thread = threading.Thread(target=self._work, name="event client", daemon=True)
        self._thread.start()

    @property
    def is_there(self) -> bool:
        """Whether it is still connected; clients send nothing, so that what can be read is their end."""
        if not self._ended:
            try:
                self._ended = not self._socket.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT)
            except BlockingIOError:
                pass
            except OSError:
                self._ended = True
        return not self._ended

    def send(self, data: bytes) -> None:
        try:
            self._queue.put_nowait(data)
        except queue.Full:
            self.lost += 1

    def close(self) -> None:
        with contextlib.suppress(queue.Full):
            self._queue.put(None, timeout=_GIVE_UP_S)
        # What is queued is two seconds at most; a client that takes longer than this for it has stopped reading.
        self._thread.join(_DRAIN_S)
        self._end()

    def _work(self) -> None:
        try:
            while (data := self._queue.get()) is not None:
                self._socket.sendall(data)
            # Readers of dv-processing throw away what they have not parsed yet when a stream ends: it is held open
            # until all has arrived, and for as long as a busy machine may need to read that.
            self._linger(_DRAIN_S, until=lambda: _unsent_bytes(self._socket) == 0)
            self._linger(_LINGER_S, until=lambda: False)
        except OSError:  # the client has gone
            pass
        finally:
            self._end()

    def _linger(self, seconds: float, *, until: Callable[[], bool]) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end and self.is_there and not until():
            time.sleep(_POLL_S)

    def _end(self) -> None:
        self._ended = True
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()


def _unsent_bytes(connection: socket.socket) -> int:
    """Return how many bytes the other side's system has not taken yet; 0 where the system does not tell."""
    count = array.array("i", [0])
    if fcntl is not None and termios is not None:
        with contextlib.suppress(OSError):
            fcntl.ioctl(connection, termios.TIOCOUTQ, count)
    return count[0]


def replay(
    recording: Recording,
    server: EventServer,
    *,
    speed: float = 1.0,
    stop: threading.Event | None = None,
    progress: Callable[[float], None] | None = None,
) -> float:
    """Send a recording at its own pace and return the seconds by which the last packet was late at worst.

    Args:
        recording: what is sent.
        server: to whom.
        speed: recording seconds a second.
        stop: ends it early when set.
        progress: called with the share done, 0 to 1.

    Raises:
        ValueError: `speed` is not above 0.
    """
    if not 0 < speed < np.inf:
        raise ValueError(f"speed: expected a number above 0, got {speed}")
    first_us, span_us = recording.first_us, max(1, recording.last_us - recording.first_us)
    started, latest = time.monotonic(), 0.0
    for events in recording.chunks(_PACKET_EVENTS):
        marks = np.arange(int(events.t_us[0]), int(events.t_us[-1]) + _PACKET_US, _PACKET_US)
        cuts = [*np.unique(np.searchsorted(events.t_us, marks)).tolist(), len(events)]
        for begin, end in itertools.pairwise(cuts):
            if end == begin:
                continue
            # A packet is sent when its last event has happened.
            due = started + (int(events.t_us[end - 1]) - first_us) * 1e-6 / speed
            wait = due - time.monotonic()
            if stop is not None and stop.wait(max(0.0, wait)):
                return latest
            if stop is None and wait > 0:
                time.sleep(wait)
            latest = max(latest, time.monotonic() - due)
            server.send(events[begin:end])
        if progress is not None:
            progress((int(events.t_us[-1]) - first_us) / span_us)
    return latest
