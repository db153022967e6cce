"""AEDAT4 (iniVation DV): events, frames, inertial measurements and triggers, read with dv-processing."""

from __future__ import annotations

import tempfile
from collections import Counter
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from dvsviz.errors import FormatError
from dvsviz.events.recording import Imu
from dvsviz.formats.aedat4_packets import check_packets, copy_whole_packets
from dvsviz.formats.sink import RecordingSink
from dvsviz.geometry.camera import Camera

MAGIC = b"#!AER-DAT4"
FORMAT_NAME = "AEDAT4"


def convert_aedat4(path: Path, sink: RecordingSink) -> None:
    """Read an AEDAT4 file of one camera into a recording.

    Raises:
        FormatError: it cannot be read, or holds no events.
    """
    try:
        # Heavy and needed for this format alone; there are no wheels of it for every machine.
        import dv_processing as dv
    except ImportError as error:
        hint = "pip install dv-processing (Linux on x86_64), or convert the file elsewhere"
        raise FormatError("dv-processing is not installed", path=path, hint=hint) from error
    with ExitStack() as stack:
        whole = path
        if not sink.options.repair:
            check_packets(path)
        else:
            whole = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "whole.aedat4"
            dropped, rest = copy_whole_packets(path, whole)
            sink.dropped(dropped, "packets that are damaged")
            sink.dropped(rest, "bytes of a last packet that was cut short")
        try:
            reader = dv.io.MonoCameraRecording(str(whole))
            if not reader.isEventStreamAvailable():
                raise FormatError("there is no event stream", path=path, hint="record or copy it again")
            _read(reader, path, sink)
        except (RuntimeError, ValueError, IndexError, MemoryError, OverflowError) as error:
            reason = " ".join(str(error).split())[:120]
            raise FormatError(f"damaged or cut short ({reason})", path=path, hint="copy it again") from error


def _read(reader: Any, path: Path, sink: RecordingSink) -> None:
    width, height = reader.getEventResolution() or (0, 0)
    if not (1 <= width <= 65_535 and 1 <= height <= 65_535):
        raise FormatError(f"a sensor of {width}x{height}", path=path, hint="copy it again")
    sink.start(Camera.guess(int(width), int(height)))
    start, end = reader.getTimeRange()
    while (batch := reader.getNextEventBatch()) is not None:
        if len(batch) == 0:
            continue
        rows = batch.numpy()
        sink.add(
            rows["timestamp"].astype(np.int64),
            rows["x"].astype(np.int64),
            rows["y"].astype(np.int64),
            rows["polarity"] != 0,
        )
        sink.options.report((int(rows["timestamp"][-1]) - start) / max(1, end - start))
    if reader.isFrameStreamAvailable():
        _read_frames(reader, sink)
    if reader.isImuStreamAvailable():
        _read_imu(reader, sink)
    if reader.isTriggerStreamAvailable():
        _count_triggers(reader, sink)


def _count_triggers(reader: Any, sink: RecordingSink) -> None:
    """Count the triggers by their kind: `info` lists them, and nothing here uses their times."""
    counts: Counter[str] = Counter()
    while (batch := reader.getNextTriggerBatch()) is not None:
        counts.update(str(trigger.type.name).lower().replace("_", " ") for trigger in batch)
    sink.set_triggers(dict(sorted(counts.items())))


def _read_frames(reader: Any, sink: RecordingSink) -> None:
    shape, other = None, 0
    while (frame := reader.getNextFrame()) is not None:
        image = np.asarray(frame.image)
        if image.ndim == 3:
            # BGR to grey by the weights of ITU-R BT.601.
            image = np.round(image[..., :3] @ np.array([0.114, 0.587, 0.299])).astype(np.uint8)
        if image.dtype != np.uint8 or image.ndim != 2 or (shape is not None and image.shape != shape):
            other += 1
            continue
        shape = image.shape
        sink.add_frame(int(frame.timestamp), np.ascontiguousarray(image))
    if other:
        sink.warn(f"{other} frames of another size or type left out")


def _read_imu(reader: Any, sink: RecordingSink) -> None:
    t: list[int] = []
    gyro: list[np.ndarray] = []
    accel: list[np.ndarray] = []
    while (batch := reader.getNextImuBatch()) is not None:
        for sample in batch:
            t.append(int(sample.timestamp))
            gyro.append(np.asarray(sample.getAngularVelocities(), np.float64).ravel())
            accel.append(np.asarray(sample.getAccelerations(), np.float64).ravel())
    if t:
        # DV writes the axes of the camera's housing as the camera's; a Kalibr file would tell a better rotation.
        sink.set_imu(Imu(t_us=np.array(t, np.int64), gyro=np.array(gyro), accel=np.array(accel)))
