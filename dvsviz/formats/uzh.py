"""The text layout of the UZH Event-Camera Dataset, as a folder, a zip archive, or `events.txt` alone."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import FormatError
from dvsviz.events.recording import Imu
from dvsviz.formats import text_kernel
from dvsviz.formats.calibration import Calibration, parse_calibration
from dvsviz.formats.container import Container
from dvsviz.formats.images import MAX_IMAGE_BYTES, decode_image
from dvsviz.formats.sink import RecordingSink
from dvsviz.formats.tables import read_poses, read_table, text_rows
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.tum import microseconds

FORMAT_NAME = "UZH text"
# The dataset's sensor, DAVIS240C: assumed where neither a frame nor the user nor the file says another.
DEFAULT_SIZE = (240, 180)
_BLOCK_BYTES = 1 << 22
_MAX_LINE_BYTES = 1 << 16


def convert_uzh(container: Container, sink: RecordingSink, *, events_name: str = "events.txt") -> None:
    """Read everything the layout holds into a recording; only the events are required.

    Raises:
        FormatError: a file breaks the layout; it names file and line.
    """
    frames = _frame_list(container, sink)
    first_image = _image(container, frames[0][1], sink) if frames else None
    with container.open(events_name) as file:
        path = container.where(events_name)
        head = _read(file, 1 << 16, path).removeprefix(b"\xef\xbb\xbf")
        header, header_size, time_scale = _look_at(head, path)
        frame_size = None if first_image is None else (first_image.shape[1], first_image.shape[0])
        calibration = _calibration(container)
        size = sink.options.size or frame_size or header_size or (calibration.size if calibration else None)
        if size is None:
            size = DEFAULT_SIZE
            sink.warn(f"the sensor's size is not recorded: {size[0]}x{size[1]} assumed; give it with --size")
        sink.start(Camera.guess(*size) if calibration is None else calibration.camera(*size))
        _add_events(file, head, header, time_scale, container.size(events_name), path, sink)
    if container.has("groundtruth.txt"):
        with container.open("groundtruth.txt") as file:
            truth, dropped = read_poses(file, container.where("groundtruth.txt"), repair=sink.options.repair)
        sink.dropped(dropped, "poses of groundtruth.txt")
        if len(truth):
            sink.set_ground_truth(truth)
    if container.has("imu.txt"):
        _add_imu(container, sink)
    _add_frames(container, frames, sink)


def _calibration(container: Container) -> Calibration | None:
    if not container.has("calib.txt"):
        return None
    with container.open("calib.txt") as file:
        return parse_calibration(file.read(1 << 20), container.where("calib.txt"))


def _read(file: BinaryIO, size: int, path: Path) -> bytes:
    try:
        return file.read(size)
    except OSError as error:
        raise FormatError(f"cannot be read: {error.strerror}", path=path, hint="copy it again") from error


def _look_at(head: bytes, path: Path) -> tuple[int, tuple[int, int] | None, int]:
    """Return (bytes of a header line, the size it holds, decimal scale of times) of the start of an events file."""
    if b"\x00" in head:
        raise FormatError("not a text file", path=path, hint="expected lines of `t x y p`")
    header, size, at = 0, None, 0
    for line in head.splitlines(keepends=True):
        words = line.replace(b",", b" ").split()
        at += len(line)
        if not words or words[0].startswith(b"#"):
            continue
        if len(words) == 2 and size is None and all(word.isdigit() and len(word) < 6 for word in words):
            # Some converters write the sensor's `width height` first.
            header, size = at, (int(words[0]), int(words[1]))
            if min(size) < 1 or max(size) > 65_535:
                raise FormatError(f"a sensor of {size[0]}x{size[1]}", path=path, place="line 1", hint="correct it")
            continue
        return header, size, 6 if any(c in words[0] for c in b".eE") else 0
    return header, size, 6


def _add_events(
    file: BinaryIO, head: bytes, header: int, time_scale: int, total: int, path: Path, sink: RecordingSink
) -> None:
    """Parse the file block by block; what follows the last newline of a block is parsed with the next one."""
    if time_scale == 0:
        sink.warn("times without a decimal point are taken as microseconds")
    repair, camera = sink.options.repair, sink.camera
    counts = np.zeros(len(text_kernel.MESSAGES) + 1, np.int64)
    lines, done, last_us = head[:header].count(b"\n"), len(head), -(2**62)
    rest = head[header:]
    while True:
        block = _read(file, _BLOCK_BYTES, path)
        done += len(block)
        end = block.rfind(b"\n") + 1 if block else 0
        data = rest + block[:end] if end or not block else b""
        if not block:
            data += b"\n"
        elif not end:
            rest += block
            if len(rest) > _BLOCK_BYTES + _MAX_LINE_BYTES:
                raise FormatError("a line without end", path=path, place=f"line {lines + 1}", hint="copy it again")
            continue
        rest = block[end:]
        buffer = np.frombuffer(data, np.uint8)
        rows = int(np.count_nonzero(buffer == 10))
        t, x, y = np.empty(rows, np.int64), np.empty(rows, np.int64), np.empty(rows, np.int64)
        p = np.empty(rows, np.bool_)
        n, read, status, at = text_kernel.parse_events(
            buffer, camera.width, camera.height, time_scale, last_us, repair, t, x, y, p, counts
        )
        if status != text_kernel.OK:
            _refuse_line(data[at : at + 200], int(status), lines + int(read) + 1, path, sink)
        sink.add(t[:n], x[:n], y[:n], p[:n])
        if n:
            last_us = int(t[n - 1])
        lines += int(read)
        sink.options.report(done / max(1, total))
        if not block:
            break
    sink.dropped(int(counts.sum()), "lines that are not an event")
    if sink.count == 0:
        raise FormatError("there are no events", path=path, hint="record or copy it again")


def _refuse_line(data: bytes, status: int, line: int, path: Path, sink: RecordingSink) -> None:
    text = data.split(b"\n")[0].decode("utf-8", errors="replace").strip()[:60]
    message = f"{text_kernel.MESSAGES[status]} in `{text}`"
    hint = "correct the line, or drop such lines with --repair"
    if status == text_kernel.OUTSIDE:
        message += f", the sensor being {sink.camera.width}x{sink.camera.height}"
        hint = "give the right size with --size WxH, or drop such events with --repair"
    if status == text_kernel.BACKWARDS:
        hint = "sort the events by time, or drop those that run backwards with --repair"
    raise FormatError(message, path=path, place=f"line {line}", hint=hint)


def _add_imu(container: Container, sink: RecordingSink) -> None:
    # The dataset's inertial sensor is turned against the optical axes by less than a degree: taken as they are.
    path = container.where("imu.txt")
    with container.open("imu.txt") as file:
        t, values, dropped = read_table(
            file, path, "t ax ay az gx gy gz", repair=sink.options.repair, increasing=False
        )
    sink.dropped(dropped, "lines of imu.txt")
    if len(t):
        sink.set_imu(Imu(t_us=t, gyro=values[:, 3:], accel=values[:, :3]))


def _frame_list(container: Container, sink: RecordingSink) -> list[tuple[int, str]]:
    """Return (time, name) of the frames; a list without any of its images counts as no frames."""
    if not container.has("images.txt"):
        return []
    path = container.where("images.txt")
    frames: list[tuple[int, str]] = []
    missing = 0
    with container.open("images.txt") as file:
        for number, words in text_rows(file, path):
            try:
                if len(words) != 2:
                    raise ValueError(f"expected `t name`, got {len(words)} words")
                t_us, name = microseconds(words[0]), words[1]
            except ValueError as error:
                hint = "correct or remove the line"
                raise FormatError(str(error), path=path, place=f"line {number}", hint=hint) from error
            if container.has(name):
                frames.append((t_us, name))
            else:
                missing += 1
    if missing:
        sink.warn(f"{missing} of {missing + len(frames)} frames of images.txt are not there")
    return frames


def _image(container: Container, name: str, sink: RecordingSink) -> NDArray[np.uint8] | None:
    """Return a frame, or None where it is damaged and may be dropped."""
    path = container.where(name)
    try:
        if container.size(name) > MAX_IMAGE_BYTES:
            raise FormatError("too large for a frame", path=path, hint="remove its line from images.txt")
        with container.open(name) as file:
            return decode_image(file.read(), path)
    except FormatError:
        if not sink.options.repair:
            raise
        return None


def _add_frames(container: Container, frames: list[tuple[int, str]], sink: RecordingSink) -> None:
    shape, dropped = None, 0
    for t_us, name in frames:
        image = _image(container, name, sink)
        if image is None or (shape is not None and image.shape != shape):
            if image is not None and not sink.options.repair:
                message = f"a frame of {image.shape[1]}x{image.shape[0]} among frames of another size"
                raise FormatError(message, path=container.where(name), hint="drop such frames with --repair")
            dropped += 1
            continue
        shape = image.shape
        sink.add_frame(t_us, image)
    sink.dropped(dropped, "frames")
