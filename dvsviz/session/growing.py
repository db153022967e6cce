"""An array that grows at its end without copying what is there each time."""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike, NDArray


class Growing:
    """Rows that are appended; `view` stays valid (and unchanged) while later rows arrive."""

    def __init__(self, shape: tuple[int, ...], dtype: DTypeLike) -> None:
        self._data = np.zeros((0, *shape), dtype)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def append(self, rows: NDArray) -> None:
        """Append rows (N, *shape)."""
        end = self._count + len(rows)
        if end > len(self._data):
            larger = np.zeros((max(end, 2 * len(self._data)), *self._data.shape[1:]), self._data.dtype)
            larger[: self._count] = self._data[: self._count]
            self._data = larger
        self._data[self._count : end] = rows
        self._count = end

    def view(self) -> NDArray:
        """Return all rows, read-only."""
        out = self._data[: self._count]
        out.flags.writeable = False
        return out
