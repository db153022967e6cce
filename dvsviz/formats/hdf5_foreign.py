"""HDF5 recordings of other programs: DSEC, MVSEC, and any group or dataset that holds the columns of events.

Our own format comes here too where `--repair` was asked for and its events break the rules.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import h5py
import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import FormatError
from dvsviz.formats.checks import check_stored
from dvsviz.formats.columns import Columns, find_names, tell_order
from dvsviz.formats.dsec import dsec_camera
from dvsviz.formats.sink import RecordingSink
from dvsviz.formats.sizes import KNOWN_SIZES, assumption, require_size
from dvsviz.geometry.camera import Camera

FORMAT_NAME = "HDF5"
_BLOCK = 1 << 18
# DSEC's sensor is known by its layout, MVSEC's by its group.
_DSEC_SIZE, _MVSEC_SIZE = (640, 480), (346, 260)
_MVSEC_EVENTS = "davis/left/events"


def layout(file: h5py.File) -> str | None:
    """Return `DSEC HDF5`, `MVSEC HDF5`, `HDF5 events`, or None where there are no events known here."""
    if isinstance(file.get(_MVSEC_EVENTS), h5py.Dataset):
        return "MVSEC HDF5"
    if isinstance(file.get("events"), h5py.Group) and "t_offset" in file:
        return "DSEC HDF5"
    return "HDF5 events" if _find(file) is not None else None


def _find(file: h5py.File) -> list[h5py.Dataset] | None:
    """Return the datasets t, x, y, p, or the one dataset of rows, at the root, in `events`, or in `CD/events`."""
    for name in ("events", "CD/events", "dvs/events", "/"):
        found = file.get(name)
        if isinstance(found, h5py.Dataset):
            return [found] if (found.ndim == 1 and found.dtype.names) or found.ndim == 2 else None
        if isinstance(found, h5py.Group):
            datasets = [str(key) for key in found if isinstance(found.get(str(key)), h5py.Dataset)]
            names = find_names(datasets)
            if names is not None:
                return [_dataset(found[key]) for key in names]
    return None


def convert_hdf5(path: Path, sink: RecordingSink) -> None:
    """Read an HDF5 file of a known layout into a recording.

    Raises:
        FormatError: columns that differ in length, a damaged file, or a sensor's size that is not known.
    """
    try:
        with h5py.File(path, "r") as file:
            _convert(file, path, sink)
    except (OSError, RuntimeError, KeyError) as error:
        reason = " ".join(str(error).split())[:100]
        raise FormatError(f"damaged or cut short ({reason})", path=path, hint="copy it again") from error


def _convert(file: h5py.File, path: Path, sink: RecordingSink) -> None:
    kind = layout(file)
    if kind == "MVSEC HDF5":
        datasets, size = [_dataset(file[_MVSEC_EVENTS])], _MVSEC_SIZE
    else:
        found = _find(file)
        if found is None:
            _refuse("no events of a known layout", path)
        datasets, size = found, _size(file) or (_DSEC_SIZE if kind == "DSEC HDF5" else None)
    for dataset in datasets:
        check_stored(dataset, path)
    shapes = [dataset.shape for dataset in datasets]
    if len(datasets) == 4 and (len(set(shapes)) != 1 or len(shapes[0]) != 1):
        _refuse(f"t, x, y, p differ in size: {', '.join(map(str, shapes))}", path)
    # DSEC's times count from `t_offset`, microseconds of the clock that its poses and images share.
    offset = int(np.asarray(_dataset(file["t_offset"])[()]).ravel()[0]) if kind == "DSEC HDF5" else 0

    def blocks() -> Iterator[tuple[float, Columns]]:
        return _column_blocks(datasets) if len(datasets) == 4 else _row_blocks(datasets[0], path)

    size = sink.options.size or size
    if size is None:
        max_x, max_y = 0, 0
        for _, (_t, x, y, _p) in blocks():
            max_x, max_y = max(max_x, int(x.max())), max(max_y, int(y.max()))
        size = require_size(max_x, max_y, path)
        sink.warn(assumption(size))
    if kind == "DSEC HDF5":
        camera, warnings = dsec_camera(file, path, size)
        for warning in warnings:
            sink.warn(warning)
        sink.start(camera)
    else:
        sink.start(_camera(file, size))
    for share, (t, x, y, p) in blocks():
        sink.add(_microseconds(t, path) + offset, _whole(x, path), _whole(y, path), p > 0)
        sink.options.report(share)


def _camera(file: h5py.File, size: tuple[int, int]) -> Camera:
    """Return the calibration of our own format where there is one, else a guess."""
    group = file.get("camera")
    guess = Camera.guess(*size)
    if not isinstance(group, h5py.Group):
        return guess
    try:
        k1, k2, p1, p2, k3 = (
            float(value) for value in np.asarray(group.attrs.get("distortion", np.zeros(5))).ravel()
        )
        fx, fy, cx, cy = (float(np.asarray(group.attrs[name])) for name in ("fx", "fy", "cx", "cy"))
        return Camera(width=size[0], height=size[1], fx=fx, fy=fy, cx=cx, cy=cy, distortion=(k1, k2, p1, p2, k3))
    except (ValueError, TypeError, KeyError):
        return guess


def _size(file: h5py.File) -> tuple[int, int] | None:
    """Return the sensor's size where attributes of the root tell it."""
    for names in (("width", "height"), ("sensor_width", "sensor_height")):
        values = [file.attrs.get(name) for name in names]
        if all(isinstance(value, int | np.integer) for value in values):
            width, height = (int(np.asarray(value)) for value in values)
            if min(width, height) >= 1 and max(width, height) <= 65_535:
                return width, height
    resolution = file.attrs.get("sensor_resolution")
    if isinstance(resolution, np.ndarray) and resolution.shape == (2,):
        # Some programs write (width, height), others (height, width): sensors are wider than high.
        width, height = max(map(int, resolution)), min(map(int, resolution))
        return (width, height) if (width, height) in KNOWN_SIZES else None
    return None


def _column_blocks(datasets: list[h5py.Dataset]) -> Iterator[tuple[float, Columns]]:
    n = len(datasets[0])
    for first in range(0, n, _BLOCK):
        key = slice(first, first + _BLOCK)
        t, x, y, p = (np.asarray(dataset[key]) for dataset in datasets)
        yield min(1.0, (first + _BLOCK) / n), (t, x, y, p)


def _row_blocks(dataset: h5py.Dataset, path: Path) -> Iterator[tuple[float, Columns]]:
    fields = dataset.dtype.names
    order: tuple[int | str, ...] | None = None
    if fields is not None and (order := find_names(fields)) is None:
        _refuse(f"expected fields t, x, y, p, got {', '.join(fields)}", path)
    if fields is None and dataset.shape[1] != 4:
        _refuse(f"expected four columns, got {dataset.shape[1]}", path)
    n = len(dataset)
    for first in range(0, n, _BLOCK):
        rows = np.asarray(dataset[first : first + _BLOCK])
        if order is None and (order := tell_order(rows)) is None:
            _refuse("the columns are neither t x y p, x y t p nor x y p t", path)
        t, x, y, p = (rows[key] if isinstance(key, str) else rows[:, key] for key in order)
        yield min(1.0, (first + _BLOCK) / n), (t, x, y, p)


def _microseconds(t: NDArray, path: Path) -> NDArray[np.int64]:
    if t.dtype.kind in "iu":
        return t.astype(np.int64)
    if t.dtype.kind != "f" or not np.all(np.isfinite(t)) or np.abs(t).max(initial=0.0) > 2**42:
        _refuse("a time is not a finite number of seconds", path)
    # MVSEC: seconds since 1970 as float64, whose steps are 0.24 us there.
    return np.round(t * 1e6).astype(np.int64)


def _whole(values: NDArray, path: Path) -> NDArray:
    if values.dtype.kind in "iu":
        return values
    if values.dtype.kind != "f" or not np.all(np.isfinite(values)) or np.any(values != np.floor(values)):
        _refuse("a pixel is not a whole number", path)
    return values.astype(np.int64)


def _dataset(found: Any) -> h5py.Dataset:
    if not isinstance(found, h5py.Dataset):
        raise KeyError("a dataset is missing")
    return found


def _refuse(message: str, path: Path) -> NoReturn:
    raise FormatError(message, path=path, place="events", hint="docs/formats.md lists the layouts that are known")
