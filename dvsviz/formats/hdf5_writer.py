"""Writing of our HDF5 recording, `dvsviz-recording` version 1 (docs/recording-format.md)."""

from __future__ import annotations

import os
import threading
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from dvsviz.errors import FormatError
from dvsviz.events.events import Events
from dvsviz.events.recording import Imu
from dvsviz.formats.checks import check_events
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.trajectory import Trajectory
from dvsviz.session.lock import WriterLock, has_writer

FORMAT = "dvsviz-recording"
VERSION = 1

# Measured on DAVIS events: without compression 14 B an event at 30 million events/s, lzf with shuffle 3.5 B at 7.5,
# gzip 2.9 B at 5: reading does 12 million events/s with either.
_CHUNK = 1 << 16
_COMPRESSION: dict[str, Any] = {"compression": "lzf", "shuffle": True}
# Recordings longer than six hours get no millisecond index: readers do not need it, and one wrong time years ahead
# must not fill the disk.
_MAX_INDEX_MS = 21_600_000
_INDEX_BLOCK = 1 << 18
_COLUMNS = (("t", np.int64), ("x", np.uint16), ("y", np.uint16), ("p", np.uint8))


class RecordingWriter:
    """Writes a recording to a temporary name beside `path` and renames it when the with-block ends well.

    Args:
        path: the file to make; replaced where it exists.
        camera: sensor size and calibration; a guessed calibration is not written.
        growing: others may read the events while they are written (`hdf5_growing`); nothing but events can be added
            then, and they are not compressed, as a compressed chunk is written anew with every addition.

    Raises:
        FormatError: the file cannot be made, or what is given to a method breaks the format.
    """

    def __init__(self, path: Path, *, camera: Camera, growing: bool = False) -> None:
        self._path, self._camera = Path(path), camera
        self._growing = growing
        self._partial = self._path.with_name(f".{self._path.name}.{os.getpid()}-{threading.get_ident()}.part")
        self._lock: WriterLock | None = None
        if growing:
            self._partial = growing_path(self._path)
            if has_writer(self._partial):
                hint = "choose another name, or wait until that run has ended"
                raise FormatError("is being recorded by another run", path=self._path, hint=hint)
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._file = h5py.File(self._partial, "w", libver="latest" if growing else None)
            if growing and os.name != "nt":  # there a file that is open cannot get its name
                self._lock = WriterLock(self._partial)
        except OSError as error:
            hint = "choose a folder that can be written"
            raise FormatError(f"cannot be written ({error})", path=self._path, hint=hint) from error
        self._file.attrs.update(format=FORMAT, version=VERSION, width=camera.width, height=camera.height)
        if not camera.is_guess:
            group = self._file.create_group("camera")
            group.attrs.update(fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy)
            group.attrs["distortion"] = np.array(camera.distortion, np.float64)
        self._events = self._file.create_group("events")
        packed = {} if growing else _COMPRESSION
        self._columns = {name: _extended(self._events, name, kind, packed) for name, kind in _COLUMNS}
        self._index = None if growing else _extended(self._events, "ms_to_idx", np.int64, packed)
        self._count, self._first_us, self._last_us, self._next_ms = 0, 0, 0, 0
        self._frame_t: list[int] = []
        self._frames: h5py.Dataset | None = None
        if growing:
            self._file.swmr_mode = True

    def append(self, events: Events) -> None:
        """Add events that follow those already written.

        Raises:
            FormatError: an event is older than the one before it or outside the sensor.
        """
        n = len(events)
        if n == 0:
            return
        last_us = self._last_us if self._count else None
        check_events(events, self._camera, path=self._path, first=self._count, last_us=last_us)
        if self._count == 0:
            self._first_us = int(events.t_us[0])
        end = self._count + n
        for name, values in (("t", events.t_us), ("x", events.x_px), ("y", events.y_px), ("p", events.is_positive)):
            column = self._columns[name]
            column.resize((end,))
            column[self._count :] = values.view(np.uint8) if name == "p" else values
        self._last_us = int(events.t_us[-1])
        self._append_index(events.t_us)
        self._count = end
        if self._growing:
            self._file.flush()

    def _append_index(self, t_us: NDArray[np.int64]) -> None:
        """Write the index of every millisecond that these events reach, in blocks (a gap may be hours long)."""
        if self._index is None:
            return
        end_ms = (self._last_us - self._first_us) // 1000 + 1
        if end_ms > _MAX_INDEX_MS:
            if "ms_to_idx" in self._events:
                del self._events["ms_to_idx"]
            return
        while self._next_ms < end_ms:
            stop = min(end_ms, self._next_ms + _INDEX_BLOCK)
            marks = self._first_us + 1000 * np.arange(self._next_ms, stop, dtype=np.int64)
            self._index.resize((stop,))
            self._index[self._next_ms :] = self._count + np.searchsorted(t_us, marks, side="left")
            self._next_ms = stop

    def set_ground_truth(self, trajectory: Trajectory) -> None:
        """Store true poses `T_world_camera`."""
        group = self._file.require_group("groundtruth")
        T = trajectory.Ts_world_camera
        _replace(group, "t", trajectory.t_us)
        _replace(group, "position", T[:, :3, 3])
        _replace(group, "quaternion_wxyz", se3.quaternion_from_rotation(T[:, :3, :3]).reshape(-1, 4))

    def set_imu(self, imu: Imu) -> None:
        """Store inertial measurements along the optical axes."""
        group = self._file.require_group("imu")
        _replace(group, "t", imu.t_us)
        _replace(group, "gyro", imu.gyro)
        _replace(group, "accel", imu.accel)

    def append_frame(self, t_us: int, image: NDArray[np.uint8]) -> None:
        """Add an intensity frame (height, width) uint8; all frames of a recording have one size.

        Raises:
            FormatError: the frame differs in size from the first one.
        """
        if image.ndim != 2 or image.dtype != np.uint8:
            raise ValueError(f"image: expected (height, width) uint8, got {image.shape} {image.dtype}")
        images: Any = self._frames
        if images is None:
            whole = {"maxshape": (None, *image.shape), "chunks": (1, *image.shape), **_COMPRESSION}
            images = self._frames = self._file.create_dataset("frames/image", (0, *image.shape), np.uint8, **whole)
        if images.shape[1:] != image.shape:
            raise FormatError(
                f"a frame of {image.shape[1]}x{image.shape[0]} after frames of {images.shape[2]}x{images.shape[1]}",
                path=self._path,
                place=f"frame {len(self._frame_t)}",
                hint="give frames of one size",
            )
        images.resize(len(self._frame_t) + 1, axis=0)
        images[len(self._frame_t)] = image
        self._frame_t.append(int(t_us))

    def set_plane(
        self,
        *,
        mean_plane_distance: float | None = None,
        normal_world: ArrayLike | None = None,
        distance_world: float | None = None,
    ) -> None:
        """Store what is known of the true plane: metres, a unit normal (3,) and metres."""
        if mean_plane_distance is not None:
            self._file.attrs["mean_plane_distance"] = float(mean_plane_distance)
        if normal_world is not None:
            self._file.attrs["plane_normal_world"] = np.asarray(normal_world, np.float64).reshape(3)
        if distance_world is not None:
            self._file.attrs["plane_distance_world"] = float(distance_world)

    def set_note(self, name: str, text: str) -> None:
        """Store a text attribute at the root, which readers of the format ignore unless they know it."""
        self._file.attrs[name] = text

    def discard(self) -> None:
        """Give up: remove what was written."""
        if self._file:
            self._file.close()
        self._partial.unlink(missing_ok=True)
        self._release()

    def close(self) -> None:
        """Finish the file and give it its name."""
        if not self._file:
            return
        if self._frame_t:
            _replace(self._file.require_group("frames"), "t", np.array(self._frame_t, np.int64))
        self._file.close()
        self._partial.replace(self._path)
        self._release()

    def _release(self) -> None:
        if self._lock is not None:
            self._lock.release()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None):
        if kind is None:
            self.close()
        else:
            self.discard()


def growing_path(path: Path) -> Path:
    """Return where a recording that others may read lies until it is whole."""
    return path.with_name(f".{path.name}.growing.part")


def _extended(group: h5py.Group, name: str, kind: type, packed: dict[str, Any]) -> h5py.Dataset:
    return group.create_dataset(name, (0,), kind, maxshape=(None,), chunks=(_CHUNK,), **packed)


def _replace(group: h5py.Group, name: str, values: NDArray) -> None:
    if name in group:
        del group[name]
    group.create_dataset(name, data=values)
