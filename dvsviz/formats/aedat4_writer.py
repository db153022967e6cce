"""Writing of AEDAT4 with dv-processing: events, frames and inertial measurements."""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import Any

import numpy as np

from dvsviz.errors import FormatError
from dvsviz.events.events import Events
from dvsviz.events.recording import Recording

# What dv-processing multiplies by on reading (standard gravity is 9.80665): with it the same values come back.
_GRAVITY = 9.81007
# One packet of the format: what dv-processing itself writes at most.
_PACKET_EVENTS = 10_000
_MAX_SIDE = 32_767


def event_store(dv: Any, events: Events) -> Any:
    """Return events as an `EventStore` of dv-processing; the library takes them one by one, 1 to 2 us each."""
    store = dv.EventStore()
    columns = (events.t_us, events.x_px, events.y_px, events.is_positive)
    deque(map(store.push_back, *(column.tolist() for column in columns)), maxlen=0)
    return store


def write_aedat4(recording: Recording, out: Path) -> None:
    """Write events, frames and inertial measurements of a recording; the format has no place for true poses.

    Raises:
        FormatError: dv-processing is not installed, the sensor is too large, or the file cannot be made.
    """
    try:
        # Heavy and needed for this format alone; there are no wheels of it for every machine.
        import dv_processing as dv
    except ImportError as error:
        hint = "pip install dv-processing (Linux on x86_64)"
        raise FormatError("dv-processing is not installed", path=out, hint=hint) from error
    camera = recording.camera
    if max(camera.width, camera.height) > _MAX_SIDE:
        raise FormatError(f"a sensor of {camera.width}x{camera.height} is too large for AEDAT4", path=out)
    kinds: Any = dv.io.MonoCameraWriter
    make = kinds.EventOnlyConfig
    if recording.frames is not None:
        make = kinds.DAVISConfig
    elif recording.imu is not None:
        make = kinds.DVSConfig
    partial = out.with_name(f".{out.stem}.part.aedat4")
    try:
        writer = dv.io.MonoCameraWriter(str(partial), make("dvsviz", (camera.width, camera.height)))
        for events in recording.chunks(_PACKET_EVENTS):
            writer.writeEvents(event_store(dv, events))
        _write_frames(dv, writer, recording)
        _write_imu(dv, writer, recording)
        # Its end writes the table of packets.
        del writer
        partial.replace(out)
    except (RuntimeError, ValueError, OSError) as error:
        partial.unlink(missing_ok=True)
        reason = " ".join(str(error).split())[:120]
        raise FormatError(f"cannot be written ({reason})", path=out, hint="choose another folder") from error


def _write_frames(dv: Any, writer: Any, recording: Recording) -> None:
    if recording.frames is None:
        return
    for k, t_us in enumerate(recording.frames.t_us.tolist()):
        writer.writeFrame(dv.Frame(t_us, np.ascontiguousarray(recording.frames.read(k))))


def _write_imu(dv: Any, writer: Any, recording: Recording) -> None:
    if recording.imu is None:
        return
    # AEDAT4 keeps degrees per second and multiples of gravity.
    accel = recording.imu.accel / _GRAVITY
    gyro = np.rad2deg(recording.imu.gyro)
    nothing = (0.0, 0.0, 0.0)
    for t_us, a, g in zip(recording.imu.t_us.tolist(), accel.tolist(), gyro.tolist(), strict=True):
        writer.writeImu(dv.IMU(t_us, 0.0, *a, *g, *nothing))
