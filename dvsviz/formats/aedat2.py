"""AEDAT 2.0 (jAER): events of DVS128, DAVIS240 and DAVIS346, inertial measurements of the DAVIS; our own reader."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import FormatError
from dvsviz.events.recording import Imu
from dvsviz.formats.sink import RecordingSink
from dvsviz.geometry.camera import Camera

MAGIC = b"#!AER-DAT2"
FORMAT_NAME = "AEDAT 2.0"
_BLOCK_WORDS = 1 << 18
_MAX_HEADER_LINE = 1 << 20
# Names in the header's AEChip line, longest first, with the sensor's size.
_CHIPS = (("DAVIS346", (346, 260)), ("DAVIS240", (240, 180)), ("DVS128", (128, 128)))
_DEFAULT_CHIP = "DAVIS240"
# jAER's standard ranges of the inertial sensor, 8 g and 1000 degrees/s: confirmed on a recording whose true rates
# were known. The header may hold others in its preferences, which are not looked at.
_G_PER_COUNT = 1 / 4096
_DEG_PER_S_PER_COUNT = 1 / 32.8
_STANDARD_GRAVITY = 9.80665
# Order of the values of one sample: acceleration x y z, temperature, rate x y z.
_IMU_VALUES = 7


def convert_aedat2(path: Path, sink: RecordingSink) -> None:
    """Read an AEDAT 2.0 file into a recording; pixels are turned upright and times start at the first event.

    Raises:
        FormatError: a header that does not end, or a file cut short inside an event.
    """
    with path.open("rb") as file:
        start, chip = _header(file, path)
        if chip is None:
            chip = _DEFAULT_CHIP
            sink.warn(f"the header names no known sensor: {chip} assumed")
        width, height = dict(_CHIPS)[chip]
        sink.start(Camera.guess(width, height))
        file.seek(start)
        total = path.stat().st_size
        first_us: int | None = None
        samples: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = []
        for address, t in _words(file, path, sink):
            if chip == "DVS128":
                is_event = address < 1 << 15
                x, y, p = 127 - ((address >> 1) & 0x7F), 127 - ((address >> 8) & 0x7F), (address & 1) == 0
            else:
                # Bit 31 marks frames and inertial samples, bit 10 an external signal.
                is_event = (address >> 31 == 0) & ((address >> 10) & 1 == 0)
                x, y = width - 1 - ((address >> 12) & 0x3FF), height - 1 - ((address >> 22) & 0x1FF)
                p = ((address >> 11) & 1) == 1
                is_imu = (address & 0x80000C00) == 0x80000C00
                samples.append((t[is_imu], address[is_imu]))
            if first_us is None and is_event.any():
                first_us = int(t[is_event][0])
            sink.add(t[is_event] - (first_us or 0), x[is_event], y[is_event], p[is_event])
            sink.options.report(file.tell() / total)
    imu = _imu(samples, first_us or 0)
    if imu is not None:
        sink.set_imu(imu)


def _header(file: BinaryIO, path: Path) -> tuple[int, str | None]:
    """Return the byte after the lines that start with `#`, and the sensor they name."""
    chip = None
    while True:
        at = file.tell()
        line = file.readline(_MAX_HEADER_LINE)
        if not line.startswith(b"#"):
            return at, chip
        if len(line) == _MAX_HEADER_LINE:
            raise FormatError("the header does not end", path=path, place=f"byte {at}", hint="copy it again")
        if b"AEChip:" in line:
            name = line.decode("latin-1").upper()
            chip = next((known for known, _ in _CHIPS if known in name), None)


def _words(
    file: BinaryIO, path: Path, sink: RecordingSink
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Yield addresses and times of blocks; times of 32 bits are carried on where they wrap."""
    last, wraps = 0, 0
    while data := file.read(_BLOCK_WORDS * 8):
        if rest := len(data) % 8:
            if not sink.options.repair:
                place = f"byte {file.tell() - rest}"
                hint = "copy it again, or read what is there with --repair"
                raise FormatError("cut short inside an event", path=path, place=place, hint=hint)
            sink.dropped(rest, "bytes of a last event that was cut short")
            data = data[:-rest]
        if not data:
            return
        rows = np.frombuffer(data, ">u4").reshape(-1, 2).astype(np.int64)
        t = rows[:, 1]
        loops = np.cumsum(np.diff(t, prepend=last) < -(1 << 31)) + wraps
        last, wraps = int(t[-1]), int(loops[-1])
        yield rows[:, 0], t + (loops << 32)


def _imu(samples: list[tuple[NDArray[np.int64], NDArray[np.int64]]], first_us: int) -> Imu | None:
    """Return the inertial samples, seven words each, along the optical axes."""
    if not samples:
        return None
    t = np.concatenate([times for times, _ in samples])
    address = np.concatenate([addresses for _, addresses in samples])
    code = (address >> 28) & 0x7
    value = ((address >> 12) & 0xFFFF).astype(np.uint16).view(np.int16).astype(np.float64)
    starts = np.flatnonzero(code == 0)
    starts = starts[starts + _IMU_VALUES <= len(code)]
    index = starts[:, None] + np.arange(_IMU_VALUES)
    whole = np.all(code[index] == np.arange(_IMU_VALUES), axis=1)
    index = index[whole]
    if len(index) == 0:
        return None
    # The inertial sensor sits on the back of the board: a half turn about the camera's y axis.
    turn = np.array([-1.0, 1.0, -1.0])
    accel = value[index[:, 0:3]] * (_G_PER_COUNT * _STANDARD_GRAVITY) * turn
    gyro = np.deg2rad(value[index[:, 4:7]] * _DEG_PER_S_PER_COUNT) * turn
    times = t[index[:, 0]] - first_us
    order = np.argsort(times, kind="stable")
    return Imu(t_us=times[order], gyro=gyro[order], accel=accel[order])
