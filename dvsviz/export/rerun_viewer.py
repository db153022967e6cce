"""A rerun viewer that is open now: a run is streamed to it over gRPC instead of into a file."""

from __future__ import annotations

import logging
import socket
from dataclasses import dataclass

import rerun as rr
import rerun.blueprint as rrb

from dvsviz.errors import DvsvizError
from dvsviz.export.rrd_file import APPLICATION

_log = logging.getLogger(__name__)

DEFAULT_PORT = 9876
"""Where `rerun` listens unless told otherwise."""

_WAIT_S = 2.0
_END_S = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class RerunViewer:
    """Where a viewer listens.

    Attributes:
        host: name or address.
        port: of its gRPC server.
    """

    host: str = "127.0.0.1"
    port: int = DEFAULT_PORT

    @property
    def url(self) -> str:
        """The address as rerun writes it."""
        return f"rerun+http://{self.host}:{self.port}/proxy"

    def look(self) -> None:
        """Return where a viewer listens.

        Raises:
            DvsvizError: nobody listens there.
        """
        try:
            socket.create_connection((self.host, self.port), timeout=_WAIT_S).close()
        except OSError as error:
            other = "" if self.port == DEFAULT_PORT else f" --port {self.port}"
            raise DvsvizError(
                f"no rerun viewer listens at {self.host}:{self.port}",
                hint=f"open one with `rerun{other}` in another terminal, or leave --rerun away",
            ) from error


class ViewerStream:
    """A recording stream to a viewer; a viewer that is closed meanwhile does not end the run."""

    def __init__(self, viewer: RerunViewer, blueprint: rrb.Blueprint, *, name: str) -> None:
        """Begin a recording.

        Args:
            viewer: where it is shown.
            blueprint: how it opens.
            name: what the viewer calls the recording.

        Raises:
            DvsvizError: nobody listens there.
        """
        viewer.look()
        self._viewer = viewer
        self.stream = rr.RecordingStream(APPLICATION)
        self.stream.connect_grpc(viewer.url, default_blueprint=blueprint)
        self.stream.send_recording_name(name)

    def finish(self, expected: dict[str, int]) -> None:
        """End the recording; it stays open in the viewer."""
        self.abandon()

    def abandon(self) -> None:
        """End the recording where it is."""
        try:
            self.stream.flush(timeout_sec=_END_S)
        except (RuntimeError, ValueError) as error:
            _log.warning("the rerun viewer at %s did not take the end of the run: %s", self._viewer.url, error)
        self.stream.disconnect()
