"""Writing the text layout of the UZH Event-Camera Dataset; `uzh` reads it back with every number the same."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numba import njit

from dvsviz.errors import FormatError
from dvsviz.events.recording import FrameSource, Imu, Recording
from dvsviz.formats.uzh import DEFAULT_SIZE
from dvsviz.geometry import se3
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.trajectory import Trajectory
from dvsviz.geometry.tum import seconds_text

# The longest line of an event: a sign, 13 digits, a point, 6 digits, two coordinates of 5, a polarity, parting.
_MOST_BYTES = 36


def write_uzh(recording: Recording, folder: Path) -> None:
    """Write a recording: `events.txt`, `calib.txt`; where it has them, `groundtruth.txt`, `images.txt`, `imu.txt`.

    Times have six decimals, everything else as many digits as it needs. Inertial measurements without acceleration
    are left out, as the layout has no word for them. Where neither the frames nor the layout's own 240 x 180 say the
    sensor's size, a second line of `calib.txt` does. A guessed calibration is not written, as the layout could not say
    that it is one: then the size is the first line of `events.txt`.

    Args:
        recording: what is written.
        folder: where; made where it is missing.

    Raises:
        FormatError: the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        camera = recording.camera
        with (folder / "events.txt").open("wb") as out:
            if camera.is_guess:
                out.write(f"{camera.width} {camera.height}\n".encode())
            for events in recording.chunks(1 << 18):
                data = np.empty(len(events) * _MOST_BYTES, np.uint8)
                size = _format(events.t_us, events.x_px, events.y_px, events.is_positive, data)
                out.write(data[:size].tobytes())
        if not camera.is_guess:
            _write_calibration(camera, folder, has_frames=recording.frames is not None)
        if recording.ground_truth is not None:
            _write_poses(recording.ground_truth, folder / "groundtruth.txt")
        if recording.imu is not None:
            _write_imu(recording.imu, folder / "imu.txt")
        if recording.frames is not None:
            _write_frames(recording.frames, folder)
    except OSError as error:
        hint = "check the folder and the free space"
        raise FormatError(f"cannot be written: {error.strerror}", path=folder, hint=hint) from error


@njit(cache=True, nogil=True)
def _digits(out, at, value, least):
    """Write a number that is not negative, with at least so many digits, and return where it ends."""
    count, rest = 1, value // 10
    while rest:
        count += 1
        rest //= 10
    count = max(count, least)
    for i in range(count - 1, -1, -1):
        out[at + i] = 48 + value % 10
        value //= 10
    return at + count


@njit(cache=True, nogil=True)
def _format(t_us, x, y, p, out):
    """Write the lines `seconds x y p` and return their size."""
    at = 0
    for k in range(len(t_us)):
        t = t_us[k]
        if t < 0:
            out[at] = 45
            at += 1
            t = -t
        at = _digits(out, at, t // 1_000_000, 1)
        out[at] = 46
        at = _digits(out, at + 1, t % 1_000_000, 6)
        out[at] = 32
        at = _digits(out, at + 1, np.int64(x[k]), 1)
        out[at] = 32
        at = _digits(out, at + 1, np.int64(y[k]), 1)
        out[at], out[at + 1], out[at + 2] = 32, 49 if p[k] else 48, 10
        at += 3
    return at


def _write_calibration(camera: Camera, folder: Path, *, has_frames: bool) -> None:
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion)
    lines = [" ".join(repr(float(v)) for v in numbers)]
    if not has_frames and (camera.width, camera.height) != DEFAULT_SIZE:
        lines.append(f"{camera.width} {camera.height}")
    (folder / "calib.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _write_poses(truth: Trajectory, path: Path) -> None:
    values = np.concatenate([truth.positions, se3.xyzw_from_wxyz(truth.quaternions_wxyz)], axis=1)
    _write_table(truth.t_us, values, path)


def _write_imu(imu: Imu, path: Path) -> None:
    whole = np.all(np.isfinite(imu.accel), axis=1)
    if whole.any():
        _write_table(imu.t_us[whole], np.concatenate([imu.accel, imu.gyro], axis=1)[whole], path)


def _write_table(t_us: np.ndarray, values: np.ndarray, path: Path) -> None:
    with path.open("w", encoding="utf-8", newline="\n") as out:
        for t, row in zip(t_us.tolist(), values.tolist(), strict=True):
            out.write(f"{seconds_text(t)} {' '.join(map(repr, row))}\n")


def _write_frames(frames: FrameSource, folder: Path) -> None:
    (folder / "images").mkdir(exist_ok=True)
    lines = []
    for k, t in enumerate(frames.t_us.tolist()):
        name = f"images/frame_{k:08d}.png"
        done, data = cv2.imencode(".png", frames.read(k))
        if not done:
            raise FormatError("the frame cannot be encoded", path=folder / name, hint="write it without frames")
        (folder / name).write_bytes(data.tobytes())
        lines.append(f"{seconds_text(t)} {name}\n")
    (folder / "images.txt").write_text("".join(lines), encoding="utf-8")
