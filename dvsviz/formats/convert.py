"""Conversion of any recording to a file that other programs read, whole or a part of it."""

from __future__ import annotations

import tempfile
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from dvsviz.errors import FormatError
from dvsviz.events.events import Events
from dvsviz.events.filters import EventFilter, FilterConfig
from dvsviz.events.recording import Imu, Recording
from dvsviz.formats.aedat4_writer import write_aedat4
from dvsviz.formats.dsec_writer import write_dsec
from dvsviz.formats.filtered import hot_mask
from dvsviz.formats.hdf5 import RecordingWriter, read_recording
from dvsviz.formats.uzh_writer import write_uzh
from dvsviz.geometry.camera import Camera
from dvsviz.geometry.trajectory import Trajectory
from dvsviz.geometry.tum import write_tum

Target = Literal["hdf5", "uzh", "dsec", "aedat4", "tum"]
_SUFFIXES: dict[str, Target] = {
    ".h5": "hdf5",
    ".hdf5": "hdf5",
    ".aedat4": "aedat4",
    ".tum": "tum",
    ".zip": "uzh",
    "": "uzh",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Selection:
    """Which part of a recording is taken.

    Attributes:
        start_s: seconds after the first event.
        end_s: seconds after the first event, exclusive; None for the end.
        roi: x, y, width, height of the pixels that are kept; the result's pixels count from its corner.
        stride: every so manieth of the events that are left is kept.
        filters: applied to the whole sensor, before anything else is cut.
    """

    start_s: float = 0.0
    end_s: float | None = None
    roi: tuple[int, int, int, int] | None = None
    stride: int = 1
    filters: FilterConfig = field(default_factory=FilterConfig)

    @property
    def is_everything(self) -> bool:
        """Whether nothing is left out."""
        return self == Selection()


def target_of(out: Path, target: Target | None = None) -> Target:
    """Return the format that is said, or that the file's ending says.

    Raises:
        FormatError: neither does.
    """
    if target is not None:
        return target
    found = _SUFFIXES.get(out.suffix.lower())
    if found is None:
        hint = "name x.h5, x.aedat4, x.tum, x.zip or a folder, or say --to " + "|".join(get_args(Target))
        raise FormatError(f"cannot tell a format from the ending {out.suffix}", path=out, hint=hint)
    return found


def convert(
    recording: Recording,
    out: Path,
    *,
    target: Target | None = None,
    selection: Selection | None = None,
    progress: Callable[[float], None] | None = None,
) -> dict[str, Any]:
    """Write a recording in another format and return `out, target, events, events_kept`.

    Args:
        recording: what is converted.
        out: the file; for `uzh` a folder, or a `.zip`.
        target: the format; told by the ending of `out` where it is None.
        selection: which part; everything where it is None.
        progress: called with the share done, 0 to 1.

    Raises:
        FormatError: the format cannot hold it, the selection leaves no event, or the file cannot be written.
    """
    selection, kind = selection or Selection(), target_of(out, target)
    if recording.path.exists() and out.exists() and out.samefile(recording.path):
        raise FormatError("is the recording itself", path=out, hint="name another file")
    _check(recording, selection, out)
    if kind == "tum":
        truth = _cut_truth(recording, selection)
        if truth is None or len(truth) == 0:
            hint = "give poses with --ground-truth"
            raise FormatError("there is no ground truth in it", path=recording.path, hint=hint)
        write_tum(out, truth)
        return {"out": str(out), "target": kind, "events": recording.events.count, "events_kept": 0}
    out.parent.mkdir(parents=True, exist_ok=True)
    if kind == "hdf5":
        kept = write_selected(recording, out, selection, progress)
        return {"out": str(out), "target": kind, "events": recording.events.count, "events_kept": kept}
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=".converting-") as folder:
        part = recording
        if not selection.is_everything:
            write_selected(recording, Path(folder) / "part.h5", selection, progress)
            part = replace(read_recording(Path(folder) / "part.h5"), name=recording.name)
        write = {"uzh": _write_text, "dsec": write_dsec, "aedat4": write_aedat4}[kind]
        write(part, out)
        kept = part.events.count
        if part is not recording:
            part.close()
    if progress is not None:
        progress(1.0)
    return {"out": str(out), "target": kind, "events": recording.events.count, "events_kept": kept}


def _write_text(recording: Recording, out: Path) -> None:
    """Write the Event Camera Dataset's layout as a folder, or as an archive of it."""
    if out.suffix.lower() != ".zip":
        if out.is_file():
            raise FormatError("is a file", path=out, hint="this layout is a folder or a .zip: name one of them")
        write_uzh(recording, out)
        return
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=".converting-") as scratch:
        folder, archive = Path(scratch) / "text", Path(scratch) / "archive.zip"
        write_uzh(recording, folder)
        with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as file:
            for path in sorted(path for path in folder.rglob("*") if path.is_file()):
                file.write(path, path.relative_to(folder))
        archive.replace(out)


def _check(recording: Recording, selection: Selection, out: Path) -> None:
    end_s = recording.duration_s if selection.end_s is None else selection.end_s
    if not (np.isfinite(selection.start_s) and np.isfinite(end_s) and 0 <= selection.start_s <= end_s):
        hint = f"expected seconds after the first event, 0 to {recording.duration_s:.6f}"
        raise FormatError(f"from {selection.start_s} to {end_s} s", path=out, place="--start, --end", hint=hint)
    if selection.stride < 1:
        raise FormatError(
            f"every {selection.stride}th event", path=out, place="--stride", hint="expected 1 or more"
        )
    if selection.roi is not None:
        x, y, width, height = selection.roi
        sensor = (recording.camera.width, recording.camera.height)
        if min(x, y) < 0 or min(width, height) < 1 or x + width > sensor[0] or y + height > sensor[1]:
            hint = f"expected X,Y,WIDTH,HEIGHT inside the sensor of {sensor[0]}x{sensor[1]}"
            raise FormatError(f"{x},{y},{width},{height} lies outside", path=out, place="--roi", hint=hint)


def write_selected(
    recording: Recording, out: Path, selection: Selection, progress: Callable[[float], None] | None = None
) -> int:
    """Write the selected part of a recording in our own format and return its number of events.

    Raises:
        FormatError: no event is left.
    """
    kept = 0
    with RecordingWriter(out, camera=_cut_camera(recording.camera, selection)) as writer:
        for events in _selected(recording, selection, progress):
            writer.append(events)
            kept += len(events)
        if kept == 0:
            raise FormatError("no event is left", path=out, hint="take a larger part, or weaker filters")
        if (truth := _cut_truth(recording, selection)) is not None and len(truth):
            writer.set_ground_truth(truth)
        if (imu := _cut_imu(recording, selection)) is not None:
            writer.set_imu(imu)
        for t_us, image in _cut_frames(recording, selection):
            writer.append_frame(t_us, image)
        if recording.mean_plane_distance is not None or recording.plane_normal_world is not None:
            writer.set_plane(
                mean_plane_distance=recording.mean_plane_distance,
                normal_world=recording.plane_normal_world,
                distance_world=recording.plane_distance_world,
            )
    return kept


def _span(recording: Recording, selection: Selection) -> tuple[int, int]:
    """Return the first microsecond that is taken and the first one after."""
    first, last = recording.first_us, recording.last_us
    end_us = last + 1 if selection.end_s is None else min(last + 1, first + round(selection.end_s * 1e6))
    return first + round(selection.start_s * 1e6), end_us


def _selected(
    recording: Recording, selection: Selection, progress: Callable[[float], None] | None
) -> Iterator[Events]:
    camera, filters = recording.camera, selection.filters
    act = None
    if filters.is_active:
        mask = hot_mask(recording) if filters.hot_pixels else None
        act = EventFilter(camera.width, camera.height, filters, mask)
    start_us, end_us = _span(recording, selection)
    # Filters remember the pixels' pasts, so that they see what lies before the start too.
    first = 0 if act is not None else recording.events.index_at(start_us)
    end = recording.events.index_at(end_us)
    seen, size = 0, 1 << 20
    for at in range(first, end, size):
        events = recording.events.read(at, min(end, at + size))
        if act is not None:
            events = act(events)
            events = events[int(np.searchsorted(events.t_us, start_us)) :]
        if selection.roi is not None:
            events = _crop(events, selection.roi)
        if selection.stride > 1:
            skip = -seen % selection.stride
            seen += len(events)
            events = events[skip :: selection.stride]
        yield events
        if progress is not None:
            progress(min(1.0, (at + size) / max(1, end)))


def _crop(events: Events, roi: tuple[int, int, int, int]) -> Events:
    x0, y0, width, height = roi
    # Below the corner the unsigned difference wraps to a large number, which is outside as well.
    x, y = events.x_px - np.uint16(x0), events.y_px - np.uint16(y0)
    inside = (x < width) & (y < height)
    return Events(t_us=events.t_us[inside], x_px=x[inside], y_px=y[inside], is_positive=events.is_positive[inside])


def _cut_camera(camera: Camera, selection: Selection) -> Camera:
    if selection.roi is None:
        return camera
    x, y, width, height = selection.roi
    return replace(camera, width=width, height=height, cx=camera.cx - x, cy=camera.cy - y)


def _cut_truth(recording: Recording, selection: Selection) -> Trajectory | None:
    truth = recording.ground_truth
    if truth is None or (selection.start_s == 0 and selection.end_s is None):
        return truth
    start_us, end_us = _span(recording, selection)
    # One pose more on either side, so that the part's first and last events lie between two.
    first = max(0, int(np.searchsorted(truth.t_us, start_us, side="right")) - 1)
    end = min(len(truth), int(np.searchsorted(truth.t_us, end_us)) + 1)
    return Trajectory(t_us=truth.t_us[first:end], Ts_world_camera=truth.Ts_world_camera[first:end])


def _cut_imu(recording: Recording, selection: Selection) -> Imu | None:
    imu = recording.imu
    if imu is None or (selection.start_s == 0 and selection.end_s is None):
        return imu
    start_us, end_us = _span(recording, selection)
    inside = (imu.t_us >= start_us) & (imu.t_us < end_us)
    return Imu(t_us=imu.t_us[inside], gyro=imu.gyro[inside], accel=imu.accel[inside]) if inside.any() else None


def _cut_frames(recording: Recording, selection: Selection) -> Iterator[tuple[int, np.ndarray]]:
    if recording.frames is None:
        return
    start_us, end_us = _span(recording, selection)
    whole = selection.start_s == 0 and selection.end_s is None
    for k, t_us in enumerate(recording.frames.t_us.tolist()):
        if whole or start_us <= t_us < end_us:
            image = recording.frames.read(k)
            if selection.roi is not None:
                x, y, width, height = selection.roi
                if image.shape != (recording.camera.height, recording.camera.width):
                    continue
                image = np.ascontiguousarray(image[y : y + height, x : x + width])
            yield t_us, image
