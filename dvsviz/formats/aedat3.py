"""AEDAT 3.1 (cAER): polarity events, frames and inertial measurements in packets; our own reader."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import FormatError
from dvsviz.events.recording import Imu
from dvsviz.formats.sink import RecordingSink
from dvsviz.formats.sizes import assumption, require_size
from dvsviz.geometry.camera import Camera

MAGIC = b"#!AER-DAT3"
FORMAT_NAME = "AEDAT 3.1"
_HEADER_END = b"#!END-HEADER"
_MAX_HEADER = 1 << 20
_MAX_PACKET = 1 << 28
# Type, source, size of an event, offset of its time, overflow of times, capacity, number, valid.
_PACKET = struct.Struct("<hhiiiiii")
_POLARITY, _FRAME, _IMU6 = 1, 2, 3
_POLARITY_EVENT = np.dtype([("data", "<u4"), ("t", "<i4")])
_IMU_EVENT = np.dtype([("info", "<u4"), ("t", "<i4"), ("accel", "<f4", 3), ("gyro", "<f4", 3), ("celsius", "<f4")])
_FRAME_HEAD = struct.Struct("<Iiiiiiiii")
_STANDARD_GRAVITY = 9.80665
_SENSORS = ((b"DAVIS346", (346, 260)), (b"DAVIS240", (240, 180)), (b"DVS128", (128, 128)))


def convert_aedat3(path: Path, sink: RecordingSink) -> None:
    """Read an AEDAT 3.1 file into a recording.

    Raises:
        FormatError: a header that does not end, a packet of an absurd size, or a file that is cut short.
    """
    with path.open("rb") as file:
        start, size = _header(file, path)
        size = sink.options.size or size
        if size is None:
            max_x, max_y = 0, 0
            for kind, _, body in _packets(file, start, path, sink):
                if kind == _POLARITY:
                    _, x, y, _ = _polarity(body, 0)
                    max_x, max_y = max(max_x, int(x.max(initial=0))), max(max_y, int(y.max(initial=0)))
            size = require_size(max_x, max_y, path)
            sink.warn(assumption(size))
        sink.start(Camera.guess(*size))
        samples: list[tuple[NDArray[np.int64], NDArray[np.float64]]] = []
        total, shape = path.stat().st_size, None
        for kind, overflow, body in _packets(file, start, path, sink):
            if kind == _POLARITY:
                sink.add(*_polarity(body, overflow))
            elif kind == _IMU6 and len(body) % _IMU_EVENT.itemsize == 0:
                rows = np.frombuffer(body, _IMU_EVENT)
                rows = rows[rows["info"] & 1 == 1]
                values = np.concatenate([rows["gyro"], rows["accel"]], axis=1).astype(np.float64)
                samples.append((rows["t"].astype(np.int64) + (overflow << 31), values))
            elif kind == _FRAME:
                for t_us, image in _frames(body, overflow):
                    if shape in (None, image.shape):
                        shape = image.shape
                        sink.add_frame(t_us, image)
            sink.options.report(file.tell() / total)
    if samples:
        values = np.concatenate([v for _, v in samples])
        t_us = np.concatenate([t for t, _ in samples])
        gyro, accel = np.deg2rad(values[:, :3]), values[:, 3:] * _STANDARD_GRAVITY
        sink.set_imu(Imu(t_us=t_us, gyro=gyro, accel=accel))


def _header(file: BinaryIO, path: Path) -> tuple[int, tuple[int, int] | None]:
    head = file.read(_MAX_HEADER)
    end = head.find(_HEADER_END)
    line_end = head.find(b"\n", end) if end >= 0 else -1
    if line_end < 0:
        raise FormatError("the header does not end", path=path, place="header", hint="copy it again")
    size = next((size for name, size in _SENSORS if name in head[:end].upper()), None)
    return line_end + 1, size


def _packets(file: BinaryIO, start: int, path: Path, sink: RecordingSink) -> Iterator[tuple[int, int, bytes]]:
    """Yield (type, overflow of times, bytes of the events) of each packet."""
    file.seek(start)
    while head := file.read(_PACKET.size):
        at = file.tell() - len(head)
        if len(head) == _PACKET.size:
            kind, _, size, _, overflow, _, number, _ = _PACKET.unpack(head)
            if size < 1 or number < 0 or overflow < 0 or size * number > _MAX_PACKET:
                message = f"a packet of {number} events of {size} bytes"
                raise FormatError(message, path=path, place=f"byte {at}", hint="the file is damaged: copy it again")
            body = file.read(size * number)
            if len(body) == size * number:
                if kind == _POLARITY and size != _POLARITY_EVENT.itemsize:
                    raise FormatError(f"polarity events of {size} bytes", path=path, place=f"byte {at}")
                yield kind, overflow, body
                continue
        if not sink.options.repair:
            hint = "copy it again, or read what is there with --repair"
            raise FormatError("cut short inside a packet", path=path, place=f"byte {at}", hint=hint)
        sink.dropped(1, "packet that was cut short")
        return


def _polarity(
    body: bytes, overflow: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    rows = np.frombuffer(body, _POLARITY_EVENT)
    rows = rows[rows["data"] & 1 == 1]
    data = rows["data"].astype(np.int64)
    return rows["t"].astype(np.int64) + (overflow << 31), data >> 17, (data >> 2) & 0x7FFF, (data >> 1) & 1 == 1


def _frames(body: bytes, overflow: int) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Yield (start of exposure, image) of the valid frames of one channel in a packet."""
    at = 0
    while at + _FRAME_HEAD.size <= len(body):
        info, _, _, begin, _, width, height, _, _ = _FRAME_HEAD.unpack_from(body, at)
        channels = (info >> 1) & 0x7
        at += _FRAME_HEAD.size
        count = width * height * channels
        if width < 1 or height < 1 or channels < 1 or at + 2 * count > len(body):
            return
        if info & 1 and channels == 1:
            pixels = np.frombuffer(body, "<u2", count, at).reshape(height, width)
            yield begin + (overflow << 31), (pixels >> 8).astype(np.uint8)
        at += 2 * count
