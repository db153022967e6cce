"""MATLAB files of version 7.3, which are HDF5: a matrix of events or columns, also inside a struct, read in blocks.

MATLAB stores its arrays column by column, so that here an (N, 4) matrix is a dataset (4, N) and a column (1, N).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

import h5py
import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import FormatError
from dvsviz.formats.checks import check_stored
from dvsviz.formats.columns import Columns, find_names, tell_order
from dvsviz.formats.sink import RecordingSink
from dvsviz.formats.sizes import assumption, require_size
from dvsviz.geometry.camera import Camera

MAGIC = b"MATLAB 7.3 MAT-file"
FORMAT_NAME = "MATLAB 7.3"
_BLOCK = 1 << 18
# What MATLAB keeps for itself: references and the classes of objects.
_OWN = "#"


def convert_mat73(path: Path, sink: RecordingSink) -> None:
    """Read a MATLAB file of version 7.3 into a recording; pixels may count from 0 or from 1.

    Raises:
        FormatError: no events in it, or a damaged file.
    """
    try:
        with h5py.File(path, "r") as file:
            _convert(_Table(file, path), path, sink)
    except (OSError, RuntimeError, KeyError) as error:
        reason = " ".join(str(error).split())[:100]
        raise FormatError(f"damaged or cut short ({reason})", path=path, hint="save it again") from error


def _convert(table: _Table, path: Path, sink: RecordingSink) -> None:
    low, high = np.full(2, np.inf), np.zeros(2)
    for _, (_t, x, y, _p) in table.blocks():
        low = np.minimum(low, (x.min(), y.min()))
        high = np.maximum(high, (x.max(), y.max()))
    if not np.all(np.isfinite(low)):
        raise FormatError("there are no events", path=path, hint="record or save it again")
    size = sink.options.size
    one = int(low.min() >= 1)
    if size is None:
        # Counted from 1, the last column of a sensor has the number of its columns.
        size = require_size(int(high[0]) - one, int(high[1]) - one, path)
        sink.warn(assumption(size))
    shift = int(one and (high[0] == size[0] or high[1] == size[1]))
    if shift:
        sink.warn("pixels count from 1: one was taken off")
    sink.start(Camera.guess(*size))
    for share, (t, x, y, p) in table.blocks():
        sink.add(t, x - shift, y - shift, p > 0)
        sink.options.report(share)


class _Table:
    """The columns t, x, y, p of an open file."""

    def __init__(self, file: h5py.File, path: Path) -> None:
        self._path = path
        self._matrix: h5py.Dataset | None = None
        self._columns: tuple[h5py.Dataset, ...] = ()
        groups = [
            file,
            *(found for name, found in file.items() if isinstance(found, h5py.Group) and name[0] != _OWN),
        ]
        for group in groups:
            arrays = {str(name): found for name, found in group.items() if _is_numeric(found)}
            if (names := find_names(list(arrays))) is not None:
                self._columns = tuple(arrays[name] for name in names)
                break
            tables = [found for found in arrays.values() if found.ndim == 2 and found.shape[0] == 4]
            self._matrix = self._matrix or max(tables, key=lambda found: found.shape[1], default=None)
        if not self._columns and self._matrix is None:
            _refuse(f"no events among {', '.join(map(str, file)) or 'nothing'}"[:200], path)
        stored = self._columns or (self._matrix,)
        for dataset in stored:
            if dataset is not None:
                check_stored(dataset, path)
        sizes = {int(np.prod(dataset.shape)) for dataset in self._columns}
        if len(sizes) > 1:
            _refuse("t, x, y, p differ in length", path)
        self._count = sizes.pop() if sizes else int(self._matrix.shape[1]) if self._matrix is not None else 0

    def blocks(self) -> Iterator[tuple[float, Columns]]:
        """Yield (share done, columns of whole numbers); of a matrix the order is told by its first block."""
        order, matrix = None, self._matrix
        count = self._count
        for first in range(0, count, _BLOCK):
            part = slice(first, min(count, first + _BLOCK))
            if not self._columns and matrix is not None:
                rows = np.asarray(matrix[:, part]).T
                order = order or tell_order(rows)
                if order is None:
                    _refuse("the four columns are not t, x, y, p in a known order", self._path)
                t, x, y, p = (rows[:, k] for k in order)
            else:
                t, x, y, p = (_column(dataset, part) for dataset in self._columns)
            yield part.stop / count, (self._whole(t), self._whole(x), self._whole(y), p)

    def _whole(self, values: NDArray) -> NDArray[np.int64]:
        # Beyond 2^62 there is no time of any clock.
        if values.dtype.kind == "f" and not np.all((np.abs(values) < 2**62) & (values == np.floor(values))):
            _refuse("a time or pixel is not a whole number", self._path)
        return values.astype(np.int64)


def _is_numeric(found: object) -> bool:
    """Tell whether this is an array of numbers: texts, cells and empty arrays carry attributes that say so."""
    if not isinstance(found, h5py.Dataset) or found.dtype.kind not in "iufb" or "MATLAB_empty" in found.attrs:
        return False
    kind = found.attrs.get("MATLAB_class", b"")
    return kind not in (b"char", b"cell", "char", "cell") and found.ndim == 2


def _column(dataset: h5py.Dataset, part: slice) -> NDArray:
    return np.asarray(dataset[0, part] if dataset.shape[0] == 1 else dataset[part, 0])


def _refuse(message: str, path: Path) -> NoReturn:
    hint = "expected a matrix of four columns, or columns named t, x, y, p"
    raise FormatError(message, path=path, hint=hint)
