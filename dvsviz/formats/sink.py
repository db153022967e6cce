"""Where readers of foreign formats put what they read: checked or repaired, then written to a recording."""

from __future__ import annotations

import json
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import FormatError
from dvsviz.events.events import Events
from dvsviz.events.recording import Imu
from dvsviz.formats.checks import check_sensor
from dvsviz.formats.hdf5 import RecordingWriter
from dvsviz.formats.options import OpenOptions
from dvsviz.formats.repair import EventRepair
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.trajectory import Trajectory

FORMAT_NOTE, WARNINGS_NOTE, TRIGGERS_NOTE = "source_format", "source_warnings", "source_triggers"
OUT_OF_ORDER = "events whose time ran backwards"


class RecordingSink:
    """Writes what a reader found into a recording of our own format.

    Args:
        target: the recording to make.
        source: the file that is read, named in errors.
        format_name: the layout of `source`, as `dvsviz info` prints it.
        options: of reading.
    """

    def __init__(self, target: Path, source: Path, format_name: str, options: OpenOptions) -> None:
        self.source, self.options = source, options
        self._target, self._format = target, format_name
        self._warnings: list[str] = []
        self._writer: RecordingWriter | None = None
        self._camera: Camera | None = None
        self._repair: EventRepair | None = None
        self._count = 0

    @property
    def camera(self) -> Camera:
        """The sensor and its calibration, once `start` was called."""
        if self._camera is None:
            raise ValueError("camera: expected start() to be called first")
        return self._camera

    @property
    def count(self) -> int:
        """Events written so far."""
        return self._count

    def start(self, camera: Camera) -> None:
        """Fix the sensor's size and calibration; the user's size is obeyed where one was given.

        Raises:
            FormatError: the sensor is larger than any camera's.
        """
        self._camera = resize(camera, self.options.size)
        check_sensor(self.camera.width, self.camera.height, self.source)
        self._repair = EventRepair(self.camera.width, self.camera.height) if self.options.repair else None
        self._writer = RecordingWriter(self._target, camera=self.camera)

    def add(self, t_us: NDArray, x_px: NDArray, y_px: NDArray, is_positive: NDArray[np.bool_]) -> None:
        """Add the next events (N,), columns of any integer type.

        Raises:
            FormatError: an event is out of order or outside the sensor, and `repair` is not set.
        """
        if len(t_us) == 0:
            return
        if self._repair is not None:
            events = self._repair(t_us, x_px, y_px, is_positive)
        else:
            # Below zero becomes 65,535, which lies outside every sensor, so that the check below names the event.
            x, y = (
                v if v.dtype == np.uint16 else np.where((v < 0) | (v > 65_535), 65_535, v).astype(np.uint16)
                for v in (x_px, y_px)
            )
            events = Events(t_us=t_us.astype(np.int64, copy=False), x_px=x, y_px=y, is_positive=is_positive)
        self._count += len(events)
        try:
            self._started().append(events)
        except FormatError as error:
            if error.path != self._target:
                raise
            raise FormatError(error.message, path=self.source, place=error.place, hint=error.hint) from error

    def set_ground_truth(self, trajectory: Trajectory) -> None:
        """Store true poses."""
        self._started().set_ground_truth(trajectory)

    def set_imu(self, imu: Imu) -> None:
        """Store inertial measurements along the optical axes."""
        self._started().set_imu(imu)

    def add_frame(self, t_us: int, image: NDArray[np.uint8]) -> None:
        """Add an intensity frame (height, width)."""
        self._started().append_frame(t_us, image)

    def set_triggers(self, counts: dict[str, int]) -> None:
        """Tell how many triggers of each kind there are; `info` lists them, their times are not kept."""
        self._started().set_note(TRIGGERS_NOTE, json.dumps(counts))

    def warn(self, text: str) -> None:
        """Say something about what was assumed or dropped."""
        self._warnings.append(text)

    def dropped(self, count: int, what: str) -> None:
        """Say that something was dropped, where anything was."""
        if count:
            self.warn(f"repaired: {count} {what if count > 1 else _one(what)} dropped")

    def close(self) -> None:
        """Finish the recording.

        Raises:
            FormatError: it holds no event.
        """
        writer = self._started()
        if self._repair is not None:
            if self._repair.wraps:
                times = "once" if self._repair.wraps == 1 else f"{self._repair.wraps} times"
                self.warn(f"repaired: a clock that began anew at its largest number {times} was carried on")
            self.dropped(self._repair.backwards, OUT_OF_ORDER)
            self.dropped(self._repair.outside, "events outside the sensor")
        if self._count == 0:
            raise FormatError("there are no events", path=self.source, hint="record or copy it again")
        writer.set_note(FORMAT_NOTE, self._format)
        writer.set_note(WARNINGS_NOTE, json.dumps(self._warnings))
        writer.close()

    def _started(self) -> RecordingWriter:
        if self._writer is None:
            raise ValueError("writer: expected start() to be called first")
        return self._writer

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None):
        try:
            if kind is None:
                self.close()
        finally:
            # After a close that went well there is nothing left to remove.
            if self._writer is not None:
                self._writer.discard()


def _one(what: str) -> str:
    """Return the words for one of several: `lines that are …` as `line that is …`."""
    noun, _, rest = what.partition(" ")
    return f"{noun.removesuffix('s')} {rest.replace('that are ', 'that is ')}".rstrip()


def resize(camera: Camera, size: tuple[int, int] | None) -> Camera:
    """Return the camera with another sensor size; a guess is guessed anew."""
    if size is None or size == (camera.width, camera.height):
        return camera
    width, height = size
    if camera.is_guess:
        return Camera.guess(width, height)
    return Camera(
        width=width,
        height=height,
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
        distortion=camera.distortion,
    )
