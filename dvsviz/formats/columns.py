"""Columns of events in files whose layout nobody fixed: which is which, told by name or by value."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

Columns = tuple[NDArray, NDArray, NDArray, NDArray]

_NAMES = {
    "t": ("t_us", "t", "ts", "timestamp", "timestamps", "time"),
    "x": ("x", "x_px", "xs", "col"),
    "y": ("y", "y_px", "ys", "row"),
    "p": ("p", "pol", "polarity", "polarities", "ps", "is_positive", "on"),
}
_ORDERS = ((0, 1, 2, 3), (2, 0, 1, 3), (3, 0, 1, 2))


def find_names(names: Collection[str]) -> tuple[str, str, str, str] | None:
    """Return the names of the columns t, x, y, p among `names`, or None where one is missing."""
    found = [next((name for name in known if name in names), None) for known in _NAMES.values()]
    t, x, y, p = found
    return None if t is None or x is None or y is None or p is None else (t, x, y, p)


def tell_order(rows: NDArray) -> tuple[int, int, int, int] | None:
    """Return which columns of an (N, 4) array are t, x, y, p: `t x y p`, `x y t p` or `x y p t`, or None.

    Polarity is the column of -1, 0 and 1; time never falls; pixels are small.
    """
    for order in _ORDERS:
        t, x, y, p = (rows[:, k] for k in order)
        small = max(np.abs(x).max(), np.abs(y).max()) < 65_536 and set(np.unique(p).tolist()) <= {-1, 0, 1}
        if small and bool(np.all(t[1:] >= t[:-1])):
            return order
    return None
