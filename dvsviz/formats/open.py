"""Opening of any recording: the format is recognised by content, foreign ones are converted once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

import h5py

from dvsviz.errors import FormatError
from dvsviz.events.filters import FilterConfig
from dvsviz.events.inertial import imu_warnings
from dvsviz.events.recording import Recording
from dvsviz.formats import (
    aedat2,
    aedat3,
    aedat4,
    dsec,
    event_stream,
    hdf5_foreign,
    matlab,
    matlab73,
    prophesee,
    ros,
)
from dvsviz.formats.arrays import convert_npy, convert_npz
from dvsviz.formats.cache import cached
from dvsviz.formats.calibration import read_calibration
from dvsviz.formats.checks import MAX_SIDE
from dvsviz.formats.container import Folder, Zip
from dvsviz.formats.filtered import filtered
from dvsviz.formats.ground_truth import read_ground_truth
from dvsviz.formats.hdf5 import GUESS_WARNING, read_recording
from dvsviz.formats.hdf5_rescue import rescue
from dvsviz.formats.options import OpenOptions
from dvsviz.formats.sink import RecordingSink
from dvsviz.formats.uzh import FORMAT_NAME as UZH_NAME
from dvsviz.formats.uzh import convert_uzh

_HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
_ZIP_MAGICS = (b"PK\x03\x04", b"PK\x05\x06")
_HEAD_BYTES = 1 << 16
_NPY_MAGIC = b"\x93NUMPY"
_UZH_FILES = ("events.txt", "groundtruth.txt", "calib.txt", "images.txt", "imu.txt")


def open_recording(
    path: Path,
    *,
    size: tuple[int, int] | None = None,
    calibration: Path | None = None,
    repair: bool = False,
    topic: str | None = None,
    ground_truth: Path | str | None = None,
    gt_offset_s: float = 0.0,
    filters: FilterConfig | None = None,
    progress: Callable[[float], None] | None = None,
) -> Recording:
    """Return the recording in a file, folder or archive of any known format.

    A format other than our own is converted once; the copy is kept in the cache folder (`formats.cache`). What a
    killed run left of a recording gets its name first (`formats.hdf5_rescue`).

    Args:
        path: the recording.
        size: sensor (width, height), px, where the recording does not say it or says it wrong.
        calibration: a calibration file that replaces what is recorded.
        repair: drop and count events, poses and frames that are wrong instead of refusing the file.
        topic: which event topic of a bag is read.
        ground_truth: true poses that replace the recorded ones: a file (`formats.ground_truth`), or a topic of a bag.
        gt_offset_s: seconds to add to the times of the true poses.
        filters: which events are kept.
        progress: called with the share done, 0 to 1, while a file is converted.

    Raises:
        FormatError: no such file, no known format, or a recording that cannot be read as it is; it names the
            file, the place and what to do.
    """
    path = Path(path)
    if size is not None and not all(1 <= side <= MAX_SIDE for side in size):
        hint = f"expected 1 to {MAX_SIDE} pixels"
        raise FormatError(f"a sensor of {size[0]}x{size[1]}", place="--size", hint=hint)
    truth_topic = None
    if ground_truth is not None and str(ground_truth).startswith("/") and not Path(ground_truth).exists():
        truth_topic = str(ground_truth)
    options = OpenOptions(size=size, repair=repair, topic=topic, truth_topic=truth_topic, progress=progress)
    found = None if calibration is None else read_calibration(calibration, camera=dsec.camera_name(path))
    if found is not None and found.size is not None and size is None:
        options = replace(options, size=found.size)
    try:
        exists = path.exists() or rescue(path) is not None
    except OSError:
        exists = False
    if not exists:
        raise FormatError("no such file or folder", path=path, hint="check the path")
    try:
        recording = _open_folder(path, options) if path.is_dir() else _open_file(path, options)
    except PermissionError as error:
        raise FormatError("cannot be read", path=path, hint="check its permissions") from error
    if filters is not None:
        recording = filtered(recording, filters, options)
    if found is not None:
        camera = found.camera(recording.camera.width, recording.camera.height)
        guess = GUESS_WARNING.split(":")[0]
        warnings = tuple(warning for warning in recording.warnings if not warning.startswith(guess))
        recording = replace(recording, camera=camera, warnings=warnings)
    recording = replace(recording, warnings=(*recording.warnings, *imu_warnings(recording)))
    return _with_truth(recording, ground_truth, gt_offset_s, options)


def _with_truth(
    recording: Recording, ground_truth: Path | str | None, offset_s: float, options: OpenOptions
) -> Recording:
    """Replace or shift a recording's true poses as the user said."""
    if options.truth_topic is not None and not recording.format.startswith(ros.FORMAT_NAME):
        message = "neither a file, nor a topic: the recording is no bag"
        raise FormatError(message, path=Path(options.truth_topic), hint="check the path given with --ground-truth")
    if ground_truth is not None and options.truth_topic is None:
        truth = read_ground_truth(Path(ground_truth), offset_s=offset_s, repair=options.repair)
        return replace(recording, ground_truth=truth)
    if offset_s and recording.ground_truth is not None:
        truth = recording.ground_truth
        return replace(recording, ground_truth=replace(truth, t_us=truth.t_us + round(offset_s * 1e6)))
    return recording


def _open_folder(path: Path, options: OpenOptions) -> Recording:
    folder = Folder(path)
    if folder.has("events.txt"):
        files = [path / name for name in _UZH_FILES]
        return _converted(path, files, options, UZH_NAME, lambda sink: convert_uzh(folder, sink))
    if folder.has("events.npz"):
        files = [path / "events.npz", path / "calib.txt"]
        return _converted(path, files, options, "npz", lambda sink: _npz(path / "events.npz", sink, folder))
    bag = [child for child in sorted(path.iterdir()) if child.suffix in (".db3", ".mcap")]
    if bag:
        files = [*bag, path / "metadata.yaml"]
        return _converted(path, files, options, ros.FORMAT_NAME, lambda sink: ros.convert_ros(path, sink))
    inside = [child for child in path.iterdir() if child.is_dir() and Folder(child).has("events.txt")]
    if len(inside) == 1:
        return _open_folder(inside[0], options)
    hint = "expected events.txt (Event Camera Dataset), events.npz or a ROS 2 bag inside"
    raise FormatError("no recording in this folder", path=path, hint=hint)


def _open_file(path: Path, options: OpenOptions) -> Recording:
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    if not head:
        raise FormatError("the file is empty", path=path, hint="record or copy it again")
    if head.startswith(_HDF5_MAGIC):
        return _open_hdf5(path, options)
    if head.startswith(_ZIP_MAGICS):
        return _open_zip(path, options)
    if head.startswith(_NPY_MAGIC):
        return _converted(path, [path], options, "npy", lambda sink: convert_npy(path, sink))
    if head.startswith(aedat3.MAGIC):
        return _converted(path, [path], options, aedat3.FORMAT_NAME, lambda sink: aedat3.convert_aedat3(path, sink))
    if head.startswith(aedat4.MAGIC):
        return _converted(path, [path], options, aedat4.FORMAT_NAME, lambda sink: aedat4.convert_aedat4(path, sink))
    if head.startswith((ros.ROS1_MAGIC, ros.MCAP_MAGIC, ros.SQLITE_MAGIC)):
        return _converted(path, [path], options, ros.FORMAT_NAME, lambda sink: ros.convert_ros(path, sink))
    if head.startswith(aedat2.MAGIC):
        return _converted(path, [path], options, aedat2.FORMAT_NAME, lambda sink: aedat2.convert_aedat2(path, sink))
    if head.startswith(matlab.MAGIC):
        return _converted(path, [path], options, matlab.FORMAT_NAME, lambda sink: matlab.convert_mat(path, sink))
    if head.startswith(matlab73.MAGIC):
        name = matlab73.FORMAT_NAME
        return _converted(path, [path], options, name, lambda sink: matlab73.convert_mat73(path, sink))
    if head.startswith(event_stream.MAGIC):
        name = event_stream.FORMAT_NAME
        return _converted(path, [path], options, name, lambda sink: event_stream.convert_event_stream(path, sink))
    if (header := prophesee.read_header(head)) is not None:
        name = f"Prophesee {header.encoding}"
        return _converted(path, [path], options, name, lambda sink: prophesee.convert_prophesee(path, header, sink))
    if _is_text_events(head):
        # The file alone: what lies beside it in its folder belongs to it.
        folder = Folder(path.parent)
        files = [path, *(path.parent / name for name in _UZH_FILES[1:])]
        return _converted(
            path, files, options, UZH_NAME, lambda sink: convert_uzh(folder, sink, events_name=path.name)
        )
    _refuse_unknown(path)


def _is_text_events(head: bytes) -> bool:
    """Tell whether the first line that is no comment starts with a number, as a line of events does."""
    if b"\x00" in head:
        return False
    for line in head.removeprefix(b"\xef\xbb\xbf").splitlines():
        words = line.replace(b",", b" ").split()
        if words and not words[0].startswith(b"#"):
            return 2 <= len(words) <= 5 and words[0][:1] in b"+-.0123456789"
    return False


def _open_hdf5(path: Path, options: OpenOptions) -> Recording:
    try:
        with h5py.File(path, "r") as file:
            own, kind = "format" in file.attrs, hdf5_foreign.layout(file)
    except (OSError, RuntimeError, KeyError) as error:
        raise FormatError("a damaged HDF5 file", path=path, hint="copy it again") from error
    if own or kind is None:
        try:
            recording = read_recording(path)
            if not options.repair:
                return _resized(recording, options)
            # Repair needs all events looked at, not only those of the first blocks.
            for _ in recording.chunks():
                pass
            return _resized(recording, options)
        except FormatError:
            if not options.repair or kind is None:
                raise
    name = kind or hdf5_foreign.FORMAT_NAME
    files = [path, *dsec.beside(path)] if name == "DSEC HDF5" else [path]
    return _converted(path, files, options, name, lambda sink: hdf5_foreign.convert_hdf5(path, sink))


def _resized(recording: Recording, options: OpenOptions) -> Recording:
    """Check that the size the user gave is that of the file."""
    camera = recording.camera
    if options.size is not None and options.size != (camera.width, camera.height):
        given = f"{options.size[0]}x{options.size[1]}"
        message = f"the sensor is {camera.width}x{camera.height}, not {given}"
        raise FormatError(message, path=recording.path, hint="leave --size out")
    return recording


def _open_zip(path: Path, options: OpenOptions) -> Recording:
    archive = Zip(path)
    try:
        if archive.has("events.txt"):
            return _converted(path, [path], options, f"{UZH_NAME} (zip)", lambda sink: convert_uzh(archive, sink))
        if path.name == "events.npz" and (path.parent / "calib.txt").is_file():
            files, folder = [path, path.parent / "calib.txt"], Folder(path.parent)
            return _converted(path, files, options, "npz", lambda sink: convert_npz(archive, sink, beside=folder))
        if any(name.endswith(".npy") for name in archive.names):
            return _converted(path, [path], options, "npz", lambda sink: convert_npz(archive, sink))
    finally:
        archive.close()
    raise FormatError("no events.txt in this archive", path=path, hint="expected the Event Camera Dataset's layout")


def _npz(path: Path, sink: RecordingSink, folder: Folder) -> None:
    archive = Zip(path)
    try:
        convert_npz(archive, sink, beside=folder)
    finally:
        archive.close()


def _converted(
    path: Path, files: list[Path], options: OpenOptions, name: str, read: Callable[[RecordingSink], None]
) -> Recording:
    def convert(target: Path) -> None:
        with RecordingSink(target, path, name, options) as sink:
            read(sink)

    return cached(path, files, options, convert, kind=name)


def _refuse_unknown(path: Path) -> NoReturn:
    raise FormatError("no recording of a known format", path=path, hint="docs/formats.md lists the formats")
