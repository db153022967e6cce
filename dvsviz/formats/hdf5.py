"""Our HDF5 recording, `dvsviz-recording` version 1 (docs/recording-format.md): reading in blocks."""

from __future__ import annotations

import threading
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NoReturn

import h5py
import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import FormatError
from dvsviz.events.events import Events
from dvsviz.events.recording import Imu, Recording
from dvsviz.formats.checks import check_events, check_sensor, check_stored
from dvsviz.formats.hdf5_writer import FORMAT, VERSION, RecordingWriter
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.trajectory import Trajectory

__all__ = ["FORMAT", "VERSION", "Hdf5Events", "Hdf5Frames", "RecordingWriter", "is_recording", "read_recording"]

# 262,144 events of 13 B are 3.4 MB: large enough that a window of thousands of events seldom costs two reads.
_BLOCK = 1 << 18
_KEPT_BLOCKS = 4
_MAX_SIDE = 65_536
# Files of up to so many events are checked whole on opening (0.2 s), longer ones block by block as they are read.
_CHECKED_AT_OPEN = 1 << 22


class Hdf5Events:
    """An `EventSource` over `events/{t,x,y,p}` of an open file; each block is checked when it is first read.

    Whoever reads on from block to block finds the next one unpacked already: HDF5 does it on another core.
    """

    def __init__(self, file: h5py.File, path: Path, camera: Camera) -> None:
        self._file, self._path, self._camera = file, path, camera
        self._columns = [_dataset(file, f"events/{name}", path) for name in ("t", "x", "y", "p")]
        sizes = [column.shape for column in self._columns]
        if any(len(size) != 1 or size != sizes[0] for size in sizes):
            _refuse(path, "events", f"t, x, y, p differ in size: {', '.join(str(size) for size in sizes)}")
        if any(column.dtype.kind not in "iub" for column in self._columns):
            _refuse(path, "events", f"expected integers, got {', '.join(str(c.dtype) for c in self._columns)}")
        self._count = int(sizes[0][0])
        self._blocks: dict[int, Events] = {}
        self._last = -1
        self._ahead: tuple[int, Future[Events]] | None = None
        self._reader = ThreadPoolExecutor(1, thread_name_prefix="read-ahead")
        self._lock = threading.Lock()

    @property
    def count(self) -> int:
        """Number of events."""
        return self._count

    def read(self, first: int, end: int) -> Events:
        """Return events `[first, end)`, clipped to those there are.

        Raises:
            FormatError: the file is damaged there, or an event is out of order or outside the sensor.
        """
        first, end = max(0, first), min(end, self._count)
        if end <= first:
            return Events.empty()
        parts = []
        for k in range(first // _BLOCK, (end - 1) // _BLOCK + 1):
            block = self._block(k)
            parts.append(block[max(0, first - k * _BLOCK) : end - k * _BLOCK])
        if len(parts) == 1:
            return parts[0]
        return Events(
            t_us=np.concatenate([part.t_us for part in parts]),
            x_px=np.concatenate([part.x_px for part in parts]),
            y_px=np.concatenate([part.y_px for part in parts]),
            is_positive=np.concatenate([part.is_positive for part in parts]),
        )

    def index_at(self, t_us: int) -> int:
        """Return the index of the first event at or after a time (`count` where there is none)."""
        low, high = 0, (self._count + _BLOCK - 1) // _BLOCK
        # The first block that starts at or after the time: the event lies in the block before it, or is its first.
        while low < high:
            middle = (low + high) // 2
            if self._time_of(middle * _BLOCK) >= t_us:
                high = middle
            else:
                low = middle + 1
        if low == 0:
            return 0
        k = low - 1
        return k * _BLOCK + int(np.searchsorted(self._block(k).t_us, t_us, side="left"))

    def close(self) -> None:
        """Close the file."""
        self._reader.shutdown(cancel_futures=True)
        self._file.close()

    def _time_of(self, index: int) -> int:
        block = self._blocks.get(index // _BLOCK)
        if block is not None:
            return int(block.t_us[index % _BLOCK])
        return int(_values(self._columns[0], slice(index, index + 1), self._path, f"event {index}")[0])

    def _block(self, k: int) -> Events:
        with self._lock:
            block = self._blocks.pop(k, None)
            if block is None:
                block = self._unpacked(k)
                while len(self._blocks) >= _KEPT_BLOCKS:
                    del self._blocks[next(iter(self._blocks))]
            self._blocks[k] = block
            return block

    def _unpacked(self, k: int) -> Events:
        ahead, self._ahead = self._ahead, None
        block = ahead[1].result() if ahead is not None and ahead[0] == k else self._load(k)
        if k == self._last + 1 and (k + 1) * _BLOCK < self._count:
            self._ahead = (k + 1, self._reader.submit(self._load, k + 1))
        self._last = k
        return block

    def _load(self, k: int) -> Events:
        first = k * _BLOCK
        key = slice(first, first + _BLOCK)
        t, x, y, p = (_values(c, key, self._path, f"events {first} and after") for c in self._columns)
        if t.dtype == np.uint64 and int(t.max()) > np.iinfo(np.int64).max:
            hint = "write microseconds of a nearer origin"
            _refuse(self._path, f"events {first} and after", f"the time {t.max()} does not fit into 63 bits", hint)
        if (x.dtype != np.uint16 and (int(x.min()) < 0 or int(x.max()) >= _MAX_SIDE)) or (
            y.dtype != np.uint16 and (int(y.min()) < 0 or int(y.max()) >= _MAX_SIDE)
        ):
            _refuse(self._path, f"events {first} and after", "pixels outside the sensor")
        events = Events(
            t_us=t.astype(np.int64, copy=False),
            x_px=x.astype(np.uint16, copy=False),
            y_px=y.astype(np.uint16, copy=False),
            is_positive=p > 0,
        )
        last_us = self._time_of(first - 1) if first else None
        check_events(events, self._camera, path=self._path, first=first, last_us=last_us)
        for column in (events.t_us, events.x_px, events.y_px, events.is_positive):
            column.setflags(write=False)
        return events


class Hdf5Frames:
    """A `FrameSource` over `frames/{t,image}` of an open file."""

    def __init__(self, file: h5py.File, path: Path) -> None:
        self._path = path
        self._t = _values(_dataset(file, "frames/t", path), slice(None), path, "frames/t").astype(np.int64)
        self._images = _dataset(file, "frames/image", path)
        if self._images.ndim != 3 or len(self._images) != len(self._t) or self._images.dtype != np.uint8:
            shape, kind = self._images.shape, self._images.dtype
            _refuse(path, "frames/image", f"expected ({len(self._t)}, height, width) uint8, got {shape} {kind}")

    @property
    def t_us(self) -> NDArray[np.int64]:
        """Times (N,) of the frames."""
        return self._t

    def read(self, index: int) -> NDArray[np.uint8]:
        """Return frame `index` (height, width)."""
        return _values(self._images, index, self._path, f"frames/image {index}")


def is_recording(path: Path) -> bool:
    """Return whether a file is a recording of ours, of any version; False where it cannot be opened."""
    try:
        with h5py.File(path, "r") as file:
            return file.attrs.get("format") == FORMAT
    except OSError:
        return False


def read_recording(path: Path) -> Recording:
    """Return the recording in a `dvsviz-recording` file; its events stay on disk and are read in blocks.

    Raises:
        FormatError: no such file, not this format or version, or contents that break it; events are checked at
            once in files of up to four million, and block by block as they are read in longer ones.
    """
    path = Path(path)
    if not path.is_file():
        raise FormatError("no such file", path=path, hint="check the path")
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        reason = "not an HDF5 file, or a damaged one"
        raise FormatError(reason, path=path, hint="copy or convert it again") from error
    try:
        return _read(file, path)
    except BaseException:
        file.close()
        raise


def _read(file: h5py.File, path: Path) -> Recording:
    kind = file.attrs.get("format")
    if kind != FORMAT:
        _refuse(path, "attribute format", f"expected {FORMAT!r}, got {kind!r}", "convert it with dvsviz convert")
    version = _number(file, "version", path)
    if version != VERSION:
        hint = "update dvsviz"
        _refuse(path, "attribute version", f"version {version:g} is not known, expected {VERSION}", hint)
    camera, warnings = read_camera(file, path)
    events = Hdf5Events(file, path, camera)
    if events.count == 0:
        _refuse(path, "events", "there are no events", "record or convert it again")
    if events.count <= _CHECKED_AT_OPEN:
        for first in range(0, events.count, _BLOCK):
            events.read(first, first + 1)
    normal = file.attrs.get("plane_normal_world")
    if normal is not None and (np.shape(normal) != (3,) or np.asarray(normal).dtype.kind not in "iuf"):
        _refuse(path, "attribute plane_normal_world", f"expected three numbers, got {normal!r}", "write it anew")
    return Recording(
        path=path,
        name=path.stem,
        format=f"{FORMAT} {VERSION}",
        camera=camera,
        events=events,
        ground_truth=_ground_truth(file, path),
        imu=_imu(file, path),
        frames=Hdf5Frames(file, path) if "frames" in file else None,
        mean_plane_distance=_optional(file, "mean_plane_distance", path),
        plane_normal_world=None if normal is None else np.asarray(normal, np.float64).reshape(3),
        plane_distance_world=_optional(file, "plane_distance_world", path),
        warnings=warnings,
    )


def read_camera(file: h5py.File, path: Path) -> tuple[Camera, tuple[str, ...]]:
    """Return the camera of a recording's file, and what is to be warned of."""
    width, height = int(_number(file, "width", path)), int(_number(file, "height", path))
    check_sensor(width, height, path)
    if "camera" not in file:
        return Camera.guess(width, height), (GUESS_WARNING.format(width=width, focal=0.8 * width),)
    group = file["camera"]
    fx, fy, cx, cy = (_number(group, name, path) for name in ("fx", "fy", "cx", "cy"))
    try:
        values = np.asarray(group.attrs.get("distortion", np.zeros(5)), np.float64).ravel()
        distortion = tuple(float(value) for value in values)
        if len(distortion) != 5:
            raise ValueError(f"expected five distortion values k1 k2 p1 p2 k3, got {len(distortion)}")
        camera = Camera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, distortion=distortion)
    except ValueError as error:
        raise FormatError(str(error), path=path, place="camera", hint="calibrate or convert it again") from error
    return camera, ()


GUESS_WARNING = (
    "no calibration: focal length guessed as 0.8 x width = {focal:g} px, centred, no distortion; "
    "give one with --calibration"
)


def _ground_truth(file: h5py.File, path: Path) -> Trajectory | None:
    if "groundtruth" not in file:
        return None
    t, position, quaternion = (
        _values(_dataset(file, f"groundtruth/{name}", path), slice(None), path, f"groundtruth/{name}")
        for name in ("t", "position", "quaternion_wxyz")
    )
    n = len(t)
    if position.shape != (n, 3) or quaternion.shape != (n, 4):
        _refuse(
            path, "groundtruth", f"expected {n} positions and quaternions, got {position.shape}, {quaternion.shape}"
        )
    bad = ~(np.isfinite(position).all(axis=1) & np.isfinite(quaternion).all(axis=1))
    if bad.any():
        _refuse(path, f"groundtruth, pose {int(np.argmax(bad))}", "the pose is not finite", "correct or remove it")
    try:
        return Trajectory.from_quaternions(t, position, quaternion)
    except ValueError as error:
        raise FormatError(str(error), path=path, place="groundtruth", hint="correct or remove it") from error


def _imu(file: h5py.File, path: Path) -> Imu | None:
    if "imu" not in file:
        return None
    hint = "write it anew, or leave it out with --repair"
    t, gyro = (_numbers(file, f"imu/{name}", path, kinds, hint) for name, kinds in (("t", "iu"), ("gyro", "iuf")))
    # Many sensors have a gyroscope alone.
    group = file["imu"]
    has_accel = not isinstance(group, h5py.Group) or "accel" in group
    accel = _numbers(file, "imu/accel", path, "iuf", hint) if has_accel else np.full_like(gyro, np.nan, np.float64)
    if t.ndim != 1 or gyro.shape != (len(t), 3) or accel.shape != (len(t), 3):
        found = f"t {t.shape}, gyro {gyro.shape}, accel {accel.shape}"
        _refuse(path, "imu", f"expected (N,) times, (N, 3) rates and accelerations, got {found}", hint)
    return Imu(t_us=t.astype(np.int64), gyro=gyro.astype(np.float64), accel=accel.astype(np.float64))


def _numbers(file: h5py.File, name: str, path: Path, kinds: str, hint: str) -> NDArray[Any]:
    """Return a dataset of numbers, refused where its type is none of these kinds or the numbers are too large."""
    values = _values(_dataset(file, name, path), slice(None), path, name)
    if values.dtype.kind not in kinds:
        wanted = "numbers" if "f" in kinds else "whole numbers (microseconds)"
        _refuse(path, name, f"expected {wanted}, got {values.dtype}", hint)
    if values.dtype == np.uint64 and values.size and int(values.max()) > np.iinfo(np.int64).max:
        _refuse(path, name, f"{values.max()} does not fit into 63 bits", hint)
    return values


def _dataset(file: h5py.File, name: str, path: Path) -> h5py.Dataset:
    found = file.get(name)
    if not isinstance(found, h5py.Dataset):
        _refuse(path, name, "this dataset is missing", "docs/recording-format.md lists what a recording holds")
    check_stored(found, path)
    return found


def _values(dataset: h5py.Dataset, key: slice | int, path: Path, place: str) -> NDArray[Any]:
    try:
        return dataset[key]
    except (OSError, RuntimeError) as error:
        raise FormatError("the file is damaged here", path=path, place=place, hint="copy it again") from error


def _number(group: h5py.Group | Any, name: str, path: Path) -> float:
    value = _optional(group, name, path)
    if value is None:
        _refuse(
            path, f"attribute {name}", "this attribute is missing", "docs/recording-format.md lists what is needed"
        )
    return value


def _optional(group: h5py.Group | Any, name: str, path: Path) -> float | None:
    value = group.attrs.get(name)
    if value is None:
        return None
    try:
        return float(value)
    except (TypeError, ValueError) as error:
        raise FormatError(f"expected a number, got {value!r}", path=path, place=f"attribute {name}") from error


def _refuse(path: Path, place: str, message: str, hint: str | None = None) -> NoReturn:
    raise FormatError(message, path=path, place=place, hint=hint)
