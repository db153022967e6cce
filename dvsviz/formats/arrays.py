"""NumPy files: `.npz` of columns t, x, y, p; `.npy` of a structured or an (N, 4) array; read block by block."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import BinaryIO, NoReturn

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from dvsviz.errors import FormatError
from dvsviz.formats.calibration import parse_calibration
from dvsviz.formats.columns import Columns, find_names, tell_order
from dvsviz.formats.container import Container, Zip
from dvsviz.formats.sink import RecordingSink
from dvsviz.formats.sizes import assumption, require_size
from dvsviz.formats.uzh import DEFAULT_SIZE
from dvsviz.geometry.camera import Camera

_BLOCK = 1 << 19
_MAX_EVENTS = 1 << 40


class _Array:
    """One `.npy` stream: its header, then blocks of rows."""

    def __init__(self, file: BinaryIO, path: Path) -> None:
        self._file, self._path = file, path
        try:
            version = npy.read_magic(file)
            read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
            self.shape, self.fortran, self.dtype = read(file)
        except (ValueError, EOFError, OSError) as error:
            raise FormatError("not a NumPy array", path=path, hint="save it again with numpy.savez") from error
        if self.dtype.hasobject:
            _refuse("it holds Python objects, which are not read", path)
        if self.dtype.itemsize == 0 or any(side < 0 or side > _MAX_EVENTS for side in self.shape):
            _refuse(f"an array of shape {self.shape} and type {self.dtype}", path)

    def block(self, rows: int) -> NDArray:
        """Return the next rows of a C-ordered array."""
        width = int(np.prod(self.shape[1:], dtype=np.int64))
        size = rows * width * self.dtype.itemsize
        data = bytearray()
        while len(data) < size:
            part = self._file.read(min(size - len(data), 1 << 22))
            if not part:
                _refuse("the array is cut short", self._path)
            data += part
        return np.frombuffer(bytes(data), self.dtype).reshape(rows, *self.shape[1:])


def convert_npz(container: Zip, sink: RecordingSink, *, beside: Container | None = None) -> None:
    """Read an `.npz` whose arrays are the columns of events, or one array of them.

    Args:
        container: the archive.
        sink: where events go.
        beside: the folder around it, whose `calib.txt` calibrates it.

    Raises:
        FormatError: a column is missing, differs in length or is damaged, or the sensor's size is not known.
    """
    names = {name.removesuffix(".npy"): name for name in container.names if name.endswith(".npy")}
    columns = find_names(names)
    if columns is not None:
        found = [names[column] for column in columns]

        def blocks() -> Iterator[tuple[float, Columns]]:
            return _column_blocks(container, found)
    elif len(names) == 1:
        name = next(iter(names.values()))

        def blocks() -> Iterator[tuple[float, Columns]]:
            with container.open(name) as file:
                yield from _row_blocks(_Array(file, container.where(name)), container.where(name))
    else:
        _refuse(f"no columns t, x, y, p among {', '.join(names) or 'no arrays'}", container.path)
    _convert(blocks, container.path, sink, beside)


def convert_npy(path: Path, sink: RecordingSink) -> None:
    """Read an `.npy` of a structured array with fields t, x, y, p, or of (N, 4) columns t x y p or x y t p."""

    def blocks() -> Iterator[tuple[float, Columns]]:
        with path.open("rb") as file:
            yield from _row_blocks(_Array(file, path), path)

    _convert(blocks, path, sink, None)


def _column_blocks(container: Container, names: list[str]) -> Iterator[tuple[float, Columns]]:
    with ExitStack() as stack:
        arrays = [_Array(stack.enter_context(container.open(name)), container.where(name)) for name in names]
        sizes = [array.shape for array in arrays]
        if any(len(size) != 1 or size != sizes[0] for size in sizes):
            _refuse(f"t, x, y, p differ in size: {', '.join(map(str, sizes))}", container.path)
        n = sizes[0][0]
        for first in range(0, n, _BLOCK):
            rows = min(_BLOCK, n - first)
            t, x, y, p = (array.block(rows) for array in arrays)
            yield (first + rows) / n, (t, x, y, p)


def _row_blocks(array: _Array, path: Path) -> Iterator[tuple[float, Columns]]:
    fields = array.dtype.names
    if fields is None and (len(array.shape) != 2 or array.shape[1] != 4 or array.fortran):
        _refuse(f"expected fields t, x, y, p or an (N, 4) array, got {array.shape} {array.dtype}", path)
    n = array.shape[0]
    order: tuple[int | str, ...] | None = None
    if fields is not None and (order := find_names(fields)) is None:
        _refuse(f"expected fields t, x, y, p, got {', '.join(fields)}", path)
    for first in range(0, n, _BLOCK):
        rows = array.block(min(_BLOCK, n - first))
        if order is None and (order := tell_order(rows)) is None:
            _refuse("the columns are neither t x y p, x y t p nor x y p t", path)
        t, x, y, p = (rows[key] if isinstance(key, str) else rows[:, key] for key in order)
        yield (first + len(rows)) / n, (t, x, y, p)


def _convert(blocks, path: Path, sink: RecordingSink, beside: Container | None) -> None:
    size = sink.options.size
    calibration = None
    if beside is not None and beside.has("calib.txt"):
        with beside.open("calib.txt") as file:
            calibration = parse_calibration(file.read(1 << 20), beside.where("calib.txt"))
        if size is None and calibration.size is not None:
            size = calibration.size
    try:
        if size is None:
            max_x, max_y = 0, 0
            for _, (_t, x, y, _p) in blocks():
                max_x, max_y = max(max_x, int(x.max())), max(max_y, int(y.max()))
            if calibration is not None and max_x < DEFAULT_SIZE[0] and max_y < DEFAULT_SIZE[1]:
                # A calib.txt is the Event-Camera Dataset's, whose sensor is known.
                size = DEFAULT_SIZE
                sink.warn(f"the sensor's size is not recorded: {size[0]}x{size[1]} assumed; give it with --size")
            else:
                size = require_size(max_x, max_y, path)
                sink.warn(assumption(size))
        sink.start(Camera.guess(*size) if calibration is None else calibration.camera(*size))
        scale = None
        for share, (t, x, y, p) in blocks():
            if scale is None:
                scale = _time_scale(t, path)
                if scale == 1_000_000:
                    sink.warn("times are floating point: taken as seconds")
            sink.add(_times(t, scale, path), _whole(x, path), _whole(y, path), p > 0)
            sink.options.report(share)
    except (zipfile.BadZipFile, EOFError) as error:
        raise FormatError("damaged or cut short", path=path, hint="copy it again") from error


def _time_scale(t: NDArray, path: Path) -> int:
    if t.dtype.kind in "iu":
        return 1
    if t.dtype.kind != "f":
        _refuse(f"times are {t.dtype}, expected integers", path)
    # Microseconds saved as floats are whole numbers; seconds are not.
    return 1 if np.all(t == np.floor(t)) and len(t) > 1 else 1_000_000


def _times(t: NDArray, scale: int, path: Path) -> NDArray[np.int64]:
    if t.dtype.kind in "iu":
        return t.astype(np.int64)
    if not np.all(np.isfinite(t)) or np.abs(t).max() * scale > 2**62:
        _refuse("a time is not finite", path)
    return np.round(t.astype(np.float64) * scale).astype(np.int64)


def _whole(values: NDArray, path: Path) -> NDArray:
    if values.dtype.kind in "iu":
        return values
    if values.dtype.kind != "f" or not np.all(np.isfinite(values)) or np.any(values != np.floor(values)):
        _refuse("a pixel is not a whole number", path)
    return values.astype(np.int64)


def _refuse(message: str, path: Path) -> NoReturn:
    raise FormatError(message, path=path, hint="expected arrays t_us, x, y, p of one length")
