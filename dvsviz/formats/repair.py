"""Dropping of events that cannot be right: outside the sensor, or out of the order of time."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from dvsviz.events.events import Events

# A step ahead by more than this is believed only where the following events confirm it: one flipped bit in a time
# must not make everything after it late.
_JUMP_US = 1_000_000
_LOOK_AHEAD = 32


@numba.njit(cache=True, nogil=True)
def _keep(t_us, x_px, y_px, width, height, last_us, has_last, keep):
    outside, backwards = 0, 0
    n = len(t_us)
    for i in range(n):
        keep[i] = False
        if x_px[i] < 0 or x_px[i] >= width or y_px[i] < 0 or y_px[i] >= height:
            outside += 1
            continue
        t = t_us[i]
        if has_last and t < last_us:
            backwards += 1
            continue
        if not has_last or t - last_us > _JUMP_US:
            end = min(n, i + 1 + _LOOK_AHEAD)
            earlier = 0
            for j in range(i + 1, end):
                if t_us[j] < t:
                    earlier += 1
            if 2 * earlier > end - i - 1:
                backwards += 1
                continue
        keep[i] = True
        last_us, has_last = t, True
    return outside, backwards, last_us, has_last


class EventRepair:
    """Keeps the events of one recording that are inside the sensor and in order, and counts the others.

    Attributes:
        outside: events dropped outside the sensor.
        backwards: events dropped whose time ran backwards, or ahead alone.
    """

    def __init__(self, width: int, height: int) -> None:
        self.outside, self.backwards = 0, 0
        self._size = (width, height)
        self._last_us, self._has_last = 0, False

    def __call__(self, t_us: NDArray, x_px: NDArray, y_px: NDArray, is_positive: NDArray[np.bool_]) -> Events:
        """Return what can be kept of the next events (N,), given as any integers."""
        keep = np.empty(len(t_us), np.bool_)
        width, height = self._size
        outside, backwards, self._last_us, self._has_last = _keep(
            t_us.astype(np.int64, copy=False), x_px, y_px, width, height, self._last_us, self._has_last, keep
        )
        self.outside += int(outside)
        self.backwards += int(backwards)
        return Events(
            t_us=t_us[keep].astype(np.int64, copy=False),
            x_px=x_px[keep].astype(np.uint16),
            y_px=y_px[keep].astype(np.uint16),
            is_positive=is_positive[keep],
        )
