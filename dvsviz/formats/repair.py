"""Dropping of events that cannot be right: outside the sensor, or out of the order of time; clocks that wrap."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from dvsviz.events.events import Events

# A step ahead by more than this is believed only where the following events confirm it: one flipped bit in a time
# must not make everything after it late.
_JUMP_US = 1_000_000
_LOOK_AHEAD = 32
# Clocks of 32 bits, unsigned or signed, begin anew so many microseconds before where they were, give or take a pause.
_PERIODS = (1 << 32, 1 << 31)
_PAUSE_US = 10_000_000


@numba.njit(cache=True, nogil=True)
def _period(t_us, i, last_us, shift):
    """Return the period of a clock that begins anew at event `i`, 0 where it does not."""
    for period in _PERIODS:
        if 0 <= t_us[i] + shift + period - last_us <= _PAUSE_US:
            end = min(len(t_us), i + 1 + _LOOK_AHEAD)
            later = 0
            for j in range(i + 1, end):
                if t_us[j] + shift >= last_us:
                    later += 1
            return period if 2 * later <= end - i - 1 else 0
    return 0


@numba.njit(cache=True, nogil=True)
def _keep(t_us, x_px, y_px, width, height, last_us, has_last, shift, keep):
    outside, backwards, wraps = 0, 0, 0
    n = len(t_us)
    for i in range(n):
        keep[i] = False
        if x_px[i] < 0 or x_px[i] >= width or y_px[i] < 0 or y_px[i] >= height:
            outside += 1
            continue
        t = t_us[i] + shift
        if has_last and t < last_us:
            period = _period(t_us, i, last_us, shift)
            if period == 0:
                backwards += 1
                continue
            shift += period
            wraps += 1
            t += period
        if not has_last or t - last_us > _JUMP_US:
            end = min(n, i + 1 + _LOOK_AHEAD)
            earlier = 0
            for j in range(i + 1, end):
                if t_us[j] + shift < t:
                    earlier += 1
            if 2 * earlier > end - i - 1:
                backwards += 1
                continue
        keep[i] = True
        t_us[i] = t
        last_us, has_last = t, True
    return outside, backwards, wraps, last_us, has_last, shift


class EventRepair:
    """Keeps the events of one recording that are inside the sensor and in order, and counts the others.

    Attributes:
        outside: events dropped outside the sensor.
        backwards: events dropped whose time ran backwards, or ahead alone.
        wraps: how often the clock began anew after 2^32 or 2^31 us, and was carried on.
    """

    def __init__(self, width: int, height: int) -> None:
        self.outside, self.backwards, self.wraps = 0, 0, 0
        self._size = (width, height)
        self._last_us, self._has_last, self._shift_us = 0, False, 0

    def __call__(self, t_us: NDArray, x_px: NDArray, y_px: NDArray, is_positive: NDArray[np.bool_]) -> Events:
        """Return what can be kept of the next events (N,), given as any integers."""
        keep = np.empty(len(t_us), np.bool_)
        width, height = self._size
        t = t_us.astype(np.int64)
        outside, backwards, wraps, self._last_us, self._has_last, self._shift_us = _keep(
            t, x_px, y_px, width, height, self._last_us, self._has_last, self._shift_us, keep
        )
        self.outside += int(outside)
        self.backwards += int(backwards)
        self.wraps += int(wraps)
        return Events(
            t_us=t[keep],
            x_px=x_px[keep].astype(np.uint16),
            y_px=y_px[keep].astype(np.uint16),
            is_positive=is_positive[keep],
        )
