"""MATLAB files: one (N, 4) matrix of events, or four columns named t, x, y, p."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from dvsviz.errors import FormatError
from dvsviz.formats.columns import Columns, find_names, tell_order
from dvsviz.formats.sink import RecordingSink
from dvsviz.formats.sizes import assumption, require_size
from dvsviz.geometry.camera import Camera

MAGIC = b"MATLAB 5.0 MAT-file"
FORMAT_NAME = "MATLAB"
# Files of version 5 hold at most 2 GB a variable and are read whole; more than this is not asked of memory.
_MAX_BYTES = 400 << 20


def convert_mat(path: Path, sink: RecordingSink) -> None:
    """Read a MATLAB file of version 5 to 7 into a recording; pixels may count from 0 or from 1.

    Raises:
        FormatError: no events in it, or a damaged file.
    """
    # Slow to import and needed for these files alone.
    from scipy.io import loadmat, whosmat
    from scipy.io.matlab import MatReadError

    damage = (MatReadError, ValueError, TypeError, OSError, KeyError, IndexError, NotImplementedError, MemoryError)
    try:
        shapes = {name: shape for name, shape, _ in whosmat(path)}
        if sum(8 * float(np.prod(shape, dtype=np.float64)) for shape in shapes.values()) > _MAX_BYTES:
            hint = "save it as HDF5 or npz, which are read in blocks"
            raise FormatError("too large to be read whole", path=path, hint=hint)
        values: dict[str, Any] = loadmat(path)
    except (*damage, zlib.error, struct.error, AttributeError, OverflowError) as e:
        reason = " ".join(str(e).split())[:100]
        raise FormatError(f"damaged or not a MATLAB file ({reason})", path=path, hint="save it again") from e
    t, x, y, p = _columns({name: array for name, array in values.items() if not name.startswith("__")}, path)
    if not len(t):
        raise FormatError("there are no events", path=path, hint="record or save it again")
    for column in (t, x, y):
        if not np.all(np.isfinite(column)) or np.any(column != np.floor(column)) or np.abs(column).max() > 2**62:
            _refuse("a time or pixel is not a whole number", path)
    x, y = x.astype(np.int64), y.astype(np.int64)
    size = sink.options.size
    if size is None:
        # Counted from 1, the last column of a sensor has the number of its columns.
        one = int(x.min() >= 1 and y.min() >= 1)
        size = require_size(int(x.max()) - one, int(y.max()) - one, path)
        sink.warn(assumption(size))
    if x.min() >= 1 and y.min() >= 1 and (x.max() == size[0] or y.max() == size[1]):
        sink.warn("pixels count from 1: one was taken off")
        x, y = x - 1, y - 1
    sink.start(Camera.guess(*size))
    step = 1 << 20
    for first in range(0, len(t), step):
        part = slice(first, first + step)
        sink.add(t[part].astype(np.int64), x[part], y[part], p[part] > 0)
        sink.options.report(first / len(t))


def _columns(arrays: dict[str, Any], path: Path) -> Columns:
    # A struct of columns: its fields are looked at like variables.
    for group in [a for a in arrays.values() if isinstance(a, np.ndarray) and a.dtype.names and a.size == 1]:
        fields = {name: group[name].ravel()[0] for name in group.dtype.names or ()}
        if find_names([name for name, a in fields.items() if isinstance(a, np.ndarray)]) is not None:
            arrays = fields
    numeric = {n: a for n, a in arrays.items() if isinstance(a, np.ndarray) and a.dtype.kind in "iufb" and a.size}
    names = find_names(list(numeric))
    if names is not None:
        columns = [numeric[name].ravel() for name in names]
        if len({len(column) for column in columns}) != 1:
            _refuse("t, x, y, p differ in length", path)
        return columns[0], columns[1], columns[2], columns[3]
    tables = [array for array in numeric.values() if array.ndim == 2 and array.shape[1] == 4]
    if not tables:
        _refuse(f"no events among {', '.join(arrays) or 'nothing'}"[:200], path)
    table: NDArray = max(tables, key=len)
    order = tell_order(table)
    if order is None:
        _refuse("the four columns are not t, x, y, p in a known order", path)
    t, x, y, p = (table[:, k] for k in order)
    return t, x, y, p


def _refuse(message: str, path: Path) -> NoReturn:
    raise FormatError(message, path=path, hint="expected a matrix of four columns, or columns named t, x, y, p")
